"""The image view: what is drawn in each mode, the right camera, frames around, and no images."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from inspector_page import (
    BOTH,
    changed,
    in_url,
    near,
    open_blank,
    open_flat,
    pixels,
    record_street,
    settle,
    wait_for,
)
from small_runs import saved

from semviz.inspector.context import RunImages
from semviz.inspector.image import neighbours_view, right_view
from semviz.inspector.server import HANDLERS, Inspector
from semviz.inspector.state import State
from semviz.inspector.views import frame_view
from semviz.runs.reader import load_run
from semviz.runs.run import FrameRecord, Run
from semviz.web.gateway import Gateway
from semviz.web.protocol import MalformedRequestError
from semviz_core.base.camera import Rig
from semviz_core.diagnosis.fault import FALSE_POSITIVE

if TYPE_CHECKING:
    from playwright.sync_api import Page

FRAMES = (10, 12, 14)
MISTAKEN = 12
"""The frame in which two true elements were told the other way round."""
SEEN, ESTIMATE, CANNOT = "#EFE154", "#FF7A1A", "#F0532D"


def mistake(record: FrameRecord) -> FrameRecord:
    """Two of a kind are exchanged: their pairs fit, and join different elements."""
    if record.frame.index != MISTAKEN:
        return record
    ids = record.element_id.copy()
    ids[[0, 1]] = ids[[1, 0]]
    return replace(record, element_id=ids)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    record_street(folder / "bare.rrd", FRAMES[:2], sides=())
    path = record_street(folder / "first.rrd", FRAMES, sides=BOTH, spoil=mistake)
    run = load_run(path)
    saved(one_eyed(run), folder / "one-eyed.rrd")
    saved(by_detector(run), folder / "detected.rrd")
    return path


def by_detector(run: Run) -> Run:
    """As if a detector had seen it, and its first detection in each frame were nothing real."""
    frames = tuple(
        replace(frame, element_id=np.r_[FALSE_POSITIVE, frame.element_id[1:]])
        for frame in run.frames
    )
    return replace(run, info=replace(run.info, observations="detected by X"), frames=frames)


def one_eyed(run: Run) -> Run:
    """As if there were no right camera."""
    return replace(run, info=replace(run.info, rig=Rig(run.info.rig.left)))


@pytest.fixture(scope="module")
def run(recorded: Path) -> Run:
    return load_run(recorded)


@pytest.fixture
def url(recorded: Path) -> Iterator[str]:
    others = [recorded.with_name(f"{name}.rrd") for name in ("bare", "one-eyed", "detected")]
    with Gateway(Inspector([recorded, *others])).running() as url:
        yield url


def model(page: "Page", frame: Any, mode: str) -> Any:
    """What the page's own model says of a frame."""
    return page.evaluate(
        """async ([frame, mode]) => {
          const { ImageModel } = await import("/page/image/image_model.js");
          const one = new ImageModel(frame, mode, { width: 1241, height: 376 });
          const { about, isPossible, mapped, vectors, observed } = one;
          const failed = { missed: one.missedDetections, false: one.falsePositives };
          return { about, isPossible, mapped, ...failed, vectors, seen: observed.length };
        }""",
        [frame, mode],
    )


def test_right_image_differs_by_the_disparity_of_each_element(run: Run) -> None:
    rig, result = run.info.rig, run.frames[0].localization
    assert rig.T_right_left is not None
    assert result.T_camera_map is not None
    left = frame_view(run, 0).mapped
    right = right_view(run, 0)
    depth = result.T_camera_map.apply(result.submap.anchor_m)[:, 2]
    compared = 0
    for row, (a, b) in enumerate(zip(left, right, strict=True)):
        if a.estimate and b.estimate and depth[row] > 1.0:
            shift = np.subtract(a.estimate[0], b.estimate[0])
            expected = rig.left.K[0, 0] * rig.baseline_m / depth[row]
            assert shift == pytest.approx([expected, 0.0], abs=0.05)
            compared += 1
    assert compared > 5


def test_neighbours_show_the_selected_element_in_each_frame(run: Run) -> None:
    element = int(run.frames[1].localization.submap.id[0])
    seen_in = [element in frame.element_id for frame in run.frames]
    state = State().opened("first", run, FRAMES[1]).with_selection(None, element, run)
    shown = neighbours_view(run, state)
    assert [neighbour.position for neighbour in shown] == [0, 1, 2]
    for neighbour, is_seen in zip(shown, seen_in, strict=True):
        if is_seen and neighbour.seen and neighbour.mapped:
            assert neighbour.seen.place[0] == pytest.approx(neighbour.mapped.place[0], abs=60)
    nothing = neighbours_view(run, State().opened("first", run, FRAMES[0]))
    assert [(neighbour.position, neighbour.seen, neighbour.mapped) for neighbour in nothing] == [
        (0, None, None), (1, None, None), (2, None, None),
    ]  # fmt: skip


