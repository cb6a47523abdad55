"""What tells right modes of a search from wrong ones: numbers for a network, without torch.

Where vehicles are relative to what stands beside roads is learned from the mapped elements about a
mode. The road that priors of maps carry (``Prior.road_m``) is left out on purpose: in simulation
the camera follows it to 0.3 m, which would give the answer away. So are the scores of detections:
in simulation no true one is below 0.9 and no false one above 0.8.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import Camera
from semviz_core.classes import DEFAULT_CLASSES, ClassSet
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.solving.search import Modes

MOST_MODES = 8
"""The best of a frame: of 1,000 frames, 2 have a right one only behind these."""
NEAR_M = 45.0
"""Mapped elements further from a mode's camera are left out."""
OF_A_MODE, OF_A_MAPPED, OF_A_SEEN = 28, 8, 7
"""Numbers that describe one, besides its class."""
_DEPTHS_M = (3.0, 10.0, 20.0, 30.0, 41.0)
"""Between these, elements in view with a pair and without are counted."""
Float32Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Evidence:
    """b modes of one frame, perhaps none, with m observed elements; k mapped ones are near some.

    Lengths are in units that bring them near 1; ``classes`` columns say of which class.
    """

    mode: Float32Array  # (b, OF_A_MODE)
    weight: Float32Array  # (b,) how much a mode counts where modes are seen together
    mapped: Float32Array  # (b, k, OF_A_MAPPED + classes)
    near: Float32Array  # (b, k) 1 where it is near that mode, else 0
    seen: Float32Array  # (b, m, OF_A_SEEN + classes)

    @classmethod
    def of(
        cls,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        modes: Modes,
        classes: ClassSet = DEFAULT_CLASSES,
    ) -> "Evidence":
        """Of the first MOST_MODES of ``modes``."""
        b = min(len(modes.score), MOST_MODES)
        rotation, match, score = modes.rotation[:b], modes.match[:b], modes.score[:b]
        gap = score - score.max(initial=-np.inf)
        center = -np.einsum("bji,bj->bi", rotation, modes.translation[:b])
        gain = _gain_of_pairs(modes.gain[:b], match)
        paired = (match[:, :, None] == np.arange(len(submap))).any(axis=1)
        sight = _Sight.of(submap, camera, rotation, modes.translation[:b])
        near = sight.away_m < NEAR_M
        kept = near.any(axis=0)
        return cls(
            mode=np.column_stack(
                [
                    _fit(score, gap, gain, match, observed),
                    _misses(sight, paired),
                    _off_prior(rotation, center, prior),
                    _circumstances(gap, observed, prior),
                ]
            ).astype(np.float32),
            weight=np.exp(np.maximum(gap, -40.0) / 4.0).astype(np.float32),
            mapped=_mapped(submap, sight, center, rotation, paired, classes)[:, kept],
            near=near[:, kept].astype(np.float32),
            seen=_seen(observed, camera, match, gain, classes),
        )


@dataclass(frozen=True, eq=False)
class _Sight:
    """Where n mapped elements are from b modes."""

    camera_m: FloatArray  # (b, n, 3) of the middle, camera axes
    away_m: FloatArray  # (b, n)
    in_view: BoolArray  # (b, n)

    @classmethod
    def of(
        cls, submap: Elements3D, camera: Camera, rotation: FloatArray, translation: FloatArray
    ) -> "_Sight":
        end = np.where(submap.is_line[:, None], submap.end_m, submap.anchor_m)
        middle = 0.5 * (submap.anchor_m + end)
        place = middle @ rotation.transpose(0, 2, 1) + translation[:, None]
        depth = np.maximum(place[..., 2], 0.1)
        u = camera.K[0, 0] * place[..., 0] / depth + camera.K[0, 2]
        v = camera.K[1, 1] * place[..., 1] / depth + camera.K[1, 2]
        in_view = (place[..., 2] > _DEPTHS_M[0]) & (u > 0.0) & (u < camera.width)
        in_view &= (v > 0.0) & (v < camera.height)
        return cls(place, np.linalg.norm(place, axis=2), in_view)


def _gain_of_pairs(gain: FloatArray, match: IntArray) -> FloatArray:
    """(b, m) nats of the pair of each observed element, 0 without."""
    if gain.shape[2] == 0:
        return np.zeros(match.shape)
    at = np.maximum(match, 0)[:, :, None]
    return np.where(match >= 0, np.take_along_axis(gain, at, axis=2)[:, :, 0], 0.0)


