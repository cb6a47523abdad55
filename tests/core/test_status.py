"""Where there is no answer, or more than one, the solver says so: never a wrong ``ok``."""

import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from semviz_core.base.camera import Camera
from semviz_core.base.classes import POLE, RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.localizer import Localizer
from semviz_core.metrics.pose_errors import pose_error

CAMERA = Camera(1241, 376, np.array([[719.0, 0.0, 607.0], [0.0, 719.0, 185.0], [0.0, 0.0, 1.0]]))
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation of T_camera_map of a level camera that looks along x."""
SIGMA_PX = 1.0


def looking(x: float, y: float, heading_rad: float = 0.0, z: float = 1.65) -> Pose:
    """T_camera_map of a level camera."""
    turn = Pose.from_rotvec([0.0, 0.0, -heading_rad], np.zeros(3)).rotation
    rotation = AXES @ turn
    return Pose(rotation, -rotation @ np.array([x, y, z]))


def poles(ground: FloatArray, height: FloatArray | float) -> Elements3D:
    foot = np.column_stack([ground, np.zeros(len(ground))])
    peak = foot + np.outer(np.broadcast_to(height, len(foot)), [0.0, 0.0, 1.0])
    return Elements3D.from_ends(np.arange(len(foot)), peak, foot, np.full(len(foot), POLE))


def signs(middle: FloatArray, class_id: ArrayLike) -> Elements3D:
    n = len(middle)
    return Elements3D.from_ends(
        1000 + np.arange(n), middle, np.full((n, 3), np.nan), np.broadcast_to(class_id, n)
    )


def both(first: Elements3D, second: Elements3D) -> Elements3D:
    names = ("id", "anchor_m", "end_m", "class_id", "covariance_m2", "anchor_known", "end_known")
    return Elements3D(
        **{name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names}
    )


def street(seed: int) -> Elements3D:
    """500 m of poles of different height, and a sign on every third."""
    rng = np.random.default_rng(seed)
    x = np.arange(-250.0, 250.0, 5.0) + rng.uniform(-2.0, 2.0, 100)
    y = rng.choice([-1.0, 1.0], 100) * rng.uniform(3.5, 9.0, 100)
    posts = poles(np.column_stack([x, y]), rng.uniform(2.5, 8.0, 100))
    middle = posts.anchor_m[::3] * [1.0, 1.0, 0.0] + [0.0, 0.0, 2.2]
    return both(posts, signs(middle, rng.integers(TRIANGULAR, ROUNDED + 1, len(middle))))


def seen(elements: Elements3D, T_camera_map: Pose, seed: int, far_m: float = 40.0) -> Elements2D:
    """All elements from 4 to ``far_m`` ahead and in the image, with noise."""
    depth = T_camera_map.apply(elements.anchor_m)[:, 2]
    anchor = CAMERA.project(T_camera_map.apply(elements.anchor_m))
    end = CAMERA.project(T_camera_map.apply(elements.end_m))
    middle = np.where(elements.is_line[:, None], (anchor + end) / 2.0, anchor)
    rows = (depth > 4.0) & (depth < far_m) & CAMERA.contains(middle)
    noise = np.random.default_rng(seed).normal(0.0, SIGMA_PX, (2, int(rows.sum()), 2))
    return Elements2D.from_ends(
        anchor[rows] + noise[0], end[rows] + noise[1], elements.class_id[rows], SIGMA_PX
    )


def near(elements: Elements3D, place: FloatArray) -> Elements3D:
    away = np.linalg.norm(elements.anchor_m[:, :2] - place[:2], axis=1)
    return elements[away <= 50.0]


def prior_at(x: float, y: float, sigma_m: float = 5.0, z: float = 1.65) -> Prior:
    return Prior(np.array([x, y, z]), sigma_m, 0.15, up_camera=AXES[:, 2])


def localized(observed: Elements2D, submap: Elements3D, prior: Prior) -> Localization:
    found = Localizer().localize(observed, submap, CAMERA, prior)
    assert found.reason
    return found


def is_right(found: Localization, T_camera_map: Pose, most_m: float = 1.0) -> bool:
    """Within ``most_m`` and 2 deg for each metre."""
    assert found.T_camera_map is not None
    rte_m, rre_deg = pose_error(found.T_camera_map, T_camera_map)
    return rte_m < most_m and rre_deg < 2.0 * most_m


def poses(found: Localization) -> list[Pose]:
    assert found.T_camera_map is not None
    return [found.T_camera_map, *(alternative.T_camera_map for alternative in found.alternatives)]


@pytest.mark.parametrize("seed", range(4))
def test_the_street_itself_is_solved(seed: int) -> None:
    """So the cases below fail for what is planted in them."""
    world, pose = street(seed), looking(0.3, -1.0)
    found = localized(seen(world, pose, seed), near(world, np.zeros(2)), prior_at(2.0, 2.0))
    assert found.status == "ok", found.reason
    assert is_right(found, pose)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("twice", [False, True])
def test_without_a_fix_the_whole_map_is_searched(seed: int, twice: bool) -> None:
    """A street of 500 m, with another one beside it; or with itself."""
    world, pose = street(seed), looking(90.3, -1.0, 0.1)
    observed = seen(world, pose, seed)
    aside = world if twice else street(seed + 50)
    moved = np.array([30.0, 400.0, 0.0])
    other = replace(
        aside, id=aside.id + 5000, anchor_m=aside.anchor_m + moved, end_m=aside.end_m + moved
    )
    driven = np.column_stack([np.arange(-250.0, 250.0), np.zeros(500), np.full(500, 1.65)])
    road_m = np.concatenate([driven, driven + moved])
    prior = replace(prior_at(0.0, 200.0, 150.0), road_m=road_m)
    found = localized(observed, both(world, other), prior)
    if twice:
        assert found.status == "ambiguous", found.reason
        assert "401.1 m and 0 deg apart" in found.reason
    else:
        assert found.status == "ok", found.reason
        assert is_right(found, pose)


@pytest.mark.parametrize("count", range(4))
def test_fewer_elements_than_needed(count: int) -> None:
    world, pose = street(0), looking(0.3, -1.0)
    found = localized(seen(world, pose, 0)[:count], near(world, np.zeros(2)), prior_at(2.0, 2.0))
    assert found.status == "cannot"
    elements = "element" if count == 1 else "elements"
    assert found.reason == f"{count} {elements} seen, 4 needed."


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_mapped_than_needed(count: int) -> None:
    world, pose = street(0), looking(0.3, -1.0)
    ahead = np.flatnonzero((world.anchor_m[:, 0] > 8.0) & (world.anchor_m[:, 0] < 30.0))
    found = localized(seen(world, pose, 0), world[ahead[:count]], prior_at(2.0, 2.0))
    assert found.status == "cannot"


@pytest.mark.parametrize("with_signs", [False, True])
@pytest.mark.parametrize("with_up", [False, True])
def test_one_post(with_signs: bool, with_up: bool) -> None:
    """A pole and its signs: the camera can be anywhere on a circle around it."""
    post, pose = poles(np.array([[15.0, 2.0]]), 4.0), looking(0.0, 0.0)
    middle = np.array([[15.0, 2.0, z] for z in (1.9, 2.4, 2.9, 3.3)])
    if with_signs:
        world = both(post, signs(middle, [TRIANGULAR, RECTANGULAR, ROUNDED, RECTANGULAR]))
    else:
        world = signs(middle, [TRIANGULAR, RECTANGULAR, ROUNDED, RECTANGULAR])
    prior = prior_at(2.0, 2.0)
    found = localized(
        seen(world, pose, 1), world, prior if with_up else replace(prior, up_camera=None)
    )
    assert found.status == "cannot", found.reason


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("with_up", [False, True])
def test_points_on_one_line(with_up: bool, seed: int) -> None:
    """Signs along one straight line: no turn about it changes their places in the image."""
    x = np.array([10.0, 13.0, 19.0, 22.0, 30.0])
    middle = np.column_stack([x, 0.1 * x + 3.0, np.full(5, 2.2)])
    world, pose = signs(middle, RECTANGULAR), looking(0.0, 0.0)
    prior = prior_at(1.0, 1.0)
    prior = prior if with_up else replace(prior, up_camera=None, vertical_sigma_m=3.0)
    found = localized(seen(world, pose, seed), world, prior)
    assert found.status != "ok" or is_right(found, pose), found.reason


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("heading_rad", [None, 0.0])
def test_one_post_of_a_street(heading_rad: float | None, seed: int) -> None:
    """Only one of many posts is seen; a heading makes up for the others, if it fits one place."""
    post = poles(np.array([[15.0, 2.0]]), 4.0)
    middle = np.array([[15.0, 2.0, z] for z in (1.9, 2.4, 2.9)])
    post = both(post, signs(middle, [TRIANGULAR, RECTANGULAR, ROUNDED]))
    world = both(street(seed), replace(post, id=post.id + 5000))
    pose, prior = looking(0.0, 0.0), replace(prior_at(2.0, 2.0), heading_rad=heading_rad)
    found = localized(seen(post, pose, seed), near(world, np.zeros(2)), prior)
    if heading_rad is None:
        assert found.status != "ok", found.reason
    else:  # 5 deg of heading at 15 m are 1.3 m across
        assert found.status != "ok" or is_right(found, pose, 4.0), found.reason


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("across", [False, True])
def test_poles_in_one_row_are_enough(across: bool, seed: int) -> None:
    """All in one column of the image, or side by side: uneven gaps and heights fix the pose."""
    rng = np.random.default_rng(seed)
    ahead = np.array([9.0, 14.0, 17.0, 24.0, 31.0])
    ground = np.column_stack([ahead, 0.15 * ahead])
    if across:
        ground = np.column_stack([np.full(5, 20.0), [-9.0, -2.0, 1.0, 4.0, 11.0]])
    world, pose = poles(ground, rng.uniform(2.5, 7.0, 5)), looking(0.0, 0.0)
    found = localized(seen(world, pose, seed), world, prior_at(2.0, 2.0))
    assert found.status == "ok", found.reason
    assert is_right(found, pose)


@pytest.mark.parametrize("spacing_m", [5.0, 6.0, 8.0])
def test_a_row_of_equal_poles(spacing_m: float) -> None:
    """Moved by the spacing the street looks the same."""
    x = np.repeat(np.arange(-8, 10) * spacing_m, 2)
    world = poles(np.column_stack([x, np.tile([-4.0, 4.0], 18)]), 4.0)
    pose = looking(0.7, 0.3)
    prior = replace(prior_at(2.0, 1.0), heading_rad=0.0)
    found = localized(seen(world, pose, 0), near(world, np.zeros(2)), prior)
    assert found.status == "ambiguous", found.reason
    apart = re.search(r"([\d.]+) m .*apart", found.reason)
    assert apart is not None, found.reason
    steps = float(apart[1]) / spacing_m
    assert round(steps) >= 1
    assert abs(steps - round(steps)) < 0.05
    assert min(pose_error(found_pose, pose)[0] for found_pose in poses(found)) < 0.5


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("offset_m", [0.0, 1.5])
def test_a_place_that_looks_the_same_turned_round(offset_m: float, seed: int) -> None:
    """A junction that is its own image turned by 180 degrees, and no heading."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(8.0, 35.0, 8), rng.uniform(-9.0, 9.0, 8)])
    height = rng.uniform(2.5, 7.0, 8)
    world = poles(np.concatenate([ground, -ground]), np.concatenate([height, height]))
    pose, turned = looking(offset_m, 0.0), looking(-offset_m, 0.0, np.pi)
    found = localized(seen(world, pose, seed), world, prior_at(0.0, 0.0))
    assert found.status == "ambiguous", found.reason
    assert "apart" in found.reason
    for value in (pose, turned):
        assert min(pose_error(have, value)[0] for have in poses(found)) < 0.5


