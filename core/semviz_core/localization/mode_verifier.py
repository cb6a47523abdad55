"""Estimate how likely each mode of a search is right, with a small network in NumPy.

The network is defined once, for NumPy and torch. It pools two sets, the mapped elements around
a mode and the observations. It joins them with the mode's features and compares all modes of
the frame. Its output is a log-odds for each mode and one for none. A linear path runs from a
mode's features to its log-odds; alone it would be a logistic regression.

The positions of vehicles relative to roadside elements are learned from the map elements around
the mode. Two inputs are left out because they would reveal the right mode in simulation. The
road of the map (``Prior.road_m``) is one: the simulated camera follows it to 0.3 m. Detection
scores are the other: no true one is below 0.9 there, and no false one above 0.8.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.camera import Camera
from semviz_core.base.classes import DEFAULT_CLASSES, ClassSet, as_known
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.weights import NetworkWeights, load_trained, version_error
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors
from semviz_core.localization.search import Modes

MOST_MODES = 8
"""The best modes of a frame that are compared; in 2 of 1,000 frames only a later one is right."""
NEAR_M = 45.0
"""Mapped elements further from a mode's camera are left out."""
MODE_FEATURES, MAPPED_FEATURES, SEEN_FEATURES = 28, 8, 7
"""Numbers of features of a mode, and of a mapped and an observed element besides its class."""
_DEPTHS_M = (3.0, 10.0, 20.0, 30.0, 41.0)
"""Limits of the depth ranges in which elements with and without a pair are counted."""
Float32Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class ModeFeatures:
    """Network inputs of the b modes of a frame, with m observed and k mapped elements near one.

    b may be 0. Features are scaled to about 1; the last ``classes`` columns are one-hot.
    """

    mode: Float32Array  # (b, MODE_FEATURES)
    weight: Float32Array  # (b,) weight of a mode in the frame's average
    mapped: Float32Array  # (b, k, MAPPED_FEATURES + classes)
    near: Float32Array  # (b, k) 1 if the element is near the mode, else 0
    seen: Float32Array  # (b, m, SEEN_FEATURES + classes)

    @classmethod
    def of(
        cls,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        modes: Modes,
        classes: ClassSet = DEFAULT_CLASSES,
    ) -> "ModeFeatures":
        """Return the features of the first MOST_MODES of ``modes``."""
        b = min(len(modes.score), MOST_MODES)
        rotation, match, score = modes.rotation[:b], modes.match[:b], modes.score[:b]
        gap = score - score.max(initial=-np.inf)
        center = -np.einsum("bji,bj->bi", rotation, modes.translation[:b])
        gain = _gain_of_pairs(modes.gain[:b], match)
        paired = (match[:, :, None] == np.arange(len(submap))).any(axis=1)
        geometry = _ModeGeometry.of(submap, camera, rotation, modes.translation[:b])
        near = geometry.distance_m < NEAR_M
        kept = near.any(axis=0)
        return cls(
            mode=np.column_stack(
                [
                    _fit(score, gap, gain, match, observed),
                    _misses(geometry, paired),
                    _off_prior(rotation, center, prior),
                    _circumstances(gap, observed, prior),
                ]
            ).astype(np.float32),
            weight=np.exp(np.maximum(gap, -40.0) / 4.0).astype(np.float32),
            mapped=_mapped(submap, geometry, center, rotation, paired, classes)[:, kept],
            near=near[:, kept].astype(np.float32),
            seen=_seen(observed, camera, match, gain, classes),
        )


@dataclass(frozen=True, eq=False)
class _ModeGeometry:
    """n mapped elements as seen from b modes."""

    camera_m: FloatArray  # (b, n, 3) of the middle, camera axes
    distance_m: FloatArray  # (b, n)
    in_view: BoolArray  # (b, n)

    @classmethod
    def of(
        cls, submap: Elements3D, camera: Camera, rotation: FloatArray, translation: FloatArray
    ) -> "_ModeGeometry":
        end = np.where(submap.is_line[:, None], submap.end_m, submap.anchor_m)
        middle = 0.5 * (submap.anchor_m + end)
        camera_m = middle @ rotation.transpose(0, 2, 1) + translation[:, None]
        depth = np.maximum(camera_m[..., 2], 0.1)
        u = camera.K[0, 0] * camera_m[..., 0] / depth + camera.K[0, 2]
        v = camera.K[1, 1] * camera_m[..., 1] / depth + camera.K[1, 2]
        in_view = (camera_m[..., 2] > _DEPTHS_M[0]) & (u > 0.0) & (u < camera.width)
        in_view &= (v > 0.0) & (v < camera.height)
        return cls(camera_m, np.linalg.norm(camera_m, axis=2), in_view)


