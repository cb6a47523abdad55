"""Edits of whole tracks: accept or reject those of detections, align labels to a view."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Annotated, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import ConfigDict, Field

from semviz.annotator.drawing.draft import SMALLER, PagePixel
from semviz.annotator.element_positions import ElementPositions
from semviz.annotator.panes import Cameras, Pane, Panes
from semviz.annotator.proposals.image_worker import ImageWorker
from semviz.annotator.proposals.label_proposals import ImageQuery, PropagationQuery, SearchImage
from semviz.annotator.tracks import detection_tracks
from semviz.web.protocol import Part
from semviz_annotation.assist.marked_image import Mark, pixel
from semviz_annotation.labels.edits import AddElements, NewElement
from semviz_annotation.labels.labels import Id, Index, Labels, Observation, Pixel
from semviz_annotation.labels.rows import RowChange, Rules
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.frame import Side
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError


class CorrectedMark(Part):
    """The ends by which a person replaced those of a detection."""

    model_config: ClassVar[ConfigDict] = ConfigDict(strict=True)

    observation_id: Id
    anchor_px: PagePixel
    end_px: PagePixel | None = None


class AcceptTracksEdit(Part):
    """Accept tracks of detections in all their images, with corrections of single marks."""

    kind: Literal["accept tracks"]
    track_ids: list[Id] = Field(min_length=1)
    corrections: list[CorrectedMark] = Field(default_factory=list)


class RejectTracksEdit(Part):
    """Reject tracks of detections in all their images: no map will have them."""

    kind: Literal["reject tracks"]
    track_ids: list[Id] = Field(min_length=1)


class AcceptSureTracksEdit(Part):
    """Accept all sure tracks; ``count`` is their number as the page showed it."""

    kind: Literal["accept sure tracks"]
    count: Annotated[int, Field(ge=0)]


class AlignLabelsEdit(Part):
    """Move the labels of an element to where its labels in the frame on screen put them."""

    kind: Literal["align labels"]
    element_id: Id
    frame_index: Index


Corrections: TypeAlias = Mapping[str, tuple[Pixel, Pixel | None]]
"""Ends by which a person replaced those of detections, by the detection's id."""


@dataclass(frozen=True, eq=False)
class TrackEdit:
    """Accept or reject tracks, all or none: new label elements with the free detections.

    Rejected ones are left out of maps. The tracks are chosen in the labels that the edit changes.
    """

    kind: Literal["accept tracks", "reject tracks"]
    choose: Callable[[Labels], Sequence[detection_tracks.DetectionTrack]]
    corrections: Corrections = field(default_factory=dict)

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        tracks = self.choose(labels)
        elements = tuple(
            NewElement(track.id, track.class_id, tuple(self._observations(track, labels)))
            for track in tracks
        )
        for track, element in zip(tracks, elements, strict=True):
            if not element.observations and track.id not in labels.elements:
                raise SemvizError(f"{track.name} is labelled in all images of the track already")
        return AddElements(elements, left_out=self.kind == "reject tracks").changes(labels, rules)

    def _observations(
        self, track: detection_tracks.DetectionTrack, labels: Labels
    ) -> Iterator[Observation]:
        for detection in detection_tracks.free_detections(track.detections, labels):
            row = detection_tracks.mark_of(detection).at(detection.frame_index, detection.side)
            row = replace(row, id=detection.id)
            if detection.id in self.corrections:
                anchor_px, end_px = self.corrections[detection.id]
                row = replace(row, anchor_px=anchor_px, end_px=end_px)
            yield row


def _named_tracks(
    tracks: detection_tracks.OpenTracks, track_ids: Iterable[str], labels: Labels
) -> Sequence[detection_tracks.DetectionTrack]:
    """Return tracks by their ids. Raise SemvizError if the map has none of an id."""
    by_id = tracks.tracks.by_id
    try:
        return [by_id[track_id] for track_id in dict.fromkeys(track_ids)]
    except KeyError:
        raise SemvizError("the last map has no such track any more; nothing was changed") from None


