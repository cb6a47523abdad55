"""Measuring in compiled code gives what its plain definition gives."""

import cv2
import numpy as np
from drawn_shapes import METAL, background, drawn, pole_polygon
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_core.detection.model_config import IGNORED, SIGN, ModelClasses
from semviz_core.detection.postprocessing import segmentation_maps, softmax
from semviz_core.subpixel import pole_axis, sign_outline
from semviz_core.subpixel.pole_axis import across, edge_votes, find_axes, shift_line
from semviz_core.subpixel.pole_ends import end_by_rows, grown_end
from semviz_core.subpixel.pole_fit import refine_axis
from semviz_core.subpixel.sampling import SampledImage
from semviz_core.subpixel.sign_outline import WEIGHTS, Outline, fit_outlines


@given(st.integers(0, 10_000), st.integers(1, 30), st.integers(1, 40))
@settings(max_examples=30, deadline=None)
def test_colours_between_pixels_are_bilinear_and_the_border_is_extended(seed, height, width):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    u, v = rng.uniform(-3.0, width + 3.0, (8, 5)), rng.uniform(-3.0, height + 3.0, (8, 5))
    flags = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    wanted = cv2.remap(
        image.astype(np.float32), u.astype(np.float32), v.astype(np.float32), **flags
    )
    found = SampledImage(image).sample(np.stack([u, v], axis=-1))
    np.testing.assert_allclose(found, wanted, atol=0.01)


def test_a_point_that_is_no_number_has_a_colour_of_the_image() -> None:
    image = SampledImage(np.full((4, 5, 3), 7, np.uint8))
    assert (image.sample(np.array([[[np.nan, 1.0], [np.inf, -np.inf]]])) == 7.0).all()


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_edge_votes_are_those_of_smoothed_slopes_above_their_surroundings(seed):
    strip = np.random.default_rng(seed).uniform(0.0, 255.0, (3, 24, 3)).astype(np.float32)
    slope = np.zeros(strip.shape)
    inner = strip[:, 4:] + 2.0 * strip[:, 3:-1] - 2.0 * strip[:, 1:-3] - strip[:, :-4]
    slope[:, 2:-2] = inner / 4.0
    size = np.sqrt((slope**2).mean(axis=2))
    least = [
        [max(row[max(k - 5, 0) : k + 1].min(), row[k : k + 6].min()) for k in range(24)]
        for row in size
    ]
    square = (size - least) ** 2
    np.testing.assert_allclose(edge_votes(strip), square / (square + 36.0), atol=1e-4)


def test_candidates_differ_and_the_best_is_refined_to_the_drawn_pole() -> None:
    ends = np.array([[90.3, 30.0], [93.1, 120.0]])
    image = drawn(background(np.random.default_rng(1)), pole_polygon(ends, 5.0), METAL)
    axes = find_axes(SampledImage(image), shift_line(ends, 1.2, 1.2), 4.0, 3, 14.0)
    assert [axis.score for axis in axes] == sorted((axis.score for axis in axes), reverse=True)
    for first, second in ((0, 1), (0, 2), (1, 2)):
        apart = np.abs(axes[first].ends_px - axes[second].ends_px).max()
        assert apart >= 1.2 or abs(axes[first].width_px - axes[second].width_px) >= 1.2
    off = (refine_axis(SampledImage(image), axes[0]).ends_px - ends) @ across(ends)
    assert np.abs(off).max() < 0.1


def test_a_pole_that_ends_far_beyond_its_mask_is_followed_to_there_and_no_further() -> None:
    ends = np.array([[80.0, 15.0], [80.0, 150.0]])
    image = drawn(background(np.random.default_rng(3)), pole_polygon(ends, 6.0), METAL)
    middle = np.array([80.0, 120.0])
    grown = grown_end(SampledImage(image), ends[1], middle, 6.0, 0.0)
    assert abs(grown.off_px - 105.0) < 3.0
    rows = end_by_rows(SampledImage(image), ends[1], ends[0] + [0.0, 4.0], 6.0, 4.0)
    assert rows is not None
    assert abs(rows.off_px - 4.0) < 2.0


@given(st.integers(0, 10_000), st.integers(1, 30))
@settings(max_examples=10, deadline=None)
def test_a_class_map_in_blocks_of_rows_is_that_of_the_whole(seed, height):
    classes = ModelClasses(np.array([IGNORED, 1, SIGN, IGNORED]), frozenset({1}))
    logits = np.random.default_rng(seed).normal(0.0, 4.0, (1, 4, height, 9)).astype(np.float32)
    odds = softmax(logits[0], 0)
    maps = segmentation_maps(logits, classes)
    for row, target in enumerate(classes.wanted):
        np.testing.assert_array_equal(maps[row], odds[classes.target == target].sum(axis=0))
    np.testing.assert_array_equal(maps[-1], np.maximum(odds[0], odds[3]))


def test_an_outline_so_thin_that_its_fit_is_singular_still_has_a_start_outside(monkeypatch) -> None:
    monkeypatch.setattr(sign_outline, "_border_px", lambda *_: 2.0)
    middle, half = np.array([30.0, 30.0]), np.array([2.0, 1e200])
    thin = Outline("diamond", middle, half, np.zeros(len(WEIGHTS)), 0.0)
    (start,) = sign_outline._outside_borders(SampledImage(np.zeros((60, 60, 3), np.uint8)), [thin])
    assert np.isfinite(start.middle_px).all()
    assert np.isfinite(start.half_px).all()
    assert start.half_px[0] > half[0]


def test_images_of_any_layout_share_compiled_code() -> None:
    plain = background(np.random.default_rng(5))
    frozen = plain.copy()
    frozen.flags.writeable = False
    ends, middle, half = np.array([[50.0, 20.0], [52.0, 90.0]]), np.full(2, 50.0), np.full(2, 9.0)

    def measured(image):
        axis = find_axes(SampledImage(image), ends, 3.0, 1, 12.0)[0]
        (*_, outline) = fit_outlines(SampledImage(image), middle, half, ["circle"])
        return np.concatenate([axis.ends_px.ravel(), axis.evidence, outline.evidence])

    def signatures():
        return len(pole_axis.straighten.signatures), len(sign_outline._fitted.signatures)

    expected, before = measured(plain), signatures()
    for image in (frozen, np.asfortranarray(plain), plain[..., ::-1][..., ::-1]):
        np.testing.assert_array_equal(measured(image), expected)
    assert signatures() == before
