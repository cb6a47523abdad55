"""Labelling one workspace: what the page can ask for and do. No web, no screen."""

import hashlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

from pydantic import Field
from pydantic.dataclasses import dataclass as checked_dataclass

from semviz.annotator import views
from semviz.annotator.cards import card, epipolar_error_px
from semviz.annotator.ghosts import Ghost, ghosts_in
from semviz.annotator.nearby import nearby_in
from semviz.annotator.pairing import Partner, partner_of
from semviz.annotator.places import Places
from semviz.annotator.views import Json
from semviz.workspace import Workspace
from semviz_annotation.edits import AddObservation, edit_from_json
from semviz_annotation.labels import STRICT, Id, Index, Labels, Observation, Pixel
from semviz_annotation.stereo import epipolar_segment
from semviz_annotation.store import Operation
from semviz_annotation.triangulate import Triangulated
from semviz_annotation.view import camera_of, other, rig_view
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame
from semviz_core.sources.source import Side

HISTORY = 100
"""So many operations the page lists."""
WHOLE_LINE_M = (0.5, float("inf"))


@dataclass(frozen=True)
class Done:
    """An edit that is on disk."""

    operation: Operation
    element_id: str | None
    """The element to which a drawing, link or unlinked view belongs now; None for other edits."""
    frame: int | None
    """Where it happened, if in this sequence; the page goes there after an undo."""
    note: str = ""
    """What people should know about it."""


@checked_dataclass(frozen=True, config=STRICT)
class Drawing:
    """What is under the pen: not saved yet."""

    side: Side
    class_id: Index
    anchor_px: Pixel
    end_px: Pixel | None
    anchor_known: bool = True
    end_known: bool = True


@checked_dataclass(frozen=True, config=STRICT)
class Look:
    """What the page has in hand, for which it wants guides and numbers."""

    frame_index: Index
    selected_id: Id | None = None
    side: Side = "left"
    """Of the selected observation."""
    drawing: Drawing | None = None
    moved: dict[Id, tuple[Pixel, Pixel | None]] = Field(default_factory=dict)
    """Observations that are being dragged, with where they are now."""


