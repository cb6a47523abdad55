"""Whether a pose can be relied on, and in which words."""

from dataclasses import dataclass

import numpy as np

from semviz_core.elements import Elements2D, Elements3D
from semviz_core.localization import Status
from semviz_core.solving.refine import NEEDED_PAIRS, Refined
from semviz_core.solving.search import Modes, apart

AMBIGUOUS_NATS = 12.0
"""Another pose within this of the best makes the answer ambiguous. Chosen on seeds 0 to 79 of every
suite of bench/localize.py as the smallest gap without a wrong ``ok``; at 20 sparse scenes lose a
further eighth of their answers."""
LEAST_SHARE = 0.5
"""Share of the elements seen that must fit, of those that the submap could explain: a wrong place
explains a few by chance, seldom half."""
LEAST_WITH_UNMAPPED = 5
"""Elements that must fit where some of those seen cannot be in the submap. With 4, one place in a
hundred 60 m from the fix was taken for the right one."""


@dataclass(frozen=True)
class Verdict:
    status: Status
    reason: str
    """One sentence with numbers."""


def judge(modes: Modes, refined: Refined, observed: Elements2D, submap: Elements3D) -> Verdict:
    """Judge the refined best of ``modes``."""
    seen, explicable = len(observed), _explicable(observed, submap)
    fitting = int(refined.refinement.inlier.sum())
    if fitting < NEEDED_PAIRS:
        return Verdict("cannot", f"{fitting} of {seen} elements fit, {NEEDED_PAIRS} needed.")
    needed = int(np.ceil(LEAST_SHARE * explicable))
    if explicable < seen:  # the prior may be far off: then few agree by chance more easily
        needed = max(needed, LEAST_WITH_UNMAPPED)
    if fitting < needed:
        mapped = "" if explicable == seen else f" ({explicable} can be in the submap)"
        return Verdict(
            "cannot",
            f"Only {fitting} of {seen} elements{mapped} fit the best pose; {needed} needed.",
        )
    T = refined.T_camera_map
    away, angle = apart(T.rotation, T.translation, modes.rotation, modes.translation)
    gap = modes.score[0] - modes.score
    rivals = int((gap < AMBIGUOUS_NATS).sum())
    if rivals > 1:
        first, second = modes.score[:2]
        count = "Two" if rivals == 2 else str(rivals)
        between = f"{away[1]:.1f} m" if away[1] > 0.05 else f"{np.rad2deg(angle[1]):.1f} deg"
        which = "" if rivals == 2 else "the first two "
        return Verdict(
            "ambiguous",
            f"{count} poses fit: scores {first:.1f} and {second:.1f}, {which}{between} apart.",
        )
    sigma = float(np.sqrt(np.trace(refined.covariance[:3, :3])))
    next_best = f"; the next pose is {gap[1]:.0f} nats worse" if len(gap) > 1 else ""
    return Verdict("ok", f"{fitting} of {seen} elements fit, {sigma:.2f} m{next_best}.")


def _explicable(observed: Elements2D, submap: Elements3D) -> int:
    """How many observed elements the submap has enough elements of the right class for."""
    classes = np.union1d(observed.class_id, submap.class_id)
    seen = (observed.class_id[:, None] == classes).sum(axis=0)
    mapped = (submap.class_id[:, None] == classes).sum(axis=0)
    return int(np.minimum(seen, mapped).sum())
