"""What the pictures show is what the labels say, to a fraction of a pixel."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements3D
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.simulation.drawing import PinholeView
from semviz_core.simulation.furniture import objects_far_to_near, paint_object
from semviz_core.simulation.layout import Layout
from semviz_core.simulation.objects import UP, Car, Pole, Sign
from semviz_core.simulation.street import (
    Painter,
    Street,
    camera_axes,
    elements_in_view,
    paint_ranks,
)


@pytest.fixture(scope="module")
def street() -> Street:
    return Street(11)


def furniture(layout: Layout, view: PinholeView, ground: int = 128) -> ByteImage:
    """Cars, poles and signs alone, before a plain ground."""
    picture = np.full((view.camera.height, view.camera.width, 3), ground, np.uint8)
    for element in objects_far_to_near(layout, view):
        paint_object(picture, view, element, layout.sun, (206.0, 220.0, 232.0))
    return picture


def cover(layout: Layout, view: PinholeView) -> FloatArray:
    """(height, width) how much of each pixel is painted: it hides that much of the ground."""
    white, black = (furniture(layout, view, value).astype(float)[..., 1] for value in (255, 0))
    return np.asarray(1.0 - (white - black) / 255.0)


def empty(layout: Layout) -> Layout:
    return replace(layout, poles=(), signs=(), cars=(), trees=(), hedges=(), houses=())


def view_at(street: Street, roll_rad: float = 0.0) -> PinholeView:
    turn = Pose.from_rotvec([0.01, -0.02, roll_rad], [0.0, 0.0, 0.0])
    return PinholeView(street.rig.left, Pose(camera_axes(0.3), np.array([4.0, 5.0, 1.65])) @ turn)


def in_view(view: PinholeView, x: float, y: float, z: float) -> FloatArray:
    return view.T_map_camera.apply(np.array([x, y, z]))


def pole_at(bottom: FloatArray, height: float, radius: float, tilt: float = 0.01) -> Pole:
    peak = bottom + height * np.array([tilt, -tilt, 1.0])
    return Pole(1, "post", bottom, peak, radius, (90.0, 95.0, 99.0), np.zeros(3))


@pytest.mark.parametrize("depth", [5.0, 12.3, 24.7, 38.1])
@pytest.mark.parametrize("radius", [0.038, 0.09])
@pytest.mark.parametrize("roll", [0.0, 0.05])
def test_a_poles_axis_is_painted_where_it_projects(
    street: Street, depth: float, radius: float, roll: float
) -> None:
    view = view_at(street, roll)
    pole = pole_at(in_view(view, 0.21 * depth + 0.137, 1.2, depth), 2.7, radius)
    painted = cover(replace(empty(street.layout), poles=(pole,)), view)
    peak, bottom = view.project(np.array([pole.peak_m, pole.bottom_m]))
    rows = np.arange(int(max(peak[1], 0)) + 4, int(min(bottom[1], view.camera.height)) - 4)
    centroid = painted[rows] @ np.arange(view.camera.width) / painted[rows].sum(axis=1)
    expected = peak[0] + (rows - peak[1]) / (bottom[1] - peak[1]) * (bottom[0] - peak[0])
    assert len(rows) > 20
    assert np.abs(centroid - expected).max() < 0.15
    width = 2.0 * radius * view.camera.K[0, 0] / depth
    assert painted[rows].sum(axis=1).mean() == pytest.approx(width, rel=0.1)


@pytest.mark.parametrize("depth", [9.0, 21.3, 36.6])
def test_a_pole_ends_where_its_ends_project(street: Street, depth: float) -> None:
    view = view_at(street)
    pole = pole_at(in_view(view, 0.5, 1.1, depth), 2.7 if depth > 10 else 2.2, 0.06, tilt=0.0)
    painted = cover(replace(empty(street.layout), poles=(pole,)), view).max(axis=1)
    peak, bottom = view.project(np.array([pole.peak_m, pole.bottom_m]))
    solid = np.flatnonzero(painted > 0.5 * painted.max())
    assert solid[0] == pytest.approx(peak[1], abs=1.0)
    assert solid[-1] == pytest.approx(bottom[1], abs=1.0)
    assert painted.sum() / painted.max() == pytest.approx(bottom[1] - peak[1], abs=0.3)


@pytest.mark.parametrize("class_id", [TRIANGULAR, RECTANGULAR, ROUNDED])
@pytest.mark.parametrize("depth", [6.1, 17.8, 33.4])
def test_a_signs_middle_is_painted_where_it_projects(
    street: Street, class_id: int, depth: float
) -> None:
    view = view_at(street)
    right = 0.35 * view.T_map_camera.rotation[:, 0]
    middle = in_view(view, 0.13 * depth, -0.5, depth)
    bottom = in_view(view, 0.13 * depth, 1.6, depth)
    pole = replace(pole_at(bottom, 0.1, 0.02), id=2)
    sign = Sign(1, class_id, middle, right, 0.35 * UP, 4, 2)
    painted = cover(replace(empty(street.layout), poles=(pole,), signs=(sign,)), view)
    u, v = view.project(middle)[0]
    near = painted[: int(v + 0.45 * view.camera.K[0, 0] / depth) + 3]
    rows, columns = np.indices(near.shape)
    if class_id == TRIANGULAR:  # the middle is that of its box; its mass lies a third lower
        v = view.project(middle - sign.up_m / 3.0)[0, 1]
    assert (near * columns).sum() / near.sum() == pytest.approx(u, abs=0.15)
    assert (near * rows).sum() / near.sum() == pytest.approx(v, abs=0.2)


def test_the_same_seed_paints_the_same_picture(street: Street) -> None:
    again = Street(11)
    for side in ("left", "right"):
        assert np.array_equal(street.image(5, side), again.image(5, side))
    assert street.image(5, "left").shape == (376, 1241, 3)
    assert np.abs(street.image(5, "left").astype(int) - Street(12).image(5, "left")).mean() > 5


def test_labels_project_from_the_truth(street: Street) -> None:
    elements = street.truth_map.elements
    for index in range(0, 60, 7):
        for side in ("left", "right"):
            labels, ids = street.labels(index, side)
            view = street.view(index, side)
            true = elements[np.searchsorted(elements.id, ids)]
            peak, bottom = view.project(true.anchor_m), view.project(true.end_m)
            assert len(ids) > 4
            assert np.array_equal(true.class_id, labels.class_id)
            assert np.abs((labels.anchor_px - peak)[labels.anchor_known]).max() < 1e-6
            assert np.abs((labels.end_px - bottom)[labels.end_known]).max(initial=0.0) < 1e-6
            line = labels.is_line
            axis = (bottom - peak)[line] / np.linalg.norm((bottom - peak)[line], axis=1)[:, None]
            for end in (labels.anchor_px, labels.end_px):
                offset = (end - peak)[line]
                across = axis[:, 0] * offset[:, 1] - axis[:, 1] * offset[:, 0]
                assert np.abs(across).max() < 1e-6
                assert view.camera.contains(end[line]).all()


def test_left_and_right_labels_lie_on_the_same_rows(street: Street) -> None:
    pairs = 0
    for index in range(0, 60, 9):
        (left, left_ids), (right, right_ids) = (street.labels(index, s) for s in ("left", "right"))
        _, a, b = np.intersect1d(left_ids, right_ids, return_indices=True)
        known = left.anchor_known[a] & right.anchor_known[b]
        first, second = left.anchor_px[a][known], right.anchor_px[b][known]
        elements = street.truth_map.elements
        points = elements.anchor_m[np.searchsorted(elements.id, left_ids[a][known])]
        disparity = 718.856 * 0.54 / street.view(index, "left").depth(points)
        assert np.abs(first[:, 1] - second[:, 1]).max() < 1e-6
        assert np.abs(first[:, 0] - second[:, 0] - disparity).max() < 1e-6
        pairs += int(known.sum())
    assert pairs > 20


def test_left_and_right_pictures_agree_in_3d(street: Street) -> None:
    """The road's texture shows the same at one place in both, and another one beside it."""
    road = street.layout.road
    painter = Painter(empty(street.layout), 11)
    s, d = (
        axis.ravel() for axis in np.meshgrid(np.arange(17.0, 24.0, 0.05), np.arange(-3, -1, 0.1))
    )
    points = road.at(s, d)
    samples = []
    for side, shift in (("left", 0.0), ("right", 0.0), ("right", 4.0)):
        view = street.view(10, side)
        pixels = (view.project(points) + np.array([shift, 0.0])).astype(np.float32)
        picture = painter.paint(view)[..., 1].astype(np.float32)
        samples.append(cv2.remap(picture, pixels[:, 0], pixels[:, 1], cv2.INTER_LINEAR).ravel())
    inside = np.isfinite(samples).all(axis=0) & (np.min(samples, axis=0) > 0)
    correlation = np.corrcoef(np.array(samples)[:, inside])
    assert inside.sum() > 300
    assert correlation[0, 1] > 0.85
    assert correlation[0, 2] < correlation[0, 1] - 0.1


