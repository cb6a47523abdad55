"""Detect poles and signs in a rendered image: the truth, and a simulated detector with errors.

The truth for evaluation is the labels of a careful annotator. Elements with at least one visible
pixel that are far off, almost hidden, or hidden at their centre are ignored. Training regions are
those of a perfect model. The detector has the benchmark's errors; the same seed, frame and side
give the same detections.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.detector_model import NOISE, RANGE_M, SIMULATED_DETECTOR, NoiseName
from semviz_core.base.elements import Elements2D, joined
from semviz_core.base.frame import Side
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.detection.regions import Region
from semviz_core.metrics.detection import REACH_M, ImageGroundTruth
from semviz_core.simulation.layout import CLASS_SHARE, SIGN_CLASSES
from semviz_core.simulation.street import Street


def street_truth(
    street: Street, index: int, side: Side, reach_m: float = REACH_M
) -> ImageGroundTruth:
    """Return the labels of a careful annotator, with all other visible elements as ignored.

    Ignored elements show at least a pixel, but are far off, almost hidden, or hidden at the centre.
    """
    labelled, ids = street.labels(index, side)
    order, ranks = street.painted(index, side)
    seen = np.unique(order)
    others = np.array(
        [id for id, rank in ranks.items() if rank in seen and id not in ids], dtype=np.int64
    )
    boxes = {id: _box(order == ranks[id]) for id in (*ids.tolist(), *others.tolist())}
    elements = joined(labelled, _remainders(street, others, boxes))
    all_ids = np.concatenate([ids, others])
    sizes = [boxes[id][1] for id in all_ids.tolist()]
    return ImageGroundTruth.of(
        elements,
        distance_m=street.distance_m(all_ids, index, side),
        size_px=np.array([size.min() for size in sizes], dtype=np.float64),
        ignored=np.arange(len(elements)) >= len(labelled),
        reach_m=reach_m,
    )


_Box = tuple[FloatArray, FloatArray]
"""Middle (2,) and size (2,) in pixels."""


def _box(mask: BoolArray) -> _Box:
    rows, columns = np.nonzero(mask)
    low = np.array([columns.min(), rows.min()], dtype=np.float64)
    high = np.array([columns.max(), rows.max()], dtype=np.float64)
    return (low + high) / 2.0, high - low + 1.0


def _remainders(street: Street, ids: IntArray, boxes: dict[int, _Box]) -> Elements2D:
    """Return elements (k,) that would not be labelled, at the centre of their visible pixels."""
    mapped = street.truth_map.elements
    rows = mapped[np.searchsorted(mapped.id, ids)]
    middle = np.array([boxes[id][0] for id in ids.tolist()]).reshape(-1, 2)
    half = np.array([boxes[id][1] for id in ids.tolist()]).reshape(-1, 2)[:, 1:] / 2.0
    reach = np.concatenate([np.zeros_like(half), half], axis=1)
    is_line = rows.is_line[:, None]
    known: NDArray[np.bool_] = np.zeros(len(ids), dtype=bool)
    return Elements2D(
        anchor_px=np.where(is_line, middle - reach, middle),
        end_px=np.where(is_line, middle + reach, np.nan),
        class_id=rows.class_id,
        score=np.ones(len(ids)),
        sigma_px=np.ones((len(ids), 2)),
        anchor_known=known | ~rows.is_line,
        end_known=known,
    )


class RenderedTruth(NamedTuple):
    """The elements and regions of a rendered image."""

    elements: Elements2D
    """(m,) exact labels of a careful annotator."""
    element_id: IntArray
    """(m,) in the street's ``truth_map``."""
    regions: tuple[Region, ...]
    """(m,) of score 1, with masks of the visible pixels."""


def rendered_truth(street: Street, index: int, side: Side) -> RenderedTruth:
    """Return the ground truth of one image of a street."""
    elements, element_id = street.labels(index, side)
    order, ranks = street.painted(index, side)
    regions: list[Region] = []
    for row in range(len(elements)):
        shown = order == ranks[int(element_id[row])]
        rows, columns = np.nonzero(shown)
        top, left = int(rows.min()), int(columns.min())
        regions.append(
            Region(
                class_id=int(elements.class_id[row]),
                score=1.0,
                box_px=np.array([left, top, columns.max(), rows.max()], dtype=np.float64),
                mask=shown[top : rows.max() + 1, left : columns.max() + 1],
                corner_px=(left, top),
                ends_px=_ends(elements, row),
                ends_known=(bool(elements.anchor_known[row]), bool(elements.end_known[row])),
            )
        )
    return RenderedTruth(elements, element_id, tuple(regions))


def _ends(elements: Elements2D, row: int) -> FloatArray | None:
    if not elements.is_line[row]:
        return None
    return np.stack([elements.anchor_px[row], elements.end_px[row]])


RECALL = {POLE: 0.66, TRIANGULAR: 0.89, RECTANGULAR: 0.87, ROUNDED: 0.79}
"""Recall of elements up to 20 m away (the paper's table of detection accuracy)."""
FADE_M = (SIMULATED_DETECTOR.near_m, SIMULATED_DETECTOR.far_m)
FADE = 0.4
"""Recall falls by this share between those distances."""
FALSE_TO_CENTROID_PX = 4.0
"""Of false positives, as of a triangle of 24 px height."""
FALSE_POLE_SHARE = 0.7
HIDE_BOTTOM = 0.25
"""Share of hidden bottoms among those that parked cars leave visible; with both, about half are
hidden."""


