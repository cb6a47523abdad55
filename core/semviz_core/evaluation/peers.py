"""What others do with the same matches, and what the paper does: to compare with.

Every peer gets the matches best first, with its threshold and options chosen for success on tuning
seeds at 1 px detection noise; they are stated with each. None of them estimates a covariance.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz_core.arrays import FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.detector_model import DetectorModel
from semviz_core.evaluation.answers import Answer, MatchedMethod, Method
from semviz_core.evaluation.problems import DETECTOR, Problem
from semviz_core.pose import Pose, nearest_rotation, so3_exp
from semviz_core.solving.least_squares import information
from semviz_core.solving.matched import Failure, MatchedMethodName, localize_matches
from semviz_core.solving.matched.matches import Matches
from semviz_core.solving.matched.p3p import p3p_ransac
from semviz_core.solving.matched.pnpl import paper_pnpl

if TYPE_CHECKING:
    from semviz_core.evaluation.matched_problems import MatchedProblem

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
    line_px: tuple[FloatArray, FloatArray]  # (l, 2) both ends of what is seen of poles
    line_m: tuple[FloatArray, FloatArray]  # (l, 3) peaks and bottoms

    @classmethod
    def of(cls, problem: Problem, pairs: IntArray, score: FloatArray) -> "Correspondences":
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
    """(k, 2) of observed anchors and ends without distortion."""
    homogeneous = [ray / ray[:, 2:] @ matches.camera.K.T for ray in matches.rays()]
    return [one[:, :2] for one in homogeneous]


Found = tuple[FloatArray, FloatArray] | None
"""Rotation (3, 3) and translation (3,) T_camera_map, or none by the library's own word."""


@dataclass(frozen=True)
class Peer:
    """A library's solver as a method for given matches. Only the solver is timed."""

    name: str
    solve: Callable[[Correspondences], Found]
    with_prior: bool = False

    def answer(self, problem: "MatchedProblem") -> Answer:
        return self.answer_pairs(problem.problem, problem.pairs, problem.score)

    def answer_pairs(self, problem: Problem, pairs: IntArray, score: FloatArray) -> Answer:
        given = Correspondences.of(problem, pairs, score)
        if len(given.pixel_px) < NEEDED_POINTS:
            reason = f"{len(given.pixel_px)} matched points are known, {NEEDED_POINTS} needed."
            return Answer(None, None, "cannot", reason)
        start = perf_counter()
        found = self.solve(given)
        time_ms = {"solve": (perf_counter() - start) * 1e3}
        if found is None or not _is_pose(*found):
            return Answer(None, None, "cannot", f"{self.name} found no pose.", time_ms)
        pose = Pose(nearest_rotation(found[0]), found[1])
        return Answer(pose, None, "ok", f"{self.name} found a pose.", time_ms)


def _is_pose(rotation: FloatArray, translation: FloatArray) -> bool:
    """Libraries also return NaN, and places further away than the sun."""
    return bool(np.isfinite(rotation).all() and np.linalg.norm(translation) < FARTHEST_M)


@dataclass(frozen=True)
class AllPairs:
    """A peer on whole frames: it is given every pair that classes and the prior allow."""

    peer: Peer

    @property
    def name(self) -> str:
        return self.peer.name

    def answer(self, problem: Problem) -> Answer:
        pairs = possible_pairs(problem)
        return self.peer.answer_pairs(problem, pairs, np.full(len(pairs), 0.5))


def possible_pairs(problem: Problem) -> IntArray:
    """(k, 2) pairs of one class whose mapped element can be in view from near the prior."""
    prior = problem.prior
    off = problem.submap.anchor_m[:, :2] - prior.position_m[:2]
    reach = GPS_SIGMAS * prior.horizontal_sigma_m + DETECTION_RANGE_M
    near = np.hypot(off[:, 0], off[:, 1]) < reach
    same = problem.observed.class_id[:, None] == problem.submap.class_id
    return np.argwhere(same & near)


@dataclass(frozen=True)
class OwnMatched:
    """``localize_matches`` as users have it; only ``minimal`` makes use of the prior."""

    name: str
    method: MatchedMethodName
    with_prior: bool = False
    detector: DetectorModel = DETECTOR
    seed: int = 0

    def answer(self, problem: "MatchedProblem") -> Answer:
        frame = problem.problem
        start = perf_counter()
        found = localize_matches(
            frame.observed, frame.submap, frame.camera, problem.pairs, problem.score,
            prior=frame.prior if self.with_prior else None,
            method=self.method, seed=self.seed, detector=self.detector,
        )  # fmt: skip
        time_ms = {"solve": (perf_counter() - start) * 1e3}
        if isinstance(found, Failure):
            return Answer(None, None, "cannot", found.reason, time_ms)
        reason = f"{int(found.inlier.sum())} of {len(found.pairs)} matches agree."
        return Answer(found.T_camera_map, found.covariance, "ok", reason, time_ms)


