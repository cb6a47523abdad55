"""The paper's differentiable layers: accuracy, failures, time, and the effect of its eq. 6.

    OMP_NUM_THREADS=1 python bench/paper_gradients.py
    OMP_NUM_THREADS=1 python bench/paper_gradients.py --batches 200      (a short run)

Frames are held-out samples. Times are medians of processor time on one thread.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import process_time

import numpy as np
import torch
import tyro
from torch import Tensor

from semviz_core.base.pose import so3_exp
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.correspondences.candidate_pairs import Sample, SampleTarget
from semviz_core.research.paper import matcher_torch, training
from semviz_core.research.paper.matcher import MU
from semviz_core.research.paper.matcher_torch import sinkhorn, sinkhorn_with_dustbins
from semviz_core.research.paper.training import (
    POSE_FROM,
    PaperTask,
    StartPoses,
    correspondence_loss,
    differentiable_pnpl,
    pose_loss,
    start_poses,
    whole_loss,
)
from semviz_core.research.training.batch import Batch, BatchTruth, Progress
from semviz_core.research.training.simulated_samples import (
    PAPER_20M_DISTRIBUTION,
    PAPER_DISTRIBUTION,
)

BATCH = 12
WELL_POSED = 7
"""True pairs from which on a frame's optimum is well-posed."""
ENTRIES = 20
"""Of each frame's P or cost, for which the slope is compared."""
SIZES = ((7, 33), (30, 100))
UNROLLED = (10, 30, 100, 300)
SURE = 3.0
"""Cost of wrong pairs over right ones (30 times mu) where P is perfect."""
EXACT = 1e-12
Layer = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Options:
    batches: int = 10_000
    """Of four frames each, with random P."""
    frames: int = 200
    """Whose optimum under a perfect P is looked for."""


def main(options: Options) -> None:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    samples = [PAPER_DISTRIBUTION.held_out(k) for k in range(options.frames)]
    rich = [sample for sample in samples if truth_of(sample).pairs.sum() >= WELL_POSED]
    tell_gradients(Batch.of(rich[:BATCH]))
    tell_unrolling()
    tell_optima("normal frames", samples)
    near = [PAPER_20M_DISTRIBUTION.held_out(k) for k in range(options.frames)]
    tell_optima("the paper's own protocol", near)
    tell_times()
    small = [Batch.of(samples[k : k + 4]) for k in range(0, len(samples), 4)]
    tell_numbers(small, options.batches)


def tell_gradients(batch: Batch) -> None:
    print("Gradients against central differences in float64, error relative to the largest slope")
    tolerance, matcher_torch.TOLERANCE = matcher_torch.TOLERANCE, EXACT
    pairs, possible = truths(batch).pairs, batch.same_class
    noise, weight = torch.rand(2, *possible.shape, dtype=torch.float64)
    cost = torch.where(pairs, 0.3, 0.6) + 0.3 * noise

    def dustbins(score: Tensor) -> Tensor:
        bins = (
            torch.zeros(class_.shape, dtype=torch.float64) for class_ in (batch.seen, batch.mapped)
        )
        P = torch.exp(sinkhorn_with_dustbins(score, *bins, possible))
        return (P[:, :-1, :-1] * weight).sum(dim=(1, 2))

    layers: dict[str, tuple[Layer, Tensor]] = {
        "Sinkhorn, uniform": (lambda x: (sinkhorn(x, possible) * weight).sum(dim=(1, 2)), cost),
        "Sinkhorn, dustbins": (dustbins, 5.0 - 10.0 * cost),
        "weighted PnPL": (
            lambda x: poses_loss(batch, x, true_poses(batch))[0],
            torch.where(pairs, 0.6 + 0.3 * noise, 1e-4 * noise) * possible,
        ),
    }
    for name, (layer, at) in layers.items():
        error = slope_errors(layer, at, possible, 1e-6)
        print(f"  {name:20s} median {np.median(error):.1e}, most {error.max():.1e}")
    matcher_torch.TOLERANCE = tolerance