def _sure_tracks(
    tracks: detection_tracks.OpenTracks, count: int, labels: Labels
) -> Sequence[detection_tracks.DetectionTrack]:
    """Return all sure tracks. Raise SemvizError if their number is not ``count``, or is 0."""
    sure = tracks.sure(labels)
    if len(sure) != count or not count:
        raise SemvizError(
            f"{len(sure)} tracks are sure now, not {count}; nothing was changed"
            if sure
            else "no open track is sure; accept them one by one"
        )
    return sure


LEAST_MOVE_PX = 0.5
"""Labels that would move by less stay."""


@dataclass(frozen=True, eq=False)
class AlignEdit:
    """Move labels of an element to where another view shows it."""

    aligned: tuple[Observation, ...]
    by_px: float
    """How far an end moves at most."""
    kind: Literal["align labels"] = "align labels"

    @property
    def note(self) -> str:
        """What it did, for people."""
        labels = "1 label" if len(self.aligned) == 1 else f"{len(self.aligned)} labels"
        return f"Aligned {labels} to this view, by up to {self.by_px:.1f} px. Ctrl Z undoes it."

    def changes(self, labels: Labels, rules: Rules) -> Iterator[RowChange]:
        for row in self.aligned:
            before = labels.observation(row.id)
            yield RowChange(before, rules.check(row, labels.element(row.element_id).class_id))


@dataclass(frozen=True, eq=False)
class LabelAligner:
    """Finds where the labels of an element belong by those in the frame on screen.

    An offset of a drawing goes on in the labels that follow it. In a nearer view the same offset in
    metres is larger in pixels, so that one shows it; followed backwards, its own shrinks.
    """

    cameras: Cameras
    positions: ElementPositions
    worker: ImageWorker
    labels: Labels
    panes: Mapping[Side, Pane]
    """Those on screen."""
    element_id: str

    def edit(self) -> AlignEdit:
        """Return the edit of the labels in which the element is smaller than on screen.

        Where an image does not show it surely, the label stays. Raise SemvizError if nothing moves.
        """
        aligned = [row for rows, query in self.searches for row in self._aligned(rows, query)]
        if not aligned:
            raise SemvizError("no label moves: each agrees with this view, or is unclear there")
        by_px = max(_apart_px(self.labels.observation(row.id), row) for row in aligned)
        return AlignEdit(tuple(aligned), by_px)

    @cached_property
    def searches(self) -> tuple[tuple[tuple[Observation, ...], PropagationQuery], ...]:
        """The labels of each moment, with the query that finds where they belong.

        Raise SemvizError if the element is unknown, not labelled on screen, or has no position.
        """
        class_id = self.labels.element(self.element_id).class_id
        here = self._here()
        element = self._position(here)
        moments = defaultdict(list)
        for row in self._smaller(here, element):
            moments[row.frame_index].append(row)
        return tuple(
            (tuple(rows), PropagationQuery(class_id, element, self._images(rows, here)))
            for rows in moments.values()
        )

    def _here(self) -> list[Observation]:
        shown = {(pane.frame_index, pane.side) for pane in self.panes.values()}
        rows = self.positions.posed(self.labels.of_element(self.element_id))
        return [row for row in rows if (row.frame_index, row.side) in shown]

    def _position(self, here: Sequence[Observation]) -> Triangulated:
        if not here:
            raise SemvizError("label it in this frame first: its other labels follow this view")
        pair = self.positions.of_observations(here) if len(here) > 1 else None
        if isinstance(pair, Triangulated):
            return pair
        element = self.positions.of_element(self.labels, self.element_id)
        if isinstance(element, Triangulated):
            return element
        raise SemvizError(f"it has no position: {element.reason}")

    def _sizes(self, element: Triangulated, rows: Sequence[Observation]) -> FloatArray:
        return self.cameras.sizes_px(element, [_pane(row) for row in rows])

    def _smaller(self, here: Sequence[Observation], element: Triangulated) -> list[Observation]:
        rows = self.positions.posed(self.labels.of_element(self.element_id))
        now = self._sizes(element, here).max()
        smaller = SMALLER * self._sizes(element, rows) < now
        return [row for row, is_smaller in zip(rows, smaller, strict=True) if is_smaller]

    @staticmethod
    def _images(
        rows: Sequence[Observation], here: Sequence[Observation]
    ) -> tuple[SearchImage, ...]:
        """Return the images of some labels, each with the one on screen that it follows."""
        by_side = {row.side: row for row in here}
        sources = [by_side.get(row.side, here[0]) for row in rows]
        return tuple(
            SearchImage(_pane(row), _pane(source), Mark.of(source))
            for row, source in zip(rows, sources, strict=True)
        )

    def _aligned(
        self, rows: Sequence[Observation], query: PropagationQuery
    ) -> Iterator[Observation]:
        """Return the labels of one moment that move."""
        for row, image in zip(rows, query.images, strict=True):
            found = self.worker.best(query, image.there)
            if found is None or not found.sure:
                continue
            moved = _moved(row, found.mark, image.mark)
            if _apart_px(row, moved) >= LEAST_MOVE_PX:
                yield moved