@pytest.mark.parametrize("sigma_m", [1.0, 5.0])
@pytest.mark.parametrize("seed", range(6))
def test_a_fix_60_m_off(seed: int, sigma_m: float) -> None:
    world, pose = street(seed), looking(0.3, -1.0)
    fix = np.array([60.0, 2.0])
    found = localized(seen(world, pose, seed), near(world, fix), prior_at(60.0, 2.0, sigma_m))
    assert found.status != "ok", found.reason


@pytest.mark.parametrize("seed", range(6))
def test_a_fix_15_m_off_that_claims_1_m(seed: int) -> None:
    """The submap holds the truth; the prior denies it."""
    world, pose = street(seed), looking(0.3, -1.0)
    found = localized(seen(world, pose, seed), near(world, np.zeros(2)), prior_at(15.3, -1.0, 1.0))
    assert found.status != "ok" or is_right(found, pose), found.reason


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("wrong", ["height", "up", "heading"])
def test_a_height_attitude_or_heading_that_contradicts(wrong: str, seed: int) -> None:
    world, pose = street(seed), looking(0.3, -1.0)
    prior = {
        "height": prior_at(2.0, 2.0, z=7.65),
        "up": replace(prior_at(2.0, 2.0), up_camera=np.array([0.0, -0.8, 0.6])),
        "heading": replace(prior_at(2.0, 2.0), heading_rad=np.pi),
    }[wrong]
    found = localized(seen(world, pose, seed), near(world, np.zeros(2)), prior)
    assert found.status != "ok", found.reason


