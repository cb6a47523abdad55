"""What labels say about wrong poses: do the elements of a frame jump together, or one by one?

The elements are placed by the labels of all other frames. If their labels in the frames of a fault
fit refined poses much better than given ones, the poses are wrong and not the labels. Refining
uses no label, so all of them are kept back.
"""

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semviz_annotation.labels.labels import Labels, Observation
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.quality.label_links import map_rows
from semviz_core.base.frame import Dataset, Frame, Side
from semviz_core.base.semantic_map import SemanticMap, footprint_m
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import DatasetWithFrames
from semviz_core.metrics.detection import ImageErrors
from semviz_core.pose_checks.faults import RIG_KINDS, PoseCheck, PoseFault, refined_frames

AGREES = 0.5
"""An element agrees if its error falls below this share."""
MIN_ELEMENTS = 6
"""Fewer do not tell a wrong pose from wrong labels, nor refuse a refinement."""
WORSE_SHARE, WORSE_PX = 1.25, 0.3
"""A refinement is refused if the labels' error grows by this factor, and by so much."""


@dataclass(frozen=True)
class LabelEvidence:
    """Errors of the elements in the frames of a fault, placed by other frames."""

    elements: int
    agreeing: int
    """Elements that fit the refined poses much better than the given ones."""
    before_px: float
    """Median over elements, with the given poses."""
    after_px: float
    """Median over elements, with the refined poses."""

    def __str__(self) -> str:
        return (
            f"{self.agreeing} of {self.elements} labelled elements agree: median "
            f"{self.before_px:.1f} px, {self.after_px:.1f} px after refining"
        )

    @property
    def grows_worse(self) -> bool:
        """Whether the labels refute the refined poses."""
        before, after = self.before_px, self.after_px
        worse = after > WORSE_SHARE * before and after > before + WORSE_PX
        return self.elements >= MIN_ELEMENTS and worse


@dataclass(frozen=True, eq=False)
class PlacedElements:
    """Elements of a map as the poses of a drive show them."""

    semantic_map: SemanticMap
    drive: DatasetWithFrames

    @cached_property
    def _poses(self) -> dict[int, Frame]:
        return {frame.index: frame for frame in self.drive.frames}

    def view(self, index: int, side: Side) -> PosedView | None:
        """Return the view of an image; None if its frame has no pose."""
        frame = self._poses.get(index)
        if frame is None or frame.T_map_camera is None:
            return None
        return rig_view(self.drive.rig, side, frame.T_map_camera.inverse())

    def ends_px(self, row: Observation) -> FloatArray | None:
        """Return anchor and end (2, 2) of the label's element in its image; None if not mapped."""
        place = map_rows(self.semantic_map).row(row)
        view = self.view(row.frame_index, row.side)
        if place < 0 or view is None:
            return None
        elements = self.semantic_map.elements
        ends = view.project(np.stack([elements.anchor_m[place], elements.end_m[place]]))
        return ends if np.isfinite(ends[0]).all() else None

    def error_px(self, row: Observation) -> float | None:
        """Return the error of a label: of a pole across its axis; None if it has none."""
        ends = self.ends_px(row)
        if ends is None:
            return None
        error = ImageErrors.between(ends, label_ends(row))
        size = np.concatenate([error.lateral_px, error.longitudinal_px])
        return float(np.sqrt(np.mean(size**2))) if np.isfinite(size).all() else None


def label_ends(row: Observation) -> FloatArray:
    """Return the label's anchor and end (2, 2); a sign's end is NaN."""
    return np.array([row.anchor_px, row.end_px or (np.nan, np.nan)])


@dataclass(frozen=True, eq=False)
class FaultLabels:
    """The labels in the frames of a fault, against elements that other frames place."""

    rows: tuple[Observation, ...]
    given: PlacedElements
    refined: PlacedElements

    @classmethod
    def of(
        cls, labels: Labels, source: Dataset, check: PoseCheck, first: int, last: int
    ) -> "FaultLabels | None":
        """Return the labels of the frames ``first`` to ``last``.

        If no frame is outside, each set of poses places the elements for itself. None without
        labels, or if they place no element.
        """
        known = {frame.index for frame in check.frames}
        inside = {index for index in known if first <= index <= last} & set(labels.frames)
        rows = tuple(row for index in sorted(inside) for row in labels.in_frame(index))
        elements = {row.element_id for row in rows}
        seen = {row.frame_index for id_ in elements for row in labels.of_element(id_)} & known
        given = DatasetWithFrames(source, check.frames)
        refined = DatasetWithFrames(source, refined_frames(check))
        outside = seen - inside
        try:
            if known - inside and not outside:
                return None
            if outside:
                placed = _placed(labels, refined, outside)
                return cls(rows, PlacedElements(placed, given), PlacedElements(placed, refined))
            return cls(
                rows,
                PlacedElements(_placed(labels, given, seen), given),
                PlacedElements(_placed(labels, refined, seen), refined),
            )
        except SemvizError:  # too few labels
            return None

    @cached_property
    def evidence(self) -> LabelEvidence | None:
        """What the labels say; None if no element can be compared."""
        given, refined = self._errors
        ids = sorted(given.keys() & refined.keys())
        if not ids:
            return None
        before, after = (np.array([errors[id_] for id_ in ids]) for errors in (given, refined))
        agreeing = int((after < AGREES * before).sum())
        middle = float(np.median(before)), float(np.median(after))
        return LabelEvidence(len(ids), agreeing, *middle)

    def errors_of(self, element_id: str) -> tuple[float | None, float | None]:
        """Return the median error (px) of an element with the given and the refined poses."""
        given, refined = self._errors
        return given.get(element_id), refined.get(element_id)

    @cached_property
    def _errors(self) -> tuple[dict[str, float], dict[str, float]]:
        """The median error of each element, with the given and the refined poses."""
        return self._errors_in(self.given), self._errors_in(self.refined)

    def _errors_in(self, placed: PlacedElements) -> dict[str, float]:
        errors: dict[str, list[float]] = defaultdict(list)
        for row in self.rows:
            size = placed.error_px(row)
            if size is not None:
                errors[row.element_id].append(size)
        return {id_: float(np.median(sizes)) for id_, sizes in errors.items()}


