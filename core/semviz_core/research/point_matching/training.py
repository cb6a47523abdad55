"""Train 2D3D-MatchNet and DeepI2P between points with the losses of their published code."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.localization.correspondences.candidate_pairs import Sample
from semviz_core.research.evaluation.problems import CAMERA
from semviz_core.research.paper.matcher import split_lines
from semviz_core.research.point_matching.methods import POINT_MODELS
from semviz_core.research.point_matching.networks import DeepI2P, MatchNet, make_network
from semviz_core.research.training.batch import Batch, BatchTruth, Progress, SampleSource, cosine
from semviz_core.research.training.simulated_samples import PAPER_20M_DISTRIBUTION

SAMPLES = {MatchNet: 60_000, DeepI2P: 120_000}
"""Frames, about ten minutes of a core. The published trainings had 25 epochs of 433,000 pairs of
patches, and 4 million frames."""
RATES = {MatchNet: 3e-4, DeepI2P: 1e-3}
"""Highest step sizes; 2D3D-MatchNet's 6e-5 is for a network that was trained before."""
STEEPNESS = 5.0
"""Of the loss of distances, as published."""
INSIDE_WEIGHT, FOCUS = 50.0, 2.0
"""Weight and gamma of the focal loss, as published; its alpha is 0.5."""
NEAREST_M = 0.1


class PointTask:
    """Training of a network of ``POINT_MODELS`` on frames with ground truth."""

    def __init__(self, name: str, source: SampleSource, classes: ClassSet = DEFAULT_CLASSES):
        self.name = name
        self.source = source
        self.network = make_network(POINT_MODELS[name], len(classes))
        self.samples = SAMPLES[type(self.network)]
        names = [class_.name for class_ in classes]
        self.options: dict[str, Any] = {"classes": names, "data": source.describe()}

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATES[type(self.network)])

    def make(self, number: int) -> Sample:
        return split_lines(self.source.sample(number))

    def held_out(self, number: int) -> Sample:
        return split_lines(self.source.held_out(number))

    def collate(self, items: Sequence[Sample]) -> Batch:
        return Batch.of(items)

    def losses(self, batch: Batch, progress: Progress) -> dict[str, Tensor]:
        if isinstance(self.network, MatchNet):
            seed = torch.Generator().manual_seed(progress.samples)
            distance, possible = self.network.distances(batch), self.network.possible(batch)
            return {"loss": distance_loss(distance, possible, _truth(batch).pairs, seed)}
        assert isinstance(self.network, DeepI2P)
        inside, cell = self.network(batch)
        true_inside = points_in_image(batch)
        focal = focal_loss(inside, true_inside, batch.mapped)
        place = cell_loss(cell, _cells(batch, self.network.possible(batch)), true_inside)
        return {"loss": INSIDE_WEIGHT * focal + place, "inside": focal, "cell": place}

    def finish(self) -> None:
        """Do nothing."""

    def figures(self, batch: Batch) -> dict[str, Tensor]:
        """Return the share of observed points in the map that match right, and of matches that
        are right."""
        matches = self.network.matches(batch)
        pairs = _truth(batch).pairs & self.network.possible(batch)
        right = (matches & pairs).sum().double()
        there = pairs.any(dim=2).sum().clamp_min(1)
        return {"recall": right / there, "precision": right / matches.sum().clamp_min(1)}


def make_task(name: str, source: SampleSource | None) -> PointTask:
    """Return the task with new weights (default source: frames of the paper's own protocol)."""
    return PointTask(name, source or PAPER_20M_DISTRIBUTION)


def distance_loss(
    distance: Tensor, possible: Tensor, pairs: Tensor, generator: torch.Generator
) -> Tensor:
    """Return the mean of ln(1 + exp(5 (d+ - d-))) over true ``pairs`` (b, m, n).

    d- is the distance of a random other mapped point of the frame; published is one of another
    scan, but here all candidates are of one map.
    """
    true, false = pairs & possible, possible & ~pairs
    drawn = torch.rand(distance.shape, generator=generator).masked_fill(~false, -1.0)
    other = distance.gather(2, drawn.argmax(dim=2, keepdim=True))
    counts = true & false.any(dim=2, keepdim=True)
    losses = functional.softplus(STEEPNESS * (distance - other))
    return (losses * counts).sum() / counts.sum().clamp_min(1)


def points_in_image(batch: Batch) -> Tensor:
    """Return (b, n) whether mapped points are inside the true image, hidden or not."""
    truth = _truth(batch)
    place = batch.point_m.double() @ truth.rotation.transpose(1, 2) + truth.translation[:, None]
    pixel = place @ torch.tensor(CAMERA.K).T / place[..., 2:].clamp_min(NEAREST_M)
    u, v = pixel[..., 0], pixel[..., 1]
    within = (u >= 0) & (v >= 0) & (u <= CAMERA.width - 1) & (v <= CAMERA.height - 1)
    return within & (place[..., 2] > NEAREST_M) & batch.mapped


def focal_loss(inside: Tensor, true_inside: Tensor, mapped: Tensor) -> Tensor:
    """Return the mean of -0.5 (1 - p)^2 ln p over mapped points, p of the true side."""
    log_p = inside.log_softmax(dim=2).gather(2, true_inside[..., None].long())[..., 0]
    losses = -0.5 * (1.0 - log_p.exp()) ** FOCUS * log_p
    return losses[mapped].mean()


def cell_loss(cell: Tensor, true_cell: Tensor, inside: Tensor) -> Tensor:
    """Return the cross entropy of ``true_cell`` (b, n) over points inside the image."""
    losses = functional.cross_entropy(cell.transpose(1, 2), true_cell, reduction="none")
    return (losses * inside).sum() / inside.sum().clamp_min(1)


def _cells(batch: Batch, possible: Tensor) -> Tensor:
    """Return (b, n) the observed point of each mapped one; m for none."""
    pairs = _truth(batch).pairs & possible
    return torch.where(pairs.any(dim=1), pairs.int().argmax(dim=1), pairs.shape[1])


def _truth(batch: Batch) -> BatchTruth:
    if batch.truth is None:
        raise ValueError("training needs samples with a truth")
    return batch.truth
