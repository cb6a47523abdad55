"""Diagnose one frame: find the first stage of localization that failed, and why.

The checks, in order: enough detections, elements in the submap, correct pairs possible and
preferred, true pose found by the search, refined to the right pose, determined by the geometry.
Each check returns its fault or None, and uses the ground truth where it is known.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.diagnosis import assumptions
from semviz_core.diagnosis.checks import find_faults, sound_pairs
from semviz_core.diagnosis.confidence import CONFIDENCE
from semviz_core.diagnosis.fault import (
    EvidenceItem,
    Fault,
    FaultKind,
    FrameDiagnosis,
    GroundTruth,
    GroundTruthLevel,
)
from semviz_core.diagnosis.frame_causes import misalignment, misalignment_fault, with_sigma_scaled
from semviz_core.diagnosis.reference import FrameReference, is_healthy, pose_distance
from semviz_core.localization.localizer import NEEDED_ELEMENTS
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.residuals import problem_residuals
from semviz_core.localization.search import APART_M, APART_RAD, BASIN_M, mode_near
from semviz_core.localization.status import needed_gap_nats
from semviz_core.localization.upright import assumed_upright

MATRIX_FROM_POSES = ("search", "track")
"""Methods whose match probabilities follow from the poses found, and cannot mislead the search."""
LEAST_FIRST = 0.5
"""Below this share of true pairs among the pairs ranked first, the matches are wrong."""
MISSED_NATS = 3.0
"""The true pose was missed if its score exceeds the best score found by more."""
LEAST_GAIN_NATS = 0.05
"""A smaller gain or loss is none."""
MUCH_CLUTTER = 0.5
"""Share of faulty rows that is harmful even if none of them is among the inliers."""
UNMATCHED: FaultKind = "false or not mapped"
"""Costs a pair if the detection is real; no failure if enough other pairs remain."""
MANY_OFF, MOST_OFF = 3, 0.5
"""From so many detections and more than this share that do not fit, faults are not their own."""
COSTS_A_PAIR: tuple[FaultKind, ...] = (
    "wrong class", "moved in the map", "missing in the map", UNMATCHED,
)  # fmt: skip
MAX_NAMED = 3
"""Number of missed elements that a sentence names."""
_AHEAD_SHARE = 0.23
"""Share of the elements around a camera that an image of about 80 deg shows."""


def check_detection_count(case: FrameReference) -> Fault | None:
    """Check that enough elements are detected."""
    seen = len(case.localization.observed)
    return None if seen >= NEEDED_ELEMENTS else _too_few(case, seen)


def check_submap(case: FrameReference) -> Fault | None:
    """Check that the submap holds the detected elements: a poor prior or a narrow crop may not."""
    result = case.localization
    if result.prior is None and not len(result.submap):
        sentence = "The frame has no prior, so it is unknown which part of the map to search."
        return Fault("not in the submap", sentence)
    if case.truth is None:
        return None if result.prior is None else _found_in_wide_submap(case)
    sound = sound_pairs(case)
    outside = int((~case.in_submap[sound[:, 1]]).sum()) if len(sound) else 0
    enough = len(sound) - outside >= NEEDED_ELEMENTS
    if enough or not outside:
        return None
    if wrong := assumptions.position_fault(case):  # other faults besides keep the frame from a pose
        return wrong
    sentence = f"{outside} of {len(sound)} detected elements are outside the submap"
    if result.prior is None:
        return Fault("not in the submap", f"{sentence}.", (EvidenceItem("outside", outside),))
    off_m = _prior_off_m(case)
    evidence = (EvidenceItem("prior off", off_m, "m"), EvidenceItem("outside", outside))
    return Fault("not in the submap", f"{sentence}; the prior is {off_m:.0f} m off.", evidence)


def _found_in_wide_submap(case: FrameReference) -> Fault | None:
    """Return the fault of a crop without which the frame has a pose."""
    result, again = case.localization, assumptions.solve_in_wide_submap(case)
    if again.status != "ok" or again.refinement is None:
        return None
    used = again.submap.id[again.refinement.pairs[again.refinement.inlier, 1]]
    outside = int((~np.isin(used, result.submap.id)).sum())
    if not outside:
        return None
    sentence = f"{outside} of {len(used)} detected elements are outside the submap."
    return Fault("not in the submap", sentence, (EvidenceItem("outside", outside),))


def check_candidate_pairs(case: FrameReference, faults: Sequence[Fault]) -> Fault | None:
    """Check that enough detections fit the map, and that no faulty one is among the inliers."""
    if case.reference is None:
        return None
    costly = [fault for fault in faults if fault.kind in COSTS_A_PAIR]
    sound = len(sound_pairs(case))
    if sound < NEEDED_ELEMENTS and sound + len(costly) < NEEDED_ELEMENTS and case.truth is not None:
        return _too_few(case, sound)
    if len(costly) >= MANY_OFF and len(costly) > MOST_OFF * len(case.localization.observed):
        return _most_are_off(case, len(costly))
    blamed = [fault for fault in costly if sound < NEEDED_ELEMENTS or fault.kind != UNMATCHED]
    if blamed:
        return blamed[0]
    used = case.localization.refinement
    rows = set() if used is None else set(used.pairs[used.inlier, 0].tolist())
    cluttered = len(faults) >= MUCH_CLUTTER * len(case.localization.observed)
    harmful = [
        fault for fault in faults
        if fault.kind == "twice in the map" or cluttered or rows & set(fault.rows)
    ]  # fmt: skip
    return harmful[0] if harmful else None


def _most_are_off(case: FrameReference, off: int) -> Fault:
    """Return what is said of more faults than single elements and detections have."""
    sentence = (
        f"{off} of {len(case.localization.observed)} detections do not fit the map, and no single "
        "cause explains them: the lens, the calibration, the image or the map is another one."
    )
    return Fault("unexplained", sentence, (EvidenceItem("off", off),))


def check_association(case: FrameReference) -> Fault | None:
    """Check that the pairs that the solver preferred are the true ones."""
    result = case.localization
    if case.truth is None or result.match is None or result.method in MATRIX_FROM_POSES:
        return None
    sound = sound_pairs(case)
    true = {(int(i), int(case.nearby.id[j])) for i, j in sound}
    order = [(int(i), int(result.submap.id[j])) for i, j in result.match.order]
    if not true:
        return None
    first = len(true.intersection(order[: len(true)])) / len(true)
    if first >= LEAST_FIRST:
        return None
    ranks = [order.index(pair) + 1 if pair in order else len(order) + 1 for pair in sorted(true)]
    rank = float(np.median(ranks))
    sentence = (
        f"Of the {len(true)} pairs ranked first, {first:.0%} are true; the median rank of the true "
        f"pairs is {rank:.0f}."
    )
    evidence = (EvidenceItem("true among the first", first), EvidenceItem("median rank", rank))
    return Fault("wrong matches", sentence, evidence)


def check_search(case: FrameReference) -> Fault | None:
    """Check that the search found the true pose, and ranked it first."""
    search = case.localization.search
    if case.truth is None:
        unknown = case.localization.prior is None
        return None if unknown else _found_with_more_effort(case)
    if search is None:
        return None
    if search_found_truth(case):
        return None
    best = float(search.score[0]) if len(search.score) else -np.inf
    truth = score_near(case, case.truth)
    evidence = (EvidenceItem("truth", truth, "nats"), EvidenceItem("best found", best, "nats"))
    if truth > best + MISSED_NATS and not any(map(case.is_true, search.T_camera_map)):
        sentence = f"The search missed the true pose, which scores {truth:.0f} nats"
        worse = f"; the best pose it found scores {best:.0f}." if len(search.score) else "."
        return Fault("search miss", sentence + worse, evidence)
    return Fault("ambiguous geometry", _compared(best - truth), evidence)


def _compared(gain: float) -> str:
    """Return how another pose compares with the true one; ``gain`` in nats."""
    if abs(gain) < LEAST_GAIN_NATS:
        return "Another pose explains the image as well as the true one."
    if gain > 0.0:
        return f"Another pose explains the image better than the true one, by {gain:.1f} nats."
    return f"Another pose explains the image almost as well as the true one: {-gain:.1f} nats less."


def _found_with_more_effort(case: FrameReference) -> Fault | None:
    """Return the fault of a search that stopped before the pose that a wider one finds."""
    result, again = case.localization, assumptions.solve_with_more_effort(case)
    if again.status != "ok" or again.refinement is None:
        return None
    fit = int(again.refinement.inlier.sum())
    sentence = f"A wider search finds a pose that {fit} of {len(result.observed)} elements fit."
    own = result.match is not None and result.method not in MATRIX_FROM_POSES
    kind: FaultKind = "wrong matches" if own else "search miss"
    return Fault(kind, sentence, (EvidenceItem("fit", fit),))


def search_found_truth(case: FrameReference) -> bool:
    """Whether the search ranked the true pose first; False if the truth is unknown."""
    search = case.localization.search
    return search is not None and len(search.score) > 0 and case.is_true(search.T_camera_map[0])


def check_refinement(case: FrameReference) -> Fault | None:
    """Check that refinement stayed near its start."""
    result = case.localization
    if result.search is None or not len(result.search.score):
        return None
    if result.T_camera_map is None:
        return _lost_pairs(case)
    away_m, angle = pose_distance(result.search.T_camera_map[0], result.T_camera_map)
    limit_m = BASIN_M if case.truth is None else APART_M
    if away_m <= limit_m and angle <= 2.0 * APART_RAD:
        return None
    sentence = f"Refinement ended {away_m:.1f} m and {np.rad2deg(angle):.0f} deg from its start."
    return Fault("refinement diverged", sentence, (EvidenceItem("away", away_m, "m"),))


def _lost_pairs(case: FrameReference) -> Fault | None:
    """Check that the pairs that fit the start of refinement still fit its end."""
    result = case.localization
    if result.search is None or not result.search.T_camera_map or result.refinement is None:
        return None
    pairs, after = result.refinement.pairs, int(result.refinement.inlier.sum())
    problem = PoseProblem.of(result.camera, result.observed, result.submap, case.detector)
    before = int(problem_residuals(problem, result.search.T_camera_map[0], pairs).inlier.sum())
    if before < NEEDED_ELEMENTS or after >= before:
        return None
    sentence = f"{before} pairs fit the start of refinement, {after} its end."
    evidence = (EvidenceItem("fit before", before), EvidenceItem("fit after", after))
    return Fault("refinement diverged", sentence, evidence)


def check_observability(case: FrameReference) -> Fault | None:
    """Check that the pairs determine one pose; the last check, for frames that are not ok."""
    result = case.localization
    if result.status == "ok":
        return None
    rivals = 0
    if result.search is not None and len(result.search.score):
        fitting = 0 if result.refinement is None else int(result.refinement.inlier.sum())
        nats = needed_gap_nats(fitting, len(result.observed))
        rivals = int((result.search.score[0] - result.search.score < nats).sum())
    if rivals > 1:
        gap = float(result.search.score[0] - result.search.score[1]) if result.search else 0.0
        sentence = f"{rivals} poses explain the image about equally well."
        evidence = (EvidenceItem("poses", rivals), EvidenceItem("gap", gap, "nats"))
        return Fault("ambiguous geometry", sentence, evidence)
    sigma_m = np.nan
    if result.covariance is not None:
        sigma_m = float(np.sqrt(np.trace(result.covariance[:3, :3])))
    sentence = "The detections do not determine the pose reliably."
    return Fault("ambiguous geometry", sentence, (EvidenceItem("uncertainty", sigma_m, "m"),))


def score_near(case: FrameReference, T_camera_map: Pose) -> float:
    """Return the log-likelihood (nats) of the best pose near one, as the search scores it."""
    result = case.localization
    problem = PoseProblem.of(result.camera, result.observed, result.submap, case.detector)
    return float(mode_near(problem, assumed_upright(case.prior), T_camera_map).score[0])


def _too_few(case: FrameReference, seen: int) -> Fault:
    """Return the cause of too few detections: few elements in view, or missed detections."""
    if case.truth is not None:
        mapped, about = int(case.in_view.sum()), ""
    else:
        mapped, about = round(_AHEAD_SHARE * _within_reach(case)), "about "
    kind: FaultKind = "missed detection" if mapped >= NEEDED_ELEMENTS else "too few elements"
    sentence = (
        f"{about}{mapped} mapped elements are in view, {seen} of them detected; "
        f"{NEEDED_ELEMENTS} are needed.{_missed_names(case)}"
    )
    evidence = (EvidenceItem("seen", seen), EvidenceItem("in view", mapped))
    return Fault(kind, sentence[0].upper() + sentence[1:], evidence)


def _missed_names(case: FrameReference) -> str:
    """Return a sentence with the missed elements in view, nearest first; empty without any."""
    missed = np.flatnonzero(case.missed)
    if case.truth is None or not len(missed):
        return ""
    depth_m = case.truth.apply(case.nearby.anchor_m[missed])[:, 2]
    names = [case.name(int(j)) for j in missed[np.argsort(depth_m)]]
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return f" Not detected: {', '.join(names[:MAX_NAMED])}{more}."


def _within_reach(case: FrameReference) -> int:
    """Return the number of mapped elements within the detector's range of the place."""
    result = case.localization
    offset_m = result.submap.anchor_m[:, :2] - result.around_m[:2]
    return int((np.linalg.norm(offset_m, axis=1) < case.detector.far_m).sum())