def test_a_parked_car_hides_the_bottom_of_the_pole_behind_it(street: Street) -> None:
    view = view_at(street)
    bottom = in_view(view, 3.0, 1.6, 14.0)
    pole = pole_at(bottom, 2.8, 0.05, tilt=0.0)
    car_place = in_view(view, 2.0, 1.65, 10.0)
    car = Car(car_place, 0.3, (1.0, 1.0, 1.0), True, (150.0, 30.0, 30.0))
    truth = Elements3D.from_ends([1], [pole.peak_m], [pole.bottom_m], [POLE])
    alone = replace(empty(street.layout), poles=(pole,))
    free, _ = elements_in_view(paint_ranks(alone, view), truth, view)
    hidden, _ = elements_in_view(paint_ranks(replace(alone, cars=(car,)), view), truth, view)
    assert free.end_known.all()
    assert hidden.anchor_known.all()
    assert not hidden.end_known.any()
    assert free.end_px[0, 1] - hidden.end_px[0, 1] > 10.0
    assert np.allclose(free.anchor_px, hidden.anchor_px)


def test_labels_end_where_the_picture_does(street: Street) -> None:
    """A pole among cars changes the picture from one end of its label to the other."""
    hidden = 0
    for index in (3, 30, 55):
        view = street.view(index, "left")
        _, ids = street.labels(index, "left")
        for pole in street.layout.poles:
            if pole.id not in ids:
                continue
            pole = replace(pole, arm_m=np.zeros(3))
            cars = replace(street.layout, poles=(), signs=())
            among = replace(cars, poles=(pole,))
            with_pole, without = (
                furniture(value, view, 255).astype(int) for value in (among, cars)
            )
            changed = np.abs(with_pole - without).max(axis=2)
            axis = view.project(np.linspace(pole.peak_m, pole.bottom_m, 2000))
            axis = axis[view.camera.contains(axis)]
            u, v = np.round(axis).astype(int).T
            shown = axis[changed[v, u] > 5]
            labels, _ = elements_in_view(paint_ranks(among, view), street.truth_map.elements, view)
            assert np.linalg.norm(shown[0] - labels.anchor_px[0]) < 2.0
            assert np.linalg.norm(shown[-1] - labels.end_px[0]) < 2.0
            hidden += not labels.end_known[0]
    assert hidden > 0


