"""The label file is removed, replaced or damaged while pages are open: no edit is lost unsaid."""

import shutil
import sqlite3
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from annotator_page import Served, annotating, draw_signs
from journeys.driver import LabelDriver
from streets import street_workspace

from semviz.workspace.workspace import Workspace
from semviz_annotation.storage.backup import Integrity, backup_labels, check_labels, restore_labels

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.browser
Lose = Callable[[Path, Path], None]
ENDS = ("", "-wal", "-shm")
OFFLINE = """() => {
    window.Real = WebSocket;
    window.WebSocket = class extends EventTarget { static OPEN = 1; };
    semviz.socket._socket.close();
}"""
ONLINE = """() => {
    window.WebSocket = Real;
    semviz.socket._socket = semviz.socket._connect();
}"""


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    """Three operations; the backup has the first."""
    workspace = street_workspace(tmp_path / "street", 7, 4)
    draw_signs(workspace, [(0, 300.0)], "one")
    backup_labels(workspace.labels_path, tmp_path / "backup.db")
    draw_signs(workspace, [(1, 300.0), (2, 320.0)], "one")
    return workspace


def remove(path: Path, backup: Path) -> None:
    for end in ENDS:
        Path(f"{path}{end}").unlink()


def move_over(path: Path, backup: Path) -> None:
    backup.rename(path)


def copy_over(path: Path, backup: Path) -> None:
    shutil.copyfile(backup, path)


def draw(driver: LabelDriver, u: float) -> None:
    driver.page.keyboard.press("1")
    driver.click_at("left", (u, 60.0))
    driver.click_at("left", (u + 1.0, 260.0))


def wait_for(page: "Page", selector: str, words: str) -> None:
    page.locator(selector, has_text=words).wait_for()


@pytest.mark.parametrize(
    ("lose", "said"),
    [
        (remove, "labels.db was removed while it was open"),
        (move_over, "labels.db was replaced while it was open"),
        (copy_over, "labels.db was overwritten while it was open"),
    ],
)
def test_edits_stay_in_the_page_when_the_file_is_lost(
    driver: LabelDriver,
    served: Served,
    tmp_path: Path,
    lose: Callable[[Path, Path], None],
    said: str,
) -> None:
    page, path = driver.page, served.annotator.session.workspace.labels_path
    lose(path, tmp_path / "backup.db")
    there = path.read_bytes() if path.exists() else None
    page.wait_for_selector("#label-file:not([hidden])")
    for number in range(2):
        draw(driver, 400.0 + 90.0 * number)
    wait_for(page, "#label-file", "2 edits are kept in this page.")
    assert page.inner_text("#label-file").startswith(f"Not saved: {said}; put it back, or restart")
    assert page.inner_text("#saved") == "Not saved, 2 kept here"
    page.reload()
    page.wait_for_selector("#label-file:not([hidden])")
    wait_for(page, "#label-file", "2 edits are kept in this page.")
    assert (path.read_bytes() if path.exists() else None) == there
    served.annotator.session._store.close()
    assert (path.read_bytes() if path.exists() else None) == there


def test_a_file_that_comes_back_takes_the_edits(driver: LabelDriver, served: Served) -> None:
    page, path = driver.page, served.annotator.session.workspace.labels_path
    for end in ENDS:
        Path(f"{path}{end}").rename(f"{path}.away{end}")
    page.wait_for_selector("#label-file:not([hidden])")
    draw(driver, 400.0)
    wait_for(page, "#label-file", "1 edit is kept in this page.")
    for end in ENDS:
        Path(f"{path}.away{end}").rename(f"{path}{end}")
    page.wait_for_selector("#label-file", state="hidden")
    wait_for(page, "#saved", "Saved operation 4")
    assert check_labels(path).operations == 4


def test_damage_that_the_check_finds_is_told_until_a_backup_is_restored(
    workspace: Workspace, page: "Page", tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The author of an early operation: no label depends on it, so the page opens."""
    path = workspace.labels_path
    with sqlite3.connect(path) as connection:
        (trigger,) = connection.execute(
            "SELECT sql FROM sqlite_master WHERE name = 'operations_stay'"
        ).fetchone()
        connection.execute("DROP TRIGGER operations_stay")
        connection.execute("UPDATE operations SET author = 'two' WHERE number = 1")
        connection.execute(trigger)
    opened = threading.Event()

    def check_later(*arguments: Any) -> Integrity:
        opened.wait()
        return check_labels(*arguments)

    monkeypatch.setattr("semviz_annotation.storage.label_file.check_labels", check_later)
    monkeypatch.setattr("semviz_annotation.storage.integrity.TAIL", 1)
    with annotating(workspace) as served:
        driver = LabelDriver(page)
        driver.open(served.url)
        page.wait_for_selector('#saved[title^="The label file is being checked"]')
        opened.set()
        page.wait_for_selector("#label-file:not([hidden])")
        draw(driver, 400.0)
        wait_for(page, "#label-file", "1 edit is kept in this page.")
        assert "damaged (operation 1: its hash is wrong" in page.inner_text("#label-file")
        restore_labels(path, tmp_path / "backup.db")
        page.wait_for_selector("#label-file", state="hidden")
        wait_for(page, "#question", "a backup replaced the labels on which this edit was made")
        page.keyboard.press("y")
        wait_for(page, "#saved", "Saved operation 2")
        page.wait_for_selector('#saved[title^="The label file was checked"]')
    assert check_labels(path).operations == 2


def test_edits_made_before_a_backup_was_restored_ask_before_they_change_it(
    driver: LabelDriver, served: Served, tmp_path: Path
) -> None:
    """The page was offline meanwhile, and the numbers that it knows are in use again."""
    page, workspace = driver.page, served.annotator.session.workspace
    page.evaluate(OFFLINE)
    page.wait_for_function("() => !semviz.state.connected")
    for u in (400.0, 490.0):
        draw(driver, u)
    page.wait_for_function("() => semviz.outbox.entries.length === 2")
    restore_labels(workspace.labels_path, tmp_path / "backup.db")
    draw_signs(workspace, [(0, 340.0 + 20.0 * number) for number in range(6)], "two")
    page.evaluate(ONLINE)
    wait_for(page, "#question", "a backup replaced the labels on which this edit was made")
    wait_for(page, "#question", "2 edits kept in this page")
    assert served.annotator.session.labels.operation == 7
    draw(driver, 580.0)  # while it asks, and takes it back
    page.keyboard.press("Control+z")
    page.wait_for_function("() => semviz.outbox.entries.length === 4")
    page.keyboard.press("y")
    page.wait_for_function("() => semviz.outbox.entries.length === 0")
    wait_for(page, "#saved", "Saved operation 11")
    assert check_labels(workspace.labels_path).operations == 11
    assert len(served.labels.observations) == 9
