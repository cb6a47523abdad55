"""Does training the pair matcher on the pose, too, localize more frames?

    OMP_NUM_THREADS=1 python bench/joint_training.py --kitti-poses DIR --pole-maps DIR
        [--seeds 4] [--samples 4800] [--frames 500] [--report] [--out DIR]

From the shipped weights, three trainings with the same frames and the same budget: on the
correspondences alone, with the pose loss of weighted PnPL, and with the share of hypotheses within
1 m (`pose_losses`). Half of the frames have a fix 30 m off. Then
`correspondences` with each of the weights, on frames of KITTI's 00, 02, 05, 06, 08, or with
--report of 09 and 10. A gain is over the shipped weights on the same frames: the mean over seeds of
the training, with its standard error over seeds. `top-1`: observed elements whose true pair is the
most likely one.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
import tyro
from correspondences import REPORTING, REPORTING_SEED, TUNING, TUNING_SEED, asked, problems
from pose_losses import (
    PoseItem,
    mean_hypothesis_loss,
    mean_pose_loss,
)
from torch import Tensor

from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.weights import NetworkWeights, read_weights, shipped_weights
from semviz_core.localization.correspondences.matcher import TASK
from semviz_core.localization.localizer import Localizer
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.research.evaluation.problems import DETECTOR, HARD_SETS, LocalizationProblem
from semviz_core.research.evaluation.roads import kitti_road
from semviz_core.research.pair_matcher.network import ConsensusNetwork, Prepared
from semviz_core.research.pair_matcher.training import log_probabilities, mean_surprise
from semviz_core.research.training.batch import Progress, cosine
from semviz_core.research.training.simulated_samples import LEARNED_DISTRIBUTION, SimulatedSamples

LOSSES = ("correspondences", "with pose", "with hypotheses")
SETS = ("low", "paper", "GPS 30 m", "clutter 100 %")
BATCH, RATE = 24, 1e-3
POSE_WEIGHT = 1.0
"""The paper's gamma."""
FAR_OFF = HARD_SETS["GPS 30 m"]
NUMBERS_A_SEED = 100_000_000
"""Frames of a seed are numbered from it times this on; the shipped weights saw those of 0."""


@dataclass(frozen=True)
class Options:
    kitti_poses: Path
    pole_maps: Path
    seeds: int = 4
    samples: int = 4800
    frames: int = 500
    report: bool = False
    out: Path = Path("joint-training")


def main(options: Options) -> None:
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    for seed in range(1, options.seeds + 1):
        if not weights_path(options, LOSSES[-1], seed).is_file():
            train(options, seed)
    for name in SETS:
        frames = list(islice(frames_of(options, name), options.frames))
        shipped = 100.0 * np.array(shares(frames, None))
        print(f"{name:14} shipped: <1 m {shipped[0]:.1f} %, top-1 {shipped[1]:.1f} %", flush=True)
        for loss in LOSSES:
            paths = [weights_path(options, loss, seed) for seed in range(1, options.seeds + 1)]
            gains = np.array([100.0 * np.array(shares(frames, path)) - shipped for path in paths])
            error = gains.std(axis=0, ddof=1) / np.sqrt(len(gains)) if len(gains) > 1 else [0, 0]
            told = zip(("<1 m", "top-1"), gains.mean(axis=0), error, strict=True)
            each = ", ".join(f"{what} {mean:+.2f} +- {of:.2f}" for what, mean, of in told)
            print(f"{'':14} {loss:16} {each}", flush=True)


def weights_path(options: Options, loss: str, seed: int) -> Path:
    return options.out / f"{loss.replace(' ', '-')}-{seed}-{options.samples}.safetensors"


def frames_of(options: Options, name: str) -> Iterator[LocalizationProblem]:
    names = REPORTING if options.report else TUNING
    roads = [
        kitti_road(options.kitti_poses / f"{n}.txt", options.pole_maps / f"kitti_{n}.npz", n)
        for n in names
    ]
    yield from problems(name, roads, REPORTING_SEED if options.report else TUNING_SEED)


def shares(frames: list[LocalizationProblem], weights: Path | None) -> tuple[float, float]:
    """Return the shares of frames localized within 1 m, and of true pairs that are likeliest."""
    localizer = Localizer("correspondences", detector=DETECTOR, weights=weights)
    within, likeliest = [], []
    for problem in frames:
        found = localizer.localize(*asked(problem))
        pose, match = found.T_camera_map, found.match
        within.append(pose is not None and pose_error(pose, problem.T_camera_map)[0] < 1.0)
        if match is not None:
            P, (i, j) = match.probability[:-1, :-1], problem.pairs.T
            likeliest += (P[i].max(axis=1, initial=0.0) == P[i, j]).tolist()
    return float(np.mean(within)), float(np.mean(likeliest))


def train(options: Options, seed: int) -> None:
    """Train with each of the losses on the same frames, and write the weights."""
    shipped = read_weights(shipped_weights(TASK))
    networks = {loss: ConsensusNetwork(len(DEFAULT_CLASSES)) for loss in LOSSES}
    for network in networks.values():
        shipped.load_into(network, shipped_weights(TASK))
    optimizers = {
        loss: torch.optim.Adam(network.parameters(), fused=True)
        for loss, network in networks.items()
    }
    source = _with_far_fixes()
    for step in range(options.samples // BATCH):
        first = seed * NUMBERS_A_SEED + step * BATCH
        items = [PoseItem.of(source.problem(first + k)) for k in range(BATCH)]
        prepared = Prepared.of([item.sample for item in items])
        values = {}
        for loss, network in networks.items():
            value = whole_loss(loss, network, prepared, items)
            values[loss] = [f"{float(part):.3f}" for part in value]
            optimizer = optimizers[loss]
            optimizer.param_groups[0]["lr"] = cosine(Progress(step * BATCH, options.samples), RATE)
            optimizer.zero_grad()
            value.sum().backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
        if step % 10 == 0:
            print(f"seed {seed}, sample {step * BATCH}: {values}", flush=True)
    for loss, network in networks.items():
        tensors = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
        weights = NetworkWeights(TASK, shipped.options, tensors)
        weights.save(weights_path(options, loss, seed))


def _with_far_fixes() -> SimulatedSamples:
    """Return the matcher's training distribution, half of it replaced by fixes 30 m off."""
    total = sum(weight for weight, _ in LEARNED_DISTRIBUTION.levels)
    far = tuple((0.5 * total, replace(FAR_OFF, noise=noise)) for noise in ("low", "paper"))
    return replace(LEARNED_DISTRIBUTION, levels=(*LEARNED_DISTRIBUTION.levels, *far))


def whole_loss(
    loss: str, network: ConsensusNetwork, prepared: Prepared, items: list[PoseItem]
) -> Tensor:
    """Return the parts (2,) of the loss: of the correspondences and of the pose."""
    log_probability = log_probabilities(network(prepared), prepared.batch)
    surprise = mean_surprise(log_probability, prepared.batch)
    probability = log_probability.exp()
    more = torch.zeros(())
    if loss == "with pose":
        more = mean_pose_loss(probability, prepared.batch, items).float()
    elif loss == "with hypotheses":
        more = mean_hypothesis_loss(probability, items)
    return torch.stack([surprise, POSE_WEIGHT * more])


if __name__ == "__main__":
    main(tyro.cli(Options))
