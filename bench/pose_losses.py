"""Losses by which the pair matcher learns from the pose: joint training.

Both are differentiable in P. The pose loss (the paper's eq. 10) is the error of the pose that
weighted PnPL with the prior finds from P, beginning at the true one. The hypothesis loss is minus
the log of the share of pose hypotheses within NEAR_M of the truth, where a hypothesis weighs by
the consensus of P (`localization.correspondences.matcher`). What a frame contributes besides P
does not depend on the weights, so several trainings can share it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.association import gated_pairs
from semviz_core.localization.correspondences.candidate_pairs import (
    Compass,
    Sample,
    candidate_pairs,
)
from semviz_core.localization.correspondences.couples import couples
from semviz_core.localization.correspondences.matcher import LEAST_LIKELIHOOD, MOST_GAIN
from semviz_core.localization.heading_votes import DEFAULT_EFFORT
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.rating import (
    REFINED_SIGMAS,
    ahead_and_left,
    approximate_gain,
    direction_to,
    rate_poses,
    refine_candidates,
)
from semviz_core.localization.upright import (
    UprightView,
    assumed_upright,
    likely_ups,
    upright_elements,
    upright_view,
)
from semviz_core.research.evaluation.problems import DETECTOR, LocalizationProblem
from semviz_core.research.pair_matcher.training import PosePairs, pose_of_weights
from semviz_core.research.paper.training import pose_loss
from semviz_core.research.training.batch import Batch

NEAR_M = 1.0
MOST_HYPOTHESES = 256
"""Of a frame: the best by geometry alone."""
SAME_M, SAME_RAD = 0.5, float(np.deg2rad(2.0))
"""Hypotheses in one cell of this size are one."""
NEAR_TRUTH: FloatArray = np.diag([0.5**2] * 3 + [np.deg2rad(1.0) ** 2] * 3)
"""Covariance by which the gate of pairs around the true pose widens: wrong pairs nearby are
accepted too, and have to lose their weight."""
LEAST_SHARE = 1e-6


class Hypotheses(NamedTuple):
    """h poses of a frame, and the k pairs that fit them."""

    near: BoolArray  # (h,) within NEAR_M of the truth
    row: IntArray  # (k,) hypothesis
    pair: IntArray  # (k, 2) rows of observed and mapped elements
    likelihood: FloatArray  # (k,) of the pair, over that of no pair


@dataclass(frozen=True, eq=False)
class PoseItem:
    """A frame with what its pose losses need."""

    sample: Sample
    pairs: PosePairs
    """Around the true pose."""
    hypotheses: Hypotheses

    @classmethod
    def of(cls, problem: LocalizationProblem) -> "PoseItem":
        scene = PoseProblem.of(problem.camera, problem.observed, problem.submap, DETECTOR)
        prior = PriorRecord.of(assumed_upright(problem.prior))
        true = problem.T_camera_map
        seen, mapped, _ = gated_pairs(scene, true.rotation, true.translation, NEAR_TRUTH)
        pairs = PosePairs.of(scene, prior, np.column_stack([seen, mapped]), true)
        sample = Sample.of(problem.observed, problem.submap, problem.camera, problem.prior)
        sample = sample.with_truth(true, problem.pairs)
        camera_m = true.inverse().translation
        return cls(sample, pairs, _hypotheses(sample, scene, prior, camera_m))


def _hypotheses(
    sample: Sample, scene: PoseProblem, prior: PriorRecord, camera_m: FloatArray
) -> Hypotheses:
    """Return the refined poses of couples, and whether each is near the true camera (3,)."""
    ups, up_sigma_rad = likely_ups(scene, prior)
    view = upright_view(scene, ups[0], up_sigma_rad)
    pose = refine_candidates(scene, view, _couple_poses(sample), DEFAULT_EFFORT.step_m)
    rating = rate_poses(scene, view, prior, pose, REFINED_SIGMAS)
    pose = pose[_apart(pose, rating)[:MOST_HYPOTHESES]]
    off_m = np.linalg.norm(pose[:, :2] - camera_m[:2], axis=1)
    return Hypotheses(off_m < NEAR_M, *_fitting(scene, view, pose))


def _couple_poses(sample: Sample) -> FloatArray:
    """Return the upright poses (E, 6) in the map of all couples of candidate pairs of one class."""
    possible = sample.seen_class[:, None] == sample.mapped_class
    found, _ = couples(candidate_pairs(sample, possible), Compass.of(sample))
    place = np.column_stack([found.camera_m.real, found.camera_m.imag])
    height = sample.road[0] + place @ sample.road[1:]
    position_m = np.column_stack([place, height]) + sample.origin_m
    return np.column_stack([position_m, found.turn.real, found.turn.imag, np.zeros(len(height))])


def _apart(pose: FloatArray, rating: FloatArray) -> IntArray:
    """Return the rows of poses (h, 6), best first, but for those in one cell with a better one."""
    order = np.argsort(-rating, kind="stable")
    heading = np.arctan2(pose[order, 4], pose[order, 3])
    cell = np.column_stack([pose[order, :2] / SAME_M, heading / SAME_RAD]).round()
    _, first = np.unique(cell, axis=0, return_index=True)
    return order[np.sort(first)]


@compiled
def _fitting(
    problem: PoseProblem, view: UprightView, pose: FloatArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the pairs that fit poses (h, 6): hypothesis (k,), pair (k, 2), likelihood (k,)."""
    elements, candidate = upright_elements(problem)
    room = len(pose) * len(candidate)
    row, pair = np.empty(room, np.int64), np.empty((room, 2), np.int64)
    likelihood, count = np.empty(room), 0
    for h in range(len(pose)):
        for j in range(len(elements)):
            ahead, left = ahead_and_left(pose[h], elements[j])
            if ahead <= 0.0:
                continue
            direction = direction_to(ahead, left, REFINED_SIGMAS)
            for entry in range(elements[j].first, elements[j].last):
                i = candidate[entry]
                gain = approximate_gain(
                    problem.setting, view, view.seen[i], elements[j], direction, pose[h],
                    REFINED_SIGMAS,
                )  # fmt: skip
                if gain > 0.0:
                    row[count], pair[count, 0], pair[count, 1] = h, i, j
                    likelihood[count] = np.exp(min(gain, MOST_GAIN))
                    count += 1
    return row[:count], pair[:count], likelihood[:count]


