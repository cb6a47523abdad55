"""Regions to elements: to a fraction of a pixel, with ends, shapes and sigmas that are true."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from drawn_shapes import METAL, OUTLINES, background, drawn, pole_polygon
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.detection.detector import MeasureRegion, by_edges, measure
from semviz_core.detection.regions import Region
from semviz_core.research.paper.method import measure_as_in_paper
from semviz_core.simulation.detector import rendered_truth
from semviz_core.simulation.street import Street
from semviz_core.subpixel.sampling import SampledImage


def pole_region(ends: FloatArray, width_px: float = 4.0, score: float = 0.9) -> Region:
    half = np.array([width_px / 2.0, 0.0])
    low, high = ends.min(axis=0) - half, ends.max(axis=0) + half
    return Region(POLE, score, np.concatenate([low, high]), ends_px=ends)


def sign_region(middle: FloatArray, half: FloatArray, class_id: int | None) -> Region:
    return Region(class_id, 0.8, np.concatenate([middle - half, middle + half]))


def line_off(found: Elements2D, ends: FloatArray) -> tuple[float, float]:
    """How far a single pole is off across at its ends (px), and its angle (degrees)."""
    step = ends[1] - ends[0]
    along = step / np.linalg.norm(step)
    normal = np.array([along[1], -along[0]])
    seen = np.stack([found.anchor_px[0], found.end_px[0]])
    course = seen[1] - seen[0]
    angle = np.rad2deg(np.arctan2(course @ normal, course @ along))
    return float(np.abs((seen - ends[0]) @ normal).max()), float(abs(angle))


poles = st.tuples(
    st.integers(0, 10_000),
    st.floats(60.0, 140.0),
    st.floats(20.0, 40.0),
    st.floats(60.0, 100.0),
    st.floats(-8.0, 8.0),
    st.floats(2.5, 10.0),
)


def planted_pole(
    values: tuple[int, float, float, float, float, float],
) -> tuple[ByteImage, FloatArray, Region]:
    seed, x, y, length, tilt, width = values
    rng = np.random.default_rng(seed)
    ends = np.array([[x, y], [x + tilt, y + length]])
    image = drawn(background(rng), pole_polygon(ends, width), METAL)
    return image, ends, pole_region(ends + rng.uniform(-1.5, 1.5, (2, 2)), width)


@given(poles)
@settings(max_examples=40, deadline=None)
def test_a_pole_is_measured_to_a_fraction_of_a_pixel_or_its_sigma_says_so(values):
    image, ends, region = planted_pole(values)
    found = measure(SampledImage(image), [replace(region, ends_known=(True, True))])
    across, angle = line_off(found, ends)
    honest_px = max(0.3, 3.0 * found.sigma_px[0, 0])
    assert across < honest_px
    assert angle < max(0.3, np.rad2deg(2.0 * honest_px / 60.0))
    assert found.anchor_known.all()
    assert found.end_known.all()
    assert found.score[0] == region.score


def test_of_many_poles_nearly_all_are_measured_to_a_fraction_of_a_pixel():
    rng = np.random.default_rng(0)
    offs = []
    for seed in range(60):
        low, high = np.array([[60, 20, 60, -8, 2.5], [140, 40, 100, 8, 10]])
        image, ends, region = planted_pole((seed, *rng.uniform(low, high)))
        found = measure(SampledImage(image), [region])
        slid = np.stack([found.anchor_px[0], found.end_px[0]]) - ends
        offs.append([*line_off(found, ends), *np.linalg.norm(slid, axis=1)])
    across, angle, peak, bottom = np.array(offs).T
    assert np.mean((across < 0.3) & (angle < 0.3)) > 0.95
    assert np.mean(np.maximum(peak, bottom) < 1.5) > 0.9


@given(poles)
@settings(max_examples=15, deadline=None)
def test_a_mirrored_image_has_mirrored_elements(values):
    image, _, region = planted_pole(values)
    last = image.shape[1] - 1
    assert region.ends_px is not None
    left, top, right, bottom = region.box_px
    mirrored = replace(
        region,
        box_px=np.array([last - right, top, last - left, bottom]),
        ends_px=region.ends_px * [-1.0, 1.0] + [last, 0.0],
    )
    element = measure(SampledImage(image), [region])
    other = measure(SampledImage(np.ascontiguousarray(image[:, ::-1])), [mirrored])
    for here, there in ((element.anchor_px, other.anchor_px), (element.end_px, other.end_px)):
        np.testing.assert_allclose(there * [-1.0, 1.0] + [last, 0.0], here, atol=0.4)
    np.testing.assert_array_equal(element.end_known, other.end_known)


@given(poles, st.integers(0, 30), st.integers(0, 20))
@settings(max_examples=15, deadline=None)
def test_a_shifted_image_has_shifted_elements(values, right, down):
    image, _, region = planted_pole(values)
    assert region.ends_px is not None
    shift = np.array([right, down], dtype=np.float64)
    larger = cv2.copyMakeBorder(image, down, 5, right, 5, cv2.BORDER_REPLICATE)
    moved = replace(
        region, box_px=region.box_px + np.tile(shift, 2), ends_px=region.ends_px + shift
    )
    element = measure(SampledImage(image), [region])
    other = measure(SampledImage(np.asarray(larger, np.uint8)), [moved])
    np.testing.assert_allclose(other.anchor_px, element.anchor_px + shift, atol=0.05)
    np.testing.assert_allclose(other.end_px, element.end_px + shift, atol=0.05)


@given(
    st.integers(0, 10_000),
    st.sampled_from([TRIANGULAR, RECTANGULAR, ROUNDED]),
    st.floats(8.0, 22.0),
    st.booleans(),
)
@settings(max_examples=30, deadline=None)
def test_a_sign_s_middle_and_its_shape(seed, class_id, half, told):
    rng = np.random.default_rng(seed)
    middle = rng.uniform(60.0, 90.0, 2)
    image = drawn(background(rng), OUTLINES[class_id] * half + middle, (190, 30, 40))
    off = middle + rng.uniform(-2.0, 2.0, 2)
    size = half * rng.uniform(0.9, 1.15, 2)
    region = sign_region(off, size, class_id if told else None)
    found = measure(SampledImage(image), [region])
    assert found.class_id[0] == class_id
    assert np.linalg.norm(found.anchor_px[0] - middle) < 0.5
    assert found.sigma_px[0, 0] < 1.0
    assert not found.is_line[0]


def test_a_mask_alone_gives_axis_and_shape():
    rng = np.random.default_rng(3)
    ends = np.array([[80.3, 30.2], [83.1, 120.4]])
    image = drawn(background(rng), pole_polygon(ends, 5.0), METAL)
    middle, half = np.array([140.2, 60.7]), 14.0
    image = drawn(image, OUTLINES[TRIANGULAR] * half + middle, (190, 30, 40))
    regions = [
        _masked(pole_polygon(ends, 8.0), POLE, image.shape),
        _masked(OUTLINES[TRIANGULAR] * 15.0 + middle, None, image.shape),
    ]
    found = measure(SampledImage(image), regions)
    across, angle = line_off(found[found.is_line], ends)
    assert across < 0.3
    assert angle < 0.3
    assert found.class_id[~found.is_line].tolist() == [TRIANGULAR]
    assert np.linalg.norm(found.anchor_px[~found.is_line] - middle) < 0.5


def _masked(polygon: FloatArray, class_id: int | None, shape: tuple[int, ...]) -> Region:
    """A region by its mask, coarse as networks' are."""
    mask = np.zeros(shape[:2], np.uint8)
    cv2.fillPoly(mask, [np.round(polygon).astype(np.int32)], 1)
    rows, columns = np.nonzero(mask)
    box = np.array([columns.min(), rows.min(), columns.max(), rows.max()], np.float64)
    return Region(class_id, 0.9, box, mask > 0)


