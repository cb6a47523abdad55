"""A detector of poles and signs, simulated: the truth with the benchmark's errors."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements2D, joined
from semviz_core.sources.source import Side
from semviz_core.sources.street.layout import CLASS_SHARE, SIGN_CLASSES
from semviz_core.sources.street.street import Street

NoiseName = Literal["paper", "low"]

RECALL = {POLE: 0.66, TRIANGULAR: 0.89, RECTANGULAR: 0.87, ROUNDED: 0.79}
"""Of elements up to 20 m away (the paper's table of detection accuracy)."""
FADE_M = (20.0, 40.0)
FADE = 0.4
"""Recall falls by this share between those distances."""
RANGE_M = (3.0, 40.0)
FALSE_RATE = 0.5
"""Mean number of false detections in an image."""
FALSE_POLE_SHARE = 0.7
HIDE_BOTTOM = 0.25
"""Of the bottoms that parked cars leave visible; with those the cars hide, about half are."""

DETECTOR_MODEL = DetectorModel(
    false_detections=FALSE_RATE,
    recall_near=0.75,
    recall_far=0.42,
    near_m=FADE_M[0],
    far_m=FADE_M[1],
    reach_m=RANGE_M[1] + 1.0,
    hidden_bottoms=0.0,
)
"""What is true of ``SimulatedDetector``: recall measured over all mapped elements in view, the
hidden ones too, on four streets of 60 frames. It flags the bottoms that it cannot see."""


class Noise(NamedTuple):
    """Standard deviations of a detector."""

    pole_across_px: float
    pole_along_px: float
    pole_angle_rad: float
    sign_px: dict[int, float]
    """Along each axis, by class."""


NOISE: dict[NoiseName, Noise] = {
    # Signs: root mean square errors of the paper's table, its mean errors included.
    "paper": Noise(
        1.5, 4.0, float(np.deg2rad(1.32)), {TRIANGULAR: 1.81, RECTANGULAR: 4.10, ROUNDED: 3.17}
    ),
    "low": Noise(
        1.0, 1.0, float(np.deg2rad(0.3)), {TRIANGULAR: 1.0, RECTANGULAR: 1.0, ROUNDED: 1.0}
    ),
}


@dataclass(frozen=True, eq=False)
class Detection:
    """What a detector says about an image, and what only a simulation knows."""

    observed: Elements2D
    element_id: IntArray
    """(m,) element of the truth map; -1 for a false detection."""


class SimulatedDetector:
    """Detects a street's elements; the same for the same seed, frame and side."""

    def __init__(self, street: Street, noise: NoiseName, seed: int) -> None:
        self._street = street
        self._noise = NOISE[noise]
        self._seed = seed

    def detect(self, index: int, side: Side = "left") -> Detection:
        """One image's detections, the true ones first."""
        rng = np.random.default_rng([self._seed, index, side == "right"])
        labels, ids = self._street.labels(index, side)
        found = np.flatnonzero(self._is_found(labels, self._distances(ids, index, side), rng))
        true = self._disturb(_hide_bottoms(labels[found], rng), rng)
        false = self._false(rng)
        return Detection(
            observed=joined(true, false),
            element_id=np.concatenate([ids[found], np.full(len(false), -1)]),
        )

    def _distances(self, ids: IntArray, index: int, side: Side) -> FloatArray:
        """(m,) metres from the camera, horizontally."""
        truth = self._street.truth_map.elements
        offset = truth.anchor_m[np.searchsorted(truth.id, ids)]
        offset = offset - self._street.view(index, side).center_m
        return np.asarray(np.linalg.norm(offset[:, :2], axis=1))

    def _is_found(
        self, labels: Elements2D, distance_m: FloatArray, rng: np.random.Generator
    ) -> BoolArray:
        """(m,) drawn by the recall of each class and distance."""
        recall = np.array([RECALL[one] for one in labels.class_id.tolist()])
        recall = recall * (1.0 - FADE * np.interp(distance_m, FADE_M, (0.0, 1.0)))
        near, far = RANGE_M
        in_range = (distance_m >= near) & (distance_m <= far)
        return np.asarray((rng.random(len(labels)) < recall) & in_range)

    def _disturb(self, true: Elements2D, rng: np.random.Generator) -> Elements2D:
        """Pixel noise, and the honest sigma of each end."""
        noise, m = self._noise, len(true)
        isotropic = np.array([noise.sign_px.get(one, 0.0) for one in true.class_id.tolist()])
        jitter = rng.standard_normal((m, 2)) * isotropic[:, None]
        anchor, end = true.anchor_px + jitter, true.end_px.copy()
        sigma = np.stack([isotropic, isotropic], axis=1)
        line = true.is_line
        axis = true.end_px[line] - true.anchor_px[line]
        half = np.linalg.norm(axis, axis=1, keepdims=True) / 2.0
        along = axis / (2.0 * half)
        across = np.stack([-along[:, 1], along[:, 0]], axis=1)
        shift = noise.pole_across_px * rng.standard_normal(half.shape)
        turn = np.tan(noise.pole_angle_rad * rng.standard_normal(half.shape)) * half
        slip = noise.pole_along_px * rng.standard_normal((2, *half.shape))
        # an end that is cut off or hidden lies somewhere on the line anyway
        anchor[line] += (shift - turn) * across + slip[0] * along * true.anchor_known[line, None]
        end[line] += (shift + turn) * across + slip[1] * along * true.end_known[line, None]
        sigma[line, 0] = np.hypot(noise.pole_across_px, noise.pole_angle_rad * half[:, 0])
        sigma[line, 1] = noise.pole_along_px
        score = rng.uniform(0.5, 1.0, m)
        return Elements2D(
            anchor, end, true.class_id, score, sigma, true.anchor_known, true.end_known
        )

    def _false(self, rng: np.random.Generator) -> Elements2D:
        """Detections of nothing."""
        camera = self._street.rig.left
        m = int(rng.poisson(FALSE_RATE))
        is_pole = rng.random(m) < FALSE_POLE_SHARE
        class_id = np.where(is_pole, POLE, rng.choice(SIGN_CLASSES, m, p=CLASS_SHARE))
        anchor = rng.uniform((0.0, 40.0), (camera.width - 1.0, 0.6 * camera.height), (m, 2))
        length = rng.uniform(30.0, 140.0, (m, 1)) * (0.0, 1.0)
        end = anchor + length + rng.normal(0.0, 1.0, (m, 2)) * (1.0, 0.0)
        pole = self._noise.pole_across_px, self._noise.pole_along_px
        sign = [(self._noise.sign_px.get(one, 1.0),) * 2 for one in class_id.tolist()]
        return Elements2D(
            anchor_px=anchor,
            end_px=np.where(is_pole[:, None], end, np.nan),
            class_id=class_id,
            score=rng.uniform(0.3, 0.8, m),
            sigma_px=np.where(is_pole[:, None], pole, np.array(sign).reshape(m, 2)),
            anchor_known=np.ones(m, dtype=bool),
            end_known=is_pole & (rng.random(m) < 0.5),
        )


def _hide_bottoms(labels: Elements2D, rng: np.random.Generator) -> Elements2D:
    """Some poles end above their bottoms, as behind a bush or a passer-by."""
    m = len(labels)
    hidden = labels.end_known & (rng.random(m) < HIDE_BOTTOM)
    kept = np.where(hidden, rng.uniform(0.5, 0.85, m), 1.0)[:, None]
    return Elements2D(
        anchor_px=labels.anchor_px,
        end_px=labels.anchor_px + kept * (labels.end_px - labels.anchor_px),
        class_id=labels.class_id,
        score=labels.score,
        sigma_px=labels.sigma_px,
        anchor_known=labels.anchor_known,
        end_known=labels.end_known & ~hidden,
    )
