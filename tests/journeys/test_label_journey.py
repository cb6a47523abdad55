"""The first journey: label a street through the page, and find every element where it stands."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from journeys.driver import POLE, LabelDriver, Pixel, Side

from semviz.annotator.server import Annotator
from semviz.web.gateway import Gateway
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.placement.triangulation import Triangulated, triangulate
from semviz_core.simulation.street import Street

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser

SEED, FRAMES = 11, (4, 5)
NEAR_M = 20.0
SIDES: tuple[Side, Side] = ("left", "right")


@dataclass(frozen=True)
class Truth:
    """One element of the street with its exact pixels, by frame and side."""

    id: int
    class_id: int
    depth_m: float
    pixels: dict[tuple[int, Side], tuple[Pixel, Pixel | None]]


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return Workspace.create_street(tmp_path / "street", SEED, range(0, 10))


@pytest.fixture
def annotator(workspace: Workspace) -> Iterator[Annotator]:
    annotator = Annotator(workspace, author="tester")
    yield annotator
    annotator.close()


@pytest.fixture
def url(annotator: Annotator) -> Iterator[str]:
    with Gateway(annotator).running() as url:
        yield url


def test_three_poles_and_a_sign_in_two_frames(workspace: Workspace, url: str, page: "Page") -> None:
    street = workspace.source
    assert isinstance(street, Street)
    truths = _chosen(street)
    driver = LabelDriver(page)
    driver.open(url)
    names: dict[int, str] = {}
    for frame in FRAMES:
        driver.goto(frame)
        for truth in truths:
            left, right = (truth.pixels[frame, side] for side in SIDES)
            names[truth.id] = driver.draw_pair(truth.class_id, left, right, names.get(truth.id))
        driver.press_and_save("Enter")
    page.goto("about:blank")

    labels = workspace.read_labels()
    assert len(labels.elements) == len(truths)
    assert [labels.review(frame) for frame in FRAMES] == ["reviewed"] * 2
    for truth in truths:
        (element,) = (
            element
            for element in labels.elements.values()
            if workspace.classes.element_name(element.class_id, element.number) == names[truth.id]
        )
        seen = labels.of_element(element.id)
        assert len(seen) == 4
        for row in seen:
            peak, bottom = truth.pixels[row.frame_index, "left" if row.side == "left" else "right"]
            np.testing.assert_allclose(row.anchor_px, peak, atol=0.05)
            if bottom is not None:
                assert row.end_px is not None
                np.testing.assert_allclose(row.end_px, bottom, atol=0.05)
        views = [
            rig_view(street.rig, row.side, street.frames[row.frame_index].T_map_camera.inverse())
            for row in seen
        ]
        place = triangulate(views, seen)
        assert isinstance(place, Triangulated)
        rows = street.truth_map.elements.id == truth.id
        true = street.truth_map.elements[rows]
        assert np.linalg.norm(place.anchor_m - true.anchor_m[0]) < 0.3
        if truth.class_id == POLE:
            assert np.linalg.norm(place.end_m - true.end_m[0]) < 0.3


def _chosen(street: Street) -> list[Truth]:
    """The three nearest poles and the nearest sign that are whole in all four images."""
    whole = [truth for truth in _truths(street) if len(truth.pixels) == 2 * len(FRAMES)]
    whole.sort(key=lambda truth: truth.depth_m)
    poles = [truth for truth in whole if truth.class_id == POLE][:3]
    signs = [truth for truth in whole if truth.class_id != POLE][:1]
    chosen = poles + signs
    assert len(chosen) == 4
    assert all(truth.depth_m < NEAR_M for truth in chosen), "this street has too little nearby"
    return chosen


def _truths(street: Street) -> list[Truth]:
    found: dict[int, Truth] = {}
    for frame in FRAMES:
        pose = street.frames[frame].T_map_camera
        assert pose is not None
        for side in SIDES:
            seen, ids = street.labels(frame, side)
            for row, element_id in enumerate(ids.tolist()):
                if not seen.anchor_known[row] or seen.end_known[row] != seen.is_line[row]:
                    continue
                true = street.truth_map.elements[street.truth_map.elements.id == element_id]
                depth = float(pose.inverse().apply(true.anchor_m)[0, 2])
                truth = found.setdefault(
                    element_id, Truth(element_id, int(seen.class_id[row]), depth, {})
                )
                end = _pixel(seen.end_px[row]) if seen.is_line[row] else None
                truth.pixels[frame, side] = (_pixel(seen.anchor_px[row]), end)
    return list(found.values())


def _pixel(values: np.ndarray) -> Pixel:
    return float(values[0]), float(values[1])
