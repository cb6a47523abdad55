"""Whether the stated confidence of a diagnosis holds: how often those of 90 % are right.

    python bench/diagnosis_reliability.py --picture docs/images/diagnosis-reliability.png
    python bench/diagnosis_reliability.py --first-seed 0     (the shares behind CONFIDENCE)

One fault is planted in each frame, every kind equally often, and as many frames have faults that
the diagnosis has no kind for: lens distortion, a rolling shutter, a mirrored or a resized image.
There, "unexplained" is right. A named kind is right as in bench/diagnosis.py.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import get_args

import matplotlib
import numpy as np
import tests_support  # noqa: F401
import tyro
from diagnosis import KINDS, MEANS, ROADS, UNDECIDED, is_meant, told
from support.planted_causes import CAUSES, UNKNOWN, plant_cause, plant_unknown
from support.planted_faults import Planted, plant

from semviz_core.diagnosis.fault import FrameDiagnosis, GroundTruthLevel
from semviz_core.diagnosis.frame import diagnose_frame
from semviz_core.research.evaluation.problems import DETECTOR
from semviz_core.research.evaluation.roads import simulated_road

EDGES = np.array([0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0001])
"""Of the classes of stated confidence."""
LEAST_DRAWN = 5
"""Diagnoses of a class in the picture."""
COLOURS = {"pose and ids": "#1f77b4", "pose": "#e08214", "nothing": "#2a9d5c"}
WORDS = {"pose and ids": "true pose and ids", "pose": "true pose", "nothing": "no ground truth"}


@dataclass(frozen=True)
class Options:
    frames: int = 60
    """Of each kind; as many have unknown faults, in all."""
    first_seed: int = 6000
    picture: Path | None = None


@dataclass(frozen=True)
class Stated:
    """A diagnosis, and whether it was right."""

    kind: str
    confidence: float
    is_right: bool
    weight: float


def planted_frames(options: Options) -> Iterator[Planted]:
    roads = [simulated_road(options.first_seed + k) for k in range(ROADS)]
    for kind in (*KINDS, *UNKNOWN):
        count = options.frames // len(UNKNOWN) if kind in UNKNOWN else options.frames
        seed = options.first_seed
        while count:
            road = roads[seed % ROADS]
            if kind in UNKNOWN:
                case = plant_unknown(kind, seed, road)
            elif kind in CAUSES:
                case = plant_cause(kind, seed, road)
            else:
                case = plant(kind, seed, road, 0.0)
            seed += 1
            if case is not None:
                count -= 1
                yield case


def stated(case: Planted, knowledge: GroundTruthLevel) -> Stated | None:
    """Return the diagnosis; None for a healthy frame, of which none is stated."""
    truth = told(case.truth, knowledge)
    found = diagnose_frame(case.localization, case.semantic_map, truth, DETECTOR)
    if found.kind == "healthy" or case.is_healthy:
        return None
    return Stated(found.kind, found.confidence, _is_right(found, case), 1.0)


def _is_right(found: FrameDiagnosis, case: Planted) -> bool:
    if found.kind == UNDECIDED:
        return case.fault in MEANS
    return found.kind == case.fault and is_meant(found.fault, case)


def main(options: Options) -> None:
    cases = list(planted_frames(options))
    results = {
        knowledge: [one for case in cases if (one := stated(case, knowledge)) is not None]
        for knowledge in get_args(GroundTruthLevel)
    }
    for knowledge, all_stated in results.items():
        print(f"\n{WORDS[knowledge]}: {len(all_stated)} diagnoses of failed frames")
        for count, said, right in classes(all_stated):
            print(f"  stated {said:6.1%}   right {right:6.1%}   {count:5d} diagnoses")
        print("  shares: " + ", ".join(shares(all_stated)))
    if options.picture is not None:
        draw(results, options.picture)


def classes(all_stated: list[Stated]) -> Iterator[tuple[int, float, float]]:
    """Yield number, mean stated confidence and share right of each class."""
    said = np.array([one.confidence for one in all_stated])
    right = np.array([one.is_right for one in all_stated])
    for low, high in pairwise(EDGES):
        rows = (said >= low) & (said < high)
        if rows.any():
            yield int(rows.sum()), float(said[rows].mean()), float(right[rows].mean())


def shares(all_stated: list[Stated]) -> list[str]:
    """Return the share right of each kind, by Laplace's rule."""
    by_kind: dict[str, list[bool]] = defaultdict(list)
    for one in all_stated:
        by_kind[one.kind].append(one.is_right)
    return [
        f'"{kind}": {(sum(right) + 1) / (len(right) + 2):.2f}' for kind, right in by_kind.items()
    ]


def draw(results: dict[GroundTruthLevel, list[Stated]], path: Path) -> None:
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5.2, 4.6), dpi=120)
    axes.plot([0, 1], [0, 1], color="#999999", linewidth=1.0, linestyle="--")
    for knowledge, all_stated in results.items():
        drawn = [one for one in classes(all_stated) if one[0] >= LEAST_DRAWN]
        count, said, right = np.array(drawn).T
        sigma = np.sqrt(right * (1.0 - right) / count + 0.25 / count**2)
        axes.errorbar(
            said, right, 2.0 * sigma, fmt="o-", markersize=5, linewidth=1.2, capsize=3,
            color=COLOURS[knowledge], label=WORDS[knowledge],
        )  # fmt: skip
    axes.set(xlim=(0, 1.02), ylim=(0, 1.02), xlabel="stated confidence", ylabel="share right")
    axes.legend(loc="upper left", frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)
    print(f"{path}: reliability diagram")


if __name__ == "__main__":
    main(tyro.cli(Options))
