"""Several people on one server: tokens, roles, whose edit it is, who is where."""

import json
import stat
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import pytest
from annotator_page import WAIT_MS, Served, annotating, draw_on, opened_pages, settled
from echo_tool import connected
from pydantic import ValidationError
from streets import street_workspace

from semviz.annotator.server import Annotator
from semviz.annotator.team.team_view import (
    FORECAST_DAYS,
    MOST_DAYS,
    AssignFramesRequest,
    done_on,
)
from semviz.web.gateway import Gateway
from semviz.workspace.people import FILE, People, Role, digest_of
from semviz.workspace.workspace import Workspace
from semviz_annotation.storage.integrity import check_labels
from semviz_annotation.storage.teamwork import AssignedFrames, assignment_text
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    return street_workspace(tmp_path / "street", 7, 3)


@pytest.fixture
def people(workspace: Workspace) -> People:
    return People(workspace.path)


@pytest.fixture
def served(workspace: Workspace) -> Iterator[Served]:
    annotator = Annotator(workspace, author="tester")
    try:
        with Gateway(annotator, guests=annotator.people.names_by_digest).running() as url:
            yield Served(url, annotator)
    finally:
        annotator.close()


def test_a_token_is_shown_once_and_kept_as_a_digest_in_a_private_file(people: People) -> None:
    token = people.invite("mara", "annotate")
    path = people._path
    assert token not in path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert people.names_by_digest() == {digest_of(token): "mara"}
    again = people.invite("mara", "review")
    assert people.names_by_digest() == {digest_of(again): "mara"}
    people.revoke("mara")
    assert not people.names_by_digest()
    with pytest.raises(SemvizError, match="nobody named 'mara' is invited"):
        people.revoke("mara")
    with pytest.raises(SemvizError, match="is no name"):
        people.invite("../mara\n", "look")


def test_a_damaged_file_lets_nobody_in(people: People) -> None:
    people.invite("mara", "annotate")
    path = people._path
    path.write_text(path.read_text().replace("annotate", "anything"))
    assert not people.names_by_digest()
    with pytest.raises(SemvizError, match=FILE):
        people.by_name()


def test_each_token_opens_every_page_until_it_is_revoked(served: Served, people: People) -> None:
    port = urlsplit(served.url).port
    script = "/static/dom.js"
    assert connected(port, "GET", f"{script}?token=guessed", {}).status == 403
    token = people.invite("mara", "look")
    entered = connected(port, "GET", f"/?token={token}", {})
    assert entered.status == 303
    cookie = {"Cookie": entered.headers["Set-Cookie"].split(";")[0]}
    assert token not in cookie["Cookie"]
    assert connected(port, "GET", script, cookie).status == 200
    digest = digest_of(token)  # who reads the file has no token
    assert connected(port, "GET", f"{script}?token={digest}", {}).status == 403
    people.revoke("mara")
    assert connected(port, "GET", script, cookie).status == 403
    assert connected(port, "GET", f"/?token={token}", {}).status == 403


def test_the_commands_say_what_they_did_in_the_log(workspace: Workspace) -> None:
    def annotate(*options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "semviz.cli", "annotate", str(workspace.path), *options]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    done = annotate("--invite", "mara", "--role", "review", "--author", "eva")
    assert done.returncode == 0, done.stderr
    (token,) = (line.split("token=")[1] for line in done.stdout.splitlines() if "token=" in line)
    assert People(workspace.path).names_by_digest() == {digest_of(token): "mara"}
    assert annotate("--invite", "eva", "--author", "eva").returncode == 2
    assert annotate("--revoke", "jon", "--author", "eva").returncode == 2
    assert annotate("--revoke", "mara", "--author", "eva").returncode == 0
    with workspace.open_labels() as store:
        said = [(row.kind, row.text, row.author) for row in store.operations()]
        assert store.undoable("eva") is None
    assert said == [("invite", "mara to review", "eva"), ("revoke", "mara", "eva")]
    check_labels(workspace.labels_path)
    assert token not in workspace.labels_path.read_bytes().decode("latin-1")


@pytest.fixture
def pages(served: Served, people: People, chromium: "Browser") -> Iterator[dict[str, "Page"]]:
    """The pages of who started the server, of mara who labels, and of lin who looks."""
    guests: dict[str, Role] = {"mara": "annotate", "lin": "look"}
    with opened_pages(chromium, served.url, "tester", people, guests) as opened:
        yield opened