def _placed(labels: Labels, drive: DatasetWithFrames, frames: Collection[int]) -> SemanticMap:
    semantic_map, _ = build_map(labels, drive, frames=sorted(frames))
    return semantic_map


def label_evidence(
    labels: Labels, source: Dataset, check: PoseCheck, fault: PoseFault
) -> LabelEvidence | None:
    """Return what labels say about a fault; None if they say nothing, or it is of the
    calibration."""
    if fault.kind in RIG_KINDS:
        return None
    found = FaultLabels.of(labels, source, check, fault.first, fault.last)
    return None if found is None else found.evidence


@dataclass(frozen=True)
class ElementMove:
    """How far an element moves in the map if the poses of some frames are refined."""

    element_id: str
    moved_m: float


def element_moves(
    labels: Labels, source: Dataset, check: PoseCheck, first: int, last: int
) -> tuple[ElementMove, ...]:
    """Return the elements labelled in a stretch, furthest move first; none if not placed."""
    known = {frame.index for frame in check.frames}
    inside = range(first, last + 1)
    rows = [row for index in labels.frames if index in inside for row in labels.in_frame(index)]
    ids = sorted({row.element_id for row in rows})
    frames = {row.frame_index for id_ in ids for row in labels.of_element(id_)} & known
    mixed = tuple(
        refined if given.index in inside else given
        for given, refined in zip(check.frames, refined_frames(check), strict=True)
    )
    try:
        before, after = (
            _placed(labels, DatasetWithFrames(source, poses), frames)
            for poses in (check.frames, mixed)
        )
    except SemvizError:  # too few labels
        return ()
    places = [footprint_m(one.elements) for one in (before, after)]
    rows_of = [map_rows(one).of_label for one in (before, after)]
    moves = [
        ElementMove(
            id_, float(np.linalg.norm(places[0][rows_of[0][id_]] - places[1][rows_of[1][id_]]))
        )
        for id_ in ids
        if id_ in rows_of[0] and id_ in rows_of[1]
    ]
    return tuple(sorted(moves, key=lambda move: -move.moved_m))


@dataclass(frozen=True)
class FrameAgreement:
    """The labels of one frame against the elements of all others: common shift, and the rest."""

    frame: int
    elements: int
    shift_px: tuple[float, float]
    """Median error, label minus element: what all elements do together."""
    alone_px: float
    """Median error of an element beyond that."""

    @property
    def together_px(self) -> float:
        return float(np.hypot(*self.shift_px))


def frame_agreements(
    labels: Labels, drive: DatasetWithFrames, refined: Sequence[Frame]
) -> Iterator[FrameAgreement]:
    """Yield for each labelled frame how its labels fit the poses of ``drive``.

    The elements are placed with refined poses.
    """
    good = DatasetWithFrames(drive.source, tuple(refined))
    posed = {frame.index for frame in good.frames if frame.T_map_camera is not None}
    try:
        placed = PlacedElements(_placed(labels, good, posed & set(labels.frames)), drive)
    except SemvizError:  # too few labels
        return
    for index in labels.frames:
        rows = [row for row in labels.in_frame(index) if row.side == "left"]
        errors = [error for row in rows if (error := _vector_px(placed, row)) is not None]
        if errors:
            vectors = np.array(errors)
            common = np.nan_to_num(np.nanmedian(vectors, axis=0))
            rest = np.hypot(*np.nan_to_num(vectors - common).T)
            shift = float(common[0]), float(common[1])
            yield FrameAgreement(index, len(errors), shift, float(np.median(rest)))


def _vector_px(placed: PlacedElements, row: Observation) -> FloatArray | None:
    """Return the error (2,) of a label; along a pole whose ends are not known it is NaN."""
    ends = placed.ends_px(row)
    if ends is None:
        return None
    error = label_ends(row) - ends
    if row.end_px is None:
        return np.asarray(error[0])
    across = float(ImageErrors.between(ends, label_ends(row)).lateral_px.mean())
    known = [place for place, is_known in enumerate((row.anchor_known, row.end_known)) if is_known]
    down = float(error[known, 1].mean()) if known else np.nan
    return np.array([-across, down])