def test_what_is_behind_the_camera_is_said_to_be_there(run: Run) -> None:
    result = run.frames[0].localization
    assert result.T_camera_map is not None
    ends = (result.submap.anchor_m, result.submap.end_m)
    depth = np.fmax(*(result.T_camera_map.apply(end)[:, 2] for end in ends))
    behind = [row.behind for row in frame_view(run, 0).mapped]
    assert any(behind)
    assert behind == (depth < 0.5).tolist()


def test_wishes_for_images_that_are_not_there_are_refused(run: Run) -> None:
    for wrong in ('"mode": "x-rays"', '"side": "upper"', '"neighbours": 1'):
        with pytest.raises(MalformedRequestError, match="set_image"):
            HANDLERS.decode(f'{{"type": "set_image", "id": "1", {wrong}}}')
    state = State().opened("first", run, None)
    right = state.with_image("truth", "right", True)
    assert right.opened("second", run, None).side == "right"
    assert right.opened("second", one_eyed(run), None).side == "left"


def test_images_come_as_they_were_recorded_or_with_a_reason(run: Run, recorded: Path) -> None:
    here = RunImages(run, recorded)
    assert here.response(1, "left").body == run.frames[1].image
    assert here.response(1, "right").body == run.frames[1].image_right
    assert here.response(1, "left").content_type == "image/jpeg"
    bare = RunImages(load_run(recorded.with_name("bare.rrd")), recorded)
    missing = bare.response(0, "left")
    assert (missing.status, missing.content_type) == (200, "text/plain")
    assert missing.text == "This run was recorded without images."
    png = bytes(cv2.imencode(".png", np.zeros((4, 6), np.uint8))[1])
    (recorded.parent / "10.png").write_bytes(png)
    named = replace(run.frames[0], image=None, image_file="10.png")
    there = RunImages(replace(run, frames=(named,)), recorded).response(0, "left")
    assert (there.content_type, there.body) == ("image/png", png)


@pytest.mark.browser
def test_the_three_pictures_of_the_paper(url: str, page: "Page", run: Run) -> None:
    """Map under the truth; pairs with outliers; from the truth to the estimate."""
    open_blank(page, url)
    frame = frame_view(run, FRAMES.index(MISTAKEN)).model_dump(mode="json")
    truth = model(page, frame, "truth")
    assert truth["mapped"] == [row for row, mapped in enumerate(frame["mapped"]) if mapped["truth"]]
    pairs = model(page, frame, "pairs")
    assert pairs["about"] == f"{len(frame['pairs'])} pairs, 2 outliers"
    assert sum(not pair["fits"] for pair in pairs["vectors"]) == 2
    error = model(page, frame, "error")
    assert error["seen"] == 0
    ends = {
        tuple(point) for mapped in frame["mapped"] for point in mapped["estimate"] or () if point
    }
    assert all(tuple(vector["end"]) in ends for vector in error["vectors"])
    assert len(error["vectors"]) > 10
    assert max(vector["px"] for vector in error["vectors"]) < 20


def test_a_frame_says_what_was_missed_and_made_up(run: Run) -> None:
    record = run.frames[0]
    lost = int(record.element_id[0])
    frame = frame_view(by_detector(run), 0)
    missed = {frame.mapped[row].id for row in frame.missed_detections}
    assert frame.false_positives == (0,)
    assert lost in missed
    assert not missed & set(record.element_id[1:])
    rows = dict(frame.card.rows)
    assert rows["False positives"] == "#0"
    assert "Missed or occluded" in rows
    labelled = frame_view(replace(run, info=replace(run.info, observations="labels")), 0)
    assert (labelled.missed_detections, labelled.false_positives) == ((), ())


@pytest.mark.browser
def test_where_detection_failed_is_marked_in_the_image(url: str, page: "Page", run: Run) -> None:
    open_blank(page, url)
    frame = frame_view(by_detector(run), 0).model_dump(mode="json")
    seen = model(page, frame, "truth")
    missed = frame["missed_detections"]
    assert seen["missed"] == missed
    assert f"{len(missed)} missed, 1 false positive" in seen["about"]
    error = model(page, frame, "error")
    assert (error["missed"], error["false"]) == ([], [])
    open_flat(page, url)
    before = pixels(page, "#image-canvas")
    open_flat(page, url, "run=detected")
    wait_for(page, lambda: in_url(page, "run") == "detected", "the run")
    about = page.locator("#image-about")
    wait_for(page, lambda: "1 false positive" in (about.text_content() or ""), "the marks")
    bitmap = pixels(page, "#image-canvas")
    assert near(bitmap[:-90], CANNOT) > near(before[:-90], CANNOT) + 50
    legend = bitmap[-28:, :270], before[-28:, :270]  # its last line
    assert near(legend[0], CANNOT) > near(legend[1], CANNOT) + 10


