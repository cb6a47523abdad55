"""What people decided on changes of a map: the file ``map_decisions.json`` of a workspace.

The file holds the decisions in order; the last one about a change counts. The page "Map over time"
and ``semviz map changes`` write and read it. One that asks for a label in a frame of another
workspace is in the file of that one, too, for its list of labels. Nothing here changes a map:
decisions are made into a new one by ``changed_map``.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Field

from semviz.workspace.checked_file import CheckedModel, changing, read_checked, write_checked
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.passes.changes import Change, ChangeKind, MapChanges
from semviz_core.common.errors import SemvizError

Answer: TypeAlias = Literal["make", "keep", "label", "open"]
"""``make`` the change; ``keep`` the map as it is; ask for a ``label``, and keep the map until then;
``open``: not decided."""
SAME_M = 1.5
"""A new element of other passes is the same one up to this distance."""
HERE = "."
"""The folder of the workspace itself."""
_Name = Annotated[str, Field(max_length=80)]


def decisions_path(workspace: Workspace) -> Path:
    """Return the file of the decisions of a workspace, which need not exist."""
    return workspace.path / "map_decisions.json"


def answer_word(kind: ChangeKind, answer: Answer) -> str:
    """Return a answer as people say it: a new element is added, one that vanished removed."""
    if answer == "make":
        return {"new": "add", "moved": "move"}.get(kind, "remove")
    return "ask for a label" if answer == "label" else answer


class DecisionConflictError(SemvizError):
    """Somebody else decided on the same change in between."""


class LabelPlace(CheckedModel):
    """Where what a label is asked for is best seen."""

    workspace: str
    """Folder of the workspace of the pass, from that of the map; ``.``: it is the same."""
    run: str
    frame: int = Field(ge=0, lt=2**31)


DecidedAnswer: TypeAlias = tuple[str, Answer, LabelPlace | None]
"""Name of a change, the answer, and where a label is asked for."""


class ChangeDecision(CheckedModel):
    """One decision on a change of one version of a map."""

    map: str
    """Digest of the map."""
    kind: ChangeKind
    name: _Name
    """Of the element; of a new one, as it was called then."""
    class_name: str
    place_m: tuple[float, float, float]
    answer: Answer
    existence: float
    """Probability that the element exists, as it was known then."""
    passes: tuple[str, ...]
    """Names of the passes that were known then."""
    author: _Name
    time: str
    """UTC, ISO 8601."""
    label: LabelPlace | None = None
    """Of the answer ``label``."""

    def is_about(self, change: Change, digest: str) -> bool:
        """Whether it decides a change of the map with this digest. New elements are told by class
        and place, since their names follow from the passes."""
        if (self.map, self.kind, self.class_name) != (digest, change.kind, change.class_name):
            return False
        if change.kind == "new":
            return math.dist(self.place_m[:2], change.place_m[:2]) <= SAME_M
        return self.name == change.name


class ChangeDecisions(CheckedModel):
    """The content of the file."""

    version: Literal[1] = 1
    decisions: tuple[ChangeDecision, ...] = ()
    """Oldest first."""

    def on(self, change: Change, digest: str) -> ChangeDecision | None:
        """Return the decision on a change; None if it is open."""
        about = (one for one in reversed(self.decisions) if one.is_about(change, digest))
        last = next(about, None)
        return None if last is None or last.answer == "open" else last

    def made(self, found: MapChanges, also: Iterable[str] = ()) -> frozenset[str]:
        """Return the names of the changes to make, and of those of ``also`` that are open."""
        digest, other = found.semantic_map.digest, set(also)
        decided = {change.name: self.on(change, digest) for change in found.changes}
        return frozenset(
            name
            for name, decision in decided.items()
            if (name in other if decision is None else decision.answer == "make")
        )

    def as_dict(self, found: MapChanges) -> dict[str, Any]:
        """Return the changes with their decisions, for JSON."""
        said = found.as_dict()
        for change, told in zip(found.changes, said["changes"], strict=True):
            decision = self.on(change, found.semantic_map.digest)
            told["answer"] = "open" if decision is None else decision.answer
        return said

    def labels_here(self) -> list[ChangeDecision]:
        """Return the decisions that ask for labels in frames of this workspace, oldest first."""
        last = {(one.map, one.kind, one.name): one for one in self.decisions}
        return [one for one in last.values() if one.label and one.label.workspace == HERE]


def asked_by_frame(path: Path) -> dict[int, tuple[str, ...]]:
    """Return the names of elements whose labels are asked for in frames of the workspace, by the
    decisions in the file ``path``; none if it is damaged, which other uses of it report.

    Cheap while the file stays the same: annotate asks after every edit.
    """
    try:
        status = path.stat()
    except OSError:
        return {}
    return _asked_by_frame(path, (status.st_mtime_ns, status.st_ino))


@lru_cache(maxsize=8)
def _asked_by_frame(path: Path, _stamp: tuple[int, int]) -> dict[int, tuple[str, ...]]:
    try:
        asked = read_decisions(path).labels_here()
    except SemvizError:
        return {}
    names: dict[int, tuple[str, ...]] = {}
    for one in asked:
        assert one.label is not None
        names[one.label.frame] = (*names.get(one.label.frame, ()), one.name)
    return names


def read_decisions(path: Path) -> ChangeDecisions:
    """Return the decisions in the file ``path``; none if there is no such file.

    Raise SemvizError if it is damaged, or of a newer version.
    """
    return read_checked(path, ChangeDecisions, "decisions", "all changes of the map are then open")


def decide_in(
    workspace: Workspace,
    found: MapChanges,
    answers: Sequence[DecidedAnswer],
    author: str,
    seen: int | None = None,
) -> ChangeDecisions:
    """Add answers to the file of the workspace of a map, as ``decide`` does.

    Workspaces whose frames show what a label is asked for, or was, get that answer, too: their own
    lists of labels show it. Raise SemvizError if one of them is gone; nothing is then decided.
    """
    path = decisions_path(workspace)
    told = _told_elsewhere(read_decisions(path), found, answers)
    paths = {folder: decisions_path(Workspace.open(workspace.path / folder)) for folder in told}
    after = decide(path, found, answers, author, seen)
    for folder, others in told.items():
        decide(paths[folder], found, others, author)
    return after


def _told_elsewhere(
    before: ChangeDecisions, found: MapChanges, answers: Sequence[DecidedAnswer]
) -> dict[str, list[DecidedAnswer]]:
    """Return what other workspaces are told, by folder."""
    changes = {change.name: change for change in found.changes}
    told: dict[str, list[DecidedAnswer]] = defaultdict(list)
    for name, answer, place in answers:
        last = before.on(changes[name], found.semantic_map.digest) if name in changes else None
        if last is not None and last.label is not None:
            told[last.label.workspace].append((name, "open", None))
        if place is not None:
            there = place.model_copy(update={"workspace": HERE})
            told[place.workspace].append((name, answer, there))
    told.pop(HERE, None)
    return told


def decide(
    path: Path,
    found: MapChanges,
    answers: Sequence[DecidedAnswer],
    author: str,
    seen: int | None = None,
) -> ChangeDecisions:
    """Add answers on changes, by their names, to the file ``path``. Return all decisions.

    ``seen`` counts the decisions that the author had seen. Raise DecisionConflictError if a later
    one is about the same change, and SemvizError for a name that is no change; nothing is then
    decided.
    """
    changes = {change.name: change for change in found.changes}
    digest, time = found.semantic_map.digest, datetime.now(UTC).isoformat(timespec="milliseconds")
    if unknown := sorted({name for name, *_ in answers} - changes.keys()):
        raise SemvizError(f"{unknown[0]} is no change of this map; leave it out")
    with changing(path):
        before = read_decisions(path)
        for later in before.decisions[len(before.decisions) if seen is None else seen :]:
            for name, *_ in answers:
                if later.is_about(changes[name], digest):
                    raise DecisionConflictError(
                        f"{later.author} decided on {name} meanwhile; nothing was changed: look "
                        "at it and repeat"
                    )
        made = [
            _decision(changes[name], answer, found, place, author, time)
            for name, answer, place in answers
        ]
        after = ChangeDecisions(decisions=(*before.decisions, *made))
        if made:
            write_checked(path, after)
    return after


def _decision(
    change: Change,
    answer: Answer,
    found: MapChanges,
    place: LabelPlace | None,
    author: str,
    time: str,
) -> ChangeDecision:
    values: dict[str, Any] = {
        name: getattr(change, name) for name in ("kind", "name", "class_name", "place_m")
    }
    return ChangeDecision(
        map=found.semantic_map.digest,
        answer=answer,
        existence=change.existence,
        passes=found.passes,
        author=author,
        time=time,
        label=place,
        **values,
    )
