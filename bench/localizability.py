"""Localizability predicted from the map, compared with the results of the localizer.

    python bench/localizability.py
    python bench/localizability.py --kitti-poses DIR --pole-maps DIR --sequences 09 10
    python bench/localizability.py --plot docs/images/localizability-check.png
    python bench/localizability.py --speed

Roads are the benchmark's (seeds from 1000 on): the prediction knows the map with its errors, not
what really stands there. Streets have a detector of their own, and cars and hedges that hide.
Errors are means over frames at one position, none counted as more than 1 m, a frame without a pose
as 1 m. Rank correlations are Spearman's, over positions; in brackets the correlation of one half of
the real frames with the other, which tells how far chance alone lets anyone come.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
import tyro
from scipy.stats import spearmanr

from semviz_core.base.detector_model import NOISE, SIMULATED_DETECTOR
from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localizability.expected_error import LOST_M
from semviz_core.localizability.predict import Localizability, predict
from semviz_core.localizability.route import Conditions
from semviz_core.localization.localizer import Localizer
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import (
    CAMERA,
    DETECTOR,
    Difficulty,
    make_problem,
    mapped_elements,
)
from semviz_core.research.evaluation.roads import (
    BenchmarkRoad,
    kitti_road,
    simulated_road,
    with_errors,
)
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

Noise = Literal["low", "paper"]
FIRST_SEED = 1000
STEP_M = 2
GAIN_FRAMES = 4
"""So many times more frames tell what a new element brings: that is a difference of two means."""
Answer: TypeAlias = tuple[Localization, Pose]
"""What the localizer says, and the true T_camera_map."""
Look: TypeAlias = Callable[[int, int], Answer]
"""A real frame, localized: by position along the route and number of the frame there."""


@dataclass(frozen=True)
class Options:
    roads: int = 2
    """Simulated roads, and streets, for each noise."""
    meters: int = 400
    """Of each of them."""
    frames: int = 12
    """Real frames at each position."""
    kitti_poses: Path | None = None
    """KITTI's poses, and the surveyed poles for them; without, simulated roads alone."""
    pole_maps: Path | None = None
    sequences: tuple[str, ...] = ("09", "10")
    plot: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png")] = None
    """Draw predicted over real errors."""
    speed: bool = False
    """Only time 1,000 positions in a map of 10,000 elements."""


@dataclass(frozen=True, eq=False)
class Real:
    """What came out at k positions."""

    error_m: FloatArray  # (k, frames) bounded
    ambiguous: FloatArray  # (k, frames) 1.0 where not sure, or sure and wrong


def main(options: Options) -> None:
    if options.speed:
        time_it()
        return
    print(f"{'route, noise':<24}{'error: rho':>18}{'mean, real':>16}{'ambiguous: rho':>18}"
          f"{'mean, real':>16}{'s':>6}")  # fmt: skip
    drawn = {}
    for noise in ("low", "paper"):
        for road, seed in roads(options):
            drawn[f"{road.name}, {noise}"] = check_road(road, seed, noise, options)
        for seed in range(FIRST_SEED, FIRST_SEED + options.roads):
            drawn[f"street-{seed}, {noise}"] = check_street(seed, noise, options)
    if options.plot is not None:
        draw(drawn, options.plot)


def time_it() -> None:
    """A road's first kilometre, in a map that goes on far beyond it; compiled before."""
    road, conditions = simulated_road(FIRST_SEED), Conditions(DETECTOR, crop_radius_m=50.0)
    near = mapped_elements(road, FIRST_SEED)
    copies = -(-10_000 // len(near))
    far = [
        replace(
            near.transformed(Pose(np.eye(3), np.array([5e3 * k, 0.0, 0.0]))), id=near.id + k * 10**6
        )
        for k in range(copies)
    ]
    elements = reduce(joined, far)[:10_000]
    semantic_map = SemanticMap(elements, MapFrame(road.name), trajectory_m=road.center_m)
    predict(semantic_map, CAMERA, road.T_map_camera[:2], conditions)
    wall, cpu = time.perf_counter(), time.process_time()
    predict(semantic_map, CAMERA, road.T_map_camera[:1000], conditions)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"1,000 positions, 10,000 elements: {wall:.0f} s, of them computing {cpu:.0f} s")


def roads(options: Options) -> list[tuple[BenchmarkRoad, int]]:
    seeds = range(FIRST_SEED, FIRST_SEED + options.roads)
    found = [(simulated_road(seed), seed) for seed in seeds]
    if options.kitti_poses is not None and options.pole_maps is not None:
        for name in options.sequences:
            poles = options.pole_maps / f"kitti_{name}.npz"
            road = kitti_road(options.kitti_poses / f"{name}.txt", poles, f"kitti-{name}")
            found.append((road, FIRST_SEED))
    return found


def check_road(
    road: BenchmarkRoad, seed: int, noise: Noise, options: Options
) -> tuple[Localizability, Real]:
    """Along the first part of a road of the benchmark."""
    difficulty = Difficulty(noise=noise)
    elements = mapped_elements(road, seed, difficulty)
    semantic_map = SemanticMap(elements, MapFrame(road.name), trajectory_m=road.center_m)
    prior = PriorOptions(vertical_sigma_m=difficulty.vertical_sigma_m)
    conditions = Conditions(DETECTOR, NOISE[noise], prior=prior, crop_radius_m=difficulty.crop_m)
    places = range(0, min(options.meters, len(road)), STEP_M)
    poses = tuple(road.T_map_camera[place] for place in places)
    start = time.perf_counter()
    predicted = predict(semantic_map, CAMERA, poses, conditions)
    seconds = time.perf_counter() - start
    localizer = Localizer(detector=DETECTOR)

    def look(added: Elements3D | None) -> Look:
        def answer(position: int, number: int) -> Answer:
            problem = make_problem(
                seed, difficulty, road, places[position], variant=number, added=added
            )
            return localizer.localize(
                problem.observed, problem.submap, problem.camera, problem.prior
            ), (problem.T_camera_map)

        return answer

    real = collect(look(None), range(len(poses)), options.frames)
    report(f"{road.name}, {noise}", predicted, real, seconds)
    report_gain(predicted, look, GAIN_FRAMES * options.frames)
    return predicted, real


