"""Plan and run a benchmark: every method solves every problem, timed and stored.

Each problem is made from its seed. Outcomes are JSON lines, settings first, so that an
interrupted benchmark resumes. A digest of the relevant code prevents mixing results of two
versions.
"""

import hashlib
import json
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from functools import cache, partial
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from time import monotonic, perf_counter
from types import TracebackType
from typing import IO, Any

import semviz_core
from semviz.presentation.terminal import announce_compiling, track
from semviz.research.benchmark.suites import (
    SEQUENCE_FRAMES,
    Kind,
    NoiseLevel,
    Roads,
    Suite,
    make_method,
)
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.metrics.pose_errors import Outcome, ProblemFacts
from semviz_core.research.evaluation.methods import (
    BOUNDS,
    MatchedProblem,
    MethodResult,
    bound_covariance,
)
from semviz_core.research.evaluation.outcomes import errors, facts_of, published_errors
from semviz_core.research.evaluation.problems import LocalizationProblem
from semviz_core.research.evaluation.sequences import SequenceFrame

TUNING_SEEDS = 1000
"""Seeds below are for tuning; reported figures come from the others."""
Key = tuple[str, str, str, int]
"""Key of an outcome: suite, noise, method, frame."""


@dataclass(frozen=True)
class BenchmarkJob:
    """A problem (a frame or a sequence), and the methods to run on it."""

    suite: Suite
    noise: NoiseLevel
    seeds: range
    methods: tuple[str, ...]


@dataclass(frozen=True)
class BenchmarkPlan:
    """Suites, noises, methods and frames, on roads."""

    suites: tuple[Suite, ...]
    noises: tuple[NoiseLevel, ...]
    methods: dict[Kind, tuple[str, ...]]
    seeds: range
    roads: Roads

    def __post_init__(self) -> None:
        for suite in self.suites:
            if suite.has_pictures and self.roads.poses is not None:
                raise SemvizError(f"suite {suite.name} has its own streets: omit --kitti-poses")

    def outcomes(self) -> list[Key]:
        """Return the keys of all outcomes in the order of the tables: method by method."""
        return [
            (suite.name, noise, method, seed)
            for suite in self.suites
            for noise in self.noises
            for method in self.answering(suite)
            for seed in self.seeds
        ]

    def answering(self, suite: Suite) -> list[str]:
        """Return the methods for the suite, with bounds only if the suite has one."""
        named = self.methods[suite.kind]
        return [method for method in named if suite.has_bound or method not in BOUNDS]

    def tasks(self, done: Iterable[Key]) -> list[BenchmarkJob]:
        """Return the remaining jobs in the order of work: problem by problem."""
        finished = set(done)
        tasks = [
            BenchmarkJob(suite, noise, seeds, tuple(
                method
                for method in self.answering(suite)
                if any((suite.name, noise, method, seed) not in finished for seed in seeds)
            ))
            for suite in self.suites
            for noise in self.noises
            for seeds in self._parts(suite)
        ]  # fmt: skip
        return [task for task in tasks if task.methods]

    def _parts(self, suite: Suite) -> list[range]:
        """Return the seeds of each problem."""
        size = SEQUENCE_FRAMES if suite.kind == "sequence" else 1
        return [self.seeds[first : first + size] for first in range(0, len(self.seeds), size)]

    def notes(self) -> list[str]:
        if self.seeds.start >= TUNING_SEEDS:
            return []
        return [f"seeds below {TUNING_SEEDS} are for tuning; report figures of others"]

    def settings(self) -> dict[str, Any]:
        """Return the settings that results depend on besides their key."""
        return {
            "semviz": version("semviz"),
            "code": code_digest(),
            "seed": self.seeds.start,
            "roads": self.roads.digest(),
        }


def key(outcome: Outcome) -> Key:
    return outcome.suite, outcome.noise, outcome.method, outcome.frame


