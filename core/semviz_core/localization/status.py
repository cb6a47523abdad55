"""Decide whether a pose is reliable: status ok, ambiguous or cannot, with a reason.

The limits were chosen on tuning roads (docs/results/benchmark.md). No rule over a result's
features, not even a learned one, separated right results from wrong ones much better. A
verifier's probability replaces two limits: the gap to the other poses, and the least number of
pairs.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Refinement, Status
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.crowding import chance_explains
from semviz_core.localization.refinement import NEEDED_PAIRS, PoseEstimate
from semviz_core.localization.search import Modes, pose_distances

AMBIGUOUS_NATS, NEARLY_ALL_NATS, SCALE_NATS = 14.0, 9.0, 6.0
"""Another mode within the first of the best makes the pose ambiguous, within the second if at most
one observed element does not fit; within as much more as the third for each factor of e by which
the stated sigma of the detections is too small."""
SURE_PROBABILITY = 0.95
"""A pose with a lower verifier probability is ambiguous; replaces AMBIGUOUS_NATS."""
LIKELY_PROBABILITY = 0.5
"""A pose with at least this verifier probability is ambiguous, not rejected, if few pairs fit."""
LEAST_SUPPORT_NATS = 5.0
"""A pair with less leave-one-out support may be wrong."""
OPEN_M = 0.3
"""Such a pair makes the pose ambiguous if the position is open to more than this without it."""
SURE_PAIRS = 4
"""A pose with fewer inliers is ambiguous: three pairs cannot reveal a wrong one among them."""
LEAST_SHARE, PLENTY = 0.5, 6
"""Share that must fit of the observed elements that the submap can explain, up to so many: a wrong
position explains a few by chance, seldom half. Of the rest, most are false in clutter."""
SURE_SIGMA_M = 0.5
"""A pose whose position is less certain than this is ambiguous."""
CONTRADICTING_SIGMAS = 4.0
"""A pose further than this from a component of the prior contradicts it."""


@dataclass(frozen=True)
class StatusDecision:
    status: Status
    reason: str
    """One sentence with numbers."""


def decide_status(
    modes: Modes,
    estimate: PoseEstimate,
    observed: Elements2D,
    submap: Elements3D,
    prior: Prior,
    probability: FloatArray | None = None,
    by_chance: float = 0.0,
    explicable: int | None = None,
) -> StatusDecision:
    """Return the status of ``estimate``, the refined first of ``modes``, with its reason.

    ``probability`` (b,) of the modes comes from a verifier, if any, ``by_chance`` from
    ``pairs_by_chance``. ``explicable`` of the elements can be in the submap; if several cameras saw
    them, more than can if one did. The first doubt that applies makes the pose ambiguous.
    """
    if explicable is None:
        explicable = explicable_elements(observed, submap)
    decision = _decided(
        modes, estimate, observed, submap, prior, probability, by_chance, explicable
    )
    if modes.sigma_scale == 1.0:
        return decision
    times = f" The stated sigma is about {modes.sigma_scale:.2g}x too small."
    return StatusDecision(decision.status, decision.reason + times)


def _decided(
    modes: Modes,
    estimate: PoseEstimate,
    observed: Elements2D,
    submap: Elements3D,
    prior: Prior,
    probability: FloatArray | None,
    by_chance: float,
    explicable: int,
) -> StatusDecision:
    fit = estimate.refinement
    fitting = int(fit.inlier.sum())
    half = min(int(np.ceil(LEAST_SHARE * explicable)), PLENTY)
    needed = max(NEEDED_PAIRS, min(half, SURE_PAIRS))
    of_all = f"{fitting} of {len(observed)} elements"
    if explicable < len(observed):
        of_all += f" ({explicable} can be in the submap)"
    if fitting < needed and not is_likely(probability):
        return StatusDecision("cannot", f"Only {of_all} fit the best pose; {needed} needed.")
    sigma_m = float(np.sqrt(np.trace(estimate.covariance[:3, :3])))
    doubts = (
        _ambiguity(modes, estimate.T_camera_map, needed_gap_nats(fitting, len(observed)))
        if probability is None
        else _low_probability(probability),
        *_contradictions(estimate.T_camera_map, prior),
        _few_pairs(fitting, max(SURE_PAIRS, half), of_all),
        _crowded(fitting, by_chance),
        _dependence(fit, submap),
        _uncertain(sigma_m),
    )
    for doubt in filter(None, doubts):
        return StatusDecision("ambiguous", doubt)
    return StatusDecision("ok", f"{of_all} fit, {sigma_m:.2f} m{_margin(modes, probability)}.")


def is_likely(probability: FloatArray | None) -> bool:
    """Return whether the first of (b,) modes is likely right by a verifier; False without one."""
    return probability is not None and bool(probability[0] >= LIKELY_PROBABILITY)


def _margin(modes: Modes, probability: FloatArray | None) -> str:
    if probability is not None:
        return f"; {probability[0]:.1%} sure"
    gap = modes.score[0] - modes.score
    return f"; the next pose is {gap[1]:.0f} nats worse" if len(gap) > 1 else ""


def explicable_elements(observed: Elements2D, submap: Elements3D) -> int:
    """Return how many observed elements have a counterpart of their class in the submap."""
    length = 1 + max(observed.class_id.max(initial=0), submap.class_id.max(initial=0))
    seen = np.bincount(observed.class_id, minlength=length)
    return int(np.minimum(seen, np.bincount(submap.class_id, minlength=length)).sum())


def needed_gap_nats(fitting: int, observed: int) -> float:
    """Return by how many nats a pose has to be better than any other, if so many of the observed
    elements fit it: chance seldom fits nearly all."""
    return NEARLY_ALL_NATS if fitting >= observed - 1 else AMBIGUOUS_NATS


def _ambiguity(modes: Modes, T_camera_map: Pose, gap_nats: float) -> str:
    needed_nats = gap_nats + SCALE_NATS * float(np.log(modes.sigma_scale))
    rivals = int((modes.score[0] - modes.score < needed_nats).sum())
    if rivals < 2:
        return ""
    distance, angle = pose_distances(
        T_camera_map.rotation, T_camera_map.translation, modes.rotation, modes.translation
    )
    first, second = modes.score[:2]
    count, which = ("Two", "") if rivals == 2 else (str(rivals), "the first two ")
    return (
        f"{count} poses fit: scores {first:.1f} and {second:.1f}, {which}{distance[1]:.1f} m and "
        f"{np.rad2deg(angle[1]):.0f} deg apart."
    )


def _low_probability(probability: FloatArray) -> str:
    if probability[0] >= SURE_PROBABILITY:
        return ""
    next_best = f", the next one with {probability[1:].max():.0%}" if len(probability) > 1 else ""
    return f"The best pose is right with {probability[0]:.0%} only{next_best}."


def _contradictions(T_camera_map: Pose, prior: Prior) -> Iterator[str]:
    """Yield a sentence for each component of the prior, empty unless the pose contradicts it."""
    R = T_camera_map.rotation
    center = -R.T @ T_camera_map.translation
    off_m = float(np.hypot(*(center - prior.position_m)[:2]))
    yield _contradiction("fix", off_m, prior.horizontal_sigma_m, f"{off_m:.1f} m")
    if prior.up_camera is not None:
        tilt = float(np.arccos(np.clip(R[:, 2] @ prior.up_camera, -1.0, 1.0)))
        yield _contradiction("gravity", tilt, prior.up_sigma_rad, f"{np.rad2deg(tilt):.1f} deg")
    if prior.heading_rad is not None:
        turn = np.arctan2(R[2, 1], R[2, 0]) - prior.heading_rad
        turn = abs(float(np.arctan2(np.sin(turn), np.cos(turn))))
        text = f"{np.rad2deg(turn):.1f} deg"
        yield _contradiction("heading", turn, prior.heading_sigma_rad, text)


def _contradiction(piece: str, off: float, sigma: float, text: str) -> str:
    if off <= CONTRADICTING_SIGMAS * sigma:
        return ""
    return f"The pairs contradict the prior: its {piece} is {text} off, {off / sigma:.1f} sigma."


def _few_pairs(fitting: int, needed: int, of_all: str) -> str:
    return "" if fitting >= needed else f"Only {of_all} fit; {needed} are needed to be sure."


def _crowded(fitting: int, by_chance: float) -> str:
    if not chance_explains(by_chance, fitting):
        return ""
    return (
        f"The map is so dense that {by_chance:.1f} elements fit on average wherever the camera "
        f"looks: the {fitting} that fit may do so by chance."
    )


def critical_pair(fit: Refinement) -> int | None:
    """Return the row of the pair that fixes the pose with little support from others, if any."""
    if fit.support is None or fit.open_m is None:
        return None
    weak = (fit.support < LEAST_SUPPORT_NATS) & (fit.open_m > OPEN_M)
    return int(np.argmax(np.where(weak, fit.open_m, 0.0))) if weak.any() else None


def _dependence(fit: Refinement, submap: Elements3D) -> str:
    row = critical_pair(fit)
    if row is None or fit.open_m is None:
        return ""
    i, j = fit.pairs[row]
    open_m = fit.open_m[row]
    how = f"is open to {open_m:.1f} m" if np.isfinite(open_m) else "is not fixed"
    return (
        f"All hangs on one pair, element {i} seen with {submap.id[j]} mapped: without it the place "
        f"{how}, and the others do not confirm it."
    )


def _uncertain(sigma_m: float) -> str:
    if sigma_m <= SURE_SIGMA_M:
        return ""
    return f"The pairs fix the position only to {sigma_m:.2g} m; {SURE_SIGMA_M:.1f} m is sure."