def test_a_pole_that_the_image_cuts_ends_on_its_border():
    rng = np.random.default_rng(0)
    ends = np.array([[80.0, -30.0], [84.0, 130.0]])
    image = drawn(background(rng), pole_polygon(ends, 5.0), METAL)
    seen = np.array([[80.6, 1.2], [84.0, 129.0]])
    region = replace(pole_region(seen, 5.0), ends_known=(True, True))
    found = measure(SampledImage(image), [region])
    assert found.anchor_known.tolist() == [False]
    assert found.end_known.tolist() == [True]
    assert found.anchor_px[0, 1] == pytest.approx(-0.5)
    assert line_off(found, ends)[0] < 0.3


def test_an_end_that_the_model_calls_hidden_is_not_known():
    image, _, region = planted_pole((0, 100.0, 30.0, 80.0, 2.0, 5.0))
    for told in ((True, False), (False, True)):
        found = measure(SampledImage(image), [replace(region, ends_known=told)])
        assert (bool(found.anchor_known[0]), bool(found.end_known[0])) == told


def test_a_sign_on_a_pole_s_peak_does_not_shorten_it():
    rng = np.random.default_rng(1)
    ends = np.array([[100.0, 30.0], [100.0, 120.0]])
    image = drawn(background(rng), pole_polygon(ends, 4.0), METAL)
    middle = np.array([100.0, 42.0])
    image = drawn(image, OUTLINES[RECTANGULAR] * 10.0 + middle, (30, 60, 170))
    below = np.array([[100.4, 52.5], [100.2, 119.0]])
    sign = sign_region(middle, np.array([10.0, 10.0]), RECTANGULAR)
    found = measure(SampledImage(image), [pole_region(below), sign])
    pole = found[found.is_line]
    assert np.linalg.norm(pole.anchor_px[0] - ends[0]) < 3.0
    alone = measure(SampledImage(image), [pole_region(below)])
    assert alone.anchor_px[0, 1] > 45.0


