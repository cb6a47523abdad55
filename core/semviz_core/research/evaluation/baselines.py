"""Solvers of other libraries and the paper's back end, on the same matches.

Every baseline gets the matches best first. Its threshold and options were chosen for success on
tuning seeds at 1 px detection noise, and are documented with it. None of them estimates a
covariance.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.pose import Pose, nearest_rotation, so3_exp
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import require_extra
from semviz_core.localization.least_squares import information
from semviz_core.localization.matched import Failure, MatchedMethodName, localize_matches
from semviz_core.localization.matched.matches import Matches
from semviz_core.localization.matched.p3p_ransac import p3p_ransac, paper_pnpl
from semviz_core.research.evaluation.methods import MatchedMethod, Method, MethodResult
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem

if TYPE_CHECKING:
    from semviz_core.research.evaluation.methods import MatchedProblem

NEEDED_POINTS = 4
"""Three to solve and one to choose among up to four solutions."""
FARTHEST_M = 1e9
GPS_SIGMAS = 3.0
DETECTION_RANGE_M = 40.0


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Matches as point and line correspondences, best first; pixels without distortion."""

    camera: Camera
    pixel_px: FloatArray  # (p, 2) peaks, middles and bottoms known on both sides
    point_m: FloatArray  # (p, 3)
    line_px: tuple[FloatArray, FloatArray]  # (l, 2) both ends of observed poles
    line_m: tuple[FloatArray, FloatArray]  # (l, 3) peaks and bottoms

    @classmethod
    def of(
        cls, problem: LocalizationProblem, pairs: IntArray, score: FloatArray
    ) -> "Correspondences":
        order = np.argsort(-score, kind="stable")
        matches = Matches.checked(
            problem.observed, problem.submap, problem.camera, pairs[order], score[order]
        )
        line, (row, end) = matches.is_line, np.nonzero(matches.known())
        pixel, point = np.stack(_pixels(matches)), np.stack(matches.points_m())
        return cls(
            problem.camera,
            pixel[end, row],
            point[end, row],
            (pixel[0, line], pixel[1, line]),
            (point[0, line], point[1, line]),
        )


def _pixels(matches: Matches) -> list[FloatArray]:
    """Return pixels (k, 2) of observed anchors and of ends, without distortion."""
    homogeneous = [ray / ray[:, 2:] @ matches.camera.K.T for ray in matches.rays()]
    return [pixels[:, :2] for pixels in homogeneous]


BaselinePose = tuple[FloatArray, FloatArray] | None
"""Rotation (3, 3) and translation (3,) of T_camera_map; None if the library finds none."""


@dataclass(frozen=True)
class Baseline:
    """A library's solver as a method for given matches; only the solver is timed."""

    name: str
    solver: Callable[[Correspondences], BaselinePose]
    with_prior: bool = False

    def solve(self, problem: "MatchedProblem") -> MethodResult:
        return self.solve_pairs(problem.problem, problem.pairs, problem.score)

    def solve_pairs(
        self, problem: LocalizationProblem, pairs: IntArray, score: FloatArray
    ) -> MethodResult:
        correspondences = Correspondences.of(problem, pairs, score)
        if len(correspondences.pixel_px) < NEEDED_POINTS:
            reason = (
                f"{len(correspondences.pixel_px)} matched points are known, {NEEDED_POINTS} needed."
            )
            return MethodResult(None, None, "cannot", reason)
        start = perf_counter()
        solution = self.solver(correspondences)
        time_ms = {"solve": (perf_counter() - start) * 1e3}
        if solution is None or not _is_pose(*solution):
            return MethodResult(None, None, "cannot", f"{self.name} found no pose.", time_ms)
        pose = Pose(nearest_rotation(solution[0]), solution[1])
        return MethodResult(pose, None, "ok", f"{self.name} found a pose.", time_ms)


def _is_pose(rotation: FloatArray, translation: FloatArray) -> bool:
    """Return whether a pose is finite and plausible: libraries also return NaN and huge values."""
    return bool(np.isfinite(rotation).all() and np.linalg.norm(translation) < FARTHEST_M)


