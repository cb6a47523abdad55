"""Labelling one workspace: what the page can ask for and do. No web, no screen."""

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

from semviz.annotator import views
from semviz.annotator.bottoms import Bottoms
from semviz.annotator.cameras import Cameras
from semviz.annotator.facts import Facts
from semviz.annotator.hand import Drawing, Hand, Look, seen_from_json
from semviz.annotator.images import Images
from semviz.annotator.looker import Looker
from semviz.annotator.map_work import MapWork
from semviz.annotator.news import News
from semviz.annotator.offer_views import offers_json, snapped_json
from semviz.annotator.offers import Question, inside
from semviz.annotator.pairing import Partner, partner_of
from semviz.annotator.panes import Panes
from semviz.annotator.past import Past, operation_number
from semviz.annotator.places import Places
from semviz.annotator.proposing import Proposing
from semviz.annotator.reviews import Reviews
from semviz.annotator.views import Json
from semviz.workspace import Workspace
from semviz_annotation.edits import AddMany, AddObservation, edit_from_json
from semviz_annotation.labels import Labels, Observation
from semviz_annotation.proposals import load_proposals
from semviz_annotation.storing.store import Operation
from semviz_annotation.triangulate import Triangulated
from semviz_annotation.view import camera_of
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.frame import Frame


@dataclass(frozen=True)
class Done:
    """An edit that is on disk."""

    operation: Operation
    element_id: str | None
    """The element to which a drawing, link or unlinked view belongs now; None for other edits."""
    frame: int | None
    """Where it happened, if in this sequence; the page goes there after an undo."""
    added: int = 0
    """So many observations more than before."""
    note: str = ""
    """What people should know about it."""


