"""Bundle adjustment: time, memory and cost of semviz, SciPy and gtsam on the same problem.

    python bench/bundle_adjustment.py [--frames 2000 10000] [--signs] [--solvers place refine scipy]

A simulated drive with stereo images every metre, about 10 elements in each, label errors of 1 px,
and pose errors of 2 cm and 0.05 deg. Each solver runs in its own process on one thread, without
robust loss or camera offset, so that all minimize the same sum of squares. ``gtsam`` (not a
dependency; put it on PYTHONPATH) has no factor for lines: compare it with ``--signs``. semviz
computes covariances, the others do not.
"""

import argparse
import resource
import subprocess
import sys
import time

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix, diags_array, hstack, vstack
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from semviz_annotation.mapping.placement.bundle_adjustment import (
    BundleProblem,
    RefineOptions,
    Unknowns,
    bundle_adjust,
)
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_annotation.mapping.placement.reprojection import Residuals, residuals
from semviz_annotation.mapping.placement.triangulation import PlaceOptions, triangulate_landmarks
from semviz_core.common.arrays import FloatArray, IntArray

SEED = 1000
K = np.array([[720.0, 0.0, 610.0], [0.0, 720.0, 180.0], [0.0, 0.0, 1.0]])
BASE = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes in a map with x forward and z up."""
BASELINE_M, REACH_M, SIGHTS_A_FRAME = 0.54, 40.0, 10.0
SIGMA_M, SIGMA_DEG = 0.02, 0.05
PLACE = PlaceOptions(outlier_sigmas=np.inf, min_angle_rad=float(np.deg2rad(0.5)))
REFINE = RefineOptions(PLACE, SIGMA_M, SIGMA_DEG, offset_sigma_px=1e-6)
SIGMAS = np.array([SIGMA_M] * 3 + [np.deg2rad(SIGMA_DEG)] * 3)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[2000, 10000])
    parser.add_argument("--signs", action="store_true", help="signs only, for gtsam")
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=["place", "refine"])
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.here:
        report(arguments.solvers[0], arguments.frames[0], arguments.signs)
        return
    print(f"{'frames':>7} {'observations':>10} {'solver':>8} {'time, s':>9} {'peak, MB':>9}  cost")
    for frames in arguments.frames:
        for solver in arguments.solvers:
            command = [sys.executable, __file__, "--here", "--frames", str(frames)]
            command += ["--solvers", solver, *["--signs"] * arguments.signs]
            subprocess.run(command, check=True)


def report(solver: str, frames: int, signs: bool) -> None:
    """One line; the peak is that of the process, the problem itself included."""
    views, observations, _ = drive(frames, signs)
    seconds, cost = SOLVERS[solver](views, observations)
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000.0
    print(
        f"{frames:>7} {len(observations):>10} {solver:>8} "
        f"{seconds:>9.1f} {peak_mb:>9.0f}  {cost:.2f}"
    )


# -- the problem


def drive(
    frames: int, signs: bool, pose_sigmas: float = 1.0, step_m: float = 1.0
) -> tuple[ViewArray, ObservationArray, FloatArray]:
    """A winding road with poles and signs (or signs alone) on both sides; poses a little off. With
    the true anchors and ends (n, 6)."""
    rng = np.random.default_rng(SEED)
    x = step_m * np.arange(frames)
    heading = np.arctan(0.25 * np.cos(x / 80.0))
    rotations = Rotation.from_euler("z", heading[:, None]).as_matrix() @ BASE
    centers = np.stack([x, road(x), np.full(frames, 1.65)], axis=1)
    true_views = stereo(rotations, centers)
    turn = Rotation.from_rotvec(pose_sigmas * rng.normal(0.0, SIGMAS[3], (frames, 3))).as_matrix()
    given = stereo(turn @ rotations, centers + pose_sigmas * rng.normal(0.0, SIGMA_M, (frames, 3)))
    n = int(x[-1] * SIGHTS_A_FRAME / (0.62 * REACH_M))
    along = rng.uniform(0.0, x[-1], n)
    beside = road(along) + rng.choice([-1.0, 1.0], n) * rng.uniform(4.0, 12.0, n)
    anchor = np.stack([along, beside, rng.uniform(2.0, 6.0, n)], axis=1)
    end = anchor * [1.0, 1.0, 0.0] + rng.normal(0.0, 0.03, (n, 3))
    end[np.full(n, True) if signs else np.arange(n) % 2 == 1] = np.nan
    observations = seen(rng, true_views, centers, anchor, end)
    return given, observations, np.concatenate([anchor, end], axis=1)


def road(x: FloatArray) -> FloatArray:
    return np.asarray(20.0 * np.sin(x / 80.0))


def stereo(rotations: FloatArray, centers_m: FloatArray) -> ViewArray:
    """From left cameras' rotations (f, 3, 3, camera to map) and centres (f, 3)."""
    f = len(centers_m)
    R = np.repeat(rotations.transpose(0, 2, 1), 2, axis=0)
    centers = np.repeat(centers_m, 2, axis=0)
    centers[1::2] += BASELINE_M * rotations[:, :, 0]
    t = -(R @ centers[:, :, None])[:, :, 0]
    return ViewArray(
        np.repeat(np.arange(f), 2), np.tile([False, True], f), R, t, np.tile(K, (2 * f, 1, 1))
    )


