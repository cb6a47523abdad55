"""The page's proposals on a simulated street: accepted, rejected, kept through failures."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from annotator_page import SIDES, WAIT_MS, Served, annotating, true_detections
from journeys.driver import POLE, ROUNDED, TRIANGULAR, LabelDriver, Pixel, Side
from streets import street_workspace

from semviz.annotator.proposals import image_worker, label_proposals
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import new_id
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import Proposals, save_proposals
from semviz_core.base.camera import Rig
from semviz_core.simulation.street import Street

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
NEAR_M = 25.0


def poles(served: Served, frame: int, near_m: float = NEAR_M) -> list[tuple[int, Pixel, Pixel]]:
    """Id, peak and bottom in the left image of the poles that are near and whole in both."""
    street = street_of(served)
    pose = street.frames[frame].T_map_camera
    assert pose is not None
    elements = street.truth_map.elements
    depths = pose.inverse().apply(elements.anchor_m)[:, 2]
    near = set(elements.id[depths < near_m].tolist())
    right, right_ids = street.labels(frame, "right")
    whole = set(right_ids[right.anchor_known & right.end_known].tolist())
    seen, ids = street.labels(frame, "left")
    rows = np.flatnonzero(seen.anchor_known & seen.end_known & (seen.class_id == POLE))
    return [
        (int(ids[row]), tuple(seen.anchor_px[row]), tuple(seen.end_px[row]))
        for row in rows
        if ids[row] in near & whole
    ]


def street_of(served: Served) -> Street:
    """With what is truly to be seen, also where the page has only one camera of it."""
    source = served.annotator.session.source
    return getattr(source, "street", source)


def truth(street: Street, frame: int, side: Side, element: int) -> tuple[np.ndarray, np.ndarray]:
    seen, ids = street.labels(frame, side)
    (row,) = np.flatnonzero(ids == element)
    return seen.anchor_px[row], seen.end_px[row]


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return street_workspace(tmp_path / "street", 7, 6)


def draw_first(driver: LabelDriver, served: Served) -> int:
    """The first pole of the street, in the left image only; its id there."""
    element, peak, bottom = poles(served, 0)[0]
    assert driver.draw_pole("left", peak, bottom) == "P-01"
    return element


def wait_for_search(driver: LabelDriver) -> None:
    """Until the images of the frame on screen were searched for all that is proposed."""
    driver.page.wait_for_function(
        """() => {
            const { frame, labels } = semviz.state;
            return labels.frame.index === frame && !labels.frame.is_searching;
        }""",
        timeout=WAIT_MS,
    )


def wait_for_score(driver: LabelDriver, name: str) -> None:
    driver.page.wait_for_selector(f'#elements .row:has-text("{name}") .score')


def test_the_correspondence_is_proposed_and_one_key_accepts_it(
    driver: LabelDriver, served: Served
) -> None:
    element = draw_first(driver, served)
    wait_for_score(driver, "P-01")
    assert len(served.labels.observations) == 1  # a proposal is no label
    driver.press_and_save("Space")
    (row,) = served.labels.in_frame(0, "right")
    peak, bottom = truth(street_of(served), 0, "right", element)
    across = np.array([1.0, 0.0])
    assert abs((row.anchor_px - peak) @ across) < 1.0
    assert abs((row.end_px - bottom) @ across) < 1.0
    assert len(served.labels.elements) == 1
    driver.press_and_save("Control+z")
    assert served.labels.in_frame(0, "right") == ()


@pytest.mark.parametrize("key", ["Control+Enter", "Control+Shift+Enter"])
def test_one_key_takes_the_sure_ones_and_goes_on(
    driver: LabelDriver, served: Served, key: str
) -> None:
    draw_first(driver, served)
    wait_for_score(driver, "P-01")
    driver.press_and_save(key)
    driver.page.wait_for_function("() => semviz.state.frame === 1")
    driver.page.wait_for_function("() => semviz.state.pending.length === 0")
    assert len(served.labels.in_frame(0, "right")) == 1
    assert served.labels.review(0) == "reviewed"


def test_what_was_never_in_view_is_looked_at_before_it_is_accepted(
    page: "Page", workspace: Workspace
) -> None:
    """The key then shows the whole image instead; what was in view before zooming in is taken."""
    save_proposals(true_detections(workspace.street, 0, SIDES), workspace.proposals_path)
    with annotating(workspace) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        page.wait_for_function("() => semviz.state.confidentProposals.length > 1")
        wait_for_search(driver)
        zoom_in = "semviz.images.zoomTo([[2, 2], [6, 6]])"
        never = "semviz.images.seen.marks.clear()"  # as if the frame was opened zoomed in
        page.evaluate(f"() => {{ {never}; {zoom_in}; }}")
        page.keyboard.press("Control+Enter")
        page.wait_for_selector("#message:has-text('out of view: look at')")
        assert not served.labels.observations
        driver.settle()
        whole = driver.view("left").scale
        page.evaluate(f"() => {zoom_in}")
        driver.press_and_save("Control+Enter")  # all was in view
        page.wait_for_function("() => semviz.state.frame === 1")
        assert len(served.labels.observations) > 1
        driver.settle()
        assert driver.view("left").scale == pytest.approx(whole)
        page.goto("about:blank")


def test_only_the_key_for_all_takes_weak_ones_and_goes_on(
    driver: LabelDriver, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_first(driver, served)
    wait_for_score(driver, "P-01")
    driver.press_and_save("Space")
    monkeypatch.setattr(label_proposals, "SURE", 1.0)  # all are weak
    driver.goto(3)
    wait_for_search(driver)
    state = "({ confidentProposals: sure, foundProposals: all }) => [sure.length, all.length]"
    assert driver.page.evaluate(f"({state})(semviz.state)") == [0, 1]
    driver.page.keyboard.press("Control+Enter")
    driver.page.wait_for_selector("#message:has-text('frame 3 has no labels')")
    driver.page.wait_for_function("() => semviz.state.frame !== 3")
    wait_for_search(driver)  # it went on; an answer about that frame must not come later
    driver.goto(3)
    wait_for_search(driver)
    driver.page.wait_for_function("() => semviz.state.foundProposals.length === 1")
    driver.settle()
    driver.press_and_save("Control+Shift+Enter")
    driver.page.wait_for_function("() => semviz.state.labels.frames[3].state === 'reviewed'")
    assert len(served.labels.in_frame(3, "left")) == 1
    assert served.labels.review(3) == "reviewed"


def test_one_key_accepts_weak_ones_too_and_the_nearest_view_offers_to_align_the_others(
    driver: LabelDriver, served: Served
) -> None:
    draw_first(driver, served)
    wait_for_score(driver, "P-01")
    driver.press_and_save("Shift+G")
    assert len(served.labels.in_frame(0, "right")) == 1
    driver.goto(3)
    wait_for_score(driver, "P-01")
    page = driver.page
    driver.settle()
    weak = page.evaluate("semviz.state.foundProposals.length")
    assert weak >= 1
    before = driver.operation
    driver.press_and_save("Shift+G")
    assert driver.operation == before + 1
    page.locator('#elements .row:has-text("P-01")').first.click()
    page.wait_for_selector('#card button:has-text("Align 2 labels farther away")')
    page.keyboard.press("Shift+R")
    message = "document.querySelector('#message').textContent"
    page.wait_for_function(f"() => /Aligned . label|no label moves/i.test({message})")


def test_a_mapped_element_is_followed_into_the_next_frame(
    driver: LabelDriver, served: Served
) -> None:
    element = draw_first(driver, served)
    wait_for_score(driver, "P-01")
    driver.press_and_save("Space")
    driver.goto(1)
    wait_for_score(driver, "P-01")
    before = driver.operation
    driver.press_and_save("Space")
    assert driver.operation == before + 1  # both images in one operation
    for side in ("left", "right"):
        (row,) = served.labels.in_frame(1, side)
        peak, _ = truth(street_of(served), 1, side, element)
        assert abs(row.anchor_px[0] - peak[0]) < 2.0
    assert "Accept P-01" in driver.page.inner_text("#history .row >> nth=0")


def test_one_key_accepts_what_a_detector_found_in_both_images(
    page: "Page", workspace: Workspace
) -> None:
    """One of its detections, then all that are sure; the next frame knows them by their names."""
    found = true_detections(workspace.street, 0, SIDES).joined(
        true_detections(workspace.street, 1, SIDES)
    )
    save_proposals(found, workspace.proposals_path)
    with annotating(workspace) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        page.wait_for_function("() => semviz.state.confidentProposals.length > 1")
        driver.settle()
        page.locator('#elements .row:has-text("new pole"):has(.score)').last.click()
        before = driver.operation
        driver.press_and_save("Space")
        assert driver.operation == before + 1  # both images in one operation
        (element,) = served.labels.elements
        assert {row.side for row in served.labels.of_element(element)} == set(SIDES)
        assert served.labels.elements[element].class_id == POLE
        driver.press_and_save("Control+Enter")
        page.wait_for_function("() => semviz.state.frame === 1")
        driver.settle()
        assert len(served.labels.elements) > 1
        for element in served.labels.elements:
            assert {row.side for row in served.labels.of_element(element)} == set(SIDES)
        proposed = served.annotator.session.frame(1).proposals
        mapped = {proposal.name for proposal in proposed if proposal.origin == "map"}
        assert "P-01" in mapped
        assert len(mapped) > len(
            [proposal for proposal in proposed if proposal.origin == "detector"]
        )
        page.goto("about:blank")


def test_the_proposal_nearest_to_the_pointer_is_the_one_that_keys_are_for(
    page: "Page", workspace: Workspace
) -> None:
    """Also where another's handle is within reach, and where something is labelled there."""
    pole, sign = ((620.0, 320.0), (620.0, 350.0)), (627.0, 335.0)
    planted = [
        Proposal(new_id(), 0, "left", POLE, *pole, True, True, 0.9, 1.0),
        Proposal(new_id(), 0, "left", ROUNDED, sign, None, True, False, 0.9, 1.0),
    ]
    save_proposals(Proposals.of(planted), workspace.proposals_path)
    with annotating(workspace) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        page.wait_for_function(
            "() => semviz.state.proposals.filter(({ score }) => score !== null).length === 2"
        )
        assert under_pointer(driver, (620.0, 335.0)) == POLE
        assert under_pointer(driver, sign) == ROUNDED
        driver.draw_sign("left", (613.0, 335.0), TRIANGULAR)
        assert under_pointer(driver, (617.0, 335.0)) == POLE
        page.goto("about:blank")