def check_street(seed: int, noise: Noise, options: Options) -> tuple[Localizability, Real]:
    """Along a simulated street, as ``semviz localize`` would."""
    street = Street(seed, StreetOptions(options.meters // STEP_M, float(STEP_M)))
    semantic_map = with_errors(street.truth_map, seed)
    camera = street.rig.left
    conditions = Conditions(SIMULATED_DETECTOR, NOISE[noise], crop_radius_m=50.0)
    poses = tuple(frame.T_map_camera for frame in street.frames if frame.T_map_camera is not None)
    start = time.perf_counter()
    predicted = predict(semantic_map, camera, poses, conditions)
    seconds = time.perf_counter() - start
    localizer = Localizer(detector=SIMULATED_DETECTOR)

    def look(position: int, number: int) -> Answer:
        observed = SimulatedDetector(street, noise, number).detect(position).observed
        prior = simulate_prior(poses[position], conditions.prior, (number, position))
        road_m = semantic_map.road_near(prior.position_m, conditions.road_radius_m)
        submap = semantic_map.crop(prior.position_m, conditions.crop_radius_m)
        answer = localizer.localize(observed, submap, camera, replace(prior, road_m=road_m))
        return answer, poses[position].inverse()

    real = collect(look, range(len(poses)), options.frames)
    report(f"street-{seed}, {noise}", predicted, real, seconds)
    return predicted, real


def collect(look: Look, positions: range, frames: int) -> Real:
    error_m, ambiguous = np.empty((2, len(positions), frames))
    for row, position in enumerate(positions):
        for number in range(frames):
            answer, truth = look(position, number)
            off_m = LOST_M
            if answer.T_camera_map is not None:
                off_m = min(pose_error(answer.T_camera_map, truth)[0], LOST_M)
            error_m[row, number] = off_m
            wrong = answer.status == "ok" and off_m == LOST_M
            ambiguous[row, number] = answer.status == "ambiguous" or wrong
    return Real(error_m, ambiguous)


def report(name: str, predicted: Localizability, real: Real, seconds: float) -> None:
    error_m, ambiguous = real.error_m.mean(axis=1), real.ambiguous.mean(axis=1)
    print(
        f"{name:<24}{rank(predicted.expected_m, error_m):>10.2f} ({halves(real.error_m):.2f})"
        f"{predicted.expected_m.mean():>9.2f} {error_m.mean():>6.2f}"
        f"{rank(predicted.ambiguous, ambiguous):>11.2f} ({halves(real.ambiguous):.2f})"
        f"{predicted.ambiguous.mean():>9.2f} {ambiguous.mean():>6.2f}{seconds:>6.0f}",
        flush=True,
    )


def report_gain(
    predicted: Localizability, look: Callable[[Elements3D | None], Look], frames: int
) -> None:
    """What the first suggested element was said to bring, and what it brings put up."""
    for effect in predicted.suggested[:1]:
        felt = np.flatnonzero(
            (predicted.along_m >= effect.first_m) & (predicted.along_m <= effect.last_m)
        )
        positions = range(int(felt[0]), int(felt[-1]) + 1)
        before = collect(look(None), positions, frames).error_m.mean()
        after = collect(look(effect.element), positions, frames).error_m.mean()
        print(
            f"    a new element, over {effect.last_m - effect.first_m:.0f} m: said "
            f"{effect.before_m:.2f} to {effect.after_m:.2f} m, got {before:.2f} to {after:.2f} m",
            flush=True,
        )


def rank(first: FloatArray, other: FloatArray) -> float:
    return float(spearmanr(first, other).statistic)


def halves(values: FloatArray) -> float:
    """Rank correlation over positions of the means of either half of the frames (k, frames)."""
    return rank(values[:, ::2].mean(axis=1), values[:, 1::2].mean(axis=1))


def draw(drawn: dict[str, tuple[Localizability, Real]], path: Path) -> None:
    from matplotlib.figure import Figure

    from semviz.presentation.plots import COLORS

    figure = Figure(figsize=(10.0, 4.6), layout="constrained")
    for axis, noise in zip(figure.subplots(1, 2), ("low", "paper"), strict=True):
        chosen = {name: value for name, value in drawn.items() if name.endswith(noise)}
        for color, (name, (predicted, real)) in zip(COLORS, chosen.items(), strict=False):
            axis.plot(
                predicted.expected_m, real.error_m.mean(axis=1), ".", color=color, label=name,
                markersize=5, alpha=0.7,
            )  # fmt: skip
        axis.plot([0.0, 1.0], [0.0, 1.0], color="0.3", linewidth=1.0, zorder=0)
        axis.set(xlabel="predicted from the map (m)", ylabel="mean error (m)", aspect="equal")
        axis.legend(loc="upper left", fontsize="small", frameon=False)
        axis.grid(color="0.88", linewidth=0.7)
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main(tyro.cli(Options))