def test_the_same_element_twice_counts_once_and_the_best_comes_first():
    image, _, region = planted_pole((5, 60.0, 30.0, 80.0, 2.0, 5.0))
    again = replace(region, score=0.95, box_px=region.box_px + 0.7)
    elsewhere = replace(pole_region(np.array([[150.0, 30.0], [150.0, 100.0]])), score=0.3)
    sign = replace(sign_region(np.array([120.0, 60.0]), np.array([8.0, 8.0]), ROUNDED), score=0.5)
    twin = replace(sign, score=0.4, box_px=sign.box_px + 0.5)
    for way in (by_edges, measure_as_in_paper):
        found = measure(SampledImage(image), [elsewhere, twin, region, sign, again], way)
        assert found.score.tolist() == sorted(found.score, reverse=True)
        assert found.score[0] == 0.95
        assert 0.9 not in found.score
        assert 0.4 not in found.score


def test_two_poles_side_by_side_are_two():
    rng = np.random.default_rng(2)
    image = background(rng)
    regions = []
    for x in (80.0, 92.0):
        ends = np.array([[x, 30.0], [x, 110.0]])
        image = drawn(image, pole_polygon(ends, 4.0), METAL)
        regions.append(pole_region(ends + 0.5))
    assert len(measure(SampledImage(image), regions)) == 2


NASTY = {
    "empty mask": Region(POLE, 0.5, np.array([10.0, 10, 20, 60]), np.zeros((5, 5), bool), (10, 10)),
    "mask of one pixel": Region(POLE, 0.5, np.array([9.0, 9, 9, 9]), np.ones((1, 1), bool), (9, 9)),
    "sign of one pixel": Region(None, 0.5, np.array([9.0, 9, 9, 9]), np.ones((1, 1), bool), (9, 9)),
    "box of no size": Region(ROUNDED, 0.5, np.array([9.0, 9, 9, 9])),
    "pole of no size": Region(POLE, 0.5, np.array([9.0, 9, 9, 9])),
    "ends in one place": Region(POLE, 0.5, np.array([5.0, 5, 9, 9]), ends_px=np.full((2, 2), 7.0)),
    "upside down": Region(
        POLE, 0.5, np.array([5.0, 5, 9, 40]), ends_px=np.array([[7.0, 40], [7, 5]])
    ),
    "level": Region(POLE, 0.5, np.array([5.0, 5, 50, 9]), ends_px=np.array([[5.0, 7], [50, 7]])),
    "outside": Region(POLE, 0.5, np.array([900.0, 10, 910, 60])),
    "sign outside": Region(RECTANGULAR, 0.5, np.array([-90.0, -90, -80, -80])),
    "partly outside": Region(POLE, 0.5, np.array([-5.0, -50, 5, 600])),
    "mask far from its box": Region(
        POLE, 0.5, np.array([5.0, 5, 9, 40]), np.ones((9, 3), bool), (600, 600)
    ),
    "larger than the image": Region(TRIANGULAR, 0.5, np.array([-400.0, -400, 900, 900])),
    "tiny sign": Region(None, 0.5, np.array([10.0, 10, 11, 11])),
    "other class": Region(7, 0.5, np.array([10.0, 10, 30, 30])),
}


@pytest.mark.parametrize("way", [by_edges, measure_as_in_paper])
@pytest.mark.parametrize("name", NASTY)
@pytest.mark.parametrize("size", [(1, 1), (3, 40), (64, 64)])
def test_whatever_a_model_says_it_is_elements_or_nothing(name, way, size):
    for image in (np.full((*size, 3), 255, np.uint8), background(np.random.default_rng(0), *size)):
        found = measure(SampledImage(image), [NASTY[name]], way)
        assert len(found) <= 1  # Elements2D itself refuses NaN and sigmas out of range
        again = measure(SampledImage(image), [NASTY[name]], way)
        np.testing.assert_array_equal(found.anchor_px, again.anchor_px)
        if len(found) and found.is_line[0]:
            height, width = image.shape[:2]
            ends = np.stack([found.anchor_px[0], found.end_px[0]])
            assert (ends >= -0.51).all() or way is measure_as_in_paper
            assert (ends <= [width - 0.49, height - 0.49]).all() or way is measure_as_in_paper


