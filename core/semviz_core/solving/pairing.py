"""What is supposed of who is who before anything is solved: pairs that must be, and cannot be."""

from dataclasses import dataclass, field

import numpy as np

from semviz_core.arrays import IntArray, int_array
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.errors import SemvizError
from semviz_core.localization import Refinement
from semviz_core.solving.scene import Scene

SURELY_REAL_NATS = 200.0
"""By so much less a detection of a forced pair is likely to be false: poses that leave it out are
no rivals of one that does not."""


def _no_pairs() -> IntArray:
    return np.empty((0, 2), dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Pairing:
    """Pairs as (k, 2) rows (observed, submap). Every other pair is as free as it was."""

    forced: IntArray = field(default_factory=_no_pairs)
    """Are one thing, whatever their classes: neither of the two can be anything else, and a pose
    under which they do not fit is no answer."""
    forbidden: IntArray = field(default_factory=_no_pairs)
    """Are two things."""

    def __post_init__(self) -> None:
        for name in ("forced", "forbidden"):
            rows = int_array(getattr(self, name), (None, 2), f"pairing: {name}")
            object.__setattr__(self, name, rows)
        for column, what in enumerate(("observed", "submap")):
            if len(np.unique(self.forced[:, column])) < len(self.forced):
                raise SemvizError(f"pairing: forced names one row of {what} twice; give it once")
        if (self.forced[:, None] == self.forbidden).all(axis=2).any():
            raise SemvizError("pairing: one pair is both forced and forbidden; choose")

    def check(self, observed: Elements2D, submap: Elements3D) -> None:
        """SemvizError where rows do not exist, or a pole is to be a sign."""
        pairs = np.concatenate([self.forced, self.forbidden])
        sides = (("observed", len(observed)), ("submap", len(submap)))
        for (name, count), rows in zip(sides, pairs.T, strict=True):
            if ((rows < 0) | (rows >= count)).any():
                raise SemvizError(f"pairing names rows that {name} with {count} elements lacks")
        i, j = self.forced.T
        odd = np.flatnonzero(observed.is_line[i] != submap.is_line[j])
        if len(odd):
            pair = tuple(self.forced[odd[0]].tolist())
            raise SemvizError(f"pairing: forced pair {pair} joins a pole and a sign; leave it out")

    def applied(self, scene: Scene) -> Scene:
        """The scene with what is supposed; without pairs, one that is equal."""
        (i, j), possible = self.forced.T, scene.compatible.copy()
        possible[i], possible[:, j] = False, False
        possible[i, j] = True
        possible[tuple(self.forbidden.T)] = False
        supposed = scene.only(possible)
        supposed.seen["clutter"][i, 0] -= SURELY_REAL_NATS
        return supposed

    def unmet(self, fit: Refinement, submap: Elements3D) -> str:
        """Which forced pairs an answer does not fit, in one sentence; empty where it fits all."""
        fitting = {(int(i), int(j)) for i, j in fit.pairs[fit.inlier]}
        missing = [(i, j) for i, j in self.forced.tolist() if (i, j) not in fitting]
        if not missing:
            return ""
        i, j = missing[0]
        return (
            f"{len(missing)} of {len(self.forced)} forced pairs fit no pose that enough others do, "
            f"first element {i} seen with {submap.id[j]} mapped."
        )
