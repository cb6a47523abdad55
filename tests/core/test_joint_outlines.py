"""One outline in several images: planted plates before clutter that differs in each."""

import cv2
import numpy as np
import pytest

from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street
from semviz_core.subpixel.joint_outlines import OutlineView, edge_profile, joint_outlines
from semviz_core.subpixel.sampling import SampledImage

SCALES = (1.0, 1.2, 1.5, 1.9)


def plate(rng: np.random.Generator, half: FloatArray, center: FloatArray) -> ByteImage:
    """A dark plate before clutter that is different in each image."""
    size, fine = 160, 4
    picture = np.full((size * fine, size * fine, 3), 150, np.uint8)
    for _ in range(40):
        low = rng.uniform(-20, size, 2)
        box(picture, low, low + rng.uniform(4, 50, 2), tuple(rng.integers(110, 220, 3).tolist()))
    box(picture, center - half, center + half, (50, 60, 70))
    inner = half * [0.7, 0.5]
    box(picture, center + half * 0.05 - inner, center + half * 0.05 + inner, (80, 95, 100))
    return cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA)


def box(picture: ByteImage, low: FloatArray, high: FloatArray, color: tuple[int, ...]) -> None:
    """Fill a box with corners in pixels of the image before enlargement by 4."""
    first, last = (np.round((point + 0.5) * 4 * 16 - 8).astype(int) for point in (low, high))
    cv2.rectangle(picture, tuple(first.tolist()), tuple(last.tolist()), color, -1, cv2.LINE_AA, 4)


def views(seed: int, off: FloatArray, half: FloatArray) -> tuple[list[OutlineView], FloatArray]:
    rng = np.random.default_rng(seed)
    result = []
    for scale in SCALES:
        center = rng.uniform(70, 90, 2)
        image = SampledImage(plate(rng, half * scale, center))
        mark = center + off * scale
        profile = edge_profile(image, mark, "square")
        result.append(OutlineView(image, profile, mark, scale, 1.5 * scale))
    return result, -off


@pytest.mark.parametrize("half", [(9.0, 12.0), (22.0, 6.0)])
@pytest.mark.parametrize("off", [(0.0, 0.0), (1.3, -0.8)])
def test_all_views_tell_the_middle_from_which_all_marks_are_off(half, off) -> None:
    for seed in range(3):
        seen, true_move = views(seed, np.array(off), np.array(half))
        best = joint_outlines(seen, "square", "centroid")[0]
        assert np.linalg.norm(best.move - true_move) < 0.35
        assert best.half_px == pytest.approx(np.array(half), abs=0.8)
        assert best.spread_px < 0.5
        assert best.edges > 1.0


def test_without_a_plate_no_outline_is_clear() -> None:
    rng = np.random.default_rng(3)
    seen = []
    for scale in SCALES:
        noise = rng.integers(90, 170, (160, 160, 3)).astype(np.uint8)
        image = SampledImage(cv2.GaussianBlur(noise, (0, 0), 2.0))
        mark = np.array([80.0, 80.0])
        seen.append(OutlineView(image, edge_profile(image, mark, "square"), mark, scale, 2.0))
    assert joint_outlines(seen, "square", "centroid")[0].edges < 0.8


def triangle_views(seed: int) -> list[OutlineView]:
    """Views of an upright triangle, marked at its centroid by a careful hand."""
    rng = np.random.default_rng(seed)
    result = []
    for scale in SCALES:
        half, center = 14.0 * scale, rng.uniform(70, 90, 2)
        picture = plate(rng, np.zeros(2), np.array([-50.0, -50.0]))
        corners = center + half * np.array([(0.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
        fine = np.round(np.kron(picture, np.ones((4, 4, 1)))).astype(np.uint8)
        points = np.round((corners + 0.5) * 64 - 8).astype(np.int32)
        cv2.fillConvexPoly(fine, points, (50, 60, 70), cv2.LINE_AA, 4)
        image = SampledImage(cv2.resize(fine, (160, 160), interpolation=cv2.INTER_AREA))
        mark = corners.mean(axis=0)
        profile = edge_profile(image, mark, "triangle")
        result.append(OutlineView(image, profile, mark, scale, 0.6))
    return result


def test_a_triangle_marked_at_its_centroid_is_not_far_from_its_mark() -> None:
    """The middle of its box is, so an outline there must not count as one of something else."""
    for seed in range(3):
        best = joint_outlines(triangle_views(seed), "triangle", "centroid")[0]
        assert np.linalg.norm(best.move) < 0.35
        assert best.edges > 1.0


def test_a_pole_above_its_peak_does_not_stretch_a_triangle() -> None:
    """A sign of a street before leaves: its pole's edges go on in those of an outline that is too
    tall, which were longer than those of outlines with other ratios than a triangle has."""
    street = Street(1014, StreetOptions(signs="worn"))
    sign = street.truth_map.elements[street.truth_map.elements.id == 23]
    rng, seen, true_px = np.random.default_rng(0), list[OutlineView](), list[FloatArray]()
    for number in (35, 33, 31):
        labels, ids = street.labels(number, "left")
        pose = street.frames[number].T_map_camera
        assert pose is not None
        true_px.append(labels.anchor_px[ids == 23][0])
        mark = true_px[-1] + rng.normal(0.0, 1.0, 2)
        image = SampledImage(street.image(number, "left"))
        scale = 1.0 / float(pose.inverse().apply(sign.anchor_m)[0, 2])
        profile = edge_profile(image, mark, "triangle")
        seen.append(OutlineView(image, profile, mark, scale, 1.5))
    best = joint_outlines(seen, "triangle", "centroid")[0]
    for view, true, move in zip(seen, true_px, best.moves, strict=True):
        off_px = view.middle_px + move * view.scale / seen[0].scale - true
        assert np.linalg.norm(off_px) < 1.0
