"""Train the mode verifier: which mode of a wide search is right, or that none is.

A search takes far longer than a training step, so training repeats a fixed number of frames. A
mode within 1 m and 2 deg of the truth is right. The network itself is defined in
`semviz_core.localization.mode_verifier`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.localization.heading_votes import WIDE
from semviz_core.localization.mode_verifier import ModeFeatures, layer_sizes, log_odds
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.search import Modes, pose_distances, search
from semviz_core.localization.upright import assumed_upright
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem
from semviz_core.research.training.batch import Progress, cosine
from semviz_core.research.training.simulated_samples import HARD_DISTRIBUTION, HELD_OUT


class Verifier(nn.Module):
    """The network of ``semviz_core.localization.mode_verifier`` with trainable weights."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        for name, (inputs, outputs) in layer_sizes(classes).items():
            self.add_module(name, nn.Linear(inputs, outputs))
        for name in ("right", "straight", "none"):
            nn.init.zeros_(self.get_parameter(f"{name}.weight"))
            nn.init.zeros_(self.get_parameter(f"{name}.bias"))

    def forward(
        self,
        mode: Tensor,
        weight: Tensor,
        mapped: Tensor,
        near: Tensor,
        seen: Tensor,
        is_seen: Tensor,
    ) -> Tensor:
        """Return (f, b + 1) log-probabilities that each mode, or (last) none, is right."""
        right, none = log_odds(
            dict(self.named_parameters()), mode, weight, mapped, near, seen, is_seen
        )
        right = right.masked_fill(weight == 0.0, -torch.inf)
        return torch.cat([right, none[:, None]], dim=1).log_softmax(dim=1)


RATE = 2e-3
VERIFIER_SAMPLES = 200_000
DISTINCT = 16_000
"""Number of frames that training repeats: searching a frame takes far longer than a step on it."""
RIGHT_M, RIGHT_RAD = 1.0, float(np.deg2rad(2.0))
"""A mode closer to the truth than both is right."""


class ProblemSource(Protocol):
    """Problems as a pure function of their number. Picklable; used in worker processes."""

    def problem(self, number: int) -> LocalizationProblem:
        """Return training problem ``number``; from HELD_OUT on, a validation problem."""

    def describe(self) -> dict[str, Any]:
        """Return the settings of the problems as JSON."""


@dataclass(frozen=True, eq=False)
class LabelledModes:
    """The modes of a frame, and which of them are right."""

    features: ModeFeatures
    right: np.ndarray[Any, np.dtype[np.bool_]]  # (b,)


@dataclass(frozen=True, eq=False)
class LabelledModesBatch:
    """f frames, padded; fields as in ``ModeFeatures``."""

    mode: Tensor  # (f, b, MODE_FEATURES)
    weight: Tensor  # (f, b) 0 where padded
    mapped: Tensor  # (f, b, k, ...)
    near: Tensor  # (f, b, k) 0 where padded
    seen: Tensor  # (f, b, m, ...)
    is_seen: Tensor  # (f, b, m) 0 where padded
    right: Tensor  # (f, b + 1) bool; the last is that none is

    def to(self, device: torch.device) -> "LabelledModesBatch":
        return LabelledModesBatch(
            *(getattr(self, name).to(device) for name in self.__dataclass_fields__)
        )