def slope_errors(layer: Layer, at: Tensor, possible: Tensor, step: float) -> FloatArray:
    """Of ENTRIES of each of the b frames, all at once since frames do not touch each other."""
    leaf = at.clone().requires_grad_()
    layer(leaf).sum().backward()
    assert leaf.grad is not None
    rows, rng, errors = np.arange(len(at)), np.random.default_rng(0), []
    for _ in range(ENTRIES):
        entry = np.array([rng.choice(np.flatnonzero(mask)) for mask in possible.flatten(1).numpy()])
        shift = torch.zeros_like(at)
        shift.view(len(at), -1)[rows, entry] = step
        slope = (layer(at + shift) - layer(at - shift)) / (2.0 * step)
        found = leaf.grad.view(len(at), -1)[rows, entry]
        errors.append((found - slope).abs() / leaf.grad.abs().amax(dim=(1, 2)))
    return torch.cat(errors).detach().numpy()


def tell_unrolling() -> None:
    print("Sinkhorn, uniform, batch 12: forward and backward; error of the gradient, by its size")
    for m, n in SIZES:
        f, g = torch.randn(BATCH, m, 16).double(), torch.randn(BATCH, n, 16).double()
        g[:, :m] = f + 0.3 * g[:, :m]
        for contrast in (0.3, 1.0, 3.0):
            cost, weight = contrast * torch.cdist(f, g) / 4.0, torch.rand(BATCH, m, n).double()
            possible = torch.ones(BATCH, m, n, dtype=torch.bool)
            tolerance, matcher_torch.TOLERANCE = matcher_torch.TOLERANCE, EXACT
            exact, _ = timed_gradient(lambda x, p=possible: sinkhorn(x, p), cost, weight)
            matcher_torch.TOLERANCE = tolerance
            told = []
            ways: dict[str, Layer] = {"implicit": lambda x, p=possible: sinkhorn(x, p)}
            ways |= {f"{k} unrolled": lambda x, k=k: unrolled(x, k) for k in UNROLLED}
            for name, way in ways.items():
                slope, time_ms = timed_gradient(way, cost, weight)
                error = float((slope - exact).abs().max() / exact.abs().max())
                told.append(f"{name} {time_ms:.1f} ms {error:.0e}")
            print(f"  ({m}, {n}), costs up to {float(cost.max()):.1f}: " + ", ".join(told))


def unrolled(cost: Tensor, sweeps: int) -> Tensor:
    """P by sweeps in the log domain that autograd follows back one by one."""
    kernel = cost / -MU
    row, column = (-float(np.log(k)) for k in cost.shape[1:])
    b = torch.zeros_like(cost[:, :1])
    for _ in range(sweeps):
        a = row - torch.logsumexp(kernel + b, dim=2, keepdim=True)
        b = column - torch.logsumexp(kernel + a, dim=1, keepdim=True)
    return torch.exp(kernel + a + b)


def timed_gradient(layer: Layer, cost: Tensor, weight: Tensor) -> tuple[Tensor, float]:
    times = []
    for _ in range(7):
        leaf, start = cost.clone().requires_grad_(), process_time()
        (layer(leaf) * weight).sum().backward()
        times.append(process_time() - start)
    assert leaf.grad is not None
    return leaf.grad, float(np.median(times)) * 1e3


