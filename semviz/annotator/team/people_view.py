"""Who may label a workspace, and where they are now, as the page shows it."""

from collections.abc import Iterable, Mapping
from typing import Literal

from semviz.web.protocol import Event, Part
from semviz.workspace.people import Person, Role


class PersonView(Part):
    """Somebody who was invited, or who started the server and has a page open."""

    name: str
    role: Role
    frames: list[int]
    """Those on screen, one for each page; empty while away."""
    element: str
    """Name of the selected element; empty for none."""


class PeopleEvent(Event):
    """Who may label this workspace, and where they are; sent when it changes."""

    type: Literal["people"] = "people"
    people: list[PersonView]


def people_views(
    people: Mapping[str, Person], owner: str, pages: Iterable[tuple[str, int, str]]
) -> list[PersonView]:
    """Return the people by name; ``pages`` have authors, frames, and selected elements."""
    roles: dict[str, Role] = {name: person.role for name, person in people.items()}
    frames: dict[str, list[int]] = {name: [] for name in roles}
    elements: dict[str, str] = {}
    for name, frame, element in pages:
        if name in roles or name == owner:
            frames.setdefault(name, []).append(frame)
            elements[name] = element or elements.get(name, "")
    return [
        PersonView(
            name=name,
            role=roles.get(name, "review"),
            frames=sorted(set(here)),
            element=elements.get(name, ""),
        )
        for name, here in sorted(frames.items())
    ]
