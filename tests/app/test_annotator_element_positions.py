"""Places of label elements: what a frame needs at once, the rest bit by bit, always up to date."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semviz.annotator.element_positions import (
    ONE_VIEW,
    REACH_M,
    ElementPositions,
    projected_elements,
)
from semviz.annotator.panes import Cameras
from semviz_annotation.labels.edits import DeleteElement, DeleteObservation, Edit, MoveObservation
from semviz_annotation.labels.labels import LabelElement, Labels, Observation, Row
from semviz_annotation.labels.rows import Rules
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.placement.triangulation import Triangulated, triangulate
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.frame import Frame
from semviz_core.base.pose import Pose

K = np.array([[720.0, 0.0, 610.0], [0.0, 720.0, 180.0], [0.0, 0.0, 1.0]])
RIG = Rig(Camera(1241, 376, K), Camera(1241, 376, K), Pose(np.eye(3), np.array([-0.54, 0.0, 0.0])))
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
ROAD_M = 600


def drive() -> tuple[Frame, ...]:
    """Every 20 m down a long road, and down it again."""
    stops = [20.0 * i for i in range(ROAD_M // 20)]
    return tuple(
        Frame(i, float(i), Pose(AHEAD, np.array([x, 1.0 * (i >= len(stops)), 1.6])))
        for i, x in enumerate(stops * 2)
    )


FRAMES = drive()
FIRST_PASS = len(FRAMES) // 2


def name_of(number: int, part: int = 0) -> str:
    return f"{part:08x}-0000-7000-8000-{number:012x}"


def labels_of(first_pass_only: bool = False) -> Labels:
    """A sign on a post every 15 m, labelled in both images of all frames within 60 m."""
    rows: list[Row] = []
    for number in range(1, ROAD_M // 15):
        place = np.array([15.0 * number, 5.0 - 10.0 * (number % 2), 2.5])
        seen: list[Row] = []
        for frame in FRAMES[: FIRST_PASS if first_pass_only else None]:
            assert frame.T_map_camera is not None
            for part, side in enumerate(("left", "right")):
                view = rig_view(RIG, side, frame.T_map_camera.inverse())
                pixel = view.project(place)[0]
                if not 3.0 < view.depth_m(place) < 60.0 or not RIG.left.contains(pixel)[0]:
                    continue
                seen.append(
                    Observation(
                        id=name_of(1000 * number + frame.index, 1 + part),
                        element_id=name_of(number),
                        frame_index=frame.index,
                        side=side,
                        anchor_px=(float(pixel[0]), float(pixel[1])),
                        end_px=None,
                        anchor_known=True,
                        end_known=False,
                    )
                )
        rows += [LabelElement(name_of(number), number, 1), *seen] if seen else []
    return Labels.from_rows(rows)


LABELS = labels_of()


def anew(labels: Labels) -> dict[str, Triangulated]:
    """The positions by the definition, of everything, nothing kept."""
    positions = {}
    for element_id in labels.elements:
        rows = labels.of_element(element_id)
        poses = [FRAMES[row.frame_index].T_map_camera for row in rows]
        views = [
            rig_view(RIG, row.side, pose.inverse())
            for row, pose in zip(rows, poses, strict=True)
            if pose is not None
        ]
        place = triangulate(views, rows) if len(views) > 1 else ONE_VIEW
        if isinstance(place, Triangulated):
            positions[element_id] = place
    return positions


def assert_same(found: dict[str, Triangulated], expected: dict[str, Triangulated]) -> None:
    assert found.keys() == expected.keys()
    for element_id, place in found.items():
        np.testing.assert_array_equal(place.anchor_m, expected[element_id].anchor_m)


@pytest.mark.parametrize("index", [0, 7, FIRST_PASS + 12, len(FRAMES) - 1])
def test_a_frame_has_all_its_projections_though_few_elements_are_triangulated(index: int) -> None:
    """Also those that only another pass of the street has labelled."""
    labels = labels_of(first_pass_only=True)
    pose = FRAMES[index].T_map_camera
    assert pose is not None
    positions = ElementPositions(Cameras(RIG, FRAMES))
    near = positions.near(labels, index)
    assert len(near) < 0.7 * len(labels.elements)
    found = projected_elements(index, "right", pose.inverse(), RIG, labels, near)
    assert found == projected_elements(index, "right", pose.inverse(), RIG, labels, anew(labels))
    if index >= FIRST_PASS and index < len(FRAMES) - 1:
        assert found
    assert all(proposed.depth_m < REACH_M for proposed in found)


def test_the_whole_map_comes_bit_by_bit() -> None:
    positions = ElementPositions(Cameras(RIG, FRAMES))
    assert not positions.update(LABELS, 0.0)
    counts = []
    while not positions.update(LABELS, 1e-9):
        counts.append(len(positions.mapped(LABELS)))
    assert counts == sorted(counts)
    assert_same(dict(positions.mapped(LABELS)), anew(LABELS))


@settings(max_examples=20)
@given(st.data())
def test_after_any_edits_places_are_as_if_found_anew(data: st.DataObject) -> None:
    positions = ElementPositions(Cameras(RIG, FRAMES))
    labels = LABELS
    for _ in range(data.draw(st.integers(1, 4))):
        draw = data.draw(st.sampled_from(sorted(labels.observations)))
        row = labels.observations[draw]
        edit: Edit = data.draw(
            st.sampled_from(
                [
                    MoveObservation(draw, (row.anchor_px[0] + 0.5, row.anchor_px[1])),
                    DeleteObservation(draw),
                    DeleteElement(row.element_id),
                ]
            )
        )
        before, labels = labels, labels.changed(edit.changes(labels, Rules()))
        assert labels.differing(before) == before.differing(labels) == {row.element_id}
        index = data.draw(st.sampled_from(range(len(FRAMES))))
        near = dict(positions.near(labels, index))
        assert_same(near, {key: value for key, value in anew(labels).items() if key in near})
        back_and_forth = data.draw(st.booleans())
        if back_and_forth:
            positions.near(before, index)
    while not positions.update(labels):
        pass
    assert_same(dict(positions.mapped(labels)), anew(labels))


def test_frames_that_are_not_there_any_more_count_as_unposed() -> None:
    """A workspace over fewer frames than were labelled."""
    positions = ElementPositions(Cameras(RIG, FRAMES[:2]))
    element_id = min(LABELS.elements.values(), key=lambda element: element.number).id
    assert isinstance(positions.of_element(LABELS, element_id), Triangulated)
    last = max(LABELS.observations.values(), key=lambda row: row.frame_index)
    assert positions.of_element(LABELS, last.element_id) is ONE_VIEW