def _gain_of_pairs(gain: FloatArray, match: IntArray) -> FloatArray:
    """Return the gain (b, m) in nats of each observed element's pair, 0 without a pair."""
    if gain.shape[2] == 0:
        return np.zeros(match.shape)
    at = np.maximum(match, 0)[:, :, None]
    return np.where(match >= 0, np.take_along_axis(gain, at, axis=2)[:, :, 0], 0.0)


def _fit(
    score: FloatArray, gap: FloatArray, gain: FloatArray, match: IntArray, observed: Elements2D
) -> FloatArray:
    """Return (b, 9) how well each mode explains the image, also relative to the best one."""
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


def _misses(geometry: _ModeGeometry, paired: BoolArray) -> FloatArray:
    """Return (b, 8) the number of mapped elements in view with and without a pair, by depth."""
    depth = geometry.camera_m[..., 2]
    counts = []
    for low, high in pairwise(_DEPTHS_M):
        in_range = geometry.in_view & (depth > low) & (depth <= high)
        counts += [(in_range & paired).sum(axis=1) / 3.0, (in_range & ~paired).sum(axis=1) / 3.0]
    return np.column_stack(counts)


def _off_prior(rotation: FloatArray, center: FloatArray, prior: Prior) -> FloatArray:
    """Return (b, 4) the distance from the fix and its square, from gravity and from the heading,
    in sigmas."""
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
    """Return (b, 7) the features that all modes of a frame share."""
    rivals = [float((gap > -nats).sum()) for nats in (3.0, 14.0)]
    shared = np.array(
        [
            len(observed) / 10.0,
            prior.horizontal_sigma_m / 10.0,
            prior.up_camera is not None,
            prior.heading_rad is not None,
            np.log(float(np.median(observed.sigma_px))),
            *(rival / 4.0 for rival in rivals),
        ]
    )
    return np.broadcast_to(shared, (len(gap), len(shared)))


def _mapped(
    submap: Elements3D,
    geometry: _ModeGeometry,
    center: FloatArray,
    rotation: FloatArray,
    paired: BoolArray,
    classes: ClassSet,
) -> Float32Array:
    """Return (b, n, MAPPED_FEATURES + classes): how far ahead, left and above the camera each
    element is in the level frame, and whether it has a pair and is in view."""
    offset = submap.anchor_m - center[:, None]
    ahead = unit_vectors(rotation[:, 2, :2])
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
            geometry.in_view,
            geometry.in_view & ~paired,
        ],
        axis=2,
    )
    return _with_class(numbers, as_known(submap.class_id, submap.is_line, classes), classes)


def _seen(
    observed: Elements2D, camera: Camera, match: IntArray, gain: FloatArray, classes: ClassSet
) -> Float32Array:
    """Return (b, m, SEEN_FEATURES + classes): directions, whether paired, and the gain."""
    ray = camera.bearing(observed.anchor_px)
    end = np.where(observed.is_line[:, None], observed.end_px, observed.anchor_px)
    length = np.linalg.norm(end - observed.anchor_px, axis=1) / camera.K[1, 1]
    shared = np.column_stack([ray[:, :2] / ray[:, 2:], length, observed.anchor_known])
    b = len(match)
    numbers = np.concatenate(
        [
            np.broadcast_to(shared, (b, *shared.shape)),
            np.stack([match >= 0, match < 0, gain / 10.0], axis=2),
        ],
        axis=2,
    )
    return _with_class(numbers, as_known(observed.class_id, observed.is_line, classes), classes)


def _with_class(numbers: FloatArray, class_id: IntArray, classes: ClassSet) -> Float32Array:
    """Return ``numbers`` (b, k, columns) with a one-hot column appended for each class."""
    ids = np.array([class_.id for class_ in classes])
    of_class: NDArray[Any] = class_id[:, None] == ids
    columns = np.broadcast_to(of_class, (len(numbers), *of_class.shape))
    return np.concatenate([numbers, columns], axis=2).astype(np.float32)


Numbers: TypeAlias = Any
"""A float32 array of NumPy or a tensor of torch: the network uses only operations of both."""
HIDDEN, COMPARED = 32, 64


