"""The solver on frames of another kind than those it was tuned on, beside PoseLib.

    OMP_NUM_THREADS=1 python bench/held_out.py [--frames 200] [--sets four,clutter]
        [--kitti-poses DIR --pole-maps DIR]

Elements lie scattered in a disc around the camera, not along a road; false poles lean as tree
trunks and edges of houses do; gravity is known to 1.5 deg. The fix is anywhere within 10 m, the
heading unknown. Each set differs as its name states; `as 1` means that the stated sigma is 1 px.
`matched` gives each solver the same matches, 80 % of them wrong. With KITTI's files also frames of
eight detections or more without any fix, in the whole map of sequence 00, and in ten such maps
side by side.

`right`: within 1 m and 2 deg. `false ok`: ok, and not right. Frames without a fix also count alone
if no second pose is within 12 nats of the true one, fitted to the true pairs. With `--run`, sigmas
are fitted over the frames of a set. Times are processor time of whole frames.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import process_time

import numpy as np
import tyro

from semviz_core.base.camera import Camera
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D, Elements3D, joined
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.localization.heading_votes import WIDE
from semviz_core.localization.least_squares import fit_pairs
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.matched import localize_matches
from semviz_core.localization.matched.matches import NEEDED_PAIRS
from semviz_core.localization.noise_estimate import NoiseEstimate
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.search import mode_near, search
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.baselines import MATCHED_METHODS
from semviz_core.research.evaluation.methods import MatchedProblem, bound_covariance
from semviz_core.research.evaluation.problems import LocalizationProblem, mapped_elements
from semviz_core.research.evaluation.problems import make_problem as make_road_problem
from semviz_core.research.evaluation.roads import kitti_road

CAMERA = Camera(
    1241, 376, np.array([[718.856, 0.0, 607.1928], [0.0, 718.856, 185.2157], [0.0, 0.0, 1.0]])
)
DETECTOR = DetectorModel(
    false_detections=0.5, recall_near=0.8, recall_far=0.8, near_m=4.0, far_m=40.0, reach_m=41.0,
    hidden_bottoms=0.3,
)  # fmt: skip
REACH_M, NEAREST_M, IN_REACH_M = 40.0, 4.0, 60.0
RECALL = 0.8
MOST_SEEN = 12
GRAVITY_RAD = float(np.deg2rad(1.5))
FALSE_LEAN_RAD = float(np.deg2rad(8.0))
MAP_SIGMA_M = 0.05
HIDDEN = 0.3
RIGHT_M, RIGHT_DEG = 1.0, 2.0
SECOND_NATS = 12.0
"""A frame without a fix can be told if no second pose is within this of the true one."""


@dataclass(frozen=True)
class Kind:
    """How frames of a set are made."""

    sigma_px: float = 1.0
    stated_px: float | None = None
    sign_times: float = 1.0
    """Errors of signs over those of poles; the detector does not know."""
    most_seen: int = MOST_SEEN
    false_share: float = 0.0
    """False detections relative to the true ones, beside half a one per frame."""
    moved: float = 0.0
    in_reach: int = 100
    """Mapped elements within 60 m of the camera."""
    fix_m: float = 10.0
    """Radius of the disc that the fix is drawn from; its sigma is half of it."""


HARD = Kind(sigma_px=3.0, false_share=1.0, moved=0.2)
SETS = {
    "usual": Kind(),
    "four": Kind(most_seen=4),
    "five": Kind(most_seen=5),
    "clutter": Kind(false_share=1.0),
    "3 px": Kind(sigma_px=3.0),
    "3 px as 1": Kind(sigma_px=3.0, stated_px=1.0),
    "signs 3 px as 1": Kind(sign_times=3.0),
    "all": HARD,
    "all as 1": replace(HARD, stated_px=1.0),
    "200 in reach": Kind(in_reach=200),
    "1000 in reach": Kind(in_reach=1000),
    "5000 in reach": Kind(in_reach=5000),
    "fix 50 m": Kind(fix_m=100.0),
    "fix 200 m": Kind(fix_m=400.0),
}


@dataclass(frozen=True)
class Options:
    frames: int = 200
    sets: str = ",".join((*SETS, "matched"))
    """Empty: none but those without a fix."""
    kitti_poses: Path | None = None
    pole_maps: Path | None = None
    first_seed: int = 0
    method: str = "search"
    run: bool = False
    """Fit the sigmas over the frames of a set."""


def make_problem(seed: int, kind: Kind) -> LocalizationProblem:
    """Return the frame of a seed."""
    rng = np.random.default_rng([seed, 77])
    true = _camera(rng)
    reach_m = IN_REACH_M + (0.0 if kind.fix_m <= 10.0 else 1.5 * kind.fix_m)
    count = round(kind.in_reach * (reach_m / IN_REACH_M) ** 2)
    world = _elements(count, reach_m, rng)
    observed, rows, hidden = _observed(world, true, kind, rng)
    mapped, trusted = _mapped(world, kind, rng)
    observed = joined(observed, _false(len(observed), kind, rng))
    rows = np.append(rows, np.full(len(observed) - len(rows), -1))
    pairs = np.argwhere(rows[:, None] == np.where(trusted, np.arange(count), -2))
    stated = kind.stated_px or kind.sigma_px
    observed = replace(observed, sigma_px=np.full((len(observed), 2), stated))
    camera_m = true.inverse().translation
    radius, bearing = kind.fix_m * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
    fix = camera_m + np.array([radius * np.cos(bearing), radius * np.sin(bearing), 0.0])
    fix[2] = 0.0
    up = true.rotation[:, 2] + rng.normal(0.0, GRAVITY_RAD, 3)
    prior = Prior(
        fix, 0.5 * kind.fix_m, 0.1, up / np.linalg.norm(up), GRAVITY_RAD
    )  # the camera is 1.65 m above the ground, the map's z is 0 there
    visible = np.append(~hidden, np.zeros(len(observed) - len(hidden), dtype=bool))
    return LocalizationProblem(observed, mapped, CAMERA, prior, true, pairs, visible)


def _camera(rng: np.random.Generator) -> Pose:
    """Return T_camera_map of a camera near the origin, at z = 0, at any heading."""
    heading = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(heading), np.sin(heading)
    level = np.array([[s, -c, 0.0], [0.0, 0.0, -1.0], [c, s, 0.0]])
    lean = Pose.from_rotvec(rng.normal(0.0, np.deg2rad(1.0), 3) * [1.0, 0.0, 1.0], np.zeros(3))
    R = lean.rotation @ level
    center = np.array([*rng.uniform(-5.0, 5.0, 2), rng.normal(0.0, 0.05)])
    return Pose(R, -R @ center)


def _elements(count: int, reach_m: float, rng: np.random.Generator) -> Elements3D:
    """Return poles and signs in a disc; the ground is 1.65 m below z = 0."""
    radius, angle = reach_m * np.sqrt(rng.random(count)), rng.uniform(-np.pi, np.pi, count)
    ground = -1.65 + rng.normal(0.0, 0.1, count)
    class_id = rng.choice([POLE, TRIANGULAR, RECTANGULAR, ROUNDED], count, p=[0.6, 0.1, 0.2, 0.1])
    line = class_id == POLE
    height = np.where(line, rng.uniform(2.0, 7.0, count), rng.uniform(1.8, 3.0, count))
    foot = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), ground])
    lean = rng.normal(0.0, np.deg2rad(0.7), (count, 2)) * height[:, None]
    peak = foot + np.column_stack([lean, height])
    end = np.where(line[:, None], foot, np.nan)
    return Elements3D.from_ends(np.arange(count), peak, end, class_id, MAP_SIGMA_M)


def _observed(
    world: Elements3D, true: Pose, kind: Kind, rng: np.random.Generator
) -> tuple[Elements2D, IntArray, BoolArray]:
    """Return the true detections, their rows of ``world``, and which bottoms are hidden."""
    peak, line = true.apply(world.anchor_m), world.is_line
    foot = true.apply(np.where(line[:, None], world.end_m, world.anchor_m))
    depth = np.linalg.norm(peak, axis=1)
    chance = rng.random(len(world)) < RECALL
    rows = np.flatnonzero((peak[:, 2] > 1.0) & (depth > NEAREST_M) & (depth < REACH_M) & chance)
    hidden = rng.random(len(rows)) < HIDDEN
    shown = np.where(hidden, rng.uniform(0.5, 0.85, len(rows)), 1.0)[:, None]
    visible = peak[rows] + shown * (foot[rows] - peak[rows])
    anchor_px, end_px = CAMERA.project(peak[rows]), CAMERA.project(visible)
    inside = CAMERA.contains(anchor_px) & CAMERA.contains(end_px)
    kept = rng.permutation(np.flatnonzero(inside))[: kind.most_seen]
    times = np.where(line[rows[kept]], 1.0, kind.sign_times)[:, None]
    anchor_px = anchor_px[kept] + times * rng.normal(0.0, kind.sigma_px, (len(kept), 2))
    end_px = end_px[kept] + rng.normal(0.0, kind.sigma_px, (len(kept), 2))
    end_px = np.where(line[rows[kept], None], end_px, np.nan)
    observed = Elements2D.from_ends(anchor_px, end_px, world.class_id[rows[kept]])
    return observed, rows[kept], hidden[kept]


def _mapped(
    world: Elements3D, kind: Kind, rng: np.random.Generator
) -> tuple[Elements3D, FloatArray]:
    """Return the map of the world with errors, and which of its elements are where they were."""
    error = rng.normal(0.0, MAP_SIGMA_M, (len(world), 3))
    moved = rng.random(len(world)) < kind.moved
    error[moved, :2] += rng.normal(0.0, 6.0, (int(moved.sum()), 2))
    shared = np.kron(np.ones((2, 2)), MAP_SIGMA_M**2 * np.eye(3))
    covariance_m2 = np.where(world.is_line[:, None, None], shared, world.covariance_m2)
    mapped = replace(
        world,
        anchor_m=world.anchor_m + error,
        end_m=world.end_m + error,
        covariance_m2=covariance_m2,
    )
    return mapped, ~moved


def _false(true: int, kind: Kind, rng: np.random.Generator) -> Elements2D:
    """Return false detections."""
    count = int(rng.poisson(0.5 + kind.false_share * true))
    anchor = rng.uniform([20.0, 10.0], [1220.0, 180.0], (count, 2))
    length = rng.uniform(40.0, 180.0, count)
    lean = rng.normal(0.0, FALSE_LEAN_RAD, count)
    end = anchor + np.column_stack([length * np.sin(lean), length * np.cos(lean)])
    class_id = np.where(rng.random(count) < 0.7, POLE, rng.integers(1, 4, count))
    return Elements2D.from_ends(
        anchor, np.where((class_id == POLE)[:, None], end, np.nan), class_id
    )


@dataclass(frozen=True)
class Told:
    right: bool
    ok: bool
    nees: float
    time_ms: float


def main(options: Options) -> None:
    localizer = Localizer(options.method, detector=DETECTOR)
    localizer.warmup()
    seeds = range(options.first_seed, options.first_seed + options.frames)
    for name in filter(None, options.sets.split(",")):
        if name != "matched":
            problems = (make_problem(seed, SETS[name]) for seed in seeds)
            told = list(
                _told_run(localizer, problems)
                if options.run
                else (_told(localizer, problem) for problem in problems)
            )
            true = [
                _is_right(_fit_to_true_matches(problem), problem)
                for problem in (make_problem(seed, SETS[name]) for seed in seeds)
            ]
            print(f"{name:16}", _row(told), f"true matches {np.mean(true):.1%}", flush=True)
    if "matched" in options.sets:
        _matched(seeds)
    if options.kitti_poses is not None:
        for copies in 1, 10:
            frames = list(_lost_frames(options, copies))
            told = [_told(localizer, problem) for problem in frames]
            print(f"no fix, {copies:2} maps", _row(told), f"{len(frames[0].submap)} mapped")
            alone = np.array([_margin_nats(problem) >= SECOND_NATS for problem in frames])
            right = np.array([one.right for one in told])
            print(
                f"    no second pose within {SECOND_NATS:.0f} nats of the true one: "
                f"{alone.sum()} of {len(alone)} frames, right {right[alone].mean():.1%}",
                flush=True,
            )


def _told_run(localizer: Localizer, problems: Iterator[LocalizationProblem]) -> Iterator[Told]:
    """Yield what is told of the frames of a run; each is localized with sigmas fitted before it."""
    noise = NoiseEstimate()
    for problem in problems:
        observed = noise.applied(problem.observed)
        yield _told(localizer, replace(problem, observed=observed))
        found = localizer.localize(observed, problem.submap, problem.camera, problem.prior)
        noise = noise.after(found, problem.observed, DETECTOR)
    print(noise.scales.sentence)


def _told(localizer: Localizer, problem: LocalizationProblem) -> Told:
    start = process_time()
    found = localizer.localize(problem.observed, problem.submap, problem.camera, problem.prior)
    time_ms = (process_time() - start) * 1e3
    pose, covariance = found.T_camera_map, found.covariance
    if pose is None or covariance is None:
        return Told(False, False, np.nan, time_ms)
    off = (problem.T_camera_map @ pose.inverse()).log()
    nees = float(off @ np.linalg.solve(covariance, off))
    right = _is_right(pose, problem)
    return Told(right, found.status == "ok", nees if right else np.nan, time_ms)


def _is_right(pose: Pose | None, problem: LocalizationProblem) -> bool:
    if pose is None:
        return False
    off_m, off_deg = pose_error(pose, problem.T_camera_map)
    return bool(off_m < RIGHT_M and off_deg < RIGHT_DEG)


def _fit_to_true_matches(problem: LocalizationProblem) -> Pose | None:
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    if len(problem.pairs) < 2:
        return None
    return fit_pairs(scene, problem.prior, problem.T_camera_map, problem.pairs).T_camera_map


def _margin_nats(problem: LocalizationProblem) -> float:
    """Return by how much the true pose, fitted to the true pairs, scores better than any other
    that a wide search finds."""
    scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    true = fit_pairs(scene, problem.prior, problem.T_camera_map, problem.pairs).T_camera_map
    modes = search(scene, problem.prior, WIDE)
    others = [
        score
        for R, t, score in zip(modes.rotation, modes.translation, modes.score, strict=True)
        if not _is_right(Pose(R, t), problem)
    ]
    return float(mode_near(scene, problem.prior, true).score[0] - max(others, default=-np.inf))


def _row(told: list[Told]) -> str:
    right, ok = (np.array([getattr(one, name) for one in told]) for name in ("right", "ok"))
    median, p95 = np.percentile([one.time_ms for one in told], [50, 95])
    return (
        f"right {right.mean():6.1%}  ok {ok.mean():6.1%}  false ok {(ok & ~right).mean():5.2%}  "
        f"NEES {np.nanmean([one.nees for one in told]):5.1f}  "
        f"{median:6.1f} ms, p95 {p95:6.1f}"
    )


def _matched(seeds: range) -> None:
    """Print our solver and other libraries' on the same matches, 80 % of them wrong."""
    ways: dict[str, Callable[[MatchedProblem], Pose | None]] = {"semviz": _localized}
    for name in ("poselib points", "poselib points+lines", "opencv usac"):
        if name in MATCHED_METHODS:
            method = MATCHED_METHODS[name]()
            ways[name] = lambda given, method=method: method.solve(given).T_camera_map
    ways["true matches"] = lambda given: _fit_to_true_matches(given.problem)
    given = [_matched_problem(seed) for seed in seeds]
    enough = np.array([len(one.problem.pairs) >= NEEDED_PAIRS for one in given])
    bound_m = np.array([_bound_m(one.problem) for one in given])
    for name, solve in ways.items():
        solve(given[0])
        off_m, time_ms, answered = np.full((3, len(given)), np.inf)
        for row, one in enumerate(given):
            start = process_time()
            pose = solve(one)
            time_ms[row] = (process_time() - start) * 1e3
            answered[row] = pose is not None
            if pose is not None and _is_right(pose, one.problem):
                off_m[row] = pose_error(pose, one.problem.T_camera_map)[0]
        right = np.isfinite(off_m)
        both = right & np.isfinite(bound_m)
        ratio = np.sqrt(np.mean((off_m[both] / bound_m[both]) ** 2))
        median, p95 = np.percentile(time_ms, [50, 95])
        print(
            f"matched: {name:22} right {right.mean():6.1%}, of {enough.sum()} with {NEEDED_PAIRS} "
            f"true matches {right[enough].mean():6.1%}  wrong {(answered > right).mean():6.1%}  "
            f"RMS/bound {ratio:.2f}  {median:.1f} ms, p95 {p95:.1f}",
            flush=True,
        )