class LabelSession:
    """The labels of one workspace under the hands of one author. One thread at a time."""

    def __init__(self, workspace: Workspace, author: str) -> None:
        self.workspace = workspace
        self.author = author
        self.source = workspace.source
        self.rig = self.source.rig
        self.classes = workspace.classes
        self.frames: Mapping[int, Frame] = {frame.index: frame for frame in self.source.frames}
        self._order = tuple(self.frames)
        if not self.frames:
            raise SemvizError(f"{workspace.path}: the sequence has no frames")
        self._store = workspace.open_labels()
        self._places = Places(self.rig, self.source.frames)
        self._history: deque[Json] = deque(maxlen=HISTORY)
        """Newest first."""
        self._told = max(0, self._store.last_operation - HISTORY)
        """The last operation in the history."""
        self._announced = self._store.last_operation
        """The last operation that the pages have been told of."""
        self._touched: set[int] = set()
        """Frames that operations since then have changed."""

    def close(self) -> None:
        self._store.close()

    @property
    def labels(self) -> Labels:
        return self._store.labels

    # -- what there is

    def describe(self) -> Json:
        """What stays the same while the page is open."""
        cameras = {"left": self.rig.left, "right": self.rig.right}
        path = str(self.workspace.path.resolve())
        return {
            "workspace": self.workspace.name,
            "key": hashlib.sha256(path.encode()).hexdigest()[:16],
            "source": self.source.map_frame.name,
            "author": self.author,
            "classes": [vars(one) for one in self.classes],
            "images": {
                side: None if camera is None else {"width": camera.width, "height": camera.height}
                for side, camera in cameras.items()
            },
        }

    def summary(self) -> Json:
        """Everything about the labels but the frame on screen."""
        labels = self.labels
        return self._state(labels) | {"frames": views.frames_json(labels, self.frames)}

    def has_news(self) -> bool:
        """Whether anybody, here or in another process, has done something since ``news``."""
        return self._store.last_operation > self._announced

    def news(self) -> Json:
        """What is new in the summary since the last call. Meant for all pages at once."""
        labels = self.labels
        state = self._state(labels)
        touched = sorted(self._touched & self.frames.keys())
        self._touched.clear()
        self._announced = self._told
        return state | {"frames": views.frames_json(labels, touched)}

    def frame(self, index: int) -> Json:
        """One frame: what is labelled in it, what is expected, and what else may go on in it."""
        self._known(index)
        labels = self.labels
        ghosts = self._ghosts(index, labels)
        expected = {one.element_id for one in ghosts}
        nearby = nearby_in(index, self._order, expected, labels, self.rig, self._places)
        return {
            "index": index,
            "elements": views.elements_json(labels, index, self.classes),
            "ghosts": views.ghosts_json(ghosts, labels, self.classes),
            "nearby": views.nearby_json(nearby, labels, self.classes),
        }

    def elements_3d(self) -> Elements3D:
        """All elements that have a place, their numbers as ids."""
        labels = self.labels
        mapped = self._places.mapped(labels)
        elements = [labels.elements[one] for one in mapped]
        return Elements3D.from_ends(
            [one.number for one in elements],
            [place.anchor_m for place in mapped.values()],
            [place.end_m for place in mapped.values()],
            [one.class_id for one in elements],
        )

    def place(self, element_id: str) -> Triangulated | None:
        """Where an element is in the map frame; None where that is not known."""
        place = self._places.of_element(self.labels, element_id)
        return place if isinstance(place, Triangulated) else None

    # -- what one can do

    def do(self, request_id: str, edit: Json) -> Done:
        """Does an edit, ``draw``, ``undo`` or ``redo``; on disk when this returns.

        The same request again is done once. Raises SemvizError where it is refused or not saved.
        """
        match edit.get("kind"):
            case "undo":
                return self._done(self._store.undo(self.author, request_id))
            case "redo":
                return self._done(self._store.redo(self.author, request_id))
            case "draw":
                return self._draw(request_id, dict(edit))
        operation = self._store.apply(edit_from_json(edit), self.author, request_id)
        return self._done(operation)

    def _draw(self, request_id: str, edit: Json) -> Done:
        """A new observation: of the element it belongs to, or of a new one."""
        selected_id = edit.pop("selected_id", None)
        drawn = edit_from_json(edit | {"kind": "add"})
        if not isinstance(drawn, AddObservation) or drawn.class_id is None:
            raise SemvizError("a drawing needs its class")
        self._known(drawn.frame_index)
        seen = Drawing(
            side=drawn.side,
            class_id=drawn.class_id,
            anchor_px=drawn.anchor_px,
            end_px=drawn.end_px,
            anchor_known=drawn.anchor_known,
            end_known=drawn.end_known,
        )
        partner = self._partner(drawn.frame_index, seen, selected_id)
        if partner.element_id is not None:
            drawn = replace(drawn, element_id=partner.element_id, class_id=None)
        operation = self._store.apply(drawn, self.author, request_id)
        return replace(self._done(operation), note=partner.note)

    def _done(self, operation: Operation) -> Done:
        rows = [change.after for change in operation.changes]
        seen = [row.element_id for row in rows if isinstance(row, Observation)]
        frame = views.frame_of(operation, self.labels)
        return Done(
            operation=operation,
            element_id=seen[0] if seen and operation.kind in ("add", "link", "unlink") else None,
            frame=frame if frame in self.frames else None,
            note=views.what_fell(operation, self.labels, self.classes),
        )

    # -- what is in hand

    def look(self, look: Look) -> Json:
        """Guides in both images, the element that a drawing joins, and the numbers of its card."""
        self._known(look.frame_index)
        labels = self.labels
        partner = Partner(look.selected_id)
        if look.drawing is not None:
            partner = self._partner(look.frame_index, look.drawing, look.selected_id)
        observations = self._in_hand(look, partner.element_id, labels)
        here = [one for one in observations if one.frame_index == look.frame_index]
        element = labels.elements.get(partner.element_id or "")
        name = None if element is None else views.element_name(element, self.classes)
        return {
            "guides": self._guides(look, here),
            "joins": name if look.drawing is not None else None,
            "card": self._card(look.frame_index, observations, here) if observations else None,
        }

    def _in_hand(
        self, look: Look, element_id: str | None, labels: Labels
    ) -> tuple[Observation, ...]:
        """The element's observations as they would be if the pen were lifted now."""
        observations = [] if element_id is None else list(labels.of_element(element_id))
        for place, one in enumerate(observations):
            if one.id in look.moved:
                anchor, end = look.moved[one.id]
                observations[place] = replace(one, anchor_px=anchor, end_px=end)
        if look.drawing is not None:
            observations.append(_observation(look.drawing, look.frame_index))
        return tuple(observations)

    def _guides(self, look: Look, here: list[Observation]) -> dict[str, list[Json]]:
        """Epipolar lines of what is in hand, in the images across from it."""
        guides: dict[str, list[Json]] = {"left": [], "right": []}
        if self.rig.right is None:
            return guides
        for one in here:
            if look.drawing is None and one.side != look.side:
                continue
            guides[other(one.side)].append(self._guide(one.side, one.anchor_px))
            if one.end_px is not None and one.end_px != one.anchor_px:
                guides[other(one.side)].append(self._guide(one.side, one.end_px))
        return guides

    def _guide(self, side: Side, pixel: Pixel) -> Json:
        here, there = rig_view(self.rig, side), rig_view(self.rig, other(side))
        return {
            "line": epipolar_segment(here, there, pixel, WHOLE_LINE_M).tolist(),
            "plausible": epipolar_segment(here, there, pixel).tolist(),
        }

    def _card(
        self, frame_index: int, observations: tuple[Observation, ...], here: list[Observation]
    ) -> Json:
        T_camera_map = self._places.T_camera_map(frame_index)
        if T_camera_map is None:
            place, count = self._places.of_pair(here), len(here)
        else:
            place, count = self._places.of_observations(observations), len(observations)
        lengths = {
            one.side: _length_px(one.anchor_px, one.end_px)
            for one in here
            if one.end_px is not None
        }
        return card(place, rig_view(self.rig, "left", T_camera_map), count) | {
            "length_px": lengths,
            "epipolar_px": epipolar_error_px(
                [(rig_view(self.rig, one.side), one) for one in sorted(here, key=lambda x: x.side)]
            ),
        }

    def _partner(self, frame_index: int, drawing: Drawing, selected_id: str | None) -> Partner:
        camera_of(self.rig, drawing.side)
        labels = self.labels
        return partner_of(
            _observation(drawing, frame_index),
            drawing.class_id,
            selected_id,
            self._ghosts(frame_index, labels),
            labels,
            self._places,
            self.classes,
        )

    def _ghosts(self, frame_index: int, labels: Labels) -> tuple[Ghost, ...]:
        T_camera_map = self._places.T_camera_map(frame_index)
        if T_camera_map is None:
            return ()
        mapped = self._places.mapped(labels)
        return ghosts_in(frame_index, T_camera_map, self.rig, labels, mapped)

    def _state(self, labels: Labels) -> Json:
        for one in self._store.operations(after=self._told):
            self._history.appendleft(views.operation_json(one, labels, self.classes))
            self._touched.update(views.frames_touched(one))
            self._told = one.number
        return {
            "operation": self._told,
            "counts": views.class_counts(labels),
            "mapped": len(self._places.mapped(labels)),
            "can_undo": self._store.undoable(self.author) is not None,
            "can_redo": self._store.redoable(self.author) is not None,
            "history": list(self._history),
        }

    def _known(self, index: int) -> None:
        if index not in self.frames:
            raise SemvizError(f"frame {index} is not in this sequence")


def _observation(drawing: Drawing, frame_index: int) -> Observation:
    """A drawing as the observation that it would become."""
    return Observation(
        id="",
        element_id="",
        frame_index=frame_index,
        side=drawing.side,
        anchor_px=drawing.anchor_px,
        end_px=drawing.end_px,
        anchor_known=drawing.anchor_known,
        end_known=drawing.end_known,
    )


def _length_px(anchor: Pixel, end: Pixel) -> float:
    return float(((anchor[0] - end[0]) ** 2 + (anchor[1] - end[1]) ** 2) ** 0.5)
