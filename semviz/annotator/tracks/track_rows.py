"""The rows of the view "Tracks": what every element shows in every frame, kept up to date.

A row belongs to a label element, or to an open track of detections. Rows are computed a slice at
a time, and again when the labels of their element change.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from semviz.annotator.element_positions import ElementPositions, Position
from semviz.annotator.frame_quality import FrameQuality, residual_px
from semviz.annotator.tracks.detection_tracks import DetectionTrack, OpenTracks
from semviz.annotator.views import ElementRef, NoteView, attribute_values, element_ref, note_view
from semviz.web.protocol import Part
from semviz_annotation.labels.labels import Dismissal, LabelElement, Labels, Observation
from semviz_annotation.labels.shared_dict import SharedDict
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.frame import Side

NOTHING, PROPOSED, REJECTED, HIDDEN, ABSENT, UNPLACED = -1, -2, -3, -4, -5, -6
"""Codes of cells that have no residual; the others are residuals in tenths of a pixel."""
_CODES = {"rejected": REJECTED, "occluded": HIDDEN, "absent": ABSENT}
_MOST = 9999
SKETCH_S = 0.3
"""How long the first answer may take to show rows whose residuals are not known yet."""


class TrackRow(ElementRef):
    """An element in all frames from the first that shows something of it to the last."""

    number: int
    """Of the element; of an open track its place below 0."""
    first: int
    """Place of the first cell in the order of frames."""
    left: list[int]
    """Cells of the left image: residual in 0.1 px, or -1 nothing, -2 proposed, -3 rejected,
    -4 hidden, -5 no longer there, -6 labelled, but without a position."""
    right: list[int]
    views: int
    """Number of labels, or of detections; 0: the element is gone."""
    worst_px: float | None
    score: float | None
    """Probability that an open track exists; None for label elements."""
    doubt: str
    """Why a person should look at an open track first; empty: it is sure, or no track."""
    left_out: bool
    notes: list[NoteView]
    attributes: dict[str, str]


class TrackFrame(Part):
    """Elements that are expected in the images of a frame and not labelled there, by number."""

    index: int
    left: list[int]
    right: list[int]


def residual_of(
    positions: ElementPositions, row: Observation, position: Position | None
) -> float | None:
    """Return the residual of a label, px; None if its element or its frame has no position."""
    if not isinstance(position, Triangulated) or not positions.posed([row]):
        return None
    px = residual_px(positions.view(row), row, position)
    return px if np.isfinite(px) else None


@dataclass
class TrackRows:
    """Computes the rows of all elements. One thread at a time."""

    order: Sequence[int]
    """Indices of frames."""
    positions: ElementPositions
    quality: FrameQuality
    wanted: bool = False
    """Whether any page has asked for rows: until then none is computed."""
    _labels: Labels = field(default_factory=Labels)
    _stale: dict[str, None] = field(default_factory=dict)
    _rows: dict[str, TrackRow] = field(default_factory=dict)
    _tracks: OpenTracks | None = None
    _places: frozenset[int] = frozenset()

    def __post_init__(self) -> None:
        self._rank = {index: rank for rank, index in enumerate(self.order)}
        self._track_row = lru_cache(maxsize=None)(self._row_of_track)

    def known(self, labels: Labels, tracks: OpenTracks) -> tuple[list[TrackRow], int]:
        """Return the rows known so far, and the number of all.

        Rows that are not up to date come without residuals, as many as take ``SKETCH_S``.
        """
        self.wanted = True
        self._follow(labels)
        now = tracks.places(labels)
        rows = [row for id_, row in self._rows.items() if id_ not in self._stale]
        end = time.monotonic() + SKETCH_S
        for id_ in self._stale:
            if time.monotonic() > end:
                break
            rows.append(self._row(labels.elements[id_], labels, None))
        rows += [self._track_row(place, tracks.tracks.tracks[place]) for place in now]
        self._tracks, self._places = tracks, frozenset(now)
        return rows, len(labels.elements) + len(now)

    def update(self, labels: Labels, tracks: OpenTracks, seconds: float) -> list[TrackRow]:
        """Compute stale rows for that long. Return them, and rows of what is gone."""
        if not self.wanted:
            return []
        gone = self._follow(labels)
        rows = [_gone(id_) for id_ in gone] + self._changed_tracks(labels, tracks)
        end = time.monotonic() + seconds
        while self._stale and (time.monotonic() < end or not rows):
            id_ = next(iter(self._stale))
            del self._stale[id_]
            position = self.positions.of_element(labels, id_)
            self._rows[id_] = self._row(labels.elements[id_], labels, position)
            rows.append(self._rows[id_])
        return rows

    @property
    def waiting(self) -> int:
        """The number of rows that are not up to date."""
        return len(self._stale)

    def frames(self, labels: Labels, indices: Iterable[int]) -> list[TrackFrame]:
        """Return what is expected in those of the frames that have been assessed."""
        result = []
        for index in indices:
            facts = self.quality.of(index)
            if facts is None:
                continue
            numbers: dict[Side, list[int]] = {"left": [], "right": []}
            for element_id, side in facts.expected:
                if element_id in labels.elements:
                    numbers[side].append(labels.elements[element_id].number)
            result.append(TrackFrame(index=index, left=numbers["left"], right=numbers["right"]))
        return result

    def _follow(self, labels: Labels) -> list[str]:
        """Mark the rows of changed elements as stale; return the ids of those that are gone."""
        if labels is self._labels:
            return []
        changed = labels.differing(self._labels)
        changed |= {
            id_ for id_, row in labels.elements.items() if self._labels.elements.get(id_) is not row
        }
        changed |= _of_differing_dismissals(self._labels, labels)
        self._labels = labels
        gone = [id_ for id_ in changed if id_ not in labels.elements]
        for id_ in gone:
            self._rows.pop(id_, None)
            self._stale.pop(id_, None)
        kept = [labels.elements[id_] for id_ in changed if id_ in labels.elements]
        for element in sorted(kept, key=lambda element: element.number):
            self._stale[element.id] = None
        return gone

    def _changed_tracks(self, labels: Labels, tracks: OpenTracks) -> list[TrackRow]:
        """Return rows of tracks that were opened, and of those that were closed or are gone."""
        before, earlier = self._tracks, self._places
        if before is not tracks:
            self._track_row.cache_clear()
        now = frozenset(tracks.places(labels))
        self._tracks, self._places = tracks, now
        if before is None:
            return []
        is_same = before is tracks
        closed = [before.tracks.tracks[n].id for n in earlier if not is_same or n not in now]
        opened = sorted(now - earlier if is_same else now)
        rows = [_gone(id_) for id_ in closed if id_ not in labels.elements]
        return rows + [self._track_row(n, tracks.tracks.tracks[n]) for n in opened]

    def _row(self, element: LabelElement, labels: Labels, position: Position | None) -> TrackRow:
        rows = labels.of_element(element.id)
        cells = dict(self._dismissed(labels.dismissed_of(element.id)))
        worst: float | None = None
        for row in rows:
            if row.frame_index not in self._rank:
                continue
            px = residual_of(self.positions, row, position)
            worst = px if worst is None else max(worst, px or 0.0)
            code = UNPLACED if px is None else min(round(10.0 * px), _MOST)
            cells[self._rank[row.frame_index], row.side] = code
        first, left, right = _arrays(cells)
        return TrackRow(
            **element_ref(element, labels.classes).model_dump(),
            number=element.number,
            first=first,
            left=left,
            right=right,
            views=len(rows),
            worst_px=None if worst is None else round(worst, 2),
            score=None,
            doubt="",
            left_out=labels.is_left_out(element.id),
            notes=[note_view(note) for note in labels.notes_of(element.id)],
            attributes=attribute_values(labels, element.id),
        )

    def _dismissed(self, dismissals: Iterable[Dismissal]) -> Iterable[tuple[tuple[int, Side], int]]:
        for row in dismissals:
            if row.frame_index in self._rank:
                yield (self._rank[row.frame_index], row.side), _CODES[row.why]

    def _row_of_track(self, place: int, track: DetectionTrack) -> TrackRow:
        cells: dict[tuple[int, Side], int] = {
            (self._rank[row.frame_index], row.side): PROPOSED
            for row in track.detections
            if row.frame_index in self._rank
        }
        first, left, right = _arrays(cells)
        return TrackRow(
            id=track.id,
            name=track.name,
            class_id=track.class_id,
            number=-1 - place,
            first=first,
            left=left,
            right=right,
            views=len(track.detections),
            worst_px=round(track.residual_px, 2),
            score=track.probability,
            doubt=track.doubt,
            left_out=False,
            notes=[],
            attributes={},
        )


def _arrays(cells: Mapping[tuple[int, Side], int]) -> tuple[int, list[int], list[int]]:
    """Return the first place of cells, and the cells of both sides from there on."""
    places = [place for place, _ in cells]
    first = min(places, default=0)
    both: dict[Side, list[int]] = {
        side: [NOTHING] * (max(places, default=-1) + 1 - first) for side in ("left", "right")
    }
    for (place, side), code in cells.items():
        both[side][place - first] = code
    return first, both["left"], both["right"]


def _gone(element_id: str) -> TrackRow:
    """The row that tells the page that an element or track is no longer there."""
    return TrackRow(
        id=element_id,
        name="",
        class_id=0,
        number=0,
        first=0,
        left=[],
        right=[],
        views=0,
        worst_px=None,
        score=None,
        doubt="",
        left_out=False,
        notes=[],
        attributes={},
    )


def _of_differing_dismissals(before: Labels, after: Labels) -> set[str]:
    changed = SharedDict.of(after.dismissals).differing(SharedDict.of(before.dismissals))
    rows = (state.dismissals.get(id_) for state in (before, after) for id_ in changed)
    return {row.element_id for row in rows if row is not None and row.element_id is not None}