def test_what_has_no_extent_or_is_not_in_the_image_is_nothing():
    picture = SampledImage(background(np.random.default_rng(0)))
    for way in (by_edges, measure_as_in_paper):
        for name in ("box of no size", "outside", "sign outside", "pole of no size"):
            assert len(measure(picture, [NASTY[name]], way)) == 0, name
        assert len(measure(picture, [], way)) == 0


def test_the_paper_s_way_finds_the_same_coarsely():
    image, ends, region = planted_pole((8, 100.0, 30.0, 90.0, 3.0, 6.0))
    region = replace(region, ends_px=None, ends_known=(True, False))
    found = measure(SampledImage(image), [region], measure_as_in_paper)
    assert line_off(found, ends)[0] < 3.0
    assert (bool(found.anchor_known[0]), bool(found.end_known[0])) == (True, False)
    middle = np.array([60.4, 70.2])
    image = drawn(image, OUTLINES[ROUNDED] * 12.0 + middle, (190, 30, 40))
    sign = sign_region(middle + 1.0, np.array([12.0, 12.0]), ROUNDED)
    of_sign = measure(SampledImage(image), [sign], measure_as_in_paper)
    assert np.linalg.norm(of_sign.anchor_px[0] - middle) < 2.0


# -- rendered streets


@cache
def street_regions() -> list[tuple[SampledImage, Region, Elements2D]]:
    """Regions that are off by 0.8 px, and what each truly is."""
    street = Street(20_970, triangle_center="box")
    found = []
    for index in (5, 20, 35, 50):
        rng = np.random.default_rng(index)
        truth = rendered_truth(street, index, "left")
        picture = SampledImage(street.image(index, "left"))
        for row, region in enumerate(truth.regions):
            found.append((picture, _shaken(region, rng), truth.elements[[row]]))
    return found


@cache
def street_errors(way: MeasureRegion) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Sigmas and errors across, of poles and signs; angles in degrees, of poles that are not
    far; whether flags are right."""
    said, off, angles, flags = [], [], [], []
    for picture, region, true in street_regions():
        found = measure(picture, [region], way)
        if not len(found):
            continue
        said.append(found.sigma_px[0, 0])
        if region.class_id == POLE:
            across, angle = line_off(found, np.stack([true.anchor_px[0], true.end_px[0]]))
            off.append(across)
            if np.linalg.norm(true.end_px - true.anchor_px) > 30.0:
                angles.append(angle)
            flags.append(found.anchor_known[0] == true.anchor_known[0])
            flags.append(found.end_known[0] == true.end_known[0])
        else:
            off.append(float(np.abs(found.anchor_px[0] - true.anchor_px[0]).max()))
    return np.array(said), np.array(off), np.array(angles), np.array(flags)


def _shaken(region: Region, rng: np.random.Generator) -> Region:
    off = rng.normal(0.0, 0.8, 4)
    box = np.sort((region.box_px + off).reshape(2, 2), axis=0).reshape(4)
    ends = None if region.ends_px is None else region.ends_px + rng.normal(0.0, 0.8, (2, 2))
    return replace(region, box_px=box, ends_px=ends, mask=None, corner_px=(0, 0))


def honest(said: FloatArray, off: FloatArray) -> bool:
    """Whether errors are about as large as said, in each third by what is said."""
    parts = np.array_split(np.argsort(said, kind="stable"), 3)
    clipped = np.clip(off, -6.0, 6.0)
    ratios = [np.sqrt((clipped[part] ** 2).mean() / (said[part] ** 2).mean()) for part in parts]
    return all(0.4 < ratio < 2.5 for ratio in ratios)


def test_sigmas_are_honest_on_streets():
    said, off, angles, _ = street_errors(by_edges)
    assert len(said) > 45
    assert honest(said, off)
    assert not honest(said / 4.0, off), "a sigma that boasts is seen"
    order = np.argsort(said, kind="stable")
    least, most = (np.abs(off[value]).mean() for value in (order[:20], order[-20:]))
    assert most > 1.5 * least, "what is said to be worse is worse"
    assert np.mean(angles < 0.5) > 0.75


def test_edges_are_exacter_than_the_paper_s_way():
    ours, theirs = (
        np.median(np.abs(street_errors(way)[1])) for way in (by_edges, measure_as_in_paper)
    )
    assert ours < 0.5 * theirs


def test_hidden_ends_are_flagged_on_streets():
    flags = street_errors(by_edges)[3]
    assert flags.mean() > 0.9