def layer_sizes(classes: int) -> dict[str, tuple[int, int]]:
    """Return the numbers of inputs and outputs of each layer by name."""
    return {
        "mapped1": (MAPPED_FEATURES + classes, HIDDEN),
        "mapped2": (HIDDEN, HIDDEN),
        "seen1": (SEEN_FEATURES + classes, HIDDEN),
        "seen2": (HIDDEN, HIDDEN),
        "mode1": (MODE_FEATURES, COMPARED),
        "about": (HIDDEN, COMPARED),
        "image": (HIDDEN, COMPARED),
        "mode2": (COMPARED, HIDDEN),
        "own": (HIDDEN, HIDDEN),
        "frame": (HIDDEN, HIDDEN),
        "right": (HIDDEN, 1),
        "straight": (MODE_FEATURES, 1),
        "none": (HIDDEN, 1),
    }


def log_odds(
    weights: Mapping[str, Numbers],
    mode: Numbers,
    weight: Numbers,
    mapped: Numbers,
    near: Numbers,
    seen: Numbers,
    is_seen: Numbers,
) -> tuple[Numbers, Numbers]:
    """Return the log-odds (..., b) of each mode being right, and (...) of none, for a softmax.

    The inputs are ``ModeFeatures`` with leading dimensions. In padding, ``weight``, ``near`` and
    ``is_seen`` (..., b, m) are 0.
    """

    def layer(name: str, x: Numbers) -> Numbers:
        return x @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]

    def pooled(name: str, x: Numbers, included: Numbers) -> Numbers:
        each = layer(f"{name}2", layer(f"{name}1", x).clip(min=0.0)).clip(min=0.0)
        return (each * included[..., None]).sum(-2) / 8.0

    about = layer("about", pooled("mapped", mapped, near))
    image = layer("image", pooled("seen", seen, is_seen))
    first = (layer("mode1", mode) + about + image).clip(min=0.0)
    each = layer("mode2", first).clip(min=0.0)
    share = weight / weight.sum(-1)[..., None].clip(min=1e-9)
    frame = (each * share[..., None]).sum(-2)
    compared = (layer("own", each) + layer("frame", frame)[..., None, :]).clip(min=0.0)
    right = layer("right", compared) + layer("straight", mode)
    return right[..., 0], layer("none", frame)[..., 0]


TASK = "verifier"


@dataclass(frozen=True, eq=False)
class ModeVerifier:
    """The trained network: its weights and its classes."""

    weights: Mapping[str, Float32Array]
    classes: ClassSet

    def verified(
        self,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        modes: Modes,
    ) -> tuple[Modes, FloatArray]:
        """Return the modes with the most probable one moved to the front, and their probability
        (b,)."""
        probability = self.probability(observed, submap, camera, prior, modes)
        if not len(probability):
            return modes, probability
        order = np.argsort(np.arange(len(probability)) != probability.argmax(), kind="stable")
        chosen = replace(
            modes,
            rotation=modes.rotation[order],
            translation=modes.translation[order],
            score=modes.score[order],
            match=modes.match[order],
            gain=modes.gain[order],
        )
        return chosen, probability[order]

    def probability(
        self,
        observed: Elements2D,
        submap: Elements3D,
        camera: Camera,
        prior: Prior,
        modes: Modes,
    ) -> FloatArray:
        """Return the probability (b,) that each mode is within 1 m and 2 deg of the truth; the
        remainder to 1 is the probability that none is."""
        features = ModeFeatures.of(observed, submap, camera, prior, modes, self.classes)
        right, none = log_odds(
            self.weights,
            features.mode,
            features.weight,
            features.mapped,
            features.near,
            features.seen,
            np.ones(features.seen.shape[:2], dtype=np.float32),
        )
        odds = np.append(right, none).astype(np.float64)
        share = np.exp(odds - odds.max())
        probability = np.zeros(len(modes.score))
        probability[: len(right)] = share[:-1] / share.sum()
        return probability


def load_verifier(path: Path | None, classes: ClassSet) -> ModeVerifier:
    """Return the verifier stored at ``path`` (default: the shipped one).

    Raise SemvizError if the file is missing or holds another network.
    """
    return load_trained(TASK, path, classes, _built)


def _built(weights: NetworkWeights, classes: ClassSet, path: Path) -> ModeVerifier:
    shapes: dict[str, tuple[int, ...]] = {}
    for name, (inputs, outputs) in layer_sizes(len(classes)).items():
        shapes[f"{name}.weight"] = outputs, inputs
        shapes[f"{name}.bias"] = (outputs,)
    if {name: tensor.shape for name, tensor in weights.tensors.items()} != shapes:
        raise version_error(TASK, path)
    return ModeVerifier(weights.tensors, classes)