@pytest.mark.browser
def test_each_edit_has_the_name_of_who_made_it_and_undo_is_ones_own(
    pages: dict[str, "Page"], served: Served
) -> None:
    draw_on(pages["mara"], 0, 100.0)
    draw_on(pages["tester"], 0, 300.0)
    store = served.annotator.session._store
    assert [row.author for row in store.operations()] == ["mara", "tester"]
    for page in pages.values():  # all see both
        page.wait_for_function("() => semviz.state.labels.operation === 2", timeout=WAIT_MS)
    assert pages["lin"].locator("#undo").is_disabled()
    pages["mara"].keyboard.press("Control+z")
    pages["mara"].wait_for_function("() => semviz.state.labels.operation === 3", timeout=WAIT_MS)
    (left,) = store.labels.observations.values()
    assert left.anchor_px[0] == 300.0
    assert (
        pages["mara"].inner_text("#author") == "mara"
        or pages["mara"].evaluate("() => semviz.state.workspace.author") == "mara"
    )


@pytest.mark.browser
def test_who_may_look_changes_nothing_whatever_the_page_sends(
    pages: dict[str, "Page"], served: Served
) -> None:
    page = pages["lin"]
    draw_on(page, 0, 100.0)
    page.wait_for_selector("#message:has-text('look at these labels')")
    page.evaluate(  # past the page's own check
        """() => semviz.socket.send('apply_edit',
          { edit: { kind: 'review', frame_index: 0, state: 'reviewed, empty' }, base: null },
          '00000000-0000-7000-8000-000000000000')"""
    )
    page.wait_for_selector("#message:has-text('not change them')")
    page.evaluate("() => semviz.socket.send('build_map', {})")
    draw_on(pages["mara"], 0, 200.0)
    operations = served.annotator.session._store.operations()
    assert [row.author for row in operations] == ["mara"]


@pytest.mark.browser
def test_people_see_where_the_others_are_and_the_revoked_are_gone(
    pages: dict[str, "Page"], served: Served, people: People
) -> None:
    tester, mara = pages["tester"], pages["mara"]
    mara.keyboard.press(".")
    tester.wait_for_selector(".person[title*='mara (annotate): frame 1']", timeout=WAIT_MS)
    tester.click(".person[title*='mara']")
    tester.wait_for_function("() => semviz.state.frame === 1")
    assert "2 here" in (tester.text_content("#people") or "")
    for width in (1401, 1441, 1500, 1761):  # the bar ends with one's own name, whole
        tester.set_viewport_size({"width": width, "height": 900})
        ends = "['author', 'help'].map((id) => document.getElementById(id).getBoundingClientRect())"
        assert tester.evaluate(f"{ends}.every((box) => box.right <= innerWidth && box.width > 20)")
        assert tester.evaluate("author.scrollWidth <= author.clientWidth + 1")
    tester.set_viewport_size({"width": 1280, "height": 720})
    draw_on(mara, 1, 100.0)
    people.revoke("mara")
    mara.wait_for_function("() => !semviz.state.connected", timeout=WAIT_MS)
    tester.wait_for_selector(".person[title*='mara']", state="detached", timeout=WAIT_MS)
    assert len(served.labels.observations) == 1  # what she did stays
    assert json.loads((people._path).read_text())["people"][0]["name"] == "lin"


def test_without_guests_there_is_one_token(workspace: Workspace) -> None:
    with annotating(workspace) as served:
        token = People(workspace.path).invite("mara", "annotate")
        assert connected(urlsplit(served.url).port, "GET", f"/?token={token}", {}).status == 403


