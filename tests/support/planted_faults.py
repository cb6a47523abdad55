"""Frames with one fault planted in each, to see whether it is named.

A frame is a problem of the benchmark with its noise, hidden bottoms and missed detections, in a map
that is right but for its noise, and is answered rightly before the fault is planted. Faults of
detections, map and prior are planted in what the localizer is given. It does not make the other
ones by itself, so wrong matches, a search miss and a diverged refinement are planted in its steps;
what follows in the chain is computed as ever.

A fault counts only where it can show: what is moved, missing, mapped twice or called by a wrong
name is seen in the frame; what is moved is so by 20 px or more in the image.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements2D, Elements3D, joined
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization, Search
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.diagnosis.fault import FaultKind, GroundTruth
from semviz_core.diagnosis.reference import is_healthy, pose_distance
from semviz_core.localization.association import all_gains, associate, log_likelihood
from semviz_core.localization.least_squares import fit
from semviz_core.localization.localizer import NEEDED_ELEMENTS, Localizer
from semviz_core.localization.match_probabilities import posterior_match
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.refinement import Failure, refine_pose
from semviz_core.localization.residuals import EXACT_POSE, pair_residuals, problem_residuals
from semviz_core.localization.search import REFINED_COVARIANCE, Modes
from semviz_core.localization.status import decide_status
from semviz_core.research.evaluation.problems import (
    DETECTOR,
    Difficulty,
    LocalizationProblem,
    default_road,
    make_problem,
    mapped_elements,
)
from semviz_core.research.evaluation.roads import BenchmarkRoad

CLEAN = Difficulty(false_detections=0.0, missing=0.0, duplicated=0.0, moved=0.0)
WHOLE: Difficulty = replace(CLEAN, crop_m=100.0)
"""So wide that every element that is seen is among the problem's pairs; submaps are ``CLEAN``'s."""
SHOWS_PX = 20.0
_SIGNS = (TRIANGULAR, RECTANGULAR, ROUNDED)
_STARTS = 40
"""Of the fits among which a wrong place is found."""


@dataclass(frozen=True, eq=False)
class Given:
    """What a localizer is given, and the truth."""

    observed: Elements2D
    ids: IntArray
    """(m,) of the true elements; -1 for a false detection."""
    elements: Elements3D
    """The whole map."""
    camera: Camera
    prior: Prior
    T_camera_map: Pose
    crop_m: float = CLEAN.crop_m

    @classmethod
    def of(cls, problem: LocalizationProblem, elements: Elements3D) -> "Given":
        ids = np.full(len(problem.observed), -1)
        ids[problem.pairs[:, 0]] = problem.submap.id[problem.pairs[:, 1]]
        return cls(
            problem.observed, ids, elements, problem.camera, problem.prior, problem.T_camera_map
        )

    @property
    def semantic_map(self) -> SemanticMap:
        return SemanticMap(self.elements, MapFrame("planted"))

    @property
    def submap(self) -> Elements3D:
        away_m = self.elements.anchor_m[:, :2] - self.prior.position_m[:2]
        return self.elements[np.linalg.norm(away_m, axis=1) <= self.crop_m]

    def localized(self) -> Localization:
        localizer = Localizer(detector=DETECTOR)
        return localizer.localize(self.observed, self.submap, self.camera, self.prior)

    def seen(self, rows: IntArray) -> "Given":
        """With these observed rows alone."""
        return replace(self, observed=self.observed[rows], ids=self.ids[rows])

    @property
    def true_rows(self) -> IntArray:
        """Of ``observed``, those that are something real."""
        return np.flatnonzero(self.ids >= 0)

    def row_of(self, element: int) -> int:
        """Of the map."""
        return int(np.flatnonzero(self.elements.id == element)[0])


@dataclass(frozen=True, eq=False)
class Planted:
    """One frame, localized, and what is wrong with it."""

    fault: FaultKind
    localization: Localization
    semantic_map: SemanticMap
    truth: GroundTruth
    elements: tuple[int, ...] = ()
    """Ids of which one or more must be named with the fault; empty where it has none."""
    rows: tuple[int, ...] = ()

    @property
    def is_healthy(self) -> bool:
        """Answered, sure and right."""
        return is_healthy(self.localization, self.truth.T_camera_map)


def plant(
    fault: FaultKind, seed: int, road: BenchmarkRoad | None = None, false_detections: float = 0.0
) -> Planted | None:
    """A frame with the fault; None where the frame is not healthy without, or it cannot show.

    ``false_detections`` is the mean number of others that are in it anyway.
    """
    level = replace(WHOLE, false_detections=false_detections)
    problem = make_problem(seed, level, road)
    given = Given.of(problem, mapped_elements(road or default_road(), seed, level))
    if not problem.is_valid:
        return None
    healthy = localized_with("healthy", given)
    if not healthy.is_healthy:
        return None
    rng = np.random.default_rng([seed, 8])
    return healthy if fault == "healthy" else PLANTED[fault](given, healthy, rng)


Planting = Callable[[Given, Planted, np.random.Generator], Planted | None]


def localized_with(
    fault: FaultKind, given: Given, elements: tuple[int, ...] = (), rows: tuple[int, ...] = ()
) -> Planted:
    truth = GroundTruth(given.T_camera_map, given.ids)
    return Planted(fault, given.localized(), given.semantic_map, truth, elements, rows)


# --- in detections, map and prior ---


def _too_few(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """A place where three or fewer elements stand in view; the rest is not there at all."""
    kept = rng.choice(given.true_rows, int(rng.integers(1, NEEDED_ELEMENTS)), replace=False)
    middle = given.T_camera_map.apply(given.elements.anchor_m)
    there = (middle[:, 2] > 0.0) & (middle[:, 2] < 60.0)
    rows = ~there | np.isin(given.elements.id, given.ids[kept])
    return localized_with(
        "too few elements", replace(given.seen(np.sort(kept)), elements=given.elements[rows])
    )


def _missed(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """All but three or fewer of the detections are gone."""
    kept = rng.choice(given.true_rows, int(rng.integers(1, NEEDED_ELEMENTS)), replace=False)
    return localized_with("missed detection", given.seen(np.sort(kept)))


def _false(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """One detection more, of nothing, where no mapped element of its class is seen."""
    pole = rng.random() < 0.7
    anchor = rng.uniform([20.0, 10.0], [1220.0, 180.0], (1, 2))
    length = np.array([rng.normal(0.0, 2.0), rng.uniform(40.0, 180.0)])
    end = anchor + length if pole else np.full((1, 2), np.nan)
    class_id = POLE if pole else int(rng.choice(_SIGNS))
    more = Elements2D.from_ends(anchor, end, [class_id])
    row = len(given.observed)
    observed = joined(given.observed, more)
    pairs = np.column_stack([np.full(len(given.elements), row), np.arange(len(given.elements))])
    pairs = pairs[given.elements.class_id == class_id]
    if pair_residuals(
        given.T_camera_map, given.camera, observed, given.elements, pairs
    ).inlier.any():
        return None
    changed = replace(given, observed=observed, ids=np.append(given.ids, -1))
    return localized_with("false detection", changed, rows=(row,))


def _wrong_class(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """A sign called another sign."""
    signs = given.true_rows[given.observed.class_id[given.true_rows] != POLE]
    if not len(signs):
        return None
    row = int(rng.choice(signs))
    class_id = given.observed.class_id.copy()
    class_id[row] = rng.choice([sign for sign in _SIGNS if sign != class_id[row]])
    changed = replace(given, observed=replace(given.observed, class_id=class_id))
    return localized_with("wrong class", changed, (int(given.ids[row]),), (row,))


def _not_in_submap(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """A crop so narrow that fewer than four of the detected elements are in it."""
    away_m = given.elements.anchor_m[:, :2] - given.prior.position_m[:2]
    detected = np.isin(given.elements.id, given.ids[given.true_rows])
    distance_m = np.sort(np.linalg.norm(away_m, axis=1)[detected])
    kept = int(rng.integers(0, NEEDED_ELEMENTS))
    return localized_with(
        "not in the submap", replace(given, crop_m=float(distance_m[kept]) - 0.01)
    )


def _moved(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """A seen element 1 to 8 m from where it stands."""
    element = int(rng.choice(given.ids[given.true_rows]))
    changed = shifted(given.elements, element, aside(rng, 1.0, 8.0))
    row = given.row_of(element)
    px = [
        given.camera.project(given.T_camera_map.apply(elements.anchor_m[[row]]))
        for elements in (given.elements, changed)
    ]
    if not abs(px[1] - px[0])[0, 0] > SHOWS_PX:
        return None
    seen = int(np.flatnonzero(given.ids == element)[0])
    return localized_with("moved in the map", replace(given, elements=changed), (element,), (seen,))


def _missing(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """A seen element that is not in the map."""
    row = int(rng.choice(given.true_rows))
    kept = given.elements[given.elements.id != given.ids[row]]
    return localized_with(
        "missing in the map", replace(given, elements=kept), (int(given.ids[row]),), (row,)
    )


def _twice(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """A seen element that is in the map twice, 0.2 to 0.8 m apart."""
    element = int(rng.choice(given.ids[given.true_rows]))
    changed, copy = copied(given.elements, element, aside(rng, 0.2, 0.8))
    return localized_with("twice in the map", replace(given, elements=changed), (copy,))


def _row_of_poles(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """Nothing but a row of equal poles, 5 m apart."""
    T_map_camera = given.T_camera_map.inverse()
    ahead = T_map_camera.rotation[:, 2] * [1.0, 1.0, 0.0]
    ahead /= np.linalg.norm(ahead)
    aside = np.array([ahead[1], -ahead[0], 0.0]) * rng.uniform(3.0, 6.0)
    bottom = T_map_camera.translation + aside - np.array([0.0, 0.0, 1.65])
    bottom = bottom + (5.0 * np.arange(-14, 15) + rng.uniform(0.0, 5.0))[:, None] * ahead
    peak = bottom + np.array([0.0, 0.0, 6.0])
    row = Elements3D.from_ends(np.arange(len(peak)), peak, bottom, np.full(len(peak), POLE), 0.02)
    anchor, end = (
        given.camera.project(given.T_camera_map.apply(point)) for point in (peak, bottom)
    )
    distance = given.T_camera_map.apply(peak)[:, 2]
    seen = given.camera.contains(anchor) & given.camera.contains(end) & (distance < 40.0)
    seen &= rng.random(len(peak)) < 0.8
    if seen.sum() < NEEDED_ELEMENTS:
        return None
    noise = rng.standard_normal((2, int(seen.sum()), 2))
    observed = Elements2D.from_ends(
        anchor[seen] + noise[0], end[seen] + noise[1], row.class_id[seen]
    )
    changed = replace(given, observed=observed, ids=row.id[seen], elements=row)
    found = localized_with("ambiguous geometry", changed)
    return None if found.is_healthy else found


# --- in the method's own steps ---


def _wrong_matches(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """A matcher that prefers the pairs of a wrong place, which search then finds."""
    missed = _search_miss(given, healthy, rng)
    if missed is None:
        return None
    localization = replace(missed.localization, method="matcher")
    return replace(missed, fault="wrong matches", localization=localization)


def _search_miss(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """A search that found a wrong place alone."""
    result = healthy.localization
    scene = PoseProblem.of(result.camera, result.observed, result.submap, DETECTOR)
    modes = _wrong_place(scene, given, rng)
    if modes is None:
        return None
    pose = Pose(modes.rotation[0], modes.translation[0])
    refined = refine_pose(scene, result.prior, pose, modes.pairs(0))
    search = Search(modes.evaluated, (pose,), modes.score)
    match = posterior_match(modes.score, modes.gain, scene.compatible)
    found = replace(result, search=search, match=match, alternatives=())
    if isinstance(refined, Failure):
        found = _without_pose(replace(found, refinement=None), refined.reason)
    else:
        decision = decide_status(modes, refined, result.observed, result.submap, result.prior)
        found = replace(
            found, status="ok", reason=decision.reason, T_camera_map=refined.T_camera_map,
            covariance=refined.covariance, refinement=refined.refinement,
        )  # fmt: skip
        if decision.status == "cannot":
            found = _without_pose(found, decision.reason)
        else:
            found = replace(found, status=decision.status)
    missed = replace(healthy, fault="search miss", localization=found)
    return None if missed.is_healthy else missed


def _without_pose(localization: Localization, reason: str) -> Localization:
    return replace(localization, status="cannot", reason=reason, T_camera_map=None, covariance=None)


def _wrong_place(scene: PoseProblem, given: Given, rng: np.random.Generator) -> Modes | None:
    """The best of some fits from anywhere about the fix that ended elsewhere than at the truth."""
    known = PriorRecord.of(given.prior)
    best: Modes | None = None
    for _ in range(_STARTS):
        turn = rng.uniform(-np.pi, np.pi)
        yaw = Pose.from_rotvec([0.0, 0.0, turn], np.zeros(3))
        off = np.append(rng.uniform(-10.0, 10.0, 2), 0.0)
        center_m = given.prior.position_m + off
        R = given.T_camera_map.rotation @ yaw.rotation.T
        t = -R @ center_m
        match, _ = associate(scene, R, t, REFINED_COVARIANCE)
        R, t, _, _ = fit(scene, known, R, t, match, 10)
        match, gain = associate(scene, R, t, EXACT_POSE)
        away_m, angle = pose_distance(Pose(R, t), given.T_camera_map)
        if (match >= 0).sum() < 2 or (away_m < 3.0 and angle < 0.2):
            continue
        score = float(log_likelihood(scene, known, R, t, match, gain))
        if best is None or score > best.score[0]:
            best = Modes(
                _STARTS,
                _STARTS,
                R[None],
                t[None],
                np.array([score]),
                match[None],
                all_gains(scene, R, t)[None],
            )
    return best


def _diverged(given: Given, healthy: Planted, rng: np.random.Generator) -> Planted | None:
    """Refinement that left the right pose for one 2 to 20 m off; no answer where nothing fits."""
    result = healthy.localization
    assert result.T_camera_map is not None
    assert result.refinement is not None
    step = np.append(rng.standard_normal(3), rng.normal(0.0, 0.1, 3))
    step[:3] *= rng.uniform(2.0, 20.0) / np.linalg.norm(step[:3])
    pose = Pose.exp(step) @ result.T_camera_map
    pairs = result.refinement.pairs
    scene = PoseProblem.of(result.camera, result.observed, result.submap, DETECTOR)
    off = problem_residuals(scene, pose, pairs)
    fine = replace(result.refinement, residual_px=off.residual_px, chi2=off.chi2, inlier=off.inlier)
    found = replace(result, T_camera_map=pose, refinement=fine)
    if off.inlier.sum() < NEEDED_ELEMENTS:
        found = _without_pose(found, f"Only {off.inlier.sum()} elements fit the best pose.")
    return replace(healthy, fault="refinement diverged", localization=found)


PLANTED: dict[FaultKind, Planting] = {
    "too few elements": _too_few,
    "missed detection": _missed,
    "false detection": _false,
    "wrong class": _wrong_class,
    "not in the submap": _not_in_submap,
    "moved in the map": _moved,
    "missing in the map": _missing,
    "twice in the map": _twice,
    "wrong matches": _wrong_matches,
    "search miss": _search_miss,
    "refinement diverged": _diverged,
    "ambiguous geometry": _row_of_poles,
}


def shifted(elements: Elements3D, element: int, by_m: FloatArray) -> Elements3D:
    """With one element elsewhere."""
    by = (elements.id == element)[:, None] * by_m
    return replace(elements, anchor_m=elements.anchor_m + by, end_m=elements.end_m + by)


def copied(elements: Elements3D, element: int, by_m: FloatArray) -> tuple[Elements3D, int]:
    """With a copy of one element beside it, and the copy's id."""
    copy = int(elements.id.max()) + 1
    added = replace(elements[elements.id == element], id=np.array([copy]))
    return joined(elements, shifted(added, copy, by_m)), copy


def shifted_map(elements: Elements3D, by_m: FloatArray) -> Elements3D:
    """With all elements elsewhere."""
    return replace(elements, anchor_m=elements.anchor_m + by_m, end_m=elements.end_m + by_m)


def aside(rng: np.random.Generator, least_m: float, most_m: float) -> FloatArray:
    """A horizontal vector (3,)."""
    angle, length = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(least_m, most_m)
    return length * np.array([np.cos(angle), np.sin(angle), 0.0])