def mean_pose_loss(probability: Tensor, batch: Batch, items: Sequence[PoseItem]) -> Tensor:
    """Return the mean of eq. 10 over the frames whose pose P (b, m + 1, n + 1) fixes."""
    assert batch.truth is not None
    losses = []
    for k, item in enumerate(items):
        i, j = item.pairs.pairs.T
        weight = probability[k, i, j].double()
        rotation, translation, ok = pose_of_weights(weight, item.pairs)
        if ok:
            local = translation + rotation @ torch.tensor(item.sample.origin_m)
            true = batch.truth.rotation[k], batch.truth.translation[k]
            losses.append(pose_loss(rotation[None], local[None], true[0][None], true[1][None]))
    return torch.cat(losses).mean() if losses else probability.new_zeros(()).double()


def mean_hypothesis_loss(probability: Tensor, items: Sequence[PoseItem]) -> Tensor:
    """Return the mean of minus the log share of near hypotheses, over the frames with one, given
    P (b, m + 1, n + 1)."""
    losses = []
    for P, item in zip(probability, items, strict=True):
        hypotheses, m = item.hypotheses, len(item.sample.ray)
        near = torch.from_numpy(hypotheses.near)
        if not near.any():
            continue
        i, j = hypotheses.pair.T
        at = torch.from_numpy(hypotheses.row * m + i)
        likelihood = P[:m, -1].repeat(len(near)) + LEAST_LIKELIHOOD
        evidence = P[i, j] * torch.from_numpy(hypotheses.likelihood).float()
        nats = likelihood.index_add(0, at, evidence).log().view(-1, m).sum(dim=1)
        share = torch.softmax(nats, dim=0)[near].sum()
        losses.append(-(share + LEAST_SHARE).log())
    return torch.stack(losses).mean() if losses else probability.new_zeros(())