@pytest.mark.browser
def test_a_reviewer_sends_back_with_a_comment_and_accepts(
    pages: dict[str, "Page"], served: Served
) -> None:
    tester, mara = pages["tester"], pages["mara"]
    store = served.annotator.session._store
    draw_on(mara, 0, 100.0)
    mara.keyboard.press("Enter")
    settled(mara)
    tester.keyboard.press("F8")
    tester.wait_for_selector("#team-queue .row:has-text('mara')", timeout=WAIT_MS)
    tester.keyboard.press("Shift+N")
    tester.wait_for_selector("#message:has-text('pin a comment first')")
    tester.keyboard.press("Shift+I")
    tester.keyboard.type("too far left")
    tester.keyboard.press("Enter")
    tester.wait_for_selector("#team-notes:has-text('too far left')", timeout=WAIT_MS)
    tester.keyboard.press("Shift+N")
    tester.wait_for_function("() => semviz.team.queue.length === 0", timeout=WAIT_MS)
    assert served.labels.review(0) == "in work"
    (note,) = served.labels.notes.values()
    assert (note.author, note.frame_index, note.text) == ("tester", 0, "too far left")
    mara.wait_for_function("() => semviz.state.labels.frames[0].state === 'in work'")
    mara.keyboard.press("Enter")
    tester.wait_for_selector("#team-queue .row:has-text('mara')", timeout=WAIT_MS)
    tester.keyboard.press("Enter")
    tester.wait_for_selector("#team-queue:has-text('Nothing waits. 1 accepted.')", timeout=WAIT_MS)
    assert served.labels.review(0) == "reviewed"
    assert [row.kind for row in store.operations()][-4:] == [
        "note",
        "send back",
        "review",
        "accept frame",
    ]
    tester.keyboard.press("Control+z")
    tester.wait_for_selector("#team-queue .row", timeout=WAIT_MS)


def test_every_frame_that_a_page_may_assign_is_read_from_the_log(workspace: Workspace) -> None:
    """A number with more digits than the log's text holds would end the view for everybody."""
    last = 10**9 - 1
    request = {"id": "1", "person": "mara", "frames": (0, last)}
    frames = AssignFramesRequest.model_validate(request).frames
    assert frames is not None
    with workspace.open_labels() as store:
        store.state("assign", assignment_text("mara", AssignedFrames(*frames)), "tester")
        assert store.team()[2] == {"mara": [(0, last)]}
    with pytest.raises(ValidationError):
        AssignFramesRequest.model_validate(request | {"frames": (0, last + 1)})


def test_the_forecast_takes_the_pace_of_days_on_which_somebody_reviewed() -> None:
    now = datetime(2026, 3, 10, 12, tzinfo=UTC)
    days = [now - timedelta(days=back) for back in (1, 1, 1, 1, 3, 3)]  # 3 a day, on two days
    times = [day.isoformat() for day in days]
    assert done_on(9, times, now) == "2026-03-13"
    assert done_on(10, times, now) == "2026-03-14"  # a day that is begun counts
    assert done_on(0, times, now) == ""  # nothing is left
    assert done_on(9, [], now) == ""  # nothing tells
    old = (now - timedelta(days=FORECAST_DAYS, seconds=1)).isoformat()
    assert done_on(9, [old] * 100, now) == ""
    assert done_on(9, [*times, *[old] * 100], now) == "2026-03-13"
    assert done_on(MOST_DAYS * 3, times, now) == ""


@pytest.mark.browser
def test_frames_are_assigned_by_who_reviews_and_progress_is_told(
    pages: dict[str, "Page"], served: Served
) -> None:
    tester, mara = pages["tester"], pages["mara"]
    for page in (tester, mara):
        page.keyboard.press("F8")
        page.wait_for_selector(".team-person:has-text('mara')", timeout=WAIT_MS)
    assert mara.locator("#team-assign").is_hidden()
    mara.evaluate("() => semviz.socket.send('assign_frames', {person: 'mara', frames: [0, 2]})")
    mara.wait_for_selector("#message:has-text('only who reviews')")
    tester.select_option("#team-person", "mara")
    tester.keyboard.press("Shift+G")
    tester.keyboard.type("0-1")
    tester.keyboard.press("Enter")
    tester.wait_for_selector(".team-person:has-text('mara'):has-text('0 / 2')", timeout=WAIT_MS)
    draw_on(mara, 0, 100.0)
    mara.keyboard.press("F2")
    mara.keyboard.press("Enter")
    tester.wait_for_selector(".team-person:has-text('mara'):has-text('1 / 2')", timeout=WAIT_MS)
    mara.evaluate(  # a labeller's page cannot accept its own frame
        """() => semviz.socket.send('apply_edit',
          { edit: { kind: 'accept frame', frame_index: 0 }, base: null },
          '00000000-0000-7000-8000-000000000001')"""
    )
    mara.wait_for_selector("#message:has-text('only who reviews')")
    kinds = [row.kind for row in served.annotator.session._store.operations()]
    assert kinds == ["assign", "add", "review"]
