"""The 3D pane: what is clicked, what colours say, what is sent when something changes."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_runs import ambiguous, small_run, spoiled, unanswered

from semviz.inspector.scene import scene_map
from semviz.inspector.scene.scene_cameras import IMAGES, mark_positions_m
from semviz.inspector.scene.scene_map import Usage, legend, levels, usage_of
from semviz.inspector.scene.scene_view import InspectorScene
from semviz.inspector.state import MapColors, State, View
from semviz.presentation.plots import RESIDUAL_LIMITS_PX, USED, USED_LIMITS
from semviz.runs.run import Run
from semviz.web.scene import BACKDROP_DEPTH_M, FRUSTUM_DEPTH_M
from semviz.web.shapes import PALETTES, ellipsoids, rgb
from semviz.web.viewpoint import BEFORE_EYE_M, Pickable, pick, ray_distances
from semviz.web.viser_servers import ViserServers
from semviz_core.base.elements import joined
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap

if TYPE_CHECKING:
    pass

REACH_RAD = 0.02
STROKE_BYTES = 2 * 2 * 3 * 4
"""Places and colours of both ends of a hairline."""


# What is clicked


@given(st.integers(0, 2**32 - 1))
def test_distance_of_segments_from_a_ray_is_the_least_over_their_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, high = rng.normal(size=(2, 5, 3))
    high[0] = low[0]  # a point
    origin, direction = rng.normal(size=(2, 3))
    direction /= np.linalg.norm(direction)
    found, _ = ray_distances(Pickable(np.arange(5), low, high), origin, direction)
    share = np.linspace(0.0, 1.0, 2001)[:, None, None]
    points = low + share * (high - low) - origin
    across = points - (points @ direction)[..., None] * direction
    assert np.allclose(found, np.linalg.norm(across, axis=2).min(axis=0), atol=1e-3)


@given(st.integers(0, 2**32 - 1))
def test_click_on_an_element_means_it_or_one_before_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.uniform([5.0, -20.0, 0.0], [60.0, 20.0, 1.0], (40, 3))
    offer = Pickable(np.arange(40) + 100, low, low + np.array([0.0, 0.0, 4.0]))
    row = int(rng.integers(40))
    target = low[row] + [0.0, 0.0, rng.uniform(0.0, 4.0)]
    origin = np.array([0.0, 0.0, 2.0])
    found = pick({"element": offer}, origin, target - origin, REACH_RAD)
    assert found is not None
    assert found[0] == "element"
    away = np.linalg.norm(low - origin, axis=1)
    assert found[1] == row + 100 or away[found[1] - 100] < away[row] + 4.0


def test_click_beside_everything_or_behind_the_eye_means_nothing() -> None:
    pole = Pickable(np.array([7]), np.array([[10.0, 0.0, 0.0]]), np.array([[10.0, 0.0, 5.0]]))
    eye = np.array([0.0, 0.0, 2.0])
    assert pick({"element": pole}, eye, np.array([1.0, 0.0, 0.0]), REACH_RAD) == ("element", 7)
    assert pick({"element": pole}, eye, np.array([1.0, 0.1, 0.0]), REACH_RAD) is None
    assert pick({"element": pole}, eye, np.array([-1.0, 0.0, 0.0]), REACH_RAD) is None


@given(st.integers(0, 2**32 - 1))
def test_nothing_that_a_click_may_mean_is_left_out_beforehand(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low = rng.normal(scale=10.0, size=(200, 3))
    high = low + rng.normal(scale=rng.choice([0.0, 0.1, 5.0], (200, 1)), size=(200, 3))
    offer = Pickable(np.arange(200), low, high)
    origin, direction = rng.normal(scale=5.0, size=3), rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    reach_rad = rng.uniform(0.0, 0.3)
    apart_m, depth_m = ray_distances(offer, origin, direction)
    meant = (depth_m > BEFORE_EYE_M) & (apart_m <= reach_rad * depth_m)
    near = offer.near(origin, direction, reach_rad)
    assert set(np.flatnonzero(meant)) <= set(near)
    assert len(near) < 200 or meant.all()


def test_nearer_of_two_elements_under_the_pointer_is_meant_whatever_its_kind() -> None:
    far = Pickable(np.array([7]), np.array([[10.0, 0.0, 0.0]]), np.array([[10.0, 0.0, 5.0]]))
    near = Pickable(np.array([3]), np.array([[5.0, 0.0, 2.0]]), np.array([[5.0, 0.0, 2.0]]))
    eye, ahead = np.array([0.0, 0.0, 2.0]), np.array([1.0, 0.0, 0.0])
    for offers in ({"element": far, "frame": near}, {"frame": near, "element": far}):
        assert pick(offers, eye, ahead, REACH_RAD) == ("frame", 3)


# What colours say


@given(st.integers(0, 2**32 - 1))
def test_ellipsoids_are_those_of_the_covariances(seed: int) -> None:
    roots = np.random.default_rng(seed).normal(size=(4, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1)
    axes, wxyz = ellipsoids(covariances)
    for size, (w, x, y, z), covariance in zip(axes, wxyz, covariances, strict=True):
        turned = Rotation.from_quat([x, y, z, w]).as_matrix()
        assert np.allclose(turned @ np.diag(size**2) @ turned.T, covariance, atol=1e-9)


def test_usage_counts_the_pairs_that_fit() -> None:
    run = spoiled(small_run(), {12: unanswered})
    usage = usage_of(run)
    for row, number in enumerate(run.semantic_map.elements.id):
        sizes = []
        for localization in run.localizations:
            fine = localization.refinement
            if fine is None:
                continue
            for (_, column), residual, fits in zip(
                fine.pairs, fine.residual_px, fine.inlier, strict=True
            ):
                if fits and localization.submap.id[column] == number:
                    sizes.append(np.sqrt(np.nansum(residual**2)))
        assert usage.times[row] == len(sizes)
        if sizes:
            assert usage.residual_px[row] == pytest.approx(np.median(sizes))
        else:
            assert np.isnan(usage.residual_px[row])


@pytest.mark.parametrize("colors", ["residual", "times"])
@given(times=st.lists(st.integers(0, 60), min_size=1, max_size=40))
def test_legend_counts_every_element_once_within_limits_that_never_move(
    times: list[int], colors: MapColors
) -> None:
    count = np.array(times)
    residual_px = np.where(count > 0, 0.13 * count, np.nan)
    level = levels(colors, Usage(count, residual_px))
    told = legend(colors, Usage(count, residual_px), "dark").levels
    assert [labels.elements for labels in told] == [
        (level == row).sum() for row in range(len(told))
    ]
    assert ((level == len(told) - 1) == (count == 0)).all()
    for row, number in enumerate(count):
        limits = USED_LIMITS if colors == "times" else RESIDUAL_LIMITS_PX
        value = number if colors == "times" else residual_px[row]
        expected = sum(value > limit if colors == "times" else value >= limit for limit in limits)
        if number:
            assert level[row] == expected


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_more_often_used_stands_out_more(theme: str) -> None:
    ground = luminance(PALETTES["dark" if theme == "dark" else "light"].scene)
    tones = [luminance(getattr(tone, theme)) for tone in USED]
    contrast = [max(tone, ground) / min(tone, ground) for tone in tones]
    assert contrast == sorted(contrast)
    assert contrast[0] > 1.7


def luminance(color: str) -> float:
    """Relative luminance as WCAG has it, with its 0.05."""
    share = np.array(rgb(color)) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722]) + 0.05


# What is sent


@pytest.fixture
def sent() -> Iterator[tuple[InspectorScene, list[tuple[str, str, int]]]]:
    """A view, and what it sends: kind of message, node, bytes."""
    scenes = ViserServers()
    try:
        server = scenes.scene("one")
        messages: list[tuple[str, str, int]] = []
        interface = server.scene._websock_interface
        queue = interface.queue_message

        def note(message: Any) -> None:
            props = getattr(message, "props", None)
            values = getattr(message, "updates", {}) if props is None else vars(props)
            arrays = [value for value in values.values() if isinstance(value, np.ndarray | bytes)]
            size = sum(memoryview(array).nbytes for array in arrays)
            messages.append((type(message).__name__, getattr(message, "name", ""), size))
            queue(message)

        interface.queue_message = note  # type: ignore[method-assign]
        yield InspectorScene(server, lambda _, __: None, Path), messages
    finally:
        scenes.close_all()


def city(copies: int) -> Run:
    """The small run in a map with copies of its street beside it."""
    run = small_run()
    whole = street = run.semantic_map.elements
    for number in range(1, copies):
        away = Pose(np.eye(3), np.array([0.0, 300.0 * number, 0.0]))
        moved = replace(street.transformed(away), id=street.id + 1000 * number)
        whole = joined(whole, moved)
    road = run.semantic_map.trajectory_m
    info = replace(run.info, options={"crop_radius_m": 50.0})
    semantic_map = SemanticMap(whole, run.semantic_map.frame, trajectory_m=road)
    return replace(run, info=info, semantic_map=semantic_map)


def test_next_frame_sends_nothing_of_the_map(
    sent: tuple[InspectorScene, list[tuple[str, str, int]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_map, "MAX_GLYPHS", 50)
    view, messages = sent
    run, state = city(20), State(run="city")
    view.show_run(run, state)
    assert {"/far", "/map/thin-0"} <= {name for _, name, _ in messages}
    messages.clear()
    view.show_frame(run, replace(state, position=1))
    assert messages
    assert not [name for _, name, _ in messages if name.startswith(("/map", "/far", "/ways"))]
    made = [name for kind, name, _ in messages if kind in ("LineSegmentsMessage", "GlbMessage")]
    assert not [name for name in made if not name.startswith(("/pairs", "/submap"))]
    assert sum(size for *_, size in messages) < 60_000


def in_sight(view: InspectorScene) -> dict[str, dict[str, Any]]:
    """What is to be seen of each node of the scene."""
    held = (node for nodes in view._scene._nodes._drawn.values() for node in nodes.values())
    nodes = (node for node in held if node.visible)
    return {
        node.name: {**vars(node._impl.props), "wxyz": node.wxyz, "position": node.position}
        for node in nodes
    }


def wandered(run: Run, rng: np.random.Generator) -> Iterator[State]:
    """Every frame once, in any order, looked at in any way."""
    views: tuple[View, ...] = ("behind", "camera", "above")
    colors: tuple[MapColors, ...] = ("class", "residual", "times")
    for position in rng.permutation(len(run.frames)).tolist():
        state = State("first", int(position), view=views[rng.integers(3)])
        state = state.with_map_colors(colors[rng.integers(3)], bool(rng.integers(2)))
        chosen = rng.choice(run.frames[position].localization.submap.id)
        yield state.with_selection(None, int(chosen), run) if rng.integers(2) else state


def test_what_is_seen_is_the_same_wherever_one_was_before() -> None:
    run, rng = photographed(small_run()), np.random.default_rng(3)
    run = spoiled(run, {14: unanswered, 18: lambda record: replace(record, image=None)})
    scenes = ViserServers()
    try:
        view, fresh = (
            InspectorScene(scenes.scene(value), lambda _, __: None, Path)
            for value in ("one", "two")
        )
        view.show_run(run, State("first"))
        for state in [*wandered(run, rng), *wandered(run, rng)]:
            view.recolor(run, state)
            view.show_frame(run, state)
            fresh.show_run(run, state)
            now, expected = in_sight(view), in_sight(fresh)
            assert now.keys() == expected.keys()
            for name, node in expected.items():
                for what, value in node.items():
                    if isinstance(value, np.ndarray):
                        np.testing.assert_allclose(now[name][what], value, rtol=1e-4, atol=1e-4)
                    else:
                        value = pytest.approx(value) if isinstance(value, float) else value
                        assert now[name][what] == value, (name, what)
    finally:
        scenes.close_all()


def test_who_comes_back_makes_no_node_again(
    sent: tuple[InspectorScene, list[tuple[str, str, int]]],
) -> None:
    view, messages = sent
    run = spoiled(small_run(), {14: unanswered})
    view.show_run(run, State("first"))
    made = []
    for position in (1, 2, 3, 2, 1, 0, 1, 2, 3):
        messages.clear()
        view.show_frame(run, State("first", position))
        kinds = {kind for kind, *_ in messages}
        made.append(bool(kinds & {"LineSegmentsMessage", "LabelMessage", "RemoveSceneNodeMessage"}))
    assert any(made[:3])
    assert not any(made[3:])


def photographed(run: Run) -> Run:
    """With photos of one grey each, by position: 0, 40, 80 ..."""
    import cv2

    def photo(position: int) -> bytes:
        camera = run.frames[position].localization.camera
        image = np.full((camera.height, camera.width, 3), 40 * position, dtype=np.uint8)
        return cv2.imencode(".jpg", image)[1].tobytes()

    frames = (replace(frame, image=photo(row)) for row, frame in enumerate(run.frames))
    return replace(run, frames=tuple(frames))


def shown_photos(view: InspectorScene) -> list[tuple[int, int, np.ndarray]]:
    """Of each photo that is seen: its position, by its grey, width in pixels, and where it is."""
    nodes = view._scene._nodes._drawn
    handles = [node for name in nodes if name.startswith(IMAGES) for node in nodes[name].values()]
    assert len(handles) <= 3
    photos = (cast(Any, handle) for handle in handles if handle.visible)
    return [
        (round(photo.image.mean() / 40), photo.image.shape[1], photo.position) for photo in photos
    ]


def test_photo_of_the_frame_is_seen_and_no_other_wherever_one_goes(
    sent: tuple[InspectorScene, list[tuple[str, str, int]]],
) -> None:
    view, _ = sent
    run, rng = photographed(small_run()), np.random.default_rng(0)
    run = spoiled(run, {14: lambda record: replace(record, image=None)})
    view.show_run(run, State(run="first"))
    looks: tuple[View, ...] = ("behind", "camera", "above")
    for _ in range(60):
        position, look = int(rng.integers(len(run.frames))), looks[rng.integers(3)]
        state = State(run="first", position=position, view=look)
        view.show_frame(run, state)
        if rng.random() < 0.7:
            view.preload_images(state)
        seen = shown_photos(view)
        if position == 2:
            assert not seen
            continue
        ((number, width, place),) = seen
        result = run.frames[position].localization
        assert result.T_camera_map is not None
        through = look == "camera"
        assert number == position
        assert width == pytest.approx(result.camera.width / (1 if through else 2), abs=1)
        depth_m = BACKDROP_DEPTH_M if through else FRUSTUM_DEPTH_M
        assert result.T_camera_map.apply(place)[2] == pytest.approx(depth_m)


def test_step_to_an_expected_frame_makes_and_sends_no_photo(
    sent: tuple[InspectorScene, list[tuple[str, str, int]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2

    view, messages = sent
    run, state = photographed(small_run()), State(run="first", position=2)
    view.show_run(run, state)
    for position in (3, 4, 3):
        view.preload_images(state)
        messages.clear()
        state = replace(state, position=position)
        with monkeypatch.context() as patched:
            patched.delattr(cv2, "imencode")
            view.show_frame(run, state)
        assert [size for _, name, size in messages if name.startswith(IMAGES)]
        assert not [size for _, name, size in messages if name.startswith(IMAGES) and size]
    view.show_frame(run, replace(state, position=0))
    assert [size for _, name, size in messages if name.startswith(IMAGES) and size]


def test_every_element_is_a_stroke_and_the_nearest_have_glyphs(
    sent: tuple[InspectorScene, list[tuple[str, str, int]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_map, "MAX_GLYPHS", 50)
    view, messages = sent
    run = city(20)
    view.show_run(run, State(run="city"))
    (size,) = (size for _, name, size in messages if name == "/far" and size)
    strokes = len(run.semantic_map) * STROKE_BYTES
    assert strokes < size < strokes + 20_000  # each once, and what describes them
    layer = view._map
    center = run.frames[0].localization.prior.position_m
    away = np.linalg.norm(layer.centers_m[:, :2] - center[:2], axis=1)
    near = layer._near(center)
    assert len(near) == 50
    assert away[near].max() <= np.delete(away, near).min()


def test_what_is_near_changes_without_sending_what_is_far(
    sent: tuple[InspectorScene, list[tuple[str, str, int]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_map, "MAX_GLYPHS", 50)
    monkeypatch.setattr(scene_map, "REDRAW_M", 0.0)
    view, messages = sent
    run, state = city(20), State(run="city")
    view.show_run(run, state)
    messages.clear()
    view.show_frame(run, replace(state, position=1))
    assert not [name for _, name, _ in messages if name == "/far"]


def test_marks_are_where_frames_are_and_ways_have_gaps(
    sent: tuple[InspectorScene, list[tuple[str, str, int]]],
) -> None:
    run = spoiled(small_run(), {14: unanswered, 18: ambiguous})
    places = mark_positions_m(run)
    for place, frame in zip(places, run.frames, strict=True):
        assert frame.frame.T_map_camera is not None
        assert np.linalg.norm((place - frame.frame.T_map_camera.translation)[:2]) < 1.0
    view, messages = sent
    view.show_run(run, State(run="first"))
    size = {name: bytes_ for _, name, bytes_ in messages if bytes_}
    # to 14 and from it there is no estimate
    assert size["/ways/truth"] - size["/ways/estimate"] == pytest.approx(2 * STROKE_BYTES, abs=40)
    assert {name for name in size if name in ("/ways/ok", "/ways/ambiguous", "/ways/cannot")} == {
        "/ways/ok",
        "/ways/ambiguous",
        "/ways/cannot",
    }


# What people do
