"""Training of the verifier: which of a wide search's modes is right, or that none is."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.evaluation.problems import DETECTOR, Problem
from semviz_core.learning.drills import HELD_OUT, PUZZLES
from semviz_core.learning.evidence import Evidence
from semviz_core.learning.networks.verifier import Verifier
from semviz_core.learning.schedule import cosine
from semviz_core.learning.task import Progress
from semviz_core.solving.effort import WIDE
from semviz_core.solving.scene import Scene
from semviz_core.solving.search import Modes, apart, search
from semviz_core.solving.upright import assumed_upright

RATE = 2e-3
VERIFIER_SAMPLES = 200_000
DISTINCT = 16_000
"""Training goes round so many frames again and again: to search one takes far longer than to learn
from it."""
RIGHT_M, RIGHT_RAD = 1.0, float(np.deg2rad(2.0))
"""A mode that is closer to the truth than both is right."""


class ProblemSource(Protocol):
    """Problems by number: a pure function of it. Picklable; used in worker processes."""

    def problem(self, number: int) -> Problem:
        """Training problem ``number``; from HELD_OUT on, one that is never trained on."""

    def describe(self) -> dict[str, Any]:
        """What the problems are made with, as JSON."""


@dataclass(frozen=True, eq=False)
class Judged:
    """The modes of a frame, and which of them are right."""

    evidence: Evidence
    right: np.ndarray[Any, np.dtype[np.bool_]]  # (b,)


@dataclass(frozen=True, eq=False)
class JudgedBatch:
    """f frames side by side, padded; fields as in ``Evidence``."""

    mode: Tensor  # (f, b, OF_A_MODE)
    weight: Tensor  # (f, b) 0 where padded
    mapped: Tensor  # (f, b, k, ...)
    near: Tensor  # (f, b, k) 0 where padded
    seen: Tensor  # (f, b, m, ...)
    is_seen: Tensor  # (f, b, m) 0 where padded
    right: Tensor  # (f, b + 1) bool; the last is that none is

    def to(self, device: torch.device) -> "JudgedBatch":
        return JudgedBatch(*(getattr(self, name).to(device) for name in self.__dataclass_fields__))


class VerifierTask:
    """The verifier on frames with their answers, searched widely."""

    samples = VERIFIER_SAMPLES

    def __init__(self, name: str, source: ProblemSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.classes = classes
        self.made: dict[int, Judged] = {}
        self.network = Verifier(len(classes))
        self.options: dict[str, Any] = {
            "classes": [one.name for one in classes],
            "effort": WIDE._asdict(),
            "distinct": DISTINCT,
            "data": source.describe(),
        }

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATE)

    def make(self, number: int) -> Judged:
        """Kept in the process that made it."""
        number %= DISTINCT
        if number not in self.made:
            self.made[number] = judged(self.source.problem(number), self.classes)
        return self.made[number]

    def held_out(self, number: int) -> Judged:
        return judged(self.source.problem(HELD_OUT + number), self.classes)

    def collate(self, items: Sequence[Judged]) -> JudgedBatch:
        return collate(items)

    def losses(self, together: JudgedBatch, progress: Progress) -> dict[str, Tensor]:
        """Negative log-probability of what is right."""
        return {"loss": surprise(self._log_probability(together), together.right)}

    def finish(self) -> None:
        """Nothing is left to choose."""

    def figures(self, together: JudgedBatch) -> dict[str, Tensor]:
        """Shares of frames: the best-scored mode is right, the chosen one, any."""
        log_probability = self._log_probability(together)
        right = together.right[:, :-1]
        chosen = log_probability[:, :-1].argmax(dim=1, keepdim=True)
        return {
            "surprise": surprise(log_probability, together.right),
            "first": right[:, 0].double().mean(),
            "chosen": right.gather(1, chosen).double().mean(),
            "any": right.any(dim=1).double().mean(),
        }

    def _log_probability(self, together: JudgedBatch) -> Tensor:
        found: Tensor = self.network(
            together.mode,
            together.weight,
            together.mapped,
            together.near,
            together.seen,
            together.is_seen,
        )
        return found


def make_task(name: str, source: ProblemSource | None) -> VerifierTask:
    """With fresh weights; on simulated roads if no source is given."""
    return VerifierTask(name, source or PUZZLES)


def judged(problem: Problem, classes: ClassSet) -> Judged:
    """A problem searched widely, and judged by its answer."""
    scene = Scene.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    prior = assumed_upright(problem.prior)
    modes = search(scene, prior, WIDE)
    evidence = Evidence.of(problem.observed, problem.submap, problem.camera, prior, modes, classes)
    return Judged(evidence, right_modes(modes, problem)[: len(evidence.mode)])


def right_modes(modes: Modes, problem: Problem) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """(b,) which are close to the truth."""
    true = problem.T_camera_map
    away, angle = apart(true.rotation, true.translation, modes.rotation, modes.translation)
    return (away < RIGHT_M) & (angle < RIGHT_RAD)


def surprise(log_probability: Tensor, right: Tensor) -> Tensor:
    """Mean negative log-probability (f, b + 1) of what is right, of any of it."""
    return -log_probability.masked_fill(~right, -torch.inf).logsumexp(dim=1).mean()


def collate(items: Sequence[Judged]) -> JudgedBatch:
    evidence = [one.evidence for one in items]
    f, b = len(items), max(1, *(len(one.mode) for one in evidence))
    k = max(1, *(one.mapped.shape[1] for one in evidence))
    m = max(one.seen.shape[1] for one in evidence)
    right = torch.zeros(f, b + 1, dtype=torch.bool)
    is_seen = torch.zeros(f, b, m)
    for row, one in enumerate(items):
        right[row, : len(one.right)] = torch.from_numpy(one.right)
        right[row, -1] = not one.right.any()
        is_seen[row, : len(one.right), : one.evidence.seen.shape[1]] = 1.0
    return JudgedBatch(
        mode=_padded([one.mode for one in evidence], (b,)),
        weight=_padded([one.weight for one in evidence], (b,)),
        mapped=_padded([one.mapped for one in evidence], (b, k)),
        near=_padded([one.near for one in evidence], (b, k)),
        seen=_padded([one.seen for one in evidence], (b, m)),
        is_seen=is_seen,
        right=right,
    )


def _padded(arrays: Sequence[np.ndarray[Any, Any]], sizes: tuple[int, ...]) -> Tensor:
    """(f, *sizes, ...) of arrays whose first dimensions are at most ``sizes``; 0 elsewhere."""
    together = torch.zeros(len(arrays), *sizes, *arrays[0].shape[len(sizes) :])
    for row, one in enumerate(arrays):
        together[row][tuple(slice(size) for size in one.shape[: len(sizes)])] = torch.from_numpy(
            one
        )
    return together
