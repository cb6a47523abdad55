"""From error to label: a slip in the labels is mended, map and run are made again, and better."""

import asyncio
import shutil
import urllib.error
import urllib.request
from collections.abc import Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import aiohttp
import numpy as np
import pytest

from semviz.demo_labels import AUTHOR, SLIP_PX, demo_labels
from semviz.demo_street import SEED, SPACING_M
from semviz.drive import DriveOptions, drive_workspace, record
from semviz.inspector.mending.labels import Mending
from semviz.inspector.server import Inspector
from semviz.inspector.shelf import Shelf
from semviz.mending import mend_run
from semviz.recording.reader import load_run
from semviz.recording.run import Run
from semviz.trying.over import free_path
from semviz.web.door import Door
from semviz.workspace import TRUTH, Workspace
from semviz_annotation.edits import MoveObservation
from semviz_annotation.mapping.build import build_map
from semviz_core.errors import SemvizError
from semviz_core.map_file import load_map, save_map

if TYPE_CHECKING:
    from playwright.sync_api import Page

Result = TypeVar("Result")
FRAMES = 12
SLIP_FRAME = 6
SLIPPED = 18
"""A pole that every frame shows."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mending") / "town"
    workspace = Workspace.create_street(folder, SEED, range(FRAMES), SPACING_M)
    with workspace.open_labels() as store:
        store.apply(demo_labels(workspace.street, SLIPPED, SLIP_FRAME), AUTHOR)
    built, _ = build_map(workspace.read_labels(), workspace.street)
    save_map(built, workspace.map_path("main"))
    options = DriveOptions(observations="simulated", crop_radius_m=50.0, seed=SEED)
    drive = drive_workspace(workspace, "main", options)
    record(drive, workspace.run_path("search"), workspace=str(folder), map_name="main")
    return folder


@pytest.fixture
def workspace(made: Path, tmp_path: Path) -> Workspace:
    return Workspace.open(shutil.copytree(made, tmp_path / "town"))


def mend(workspace: Workspace) -> None:
    """Somebody puts the two marks of the pole where it stands."""
    with workspace.open_labels() as store:
        element = next(one for one in store.labels.elements.values() if one.number == SLIPPED)
        for row in store.labels.of_element(element.id):
            by = SLIP_PX[row.side]
            end = None if row.end_px is None else (row.end_px[0] - by, row.end_px[1])
            anchor = (row.anchor_px[0] - by, row.anchor_px[1])
            store.apply(MoveObservation(row.id, anchor, end), "anna")


def off_m(workspace: Workspace, run: Run) -> float:
    """How far the pole is mapped from where it stands."""
    truth = load_map(workspace.map_path(TRUTH)).elements
    stands_m, (mapped_m,) = (
        one.anchor_m[one.id == SLIPPED][:, :2] for one in (truth, run.semantic_map.elements)
    )
    return float(np.linalg.norm(mapped_m - stands_m))


def test_a_mended_label_mends_map_and_run(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    run, before = load_run(path), path.read_bytes()
    assert off_m(workspace, run) > 0.5
    unmended = mend_run(run, free_path(path, "mended"), workspace)
    assert unmended.semantic_map.digest == run.semantic_map.digest
    for was, now in zip(run.frames, unmended.frames, strict=True):
        assert now.localization.status == was.localization.status
        assert repr(now.localization.T_camera_map) == repr(was.localization.T_camera_map)
    mend(workspace)
    free = free_path(path, "mended")
    assert free.name == "search-mended-2.rrd"
    mended = mend_run(run, free, workspace)
    assert off_m(workspace, mended) < off_m(workspace, run) / 1.9
    back = load_run(free)
    assert back.complete
    assert back.semantic_map.digest == mended.semantic_map.digest
    assert back.semantic_map.operation == run.semantic_map.operation + 2
    assert [one.image for one in back.frames] == [one.image for one in run.frames]
    assert path.read_bytes() == before
    assert workspace.read_map("main").digest == run.semantic_map.digest


def test_stopping_leaves_nothing(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    before = sorted(path.parent.iterdir())

    def stop(what: str, done: int, of: int) -> None:
        if (what, done) == ("localizing", 5):
            raise SemvizError("Stopped; nothing was changed.")

    with pytest.raises(SemvizError, match="Stopped"):
        mend_run(load_run(path), free_path(path, "mended"), workspace, stop)
    assert sorted(path.parent.iterdir()) == before


def test_edits_are_counted_done_and_taken_back(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    mending = Mending(load_run(path), path)
    assert mending.view() == {"workspace": "town", "edits": 0, "undoable": 0}
    assert mending.place(SLIPPED, frame=11) == (f"P-{SLIPPED}", SLIP_FRAME)
    mending.leave_out(SLIPPED)
    assert mending.view() == {"workspace": "town", "edits": 1, "undoable": 1}
    mended = mend_run(load_run(path), free_path(path, "mended"), workspace)
    assert SLIPPED not in mended.semantic_map.elements.id
    mending.undo()
    assert mending.view() == {"workspace": "town", "edits": 2, "undoable": 0}
    with pytest.raises(SemvizError, match="nothing was changed here"):
        mending.undo()
    with pytest.raises(SemvizError, match="both in the left image"):
        mending.merge((SLIPPED, 19))  # two that one image shows


def test_a_run_whose_labels_are_gone_says_where_they_would_be(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    elsewhere = path.rename(workspace.path.parent / "search.rrd")
    shutil.rmtree(workspace.path)
    run = load_run(elsewhere)
    mending = Mending(replace(run, info=replace(run.info, workspace="gone/town")), elsewhere)
    assert mending.view() == {"workspace": "", "edits": 0, "undoable": 0}
    with pytest.raises(SemvizError, match="not at hand"):
        mending.leave_out(SLIPPED)


def test_new_runs_are_on_offer_under_names_of_their_own(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    shelf = Shelf([path])
    assert shelf.offer(path) == "search"
    other = shutil.copy(path, path.with_name("search-mended-1.rrd"))
    assert shelf.offer(Path(other)) == shelf.offer(Path(other)) == "search-mended-1"
    assert shelf.names == ("search", "search-mended-1")
    same = shutil.copy(path, workspace.path / "search.rrd")
    assert shelf.run(shelf.offer(Path(same))).info.name == "search"
    assert len(shelf.names) == 3


@pytest.fixture
def url(workspace: Workspace) -> Iterator[str]:
    tool = Inspector([workspace.run_path("search")])
    with Door(tool).running() as url:
        yield url
    tool.close()


def finished(work: Coroutine[Any, Any, Result]) -> Result:
    """Its result, from a thread of its own: Playwright has a loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