def code_digest() -> str:
    """Return a digest of the code, so that results of two versions are not mixed."""
    folder = Path(semviz_core.__file__).parent
    content = hashlib.sha256()
    for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.safetensors")]):
        content.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return content.hexdigest()[:12]


SYNC_S = 5.0
"""At most so much work is lost if the machine crashes; one line if only the process does."""


class Results:
    """An append-only file of JSON lines: settings first, then outcomes in the order of arrival.

    Opening reads the file and drops an incomplete last line. Raise SemvizError if it holds results
    of other settings, which must not be mixed.
    """

    def __init__(self, path: Path, settings: dict[str, Any]) -> None:
        self.path = path
        self.outcomes: dict[Key, Outcome] = {}
        path.parent.mkdir(parents=True, exist_ok=True)
        whole = self._read(settings)
        self._file: IO[bytes] = path.open("ab")
        self._file.truncate(whole)
        if not whole:
            self._append(settings)
        self._synced_s = monotonic()

    def add(self, outcomes: list[Outcome]) -> None:
        for outcome in outcomes:
            self._append(asdict(outcome))
            self.outcomes[key(outcome)] = outcome
        if monotonic() - self._synced_s > SYNC_S:
            self._sync()

    def __enter__(self) -> "Results":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._sync()
        self._file.close()

    def _read(self, settings: dict[str, Any]) -> int:
        """Fill ``outcomes``; return the length of the complete lines in bytes."""
        if not self.path.is_file():
            return 0
        content = self.path.read_bytes()
        whole = content.rfind(b"\n") + 1
        lines = content[:whole].splitlines()
        for number, line in enumerate(lines, 1):
            try:
                values = json.loads(line)
                if number == 1:
                    self._check(values, settings)
                else:
                    outcome = Outcome.from_json(values)
                    self.outcomes[key(outcome)] = outcome
            except (ValueError, TypeError, KeyError, AttributeError):
                raise SemvizError(
                    f"{self.path}, line {number}: not a benchmark's result; give another --out"
                ) from None
        return whole

    def _check(self, stored: dict[str, Any], settings: dict[str, Any]) -> None:
        differing = [
            f"{name} was {stored.get(name)}, is {value}"
            for name, value in settings.items()
            if stored.get(name) != value
        ]
        if differing:
            raise SemvizError(
                f"{self.path} has results of other settings ({'; '.join(differing)}): "
                "give another --out, or delete it"
            )

    def _append(self, values: dict[str, Any]) -> None:
        self._file.write(json.dumps(values).encode() + b"\n")
        self._file.flush()

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        self._synced_s = monotonic()


FEW = 10
"""Frames to warm up with."""
TimedResult = tuple[
    str, int, ProblemFacts, LocalizationProblem | SequenceFrame, MethodResult, float
]
"""Method, frame, its facts, the problem with its truth, the result and its wall time (ms)."""


def complete(plan: BenchmarkPlan, path: Path, jobs: int) -> list[Outcome]:
    """Return all outcomes of the plan in its order, computing those missing in ``path``.

    If interrupted, the next call resumes from the stored outcomes.
    """
    announce_compiling()
    with Results(path, plan.settings()) as results:
        tasks = plan.tasks(results.outcomes)
        for outcomes in track(_run(tasks, plan.roads, jobs), "benchmark", len(tasks)):
            results.add(outcomes)
        return [results.outcomes[key] for key in plan.outcomes()]


