"""Diagnoses of planted faults, as a confusion matrix of kinds.

    python bench/diagnosis.py
    python bench/diagnosis.py --first-seed 0 --frames 100     (tuning)
    python bench/diagnosis.py --frames 0 --fix-sigma-m 0.5    (runs with an inertial system)

Each frame (or run of ten frames) has one planted fault and is healthy without it;
tests/support/planted_faults.py and planted_runs.py define the faults. Each is diagnosed three
times: with the true pose and element ids, with the true pose alone, and without ground truth.

The named kind is the diagnosis of a failed frame, or the first secondary fault of a healthy one. It
is right if it is the planted kind, of the planted element or detection; *one of two* is
not. A number in the row ``healthy`` outside its column is a false alarm; as these are rare, there
are ten times as many healthy frames. A run is right only if all its faults are planted. Beside runs
without ground truth stands what an oracle names (bench/diagnosis_oracle.py).
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import get_args

import diagnosis_oracle
import numpy as np
import tests_support  # noqa: F401
import tyro
from support.planted_causes import CAUSES, plant_cause
from support.planted_faults import PLANTED, Planted, plant
from support.planted_runs import FRAMES, PlantedRun, plant_in_run

from semviz_core.diagnosis.fault import (
    FALSE_POSITIVE,
    Fault,
    FaultKind,
    GroundTruth,
    GroundTruthLevel,
)
from semviz_core.diagnosis.frame import diagnose_frame
from semviz_core.diagnosis.run import diagnose_run
from semviz_core.research.evaluation.problems import DETECTOR
from semviz_core.research.evaluation.roads import simulated_road

KINDS: tuple[FaultKind, ...] = ("healthy", *PLANTED, *CAUSES)
RUN_KINDS: tuple[FaultKind, ...] = (
    "healthy", "wrong calibration", "moved in the map", "missing in the map", "twice in the map",
    "misaligned map", "wrong extrinsic", "time offset", "wrong heading prior",
    "wrong detection sigma", "wrong odometry",
)  # fmt: skip
UNDECIDED: FaultKind = "false or not mapped"
MEANS: tuple[FaultKind, ...] = ("false detection", "missing in the map", "moved in the map")
"""What may be behind ``UNDECIDED``: one frame without ids cannot tell them apart."""
ONE_OF_TWO = "one of two"
"""The diagnosis names another kind, and says that the planted one looks the same: not right."""
ROADS = 8
HEALTHY = 10
"""Healthy frames for each of a kind."""
LONG = 100
"""Frames of the longer runs."""
Counts = dict[FaultKind, Counter[str]]


@dataclass(frozen=True)
class Options:
    frames: int = 200
    """Of each kind; 0 for runs alone."""
    runs: int = 40
    """Of each kind, and half as many of more than ten frames; 0 for frames alone."""
    lengths: tuple[int, ...] = (FRAMES, LONG)
    """Frames of the runs."""
    run_kinds: tuple[FaultKind, ...] = RUN_KINDS
    """What is planted in runs, beside nothing."""
    known: tuple[GroundTruthLevel, ...] = get_args(GroundTruthLevel)
    """Of runs."""
    fix_sigma_m: float | None = None
    """Accuracy of the position priors of runs: then they are the stated poses with this error."""
    first_seed: int = 1000
    false_detections: float = 0.0
    """Mean number per image besides the planted faults; reported too, but no false alarms."""


def main(options: Options) -> None:
    if options.frames:
        print_frames(options)
    if options.runs:
        for count in options.lengths:
            share = 1 if count <= FRAMES else 2
            print_runs(options, count, max(options.runs // share, 1))


def print_frames(options: Options) -> None:
    roads = [simulated_road(options.first_seed + k) for k in range(ROADS)]
    frames: dict[GroundTruthLevel, Counts] = {
        argument: {} for argument in get_args(GroundTruthLevel)
    }
    for fault in KINDS:
        planted = []
        seed = options.first_seed
        while len(planted) < options.frames * (HEALTHY if fault == "healthy" else 1):
            road = roads[seed % ROADS]
            case = (
                plant_cause(fault, seed, road)
                if fault in CAUSES
                else plant(fault, seed, road, options.false_detections)
            )
            if case is not None:
                planted.append(case)
            seed += 1
        harmed = sum(not case.is_healthy for case in planted)
        print(f"{fault}: {len(planted)} frames, {harmed} fail", flush=True)
        for knowledge, counts in frames.items():
            counts[fault] = Counter(named(case, knowledge) for case in planted)
    for knowledge, counts in frames.items():
        print_matrix(f"frames, told with: {knowledge}", counts)


def print_runs(options: Options, count: int, runs: int) -> None:
    roads = [simulated_road(options.first_seed + k) for k in range(ROADS)]
    found: dict[GroundTruthLevel, Counts] = {knowledge: {} for knowledge in options.known}
    oracle: dict[FaultKind, float] = {}
    for fault in dict.fromkeys(("healthy", *options.run_kinds)):
        drives = []
        seed = options.first_seed
        while len(drives) < runs:
            drive = plant_in_run(fault, seed, roads[seed % ROADS], count, options.fix_sigma_m)
            if drive is not None:
                drives.append(drive)
            seed += 1
        for knowledge, counts in found.items():
            counts[fault] = Counter(named_in_run(drive, knowledge) for drive in drives)
        if "nothing" in options.known:
            oracle[fault] = float(np.mean([is_named_by_oracle(drive) for drive in drives]))
        print(f"{fault}: {count} frames done", flush=True)
    for knowledge, counts in found.items():
        title = f"{runs} runs of {count} frames, told with: {knowledge}"
        print_matrix(title, counts, oracle if knowledge == "nothing" else None)


def told(truth: GroundTruth, knowledge: GroundTruthLevel) -> GroundTruth | None:
    if knowledge == "nothing":
        return None
    return truth if knowledge == "pose and ids" else replace(truth, element_id=None)


def named(planted: Planted, knowledge: GroundTruthLevel) -> str:
    diagnosis = diagnose_frame(
        planted.localization, planted.semantic_map, told(planted.truth, knowledge), DETECTOR
    )
    fault = diagnosis.fault
    if fault.kind == "healthy" and diagnosis.secondary_faults:
        truly_false = np.flatnonzero(planted.truth.element_id == FALSE_POSITIVE)
        secondary = [
            other for other in diagnosis.secondary_faults
            if not other.rows
            or set(other.rows) - set(truly_false)
            or set(other.rows) & set(planted.rows)
        ]  # fmt: skip
        fault = secondary[0] if secondary else fault
    if fault.kind == planted.fault and not is_meant(fault, planted):
        return "another one"
    return fault.kind


def is_meant(fault: Fault, planted: Planted) -> bool:
    """Whether a fault of the planted kind is the planted one."""
    if planted.elements and fault.elements:
        return bool(set(planted.elements) & set(fault.elements))
    return not planted.rows or not fault.rows or bool(set(planted.rows) & set(fault.rows))


def named_in_run(planted_run: PlantedRun, knowledge: GroundTruthLevel) -> str:
    frames = [(found, told(truth, knowledge)) for found, truth in planted_run.frames]
    diagnosis = diagnose_run(
        frames, planted_run.semantic_map, DETECTOR, odometry=planted_run.odometry
    )
    if diagnosis.causes:
        cause = diagnosis.causes[0]
        return ONE_OF_TWO if planted_run.fault in cause.rivals else cause.kind
    if diagnosis.calibration is not None:
        return diagnosis.calibration.kind
    wrong = [
        fault for fault in diagnosis.elements
        if fault.kind != planted_run.fault
        or (
            fault.elements
            and planted_run.elements
            and not set(fault.elements) & set(planted_run.elements)
        )
    ]  # fmt: skip
    if wrong:
        return "another one" if wrong[0].kind == planted_run.fault else wrong[0].kind
    return diagnosis.elements[0].kind if diagnosis.elements else "healthy"


def is_named_by_oracle(drive: PlantedRun) -> bool:
    """Whether an oracle names a run's fault without true poses; of a healthy run, no fault."""
    if drive.fault == "healthy":
        found = [diagnosis_oracle.nats(drive, kind) for kind in diagnosis_oracle.KINDS]
        return max(found) < diagnosis_oracle.NAMED_NATS
    if drive.fault in diagnosis_oracle.KINDS:
        return diagnosis_oracle.nats(drive, drive.fault) >= diagnosis_oracle.NAMED_NATS
    return named_in_run(drive, "pose and ids") == drive.fault


