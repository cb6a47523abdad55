"""From error to label: a slip in the labels is repaired, map and run are made again, and better."""

import asyncio
import shutil
import threading
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
from inspector_page import open_page
from serving import at

from semviz.inspector.context import RunLibrary
from semviz.inspector.label_repair import RunLabels
from semviz.inspector.messages import (
    ExcludeElementRequest,
    GetLabelEditsRequest,
    OpenLabelRequest,
    OpenRunRequest,
)
from semviz.inspector.server import Inspector
from semviz.runs.reader import load_run
from semviz.runs.run import Run
from semviz.web.gateway import Gateway
from semviz.web.protocol import Request
from semviz.what_if.solve import free_path
from semviz.workspace.demo import AUTHOR, SEED, SLIP_PX, SPACING_M, demo_labels
from semviz.workspace.localization.localize import LocalizeOptions, localize_workspace, record
from semviz.workspace.localization.rebuild import rebuild_run
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_annotation.labels.edits import DecideElements, MoveObservation, RevokeDecision
from semviz_annotation.labels.rows import review_decision
from semviz_annotation.mapping.build import build_map
from semviz_annotation.storage.backup import backup_labels, restore_labels
from semviz_annotation.storage.store import EditBase, ReplacedLogError
from semviz_core.base.map_file import load_map, save_map
from semviz_core.common.errors import SemvizError

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
    options = LocalizeOptions(observations="simulated", crop_radius_m=50.0, seed=SEED)
    drive = localize_workspace(workspace, "main", options)
    record(drive, workspace.run_path("search"), workspace=str(folder), map_name="main")
    return folder


@pytest.fixture
def workspace(made: Path, tmp_path: Path) -> Workspace:
    return Workspace.open(shutil.copytree(made, tmp_path / "town"))


def repair(workspace: Workspace) -> None:
    """Somebody puts the two marks of the pole where it stands."""
    with workspace.open_labels() as store:
        element = next(
            element for element in store.labels.elements.values() if element.number == SLIPPED
        )
        for row in store.labels.of_element(element.id):
            by = SLIP_PX[row.side]
            end = None if row.end_px is None else (row.end_px[0] - by, row.end_px[1])
            anchor = (row.anchor_px[0] - by, row.anchor_px[1])
            store.apply(MoveObservation(row.id, anchor, end), "anna")


def off_m(workspace: Workspace, run: Run) -> float:
    """How far the pole is mapped from where it stands."""
    truth = load_map(workspace.map_path(TRUTH)).elements
    stands_m, (mapped_m,) = (
        element.anchor_m[element.id == SLIPPED][:, :2]
        for element in (truth, run.semantic_map.elements)
    )
    return float(np.linalg.norm(mapped_m - stands_m))