def _fit(
    score: FloatArray, gap: FloatArray, gain: FloatArray, match: IntArray, observed: Elements2D
) -> FloatArray:
    """(b, 9) how well a mode explains what is seen, and how much better the best one does."""
    has, line = match >= 0, observed.is_line
    pairs = has.sum(axis=1)
    least = np.where(has, gain, np.inf).min(axis=1, initial=np.inf)
    rank = np.arange(len(score))
    return np.column_stack(
        [
            gap / 5.0,
            score / 30.0,
            score / (10.0 * len(observed)),
            rank == 0,
            pairs / 5.0,
            pairs / len(observed),
            (has & ~line).sum(axis=1) / 3.0,
            np.where(np.isfinite(least), least, 0.0) / 5.0,
            gain.sum(axis=1) / (10.0 * np.maximum(pairs, 1)),
        ]
    )


def _misses(sight: _Sight, paired: BoolArray) -> FloatArray:
    """(b, 8) how many mapped elements in view have a pair, and have none, by depth."""
    depth = sight.camera_m[..., 2]
    counts = []
    for low, high in pairwise(_DEPTHS_M):
        there = sight.in_view & (depth > low) & (depth <= high)
        counts += [(there & paired).sum(axis=1) / 3.0, (there & ~paired).sum(axis=1) / 3.0]
    return np.column_stack(counts)


def _off_prior(rotation: FloatArray, center: FloatArray, prior: Prior) -> FloatArray:
    """(b, 4) sigmas from the fix and its square, from gravity, from the heading."""
    off = np.linalg.norm(center[:, :2] - prior.position_m[:2], axis=1) / prior.horizontal_sigma_m
    tilt = turn = np.zeros(len(center))
    if prior.up_camera is not None:
        cosine = np.clip(rotation[:, :, 2] @ prior.up_camera, -1.0, 1.0)
        tilt = np.arccos(cosine) / prior.up_sigma_rad
    if prior.heading_rad is not None:
        turn = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 0]) - prior.heading_rad
        turn = np.arctan2(np.sin(turn), np.cos(turn)) / prior.heading_sigma_rad
    return np.column_stack([off / 2.0, off**2 / 4.0, tilt / 2.0, np.abs(turn) / 2.0])


def _circumstances(gap: FloatArray, observed: Elements2D, prior: Prior) -> FloatArray:
    """(b, 7) the same for all modes of a frame."""
    rivals = [float((gap > -nats).sum()) for nats in (3.0, 14.0)]
    same = np.array(
        [
            len(observed) / 10.0,
            prior.horizontal_sigma_m / 10.0,
            prior.up_camera is not None,
            prior.heading_rad is not None,
            np.log(float(np.median(observed.sigma_px))),
            *(one / 4.0 for one in rivals),
        ]
    )
    return np.broadcast_to(same, (len(gap), len(same)))


def _mapped(
    submap: Elements3D,
    sight: _Sight,
    center: FloatArray,
    rotation: FloatArray,
    paired: BoolArray,
    classes: ClassSet,
) -> Float32Array:
    """(b, n, OF_A_MAPPED + classes) ahead, left and above of the camera laid flat."""
    offset = submap.anchor_m - center[:, None]
    ahead = rotation[:, 2, :2]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    forward = (offset[..., :2] * ahead[:, None]).sum(axis=2)
    left = offset[..., 1] * ahead[:, None, 0] - offset[..., 0] * ahead[:, None, 1]
    numbers = np.stack(
        [
            forward / 20.0,
            left / 20.0,
            np.abs(left) / 5.0,
            np.exp(-np.hypot(forward, left) / 5.0),
            offset[..., 2] / 5.0,
            paired,
            sight.in_view,
            sight.in_view & ~paired,
        ],
        axis=2,
    )
    return _with_class(numbers, submap.class_id, classes)


def _seen(
    observed: Elements2D, camera: Camera, match: IntArray, gain: FloatArray, classes: ClassSet
) -> Float32Array:
    """(b, m, OF_A_SEEN + classes) directions, whether paired, and how well."""
    ray = camera.bearing(observed.anchor_px)
    end = np.where(observed.is_line[:, None], observed.end_px, observed.anchor_px)
    length = np.linalg.norm(end - observed.anchor_px, axis=1) / camera.K[1, 1]
    same = np.column_stack([ray[:, :2] / ray[:, 2:], length, observed.anchor_known])
    b = len(match)
    numbers = np.concatenate(
        [
            np.broadcast_to(same, (b, *same.shape)),
            np.stack([match >= 0, match < 0, gain / 10.0], axis=2),
        ],
        axis=2,
    )
    return _with_class(numbers, observed.class_id, classes)


def _with_class(numbers: FloatArray, class_id: IntArray, classes: ClassSet) -> Float32Array:
    """(b, k, columns) with a column for each class, 1 where it is of that one."""
    ids = np.array([one.id for one in classes])
    of_class: NDArray[Any] = class_id[:, None] == ids
    columns = np.broadcast_to(of_class, (len(numbers), *of_class.shape))
    return np.concatenate([numbers, columns], axis=2).astype(np.float32)
