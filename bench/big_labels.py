"""Make the large synthetic label file that the benchmarks of store and page open."""

import uuid
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from semviz_annotation.labels.edits import AddObservation
from semviz_annotation.labels.labels import Draft, Labels
from semviz_annotation.labels.rows import Rules
from semviz_annotation.storage.operations import NO_HASH, Operation, sealed
from semviz_annotation.storage.store import LabelStore
from semviz_core.common.arrays import FloatArray

FOCAL_PX, CENTER_PX, BASELINE_M = 720.0, (610.0, 180.0), 0.54
FARTHEST_M, STEP_M = 34.0, 2.5
"""An element comes into sight at this distance and is nearer by this in every frame."""
MOST_VIEWS = 9
IMAGE_PX = (1241, 376)


def make_big_labels(path: Path, elements: int = 6000, frames: int = 10_000, seed: int = 0) -> int:
    """Write a label file as one person's work; return the number of observations.

    Each element is seen by both cameras in 8 or 9 frames one after another, so that 6,000 elements
    make some 100,000 observations; each observation is one operation. The same seed gives the same
    file. Images are 1241 by 376 pixels.
    """
    with LabelStore.open(path) as store:
        store.extend(_operations(elements, frames, np.random.default_rng(seed)))
        return len(store.labels.observations)


def _operations(elements: int, frames: int, rng: np.random.Generator) -> Iterator[Operation]:
    draft, hash_before = Draft(Labels()), NO_HASH
    for number, edit in enumerate(_edits(elements, frames, rng), 1):
        changes = tuple(edit.changes(draft.labels(), Rules()))
        draft.apply(changes)
        time = f"2026-01-{1 + number // 86_400:02}T00:00:00.000+00:00"
        operation = Operation(number, _id(rng), "bench", "human", time, edit.kind, changes)
        operation = sealed(operation, hash_before)
        hash_before = operation.hash
        yield operation


def _edits(elements: int, frames: int, rng: np.random.Generator) -> Iterator[AddObservation]:
    """Frame by frame, left before right."""
    first = np.sort(rng.integers(0, max(1, frames - MOST_VIEWS), elements))
    views = rng.choice([MOST_VIEWS - 1, MOST_VIEWS], elements, p=[2 / 3, 1 / 3])
    side_m = rng.uniform(4.0, 8.0, elements) * rng.choice([-1, 1], elements)
    is_pole = rng.random(elements) < 0.6
    ids = [_id(rng) for _ in range(elements)]
    seen = [
        (int(frame), index)
        for index in range(elements)
        for frame in range(first[index], first[index] + views[index])
    ]
    for frame, element in sorted(seen):
        depth_m = FARTHEST_M - STEP_M * (frame - first[element])
        for side, camera_m in (("left", 0.0), ("right", BASELINE_M)):
            anchor = np.array([side_m[element] - camera_m, -2.0])
            end = np.add(anchor, (0.0, 3.0))
            is_new = frame == first[element] and side == "left"
            yield AddObservation(
                observation_id=_id(rng),
                element_id=ids[element],
                frame_index=frame,
                side=side,
                anchor_px=_pixel(anchor, depth_m, rng),
                end_px=_pixel(end, depth_m, rng) if is_pole[element] else None,
                class_id=(0 if is_pole[element] else 1) if is_new else None,
            )


def _pixel(offset_m: FloatArray, depth_m: float, rng: np.random.Generator) -> tuple[float, float]:
    pixel = FOCAL_PX * offset_m / depth_m + CENTER_PX + rng.normal(0.0, 0.3, 2)
    u, v = np.clip(pixel, 0.0, np.subtract(IMAGE_PX, 1.0))
    return float(u), float(v)


def _id(rng: np.random.Generator) -> str:
    return str(uuid.UUID(bytes=rng.bytes(16), version=4))
