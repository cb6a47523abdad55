"""What-if on simulated streets: python bench/what_if.py [STREETS]

Streets with seeds from 1000 on (default: 20). Without noise, in every other frame: true
pairs forced; and one wrong pair forced, with the nearest of its class. With low noise and five
detections a frame, so that one fault matters: an element is moved or twice in the map, and where
that harms a frame it is dropped, or what is advised is tried. Last, the time of an answer.
"""

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from semviz.runs.diagnosis import detector_of, frame_diagnosis
from semviz.runs.metrics import errors_of
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz.what_if.change import WhatIfChange
from semviz.what_if.request_changes import DropElement, ForcePair, ForceTruePairs
from semviz.what_if.solve import best_suggestion, solve_with_changes
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Frame
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.datasets.priors import PriorOptions, simulate_prior
from semviz_core.localization.localizer import NEEDED_ELEMENTS, Localizer
from semviz_core.research.evaluation.roads import duplicate_element, move_element
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.street import Street

FIRST_SEED, STREETS = 1000, 20
CROP_M, ROAD_M = 50.0, 60.0
FEW = 5
HARMED_M, HARMED_TIMES = 0.3, 3.0
"""A fault harms where the error is above both; or where it takes an ``ok`` away."""
OFF_M = {"moved": (1.0, 3.0), "twice": (0.5, 1.0)}
Spoil = Callable[[SemanticMap, int, FloatArray], SemanticMap]
SPOILS: dict[str, Spoil] = {"moved": move_element, "twice": duplicate_element}


@dataclass(frozen=True, eq=False)
class Asked:
    """One frame in a map, as a run of its own."""

    run: Run
    record: FrameRecord

    @classmethod
    def of(
        cls, street: Street, mapped: SemanticMap, frame: Frame, seen: Elements2D, ids: IntArray,
        observations: str,
    ) -> "Asked":  # fmt: skip
        info = RunInfo(
            "bench", "", "search", 0, "0", "", street.rig, "street", observations,
            {"crop_radius_m": CROP_M},
        )  # fmt: skip
        run = Run(info, mapped, ())
        assert frame.T_map_camera is not None
        prior = simulate_prior(frame.T_map_camera, PriorOptions(), (0, frame.index))
        road_m = mapped.road_near(prior.position_m, ROAD_M)
        localizer = Localizer(classes=mapped.classes, detector=detector_of(run))
        found = localizer.localize(
            seen, mapped.crop(prior.position_m, CROP_M), street.rig.left,
            replace(prior, road_m=road_m),
        )  # fmt: skip
        return cls(run, FrameRecord(frame, found, ids))

    def with_(self, *changes: WhatIfChange) -> FrameRecord:
        return solve_with_changes(self.run, self.record, changes)

    def truly(self) -> IntArray:
        """(k, 2) rows of what is seen and in the submap, and its id."""
        ids = self.record.element_id
        rows = np.flatnonzero(np.isin(ids, self.record.localization.submap.id))
        return np.column_stack([rows, ids[rows]])


@dataclass(frozen=True)
class Planted:
    """One frame without and with a fault in the map."""

    sound: Asked
    faulty: Asked
    planted: int
    """Id of the element to be dropped."""


def error_m(record: FrameRecord) -> float:
    """Infinite without a pose."""
    errors = errors_of(record)
    return np.inf if errors is None else errors.distance_m


def streets(count: int) -> Iterator[Street]:
    return map(Street, range(FIRST_SEED, FIRST_SEED + count))


def exact_frames(count: int) -> Iterator[Asked]:
    """What is visible, without noise, in the true map; where enough is."""
    for street in streets(count):
        for frame in street.frames[::2]:
            seen, ids = street.labels(frame.index, "left")
            problem = Asked.of(street, street.truth_map, frame, seen, ids, "labels")
            if len(problem.truly()) >= NEEDED_ELEMENTS:
                yield problem


def few_seen(count: int) -> Iterator[tuple[Street, Frame, Elements2D, IntArray, int]]:
    """Five detections of elements that are there, and the id of the one that shall be at fault."""
    for street in streets(count):
        detector = SimulatedDetector(street, "low", 0)
        for frame in street.frames:
            rng = np.random.default_rng([FIRST_SEED, frame.index])
            found = detector.detect(frame.index)
            real = np.flatnonzero(found.element_id >= 0)
            if len(real) >= FEW:
                rows = np.sort(rng.choice(real, FEW, replace=False))
                ids = found.element_id[rows]
                yield street, frame, found.observed[rows], ids, int(rng.choice(ids))


