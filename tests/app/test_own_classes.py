"""A class and attributes of a workspace's own: declared, labelled, mapped, localized, exchanged."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pytest
from annotator_page import Served
from command_line import call
from inspector_page import open_flat
from journeys.driver import LabelDriver
from labelled_street import label_street
from streets import street, street_workspace

from semviz.inspector.server import Inspector
from semviz.web.gateway import Gateway
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.edits import SetAttribute, SetClass
from semviz_annotation.labels.labels import LabelElement, Labels
from semviz_core.base.map_file import load_map
from semviz_core.base.semantic_map import SemanticMap

if TYPE_CHECKING:
    from playwright.sync_api import Page

FRAMES = 8
WAIT_MS = 60_000


class Told(NamedTuple):
    """What a command printed."""

    out: str
    err: str


Run = Callable[..., Told]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    def run_(*arguments: object, status: int = 0) -> Told:
        ended, out, err = call(capsys, *arguments)
        assert ended == status, err
        return Told(out, err)

    return run_


@pytest.fixture
def workspace(tmp_path: Path, run: Run) -> Workspace:
    """A labelled street; its longest pole is a gantry of steel, a rectangular sign is a beacon."""
    made = street_workspace(tmp_path / "street", 7, FRAMES)
    label_street(made, street(7, FRAMES), range(FRAMES))
    for arguments in (("gantry",), ("beacon", "--kind", "point")):
        run("classes", "add", made.path, *arguments)
    run("classes", "attribute", made.path, "state", "--choice", "new", "--choice", "bent")
    with made.open_labels() as store:
        pole, sign = (most_labelled(store.labels, class_id) for class_id in (0, 2))
        store.apply(SetClass(pole.id, 4), "ann")
        store.apply(SetClass(sign.id, 5), "ann")
        store.apply(SetAttribute(pole.id, "material", "steel"), "ann")
    return made


def most_labelled(labels: Labels, class_id: int) -> LabelElement:
    elements = [row for row in labels.elements.values() if row.class_id == class_id]
    return max(elements, key=lambda row: (len(labels.of_element(row.id)), -row.number))


def known(semantic_map: SemanticMap) -> dict[int, tuple[str, dict[str, str]]]:
    """Class and attributes of each element, by its id."""
    elements, classes = semantic_map.elements, semantic_map.classes
    return {
        id_: (classes[class_id].name, dict(semantic_map.attributes.get(id_, {})))
        for id_, class_id in zip(elements.id.tolist(), elements.class_id.tolist(), strict=True)
    }


def test_classes_and_attributes_go_through_map_files_and_runs(
    workspace: Workspace, run: Run
) -> None:
    labels = workspace.read_labels()
    gantry, beacon = (most_labelled(labels, class_id) for class_id in (4, 5))
    run("map", "build", workspace.path)
    built = load_map(workspace.map_path("main"))
    found = known(built)
    assert found[gantry.number] == ("gantry", {"material": "steel"})
    assert found[beacon.number] == ("beacon", {})
    for ending in ("geojson", "osm", "csv"):
        file = workspace.path / f"main.{ending}"
        anchor = () if ending == "csv" else ("--anchor", "49.0,8.4,110")
        run("map", "export", workspace.path, file, *anchor)
        run("map", "import", workspace.path, file, "--name", ending, *anchor)
        assert known(load_map(workspace.map_path(ending))) == found
    told = run("map", "export", workspace.path, workspace.path / "main.ply")
    assert "dropped: 1 x attributes" in told.out
    run("localize", workspace.path, "--frames", "0:2", "--observations", "labels")
    learned = run("localize", workspace.path, "--frames", "0:2", "--method", "learned")
    assert "its network was not trained for" in learned.err
    from semviz.runs.reader import load_run

    recorded = load_run(workspace.run_path("search"))
    assert known(recorded.semantic_map) == found
    assert {record.localization.status for record in recorded.frames} == {"ok"}
    assert {4, 5} & {
        class_id
        for record in recorded.frames
        for class_id in record.localization.observed.class_id.tolist()
    }


@pytest.mark.parametrize(
    ("format_", "file"), [("cvat", "a.xml"), ("coco", "a.json"), ("labelme", "a")]
)
def test_labels_come_back_with_class_and_attributes(
    workspace: Workspace, tmp_path: Path, format_: str, file: str, run: Run
) -> None:
    before = workspace.read_labels()
    run("labels", "export", workspace.path, tmp_path / file, "--format", format_)
    other = street_workspace(tmp_path / "other", 7, FRAMES)
    unknown = run("labels", "import", other.path, tmp_path / file, status=2)
    assert "not known" in unknown.err
    run("classes", "add", other.path, "gantry")
    run("classes", "add", other.path, "beacon", "--kind", "point")
    run("labels", "import", other.path, tmp_path / file)
    after = other.read_labels()
    assert after.elements == before.elements
    assert after.attributes == before.attributes
    assert len(after.observations) == len(before.observations)
    again = run("labels", "import", other.path, tmp_path / file)
    assert "0 labels" in again.out


def test_boxes_are_kept_and_exported_again(tmp_path: Path, run: Run) -> None:
    """Also what KITTI-360 calls its classes, by name and by id."""
    names = {1: "17", 2: "20", 3: "smallpole", 4: "lamp"}
    boxes = {1: [10, 20, 6, 90], 2: [200, 50, 30, 40], 3: [90, 20, 6, 90], 4: [150, 20, 6, 90]}
    fresh = street_workspace(tmp_path / "fresh", 7, FRAMES)
    camera = fresh.source.rig.left
    size = {"width": camera.width, "height": camera.height}
    content = {
        "images": [{"id": 1, "file_name": "left/000003.png", **size}],
        "categories": [{"id": id_, "name": name} for id_, name in names.items()],
        "annotations": [
            {"id": id_, "image_id": 1, "category_id": id_, "bbox": box, "track_id": id_,
             "attributes": {"material": "wood", "occluded": False}}
            for id_, box in boxes.items()
        ],
    }  # fmt: skip
    file = tmp_path / "boxes.json"
    file.write_text(json.dumps(content))
    told = run("labels", "import", fresh.path, file)
    assert "signs called '20', without a shape: rectangular" in told.out
    labels = fresh.read_labels()
    assert sorted(row.class_id for row in labels.elements.values()) == [0, 0, 0, 2]
    assert {row.value for row in labels.attributes.values()} == {"wood"}
    assert len(labels.outlines) == 4
    for format_, name in (("cvat", "a.xml"), ("coco", "a.json"), ("labelme", "a")):
        run("labels", "export", fresh.path, tmp_path / name, "--format", format_)
        other = street_workspace(tmp_path / f"other-{format_}", 7, FRAMES)
        run("labels", "import", other.path, tmp_path / name)
        shapes = {(row.form, row.points_px) for row in other.read_labels().outlines.values()}
        assert shapes == {(row.form, row.points_px) for row in labels.outlines.values()}
    told = run("labels", "export", fresh.path, tmp_path / "a.csv")
    assert "dropped: 4 x boxes and polygons" in told.out
    assert "attribute:material" in (tmp_path / "a.csv").read_text().splitlines()[0]


@pytest.mark.browser
def test_a_page_shows_draws_and_describes_an_own_class(served: Served, page: "Page") -> None:
    driver = LabelDriver(page)
    driver.open(served.url)
    labels = served.labels
    gantry = most_labelled(labels, 4)
    classes = page.locator("#classes .row")
    assert classes.count() == 6
    assert classes.nth(4).inner_text().split() == ["5", "Gantry", "1"]
    page.keyboard.press("6")
    assert page.evaluate("() => semviz.state.classId") == 5
    page.evaluate("(id) => semviz.select(id)", gantry.id)
    attributes = page.locator("#attributes")
    attributes.get_by_text("steel").wait_for(timeout=WAIT_MS)
    attributes.get_by_role("button", name="+").click()
    attributes.get_by_label("Attribute", exact=True).fill("state")
    attributes.get_by_label("Attribute", exact=True).press("Tab")
    attributes.get_by_label("Value").select_option("bent")
    attributes.get_by_role("button", name="Set").click()
    attributes.get_by_text("bent").wait_for(timeout=WAIT_MS)
    values = {row.name: row.value for row in served.labels.attributes_of(gantry.id)}
    assert values == {"material": "steel", "state": "bent"}
    page.keyboard.press("Control+z")
    attributes.get_by_text("bent").wait_for(state="detached", timeout=WAIT_MS)
    page.keyboard.press("F3")
    for text in ("class:gantry", "attr:material=steel"):
        page.locator("#track-search").fill(text)
        page.wait_for_function(
            "(name) => semviz.tracks.shown.length === 1 && semviz.tracks.shown[0].name === name",
            arg=f"G-{gantry.number:02}", timeout=WAIT_MS,
        )  # fmt: skip


@pytest.mark.browser
def test_a_class_declared_meanwhile_reaches_the_open_page(
    served: Served, page: "Page", run: Run
) -> None:
    LabelDriver(page).open(served.url)
    run("classes", "add", served.annotator.session.workspace.path, "bollard", "--letter", "Q")
    page.locator("#classes .row").nth(6).wait_for(timeout=WAIT_MS)
    page.keyboard.press("7")
    assert page.evaluate("() => semviz.state.classOf(semviz.state.classId).name") == "bollard"


@pytest.mark.browser
def test_the_inspector_shows_and_filters_own_classes_in_the_light_theme(
    workspace: Workspace, run: Run, page: "Page"
) -> None:
    run("map", "build", workspace.path)
    run("localize", workspace.path, "--frames", "0:2")
    page.emulate_media(color_scheme="light")
    with Gateway(Inspector([workspace.run_path("search")])).running() as url:
        open_flat(page, url, "&frame=0")
        kinds = {kind.name: kind for kind in workspace.read_labels().own_classes.values()}
        page.click("[data-tab=elements]")
        for name, kind in kinds.items():
            chip = page.locator(f"button.chip[title='{name}']")
            chip.click(timeout=WAIT_MS)
            assert kind.color_light.lower() in chip.inner_html().lower()
            chosen = page.locator("#element-classes .chip[aria-pressed=true]")
            assert chosen.get_attribute("title") == name
        page.goto("about:blank")
