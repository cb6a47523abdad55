"""What localizing one frame gives: the answer, and every step towards it."""

from dataclasses import dataclass, field
from typing import Literal

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.pose import Pose

Status = Literal["ok", "ambiguous", "cannot"]


@dataclass(frozen=True, eq=False)
class Match:
    """Soft correspondences between m observed and n mapped elements."""

    cost: FloatArray
    """(m, n) what the matcher minimized; inf where a pair is impossible (classes differ)."""
    probability: FloatArray
    """(m + 1, n + 1); the last row and column are the dustbins (not in the map, not seen).

    Rows i < m and columns j < n sum to 1. The corner is 0.
    """
    order: IntArray
    """(k, 2) pairs (i, j) in the order in which the solver prefers them."""


@dataclass(frozen=True, eq=False)
class Search:
    """The coarse stage: candidate poses and how well each explains the image."""

    hypotheses: int
    """How many were tried."""
    T_camera_map: tuple[Pose, ...]
    """The best distinct ones, best first."""
    score: FloatArray
    """(len(T_camera_map),) log-likelihoods (nats), larger is better."""
    passed: int | None = None
    """How many of those tried agree with the prior; None in runs of older versions."""
    mapped: IntArray | None = None
    """(len(T_camera_map), m) row of the submap that each observed row is taken for under each pose,
    -1 for none; None in runs of older versions."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """The fine stage: pairs, residuals and the way to the optimum."""

    pairs: IntArray
    """(k, 2) one-to-one pairs (row of observed, row of submap)."""
    residual_px: FloatArray
    """(k, 2) detection minus projection: across and along the element (u and v for points);
    NaN along a pole none of whose ends are known on both sides."""
    chi2: FloatArray
    """(k,) squared residual over its covariance."""
    inlier: BoolArray
    """(k,) by the one definition in semviz_core.solving.residuals."""
    cost_trace: FloatArray
    """(iterations + 1,) cost at the start and after each step."""
    support: FloatArray | None = None
    """(k,) nats by which each pair is likelier than a false detection under the pose of the others
    alone; None in sequences, where frames before support it too, and in runs of older versions."""
    open_m: FloatArray | None = None
    """(k,) how far the camera's place moves, or is uncertain, without each pair."""
    steps: FloatArray | None = None
    """(iterations, 2) how far each step moved (m) and turned (rad) the camera, 0 where it was not
    taken; None in sequences, and in runs of older versions."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another pose that explains the image, and how much worse."""

    T_camera_map: Pose
    score: float
    """Log-likelihood (nats), comparable with the answer's in Search.score."""


@dataclass(frozen=True, eq=False)
class Localization:
    """The answer for one frame and how it came about. Stages not reached are None."""

    method: str
    camera: Camera
    prior: Prior
    observed: Elements2D
    submap: Elements3D
    status: Status
    reason: str
    """One sentence in plain words, with numbers; never empty."""
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
