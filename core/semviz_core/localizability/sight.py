"""What a camera at a pose can see of mapped elements, and what a detector would make of it.

Pixels are undistorted ones: how far an image reaches is all that a lens would change.
"""

from dataclasses import dataclass, replace

import numpy as np

from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.camera import MIN_DEPTH_M, Camera
from semviz_core.classes import POLE
from semviz_core.detector_model import DetectorModel
from semviz_core.elements import Elements2D, Elements3D, joined
from semviz_core.localizability.conditions import Conditions
from semviz_core.pose import Pose
from semviz_core.sources.street.detector import Noise

NEAREST_M = 3.0
"""Elements closer to the camera are not counted on."""
LEAST_LENGTH_PX = 15.0
"""Shorter poles are not detected."""
SHOWN_LENGTH = (0.5, 0.85)
"""Share of a pole that is seen where its bottom is hidden."""
FALSE_POLES = 0.7
"""Share of false detections that are poles."""


@dataclass(frozen=True, eq=False)
class Sight:
    """The m elements in view, as they would be seen without an error."""

    row: IntArray
    """(m,) rows of the elements that were looked at."""
    seen: Elements2D
    recall: FloatArray
    """(m,) chance that each is detected."""


def look(
    elements: Elements3D,
    camera: Camera,
    T_camera_map: Pose,
    conditions: Conditions,
    shown: FloatArray | None = None,
) -> Sight:
    """What of ``elements`` (n,) is in the image, poles down to a share ``shown`` (n,) of them."""
    line = elements.is_line
    anchor_c = T_camera_map.apply(elements.anchor_m)
    bottom_m = elements.end_m
    if shown is not None:
        bottom_m = elements.anchor_m + shown[:, None] * (elements.end_m - elements.anchor_m)
    end_c = T_camera_map.apply(bottom_m)
    anchor, end = _project(camera, anchor_c), _project(camera, end_c)
    top, top_cut = _clipped(camera, anchor, end)
    bottom, bottom_cut = _clipped(camera, end, anchor)
    top = np.where(line[:, None], top, anchor)
    recall = recall_at(conditions.detector, anchor_c[:, 2])
    visible = camera.contains(top) & (anchor_c[:, 2] > NEAREST_M) & (recall > 0.0)
    visible &= ~line | (camera.contains(bottom) & (_length(top - bottom) > LEAST_LENGTH_PX))
    row = np.flatnonzero(visible)
    seen = Elements2D(
        anchor_px=top[row],
        end_px=np.where(line[:, None], bottom, np.nan)[row],
        class_id=elements.class_id[row],
        score=np.full(len(row), 0.9),
        sigma_px=np.ones((len(row), 2)),
        anchor_known=(elements.anchor_known & ~(line & top_cut))[row],
        end_known=(elements.end_known & line & ~bottom_cut)[row],
    )
    return Sight(row, replace(seen, sigma_px=sigma_px(seen, conditions.noise)), recall[row])


def recall_at(detector: DetectorModel, depth_m: FloatArray) -> FloatArray:
    """(n,) chance that an element in view is detected at each depth."""
    span = detector.far_m - detector.near_m
    share = np.clip((depth_m - detector.near_m) / span, 0.0, 1.0)
    recall = detector.recall_near + share * (detector.recall_far - detector.recall_near)
    return np.where(depth_m <= detector.reach_m, recall, 0.0)


def sigma_px(seen: Elements2D, noise: Noise) -> FloatArray:
    """(m, 2) across and along; at the ends of a pole an error of its angle counts as well."""
    line = seen.is_line
    sign = np.array([noise.sign_px.get(one, 1.0) for one in seen.class_id.tolist()])
    half = np.where(line, 0.5 * _length(seen.end_px - seen.anchor_px), 0.0)
    across = np.hypot(noise.pole_across_px, np.tan(noise.pole_angle_rad) * half)
    pole = np.stack([across, np.full(len(seen), noise.pole_along_px)], axis=1)
    return np.where(line[:, None], pole, sign.reshape(-1, 1))


def detect(
    elements: Elements3D,
    camera: Camera,
    T_camera_map: Pose,
    conditions: Conditions,
    rng: np.random.Generator,
) -> Elements2D:
    """A made-up frame: what a detector finds of ``elements`` and invents, with its errors."""
    n = len(elements)
    hidden = rng.random(n) < conditions.hidden_bottoms
    shown = np.where(hidden, rng.uniform(*SHOWN_LENGTH, n), 1.0)
    sight = look(elements, camera, T_camera_map, conditions, shown)
    found = rng.random(n)[sight.row] < sight.recall
    true, hidden = sight.seen[found], hidden[sight.row][found]
    if conditions.detector.hidden_bottoms == 0.0:  # it notices
        true = replace(true, end_known=true.end_known & ~hidden)
    return joined(_disturbed(true, rng), _invented(camera, conditions, rng))


def _project(camera: Camera, points_c: FloatArray) -> FloatArray:
    """(n, 2) undistorted pixels; NaN behind the camera and for points without an end."""
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = np.where(points_c[:, 2:] > MIN_DEPTH_M, points_c, np.nan)
        return np.asarray((ahead @ camera.K.T)[:, :2] / ahead[:, 2:])


def _clipped(camera: Camera, point: FloatArray, other: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Points moved along the line to ``other`` until inside the image's top and bottom rows."""
    limit = np.clip(point[:, 1], 0.0, camera.height - 1.0)
    cut = np.asarray((limit != point[:, 1]) & np.isfinite(point[:, 1]))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(cut, (limit - point[:, 1]) / (other[:, 1] - point[:, 1]), 0.0)
        return point + share[:, None] * (other - point), cut


def _disturbed(true: Elements2D, rng: np.random.Generator) -> Elements2D:
    """With noise across and along at both ends of poles, in u and v of signs."""
    m, line = len(true), true.is_line
    down = np.tile([0.0, 1.0], (m, 1))
    axis = true.end_px[line] - true.anchor_px[line]
    down[line] = axis / _length(axis)[:, None]
    across = np.stack([down[:, 1], -down[:, 0]], axis=1)
    noise = rng.standard_normal((2, m, 2)) * true.sigma_px
    offset = noise[:, :, :1] * across + noise[:, :, 1:] * down
    return replace(true, anchor_px=true.anchor_px + offset[0], end_px=true.end_px + offset[1])


def _invented(camera: Camera, conditions: Conditions, rng: np.random.Generator) -> Elements2D:
    """Detections of nothing, in the upper half of the image."""
    count = int(rng.poisson(conditions.detector.false_detections))
    signs = np.array(sorted(conditions.noise.sign_px))
    class_id = np.where(rng.random(count) < FALSE_POLES, POLE, rng.choice(signs, count))
    anchor = rng.uniform((0.0, 0.0), (camera.width - 1.0, 0.5 * camera.height), (count, 2))
    length = rng.uniform(0.1, 0.5, count) * camera.height
    end = anchor + np.column_stack([rng.normal(0.0, 2.0, count), length])
    false = Elements2D.from_ends(
        anchor, np.where((class_id == POLE)[:, None], end, np.nan), class_id
    )
    return replace(
        false, score=rng.uniform(0.3, 0.8, count), sigma_px=sigma_px(false, conditions.noise)
    )


def _length(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(vectors, axis=1))
