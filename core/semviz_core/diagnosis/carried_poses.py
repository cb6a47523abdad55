"""Give frames without a pose of their own the one that odometry carries to them.

In a run without true poses only frames that are ok can be compared with the map. A frame with few
detections is not, but odometry from a frame nearby tells its pose, and its detections are as good
as others. One wrong pose would repeat its error in all frames around it: a frame that is ok counts
if odometry joins it to another one where both say they are. Stretches without such frames are
tracked with their priors, as a sequence.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from semviz_core.base.frame import Belief, Odometry
from semviz_core.diagnosis.assumptions import solve_with_sigma, solved_without_heading
from semviz_core.diagnosis.frame_causes import with_sigma_scaled
from semviz_core.diagnosis.reference import (
    FrameReference,
    ProgressCallback,
    is_near,
    no_progress,
)
from semviz_core.localization.localizer import Localizer
from semviz_core.tracking.tracker import TrackedPose, Tracker

MOST_STEPS = 10
"""Steps from the nearest frame whose pose is known."""
MOST_SEARCHED = 30
"""Frames of a stretch that are tracked with their priors."""


@dataclass(frozen=True, eq=False)
class _Carried:
    """A pose tracked to a frame from another one."""

    start: int
    """Row of the frame that the track starts from."""
    steps: int
    belief: Belief


def with_carried_poses(
    cases: Sequence[FrameReference],
    odometry: Sequence[Odometry | None],
    watch: ProgressCallback = no_progress,
) -> list[FrameReference]:
    """Return all frames; those that are not ok, or that others contradict, with a carried pose.

    Where poses reach few frames, assumptions are left open one by one: a wrong one ends a track.
    Frames that no track reaches stay as they are. None has a true pose. ``odometry`` has the
    motion of each from the one before.
    """
    if all(step is None for step in odometry):
        return list(cases)
    best: dict[int, Belief] = {}
    for assumption in ASSUMPTIONS:
        looser = [assumption.frame(case) for case in watch(cases, assumption.name, len(cases))]
        steps = [None if step is None else assumption.step(step) for step in odometry]
        found = _carried(looser, steps)
        best = found if len(found) > len(best) else best
        if len(best) >= ENOUGH * len(cases):
            break
    return [_posed(case, best.get(row)) for row, case in enumerate(cases)]


@dataclass(frozen=True)
class _Assumption:
    """What is left open while poses are carried."""

    name: str
    frame: Callable[[FrameReference], FrameReference] = lambda case: case
    step: Callable[[Odometry], Odometry] = lambda step: step


def _with_sigma(factor: float) -> Callable[[FrameReference], FrameReference]:
    def solved(case: FrameReference) -> FrameReference:
        if case.localization.prior is None:  # the whole map would be searched
            return with_sigma_scaled(case, factor)
        return replace(case, localization=solve_with_sigma(case, factor))

    return solved


def _vague(step: Odometry) -> Odometry:
    return Odometry(step.T_now_before, WIDER**2 * step.covariance)


ENOUGH = 0.5
"""Share of frames with a pose from which on all assumptions are kept."""
WIDER = 6.0
"""Factor on the sigmas of odometry that is left open."""
ASSUMPTIONS = (
    _Assumption("carrying poses by odometry"),
    _Assumption("carrying poses without headings", solved_without_heading),
    _Assumption("carrying poses with larger sigmas", _with_sigma(2.0)),
    _Assumption("carrying poses with the largest sigmas", _with_sigma(4.0)),
    _Assumption("carrying poses by vague odometry", step=_vague),
)


def _carried(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None]
) -> dict[int, Belief]:
    """Return the poses of all frames that a track reaches, by row."""
    own = {row: belief for row, case in enumerate(cases) if (belief := _own(case)) is not None}
    known = {row: own[row] for row in _agreeing(own, _tracked(cases, odometry, own))}
    for rows in _stretches(odometry):
        if not known.keys() & set(rows):
            known |= _searched(cases, odometry, rows)
    tracks = _tracked(cases, odometry, known), _tracked_back(cases, odometry, known)
    found = {row: _best(row, known, tracks) for row in range(len(cases))}
    return {row: belief for row, belief in found.items() if belief is not None}


def _own(case: FrameReference) -> Belief | None:
    result = case.localization
    if result.status != "ok" or result.T_camera_map is None or result.covariance is None:
        return None
    return Belief(result.T_camera_map, result.covariance)


def _tracked(
    cases: Iterable[FrameReference],
    odometry: Sequence[Odometry | None],
    known: Mapping[int, Belief],
) -> dict[int, _Carried]:
    """Return, by row, the pose tracked from the last frame before whose pose is known."""
    found: dict[int, _Carried] = {}
    tracker, start = None, 0
    for row, (case, step) in enumerate(zip(cases, odometry, strict=True)):
        if step is None or row - start > MOST_STEPS:
            tracker = None
        if tracker is not None:
            belief = _belief(tracker.step(case.localization.observed, step, None))
            if belief is None:
                tracker = None
            else:
                found[row] = _Carried(start, row - start, belief)
        if row in known:
            tracker, start = _tracker(case, known[row]), row
    return found


def _tracked_back(
    cases: Sequence[FrameReference],
    odometry: Sequence[Odometry | None],
    known: Mapping[int, Belief],
) -> dict[int, _Carried]:
    """Return, by row, the pose tracked from the first frame after whose pose is known."""
    last = len(cases) - 1
    back = [None, *(None if step is None else step.inverse() for step in odometry[:0:-1])]
    found = _tracked(cases[::-1], back, {last - row: belief for row, belief in known.items()})
    return {last - row: replace(each, start=last - each.start) for row, each in found.items()}


def _tracker(case: FrameReference, start: Belief | None = None) -> Tracker:
    localizer = Localizer(classes=case.semantic_map.classes, detector=case.detector)
    camera = case.localization.camera
    return Tracker(camera, case.semantic_map, case.detector, localizer, start)


def _belief(tracked: TrackedPose) -> Belief | None:
    if tracked.T_camera_map is None or tracked.covariance is None:
        return None
    return Belief(tracked.T_camera_map, tracked.covariance)


def _agreeing(own: Mapping[int, Belief], found: Mapping[int, _Carried]) -> set[int]:
    """Return rows of frames that are ok, and that a track joins where both say they are."""
    agreeing: set[int] = set()
    for row, each in found.items():
        if row in own and is_near(each.belief.T_camera_map, own[row].T_camera_map):
            agreeing |= {row, each.start}
    return agreeing


def _stretches(odometry: Sequence[Odometry | None]) -> Iterator[range]:
    """Yield the rows of frames that odometry joins."""
    starts = [row for row, step in enumerate(odometry) if step is None or row == 0]
    for start, end in zip(starts, [*starts[1:], len(odometry)], strict=True):
        yield range(start, end)


def _searched(
    cases: Sequence[FrameReference], odometry: Sequence[Odometry | None], rows: range
) -> dict[int, Belief]:
    """Return the poses of a stretch that are sure once its frames are tracked with their priors."""
    tracker, found = _tracker(cases[rows[0]]), dict[int, Belief]()
    for row in rows[:MOST_SEARCHED]:
        result = cases[row].localization
        step = odometry[row] if row > rows[0] else None
        belief = _belief(tracker.step(result.observed, step, result.prior))
        if belief is not None:
            found[row] = belief
    return found


def _best(
    row: int, known: Mapping[int, Belief], tracks: Sequence[Mapping[int, _Carried]]
) -> Belief | None:
    """Return the pose of a frame: its known one, or that of the shortest track."""
    if row in known:
        return known[row]
    reaching = [found[row] for found in tracks if row in found]
    return min(reaching, key=lambda each: each.steps).belief if reaching else None


def _posed(case: FrameReference, belief: Belief | None) -> FrameReference:
    if belief is None:
        return case
    pose, covariance = belief.T_camera_map, belief.covariance
    result = replace(case.localization, status="ok", T_camera_map=pose, covariance=covariance)
    return replace(case, localization=result)
