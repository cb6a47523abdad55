"""Find what is marked in one image in another: along the epipolar lines, at plausible depths."""

from dataclasses import dataclass

import numpy as np

from semviz_annotation.assist.shot import Mark, Proposed, Shot, pixel
from semviz_annotation.assist.snap import snap
from semviz_annotation.assist.warp import inverse_depths, transfer
from semviz_annotation.stereo import PLAUSIBLE_DEPTH_M
from semviz_core.arrays import FloatArray
from semviz_core.classes import ElementClass


@dataclass(frozen=True)
class Partners:
    """What a mark may be in another image."""

    best: Proposed
    runner_up: Proposed | None
    """The next best at another depth."""


def find_partner(
    here: Shot, there: Shot, mark: Mark, element_class: ElementClass
) -> Partners | None:
    """The mark in ``there`` of what is marked in ``here``; None where it cannot be in it.

    The views share one map frame: two cameras of a rig, or two frames of one camera. Both ends of
    a pole get the depth that suits an upright one.
    """
    ends = mark.ends_px
    depths = inverse_depths(here.view, there.view, ends.mean(axis=0), PLAUSIBLE_DEPTH_M, 0.5)
    if not len(depths):
        return None
    places = transfer(here.view, there.view, ends, depths)  # (d, ends, 2)
    inside = np.isfinite(places).all(axis=(1, 2))
    inside &= there.view.camera.contains(places.mean(axis=1))
    depths, places = depths[inside], places[inside]
    if not len(depths):
        return None
    likeness = _likeness(here, there, ends, depths)
    order = np.argsort(-likeness, kind="stable")
    best = order[0]
    apart = np.linalg.norm(places - places[best], axis=2).min(axis=1) > 3.0
    peaks = np.ones(len(likeness), dtype=bool)
    peaks[1:] &= likeness[1:] >= likeness[:-1]
    peaks[:-1] &= likeness[:-1] >= likeness[1:]
    others = [at for at in order if apart[at] and peaks[at]]
    second = likeness[others[0]] if others else -1.0
    margin = float(likeness[best] - second)
    one = _proposed(there, mark, places[best], element_class, float(likeness[best]), margin)
    if not others:
        return Partners(one, None)
    two = _proposed(there, mark, places[others[0]], element_class, float(second), -margin)
    return Partners(one, two)


def _likeness(here: Shot, there: Shot, ends: FloatArray, depths: FloatArray) -> FloatArray:
    """(d,) normalized correlation of the windows, -1 to 1."""
    offsets = np.arange(-6.0, 6.1, 1.0)
    if len(ends) == 2:
        share = np.linspace(0.02, 0.98, 32)
        centers = ends[0] + share[:, None] * (ends[1] - ends[0])
    else:
        centers = ends + np.array([[0.0, 1.0]]) * offsets[:, None]
    mine = here.sample(centers[:, None] + offsets[:, None] * [1.0, 0.0])
    axis = transfer(here.view, there.view, centers, depths)
    beside = transfer(here.view, there.view, centers + [1.0, 0.0], depths) - axis
    points = axis[:, :, None] + beside[:, :, None] * offsets[:, None]
    shape = points.shape
    theirs = there.sample(points.reshape(shape[0] * shape[1], shape[2], 2))
    theirs = theirs.reshape(shape[0], -1)
    a = mine.reshape(-1) - mine.mean()
    b = theirs - theirs.mean(axis=1, keepdims=True)
    norms = np.linalg.norm(a) * np.linalg.norm(b, axis=1) + 1e-6
    return np.asarray((b @ a) / norms, dtype=np.float64)


def _proposed(
    there: Shot,
    mark: Mark,
    ends: FloatArray,
    element_class: ElementClass,
    likeness: float,
    margin: float,
) -> Proposed:
    raw = Mark(
        pixel(ends[0]),
        pixel(ends[1]) if len(ends) == 2 else None,
        mark.anchor_known,
        mark.end_known,
    )
    snapped = snap(there, raw, element_class, 2.0)
    logit = -6.0 + 8.0 * likeness + 6.0 * min(margin, 0.3) + (1.0 if snapped else -1.0)
    return Proposed(snapped.mark if snapped else raw, float(1.0 / (1.0 + np.exp(-logit))))