def _bound_m(problem: LocalizationProblem) -> float:
    """Return the RMS of the position's Cramer-Rao bound, infinite if the true pairs fix none."""
    covariance = bound_covariance(problem)
    return np.inf if covariance is None else float(np.sqrt(np.trace(covariance[:3, :3])))


def _localized(given: MatchedProblem) -> Pose | None:
    problem = given.problem
    frame = problem.observed, problem.submap, problem.camera
    found = localize_matches(
        *frame, given.pairs, given.score, prior=problem.prior, detector=DETECTOR
    )
    return getattr(found, "T_camera_map", None)


def _matched_problem(seed: int) -> MatchedProblem:
    problem = make_problem(seed, Kind())
    rng = np.random.default_rng([seed, 4])
    possible = problem.observed.class_id[:, None] == problem.submap.class_id
    possible[tuple(problem.pairs.T)] = False
    wrong = rng.permutation(np.argwhere(possible))[: 4 * len(problem.pairs)]
    pairs = np.concatenate([problem.pairs, wrong])
    true = np.arange(len(pairs)) < len(problem.pairs)
    score = np.where(true, rng.beta(3.0, 2.0, len(pairs)), rng.beta(2.0, 3.0, len(pairs)))
    order = rng.permutation(len(pairs))
    return MatchedProblem(problem, pairs[order], score[order], true[order])


