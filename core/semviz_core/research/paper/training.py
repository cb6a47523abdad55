"""Train the paper's matcher and its baselines with the paper's losses (eq. 9-11).

The correspondence loss is eq. 9; the pose loss is eq. 10, combined by eq. 11.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.localization.correspondences.sample import Sample
from semviz_core.research.paper.graph_torch import GraphMatcher
from semviz_core.research.paper.matcher import MODELS, options_of, split_lines
from semviz_core.research.paper.pnpl_layer import differentiable_pnpl, start_poses
from semviz_core.research.training.batch import Batch, BatchTruth
from semviz_core.research.training.simulated_samples import PAPER_DISTRIBUTION
from semviz_core.research.training.task import Progress, SampleSource, cosine

_NO_ANGLE = 1e-9
"""The gradient of angles and distances (rad, m) below this fades to 0."""


def correspondence_loss(P: Tensor, pairs: Tensor, possible: Tensor) -> Tensor:
    """Return the loss (b,) of eq. 9 for P: from 1 (no mass on ``pairs``) to -1.

    It differs from the paper, which gives no scale, in two ways. The sum of P is constant, so only
    true pairs matter. And each true pair counts alike, by its share of the most that uniform priors
    allow: the smaller of 1 / m and 1 / n of its block. Otherwise pairs of small blocks would count
    more, and pairs of crowded maps hardly. It equals eq. 9 if m = n = the number of pairs in one
    block.
    """
    seen_in_block, mapped_in_block = (
        possible.sum(dim=1, keepdim=True),
        possible.sum(dim=2)[..., None],
    )
    share = P * torch.maximum(seen_in_block, mapped_in_block)
    true = pairs & possible
    return 1.0 - 2.0 * (share * true).sum(dim=(1, 2)) / true.sum(dim=(1, 2)).clamp_min(1)


def pose_loss(
    rotation: Tensor, translation: Tensor, true_rotation: Tensor, true_translation: Tensor
) -> Tensor:
    """Return the loss (b,) of eq. 10: the angle (rad) between rotations plus the distance (m).

    As in eq. 10, the distance is that of translations of T_camera_local, which differs from the
    distance of the cameras if the angle is wrong. The arccos of eq. 10 has no digits and no
    gradient near 0, so the angle is computed from its sine and cosine.
    """
    between = true_rotation.transpose(1, 2) @ rotation
    cosine = 0.5 * (between.diagonal(dim1=1, dim2=2).sum(dim=1) - 1.0)
    twice = between - between.transpose(1, 2)
    sine = 0.5 * _length(torch.stack([twice[:, 2, 1], twice[:, 0, 2], twice[:, 1, 0]], dim=1))
    return torch.atan2(sine, cosine) + _length(translation - true_translation)


def whole_loss(correspondence: Tensor, pose: Tensor, ok: Tensor, gamma: float) -> Tensor:
    """Return eq. 11 averaged over the batch; items whose pose is not ``ok`` have no pose loss."""
    return (correspondence + gamma * torch.where(ok, pose, 0.0)).mean()


def _length(vector: Tensor) -> Tensor:
    """Return the lengths (b,) of vectors (b, 3)."""
    return torch.sqrt((vector**2).sum(dim=1) + _NO_ANGLE**2) - _NO_ANGLE


PAPER_SAMPLES = 596_800
"""200 epochs of the paper's 2984 frames."""
POSE_FROM = 120 / 200
"""Share of the training from which on the pose loss counts."""
_FEW = 5


class PaperTask:
    """Training of a matcher of ``MODELS`` on frames with ground truth."""

    samples = PAPER_SAMPLES

    def __init__(self, name: str, source: SampleSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.model = MODELS[name]
        self.network = GraphMatcher(self.model, len(classes))
        options = options_of(name, [class_.name for class_ in classes])
        self.options: dict[str, Any] = {**options, "data": source.describe()}

    def learning_rate(self, progress: Progress) -> float:
        """Return the paper's rate at most; the paper does not state that it falls."""
        return cosine(progress)

    def make(self, number: int) -> Sample:
        return self._of(self.source.sample(number))

    def held_out(self, number: int) -> Sample:
        return self._of(self.source.held_out(number))

    def _of(self, sample: Sample) -> Sample:
        return sample if self.model.lines else split_lines(sample)

    def collate(self, items: Sequence[Sample]) -> Batch:
        return Batch.of(items)

    def losses(self, batch: Batch, progress: Progress) -> dict[str, Tensor]:
        """Return the loss of eq. 11; gamma is 0 at first, then 1."""
        P = self.network(batch).probability
        truth = _truth(batch)
        possible = self.network.possible(batch)
        correspondence = correspondence_loss(P, truth.pairs, possible)
        if progress.share < POSE_FROM:
            return {"loss": correspondence.mean()}
        start = start_poses(P, batch, progress.samples)
        rotation, translation, ok = differentiable_pnpl(P, batch, start)
        pose = pose_loss(rotation, translation, truth.rotation, truth.translation)
        return {
            "loss": whole_loss(correspondence, pose, ok, gamma=1.0),
            "correspondence": correspondence.mean(),
            "pose": (pose * ok).sum() / ok.sum().clamp_min(1),
            "ok": ok.double().mean(),
        }

    def finish(self) -> None:
        """Do nothing."""

    def figures(self, batch: Batch) -> dict[str, Tensor]:
        """Return the shares of true pairs that are the most probable, or among the five most
        probable, of their observed element; and the share of P on true pairs."""
        P = self.network(batch).probability
        pairs = _truth(batch).pairs
        paired = pairs.any(dim=2)
        order = P.topk(min(_FEW, P.shape[2]), dim=2).indices
        hit = pairs.gather(2, order)[paired].double()
        loss = correspondence_loss(P, pairs, self.network.possible(batch))
        return {
            "correspondence": loss.mean(),
            "top1": hit[:, 0].mean(),
            "top5": hit.amax(dim=1).mean(),
            "true_mass": ((P * pairs).sum(dim=(1, 2)) / P.sum(dim=(1, 2))).mean(),
        }


def make_task(name: str, source: SampleSource | None) -> PaperTask:
    """Return the task with new weights (default source: simulated roads)."""
    return PaperTask(name, source or PAPER_DISTRIBUTION)


def _truth(batch: Batch) -> BatchTruth:
    if batch.truth is None:
        raise ValueError("training needs samples with a truth")
    return batch.truth
