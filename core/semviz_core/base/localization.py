"""The result of localizing one frame, with all intermediate steps.

It holds the pose or the reason why there is none, the match probabilities, the search's candidate
poses, the refinement's iterations and the alternatives. Stages not reached are None.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

Status = Literal["ok", "ambiguous", "cannot"]


@dataclass(frozen=True, eq=False)
class Match:
    """Soft correspondences between m observed and n mapped elements."""

    cost: FloatArray
    """(m, n) the matcher's cost; inf if a pair is impossible (classes differ)."""
    probability: FloatArray
    """(m + 1, n + 1); the last row and column are the dustbins (not in the map, not observed).

    Rows i < m and columns j < n sum to 1. The corner is 0.
    """
    order: IntArray
    """(k, 2) pairs (i, j) in the solver's order of preference."""


@dataclass(frozen=True, eq=False)
class Search:
    """The coarse stage: candidate poses and how well each explains the image."""

    hypotheses: int
    """Number of poses evaluated."""
    T_camera_map: tuple[Pose, ...]
    """The best distinct poses, best first."""
    score: FloatArray
    """(len(T_camera_map),) log-likelihoods (nats), larger is better."""
    passed: int | None = None
    """Number of evaluated poses that agree with the prior; None in runs of older versions."""
    mapped: IntArray | None = None
    """(len(T_camera_map), m) row of the submap that each pose associates with each observed row,
    -1 for none; None in runs of older versions."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """The fine stage: pairs, residuals and the optimizer's iterations."""

    pairs: IntArray
    """(k, 2) one-to-one pairs (row of observed, row of submap)."""
    residual_px: FloatArray
    """(k, 2) detection minus projection: across and along the element (u and v for points). NaN
    along a pole without an end that is known in both image and map."""
    chi2: FloatArray
    """(k,) squared residual over its covariance."""
    inlier: BoolArray
    """(k,) as defined in ``semviz_core.localization.residuals``."""
    cost_trace: FloatArray
    """(iterations + 1,) cost at the start and after each step."""
    support: FloatArray | None = None
    """(k,) nats by which each pair is likelier than a false detection, under the pose of the other
    pairs. None in sequences, where earlier frames support the pose too, and in runs of older
    versions."""
    open_m: FloatArray | None = None
    """(k,) how far the camera centre moves, or is uncertain, without each pair."""
    steps: FloatArray | None = None
    """(iterations, 2) how far each step moved (m) and rotated (rad) the camera, 0 if the step was
    rejected; None in sequences and in runs of older versions."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another pose that explains the image, and its score."""

    T_camera_map: Pose
    score: float
    """Log-likelihood (nats), comparable with ``Search.score``."""


@dataclass(frozen=True, eq=False)
class Localization:
    """The result for one frame, with all stages. Stages not reached are None."""

    method: str
    camera: Camera
    prior: Prior | None
    """None: the frame had no fix."""
    observed: Elements2D
    submap: Elements3D
    status: Status
    reason: str
    """One plain sentence with numbers; never empty."""
    T_camera_map: Pose | None
    """None exactly when status is ``cannot``."""
    covariance: FloatArray | None
    """(6, 6) of the left perturbation of T_camera_map: metres, then radians."""
    match: Match | None = None
    search: Search | None = None
    refinement: Refinement | None = None
    alternatives: tuple[Alternative, ...] = ()
    time_ms: dict[str, float] = field(default_factory=dict)
    """Wall time of each stage, in order."""

    def __post_init__(self) -> None:
        if (self.T_camera_map is None) != (self.status == "cannot"):
            raise ValueError("a localization has a pose exactly when its status is not 'cannot'")

    def _repr_html_(self) -> str:
        """Show status, reason and image plane in a notebook."""
        from semviz_core.base.notebook import localization_html

        return localization_html(self)

    @property
    def given_prior(self) -> Prior:
        """The prior, for methods that search around one. Raise SemvizError without one."""
        if self.prior is None:
            raise SemvizError("the frame has no prior, so there is no place to search; give one")
        return self.prior

    @property
    def around_m(self) -> FloatArray:
        """(3,) where the frame is, as far as known: the estimate's camera centre, else the prior,
        else the middle of the submap, else the map's origin."""
        if self.T_camera_map is not None:
            return self.T_camera_map.inverse().translation
        if self.prior is not None:
            return self.prior.position_m
        return np.asarray(self.submap.anchor_m.mean(axis=0)) if len(self.submap) else np.zeros(3)
