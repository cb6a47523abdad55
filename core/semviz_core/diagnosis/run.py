"""Diagnose a run: find faults of map and camera that recur over frames.

Frames without ground truth count if their status is ok. An unmapped landmark is found where rays
of unmatched detections of one class, from several frames, intersect in the ground plane.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.frame import Odometry
from semviz_core.base.localization import Localization
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.diagnosis import run_causes
from semviz_core.diagnosis.carried_poses import with_carried_poses
from semviz_core.diagnosis.cause_fits import common_cause
from semviz_core.diagnosis.checks import find_faults
from semviz_core.diagnosis.common_causes import CALIBRATIONS
from semviz_core.diagnosis.fault import EvidenceItem, Fault, FaultKind, GroundTruth, RunFault
from semviz_core.diagnosis.frame_causes import with_sigma_scaled
from semviz_core.diagnosis.odometry import odometry_fault
from semviz_core.diagnosis.prior_offsets import (
    PriorOffset,
    prior_offsets,
    solved_without_fixes,
    without_offset,
)
from semviz_core.diagnosis.reference import FrameReference, ProgressCallback, no_progress

NEEDED_FRAMES = 3
"""Rays of this many frames must meet, since two always do."""
MEET_RAD = float(np.deg2rad(0.7))
"""Largest angle, seen from the camera, between a ray and a point it passes through."""
LEAST_PARALLAX_RAD = float(np.deg2rad(3.0))
NEAREST_M, FURTHEST_M = 2.0, 60.0
"""Range of the distance from a camera to a landmark."""


@dataclass(frozen=True, eq=False)
class UnmatchedRays:
    """k unmatched detections as rays in the ground plane."""

    frame: IntArray
    """(k,) position in the run."""
    row: IntArray
    """(k,) observed row in that frame."""
    class_id: IntArray
    center_m: FloatArray
    """(k, 2) of the camera."""
    toward: FloatArray
    """(k, 2) unit."""


@dataclass(frozen=True, eq=False)
class RayIntersection:
    """A point where rays meet."""

    at_m: FloatArray
    """(2,)"""
    rays: IntArray
    """Rows of ``UnmatchedRays`` that pass through it, from three or more frames."""


def intersect_rays(rays: UnmatchedRays) -> list[RayIntersection]:
    """Return the points where rays of one class and of several frames meet, best first.

    Each ray belongs to at most one point.
    """
    free = np.ones(len(rays.row), dtype=bool)
    intersections = []
    while (best := _best(rays, free)) is not None:
        free[best.rays] = False
        intersections.append(best)
    return intersections


def _best(rays: UnmatchedRays, free: BoolArray) -> RayIntersection | None:
    points = [_best_on_ray(rays, int(index), free) for index in np.flatnonzero(free)]
    met = [point for point in points if point is not None]
    return max(met, key=lambda point: len(point.rays), default=None)


def _best_on_ray(rays: UnmatchedRays, index: int, free: BoolArray) -> RayIntersection | None:
    """Return the point on one ray that the rays of most frames pass."""
    away_m = np.linalg.norm(rays.center_m - rays.center_m[index], axis=1)
    same_class = free & (rays.class_id == rays.class_id[index]) & (away_m < FURTHEST_M)
    rows = np.flatnonzero(same_class)
    at_m = _crossings(rays, index, rows[rays.frame[rows] != rays.frame[index]])
    if not len(at_m):
        return None
    passes = _passes(rays, rows, at_m)
    frames = [len(np.unique(rays.frame[rows[chosen]])) for chosen in passes]
    best = int(np.argmax(frames))
    if frames[best] < NEEDED_FRAMES:
        return None
    return RayIntersection(at_m[best], rows[passes[best]])


def _crossings(rays: UnmatchedRays, index: int, rows: IntArray) -> FloatArray:
    """Return (c, 2) where ray ``index`` crosses other rays, ahead of both cameras."""
    a, b = rays.toward[index], rays.toward[rows]
    cross = a[0] * b[:, 1] - a[1] * b[:, 0]
    wide = np.abs(cross) > np.sin(LEAST_PARALLAX_RAD)
    offset = rays.center_m[rows[wide]] - rays.center_m[index]
    b, cross = b[wide], cross[wide]
    along_a = (offset[:, 0] * b[:, 1] - offset[:, 1] * b[:, 0]) / cross
    along_b = (offset[:, 0] * a[1] - offset[:, 1] * a[0]) / cross
    ahead = (np.minimum(along_a, along_b) > NEAREST_M) & (along_a < FURTHEST_M)
    return np.asarray(rays.center_m[index] + along_a[ahead, None] * a)


def _passes(rays: UnmatchedRays, rows: IntArray, at_m: FloatArray) -> BoolArray:
    """Return (c, len(rows)) whether rays pass through points (c, 2)."""
    offset = at_m[:, None] - rays.center_m[rows]
    toward = rays.toward[rows]
    aside = offset[..., 0] * toward[:, 1] - offset[..., 1] * toward[:, 0]
    ahead = (offset * toward).sum(axis=-1)
    near = np.abs(aside) < np.tan(MEET_RAD) * ahead
    return np.asarray(near & (ahead > NEAREST_M) & (ahead < FURTHEST_M))


MAP_KINDS: tuple[FaultKind, ...] = ("moved in the map", "missing in the map", "twice in the map")
UNMATCHED_KINDS: tuple[FaultKind, ...] = ("moved in the map", "false or not mapped")
"""Faults of unmatched detections in single frames without known ids."""
MOVED_M = 10.0
"""A landmark further than this from an undetected element is another one."""
OF_CALIBRATION: tuple[FaultKind, ...] = ("wrong detection sigma", "wrong gravity prior")
"""What a wrong calibration looks like in single frames."""
MOSTLY_OK = 0.5
"""Share of frames that are ok beyond which priors are not off by more than they state."""
STRAY_SHARE = 0.2
"""Share of the frames with an element in view below which other things are detected there."""
LEAST_SHARE = 0.5
"""Share of the frames that detect an element in which a fault must recur."""


@dataclass(frozen=True)
class RunDiagnosis:
    """Faults of all elements together, of the camera, and of single elements."""

    calibration: RunFault | None
    elements: tuple[RunFault, ...]
    """By falling number of frames. Empty if the calibration is wrong: then no element fits."""
    frames: int
    """Number of frames with a pose to compare with."""
    causes: tuple[RunFault, ...] = ()
    """Wrong priors, sigmas and odometry, and what shifts all elements together."""

    def at(self, positions: Sequence[int]) -> "RunDiagnosis":
        """Return the diagnosis of the frames at ``positions`` of a run, with its positions."""
        calibration = self.calibration
        return replace(
            self,
            calibration=None if calibration is None else _at(calibration, positions),
            elements=tuple(_at(fault, positions) for fault in self.elements),
            causes=tuple(_at(fault, positions) for fault in self.causes),
        )


def diagnose_run(
    frames: Sequence[tuple[Localization, GroundTruth | None]],
    semantic_map: SemanticMap,
    detector: DetectorModel | None = None,
    watch: ProgressCallback = no_progress,
    odometry: Sequence[Odometry | None] | None = None,
) -> RunDiagnosis:
    """Return the recurring faults of a run.

    Frames without ground truth count if their status is ok. ``odometry`` is the measured motion of
    each frame from the one before.
    """
    cases = [
        FrameReference.of(localization, semantic_map, truth, detector)
        for localization, truth in frames
    ]
    positions = _with_pose(cases)
    compared = [cases[position] for position in positions]
    calibration: RunFault | None = None
    found = common_cause(compared, watch)
    causes: list[RunFault] = []
    if found is not None:
        fault = _at(run_causes.cause_fault(*found, watch), positions)
        if found[0].fit.cause in CALIBRATIONS:
            calibration = fault
        else:
            causes.append(fault)
            compared = [found[0].fit.corrected(row) for row in range(len(compared))]
            cases = _replaced(cases, positions, compared)
    if offsets := _prior_offsets(cases, watch):
        cases = without_offset(cases, offsets[0])
        compared = [cases[position] for position in positions]
        causes.append(run_causes.prior_offset_fault(offsets, cases, watch))
    causes += run_causes.assumption_run_faults(cases, watch)
    moved = None if odometry is None else odometry_fault(cases, odometry)
    causes += [] if moved is None else [moved]
    if calibration is not None:  # it explains large residuals, and a camera that is rolled
        causes = [cause for cause in causes if cause.kind not in OF_CALIBRATION]
    blind = all(case.truth is None for case in cases)
    if odometry is not None and blind and not causes and calibration is None:
        cases = with_carried_poses(cases, odometry, watch)
        positions = _with_pose(cases)
        compared = [cases[position] for position in positions]
    for cause in causes:
        if cause.kind == "wrong detection sigma":
            compared = [with_sigma_scaled(case, cause.evidence[1].value) for case in compared]
    recurring = () if calibration else _element_faults(compared, watch)
    elements = tuple(_at(fault, positions) for fault in recurring)
    return RunDiagnosis(calibration, elements, len(compared), tuple(causes))


def _with_pose(cases: Sequence[FrameReference]) -> list[int]:
    """Return the positions of frames with a pose to compare with the map."""
    return [
        position
        for position, case in enumerate(cases)
        if case.truth is not None or case.localization.status == "ok"
    ]


def _prior_offsets(
    cases: Sequence[FrameReference], watch: ProgressCallback
) -> tuple[PriorOffset, ...]:
    """Return what all priors of a run without ground truth have in common."""
    if any(case.truth is not None for case in cases):
        return ()
    ok = sum(case.localization.status == "ok" for case in cases)
    if (found := prior_offsets(cases)) or ok > MOSTLY_OK * len(cases):
        return found
    return prior_offsets(solved_without_fixes(cases, watch))


def _at(fault: RunFault, positions: Sequence[int]) -> RunFault:
    """Return a fault whose frames are rows of ``positions``, with positions in the run."""
    return replace(fault, frames=tuple(positions[row] for row in fault.frames))


def _replaced(
    cases: Sequence[FrameReference], positions: Sequence[int], others: Sequence[FrameReference]
) -> list[FrameReference]:
    by_position = dict(zip(positions, others, strict=True))
    return [by_position.get(position, case) for position, case in enumerate(cases)]


def _element_faults(
    cases: Sequence[FrameReference], watch: ProgressCallback
) -> tuple[RunFault, ...]:
    """Return recurring faults; their ``frames`` are rows of ``cases``."""
    faults = [find_faults(case) for case in watch(cases, "collecting faults", len(cases))]
    recurring = [*_recurring_faults(cases, faults), *_unmatched_landmarks(cases, faults)]
    return tuple(sorted(recurring, key=lambda fault: (-fault.evidence[0].value, fault.elements)))


def _recurring_faults(
    cases: Sequence[FrameReference], faults: Sequence[tuple[Fault, ...]]
) -> list[RunFault]:
    """Return faults of an element that recur in most of the frames that detect it."""
    reports: dict[tuple[FaultKind, tuple[int, ...]], list[tuple[int, Fault]]] = defaultdict(list)
    for row, (case, frame_faults) in enumerate(zip(cases, faults, strict=True)):
        kinds = MAP_KINDS if case.ids is not None else MAP_KINDS[2:]
        for fault in frame_faults:
            if fault.kind not in kinds:
                continue
            reported = reports[fault.kind, tuple(sorted(fault.elements))]
            if not reported or reported[-1][0] != row:  # several detections may report it
                reported.append((row, fault))
    detected = _detection_counts(cases)
    return [
        _recurring_fault(kind, elements, reported)
        for (kind, elements), reported in reports.items()
        if len(reported)
        >= max(NEEDED_FRAMES, LEAST_SHARE * max(detected.get(element, 0) for element in elements))
        and not (len(elements) > 1 and _detected_together(cases, elements))
    ]


def _recurring_fault(
    kind: FaultKind, elements: tuple[int, ...], reports: Sequence[tuple[int, Fault]]
) -> RunFault:
    """Return the fault of ``elements`` in several frames, with the median frame's evidence."""
    ordered = sorted((fault for _, fault in reports), key=lambda fault: fault.evidence[-1:])
    middle = ordered[len(ordered) // 2]
    sentence = f"In {len(reports)} frames: {middle.sentence}"
    if kind == "missing in the map":  # it has no name, and its row differs between frames
        sentence = f"{len(reports)} frames show element {elements[0]}, which is not in the map."
    return RunFault(
        kind,
        sentence,
        (EvidenceItem("frames", len(reports)), *middle.evidence),
        elements,
        rows=tuple(fault.rows[0] for _, fault in reports),
        frames=tuple(row for row, _ in reports),
    )


def _detected_together(cases: Sequence[FrameReference], elements: tuple[int, ...]) -> bool:
    """Whether one frame detects all of them: then they are different landmarks."""
    return any(set(elements) <= set(case.nearby.id[case.pairs[:, 1]].tolist()) for case in cases)


def _detection_counts(cases: Sequence[FrameReference]) -> dict[int, int]:
    """Return the number of frames with a detection of each element id."""
    seen: dict[int, int] = defaultdict(int)
    for case in cases:
        for id in set(case.nearby.id[case.pairs[:, 1]].tolist()):
            seen[id] += 1
    return dict(seen)


def _unmatched_landmarks(
    cases: Sequence[FrameReference], faults: Sequence[tuple[Fault, ...]]
) -> list[RunFault]:
    """Return landmarks that several frames detect where no element is mapped."""
    rays, detected = _unmatched_rays(cases, faults), _detection_counts(cases)
    return [_unmatched_landmark(cases, detected, rays, point) for point in intersect_rays(rays)]


def _unmatched_rays(
    cases: Sequence[FrameReference], faults: Sequence[tuple[Fault, ...]]
) -> UnmatchedRays:
    rows = [
        (frame, fault.rows[0])
        for frame, (case, frame_faults) in enumerate(zip(cases, faults, strict=True))
        for fault in frame_faults
        if case.ids is None and fault.kind in UNMATCHED_KINDS
    ]
    frame, row = np.array(rows, dtype=np.int64).reshape(-1, 2).T
    rays, centers = np.empty((len(rows), 2)), np.empty((len(rows), 2))
    class_id = np.empty(len(rows), dtype=np.int64)
    for k, (position, i) in enumerate(rows):
        case = cases[position]
        assert case.reference is not None
        back = case.reference.inverse()
        ray = (back.rotation @ case.problem.seen[i]["anchor_ray"])[:2]
        rays[k], centers[k] = ray / np.linalg.norm(ray), back.translation[:2]
        class_id[k] = case.localization.observed.class_id[i]
    return UnmatchedRays(frame, row, class_id, centers, rays)


def _unmatched_landmark(
    cases: Sequence[FrameReference],
    detected: dict[int, int],
    rays: UnmatchedRays,
    point: RayIntersection,
) -> RunFault:
    """Return the fault of a landmark where rays meet.

    A near element that is seldom detected is the same landmark, moved; else it is missing.
    """
    frames, first = np.unique(rays.frame[point.rays], return_index=True)
    rows = rays.row[point.rays[first]]
    of_frames = {"rows": tuple(rows.tolist()), "frames": tuple(frames.tolist())}
    class_id = int(rays.class_id[point.rays[0]])
    nearby_m: dict[int, float] = {}
    for case in (cases[frame] for frame in frames):
        away_m = np.linalg.norm(case.nearby.anchor_m[:, :2] - point.at_m, axis=1)
        for j in np.flatnonzero((away_m < MOVED_M) & (case.nearby.class_id == class_id)):
            nearby_m[int(case.nearby.id[j])] = float(away_m[j])
    expected = {
        id: away for id, away in nearby_m.items() if _is_absent(cases, id, detected.get(id, 0))
    }
    evidence = EvidenceItem("frames", len(frames))
    where = f"at {point.at_m[0]:.1f}, {point.at_m[1]:.1f}"
    if not expected:
        return RunFault(
            "missing in the map",
            f"{len(frames)} frames show an element {where} that is not in the map.",
            (
                evidence, EvidenceItem("x", point.at_m[0], "m"),
                EvidenceItem("y", point.at_m[1], "m"),
            ),
            **of_frames,
        )  # fmt: skip
    id = min(expected, key=lambda id: expected[id])
    name = cases[0].semantic_map.classes.element_name(class_id, id)
    often = "seldom" if id in detected else "never"
    return RunFault(
        "moved in the map",
        f"{name} is {often} detected at its mapped position; {len(frames)} frames show it {where}.",
        (evidence, EvidenceItem("moved", expected[id], "m")), (id,), **of_frames,
    )  # fmt: skip


def _is_absent(cases: Sequence[FrameReference], id: int, detected: int) -> bool:
    """Whether an element is in view of several frames, and detected by hardly any."""
    times = sum(bool((case.in_view & (case.nearby.id == id)).any()) for case in cases)
    return times >= NEEDED_FRAMES and detected < max(1.0, STRAY_SHARE * times)