def tell_optima(frames: str, samples: list[Sample]) -> None:
    batches = [Batch.of(samples[k : k + BATCH]) for k in range(0, len(samples), BATCH)]
    print(f"Weighted PnPL (eq. 6) from the TRUE pose under a PERFECT P: {len(samples)} {frames}")
    kinds: dict[str, Callable[[Batch], Tensor]] = {
        "Boolean P": lambda batch: truths(batch).pairs.double(),
        "dustbins": perfect_with_dustbins,
        "uniform priors": lambda batch: sinkhorn(wrong(batch), batch.same_class),
    }
    most, training.MOST_SHIFT_M = training.MOST_SHIFT_M, np.inf
    for name, kind in kinds.items():
        moved, mass = [], []
        for batch in batches:
            P, truth = kind(batch), truths(batch)
            rotation, translation, ok = differentiable_pnpl(P, batch, true_poses(batch))
            away = centre(rotation, translation) - centre(truth.rotation, truth.translation)
            moved.append(torch.where(ok, away.norm(dim=1), torch.nan).numpy())
            mass.append(((P * truth.pairs).sum(dim=(1, 2)) / P.sum(dim=(1, 2))).numpy())
        away_m = np.concatenate(moved)
        found = away_m[np.isfinite(away_m)]
        quartiles = ", ".join(f"{value:.2f}" for value in np.quantile(found, (0.25, 0.5, 0.75)))
        print(
            f"  {name:15s} mass on true pairs {np.concatenate(mass).mean():.2f}; no minimum in "
            f"{1.0 - len(found) / len(away_m):.0%}; else RTE quartiles {quartiles} m, "
            f"beyond {most:.0f} m {np.mean(found > most):.0%}"
        )
    training.MOST_SHIFT_M = most


def wrong(batch: Batch) -> Tensor:
    """The cost of a network that is sure and right."""
    return torch.where(truths(batch).pairs, 0.0, SURE).double()


def perfect_with_dustbins(batch: Batch) -> Tensor:
    """As sure of true pairs as of no pair for all that has none."""
    score, alone = -wrong(batch) / MU, -0.25 * SURE / MU
    bins = (torch.full(class_.shape, alone) for class_ in (batch.seen, batch.mapped))
    return torch.exp(sinkhorn_with_dustbins(score, *bins, batch.same_class))[:, :-1, :-1]


def tell_times() -> None:
    task = PaperTask("paper", PAPER_DISTRIBUTION)
    optimizer = torch.optim.Adam(task.network.parameters())
    print("A training step of `paper` of batch 12, Adam included, without and with pose loss")
    for m, n in SIZES:
        batch = crowd(m, n)
        told = []
        for share in (0.0, POSE_FROM):
            progress, times = Progress(int(share * 1e6), 1_000_000), []
            for _ in range(9):
                start = process_time()
                optimizer.zero_grad()
                task.losses(batch, progress)["loss"].backward()
                optimizer.step()
                times.append(process_time() - start)
            told.append(f"{np.median(times):.3f} s")
        print(f"  ({m}, {n}): {' and '.join(told)}; its layers alone: {layers_ms(batch)}")
    print("  BPnPNet at (30, 100), one core of such a machine: 0.21 s and 0.63 s")


def layers_ms(batch: Batch) -> str:
    """Transport, start poses, PnPL with both passes."""
    times = []
    for k in range(9):
        cost = (wrong(batch) / SURE + 0.1 * torch.rand(batch.possible.shape)).requires_grad_()
        now = [process_time()]
        P = sinkhorn(cost, batch.same_class)
        now.append(process_time())
        start = start_poses(P, batch, k)
        now.append(process_time())
        losses, ok = poses_loss(batch, P, start)
        now.append(process_time())
        matched = correspondence_loss(P, truths(batch).pairs, batch.same_class)
        whole_loss(matched, losses, ok, 1.0).backward()
        times.append(np.diff([*now, process_time()]) * 1e3)
    names = ("Sinkhorn", "RANSAC", "PnPL", "backward")
    each = zip(names, np.median(times, axis=0), strict=True)
    return ", ".join(f"{name} {time_ms:.1f} ms" for name, time_ms in each)


def crowd(m: int, n: int) -> Batch:
    """Frames of n poles and signs about a place, m of which are seen, without noise."""
    return Batch.of([one_of_crowd(np.random.default_rng(k), m, n) for k in range(BATCH)])