def _run(tasks: list[BenchmarkJob], roads: Roads, jobs: int) -> Iterator[list[Outcome]]:
    """Yield outcomes job by job: in order in this process, or as they come from several."""
    if jobs == 1:
        _use_one_core()
        yield from (run_task(task, roads, timed_alone=True) for task in tasks)
        return
    for task in {task.suite.kind: task for task in reversed(tasks)}.values():
        for name in task.methods:  # compile here once, not in each process
            _first_call_ms(task.suite, name, roads)
    with ProcessPoolExecutor(jobs, get_context("spawn"), _start_worker) as pool:
        waiting = [pool.submit(run_task, task, roads, timed_alone=False) for task in tasks]
        try:
            yield from (done.result() for done in as_completed(waiting))
        except BrokenProcessPool:
            raise SemvizError(
                "a process of the benchmark died (out of memory?); run again with fewer --jobs, "
                "it goes on where it stopped"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def run_task(task: BenchmarkJob, roads: Roads, timed_alone: bool) -> list[Outcome]:
    """Return the outcome of each method of ``task``."""
    solve = _solve_sequence if task.suite.kind == "sequence" else _solve_frame
    return [
        Outcome(
            task.suite.name, name, task.noise, seed, facts,
            result.status, *errors(result, problem.T_camera_map),
            total_ms, result.time_ms, _first_call_ms(task.suite, name, roads), timed_alone,
            *published_errors(result, problem.T_camera_map, problem.prior.position_m),
        )
        for name, seed, facts, problem, result, total_ms in solve(task, roads)
    ]  # fmt: skip


def _solve_frame(task: BenchmarkJob, roads: Roads) -> Iterator[TimedResult]:
    (seed,) = task.seeds
    task_problem = task.suite.problem(seed, task.noise, roads)
    problem = _frame_of(task_problem)
    for name in task.methods:
        method = make_method(task.suite, name)
        facts = facts_of(problem, _bound(task.suite, method, problem))
        _first_call_ms(task.suite, name, roads)  # so that the next one is warm
        yield name, seed, facts, problem, *_timed(partial(method.solve, task_problem))


def _bound(suite: Suite, method: Any, problem: LocalizationProblem) -> FloatArray | None:
    """Return the Cramer-Rao bound (6, 6) for the information that ``method`` uses."""
    if not suite.has_bound:
        return None
    return bound_covariance(problem, with_prior=suite.kind == "single" or method.with_prior)


def _solve_sequence(task: BenchmarkJob, roads: Roads) -> Iterator[TimedResult]:
    sequence = task.suite.sequence(task.seeds, task.noise, roads)
    for name in task.methods:
        _first_call_ms(task.suite, name, roads)
        results = make_method(task.suite, name).solve(sequence)
        for seed, frame in zip(task.seeds, sequence.frames, strict=True):
            facts = ProblemFacts(detections=len(frame.observed))
            yield name, seed, facts, frame, *_timed(partial(next, results))


def _timed(action: Callable[[], MethodResult]) -> tuple[MethodResult, float]:
    """Return the result and its wall time (ms); a SemvizError counts as ``cannot``."""
    start = perf_counter()
    try:
        result = action()
    except SemvizError as error:
        result = MethodResult(None, None, "cannot", str(error))
    return result, (perf_counter() - start) * 1e3


@cache
def _first_call_ms(suite: Suite, name: str, roads: Roads) -> float:
    """Return the wall time of the method's first call in this process, which compiles and loads.

    It uses tuning frames; for single frames, the one with the most detections, which reaches every
    stage.
    """
    method = make_method(suite, name)
    if suite.kind == "sequence":
        results = method.solve(suite.sequence(range(FEW), "low", roads))
        first_ms, *_ = [_timed(partial(next, results))[1] for _ in range(FEW)]
        return first_ms
    problems = (suite.problem(seed, "low", roads) for seed in range(FEW))
    warm_up = max(problems, key=lambda problem: len(_frame_of(problem).observed))
    return _timed(partial(method.solve, warm_up))[1]


def _frame_of(given: LocalizationProblem | MatchedProblem) -> LocalizationProblem:
    return given.problem if isinstance(given, MatchedProblem) else given


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches us too; our parent ends us
    _use_one_core()


def _use_one_core() -> None:
    """Limit OpenCV's threads, which no environment variable does."""
    import cv2

    cv2.setNumThreads(1)