def print_matrix(
    title: str, counts: Counts, oracle: Mapping[FaultKind, float] | None = None
) -> None:
    columns = [
        argument for argument in (*get_args(FaultKind), ONE_OF_TWO, "another one")
        if any(counts[fault][argument] for fault in counts)
    ]  # fmt: skip
    print(
        f"\n{title}\n{'planted':<22}"
        + "".join(f"{short(column):>7}" for column in columns)
        + "   right"
        + "  oracle" * bool(oracle)
    )
    for fault, row in counts.items():
        cells = "".join(f"{row[column] or '.':>7}" for column in columns)
        share = row[fault] / row.total()
        beside = f"{oracle[fault]:>8.1%}" if oracle else ""
        print(f"{fault:<22}{cells}{share:>8.1%}{beside}")
    planted = [row[fault] / row.total() for fault, row in counts.items() if fault != "healthy"]
    undecided = [
        row[UNDECIDED] / row.total() if fault in MEANS else 0.0
        for fault, row in counts.items() if fault != "healthy"
    ]  # fmt: skip
    either = [row[ONE_OF_TWO] / row.total() for fault, row in counts.items() if fault != "healthy"]
    alarms = 1.0 - counts["healthy"]["healthy"] / counts["healthy"].total()
    print(
        f"named right {sum(planted) / len(planted):.1%}, as one of two "
        f"{sum(either) / len(either):.1%}, and left open between false, missing and "
        f"moved {sum(undecided) / len(planted):.1%}; alarms on healthy ones {alarms:.1%}"
    )
    if oracle:
        best = [share for fault, share in oracle.items() if fault != "healthy"]
        print(f"an oracle names {sum(best) / len(best):.1%}")


def short(kind: str) -> str:
    """Of a column's name, the first letters of its first words."""
    words = [word for word in kind.split() if word not in ("in", "the", "or", "not")]
    return " ".join(word[:3] for word in words[:2])[:6]


if __name__ == "__main__":
    main(tyro.cli(Options))
