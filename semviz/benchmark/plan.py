"""What a benchmark does: which methods answer which problems, and what must not be mixed."""

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import semviz_core
from semviz import __version__
from semviz.benchmark.methods import Kind
from semviz.benchmark.suites import DRIVE_FRAMES, Noise, Roads, Suite
from semviz_core.evaluation.answers import BOUNDS
from semviz_core.evaluation.outcomes import Outcome

TUNING_SEEDS = 1000
"""Seeds below tune; figures that are reported come from the others."""
Key = tuple[str, str, str, int]
"""Of an outcome: suite, noise, method, frame."""


@dataclass(frozen=True)
class Task:
    """One problem, or a drive of several frames, and the methods that are to answer it."""

    suite: Suite
    noise: Noise
    seeds: range
    methods: tuple[str, ...]


@dataclass(frozen=True)
class Plan:
    """Suites, noises, methods and frames, on roads."""

    suites: tuple[Suite, ...]
    noises: tuple[Noise, ...]
    methods: dict[Kind, tuple[str, ...]]
    seeds: range
    roads: Roads

    def outcomes(self) -> list[Key]:
        """All outcomes, in the order of the tables: method by method."""
        return [
            (suite.name, noise, method, seed)
            for suite in self.suites
            for noise in self.noises
            for method in self.answering(suite)
            for seed in self.seeds
        ]

    def answering(self, suite: Suite) -> list[str]:
        """Methods for the suite; no bounds where there is none."""
        named = self.methods[suite.kind]
        return [method for method in named if suite.has_bound or method not in BOUNDS]

    def tasks(self, done: Iterable[Key]) -> list[Task]:
        """What is left to do, in the order of work: problem by problem."""
        finished = set(done)
        tasks = [
            Task(suite, noise, seeds, tuple(
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
        """The seeds of each problem."""
        size = DRIVE_FRAMES if suite.kind == "sequence" else 1
        return [self.seeds[first : first + size] for first in range(0, len(self.seeds), size)]

    def notes(self) -> list[str]:
        if self.seeds.start >= TUNING_SEEDS:
            return []
        return [f"seeds below {TUNING_SEEDS} are for tuning; report figures of others"]

    def settings(self) -> dict[str, Any]:
        """What results depend on beside their key."""
        return {
            "semviz": __version__,
            "code": code_digest(),
            "seed": self.seeds.start,
            "roads": self.roads.digest(),
        }


def key(outcome: Outcome) -> Key:
    return outcome.suite, outcome.noise, outcome.method, outcome.frame


def code_digest() -> str:
    """Of what makes problems and answers them: results of two versions are not mixed."""
    folder = Path(semviz_core.__file__).parent
    content = hashlib.sha256()
    for path in sorted([*folder.rglob("*.py"), *folder.rglob("*.safetensors")]):
        content.update(path.relative_to(folder).as_posix().encode() + path.read_bytes())
    return content.hexdigest()[:12]