def seen(
    rng: np.random.Generator,
    views: ViewArray,
    centers_m: FloatArray,
    anchor_m: FloatArray,
    end_m: FloatArray,
) -> ObservationArray:
    """All that is ahead, within reach and in the width of an image; a third of bottoms hidden."""
    near = cKDTree(anchor_m[:, :2]).query_ball_point(centers_m[:, :2], REACH_M)
    frame = np.repeat(np.arange(len(near)), [len(rows) for rows in near])
    landmark = np.repeat(np.concatenate(near).astype(np.int64), 2)
    view = np.stack([2 * frame, 2 * frame + 1], axis=1).ravel()
    is_line = np.isfinite(end_m[landmark, 0])
    anchor, end = pixels(views, view, anchor_m[landmark]), pixels(views, view, end_m[landmark])
    cut = is_line & (rng.random(len(landmark)) < 1.0 / 3.0)
    end = np.where(
        cut[:, None], anchor + rng.uniform(0.3, 0.9, (len(cut), 1)) * (end - anchor), end
    )
    noise = rng.normal(0.0, 1.0, (2, len(landmark), 2))
    width = 2.0 * K[0, 2]
    rows = (views.depth_m(view, anchor_m[landmark]) > 3.0) & (
        np.abs(2.0 * anchor[:, 0] - width) < width
    )
    every = ObservationArray(
        landmark=landmark,
        view=view,
        anchor_px=anchor + noise[0],
        end_px=end + noise[1],
        anchor_known=np.ones(len(landmark), dtype=bool),
        end_known=is_line & ~cut,
        sigma_ratio=np.ones((len(landmark), 2)),
        label_row=np.arange(len(landmark)),
        count=len(anchor_m),
    )
    return every.regrouped(np.where(rows, landmark, -1), len(anchor_m))


def pixels(views: ViewArray, view: IntArray, points_m: FloatArray) -> FloatArray:
    """(k, 2) of points (k, 3) in the views of rows (k,)."""
    P = views.projection[view]
    x = (P[:, :, :3] @ points_m[:, :, None])[:, :, 0] + P[:, :, 3]
    return np.asarray(x[:, :2] / x[:, 2:])


# -- the solvers: each gives its time in seconds, and the cost where it stopped


def by_place(views: ViewArray, observations: ObservationArray) -> tuple[float, float]:
    start = time.perf_counter()
    cost = triangulate_landmarks(views, observations, PLACE).chi2.sum()
    return time.perf_counter() - start, float(cost)


def by_refine(views: ViewArray, observations: ObservationArray) -> tuple[float, float]:
    placed = triangulate_landmarks(views, observations, PLACE)
    start = time.perf_counter()
    cost = bundle_adjust(views, observations, placed, REFINE).costs[-1]
    return time.perf_counter() - start, cost