def test_an_empty_submap() -> None:
    world = street(0)
    found = localized(seen(world, looking(0.0, 0.0), 0), world[[]], prior_at(2.0, 2.0))
    assert found.status == "cannot"
    assert found.reason == "Nothing is mapped around the prior: the submap is empty."


def test_no_class_in_common() -> None:
    world = street(0)
    observed = seen(world, looking(0.0, 0.0), 0)
    only_signs = near(world, np.zeros(2))
    only_signs = only_signs[only_signs.class_id != POLE]
    found = localized(observed[observed.class_id == POLE], only_signs, prior_at(2.0, 2.0))
    assert found.status == "cannot"


def test_all_detections_are_false() -> None:
    """What another street shows: real shapes at places that mean nothing here fit by chance once in
    hundreds of frames."""
    wrong = {}
    for seed in range(200):
        world, other = street(seed), street(seed + 100)
        observed = seen(other, looking(0.3, -1.0), seed)
        found = localized(observed, near(world, np.zeros(2)), prior_at(2.0, 2.0))
        if found.status == "ok":
            wrong[seed] = found.reason
    assert len(wrong) <= 1, wrong


@pytest.mark.parametrize("seed", range(12))
def test_random_detections(seed: int) -> None:
    rng = np.random.default_rng(seed)
    world, m = street(seed), int(rng.integers(4, 10))
    anchor = rng.uniform([20.0, 10.0], [1220.0, 170.0], (m, 2))
    end = anchor + np.column_stack([rng.normal(0.0, 2.0, m), rng.uniform(30.0, 170.0, m)])
    class_id = np.where(rng.random(m) < 0.6, POLE, rng.integers(1, 4, m))
    end[class_id != POLE] = np.nan
    observed = Elements2D.from_ends(anchor, end, class_id, SIGMA_PX)
    found = localized(observed, near(world, np.zeros(2)), prior_at(2.0, 2.0))
    assert found.status != "ok", found.reason