def asked(url: str, *verbs: dict[str, Any], until: str) -> dict[str, Any]:
    """What the server says last when asked in turn."""

    async def talk() -> dict[str, Any]:
        async with aiohttp.ClientSession() as client, client.ws_connect(f"{url}socket") as page:
            for verb in ({"verb": "open", "theme": "dark"}, *verbs):
                await page.send_json(verb)
            while True:
                message: dict[str, Any] = await page.receive_json(timeout=60)
                assert message["type"] != "error", message["text"]
                if message["type"] == until:
                    return message

    return finished(talk())


def test_the_labels_open_through_the_same_door(url: str) -> None:
    """One port, and so one token, one tunnel: page, pictures and line of the labelling tool."""
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(f"{url}annotate/1/")
    assert refused.value.code == 404
    address = asked(url, {"verb": "label", "element": SLIPPED}, until="label")["label"]
    assert address == f"annotate/1/?frame={SLIP_FRAME}&element=P-{SLIPPED}"
    with urllib.request.urlopen(url + address) as answer:
        assert b"semviz annotate" in answer.read()
    with urllib.request.urlopen(f"{url}annotate/1/image/{SLIP_FRAME}/left.png") as answer:
        assert answer.read(4) == b"\x89PNG"

    async def greeted() -> str:
        async with (
            aiohttp.ClientSession() as client,
            client.ws_connect(f"{url}annotate/1/socket?session=") as page,
        ):
            message: dict[str, Any] = await page.receive_json(timeout=30)
            return str(message["type"])

    assert finished(greeted()) == "session"


@pytest.mark.browser
@pytest.mark.timeout(240)
def test_from_the_error_to_the_label_and_back(url: str, workspace: Workspace, page: "Page") -> None:
    """One flow without a typed command."""
    page.goto(f"{url}?element={SLIPPED}")
    page.wait_for_selector("#frame-list li")
    with page.expect_popup() as opened:
        page.click("[data-tab=selected]")
        page.click("#selected-actions >> text=Open label")
    labels = opened.value
    labels.wait_for_selector(f"#card >> text=P-{SLIPPED}", timeout=60_000)
    mend(workspace)  # as the hand would there; moving marks has tests of its own
    labels.close()
    page.bring_to_front()
    page.evaluate("() => window.dispatchEvent(new Event('focus'))")
    page.wait_for_selector("#mending >> text=2 edits")
    page.click("text=Build the map and localize again")
    page.wait_for_selector("#mending >> text=/search-mended-1: .*change/", timeout=120_000)
    page.click("text=Keep this map")
    page.wait_for_selector("#mending >> text=is now this map")
    kept = workspace.read_map("main")
    assert kept.digest == load_run(workspace.run_path("search-mended-1")).semantic_map.digest
    page.click("text=Side by side")
    page.wait_for_selector(f"#map-change-list >> text=P-{SLIPPED}", timeout=60_000)
