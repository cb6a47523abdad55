"""Lint of a map: elements that cannot be right, or need a check.

A rule names the elements, describes the anomaly in one sentence with numbers, and names the frame
that shows it. Most rules need no labels, so imported maps can be checked too. Findings are sorted
by severity, then rule by rule. Rules about images and labels are defined here.
"""

from collections.abc import Iterator

import numpy as np

from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.quality import lint_rules
from semviz_annotation.mapping.quality.label_links import LabelAssociation, check_frame
from semviz_annotation.mapping.quality.lint_context import (
    SEVERITIES,
    Finding,
    LintContext,
    Rule,
    Severity,
)
from semviz_core.base.camera import MIN_DEPTH_M
from semviz_core.base.frame import Dataset, Frame
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray, unit_vectors

__all__ = [
    "RULES",
    "SEVERITIES",
    "Finding",
    "Severity",
    "lint",
]

ASIDE_RAD = float(np.deg2rad(1.5))
"""Label and map element are on different sides if both are farther from the optical axis."""
NARROW_DEG = 1.0
"""At this angle 1 px of a 720 px lens is a twelfth of the depth."""
DEPTHS_M = (3.0, 50.0)
"""Nearer elements are half out of the image, farther ones small: they need no label."""
FURTHER = 1.2
"""A frame shows an element up to this factor farther away than where it is labelled."""
BORDER_PX = 20.0
"""Margin of the image in which a missing label is no finding."""


def behind_the_camera(context: LintContext) -> Iterator[Finding]:
    """Find elements that are behind the camera of an image in which they are labelled."""
    if context.labelled is None:
        return
    views, observations, _ = context.labelled
    depth = views.depth_m(
        observations.view, context.semantic_map.elements.anchor_m[observations.landmark]
    )
    behind = depth < MIN_DEPTH_M
    for row in np.unique(observations.landmark[behind]).tolist():
        rows = np.flatnonzero(behind & (observations.landmark == row))
        frames = np.unique(views.frame_index[observations.view[rows]])
        yield context.finding(
            "behind the camera",
            "error",
            (row,),
            f"{context.name(row)} is {-depth[rows].min():.1f} m behind the camera of frame "
            f"{frames[0]}, where it is labelled{_and_more(len(frames))}",
            int(frames[0]),
        )


def wrong_side(context: LintContext) -> Iterator[Finding]:
    """Find elements that are labelled on one side of the optical axis and mapped on the other."""
    if context.labelled is None:
        return
    views, observations, _ = context.labelled
    labelled = _azimuth_rad(context.labelled, views.rays(observations.view, observations.anchor_px))
    anchor = context.semantic_map.elements.anchor_m[observations.landmark]
    mapped = _azimuth_rad(context.labelled, anchor - views.center_m[observations.view])
    flipped = (labelled * mapped < 0.0) & (np.minimum(abs(labelled), abs(mapped)) > ASIDE_RAD)
    for row in np.unique(observations.landmark[flipped]).tolist():
        rows = np.flatnonzero(flipped & (observations.landmark == row))
        frames = views.frame_index[observations.view[rows]]
        side, is_at = ("left", "right") if labelled[rows[0]] < 0.0 else ("right", "left")
        yield context.finding(
            "wrong side of the road",
            "error",
            (row,),
            f"{context.name(row)} is labelled {np.rad2deg(abs(labelled[rows[0]])):.1f} deg {side} "
            f"of straight ahead in frame {frames[0]}, but the map has it "
            f"{np.rad2deg(abs(mapped[rows[0]])):.1f} deg {is_at}"
            f"{_and_more(len(np.unique(frames)))}",
            int(frames[0]),
        )


def _azimuth_rad(labelled: LabelAssociation, directions: FloatArray) -> FloatArray:
    """Return angles (k,) of directions (k, 3) in the map to the right of the observing cameras."""
    R = labelled.views.R[labelled.observations.view]
    x, _, z = np.einsum("kij,kj->ik", R, directions)
    return np.asarray(np.arctan2(x, z))


def _and_more(frames: int) -> str:
    return f" (and {frames - 1} more frames)" if frames > 1 else ""


