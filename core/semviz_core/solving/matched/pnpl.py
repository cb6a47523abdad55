"""The paper's pose refinement: weighted PnPL (eq. 6-7), and direct PnPL (eq. 8) with a Boolean P.

As in the paper, but in float64: 1 - cos of small angles has no digits left in float32. It is kept
for comparison; ``least_squares`` does better:
- f_l holds one point of each line, a metre below the peak, to the observed plane, which is about
  half of what a line says;
- all pairs count, however wrong: with a soft P over many elements the wrong ones win.
Peaks enter f_p, where known on both sides: eq. 7 sums f_p over all m and n elements and f_l over
the m2 and n2 lines among them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.arrays import FloatArray, float_array
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose, so3_exp, so3_left_jacobian, so3_log
from semviz_core.solving.matched.matches import Matches

ITERATIONS = 200


@dataclass(frozen=True, eq=False)
class PnplFit:
    """The pose at the optimum of eq. 6 or 8."""

    T_camera_map: Pose
    cost: float
    iterations: int


@dataclass(frozen=True, eq=False)
class Objective:
    """f_p + f_l (eq. 7) over axis-angle and translation."""

    weight: FloatArray  # (p,) the P of each point pair
    ray: FloatArray  # (p, 3) f
    point_m: FloatArray  # (p, 3)
    line_weight: FloatArray  # (l,) the P of each line pair
    normal: FloatArray  # (l, 3) unit f x v_2d
    line_point_m: FloatArray  # (l, 3) p + v_3d

    @classmethod
    def of(cls, matches: Matches, weight: FloatArray, origin_m: FloatArray) -> "Objective":
        """With map coordinates about ``origin_m`` (3,) and the P (k,) of each match."""
        line, point = matches.is_line, matches.known()[:, 0]
        (first, last), (anchor, end) = matches.rays(), matches.points_m()
        down, _ = _unit(end - anchor)
        normal, _ = _unit(np.cross(first, last))
        return cls(
            weight[point],
            first[point],
            anchor[point] - origin_m,
            weight[line],
            normal[line],
            (anchor + down - origin_m)[line],
        )

    def __call__(self, parameters: FloatArray) -> tuple[float, FloatArray]:
        """Cost and gradient (6,) at ``parameters`` (6,): axis-angle (rad), translation (m)."""
        rotvec, translation = parameters[:3], parameters[3:]
        R = so3_exp(rotvec)
        turned = self.point_m @ R.T, self.line_point_m @ R.T
        u, distance = _unit(turned[0] + translation)
        cosine = (self.ray * u).sum(axis=1)
        f_p = float(self.weight @ (1.0 - cosine))
        by_point = -self.weight[:, None] * (self.ray - cosine[:, None] * u) / distance

        u, distance = _unit(turned[1] + translation)
        sine = (self.normal * u).sum(axis=1)
        norm = np.sqrt(np.maximum(1.0 - sine**2, 1e-12))  # |n x u|
        f_l = float(self.line_weight @ (1.0 - norm))
        slope = (self.line_weight * sine / norm)[:, None]
        by_line = slope * (self.normal - sine[:, None] * u) / distance

        turn = np.cross(turned[0], by_point).sum(axis=0) + np.cross(turned[1], by_line).sum(axis=0)
        move = by_point.sum(axis=0) + by_line.sum(axis=0)
        return f_p + f_l, np.concatenate([so3_left_jacobian(rotvec).T @ turn, move])


def paper_pnpl(matches: Matches, P: ArrayLike, T_camera_map: Pose) -> PnplFit:
    """Minimize eq. 6 from ``T_camera_map`` with L-BFGS.

    ``P`` (k,) holds the entry of the paper's P for each match, all others being 0: probabilities
    for eq. 6, zeros and ones for eq. 8.
    """
    from scipy.optimize import minimize

    weight = float_array(P, (len(matches),), "P")
    total = float(weight.sum())
    if (weight < 0.0).any() or total == 0.0:
        raise SemvizError("P holds negative numbers or zeros only; give probabilities")
    # about the elements' middle, so that axis-angle and translation hardly depend on each other
    middle = matches.points_m()[0].mean(axis=0)
    objective = Objective.of(matches, weight / total, middle)

    def scaled(parameters: FloatArray) -> tuple[float, FloatArray]:
        cost, gradient = objective(parameters)
        return cost * _SCALE, gradient * _SCALE

    start = np.concatenate([so3_log(T_camera_map.rotation), T_camera_map.apply(middle)])
    found = minimize(
        scaled, start, jac=True, method="L-BFGS-B",
        options={"maxiter": ITERATIONS, "ftol": 1e-14, "gtol": 1e-9},
    )  # fmt: skip
    R = so3_exp(found.x[:3])
    pose = Pose(R, found.x[3:] - R @ middle)
    return PnplFit(pose, float(found.fun) / _SCALE * total, int(found.nit))


_SCALE = 1e4
"""1 - cos of pixels is tiny: the stopping rules of L-BFGS are made for costs about 1."""


def _unit(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    length = np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    return vectors / length, length