def test_a_repaired_label_repairs_map_and_run(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    run, before = load_run(path), path.read_bytes()
    assert off_m(workspace, run) > 0.5
    unrepaired = rebuild_run(run, free_path(path, "mended"), workspace)
    assert unrepaired.semantic_map.digest == run.semantic_map.digest
    for was, now in zip(run.frames, unrepaired.frames, strict=True):
        assert now.localization.status == was.localization.status
        assert repr(now.localization.T_camera_map) == repr(was.localization.T_camera_map)
    repair(workspace)
    free = free_path(path, "mended")
    assert free.name == "search-mended-2.rrd"
    mended = rebuild_run(run, free, workspace)
    assert off_m(workspace, mended) < off_m(workspace, run) / 1.9
    back = load_run(free)
    assert back.complete
    assert back.semantic_map.digest == mended.semantic_map.digest
    assert back.semantic_map.operation == run.semantic_map.operation + 2
    assert [frame.image for frame in back.frames] == [frame.image for frame in run.frames]
    assert path.read_bytes() == before
    assert workspace.read_map("main").digest == run.semantic_map.digest


def test_stopping_leaves_nothing(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    before = sorted(path.parent.iterdir())

    def stop(what: str, done: int, of: int) -> None:
        if (what, done) == ("localizing", 5):
            raise SemvizError("Stopped; nothing was changed.")

    with pytest.raises(SemvizError, match="Stopped"):
        rebuild_run(load_run(path), free_path(path, "mended"), workspace, stop)
    assert sorted(path.parent.iterdir()) == before


def test_the_way_from_an_element_leads_to_the_mark_that_is_off(workspace: Workspace) -> None:
    """And without such a mark to the nearest one."""
    path = workspace.run_path("search")
    run = load_run(path)
    with workspace.open_labels() as store:
        labels = store.labels
        element, rows = next(
            (element, rows)
            for element in labels.elements.values()
            if element.number in run.semantic_map
            and len(rows := [one for one in labels.of_element(element.id) if one.anchor_known]) > 4
        )
        first, last = (pick(row.frame_index for row in rows) for pick in (min, max))
        name = f"{run.semantic_map.name_of(element.number)}"
        assert RunLabels(run, path).place(element.number, first) == (name, first)
        slipped = next(row for row in rows if row.frame_index == last)
        anchor = (slipped.anchor_px[0] + 25.0, slipped.anchor_px[1])
        store.apply(MoveObservation(slipped.id, anchor, slipped.end_px), "anna")
    assert RunLabels(run, path).place(element.number, first) == (name, last)


def test_edits_are_counted_done_and_taken_back(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    mending = RunLabels(load_run(path), path)
    assert mending.view()[:3] == ("town", 0, 0)
    assert mending.place(SLIPPED, frame=11) == (f"P-{SLIPPED}", SLIP_FRAME)
    mending.exclude(SLIPPED)
    assert mending.view()[:3] == ("town", 1, 1)
    mended = rebuild_run(load_run(path), free_path(path, "mended"), workspace)
    assert SLIPPED not in mended.semantic_map.elements.id
    mending.undo()
    assert mending.view()[:3] == ("town", 2, 0)
    with pytest.raises(SemvizError, match="nothing was changed here"):
        mending.undo()
    with pytest.raises(SemvizError, match="both in the left image"):
        mending.merge((SLIPPED, 19))  # two that one image shows


def test_a_run_whose_labels_are_gone_says_where_they_would_be(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    elsewhere = path.rename(workspace.path.parent / "search.rrd")
    shutil.rmtree(workspace.path)
    run = load_run(elsewhere)
    mending = RunLabels(replace(run, info=replace(run.info, workspace="gone/town")), elsewhere)
    assert mending.view() == ("", 0, 0, None)
    with pytest.raises(SemvizError, match="not found"):
        mending.exclude(SLIPPED)


def test_new_runs_are_on_offer_under_names_of_their_own(workspace: Workspace) -> None:
    path = workspace.run_path("search")
    library = RunLibrary([path])
    assert library.add(path) == "search"
    other = shutil.copy(path, path.with_name("search-mended-1.rrd"))
    assert library.add(Path(other)) == library.add(Path(other)) == "search-mended-1"
    assert library.names == ("search", "search-mended-1")
    same = shutil.copy(path, workspace.path / "search.rrd")
    assert library.run(library.add(Path(same))).info.name == "search"
    assert len(library.names) == 3


@pytest.fixture
def url(workspace: Workspace) -> Iterator[str]:
    tool = Inspector([workspace.run_path("search")])
    with Gateway(tool).running() as url:
        yield url
    tool.close()


def finished(work: Coroutine[Any, Any, Result]) -> Result:
    """Its result, from a thread of its own: Playwright has a loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


def asked(url: str, *requests: Request, until: str) -> dict[str, Any]:
    """The first event of a type, after the run was opened and these requests sent."""

    async def talk() -> dict[str, Any]:
        async with aiohttp.ClientSession() as client, client.ws_connect(at(url, "socket")) as page:
            for request in (OpenRunRequest(id="1"), *requests):
                await page.send_str(request.model_dump_json())
            while True:
                message: dict[str, Any] = await page.receive_json(timeout=60)
                if message["type"] == until:
                    return message
                assert message["type"] != "error", message["text"]

    return finished(talk())


def test_the_labels_open_through_the_same_door(url: str) -> None:
    """One port, and so one token, one tunnel: page, pictures and line of the labelling tool."""
    opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with pytest.raises(urllib.error.HTTPError) as refused:
        opener.open(at(url, "annotate/1/"))
    assert refused.value.code == 404
    request = OpenLabelRequest(id="2", element=SLIPPED)
    address = asked(url, request, until="label_page")["address"]
    assert address == f"annotate/1/?frame={SLIP_FRAME}&element=P-{SLIPPED}"
    with opener.open(at(url, address)) as answer:
        assert b"semviz annotate" in answer.read()
    with opener.open(url.partition("?")[0] + "annotate/1/static/base.css") as answer:
        assert b":root" in answer.read()
    with urllib.request.urlopen(at(url, f"annotate/1/image/{SLIP_FRAME}/left.png")) as answer:
        assert answer.read(4) == b"\x89PNG"

    async def greeted() -> str:
        async with (
            aiohttp.ClientSession() as client,
            client.ws_connect(at(url, "annotate/1/socket?session=")) as page,
        ):
            message: dict[str, Any] = await page.receive_json(timeout=30)
            return str(message["type"])

    assert finished(greeted()) == "hello"
    threads = [thread.name for thread in threading.enumerate()]
    assert threads.count("semviz-gateway") == 1  # no second port
    for path in (
        "annotate/1/",
        "annotate/1/page/main.js",
        "annotate/1/socket",
        "annotate/1/view/x/",
    ):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(url.partition("?")[0] + path)
        assert refused.value.code == 403, path


def test_a_page_without_a_run_is_refused_in_words(workspace: Workspace) -> None:
    """Found by random messages: a KeyError in the terminal."""
    library = RunLibrary([workspace.run_path("search")])
    for ask in (library.path, library.run):
        with pytest.raises(SemvizError, match="there is no run ''; choose one of search"):
            ask("")


def test_two_pages_that_save_at_once_get_two_names(tmp_path: Path) -> None:
    """Found by random messages: the run of one was lost."""
    with ThreadPoolExecutor(8) as pool:
        paths = list(pool.map(lambda _: free_path(tmp_path / "a.rrd", "tried"), range(40)))
    assert len(set(paths)) == 40


def test_an_edit_never_overwrites_what_its_page_has_not_shown(
    workspace: Workspace, url: str
) -> None:
    """Two pages: this one has seen no answer about the pole; on the other somebody revokes one."""
    path = workspace.run_path("search")
    seen = asked(url, until="label_edits")["seen"]
    with workspace.open_labels() as store:
        (element,) = (row for row in store.labels.elements.values() if row.number == SLIPPED)
        left_out = review_decision(element.id, "leave out")
        store.apply(DecideElements((left_out,)), "anna")
        store.apply(RevokeDecision(left_out.id), "anna")
    exclude = ExcludeElementRequest(id="2", element=SLIPPED, base=EditBase(**seen))
    refused = asked(url, exclude, until="error")
    assert refused["code"] == "conflict"
    assert f"anna changed the decision about P-{SLIPPED} since" in refused["text"]
    assert not workspace.read_labels().review_decisions
    seen = asked(url, until="label_edits")["seen"]
    exclude = ExcludeElementRequest(id="2", element=SLIPPED, base=EditBase(**seen))
    assert asked(url, exclude, GetLabelEditsRequest(id="3"), until="label_edits")
    mending = RunLabels(load_run(path), path)
    with pytest.raises(ReplacedLogError):
        mending.merge((SLIPPED, 19), EditBase(1, hash="0" * 64))


def test_an_edit_of_replaced_labels_is_not_undone_in_a_restored_backup(
    workspace: Workspace, tmp_path: Path
) -> None:
    """The backup's operation of the same number is another edit, of the same author."""
    path, backup = workspace.run_path("search"), tmp_path / "backup.db"
    begun = Workspace.open(shutil.copytree(workspace.path, tmp_path / "elsewhere"))
    mine, theirs = (RunLabels(load_run(run), run) for run in (path, begun.run_path("search")))
    theirs.exclude(19)
    backup_labels(begun.labels_path, backup)
    mine.exclude(SLIPPED)
    restore_labels(workspace.labels_path, backup)
    assert mine.view()[:3] == ("town", 1, 0)
    with pytest.raises(SemvizError, match="nothing was changed here"):
        mine.undo(mine.view().seen)
    assert len(workspace.read_labels().review_decisions) == 1


@pytest.mark.browser
@pytest.mark.timeout(240)
def test_from_the_error_to_the_label_and_back(url: str, workspace: Workspace, page: "Page") -> None:
    """One flow without a typed command."""
    open_page(page, url, f"element={SLIPPED}")
    with page.expect_popup() as opened:
        page.click("[data-tab=selected]")
        page.click("#selected-actions >> text=Open label")
    labels = opened.value
    labels.wait_for_selector(f"#card >> text=P-{SLIPPED}", timeout=60_000)
    repair(workspace)  # as the hand would there; moving marks has tests of its own
    labels.close()
    page.bring_to_front()
    page.evaluate("() => window.dispatchEvent(new Event('focus'))")
    page.wait_for_selector("#label-edits >> text=2 edits")
    page.click("text=Rebuild map and run")
    page.wait_for_selector("#label-edits >> text=/search-mended-1: .*change/", timeout=120_000)
    page.click("text=Save this map")
    page.wait_for_selector("#label-edits >> text=Saved as")
    kept = workspace.read_map("main")
    assert kept.digest == load_run(workspace.run_path("search-mended-1")).semantic_map.digest
    page.click("#label-edits >> text=Compare")
    page.wait_for_selector(f"#map-change-list >> text=P-{SLIPPED}", timeout=60_000)
