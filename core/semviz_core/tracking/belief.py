"""The filter's state: a Gaussian over the pose AND the errors of map elements seen so far.

The error of a mapped element is the same in every frame. A filter that treats it as new noise
each time would, within a second, claim to be more accurate than the map. So the errors of the
elements seen are part of the state, as in SLAM with a map as prior. The covariance stays
consistent, and an element whose error the others reveal is corrected.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Belief, Odometry, adjoint
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

POSE = slice(0, 6)


@dataclass(frozen=True, eq=False)
class JointBelief:
    """A Gaussian over the pose and k mapped elements."""

    T_camera_map: Pose
    id: IntArray
    """(k,) of the mapped elements in the state."""
    error_m: FloatArray
    """(k, 6) estimated correction of their mapped anchors and ends."""
    covariance: FloatArray
    """(6 + 6k, 6 + 6k) of the left perturbation of T_camera_map (metres, radians), then of the
    errors (metres)."""

    @classmethod
    def start(cls, belief: Belief) -> "JointBelief":
        """Return the belief before any element is seen."""
        no_elements = np.zeros(0, dtype=np.int64)
        return cls(belief.T_camera_map, no_elements, np.zeros((0, 6)), belief.covariance)

    @property
    def pose(self) -> Belief:
        """The marginal of the pose."""
        own = self.covariance[POSE, POSE]
        return Belief(self.T_camera_map, 0.5 * (own + own.T))

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the position along its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.pose.covariance[:3, :3])[-1]))

    def moved(self, odometry: Odometry) -> "JointBelief":
        """Return the belief one step of odometry later."""
        A = adjoint(odometry.T_now_before)
        covariance = self.covariance.copy()
        covariance[POSE] = A @ covariance[POSE]
        covariance[:, POSE] = covariance[:, POSE] @ A.T
        covariance[POSE, POSE] += odometry.covariance
        return replace(
            self,
            T_camera_map=odometry.T_now_before @ self.T_camera_map,
            covariance=covariance,
        )

    def errors_m(self, id: IntArray) -> FloatArray:
        """Return the correction (n, 6) of anchors and ends of mapped elements; 0 if not seen."""
        row, known = self.rows(id)
        padded = self.error_m if len(self.id) else np.zeros((1, 6))
        return np.where(known[:, None], padded[row], 0.0)

    def cross_covariance(self, elements: Elements3D) -> tuple[FloatArray, FloatArray]:
        """Return (n, 6, 6) of pose with element, and (n, 6, 6) of each element's own error."""
        row, known = self.rows(elements.id)
        if not len(self.id):
            return np.zeros((len(row), 6, 6)), elements.covariance_m2
        columns = 6 + 6 * row[:, None] + np.arange(6)
        with_pose = np.swapaxes(self.covariance[POSE][:, columns], 0, 1)
        own = self.covariance[columns[:, :, None], columns[:, None, :]]
        inside = known[:, None, None]
        return np.where(inside, with_pose, 0.0), np.where(inside, own, elements.covariance_m2)

    def rows(self, id: IntArray) -> tuple[IntArray, BoolArray]:
        """Return the row (n,) of each id in the state, 0 if missing, and (n,) whether it is in."""
        equal = id[:, None] == self.id
        row = equal.argmax(axis=1) if len(self.id) else np.zeros(len(id), dtype=np.int64)
        return row, equal.any(axis=1)

    def including(self, elements: Elements3D) -> "JointBelief":
        """Return the belief with the errors of ``elements`` in the state."""
        new = elements[~self.rows(elements.id)[1]]
        size, k = len(self.covariance), len(new)
        covariance = np.zeros((size + 6 * k, size + 6 * k))
        covariance[:size, :size] = self.covariance
        for row in range(k):
            block = slice(size + 6 * row, size + 6 * row + 6)
            covariance[block, block] = new.covariance_m2[row]
        return replace(
            self,
            id=np.concatenate([self.id, new.id]),
            error_m=np.concatenate([self.error_m, np.zeros((k, 6))]),
            covariance=covariance,
        )

    def keeping(self, kept: BoolArray) -> "JointBelief":
        """Return the belief without the elements where ``kept`` (k,) is False (marginalized)."""
        index = np.concatenate([np.arange(6), *(6 + 6 * row + np.arange(6)
                                for row in np.flatnonzero(kept))])  # fmt: skip
        return replace(
            self,
            id=self.id[kept],
            error_m=self.error_m[kept],
            covariance=self.covariance[np.ix_(index, index)],
        )

    def shifted(self, step: FloatArray, covariance: FloatArray) -> "JointBelief":
        """Return the belief with its mean moved by ``step`` (6 + 6k,), and a new covariance."""
        return replace(
            self,
            T_camera_map=Pose.exp(step[POSE]) @ self.T_camera_map,
            error_m=self.error_m + step[6:].reshape(-1, 6),
            covariance=0.5 * (covariance + covariance.T),
        )

    def with_pose(self, pose: Belief) -> "JointBelief":
        """Return the belief after its pose was updated to ``pose``; correlated errors follow."""
        before = self.covariance[POSE, POSE]
        gain = np.linalg.solve(before, self.covariance[POSE]).T  # (6 + 6k, 6), identity on top
        step = (pose.T_camera_map @ self.T_camera_map.inverse()).log()
        reduction = gain @ (before - pose.covariance) @ gain.T
        return self.shifted(gain @ step, self.covariance - reduction)