@dataclass(frozen=True, eq=False)
class Detection:
    """The detections in an image, with their true elements."""

    observed: Elements2D
    element_id: IntArray
    """(m,) element of the truth map; -1 for a false positive."""


class SimulatedDetector:
    """Detects a street's elements; same seed, frame and side give the same detections."""

    def __init__(self, street: Street, noise: NoiseName, seed: int) -> None:
        self._street = street
        self._noise = NOISE[noise]
        self._seed = seed

    def detect(self, index: int, side: Side = "left") -> Detection:
        """Return one image's detections, true ones first."""
        rng = np.random.default_rng([self._seed, index, side == "right"])
        labels, ids = self._street.labels(index, side)
        detected = np.flatnonzero(self._is_found(labels, self._distances(ids, index, side), rng))
        true = self._disturb(_hide_bottoms(labels[detected], rng), rng)
        false = self._false(rng)
        return Detection(
            observed=joined(true, false),
            element_id=np.concatenate([ids[detected], np.full(len(false), -1)]),
        )

    def _distances(self, ids: IntArray, index: int, side: Side) -> FloatArray:
        """Return (m,) horizontal distances from the camera in metres."""
        truth = self._street.truth_map.elements
        offset = truth.anchor_m[np.searchsorted(truth.id, ids)]
        offset = offset - self._street.view(index, side).center_m
        return np.asarray(np.linalg.norm(offset[:, :2], axis=1))

    def _is_found(
        self, labels: Elements2D, distance_m: FloatArray, rng: np.random.Generator
    ) -> BoolArray:
        """Return (m,) whether each is detected, drawn with the recall of its class and distance."""
        recall = np.array([RECALL[class_id] for class_id in labels.class_id.tolist()])
        recall = recall * (1.0 - FADE * np.interp(distance_m, FADE_M, (0.0, 1.0)))
        near, far = RANGE_M
        in_range = (distance_m >= near) & (distance_m <= far)
        return np.asarray((rng.random(len(labels)) < recall) & in_range)

    def _disturb(self, true: Elements2D, rng: np.random.Generator) -> Elements2D:
        """Return the elements with pixel noise and its sigma."""
        noise, m = self._noise, len(true)
        isotropic = np.array(
            [noise.sign_px.get(class_id, 0.0) for class_id in true.class_id.tolist()]
        )
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
        # an end that is cut off or hidden has no error along the line
        anchor[line] += (shift - turn) * across + slip[0] * along * true.anchor_known[line, None]
        end[line] += (shift + turn) * across + slip[1] * along * true.end_known[line, None]
        sigma[line, 0] = np.hypot(noise.pole_across_px, noise.pole_angle_rad * half[:, 0])
        sigma[line, 1] = noise.pole_along_px
        score = rng.uniform(0.5, 1.0, m)
        return Elements2D(
            anchor,
            end,
            true.class_id,
            score,
            sigma,
            true.anchor_known,
            true.end_known,
            true.to_centroid_px,
        )

    def _false(self, rng: np.random.Generator) -> Elements2D:
        """Return false positives."""
        camera = self._street.rig.left
        m = int(rng.poisson(SIMULATED_DETECTOR.false_detections))
        is_pole = rng.random(m) < FALSE_POLE_SHARE
        class_id = np.where(is_pole, POLE, rng.choice(SIGN_CLASSES, m, p=CLASS_SHARE))
        anchor = rng.uniform((0.0, 40.0), (camera.width - 1.0, 0.6 * camera.height), (m, 2))
        length = rng.uniform(30.0, 140.0, (m, 1)) * (0.0, 1.0)
        end = anchor + length + rng.normal(0.0, 1.0, (m, 2)) * (1.0, 0.0)
        pole = self._noise.pole_across_px, self._noise.pole_along_px
        sign = [(self._noise.sign_px.get(class_id, 1.0),) * 2 for class_id in class_id.tolist()]
        return Elements2D(
            anchor_px=anchor,
            end_px=np.where(is_pole[:, None], end, np.nan),
            class_id=class_id,
            score=rng.uniform(0.3, 0.8, m),
            sigma_px=np.where(is_pole[:, None], pole, np.array(sign).reshape(m, 2)),
            anchor_known=np.ones(m, dtype=bool),
            end_known=is_pole & (rng.random(m) < 0.5),
            to_centroid_px=np.full(m, FALSE_TO_CENTROID_PX),
        )


def _hide_bottoms(labels: Elements2D, rng: np.random.Generator) -> Elements2D:
    """Return the labels with some bottoms hidden, as by a bush or a passer-by."""
    m = len(labels)
    hidden = labels.end_known & (rng.random(m) < HIDE_BOTTOM)
    shown = np.where(hidden, rng.uniform(0.5, 0.85, m), 1.0)[:, None]
    return Elements2D(
        anchor_px=labels.anchor_px,
        end_px=labels.anchor_px + shown * (labels.end_px - labels.anchor_px),
        class_id=labels.class_id,
        score=labels.score,
        sigma_px=labels.sigma_px,
        anchor_known=labels.anchor_known,
        end_known=labels.end_known & ~hidden,
        to_centroid_px=labels.to_centroid_px,
    )