def _prior_off_m(case: FrameReference) -> float:
    assert case.reference is not None
    center_m = case.reference.inverse().translation
    return float(np.linalg.norm((case.prior.position_m - center_m)[:2]))


def diagnose_frame(
    localization: Localization,
    semantic_map: SemanticMap,
    truth: GroundTruth | None = None,
    detector: DetectorModel | None = None,
) -> FrameDiagnosis:
    """Return the diagnosis of a frame, from all ground truth that is known.

    ``semantic_map`` is the map that the submap was cropped from, ``detector`` the localizer's
    detector model.
    """
    case = FrameReference.of(localization, semantic_map, truth, detector)
    knowledge: GroundTruthLevel = "nothing" if truth is None else truth.knowledge
    faults = _all_faults(case)
    fault = _healthy(case) if is_healthy(localization, case.truth) else _first_failure(case, faults)
    return FrameDiagnosis(fault, CONFIDENCE[knowledge][fault.kind], faults)


def _all_faults(case: FrameReference) -> tuple[Fault, ...]:
    """Return the common causes of a frame, then the faults of rows that they leave unexplained."""
    assumed = assumptions.assumption_faults(case)
    for fault in assumed:
        if fault.kind == "wrong detection sigma":
            case = with_sigma_scaled(case, fault.evidence[0].value)
    image = misalignment(case)
    if image is None:
        return (*assumed, *find_faults(case))
    aligned = replace(case, truth=image.T_camera_map)
    return (*assumed, misalignment_fault(case, image), *find_faults(aligned))


