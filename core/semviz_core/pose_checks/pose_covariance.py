"""The errors of the poses that are used: given ones, and refined ones among them.

A refined pose follows from the motions measured around it and from the given poses that hold them,
so its error is correlated with theirs: of one estimate H x = W e + J^T M m, with errors e of given
poses, m of motions, and information W and M in it.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import splu

from semviz_core.base.frame import adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.pose_checks.comparison import PoseComparison
from semviz_core.pose_checks.refinement import PoseRefinement, block_tridiagonal
from semviz_core.pose_checks.variance_components import variance_components

REACH_FRAMES = 40
"""Given poses that are further away do not count in a refined one."""


@dataclass(frozen=True, eq=False)
class PoseCovariance:
    """Covariance of the errors of n poses, each given or refined.

    Errors are right perturbations of T_map_camera, in camera axes: m, then rad. Those of given
    poses are independent.
    """

    frame_index: IntArray
    """(n,) ascending"""
    refined: BoolArray
    """(n,) which frames use the refined pose"""
    given_variance: FloatArray
    """(6,) of a given pose"""
    given_weight: FloatArray
    """(n, 6) information of each given pose in the refinement; 0 where it is wrong"""
    diagonal: FloatArray
    """(n, 6, 6) of the refinement's normal equations"""
    upper: FloatArray
    """(n - 1, 6, 6) of the same, beside the diagonal"""

    @classmethod
    def of(
        cls,
        frame_index: IntArray,
        refined: Collection[int],
        refinement: PoseRefinement,
        comparison: PoseComparison,
    ) -> "PoseCovariance":
        """Return that of the poses if the frames ``refined`` use theirs of ``refinement``.

        Errors of given poses and of motions are as large as the pairs of frames show, but for
        those whose given pose is wrong and replaced.
        """
        is_refined = np.isin(frame_index, list(refined))
        replaced = is_refined & ~refinement.held
        shown = comparison.compared & ~(replaced[:-1] | replaced[1:])
        known = variance_components(comparison, shown)
        information = comparison.information_given(refinement.held, known.motion_share)
        weight = refinement.held[:, None] / refinement.good_sigma**2
        diagonal = (weight + 1e-6)[:, :, None] * np.eye(6)
        upper = np.zeros((max(len(frame_index) - 1, 0), 6, 6))
        R, t = refinement.poses.motions()
        for row in np.flatnonzero(comparison.compared).tolist():
            A, J = information[row], adjoint(Pose(R[row], t[row]))
            diagonal[row] += J.T @ A @ J
            diagonal[row + 1] += A
            upper[row] -= J.T @ A
        return cls(frame_index, is_refined, known.pose_sigma**2, weight, diagonal, upper)

    def at(self, rows: IntArray) -> FloatArray:
        """Return the covariance (6 m, 6 m) of the poses in rows (m,)."""
        given = ~np.repeat(self.refined[rows], 6)
        alone = np.diag(np.tile(self.given_variance, len(rows)) * given)
        if given.all():
            return alone
        near = self._near(rows)
        chosen = (6 * (rows - near.start)[:, None] + np.arange(6)).ravel()
        columns = np.zeros((6 * (near.stop - near.start), len(chosen)))
        columns[chosen, np.arange(len(chosen))] = 1.0
        H = block_tridiagonal(self.diagonal[near], self.upper[near.start : near.stop - 1])
        gain = splu(H.tocsc()).solve(columns)  # of H^-1
        weight = self.given_weight[near]
        ratio = (weight * self.given_variance).ravel()  # of the true variance to the assumed one
        both = gain[chosen] + gain.T @ ((weight.ravel() * (ratio - 1.0))[:, None] * gain)
        across = ratio[chosen, None] * gain[chosen] * (given[:, None] & ~given)
        return np.asarray(both * ~(given[:, None] | given) + across + across.T + alone)

    def _near(self, rows: IntArray) -> slice:
        """Return the frames around rows (m,) whose given poses count in theirs."""
        held = np.cumsum(self.given_weight.any(axis=1))
        first, last = held[rows.min()] - REACH_FRAMES, held[rows.max()] + REACH_FRAMES
        return slice(*np.searchsorted(held, [first, last + 1]).tolist())
