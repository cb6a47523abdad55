"""Whether a pose can be relied on, and in which words.

Limits were chosen on tuning roads (docs/figures.md): no rule over what is known of an answer, not
even a learned one, told many more right answers from wrong ones than these do. Where a verifier
says how likely a pose is right, that takes the place of two of them: of the gap to other poses, and
of how many pairs there have to be for any answer.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from semviz_core.arrays import FloatArray
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.localization import Refinement, Status
from semviz_core.pose import Pose
from semviz_core.solving.refine import NEEDED_PAIRS, Refined
from semviz_core.solving.search import Modes, apart

AMBIGUOUS_NATS = 14.0
"""Another pose within this of the best makes the answer ambiguous."""
SURE_PROBABILITY = 0.95
"""A pose to which a verifier gives less is no sure answer; takes the place of AMBIGUOUS_NATS."""
LIKELY_PROBABILITY = 0.5
"""A pose to which a verifier gives as much is an answer, if no sure one, however few pairs fit."""
LEAST_SUPPORT_NATS = 7.0
"""A pair that the others support less may be wrong,"""
OPEN_M = 0.3
"""and matters where the place is open to more than this without it."""
SURE_PAIRS = 4
"""Fewer that fit are no sure answer: of three, none is left to contradict a wrong one."""
LEAST_SHARE = 0.5
"""Share of the elements seen that must fit, of those that the submap could explain: a wrong place
explains a few by chance, seldom half."""
SURE_SIGMA_M = 1.0
"""A place less certain than this is no sure answer."""
CONTRADICTING_SIGMAS = 4.0
"""A pose further than this from a piece of the prior contradicts it."""


@dataclass(frozen=True)
class Verdict:
    status: Status
    reason: str
    """One sentence with numbers."""


def judge(
    modes: Modes,
    refined: Refined,
    observed: Elements2D,
    submap: Elements3D,
    prior: Prior,
    probability: FloatArray | None = None,
) -> Verdict:
    """Judge the refined first of ``modes``; ``probability`` (b,) is what a verifier gives them."""
    fit = refined.refinement
    fitting, explicable = int(fit.inlier.sum()), _explicable(observed, submap)
    half = int(np.ceil(LEAST_SHARE * explicable))
    needed = max(NEEDED_PAIRS, min(half, SURE_PAIRS))
    of_all = f"{fitting} of {len(observed)} elements"
    if explicable < len(observed):
        of_all += f" ({explicable} can be in the submap)"
    if fitting < needed and not is_likely(probability):
        return Verdict("cannot", f"Only {of_all} fit the best pose; {needed} needed.")
    sigma_m = float(np.sqrt(np.trace(refined.covariance[:3, :3])))
    doubts = (
        _rivals(modes, refined.T_camera_map) if probability is None else _unlikely(probability),
        *_contradictions(refined.T_camera_map, prior),
        _few(fitting, max(SURE_PAIRS, half), of_all),
        _hanging(fit, submap),
        _open(sigma_m),
    )
    for doubt in filter(None, doubts):
        return Verdict("ambiguous", doubt)
    return Verdict("ok", f"{of_all} fit, {sigma_m:.2f} m{_how_clear(modes, probability)}.")


def is_likely(probability: FloatArray | None) -> bool:
    """Whether a verifier (None for none) takes the first of (b,) modes to be rather right."""
    return probability is not None and bool(probability[0] >= LIKELY_PROBABILITY)


def _how_clear(modes: Modes, probability: FloatArray | None) -> str:
    if probability is not None:
        return f"; {probability[0]:.1%} sure"
    gap = modes.score[0] - modes.score
    return f"; the next pose is {gap[1]:.0f} nats worse" if len(gap) > 1 else ""


def _explicable(observed: Elements2D, submap: Elements3D) -> int:
    """How many observed elements the submap has enough elements of the right class for."""
    length = 1 + max(observed.class_id.max(initial=0), submap.class_id.max(initial=0))
    seen = np.bincount(observed.class_id, minlength=length)
    return int(np.minimum(seen, np.bincount(submap.class_id, minlength=length)).sum())


def _rivals(modes: Modes, T_camera_map: Pose) -> str:
    rivals = int((modes.score[0] - modes.score < AMBIGUOUS_NATS).sum())
    if rivals < 2:
        return ""
    away, angle = apart(
        T_camera_map.rotation, T_camera_map.translation, modes.rotation, modes.translation
    )
    first, second = modes.score[:2]
    count, which = ("Two", "") if rivals == 2 else (str(rivals), "the first two ")
    return (
        f"{count} poses fit: scores {first:.1f} and {second:.1f}, {which}{away[1]:.1f} m and "
        f"{np.rad2deg(angle[1]):.0f} deg apart."
    )


def _unlikely(probability: FloatArray) -> str:
    if probability[0] >= SURE_PROBABILITY:
        return ""
    next_best = f", the next one with {probability[1:].max():.0%}" if len(probability) > 1 else ""
    return f"The best pose is right with {probability[0]:.0%} only{next_best}."


def _contradictions(T_camera_map: Pose, prior: Prior) -> Iterator[str]:
    """Pieces of the prior that the pose is too far from."""
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


def _few(fitting: int, needed: int, of_all: str) -> str:
    return "" if fitting >= needed else f"Only {of_all} fit; {needed} are needed to be sure."


def hanging_pair(fit: Refinement) -> int | None:
    """Row of the pair that the answer hangs on while the others hardly support it, if any."""
    if fit.support is None or fit.open_m is None:
        return None
    weak = (fit.support < LEAST_SUPPORT_NATS) & (fit.open_m > OPEN_M)
    return int(np.argmax(np.where(weak, fit.open_m, 0.0))) if weak.any() else None


def _hanging(fit: Refinement, submap: Elements3D) -> str:
    row = hanging_pair(fit)
    if row is None or fit.open_m is None:
        return ""
    i, j = fit.pairs[row]
    open_m = fit.open_m[row]
    how = f"is open to {open_m:.1f} m" if np.isfinite(open_m) else "is not fixed"
    return (
        f"All hangs on one pair, element {i} seen with {submap.id[j]} mapped: without it the place "
        f"{how}, and the others do not confirm it."
    )


def _open(sigma_m: float) -> str:
    if sigma_m <= SURE_SIGMA_M:
        return ""
    return f"The pairs fix the position only to {sigma_m:.1f} m; {SURE_SIGMA_M:.0f} m is sure."
