"""Verdicts on planted faults: which kind is named, as a confusion matrix.

    python bench/verdicts.py
    python bench/verdicts.py --first-seed 0 --frames 100     (tuning; shares for trust.py)

One fault a frame (or a run of ten frames), on frames that are healthy without it; which faults
count is told in semviz_core.evaluation.planted and planted_runs. Told three times: with the true
pose and the true element of each detection, with the true pose alone, and with nothing.

Named is the verdict of a frame that failed; of one that is healthy all the same, the first fault
noticed in it. Right is the planted kind, of the planted element or detection. A number in the row
``healthy`` outside of its column is a false alarm. Of runs, all faults named count: one that was
not planted makes the run wrong.
"""

from collections import Counter
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import tyro

from semviz_core.evaluation.planted import PLANTED, Planted, plant
from semviz_core.evaluation.planted_runs import FRAMES, PlantedRun, plant_in_run
from semviz_core.evaluation.problems import DETECTOR
from semviz_core.evaluation.roads import simulated_road
from semviz_core.explaining.explain import explain
from semviz_core.explaining.run_verdict import explain_run
from semviz_core.explaining.told import FALSE, Fault, Kind, Knowledge, Truth

KINDS: tuple[Kind, ...] = ("healthy", *PLANTED)
RUN_KINDS: tuple[Kind, ...] = (
    "healthy", "wrong calibration", "moved in the map", "missing in the map", "twice in the map",
)  # fmt: skip
UNDECIDED: Kind = "false or not mapped"
MEANS: tuple[Kind, ...] = ("false detection", "missing in the map", "moved in the map")
"""What may be behind ``UNDECIDED``: one frame without ids cannot tell them apart."""
ROADS = 8
LONG = 100
"""Frames of the longer runs."""
Counts = dict[Kind, Counter[str]]


@dataclass(frozen=True)
class Options:
    frames: int = 200
    """Of each kind."""
    runs: int = 40
    """Of each kind, of ten frames."""
    first_seed: int = 1000
    false_detections: float = 0.0
    """Mean number in an image, beside what is planted; noticed too, and no alarms."""


def main(options: Options) -> None:
    roads = [simulated_road(options.first_seed + k) for k in range(ROADS)]
    frames: dict[Knowledge, Counts] = {one: {} for one in get_args(Knowledge)}
    for fault in KINDS:
        planted = []
        seed = options.first_seed
        while len(planted) < options.frames:
            if (
                one := plant(fault, seed, roads[seed % ROADS], options.false_detections)
            ) is not None:
                planted.append(one)
            seed += 1
        harmed = sum(not one.is_healthy for one in planted)
        print(f"{fault}: {len(planted)} frames, {harmed} fail", flush=True)
        for knowledge, counts in frames.items():
            counts[fault] = Counter(named(one, knowledge) for one in planted)
    for knowledge, counts in frames.items():
        print_matrix(f"frames, told with: {knowledge}", counts)
        print_trust(counts)
    for count, share in ((FRAMES, 1), (LONG, 4)):
        print_runs(options, count, max(options.runs // share, 1))


def print_runs(options: Options, count: int, runs: int) -> None:
    roads = [simulated_road(options.first_seed + k) for k in range(ROADS)]
    found: dict[Knowledge, Counts] = {one: {} for one in get_args(Knowledge)}
    for fault in RUN_KINDS:
        drives = []
        seed = options.first_seed
        while len(drives) < runs:
            drive = plant_in_run(fault, seed, roads[seed % ROADS], count)
            if drive is not None:
                drives.append(drive)
            seed += 1
        for knowledge, counts in found.items():
            counts[fault] = Counter(named_in_run(one, knowledge) for one in drives)
    for knowledge, counts in found.items():
        print_matrix(f"{runs} runs of {count} frames, told with: {knowledge}", counts)


def told(truth: Truth, knowledge: Knowledge) -> Truth | None:
    if knowledge == "nothing":
        return None
    return truth if knowledge == "pose and ids" else replace(truth, element_id=None)


def named(one: Planted, knowledge: Knowledge) -> str:
    verdict = explain(one.localization, one.semantic_map, told(one.truth, knowledge), DETECTOR)
    fault = verdict.fault
    if fault.kind == "healthy" and verdict.noticed:
        truly_false = np.flatnonzero(one.truth.element_id == FALSE)
        noticed = [
            other for other in verdict.noticed
            if set(other.rows) - set(truly_false) or set(other.rows) & set(one.rows)
        ]  # fmt: skip
        fault = noticed[0] if noticed else fault
    if fault.kind == one.fault and not is_meant(fault, one):
        return "another one"
    return fault.kind


def is_meant(fault: Fault, one: Planted) -> bool:
    """Whether a fault of the planted kind is the planted one."""
    if one.elements and fault.elements:
        return bool(set(one.elements) & set(fault.elements))
    return not one.rows or not fault.rows or bool(set(one.rows) & set(fault.rows))


def named_in_run(one: PlantedRun, knowledge: Knowledge) -> str:
    frames = [(found, told(truth, knowledge)) for found, truth in one.frames]
    verdict = explain_run(frames, one.semantic_map, DETECTOR)
    if verdict.calibration is not None:
        return verdict.calibration.kind
    wrong = [
        fault for fault in verdict.elements
        if fault.kind != one.fault
        or (fault.elements and one.elements and not set(fault.elements) & set(one.elements))
    ]  # fmt: skip
    if wrong:
        return "another one" if wrong[0].kind == one.fault else wrong[0].kind
    return verdict.elements[0].kind if verdict.elements else "healthy"


def print_matrix(title: str, counts: Counts) -> None:
    columns = [
        one for one in (*get_args(Kind), "another one")
        if any(counts[fault][one] for fault in counts)
    ]  # fmt: skip
    print(
        f"\n{title}\n{'planted':<22}" + "".join(f"{short(one):>7}" for one in columns) + "   right"
    )
    for fault, row in counts.items():
        cells = "".join(f"{row[one] or '.':>7}" for one in columns)
        share = row[fault] / row.total()
        print(f"{fault:<22}{cells}{share:>8.1%}")
    planted = [row[fault] / row.total() for fault, row in counts.items() if fault != "healthy"]
    undecided = [
        row[UNDECIDED] / row.total() if fault in MEANS else 0.0
        for fault, row in counts.items() if fault != "healthy"
    ]  # fmt: skip
    alarms = 1.0 - counts["healthy"]["healthy"] / counts["healthy"].total()
    print(
        f"named right {sum(planted) / len(planted):.1%}, and left open between false, missing and "
        f"moved {sum(undecided) / len(planted):.1%}; alarms on healthy ones {alarms:.1%}"
    )


def print_trust(counts: Counts) -> None:
    """Of the verdicts of each kind, the share that was right, every kind planted as often; by
    Laplace's rule, so that none is told with certainty."""
    said: Counter[str] = sum(counts.values(), Counter())
    right = {
        kind: sum(counts[one][UNDECIDED] for one in MEANS) if kind == UNDECIDED
        else counts[kind][kind] if kind in counts else 0
        for kind in get_args(Kind)
    }  # fmt: skip
    shares = {kind: (right[kind] + 1) / (said[kind] + 2) for kind in right if said[kind]}
    print("sure: " + ", ".join(f'"{kind}": {share:.2f}' for kind, share in shares.items()))


def short(kind: str) -> str:
    """Of a column's name, the first letters of its first words."""
    words = [one for one in kind.split() if one not in ("in", "the", "or", "not")]
    return " ".join(one[:3] for one in words[:2])[:6]


if __name__ == "__main__":
    main(tyro.cli(Options))