def check_alignment(case: FrameReference) -> Fault | None:
    """Check that the image does not support a pose near the true one, with most elements."""
    image = misalignment(case)
    return None if image is None else misalignment_fault(case, image)


def _healthy(case: FrameReference) -> Fault:
    result = case.localization
    fit = 0 if result.refinement is None else int(result.refinement.inlier.sum())
    sentence = f"{fit} of {len(result.observed)} elements fit."
    return Fault("healthy", sentence, (EvidenceItem("fit", fit),))


def _first_failure(case: FrameReference, faults: tuple[Fault, ...]) -> Fault:
    """Return the first failed stage of a frame without a pose or with a wrong one.

    If the search found the true pose, or may have, refinement is checked first.
    """
    found = case.truth is None or search_found_truth(case)
    return (
        (check_refinement(case) if found else None)
        or check_detection_count(case)
        or assumptions.check_assumptions(case)
        or check_alignment(case)
        or check_submap(case)
        or check_candidate_pairs(case, faults)
        or check_association(case)
        or check_search(case)
        or check_refinement(case)
        or _no_pose_fits(case)
        or check_observability(case)
        or _unexplained(case)
    )


def _no_pose_fits(case: FrameReference) -> Fault | None:
    """Return the fault of a frame without a pose that no change gives one."""
    if case.reference is not None:
        return None
    sentence = (
        f"{len(case.localization.observed)} elements are detected, but no pose fits them, "
        "whichever single assumption is dropped."
    )
    return Fault("unexplained", sentence, (EvidenceItem("mapped", len(case.localization.submap)),))


def _unexplained(case: FrameReference) -> Fault:
    result = case.localization
    assert result.T_camera_map is not None
    off = (case.truth @ result.T_camera_map.inverse()).log() if case.truth else np.zeros(6)
    chi2 = np.nan
    if result.covariance is not None:
        chi2 = float(off @ np.linalg.solve(result.covariance, off))
    sentence = "The pose is wrong, but no stage fails its check."
    return Fault("unexplained", sentence, (EvidenceItem("squared error over covariance", chi2),))