class Aligners:
    """The search for labels to align, kept while the labels stay the same. One thread at a time."""

    def __init__(self, cameras: Cameras, positions: ElementPositions, worker: ImageWorker) -> None:
        self._make = partial(LabelAligner, cameras, positions, worker)
        self._last: LabelAligner | None = None

    def of(self, edit: AlignLabelsEdit, labels: Labels, panes: Panes) -> LabelAligner:
        """Return the search of an edit; the same one as before if nothing has changed."""
        shown, last = panes.of(edit.frame_index), self._last
        if (
            last is None
            or last.labels is not labels
            or (last.panes, last.element_id) != (shown, edit.element_id)
        ):
            last = self._last = self._make(labels, shown, edit.element_id)
        return last

    def queries(self, edit: object, labels: Labels, panes: Panes) -> list[ImageQuery]:
        """Return the queries of an edit that aligns labels; none of another."""
        if not isinstance(edit, AlignLabelsEdit):
            return []
        try:
            return [query for _, query in self.of(edit, labels, panes).searches]
        except SemvizError:  # the edit says why
            return []


def _pane(row: Observation) -> Pane:
    return Pane(row.frame_index, row.side)


def _apart_px(row: Observation, moved: Observation) -> float:
    ends = Mark.of(moved).ends_px - Mark.of(row).ends_px
    return float(np.linalg.norm(ends, axis=1).max())


def _moved(row: Observation, found: Mark, shown: Mark) -> Observation:
    """Return a label at a found mark; an end that ``shown`` does not know stays along the pole."""
    if row.end_px is None or found.end_px is None:
        return replace(row, anchor_px=found.anchor_px)
    line = found.ends_px
    along = (line[1] - line[0]) / np.linalg.norm(line[1] - line[0])
    kept = line[0] + ((Mark.of(row).ends_px - line[0]) @ along)[:, None] * along
    ends = np.where(np.array([[shown.anchor_known], [shown.end_known]]), line, kept)
    return replace(
        row,
        anchor_px=pixel(ends[0]),
        end_px=pixel(ends[1]),
        anchor_known=found.anchor_known if shown.anchor_known else row.anchor_known,
        end_known=found.end_known if shown.end_known else row.end_known,
    )


PageTrackEdit: TypeAlias = AcceptTracksEdit | RejectTracksEdit | AcceptSureTracksEdit


def track_edit(edit: PageTrackEdit, tracks: detection_tracks.OpenTracks) -> TrackEdit:
    """Return the edit of the labels that a page asks for."""
    match edit:
        case AcceptSureTracksEdit():
            return TrackEdit("accept tracks", partial(_sure_tracks, tracks, edit.count))
        case RejectTracksEdit():
            return TrackEdit("reject tracks", partial(_named_tracks, tracks, edit.track_ids))
        case AcceptTracksEdit():
            corrections = {
                mark.observation_id: (mark.anchor_px, mark.end_px) for mark in edit.corrections
            }
            choose = partial(_named_tracks, tracks, edit.track_ids)
            return TrackEdit("accept tracks", choose, corrections)