@dataclass(frozen=True)
class AllPairs:
    """A baseline on whole frames, with every pair that classes and the prior allow."""

    baseline: Baseline

    @property
    def name(self) -> str:
        return self.baseline.name

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        pairs = possible_pairs(problem)
        return self.baseline.solve_pairs(problem, pairs, np.full(len(pairs), 0.5))


def possible_pairs(problem: LocalizationProblem) -> IntArray:
    """Return pairs (k, 2) of one class whose mapped element can be in view near the prior."""
    prior = problem.prior
    off = problem.submap.anchor_m[:, :2] - prior.position_m[:2]
    reach = GPS_SIGMAS * prior.horizontal_sigma_m + DETECTION_RANGE_M
    near = np.hypot(off[:, 0], off[:, 1]) < reach
    same = problem.observed.class_id[:, None] == problem.submap.class_id
    return np.argwhere(same & near)


@dataclass(frozen=True)
class SemvizMatched:
    """``localize_matches``; only ``minimal`` uses the prior."""

    name: str
    method: MatchedMethodName
    with_prior: bool = False
    detector: DetectorModel = DETECTOR
    seed: int = 0

    def solve(self, problem: "MatchedProblem") -> MethodResult:
        frame = problem.problem
        start = perf_counter()
        estimate = localize_matches(
            frame.observed, frame.submap, frame.camera, problem.pairs, problem.score,
            prior=frame.prior if self.with_prior else None,
            method=self.method, seed=self.seed, detector=self.detector,
        )  # fmt: skip
        time_ms = {"solve": (perf_counter() - start) * 1e3}
        if isinstance(estimate, Failure):
            return MethodResult(None, None, "cannot", estimate.reason, time_ms)
        reason = f"{int(estimate.inlier.sum())} of {len(estimate.pairs)} matches agree."
        return MethodResult(estimate.T_camera_map, estimate.covariance, "ok", reason, time_ms)


@dataclass(frozen=True)
class PaperBackEnd:
    """The paper's P3P-RANSAC and PnPL (eq. 5-8) with the true, Boolean P.

    A reference, not a method: it uses the ground truth.
    """

    name: str = "paper with true P"
    seed: int = 0

    def solve(self, problem: LocalizationProblem) -> MethodResult:
        start = perf_counter()
        matches = Matches.checked(
            problem.observed, problem.submap, problem.camera,
            problem.pairs, np.ones(len(problem.pairs)),
        )  # fmt: skip
        coarse = p3p_ransac(matches, self.seed)
        if isinstance(coarse, Failure):
            return MethodResult(None, None, "cannot", coarse.reason, _since(start))
        pose = paper_pnpl(matches, matches.score, coarse.T_camera_map).T_camera_map
        time_ms = _since(start)
        fisher = information(matches.problem(), None, pose, problem.pairs)
        is_fixed = bool(np.linalg.eigvalsh(fisher)[0] > 1e-6)
        covariance = np.asarray(np.linalg.inv(fisher), np.float64) if is_fixed else None
        return MethodResult(pose, covariance, "ok", f"{len(problem.pairs)} true pairs.", time_ms)


def poselib_points(matches: Correspondences) -> BaselinePose:
    """LO-RANSAC of PoseLib on points: 8 px, PROSAC by score, loss of 3 px."""
    import poselib

    pose, report = poselib.estimate_absolute_pose(
        matches.pixel_px, matches.point_m, _pinhole(matches.camera),
        {"max_reproj_error": 8.0, "progressive_sampling": True}, {"loss_scale": 3.0},
    )  # fmt: skip
    return (pose.R, pose.t) if report["num_inliers"] >= NEEDED_POINTS else None