@pytest.mark.browser
def test_keys_change_what_is_drawn(url: str, page: "Page") -> None:
    open_flat(page, url)
    about = page.locator("#image-about")
    counts = {}
    for key, mode in zip("1234", ("estimate", "truth", "pairs", "error"), strict=True):
        page.keyboard.press(key)
        button = page.locator(f"[data-mode={mode}]")
        wait_for(page, lambda: button.get_attribute("aria-pressed") == "true", mode)  # noqa: B023
        settle(page)
        bitmap = pixels(page, "#image-canvas")[:-80]  # without the legend
        counts[mode] = (near(bitmap, SEEN), near(bitmap, ESTIMATE))
    assert all(counts[mode][0] > 100 for mode in ("estimate", "truth", "pairs"))
    assert counts["error"][0] < counts["estimate"][0] / 5
    assert counts["estimate"][1] > counts["truth"][1] + 20
    assert counts["error"][1] > counts["truth"][1] + 20
    assert "from true pose to estimate" in (about.text_content() or "")


@pytest.mark.browser
def test_modes_without_what_they_need_say_so(url: str, page: "Page", run: Run) -> None:
    open_blank(page, url)
    blind = replace(run.frames[0], frame=replace(run.frames[0].frame, T_map_camera=None))
    frame = frame_view(replace(run, frames=(blind,)), 0).model_dump(mode="json")
    assert model(page, frame, "truth")["about"].startswith("no ground truth")
    assert model(page, frame, "error")["about"].startswith("no ground truth")
    pairs = model(page, frame, "pairs")
    assert pairs["about"] == f"{len(frame['pairs'])} pairs, 0 outliers"


@pytest.mark.browser
def test_ends_are_hidden_or_cut_off_by_the_border(url: str, page: "Page") -> None:
    open_blank(page, url)
    states = page.evaluate(
        """async () => {
          const { endState } = await import("/page/image/image_model.js");
          const size = { width: 100, height: 50 };
          const unknown = [[50, 49], [-0.5, 20], [50, 30]].map((end) => endState(false, end, size));
          return [endState(true, [50, 49], size), ...unknown];
        }"""
    )
    assert states == ["known", "cut", "cut", "hidden"]


@pytest.mark.browser
def test_right_image_has_the_map_and_no_detections(url: str, page: "Page") -> None:
    def shown() -> np.ndarray:
        return pixels(page, "#image-canvas")[:-80]  # without the legend

    open_flat(page, url)
    before = shown()
    page.keyboard.press("k")
    title = page.locator("#image-title")
    wait_for(page, lambda: title.text_content() == "Right image", "the right image")
    wait_for(page, lambda: near(shown(), SEEN) < near(before, SEEN) / 5, "no detections")
    wait_for(page, lambda: shown().std() > 20, "its picture")
    right = shown()
    assert "detections are of the left" in (page.locator("#image-about").text_content() or "")
    assert near(right, ESTIMATE) > 50
    page.keyboard.press(".")
    wait_for(page, lambda: in_url(page, "frame") == "12", "frame 12")
    wait_for(page, lambda: np.abs(shown() - right).mean() > 5, "its picture")
    page.select_option("#run", "one-eyed")
    wait_for(page, lambda: title.text_content() == "Image", "the only image")
    assert not page.locator("#image-side").is_visible()


@pytest.mark.browser
def test_images_around_lead_to_their_frames(url: str, page: "Page") -> None:
    open_flat(page, url)
    assert not page.locator("#neighbours").is_visible()
    page.keyboard.press("Shift+K")
    wait_for(page, lambda: page.locator("#neighbours").is_visible(), "the strip")
    wait_for(page, lambda: pixels(page, "#neighbours-canvas").std() > 20, "the images")
    strip = pixels(page, "#neighbours-canvas")
    page.keyboard.press("Tab")  # selects: the images are cut out around it
    wait_for(page, lambda: changed(page, "#neighbours-canvas", strip) > 5, "the cut images")
    box = page.locator("#neighbours-canvas").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + box["width"] - 30, box["y"] + 20)
    wait_for(page, lambda: in_url(page, "frame") == str(FRAMES[-1]), "the last frame")


@pytest.mark.browser
def test_a_run_without_images_is_drawn_and_asks_for_nothing_in_vain(url: str, page: "Page") -> None:
    failed: list[str] = []
    page.on("response", lambda result: failed.append(result.url) if result.status >= 400 else None)
    open_flat(page, url, "run=bare")
    wait_for(page, lambda: in_url(page, "run") == "bare", "the run")
    assert "without images" in (page.locator("#image-about").text_content() or "")
    assert near(pixels(page, "#image-canvas"), SEEN) > 50
    page.keyboard.press(".")
    wait_for(page, lambda: in_url(page, "frame") == "12", "frame 12")
    page.wait_for_timeout(300)
    assert failed == []