def by_scipy(views: ViewArray, observations: ObservationArray) -> tuple[float, float]:
    """Trust region with LSMR and our derivatives."""
    placed = triangulate_landmarks(views, observations, PLACE)
    chosen = observations.only(placed.ok)
    problem = BundleProblem(views, chosen, REFINE)
    first = problem.start(placed)
    n, f = first.landmarks.size, first.frames.size
    told = np.concatenate([chosen.of(np.isfinite(chosen.end_px[:, 0])).repeat(6), np.ones(f, bool)])
    told.reshape(-1, 6)[:, :3] = True  # all but the ends of signs

    def unknowns(x: FloatArray) -> Unknowns:
        values = np.zeros(n + f)
        values[told] = x
        return Unknowns(values[:n].reshape(-1, 6), values[n:].reshape(-1, 6), 0.0)

    def fit(at: Unknowns) -> Residuals:
        return residuals(problem.views(at), chosen, at.landmarks[:, :3], at.landmarks[:, 3:])

    def errors(x: FloatArray) -> FloatArray:
        at = unknowns(x)
        return np.concatenate([fit(at).error_px.ravel(), (at.frames / SIGMAS).ravel()])

    frame = np.unique(views.frame_index, return_inverse=True)[1][chosen.view]
    row = np.repeat(np.arange(4 * len(chosen)), 12)
    first_column = np.stack([6 * chosen.landmark, n + 6 * frame], axis=1)
    column = (first_column[:, None, :, None] + np.arange(6)).repeat(4, axis=1).ravel()
    prior = diags_array(np.tile(1.0 / SIGMAS, f // 6), offsets=0)

    def slopes(x: FloatArray) -> csr_matrix:
        at = unknowns(x)
        at_fit = fit(at)
        J = np.stack([at_fit.J, problem.by_frame(at, at_fit)], axis=2)
        sights = csr_matrix((J.ravel(), (row, column)), shape=(4 * len(chosen), n + f))
        priors = hstack([csr_matrix((f, n)), prior])
        return vstack([sights, priors]).tocsr()[:, told]

    start = time.perf_counter()
    x = np.concatenate([first.landmarks.ravel(), first.frames.ravel()])[told]
    found = least_squares(errors, x, slopes, x_scale="jac", tr_solver="lsmr", ftol=1e-8)
    return time.perf_counter() - start, 2.0 * float(found.cost)


def by_gtsam(views: ViewArray, observations: ObservationArray) -> tuple[float, float]:
    """Levenberg-Marquardt; making the graph is not counted."""
    import gtsam

    if observations.is_line.any():
        sys.exit("gtsam has no factor for lines: give --signs")
    placed = triangulate_landmarks(views, observations, PLACE)
    chosen = observations.only(placed.ok)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    noise = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    prior = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS[[3, 4, 5, 0, 1, 2]])
    camera = gtsam.Cal3_S2(K[0, 0], K[1, 1], 0.0, K[0, 2], K[1, 2])
    sides = [gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3(), np.array([BASELINE_M, 0.0, 0.0]))]
    for frame in range(len(views) // 2):
        pose = gtsam.Pose3(gtsam.Rot3(views.R[2 * frame].T), views.center_m[2 * frame])
        values.insert(gtsam.symbol("x", frame), pose)
        graph.add(gtsam.PriorFactorPose3(gtsam.symbol("x", frame), pose, prior))
    for landmark, point in enumerate(placed.anchor_m[placed.ok]):
        values.insert(gtsam.symbol("l", landmark), point)
    for landmark, view, pixel in zip(chosen.landmark, chosen.view, chosen.anchor_px, strict=True):
        keys = gtsam.symbol("x", view // 2), gtsam.symbol("l", landmark)
        side = sides[view % 2]
        graph.add(gtsam.GenericProjectionFactorCal3_S2(pixel, noise, *keys, camera, side))
    start = time.perf_counter()
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return time.perf_counter() - start, 2.0 * graph.error(found)


SOLVERS = {"place": by_place, "refine": by_refine, "scipy": by_scipy, "gtsam": by_gtsam}

if __name__ == "__main__":
    main()