def poselib_points_lines(matches: Correspondences) -> BaselinePose:
    """LO-RANSAC of PoseLib on points and poles' lines: 8 px, loss of 3 px. Not repeatable."""
    import poselib

    pose, report = poselib.estimate_absolute_pose_pnpl(
        matches.pixel_px, matches.point_m, *matches.line_px, *matches.line_m,
        _pinhole(matches.camera), {"max_reproj_error": 8.0}, {"loss_scale": 3.0},
    )  # fmt: skip
    return (pose.R, pose.t) if report["num_inliers"] >= NEEDED_POINTS else None


def opencv_ap3p(matches: Correspondences) -> BaselinePose:
    """OpenCV's RANSAC with AP3P, 8 px, 10000 iterations, then LM over its inliers."""
    import cv2

    return _opencv(matches, cv2.SOLVEPNP_AP3P)


def opencv_usac(matches: Correspondences) -> BaselinePose:
    """OpenCV's USAC with PROSAC by score, 8 px, 10000 iterations, then LM over its inliers.

    On tuning seeds better than USAC's default, accurate, fast and MAGSAC modes.
    """
    import cv2

    return _opencv(matches, cv2.USAC_PROSAC)


def pycolmap_points(matches: Correspondences) -> BaselinePose:
    """COLMAP's LO-RANSAC on points and refinement: 6 px, loss of 3 px."""
    import pycolmap

    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = 6.0
    estimation.ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.loss_function_scale = 3.0
    camera = pycolmap.Camera(**_pinhole(matches.camera))
    result = pycolmap.estimate_and_refine_absolute_pose(
        matches.pixel_px, matches.point_m, camera, estimation, refinement
    )
    if result is None:
        return None
    pose = result["cam_from_world"]
    return pose.rotation.matrix(), pose.translation


def _opencv(matches: Correspondences, flags: int) -> BaselinePose:
    import cv2

    cv2.setRNGSeed(0)
    points, pixels, K = matches.point_m, matches.pixel_px, matches.camera.K
    ok, rotvec, translation, inlier = cv2.solvePnPRansac(
        points, pixels, K, None, flags=flags,
        reprojectionError=8.0, iterationsCount=10_000, confidence=0.9999,
    )  # fmt: skip
    if not ok or inlier is None or len(inlier) < NEEDED_POINTS:
        return None
    rows = inlier.ravel()
    rotvec, translation = cv2.solvePnPRefineLM(
        points[rows], pixels[rows], K, None, rotvec, translation
    )
    return so3_exp(np.asarray(rotvec, np.float64).ravel()), np.asarray(
        translation, np.float64
    ).ravel()


def _pinhole(camera: Camera) -> dict[str, Any]:
    K = camera.K
    return {
        "model": "PINHOLE",
        "width": camera.width,
        "height": camera.height,
        "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
    }


def _since(start: float) -> dict[str, float]:
    return {"solve": (perf_counter() - start) * 1e3}


def _baseline(name: str) -> Baseline:
    """Return the baseline. Raise SemvizError if its library is not installed."""
    library, solver = _SOLVERS[name]
    require_extra(f"method {name}", library, "peers")
    return Baseline(name, solver)


def _on_frames(name: str) -> AllPairs:
    return AllPairs(_baseline(name))


_SOLVERS: dict[str, tuple[str, Callable[[Correspondences], BaselinePose]]] = {
    "poselib points": ("poselib", poselib_points),
    "poselib points+lines": ("poselib", poselib_points_lines),
    "opencv ap3p": ("cv2", opencv_ap3p),
    "opencv usac": ("cv2", opencv_usac),
    "pycolmap": ("pycolmap", pycolmap_points),
}

METHODS: dict[str, Callable[[], Method]] = {
    **{name: partial(_on_frames, name) for name in _SOLVERS},
    "paper with true P": PaperBackEnd,
}
MATCHED_METHODS: dict[str, Callable[[], MatchedMethod]] = {
    "minimal": lambda: SemvizMatched("minimal", "minimal"),
    "minimal with prior": lambda: SemvizMatched("minimal with prior", "minimal", with_prior=True),
    "p3p": lambda: SemvizMatched("p3p", "p3p"),
    **{name: partial(_baseline, name) for name in _SOLVERS},
}
