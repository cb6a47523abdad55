"""Runs a plan: each problem is made from its seed and answered by every method, timed."""

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter
from typing import Any

from semviz.benchmark.methods import make_method
from semviz.benchmark.plan import Plan, Task
from semviz.benchmark.results import Results
from semviz.benchmark.suites import Roads, Suite
from semviz.progress import tell_of_compiling, track
from semviz_core.arrays import FloatArray
from semviz_core.errors import SemvizError
from semviz_core.evaluation.answers import Answer
from semviz_core.evaluation.bound import bound_covariance
from semviz_core.evaluation.matched_problems import MatchedProblem
from semviz_core.evaluation.outcomes import Facts, Outcome, errors, facts_of
from semviz_core.evaluation.problems import Problem
from semviz_core.pose import Pose

FEW = 10
"""Frames to warm up with."""
Answered = tuple[str, int, Facts, Pose, Answer, float]
"""Method, frame, its facts, its true T_camera_map; the answer and its wall time (ms)."""


def complete(plan: Plan, path: Path, jobs: int) -> list[Outcome]:
    """All outcomes of the plan, in its order: those in the file at ``path``, and what it lacks.

    Interrupted, it keeps what is done; called again, it goes on from there.
    """
    tell_of_compiling()
    with Results(path, plan.settings()) as results:
        tasks = plan.tasks(results.outcomes)
        for outcomes in track(_run(tasks, plan.roads, jobs), "benchmark", len(tasks)):
            results.add(outcomes)
        return [results.outcomes[key] for key in plan.outcomes()]


def _run(tasks: list[Task], roads: Roads, jobs: int) -> Iterator[list[Outcome]]:
    """Outcomes task by task: in this process and in order, or in several as they come."""
    if jobs == 1:
        _use_one_core()
        yield from (run_task(task, roads, timed_alone=True) for task in tasks)
        return
    for task in {task.suite.kind: task for task in reversed(tasks)}.values():
        for name in task.methods:  # compiled once and told so, not by each process in silence
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


def run_task(task: Task, roads: Roads, timed_alone: bool) -> list[Outcome]:
    """What each method of ``task`` makes of its problem."""
    answered = _answer_drive if task.suite.kind == "sequence" else _answer_frame
    return [
        Outcome(
            task.suite.name, name, task.noise, seed, facts,
            answer.status, *errors(answer, truth),
            total_ms, answer.time_ms, _first_call_ms(task.suite, name, roads), timed_alone,
        )
        for name, seed, facts, truth, answer, total_ms in answered(task, roads)
    ]  # fmt: skip


def _answer_frame(task: Task, roads: Roads) -> Iterator[Answered]:
    (seed,) = task.seeds
    given = task.suite.problem(seed, task.noise, roads)
    problem = _frame_of(given)
    for name in task.methods:
        method = make_method(task.suite.kind, name)
        facts = facts_of(problem, _bound(task.suite, method, problem))
        _first_call_ms(task.suite, name, roads)  # so that the next one is warm
        yield name, seed, facts, problem.T_camera_map, *_timed(partial(method.answer, given))


def _bound(suite: Suite, method: Any, problem: Problem) -> FloatArray | None:
    """(6, 6) the least covariance of an estimator that is given what ``method`` is."""
    if not suite.has_bound:
        return None
    return bound_covariance(problem, with_prior=suite.kind == "single" or method.with_prior)


def _answer_drive(task: Task, roads: Roads) -> Iterator[Answered]:
    drive = task.suite.drive(task.seeds, task.noise, roads)
    for name in task.methods:
        _first_call_ms(task.suite, name, roads)
        answers = make_method(task.suite.kind, name).answers(drive)
        for seed, one in zip(task.seeds, drive.frames, strict=True):
            facts = Facts(detections=len(one.observed))
            yield name, seed, facts, one.T_camera_map, *_timed(partial(next, answers))


def _timed(action: Callable[[], Answer]) -> tuple[Answer, float]:
    """The answer and its wall time (ms); a method that refuses a problem cannot answer it."""
    start = perf_counter()
    try:
        answer = action()
    except SemvizError as error:
        answer = Answer(None, None, "cannot", str(error))
    return answer, (perf_counter() - start) * 1e3


@cache
def _first_call_ms(suite: Suite, name: str, roads: Roads) -> float:
    """Wall time of the method's first answer of the suite in this process: it compiles and loads.

    On frames for tuning; a single one has many detections, so that it reaches every stage.
    """
    method = make_method(suite.kind, name)
    if suite.kind == "sequence":
        answers = method.answers(suite.drive(range(FEW), "low", roads))
        first_ms, *_ = [_timed(partial(next, answers))[1] for _ in range(FEW)]
        return first_ms
    problems = (suite.problem(seed, "low", roads) for seed in range(FEW))
    given = max(problems, key=lambda one: len(_frame_of(one).observed))
    return _timed(partial(method.answer, given))[1]


def _frame_of(given: Problem | MatchedProblem) -> Problem:
    return given.problem if isinstance(given, MatchedProblem) else given


def _start_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches us too; our parent ends us
    _use_one_core()


def _use_one_core() -> None:
    """What the environment (set by the command) cannot say."""
    import cv2

    cv2.setNumThreads(1)