def narrow_rays(context: LintContext) -> Iterator[Finding]:
    """Find elements that were seen from nearly one direction, so that their depth is uncertain."""
    if context.labelled is None:
        return
    views, observations, _ = context.labelled
    elements, is_line = context.semantic_map.elements, context.semantic_map.elements.is_line
    for row in np.flatnonzero(observations.seen > 1).tolist():
        away = elements.anchor_m[row] - views.center_m[context.views_of(row)]
        if is_line[row]:  # only the angle across the line counts
            axis = elements.end_m[row] - elements.anchor_m[row]
            away = away - np.outer(away @ axis, axis) / max(axis @ axis, 1e-12)
        away = unit_vectors(away)
        angle = np.rad2deg(2.0 * np.arcsin(min(1.0, _widest(away) / 2.0)))
        if angle < NARROW_DEG:
            sigma = np.sqrt(np.linalg.eigvalsh(elements.covariance_m2[row, :3, :3])[-1])
            yield context.finding(
                "ray angle too small",
                "warning",
                (row,),
                f"{context.name(row)} was seen from directions only {angle:.2f} deg apart "
                f"(its place is good to {sigma:.1f} m): label it in nearer frames",
            )


def _widest(directions: FloatArray) -> float:
    """Return the approximate largest distance between two unit vectors (k, 3).

    From the farthest to the one farthest from it: views lie nearly on a line.
    """
    first = np.linalg.norm(directions - directions[0], axis=1).argmax()
    return float(np.linalg.norm(directions - directions[first], axis=1).max())


def never_seen_again(context: LintContext) -> Iterator[Finding]:
    """Find elements labelled in one frame only, though a neighbouring frame should show them."""
    if context.labelled is None:
        return
    views, observations, _ = context.labelled
    posed = {
        frame.index: frame for frame in context.source.frames if frame.T_map_camera is not None
    }
    visited = sorted({*context.labels.frames, *context.labels.reviews} & posed.keys())
    place_of = {index: place for place, index in enumerate(visited)}
    for row in np.flatnonzero(observations.seen > 0).tolist():
        frames = np.unique(views.frame_index[context.views_of(row)])
        if len(frames) > 1:
            continue
        place = place_of[int(frames[0])]
        beside = (*visited[max(place - 1, 0) : place], *visited[place + 1 : place + 2])
        labelled_frame = posed[int(frames[0])]
        missing = [index for index in beside if _shows(context, row, posed[index], labelled_frame)]
        if missing:
            yield context.finding(
                "never seen again",
                "warning",
                (row,),
                f"{context.name(row)} is labelled in frame {frames[0]} alone, though frame "
                f"{' and '.join(map(str, missing))} should show it",
                int(frames[0]),
            )


def _shows(context: LintContext, row: int, frame: Frame, where_labelled: Frame) -> bool:
    """Return whether the left image of a frame should show the element, and nobody dismissed it."""
    if _dismissed(context, row, frame.index):
        return False
    point = context.semantic_map.elements.anchor_m[row][None]
    assert frame.T_map_camera is not None
    assert where_labelled.T_map_camera is not None
    view = rig_view(context.source.rig, "left", frame.T_map_camera.inverse())
    labelled = rig_view(context.source.rig, "left", where_labelled.T_map_camera.inverse())
    depth = float(view.depth_m(point)[0])
    nearest, furthest = DEPTHS_M
    if not nearest < depth < min(furthest, FURTHER * float(labelled.depth_m(point)[0])):
        return False
    u, v = view.project(point)[0]
    return bool(
        BORDER_PX < u < view.camera.width - BORDER_PX
        and BORDER_PX < v < view.camera.height - BORDER_PX
    )


def _dismissed(context: LintContext, row: int, frame_index: int) -> bool:
    """Return whether a person stated that the element is hidden in a frame, or absent."""
    return any(
        dismissal.frame_index == frame_index
        for label_id in context.semantic_map.provenance[row].label_ids
        for dismissal in context.labels.dismissed_of(label_id)
    )


RULES: tuple[Rule, ...] = (
    lint_rules.leaning_pole,
    lint_rules.odd_length,
    lint_rules.off_the_ground,
    lint_rules.where_the_car_drove,
    behind_the_camera,
    wrong_side,
    narrow_rays,
    never_seen_again,
    lint_rules.class_conflict,
    lint_rules.duplicate_nearby,
    lint_rules.sign_without_post,
)


def lint(semantic_map: SemanticMap, labels: Labels, source: Dataset) -> tuple[Finding, ...]:
    """Return the findings of all rules, the worst first, then rule by rule.

    Raise SemvizError if the map is of another frame than the images.
    """
    check_frame(semantic_map, source)
    context = LintContext(semantic_map, labels, source)
    findings = [finding for rule in RULES for finding in rule(context)]
    return tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))