def one_of_crowd(rng: np.random.Generator, m: int, n: int) -> Sample:
    pattern = PAPER_DISTRIBUTION.held_out(0)
    ahead = rng.uniform([-12.0, -4.0, 6.0], [12.0, -1.0, 40.0], (n, 3))
    classes = rng.choice(4, n, p=(0.6, 0.1, 0.2, 0.1))
    lower = ahead + np.where((classes == 0)[:, None], [0.05, 3.0, 0.02], 0.0)
    R, t = so3_exp(rng.normal(size=3)), rng.normal(0.0, 5.0, 3)
    rays = [
        value[:m] / np.linalg.norm(value[:m], axis=1, keepdims=True) for value in (ahead, lower)
    ]
    known = np.stack([np.ones(n, dtype=bool), classes == 0], axis=1)
    values = {name: getattr(pattern, name) for name in pattern.__dataclass_fields__}
    return Sample(
        **values
        | {
            "ray": rays[0],
            "bottom_ray": rays[1],
            "sigma_rad": np.full((m, 2), 1e-3),
            "score": np.full(m, 0.9),
            "seen_class": classes[:m],
            "seen_known": known[:m],
            "point_m": (ahead - t) @ R,
            "bottom_m": (lower - t) @ R,
            "mapped_class": classes,
            "mapped_known": known,
            "truth": SampleTarget(R, t, np.eye(m, n, dtype=bool)),
        }
    )


def tell_numbers(batches: list[Batch], count: int) -> None:
    """Costs of any size, from nothing but noise to nearly right; both kinds of transport."""
    wrong_numbers, started, solved, frames = 0, 0, 0, 0
    rng = np.random.default_rng(0)
    for k in range(count):
        batch = batches[int(rng.integers(len(batches)))]
        possible = batch.same_class if rng.random() < 0.5 else batch.possible
        noise = 10.0 ** rng.uniform(-2.0, 2.0) * torch.randn(possible.shape).abs()
        leaf = (noise + rng.random() * wrong(batch)).float().requires_grad_()
        if k % 2:
            P = sinkhorn(leaf, possible)
        else:
            bins = (torch.zeros(class_.shape) for class_ in (batch.seen, batch.mapped))
            log_P = sinkhorn_with_dustbins(SURE - 10.0 * leaf, *bins, possible)
            P = torch.exp(log_P)[:, :-1, :-1]
        start = start_poses(P, batch, k)
        losses, ok = poses_loss(batch, P, start)
        matched = correspondence_loss(P, truths(batch).pairs, possible)
        loss = whole_loss(matched, losses, ok, 1.0)
        loss.backward()
        assert leaf.grad is not None
        wrong_numbers += not bool(torch.isfinite(loss)) or not bool(torch.isfinite(leaf.grad).all())
        frames, started, solved = frames + len(ok), started + start.ok.sum(), solved + int(ok.sum())
    print(
        f"{count} random batches: {wrong_numbers} with a NaN or infinite loss or gradient; of "
        f"{frames} frames {started / frames:.0%} have a start, {solved / frames:.0%} an optimum"
    )


def poses_loss(batch: Batch, P: Tensor, start: StartPoses) -> tuple[Tensor, Tensor]:
    """(b,) losses, and which count."""
    truth = truths(batch)
    rotation, translation, ok = differentiable_pnpl(P, batch, start)
    return pose_loss(rotation, translation, truth.rotation, truth.translation), ok


def true_poses(batch: Batch) -> StartPoses:
    truth = truths(batch)
    ok = np.ones(len(batch), dtype=bool)
    return StartPoses(truth.rotation.numpy(), truth.translation.numpy(), ok)


def centre(rotation: Tensor, translation: Tensor) -> Tensor:
    """(b, 3) of the camera."""
    return -(rotation.transpose(1, 2) @ translation[:, :, None])[:, :, 0]


def truths(batch: Batch) -> BatchTruth:
    assert batch.truth is not None
    return batch.truth


def truth_of(sample: Sample) -> SampleTarget:
    assert sample.truth is not None
    return sample.truth


if __name__ == "__main__":
    main(tyro.cli(Options))