@dataclass(frozen=True)
class PaperBackEnd:
    """The paper's P3P-RANSAC and PnPL (eq. 5-8) with the true, Boolean P.

    A reference, not a method: it knows the answers.
    """

    name: str = "paper with true P"
    seed: int = 0

    def answer(self, problem: Problem) -> Answer:
        start = perf_counter()
        matches = Matches.checked(
            problem.observed, problem.submap, problem.camera,
            problem.pairs, np.ones(len(problem.pairs)),
        )  # fmt: skip
        coarse = p3p_ransac(matches, self.seed)
        if isinstance(coarse, Failure):
            return Answer(None, None, "cannot", coarse.reason, _since(start))
        pose = paper_pnpl(matches, matches.score, coarse.T_camera_map).T_camera_map
        time_ms = _since(start)
        weight = information(matches.scene(), None, pose, problem.pairs)
        sound = bool(np.linalg.eigvalsh(weight)[0] > 1e-6)
        covariance = np.asarray(np.linalg.inv(weight), np.float64) if sound else None
        return Answer(pose, covariance, "ok", f"{len(problem.pairs)} true pairs.", time_ms)


def poselib_points(given: Correspondences) -> Found:
    """LO-RANSAC of PoseLib on points: 8 px, PROSAC by score, loss of 3 px."""
    import poselib

    pose, report = poselib.estimate_absolute_pose(
        given.pixel_px, given.point_m, _pinhole(given.camera),
        {"max_reproj_error": 8.0, "progressive_sampling": True}, {"loss_scale": 3.0},
    )  # fmt: skip
    return (pose.R, pose.t) if report["num_inliers"] >= NEEDED_POINTS else None


def poselib_points_lines(given: Correspondences) -> Found:
    """LO-RANSAC of PoseLib on points and poles' lines: 8 px, loss of 3 px. Not repeatable."""
    import poselib

    pose, report = poselib.estimate_absolute_pose_pnpl(
        given.pixel_px, given.point_m, *given.line_px, *given.line_m, _pinhole(given.camera),
        {"max_reproj_error": 8.0}, {"loss_scale": 3.0},
    )  # fmt: skip
    return (pose.R, pose.t) if report["num_inliers"] >= NEEDED_POINTS else None


def opencv_ap3p(given: Correspondences) -> Found:
    """OpenCV's RANSAC with AP3P, 8 px, 10000 iterations, then LM over its inliers."""
    import cv2

    return _opencv(given, cv2.SOLVEPNP_AP3P)


def opencv_usac(given: Correspondences) -> Found:
    """OpenCV's USAC with PROSAC by score, 8 px, 10000 iterations, then LM over its inliers.

    On tuning seeds better than USAC's default, accurate, fast and MAGSAC modes.
    """
    import cv2

    return _opencv(given, cv2.USAC_PROSAC)


def pycolmap_points(given: Correspondences) -> Found:
    """COLMAP's LO-RANSAC on points and refinement: 6 px, loss of 3 px."""
    import pycolmap

    estimation = pycolmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error = 6.0
    estimation.ransac.random_seed = 0
    refinement = pycolmap.AbsolutePoseRefinementOptions()
    refinement.loss_function_scale = 3.0
    camera = pycolmap.Camera(**_pinhole(given.camera))
    found = pycolmap.estimate_and_refine_absolute_pose(
        given.pixel_px, given.point_m, camera, estimation, refinement
    )
    if found is None:
        return None
    pose = found["cam_from_world"]
    return pose.rotation.matrix(), pose.translation


def _opencv(given: Correspondences, flags: int) -> Found:
    import cv2

    cv2.setRNGSeed(0)
    points, pixels, K = given.point_m, given.pixel_px, given.camera.K
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


def _peer(name: str) -> Peer:
    """ImportError where the peer's library is not installed."""
    library, solve = _PEERS[name]
    import_module(library)
    return Peer(name, solve)


def _on_frames(name: str) -> AllPairs:
    return AllPairs(_peer(name))


_PEERS: dict[str, tuple[str, Callable[[Correspondences], Found]]] = {
    "poselib points": ("poselib", poselib_points),
    "poselib points+lines": ("poselib", poselib_points_lines),
    "opencv ap3p": ("cv2", opencv_ap3p),
    "opencv usac": ("cv2", opencv_usac),
    "pycolmap": ("pycolmap", pycolmap_points),
}

METHODS: dict[str, Callable[[], Method]] = {
    **{name: partial(_on_frames, name) for name in _PEERS},
    "paper with true P": PaperBackEnd,
}
MATCHED_METHODS: dict[str, Callable[[], MatchedMethod]] = {
    "minimal": lambda: OwnMatched("minimal", "minimal"),
    "minimal with prior": lambda: OwnMatched("minimal with prior", "minimal", with_prior=True),
    "p3p": lambda: OwnMatched("p3p", "p3p"),
    **{name: partial(_peer, name) for name in _PEERS},
}
