"""Train DeepI2P from pixels on simulated streets, with the published losses.

Samples draw their frames from a pool that grows by a street every ``SAMPLES_A_STREET`` samples, so
that training need not wait for frames, which take long to make. A sample is a picture with several
draws from its cloud, each turned by any angle and shifted by up to the error of a fix; colours
vary, and half of the frames are mirrored.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.research.evaluation.street_frames import (
    CLOUD_M,
    COLUMNS,
    FIRST_FRAME,
    LAST_FRAME,
    PICTURE_CAMERA,
    PRIOR,
    MappedStreet,
    cells,
    seen_in_picture,
)
from semviz_core.research.point_matching.pixel_methods import TASK
from semviz_core.research.point_matching.pixel_network import (
    POINTS,
    CloudBatch,
    DeepI2PPixels,
    nodes,
)
from semviz_core.research.point_matching.training import INSIDE_WEIGHT, cell_loss, focal_loss
from semviz_core.research.training.batch import Progress, cosine

SAMPLES = 12_000
CLOUDS = 4
"""Of a sample. The published training had 4 million pairs of a picture and a cloud."""
RATE = 1e-3
STREETS, FRAMES_A_STREET, SAMPLES_A_STREET = 200, 15, 100
FIRST_STREET, FIRST_HELD_OUT = 10_000_000, 20_000_000
"""Smaller seeds of streets are for tests and benchmarks."""
_KEPT_POINTS = 8192


@dataclass(frozen=True, eq=False)
class StreetFrame:
    """A frame to draw samples from."""

    picture: ByteImage
    cloud: FloatArray
    """(n, 7) about the camera, in the axes of the map; float16."""
    rotation: FloatArray
    """(3, 3) from the map to the camera."""


@dataclass(frozen=True, eq=False)
class CloudSample:
    """A picture, clouds, and which of their points are in which cell of the picture."""

    picture: ByteImage
    points: FloatArray
    """(k, n, 7) local"""
    nodes: IntArray
    """(k, 2, NODES) of A and B"""
    inside: BoolArray
    """(k, n)"""
    cell: IntArray
    """(k, n), where inside."""


class PixelTask:
    """Training of DeepI2P from pixels."""

    name = TASK
    samples = SAMPLES

    def __init__(self) -> None:
        self.network = DeepI2PPixels()
        data = {"streets": STREETS, "frames": STREETS * FRAMES_A_STREET}
        self.options: dict[str, Any] = {"classes": [], "data": data}

    def learning_rate(self, progress: Progress) -> float:
        return cosine(progress, RATE)

    def make(self, number: int) -> CloudSample:
        rng = np.random.default_rng([number, 10])
        street = int(rng.integers(min(1 + number // SAMPLES_A_STREET, STREETS)))
        frames = _frames(FIRST_STREET + street)
        return make_cloud_sample(frames[rng.integers(len(frames))], rng)

    def held_out(self, number: int) -> CloudSample:
        street, frame = divmod(number, FRAMES_A_STREET)
        rng = np.random.default_rng([number, 11])
        return make_cloud_sample(_frames(FIRST_HELD_OUT + street)[frame], rng)

    def collate(self, items: Sequence[CloudSample]) -> CloudBatch:
        return collate(items)

    def losses(self, batch: CloudBatch, progress: Progress) -> dict[str, Tensor]:
        inside, cell = self.network(batch)
        focal = focal_loss(inside, batch.inside, torch.ones_like(batch.inside))
        place = cell_loss(cell, batch.cell, batch.inside)
        return {"loss": INSIDE_WEIGHT * focal + place, "inside": focal, "cell": place}

    def finish(self) -> None:
        """Do nothing."""

    def figures(self, batch: CloudBatch) -> dict[str, Tensor]:
        """Return the shares of points rightly called inside or outside (the mean of both), and of
        points inside whose cell is right or next to it."""
        inside, cell = self.network(batch)
        called = inside[..., 1] > inside[..., 0]
        right = (called == batch.inside).double()
        found = cell.argmax(dim=2)
        off = (found % COLUMNS - batch.cell % COLUMNS).abs()
        off = torch.maximum(off, (found // COLUMNS - batch.cell // COLUMNS).abs())
        return {
            "side": 0.5 * (right[batch.inside].mean() + right[~batch.inside].mean()),
            "cell": (off[batch.inside] == 0).double().mean(),
            "near cell": (off[batch.inside] <= 1).double().mean(),
        }


def make_task(name: str, source: object = None) -> PixelTask:
    """Return the task with new weights; it has its own samples."""
    return PixelTask()


@lru_cache(maxsize=STREETS)
def _frames(seed: int) -> list[StreetFrame]:
    """Return the frames of a street."""
    world, rng = MappedStreet(seed), np.random.default_rng([seed, 12])
    frames = []
    for index in rng.permutation(np.arange(FIRST_FRAME, LAST_FRAME))[:FRAMES_A_STREET].tolist():
        pose = world.pose(index)
        cloud = world.cloud(pose.translation, CLOUD_M + PRIOR.distance_m[1])
        cloud = cloud[rng.permutation(len(cloud))[:_KEPT_POINTS]]
        cloud[:, :3] -= pose.translation
        frame = StreetFrame(world.picture(index), cloud.astype(np.float16), pose.rotation.T)
        frames.append(frame)
    return frames


def make_cloud_sample(frame: StreetFrame, rng: np.random.Generator) -> CloudSample:
    """Return a frame as a sample, maybe mirrored."""
    cloud = frame.cloud.astype(np.float64)
    inside, pixel = seen_in_picture(cloud[:, :3] @ frame.rotation.T)
    picture = _recolored(frame.picture, rng)
    if rng.random() < 0.5:
        picture = np.ascontiguousarray(picture[:, ::-1])
        pixel[:, 0] = PICTURE_CAMERA.width - 1.0 - pixel[:, 0]
        cloud[:, [1, 5]] *= -1.0  # any mirror will do before the turn
    cell = cells(pixel, inside)
    drawn = [_drawn(cloud, rng) for _ in range(CLOUDS)]
    points = np.array([points for points, _ in drawn])
    return CloudSample(
        picture,
        points,
        np.array([nodes(one, rng) for one in points]),
        np.array([inside[rows] for _, rows in drawn]),
        np.array([cell[rows] for _, rows in drawn]),
    )


def _drawn(cloud: FloatArray, rng: np.random.Generator) -> tuple[FloatArray, IntArray]:
    """Return points (POINTS, 7) as seen from a fix within its error, turned, and their rows."""
    distance, bearing, turn = rng.uniform(*PRIOR.distance_m), *rng.uniform(-np.pi, np.pi, 2)
    height = PRIOR.vertical_sigma_m * rng.standard_normal()
    place = cloud[:, :3] - [distance * np.cos(bearing), distance * np.sin(bearing), height]
    near = np.flatnonzero(np.linalg.norm(place[:, :2], axis=1) < CLOUD_M)
    rows = near[rng.permutation(len(near))[:POINTS]]
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    place = place[rows] @ rotation.T + rng.normal(0.0, 0.01, (POINTS, 3)).clip(-0.05, 0.05)
    return np.column_stack([place, cloud[rows, 3], cloud[rows, 4:] @ rotation.T]), rows


def collate(items: Sequence[CloudSample]) -> CloudBatch:
    node = torch.from_numpy(np.concatenate([item.nodes for item in items]))
    return CloudBatch(
        picture=torch.from_numpy(np.stack([item.picture for item in items])),
        points=torch.from_numpy(np.concatenate([item.points for item in items])).float(),
        node_a=node[:, 0],
        node_b=node[:, 1],
        inside=torch.from_numpy(np.concatenate([item.inside for item in items])),
        cell=torch.from_numpy(np.concatenate([item.cell for item in items])),
    )


def _recolored(picture: ByteImage, rng: np.random.Generator) -> ByteImage:
    gain, offset = rng.uniform(0.8, 1.2, 3), rng.uniform(-20.0, 20.0)
    return np.asarray((picture * gain + offset).clip(0.0, 255.0), dtype=np.uint8)