def under_pointer(driver: LabelDriver, at: Pixel) -> int:
    """The class of the proposal that the keys are for while the pointer is there."""
    driver.page.mouse.move(*driver.view("left").screen(at))
    driver.settle()
    assert driver.page.evaluate("() => semviz.state.pointed !== null")
    return int(driver.page.evaluate("() => semviz.state.currentProposal.class_id"))


def test_the_jump_list_leads_to_where_the_detector_disagrees(
    page: "Page", workspace: Workspace
) -> None:
    at = (620.0, 330.0)
    planted = Proposal(new_id(), 3, "left", ROUNDED, at, None, True, False, 0.9, 1.0)
    save_proposals(Proposals.of([planted]), workspace.proposals_path)
    with annotating(workspace) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        page.click("#jumps .row:has-text('Detector disagrees'):has(.dim:text-is('1'))")
        page.wait_for_selector('.tile.current[data-frame="3"]')
        page.wait_for_function("() => semviz.state.currentProposal?.name === 'new rounded sign'")
        page.goto("about:blank")


def test_the_page_does_not_wait_for_a_search_that_failed(
    driver: LabelDriver,
    served: Served,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The element is expected there, without a score."""
    draw_first(driver, served)
    wait_for_score(driver, "P-01")
    driver.press_and_save("Space")

    def failing(*_arguments: object, **_options: object) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr(image_worker, "propagate", failing)
    driver.goto(1)
    wait_for_search(driver)
    (proposal,) = driver.page.evaluate(
        "semviz.state.proposals.map(({ name, score }) => [name, score])"
    )
    assert proposal == ["P-01", 0]
    assert "an image search failed" in caplog.text


@pytest.mark.parametrize(("key", "why"), [("x", "rejected"), ("n", "absent"), ("o", "occluded")])
def test_a_rejection_holds_until_it_is_undone(
    driver: LabelDriver, served: Served, key: str, why: str
) -> None:
    draw_first(driver, served)
    wait_for_score(driver, "P-01")
    driver.press_and_save("Space")
    driver.goto(1)
    wait_for_score(driver, "P-01")
    driver.press_and_save(key)
    assert {dismissal.why for dismissal in served.labels.dismissed_in(1)} == {why}
    driver.page.reload()
    driver.page.wait_for_selector("#saved.saved")
    driver.page.wait_for_selector("#elements-about:has-text('0 here')")
    driver.settle()
    assert "proposed" not in driver.page.inner_text("#elements-about")
    driver.press_and_save("Control+z")
    wait_for_score(driver, "P-01")


def test_a_click_beside_a_pole_snaps_to_its_axis(served: Served, page: "Page") -> None:
    driver = LabelDriver(page)
    driver.open(served.url, with_snap=True)
    element, peak, bottom = poles(served, 0)[0]
    driver.draw_pole("left", (peak[0] + 1.5, peak[1]), (bottom[0] - 1.5, bottom[1]))
    (row,) = served.labels.observations.values()
    true = truth(street_of(served), 0, "left", element)
    assert row.end_px is not None
    for drawn, at in zip((row.anchor_px, row.end_px), true, strict=True):
        assert abs(drawn[0] - at[0]) < 0.5
    page.keyboard.press("m")
    driver.clear_selection()
    driver.draw_sign("left", (700.0, 120.0), ROUNDED)
    free = [
        observation
        for observation in served.labels.observations.values()
        if observation.end_px is None
    ]
    np.testing.assert_allclose(free[0].anchor_px, (700.0, 120.0), atol=0.05)


def test_a_bottom_behind_a_car_is_hidden_unless_one_says_it_is_not(
    page: "Page", tmp_path: Path
) -> None:
    """The ground is known from two poles that are whole; one key says otherwise."""
    behind_car, whole = 20, (14, 15)
    with annotating(street_workspace(tmp_path / "cars", 2, 8)) as served:
        driver = LabelDriver(page)
        driver.open(served.url, with_snap=True)
        street = street_of(served)
        for element in whole:
            driver.draw_pole("left", *(tuple(point) for point in truth(street, 0, "left", element)))
        driver.settle()
        peak, bottom = (tuple(point) for point in truth(street, 0, "left", behind_car))
        driver.draw_pole("left", peak, bottom)
        known = [row.end_known for row in served.labels.in_frame(0, "left")]
        assert known == [True, True, False]
        driver.press_and_save("Control+z")
        driver.clear_selection()
        page.keyboard.press("1")
        driver.click_at("left", peak)
        page.mouse.move(*driver.view("left").screen(bottom))
        page.wait_for_function("() => semviz.state.preview?.snapped?.end_known === false")
        page.keyboard.press("o")
        page.wait_for_function("() => semviz.state.preview?.snapped?.end_known !== false")
        before = driver.operation
        driver.click_at("left", bottom)
        driver.wait_saved(before)
        assert all(row.end_known for row in served.labels.in_frame(0, "left"))
        page.goto("about:blank")


def test_a_reload_in_mid_drawing_loses_nothing(driver: LabelDriver, served: Served) -> None:
    _, peak, bottom = poles(served, 0)[0]
    driver.page.keyboard.press("1")
    driver.click_at("left", peak)
    driver.page.wait_for_selector("#left-image .status:has-text('second click sets the bottom')")
    driver.page.reload()
    driver.page.wait_for_selector("#left-image .status:has-text('second click sets the bottom')")
    driver.page.keyboard.press("m")
    before = driver.operation
    driver.click_at("left", bottom)
    driver.wait_saved(before)
    (row,) = served.labels.observations.values()
    np.testing.assert_allclose((row.anchor_px, row.end_px), (peak, bottom), atol=1.0)


def test_the_queue_keeps_its_order_though_the_clock_goes_back(
    driver: LabelDriver, served: Served
) -> None:
    driver.draw_sign("left", (700.0, 120.0), ROUNDED)
    served.annotator.lock.acquire()
    try:
        driver.page.keyboard.press("Shift+ArrowRight")
        driver.page.evaluate("const then = Date.now() - 9e6; Date.now = () => then")
        driver.page.keyboard.press("Shift+ArrowRight")
        driver.page.keyboard.press("Shift+ArrowDown")
        driver.page.wait_for_selector("#saved:has-text('3')")
    finally:
        served.annotator.lock.release()
    driver.page.wait_for_selector("#saved:has-text('Saved operation 4')")
    (row,) = served.labels.observations.values()
    np.testing.assert_allclose(row.anchor_px, (702.0, 121.0), atol=0.05)


def test_jump_lists_lead_to_the_frames_that_want_a_visit(
    driver: LabelDriver, served: Served
) -> None:
    driver.draw_sign("left", (700.0, 120.0), ROUNDED)
    driver.press_and_save("Enter")
    rows = driver.page.locator("#jumps .row")
    driver.page.wait_for_selector("#jumps .row:has-text('Unreviewed'):has-text('5')")
    assert "6" in rows.nth(2).inner_text()  # under 4 elements
    driver.page.keyboard.press("Shift+Period")
    driver.page.wait_for_selector('.tile.current[data-frame="1"]')
    driver.page.keyboard.press("j")
    driver.page.wait_for_selector("#jumps .row.chosen:has-text('Worst residual')")


def test_one_camera_is_labelled_in_two_frames(page: "Page", workspace: Workspace) -> None:
    """The second image is another frame of the same camera, and its labels are that frame's."""

    class OneCamera:
        def __init__(self, source: Street) -> None:
            self.frames, self.map_frame = source.frames, source.map_frame
            self.rig, self.street = Rig(source.rig.left), source

        def image(self, index: int, side: Side) -> np.ndarray:
            return self.street.image(index, side)

    street = workspace.street
    workspace.__dict__["source"] = OneCamera(street)
    with annotating(workspace) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        page.wait_for_selector("#right-image h2:has-text('Frame 3')")
        later = {pole for pole, _, _ in poles(served, 3, 60.0)}
        element, peak, bottom = next(pole for pole in poles(served, 0, 60.0) if pole[0] in later)
        driver.draw_pole("left", peak, bottom)
        wait_for_score(driver, "P-01")
        there = truth(street, 3, "left", element)
        driver.draw_pole("right", *(tuple(point) for point in there), element="P-01")
        assert sorted(row.frame_index for row in served.labels.observations.values()) == [0, 3]
        (place,) = served.annotator.session.scene.elements().anchor_m
        rows = street.truth_map.elements
        np.testing.assert_allclose(place, rows.anchor_m[rows.id == element][0], atol=0.3)
        page.goto("about:blank")