def _lost_frames(options: Options, copies: int) -> Iterator[LocalizationProblem]:
    """Yield frames with eight detections or more, without a fix: the map is the whole of KITTI 00,
    or as many copies of it, drawn anew, side by side."""
    assert options.kitti_poses is not None
    assert options.pole_maps is not None
    poses, poles = options.kitti_poses / "00.txt", options.pole_maps / "kitti_00.npz"
    road = kitti_road(poses, poles, "00")
    low, high = road.center_m.min(axis=0), road.center_m.max(axis=0)
    size = high - low + 200.0
    seed = 5000
    worlds = [mapped_elements(road, seed + 500 * copy) for copy in range(copies)]
    shifts = [np.array([size[0] * (k % 4), size[1] * (k // 4), 0.0]) for k in range(copies)]
    first = np.cumsum([0, *(len(world) for world in worlds)])
    parts = [
        replace(world, id=start + np.arange(len(world)), anchor_m=world.anchor_m + shift,
                end_m=world.end_m + shift)
        for world, start, shift in zip(worlds, first, shifts, strict=False)
    ]  # fmt: skip
    whole = parts[0]
    for part in parts[1:]:
        whole = joined(whole, part)
    driven = np.concatenate([road.thinned_m + shift for shift in shifts])
    middle = 0.5 * (driven.min(axis=0) + driven.max(axis=0))
    sigma_m = float(np.linalg.norm(driven.max(axis=0) - middle)) / 3.0
    made = 0
    for index in np.random.default_rng(9).permutation(len(road)).tolist():
        problem = make_road_problem(seed, None, road, index)
        if len(problem.observed) < 8:
            continue
        made += 1
        if made > max(options.frames // 4, 1):
            return
        prior = replace(problem.prior, position_m=middle, horizontal_sigma_m=sigma_m, road_m=driven)
        rows = np.flatnonzero(np.isin(worlds[0].id, problem.submap.id))
        where = {int(worlds[0].id[row]): int(row) for row in rows}
        pairs = np.array([(i, where[int(problem.submap.id[j])]) for i, j in problem.pairs])
        yield replace(problem, submap=whole, prior=prior, pairs=pairs.reshape(-1, 2))


if __name__ == "__main__":
    main(tyro.cli(Options))
