"""Rules about elements and the images in which they are labelled."""

from collections.abc import Iterator

import numpy as np

from semviz_annotation.mapping.quality.labelled import Labelled
from semviz_annotation.mapping.quality.linting.case import Case
from semviz_annotation.mapping.quality.linting.finding import Finding
from semviz_annotation.view import rig_view
from semviz_core.arrays import FloatArray
from semviz_core.camera import MIN_DEPTH_M
from semviz_core.frame import Frame

ASIDE_RAD = float(np.deg2rad(1.5))
"""Labelled and mapped so far to the two sides of where the camera looks, it is on another side."""
NARROW_DEG = 1.0
"""At this angle 1 px of a 720 px lens is a twelfth of the depth."""
DEPTHS_M = (3.0, 50.0)
"""Nearer things are half out of the image, further ones small: nobody must label them."""
FURTHER = 1.2
"""A frame from which an element is so much further away than where it is labelled shows it."""
BORDER_PX = 20.0
"""An element must be well inside an image to be missed there."""


def behind_the_camera(case: Case) -> Iterator[Finding]:
    """An element that is labelled in an image whose camera has it behind."""
    if case.labelled is None:
        return
    views, sightings, _ = case.labelled
    depth = views.depth_m(sightings.view, case.semantic_map.elements.anchor_m[sightings.thing])
    behind = depth < MIN_DEPTH_M
    for row in np.unique(sightings.thing[behind]).tolist():
        mine = np.flatnonzero(behind & (sightings.thing == row))
        frames = np.unique(views.frame_index[sightings.view[mine]])
        yield case.finding(
            "behind the camera",
            "error",
            (row,),
            f"{case.name(row)} is {-depth[mine].min():.1f} m behind the camera of frame "
            f"{frames[0]}, where it is labelled{_and_more(len(frames))}",
            int(frames[0]),
        )


def wrong_side(case: Case) -> Iterator[Finding]:
    """An element that is labelled left of where a camera looks and mapped right of it, or so."""
    if case.labelled is None:
        return
    views, sightings, _ = case.labelled
    labelled = _azimuth_rad(case.labelled, views.rays(sightings.view, sightings.anchor_px))
    anchor = case.semantic_map.elements.anchor_m[sightings.thing]
    mapped = _azimuth_rad(case.labelled, anchor - views.center_m[sightings.view])
    flipped = (labelled * mapped < 0.0) & (np.minimum(abs(labelled), abs(mapped)) > ASIDE_RAD)
    for row in np.unique(sightings.thing[flipped]).tolist():
        mine = np.flatnonzero(flipped & (sightings.thing == row))
        frames = views.frame_index[sightings.view[mine]]
        said, is_at = ("left", "right") if labelled[mine[0]] < 0.0 else ("right", "left")
        yield case.finding(
            "wrong side of the road",
            "error",
            (row,),
            f"{case.name(row)} is labelled {np.rad2deg(abs(labelled[mine[0]])):.1f} deg {said} of "
            f"straight ahead in frame {frames[0]}, but the map has it "
            f"{np.rad2deg(abs(mapped[mine[0]])):.1f} deg {is_at}"
            f"{_and_more(len(np.unique(frames)))}",
            int(frames[0]),
        )


def _azimuth_rad(labelled: Labelled, directions: FloatArray) -> FloatArray:
    """(k,) to the right of where the sightings' cameras look, of directions (k, 3) in the map."""
    R = labelled.views.R[labelled.sightings.view]
    x, _, z = np.einsum("kij,kj->ik", R, directions)
    return np.asarray(np.arctan2(x, z))


def _and_more(frames: int) -> str:
    return f" (and {frames - 1} more frames)" if frames > 1 else ""


def narrow_rays(case: Case) -> Iterator[Finding]:
    """An element that was seen from nearly one direction: its depth is hardly known."""
    if case.labelled is None:
        return
    views, sightings, _ = case.labelled
    elements, is_line = case.semantic_map.elements, case.semantic_map.elements.is_line
    for row in np.flatnonzero(sightings.seen > 1).tolist():
        away = elements.anchor_m[row] - views.center_m[case.views_of(row)]
        if is_line[row]:  # only the angle across the line counts
            axis = elements.end_m[row] - elements.anchor_m[row]
            away = away - np.outer(away @ axis, axis) / max(axis @ axis, 1e-12)
        away = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        angle = np.rad2deg(2.0 * np.arcsin(min(1.0, _widest(away) / 2.0)))
        if angle < NARROW_DEG:
            sigma = np.sqrt(np.linalg.eigvalsh(elements.covariance_m2[row, :3, :3])[-1])
            yield case.finding(
                "ray angle too small",
                "warning",
                (row,),
                f"{case.name(row)} was seen from directions only {angle:.2f} deg apart "
                f"(its place is good to {sigma:.1f} m): label it in nearer frames",
            )


def _widest(directions: FloatArray) -> float:
    """Largest distance between two unit vectors (k, 3), to a few per cent.

    From the furthest to the furthest from it: views lie nearly on a line.
    """
    first = np.linalg.norm(directions - directions[0], axis=1).argmax()
    return float(np.linalg.norm(directions - directions[first], axis=1).max())


def never_seen_again(case: Case) -> Iterator[Finding]:
    """An element labelled in one frame, while a frame before or after it should show it too."""
    if case.labelled is None:
        return
    views, sightings, _ = case.labelled
    posed = {one.index: one for one in case.source.frames if one.T_map_camera is not None}
    visited = sorted({*case.labels.frames, *case.labels.reviews} & posed.keys())
    place_of = {index: place for place, index in enumerate(visited)}
    for row in np.flatnonzero(sightings.seen > 0).tolist():
        frames = np.unique(views.frame_index[case.views_of(row)])
        if len(frames) > 1:
            continue
        place = place_of[int(frames[0])]
        beside = (*visited[max(place - 1, 0) : place], *visited[place + 1 : place + 2])
        here = posed[int(frames[0])]
        missing = [index for index in beside if _shows(case, row, posed[index], here)]
        if missing:
            yield case.finding(
                "never seen again",
                "warning",
                (row,),
                f"{case.name(row)} is labelled in frame {frames[0]} alone, though frame "
                f"{' and '.join(map(str, missing))} should show it",
                int(frames[0]),
            )


def _shows(case: Case, row: int, frame: Frame, where_labelled: Frame) -> bool:
    """Whether the left image of a frame should show the element, and nobody said it does not."""
    if _dismissed(case, row, frame.index):
        return False
    point = case.semantic_map.elements.anchor_m[row][None]
    assert frame.T_map_camera is not None
    assert where_labelled.T_map_camera is not None
    view = rig_view(case.source.rig, "left", frame.T_map_camera.inverse())
    labelled = rig_view(case.source.rig, "left", where_labelled.T_map_camera.inverse())
    depth = float(view.depth_m(point)[0])
    nearest, furthest = DEPTHS_M
    if not nearest < depth < min(furthest, FURTHER * float(labelled.depth_m(point)[0])):
        return False
    u, v = view.project(point)[0]
    return bool(
        BORDER_PX < u < view.camera.width - BORDER_PX
        and BORDER_PX < v < view.camera.height - BORDER_PX
    )


def _dismissed(case: Case, row: int, frame_index: int) -> bool:
    """Whether a person said that the element is hidden in a frame, or not there."""
    return any(
        one.frame_index == frame_index
        for label_id in case.semantic_map.provenance[row].label_ids
        for one in case.labels.dismissed_of(label_id)
    )