def bench_exact(count: int) -> None:
    true_m, wrong = [], []
    for frame in exact_frames(count):
        true_m.append(error_m(frame.with_(ForceTruePairs())))
        wrong.append(_wrong_pair(frame))
    median, p95 = np.percentile(true_m, [50, 95])
    print(
        f"true pairs forced, {len(true_m)} frames without noise: error median {1e3 * median:.1f}, "
        f"95 % {1e3 * p95:.1f}, most {1e3 * max(true_m):.1f} mm"
    )
    made = [pair for pair in wrong if pair is not None]
    cannot = sum(np.isinf(after) for _, after in made)
    worse = sum(before < after < np.inf for before, after in made)
    print(
        f"one wrong pair forced, {len(made)} frames: no answer in {cannot}, worse in {worse}, "
        f"not worse in {len(made) - cannot - worse}"
    )


def _wrong_pair(asked: Asked) -> tuple[float, float] | None:
    """Errors before and after the first detection is forced to be another of its class."""
    submap, (row, element) = asked.record.localization.submap, asked.truly()[0].tolist()
    class_id = asked.record.localization.observed.class_id[row]
    others = submap[(submap.class_id == class_id) & (submap.id != element)]
    if not len(others):
        return None
    off_m = np.linalg.norm(others.anchor_m - submap.anchor_m[submap.id == element], axis=1)
    wrong = ForcePair(asked.record.frame.index, row, int(others.id[off_m.argmin()]))
    return error_m(asked.record), error_m(asked.with_(wrong))


def bench_planted(count: int, name: str, times_ms: list[float]) -> None:
    frames = [frame for frame in planted_frames(count, name) if _is_harmed(frame)]
    dropped = [frame.faulty.with_(DropElement(frame.planted)) for frame in frames]
    times_ms.extend(sum(record.localization.time_ms.values()) for record in dropped)
    advised = []
    for frame in frames:
        run, record = frame.faulty.run, frame.faulty.record
        best = best_suggestion(run, record, frame_diagnosis(run, record))
        advised.append(record if best is None else frame.faulty.with_(best))
    columns = {
        "without the fault": [frame.sound.record for frame in frames],
        "with it": [frame.faulty.record for frame in frames],
        "dropped": dropped,
        "advised": advised,
    }
    print(f"{name} in the map, {len(frames)} frames harmed:")
    for title, records in columns.items():
        errors_m = [error_m(record) for record in records]
        ok = sum(record.localization.status == "ok" for record in records)
        far = sum(value_m > HARMED_M for value_m in errors_m)
        print(
            f"  {title:18} median {np.median(errors_m):.2f} m, beyond {HARMED_M} m {far}, ok {ok}"
        )


def planted_frames(count: int, name: str) -> Iterator[Planted]:
    for street, frame, seen, ids, element in few_seen(count):
        rng = np.random.default_rng([FIRST_SEED + 1, frame.index])
        faulty, planted = _planted(street.truth_map, name, element, rng)
        yield Planted(
            Asked.of(street, street.truth_map, frame, seen, ids, "simulated"),
            Asked.of(street, faulty, frame, seen, ids, "simulated"),
            planted,
        )


def _planted(
    true: SemanticMap, name: str, element: int, rng: np.random.Generator
) -> tuple[SemanticMap, int]:
    """The map with a fault, and the id of what is to be dropped."""
    angle, off_m = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(*OFF_M[name])
    faulty = SPOILS[name](true, element, off_m * np.array([np.cos(angle), np.sin(angle), 0.0]))
    return faulty, element if name == "moved" else int(faulty.elements.id.max())


def _is_harmed(planted: Planted) -> bool:
    sound, faulty = planted.sound.record, planted.faulty.record
    was_ok, is_ok = (record.localization.status == "ok" for record in (sound, faulty))
    far = error_m(faulty) > max(HARMED_M, HARMED_TIMES * error_m(sound))
    return was_ok and (far or not is_ok)


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else STREETS
    bench_exact(count)
    times_ms: list[float] = []
    for name in SPOILS:
        bench_planted(count, name, times_ms)
    median, p95 = np.percentile(times_ms, [50, 95])
    print(f"an answer takes {median:.0f} ms, 95 % {p95:.0f} ms")


if __name__ == "__main__":
    main()
