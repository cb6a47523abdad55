"""Scored candidate matches, validated and stored as arrays for the solvers.

It also recognizes sets of matches from which no pose can follow.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, float_array, int_array
from semviz_core.common.errors import SemvizError
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.refinement import degeneracy_reason

NEEDED_PAIRS = 3
"""Two poles fix a pose; a third element is the first that can contradict them."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A pose estimated from matches."""

    T_camera_map: Pose
    covariance: FloatArray
    """(6, 6) of the left perturbation of T_camera_map: metres, then radians."""
    pairs: IntArray
    """(k, 2) the given matches."""
    inlier: BoolArray
    """(k,) which of them the pose explains, one-to-one."""
    hypotheses: int
    """Number of poses evaluated."""


@dataclass(frozen=True, eq=False)
class Matches:
    """k candidate pairs with their scores."""

    observed: Elements2D
    submap: Elements3D
    camera: Camera
    detector: DetectorModel | None
    pairs: IntArray
    """(k, 2) row of observed, row of submap."""
    score: FloatArray
    """(k,) in [0, 1]."""

    @classmethod
    def checked(
        cls,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        pairs: ArrayLike,
        score: ArrayLike,
        detector: DetectorModel | None = None,
    ) -> "Matches":
        """Return the matches. Raise SemvizError if pairs or scores are impossible."""
        rows = int_array(pairs, (None, 2), "pairs")
        scores = float_array(score, (len(rows),), "score")
        if ((scores < 0.0) | (scores > 1.0)).any():
            raise SemvizError("score holds numbers outside [0, 1]; give probabilities")
        sides = (("observed", len(observed)), ("submap", len(submap)))
        for column, (name, count) in zip(rows.T, sides, strict=True):
            if ((column < 0) | (column >= count)).any():
                raise SemvizError(f"pairs name rows that {name} with {count} elements lacks")
        if len(np.unique(rows, axis=0)) != len(rows):
            raise SemvizError("pairs holds the same pair twice; give each once")
        i, j = rows.T
        same = observed.class_id[i] == submap.class_id[j]
        wrong = np.flatnonzero(~same | (observed.is_line[i] != submap.is_line[j]))
        if len(wrong):
            pair = tuple(rows[wrong[0]].tolist())
            raise SemvizError(f"pair {pair} joins elements of different classes; leave it out")
        return cls(observed, submap, camera, detector, rows, scores)

    def __len__(self) -> int:
        return len(self.pairs)

    def problem(self, sigma_px: float = 0.0) -> PoseProblem:
        """Return the problem that allows only these pairs, detections blurred by ``sigma_px``."""
        sigma = np.hypot(self.observed.sigma_px, sigma_px)
        blurred = replace(self.observed, sigma_px=sigma)
        problem = PoseProblem.of(self.camera, blurred, self.submap, self.detector)
        possible = np.zeros_like(problem.compatible)
        possible[tuple(self.pairs.T)] = True
        return problem.only(possible)

    @property
    def is_line(self) -> BoolArray:
        """(k,) True for poles."""
        return self.observed.is_line[self.pairs[:, 0]]

    def known(self) -> BoolArray:
        """Return (k, 2) whether peak (or center) and bottom are points known on both sides."""
        (i, j), seen, mapped = self.pairs.T, self.observed, self.submap
        anchor = ~self.is_line | (seen.anchor_known[i] & mapped.anchor_known[j])
        return np.column_stack([anchor, seen.end_known[i] & mapped.end_known[j]])

    def rays(self) -> tuple[FloatArray, FloatArray]:
        """Return unit rays (k, 3) through observed anchors and ends (a point's end: its anchor)."""
        i, seen = self.pairs[:, 0], self.observed
        end = np.where(seen.is_line[:, None], seen.end_px, seen.anchor_px)
        return self.camera.bearing(seen.anchor_px)[i], self.camera.bearing(end)[i]

    def points_m(self) -> tuple[FloatArray, FloatArray]:
        """Return mapped anchors and ends (k, 3) (a point's end: its anchor)."""
        j, mapped = self.pairs[:, 1], self.submap
        end = np.where(mapped.is_line[:, None], mapped.end_m, mapped.anchor_m)
        return mapped.anchor_m[j], end[j]

    def conflicts(self) -> BoolArray:
        """Return (k, k) whether two matches share an element; each match shares its own."""
        i, j = self.pairs.T
        return np.asarray((i[:, None] == i) | (j[:, None] == j))


def unsolvable_reason(matches: Matches) -> str:
    """Return why no pose can follow from these matches, in one sentence; empty if one may."""
    if not len(matches):
        return "No matches are given."
    seen, mapped = (len(np.unique(column)) for column in matches.pairs.T)
    if min(seen, mapped) < NEEDED_PAIRS:
        return (
            f"The matches join {seen} seen and {mapped} mapped elements; "
            f"{NEEDED_PAIRS} of each are needed."
        )
    return degeneracy_reason(*matches.points_m(), matches.known())