class LabelSession:
    """The labels of one workspace under the hands of one author. One thread at a time.

    ``images``, ``looker`` and ``map_work`` may be used by any thread.
    """

    def __init__(self, workspace: Workspace, author: str) -> None:
        self.workspace = workspace
        self.author = author
        self.source = workspace.source
        self.rig = self.source.rig
        self.classes = workspace.classes
        self.frames: Mapping[int, Frame] = {frame.index: frame for frame in self.source.frames}
        if not self.frames:
            raise SemvizError(f"{workspace.path}: the sequence has no frames")
        detected = load_proposals(workspace.proposals_path, self.classes)
        self._store = workspace.open_labels()
        self.images = Images(self.source)
        cameras = Cameras(self.rig, self.source.frames)
        self._panes = Panes(cameras)
        self._places = Places(cameras)
        self.looker = Looker(self.images, cameras, self.classes)
        self._snap = lru_cache(maxsize=8)(self.looker.snap)  # what is shown is then saved
        self._hand = Hand(cameras, self._panes, self._places)
        self._proposing = Proposing(cameras, self._panes, self._places, self.looker, detected)
        self._bottoms = Bottoms(cameras, self._panes, self._places, self.looker, self._proposing)
        self._facts = Facts(tuple(self.frames), self._places, self._proposing)
        self.past = Past(self._store, self._panes, self.frames, self.classes)
        self._elements_3d = -1, -1, Elements3D.from_ends([], [], [], [])
        """As of this operation and version of the places."""
        self._news = News(self._store, self.classes, self._facts)
        self.map_work = MapWork(workspace, lambda: self._store.labels)
        self._reviews = Reviews(self.map_work)
        self._told_version = self.map_work.version
        self._placed_version = self._told_placed = self._places.version

    def close(self) -> None:
        self.map_work.close()
        self.images.close()
        self._store.close()

    @property
    def labels(self) -> Labels:
        return self._store.labels

    # -- what there is

    def describe(self) -> Json:
        """What stays the same while the page is open."""
        second = self.rig.left if self.rig.right is None else self.rig.right  # another frame
        cameras = {"left": self.rig.left, "right": second}
        path = str(self.workspace.path.resolve())
        return {
            "workspace": self.workspace.name,
            "key": hashlib.sha256(path.encode()).hexdigest()[:16],
            "source": self.source.map_frame.name,
            "author": self.author,
            "classes": [vars(one) for one in self.classes],
            "images": {
                side: {"width": camera.width, "height": camera.height}
                for side, camera in cameras.items()
            },
            "has_right": self.rig.right is not None,
        }

    def summary(self) -> Json:
        """Everything about the labels but the frame on screen."""
        labels = self.labels
        return self._state(labels) | {"frames": self._frames_json(labels, self.frames)}

    def has_news(self) -> bool:
        """Whether anybody, here or in another process, has done something since ``news``; or all
        elements have got their places since."""
        is_built = self.map_work.version != self._told_version
        return self._news.waits or is_built or self._placed_version > self._told_placed

    def news(self) -> Json:
        """What is new in the summary since the last call. Meant for all pages at once."""
        labels = self.labels
        self._told_version = self.map_work.version
        state = self._state(labels)
        self._told_placed = self._places.version
        touched = sorted(self._news.told() & self.frames.keys())
        return state | {"frames": self._frames_json(labels, touched)}

    def learn(self, seconds: float) -> tuple[list[Json], bool]:
        """Frames of which something new is known after so long; whether all is known.

        To be called again and again, in the background: first elements get their places.
        """
        labels = self.labels
        if not self._places.settle(labels, seconds):
            return [], False
        self._placed_version = self._places.version
        frames, done = self._facts.learn(labels, seconds)
        return self._frames_json(labels, frames), done

    def frame(self, index: int) -> Json:
        """One frame: what is labelled in it, what is proposed, and what else may go on in it.

        ``looking``: the images have not been asked about all of it yet.
        """
        self._known(index)
        labels = self.labels
        panes = self._panes.of(index)
        offers = self._bottoms.judged(self._proposing.offers(index, labels), index, labels)
        nearby = self._proposing.nearby(index, labels)
        return {
            "index": index,
            "panes": views.panes_json(panes),
            "elements": views.elements_json(labels, panes, self.classes),
            "offers": offers_json(offers, panes, labels, self.rig, self.classes),
            "nearby": views.nearby_json(nearby, labels, self.classes),
            "looking": bool(self._proposing.unanswered(index, labels)),
        }

    def review(self, asked: Json) -> Json:
        """A decision of the last map, or a finding in it; see ``Reviews.card``."""
        return self._reviews.card(asked, self.labels)

    def unanswered(self, index: int) -> list[Question]:
        """What ``looker`` should be asked, for ``frame`` to know all about its proposals."""
        return self._proposing.unanswered(index, self.labels)

    def elements_3d(self) -> Elements3D:
        """All elements that have a place so far, their numbers as ids."""
        labels = self.labels
        mapped = self._places.mapped(labels)
        if self._elements_3d[:2] != (labels.operation, self._places.version):
            made = self._made_elements_3d(labels, mapped)
            self._elements_3d = labels.operation, self._places.version, made
        return self._elements_3d[2]

    def _made_elements_3d(self, labels: Labels, mapped: Mapping[str, Triangulated]) -> Elements3D:
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
            case "name":
                name = str(edit.get("name", ""))
                return self._done(self._store.name_state(name, self.author, request_id))
            case "restore":
                number = operation_number(edit.get("number"))
                return self._done(self._store.restore(number, self.author, request_id))
            case "accept":
                return self._accept(request_id, dict(edit))
            case _:
                return self._change(request_id, dict(edit))

    def _draw(self, request_id: str, edit: Json) -> Done:
        """A new observation: of the element it belongs to, or of a new one."""
        added, note = self._added(edit)
        operation = self._store.apply(added, self.author, request_id)
        return replace(self._done(operation), note=note)

    def _accept(self, request_id: str, edit: Json) -> Done:
        """Proposals as the page showed them: each like a drawing, all or none."""
        marks = edit.get("marks")
        if not isinstance(marks, list) or not all(isinstance(one, dict) for one in marks):
            raise SemvizError("no proposals to accept")
        things: dict[object, list[Json]] = defaultdict(list)
        for one in marks:
            things[one.get("element_id")].append(one)
        added = tuple(one for thing in things.values() for one in self._one_thing(thing))
        return self._done(self._store.apply(AddMany(added), self.author, request_id))

    def _one_thing(self, marks: list[Json]) -> Iterator[AddObservation]:
        """Marks of one element; those of a new one join another if all of them do."""
        added = [self._added(one)[0] for one in marks]
        if (
            all(one.class_id is None for one in added)
            and len({one.element_id for one in added}) == 1
        ):
            yield from added
            return
        name = str(marks[0]["element_id"])
        class_id = next(one["class_id"] for one in marks if one.get("class_id") is not None)
        is_new = name not in self.labels.elements
        for n, one in enumerate(added):
            makes_it = is_new and n == 0
            yield replace(one, element_id=name, class_id=class_id if makes_it else None)

    def _change(self, request_id: str, edit: Json) -> Done:
        """Another edit; ``seen`` is its observation as the page showed it."""
        seen = edit.pop("seen", None)
        change = edit_from_json(edit)
        expects = None if seen is None else seen_from_json(seen).as_row(edit["observation_id"])
        return self._done(self._store.apply(change, self.author, request_id, expects=expects))

    def _added(self, drawn: Json) -> tuple[AddObservation, str]:
        """A drawing as the edit that adds it, and what people should know.

        ``side`` is that of the page. Without a ``class_id`` it is of element ``element_id``. With
        one it is of ``selected_id``, or of what is expected there, or of a new ``element_id``.
        """
        drawn = dict(drawn)
        selected_id, snap = drawn.pop("selected_id", None), drawn.pop("snap", False) is True
        asks_bottom = drawn.pop("asks_bottom", False) is True
        added = edit_from_json(drawn | {"kind": "add"})
        if not isinstance(added, AddObservation):
            raise SemvizError("not a drawing; reload the page")
        self._known(added.frame_index)
        pane = self._panes.pane(added.frame_index, added.side)
        on_pane = replace(added, frame_index=pane.frame_index, side=pane.side)
        if added.class_id is None:
            return on_pane, ""
        begun = _drawing(added, added.class_id, snap, asks_bottom)
        drawing = self._snapped(begun, added.frame_index, selected_id)
        partner = self._partner(added.frame_index, drawing, selected_id)
        placed = replace(
            on_pane,
            anchor_px=drawing.anchor_px,
            end_px=drawing.end_px,
            anchor_known=drawing.anchor_known,
            end_known=drawing.end_known,
        )
        if partner.element_id is not None:
            placed = replace(placed, element_id=partner.element_id, class_id=None)
        return placed, partner.note

    def _done(self, operation: Operation) -> Done:
        rows = [change.after for change in operation.changes]
        seen = [row.element_id for row in rows if isinstance(row, Observation)]
        frame = views.frame_of(operation, self.labels)
        return Done(
            operation=operation,
            element_id=seen[0] if seen and operation.kind in ("add", "link", "unlink") else None,
            frame=frame if frame in self.frames else None,
            added=views.observations_added(operation),
            note=views.note_on(operation, self.labels, self.classes),
        )

    # -- what is in hand

    def look(self, look: Look) -> Json:
        """Guides in both images, the element that a drawing joins, and the numbers of its card.

        ``snapped`` is where a drawing that snaps will be saved, None where it stays as it is.
        """
        self._known(look.frame_index)
        labels = self.labels
        partner, snapped = Partner(look.selected_id), None
        if look.drawing is not None:
            drawing = self._snapped(look.drawing, look.frame_index, look.selected_id)
            snapped = None if drawing is look.drawing else snapped_json(look.drawing, drawing)
            look = replace(look, drawing=drawing)
            if drawing.has_shape:
                partner = self._partner(look.frame_index, drawing, look.selected_id)
        element = labels.elements.get(partner.element_id or "")
        name = None if element is None else views.element_name(element, self.classes)
        return self._hand.about(look, partner.element_id, labels) | {
            "snapped": snapped,
            "joins": name if look.drawing is not None else None,
        }

    def _snapped(self, drawing: Drawing, frame_index: int, selected_id: str | None) -> Drawing:
        """On the edges it is meant to be on, where it snaps and they are clear; without its bottom,
        where it asks for that and the ground is clearly below."""
        moved = self._on_edges(drawing, frame_index) if drawing.snap else drawing
        if not (moved.asks_bottom and moved.end_known and moved.end_px and moved.has_shape):
            return moved
        hidden = self._bottoms.is_hidden(moved, frame_index, selected_id, self.labels)
        return replace(moved, end_known=False) if hidden else moved

    def _on_edges(self, drawing: Drawing, frame_index: int) -> Drawing:
        pane = self._panes.pane(frame_index, drawing.side)
        found = self._snap(pane, drawing.mark, drawing.class_id)
        mark = None if found is None else inside(found.mark, camera_of(self.rig, pane.side)[0])
        if mark is None:
            return drawing
        return replace(
            drawing,
            anchor_px=mark.anchor_px,
            end_px=mark.end_px,
            anchor_known=drawing.anchor_known and mark.anchor_known,
            end_known=drawing.end_known and mark.end_known,
        )

    def _partner(self, frame_index: int, drawing: Drawing, selected_id: str | None) -> Partner:
        labels = self.labels
        observation = self._hand.observation(drawing, frame_index)
        pane = self._panes.pane(frame_index, drawing.side)
        return partner_of(
            observation,
            drawing.class_id,
            selected_id,
            [one for one in self._proposing.offers(frame_index, labels) if one.pane == pane],
            labels,
            self._places,
            self.classes,
        )

    def _state(self, labels: Labels) -> Json:
        history = self._news.history(labels)
        return {
            "operation": self._news.operation,
            "counts": views.class_counts(labels),
            "mapped": len(self._places.mapped(labels)),
            "can_undo": self._store.undoable(self.author) is not None,
            "can_redo": self._store.redoable(self.author) is not None,
            "history": history,
            "map": self._reviews.summary(labels),
        }

    def _frames_json(self, labels: Labels, indices: Iterable[int]) -> list[Json]:
        return [views.frame_json(labels, one, self._facts.of(one)) for one in indices]

    def _known(self, index: int) -> None:
        if index not in self.frames:
            raise SemvizError(f"frame {index} is not in this sequence")


def _drawing(added: AddObservation, class_id: int, snap: bool, asks_bottom: bool) -> Drawing:
    return Drawing(
        side=added.side,
        class_id=class_id,
        anchor_px=added.anchor_px,
        end_px=added.end_px,
        anchor_known=added.anchor_known,
        end_known=added.end_known,
        snap=snap,
        asks_bottom=asks_bottom,
    )