def test_a_sign_behind_a_nearer_one_has_no_label(street: Street) -> None:
    """Neither in the labels nor in the picture; and without the nearer one in both."""
    view = view_at(street)
    right, up = 0.35 * view.T_map_camera.rotation[:, 0], 0.35 * UP
    near = Sign(1, ROUNDED, in_view(view, 0.5, -0.4, 10.0), right, up, 4, 3)
    far = Sign(2, RECTANGULAR, in_view(view, 0.9, -0.72, 18.0), right, up, 4, 4)
    truth = Elements3D.from_ends(
        [1, 2],
        [near.middle_m, far.middle_m],
        np.full((2, 3), np.nan),
        [near.class_id, far.class_id],
    )
    both, alone = (replace(empty(street.layout), signs=value) for value in ((near, far), (far,)))
    assert elements_in_view(paint_ranks(both, view), truth, view)[1].tolist() == [1]
    assert elements_in_view(paint_ranks(alone, view), truth, view)[1].tolist() == [2]
    u, v = np.round(view.project(far.middle_m)[0]).astype(int)
    only_near = furniture(replace(both, signs=(near,)), view)
    assert (furniture(both, view)[v, u] == only_near[v, u]).all()
    assert (furniture(alone, view)[v, u] != only_near[v, u]).any()