class VerifierTask:
    """Training of the verifier on the modes of wide searches."""

    samples = VERIFIER_SAMPLES

    def __init__(self, name: str, source: ProblemSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.classes = classes
        self.made: dict[int, LabelledModes] = {}
        self.network = Verifier(len(classes))
        self.options: dict[str, Any] = {
            "classes": [class_.name for class_ in classes],
            "effort": WIDE._asdict(),
            "distinct": DISTINCT,
            "data": source.describe(),
        }

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATE)

    def make(self, number: int) -> LabelledModes:
        """Return item ``number``, cached in this process."""
        number %= DISTINCT
        if number not in self.made:
            self.made[number] = label_modes(self.source.problem(number), self.classes)
        return self.made[number]

    def held_out(self, number: int) -> LabelledModes:
        return label_modes(self.source.problem(HELD_OUT + number), self.classes)

    def collate(self, items: Sequence[LabelledModes]) -> LabelledModesBatch:
        return collate(items)

    def losses(self, batch: LabelledModesBatch, progress: Progress) -> dict[str, Tensor]:
        """Return the negative log-probability of the right modes."""
        return {"loss": surprise(self._log_probability(batch), batch.right)}

    def finish(self) -> None:
        """Do nothing."""

    def figures(self, batch: LabelledModesBatch) -> dict[str, Tensor]:
        """Return the shares of frames in which the first, the chosen and any mode is right."""
        log_probability = self._log_probability(batch)
        right = batch.right[:, :-1]
        chosen = log_probability[:, :-1].argmax(dim=1, keepdim=True)
        return {
            "surprise": surprise(log_probability, batch.right),
            "first": right[:, 0].double().mean(),
            "chosen": right.gather(1, chosen).double().mean(),
            "any": right.any(dim=1).double().mean(),
        }

    def _log_probability(self, batch: LabelledModesBatch) -> Tensor:
        log_probability: Tensor = self.network(
            batch.mode,
            batch.weight,
            batch.mapped,
            batch.near,
            batch.seen,
            batch.is_seen,
        )
        return log_probability


def make_task(name: str, source: ProblemSource | None) -> VerifierTask:
    """Return the task with new weights (default source: simulated roads)."""
    return VerifierTask(name, source or HARD_DISTRIBUTION)


def label_modes(problem: LocalizationProblem, classes: ClassSet) -> LabelledModes:
    """Return the modes of a wide search of a problem, labelled by its ground truth."""
    pose_problem = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
    prior = assumed_upright(problem.prior)
    modes = search(pose_problem, prior, WIDE)
    features = ModeFeatures.of(
        problem.observed, problem.submap, problem.camera, prior, modes, classes
    )
    return LabelledModes(features, right_modes(modes, problem)[: len(features.mode)])


def right_modes(modes: Modes, problem: LocalizationProblem) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return (b,) which modes are close to the truth."""
    true = problem.T_camera_map
    distance, angle = pose_distances(
        true.rotation, true.translation, modes.rotation, modes.translation
    )
    return (distance < RIGHT_M) & (angle < RIGHT_RAD)


def surprise(log_probability: Tensor, right: Tensor) -> Tensor:
    """Return the mean negative log-probability, given (f, b + 1), that any right mode is chosen."""
    return -log_probability.masked_fill(~right, -torch.inf).logsumexp(dim=1).mean()


def collate(items: Sequence[LabelledModes]) -> LabelledModesBatch:
    features = [item.features for item in items]
    f, b = len(items), max(1, *(len(frame.mode) for frame in features))
    k = max(1, *(frame.mapped.shape[1] for frame in features))
    m = max(frame.seen.shape[1] for frame in features)
    right = torch.zeros(f, b + 1, dtype=torch.bool)
    is_seen = torch.zeros(f, b, m)
    for row, frame in enumerate(items):
        right[row, : len(frame.right)] = torch.from_numpy(frame.right)
        right[row, -1] = not frame.right.any()
        is_seen[row, : len(frame.right), : frame.features.seen.shape[1]] = 1.0
    return LabelledModesBatch(
        mode=_padded([frame.mode for frame in features], (b,)),
        weight=_padded([frame.weight for frame in features], (b,)),
        mapped=_padded([frame.mapped for frame in features], (b, k)),
        near=_padded([frame.near for frame in features], (b, k)),
        seen=_padded([frame.seen for frame in features], (b, m)),
        is_seen=is_seen,
        right=right,
    )


def _padded(arrays: Sequence[np.ndarray[Any, Any]], sizes: tuple[int, ...]) -> Tensor:
    """Return arrays as one (f, *sizes, ...), padded with 0 up to ``sizes``."""
    batch = torch.zeros(len(arrays), *sizes, *arrays[0].shape[len(sizes) :])
    for row, array in enumerate(arrays):
        batch[row][tuple(slice(size) for size in array.shape[: len(sizes)])] = torch.from_numpy(
            array
        )
    return batch
