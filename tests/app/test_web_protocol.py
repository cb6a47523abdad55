"""The protocol between pages and server: one definition, refusals by code, complete handlers."""

import json
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal

import pytest
from annotator_page import draw_signs
from drawn_marks import sign
from pydantic import Field, ValidationError

from semviz.annotator.drive.drive_requests import PoseUndo
from semviz.annotator.page_session import HANDLERS, AnnotatorPage
from semviz.annotator.session import LabelSession
from semviz.web import protocol
from semviz.web.protocol import (
    ErrorEvent,
    Event,
    Handlers,
    HelloEvent,
    MalformedRequestError,
    Part,
    RefusedError,
    Request,
    encode,
    error_event,
    handles,
)
from semviz.web.viser_servers import ViserServers
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import new_id
from semviz_annotation.storage.label_file import NotSavedError
from semviz_core.common.errors import SemvizError


class OneRequest(Request):
    type: Literal["one"] = "one"
    number: int
    point: tuple[float, float] | None = None


class TwoRequest(Request):
    type: Literal["two"] = "two"


class ForeignRequest(Request):
    type: Literal["foreign"] = "foreign"


AnyRequest = Annotated[OneRequest | TwoRequest, Field(discriminator="type")]


class First:
    def __init__(self) -> None:
        self.seen: list[Request] = []

    @handles(OneRequest)
    def _one(self, request: OneRequest) -> None:
        self.seen.append(request)


class Second(First):
    """Inherits a handler, and has one of its own."""

    @handles(TwoRequest)
    def _two(self, request: TwoRequest) -> None:
        self.seen.append(request)


class Other:
    def __init__(self) -> None:
        self.seen: list[Request] = []

    @handles(TwoRequest)
    def _two(self, request: TwoRequest) -> None:
        self.seen.append(request)


class Unrelated:
    @handles(ForeignRequest)
    def _foreign(self, request: ForeignRequest) -> None: ...


def test_every_request_has_one_handler_or_the_tool_cannot_be_imported() -> None:
    Handlers(AnyRequest, Second)
    Handlers(AnyRequest, First, Other)
    with pytest.raises(TypeError, match="TwoRequest has no handler"):
        Handlers(AnyRequest, First)
    with pytest.raises(TypeError, match="TwoRequest has two handlers"):
        Handlers(AnyRequest, Second, Other)
    with pytest.raises(TypeError, match="ForeignRequest has a handler but no tool"):
        Handlers(AnyRequest, Second, Unrelated)


def test_a_request_goes_to_the_object_that_handles_it() -> None:
    handlers = Handlers(AnyRequest, First, Other)
    first, other = First(), Other()
    handle = handlers.bound_to(other, first)
    for kind, more in (("one", {"number": 3, "point": [1, 2.5]}), ("two", {})):
        handle(handlers.decode(json.dumps({"type": kind, "id": kind} | more)))
    assert first.seen == [OneRequest(id="one", number=3, point=(1.0, 2.5))]
    assert other.seen == [TwoRequest(id="two")]


@pytest.mark.parametrize(
    ("text", "request_id"),
    [
        ("", None),
        ("[]", None),
        ("null", None),
        ('{"type": "one"', None),
        ('{"type": "one", "id": "r"}', "r"),
        ('{"type": "one", "id": "r", "number": "3"}', "r"),
        ('{"type": "one", "id": "r", "number": true}', "r"),
        ('{"type": "one", "id": "r", "number": 1, "point": [1, NaN]}', "r"),
        ('{"type": "one", "id": "r", "number": 1, "more": 2}', "r"),
        ('{"type": "cats", "id": "r"}', "r"),
        ('{"id": "r"}', "r"),
        ('{"type": "two", "id": 4}', None),
        ('{"type": "two"}', None),
        ('{"verb": "two", "id": "r"}', "r"),
    ],
)
def test_what_is_no_request_is_refused_by_the_id_it_has(text: str, request_id: str | None) -> None:
    with pytest.raises(
        MalformedRequestError, match=r"^not a message of this page .* reload it$"
    ) as e:
        Handlers(AnyRequest, Second).decode(text)
    assert e.value.request_id == request_id
    assert "\n" not in str(e.value)


def test_refusals_have_codes() -> None:
    assert error_event(SemvizError("no"), "r") == ErrorEvent(
        reply_to="r", code="invalid", text="no"
    )
    busy = error_event(RefusedError("busy", "wait"), None)
    assert (busy.code, busy.retry, busy.reply_to) == ("busy", True, None)
    assert not error_event(RefusedError("not_found", "gone"), "r").retry


def test_events_are_json_that_browsers_read() -> None:
    assert json.loads(encode(HelloEvent(session="s"))) == {
        "type": "hello",
        "reply_to": None,
        "protocol": 3,
        "session": "s",
    }

    class Number(Part):
        value: float

    class NumberEvent(Event):
        type: Literal["number"] = "number"
        number: Number

    for value in (float("nan"), float("inf")):
        with pytest.raises(ValidationError):
            NumberEvent(number=Number(value=value))
    with pytest.raises(ValidationError):
        HelloEvent(session="s", more=1)  # type: ignore[call-arg]


def test_the_declarations_of_the_pages_are_those_of_the_messages() -> None:
    """Changed messages: run ``python -m semviz.web.protocol --jsdoc``."""
    assert protocol.DECLARATIONS.read_text() == protocol.declarations()


def test_nothing_in_the_declarations_is_unknown() -> None:
    assert not [line for line in protocol.declarations().splitlines() if ": unknown" in line]


def test_declarations_say_what_may_be_left_out_and_what_is_always_there() -> None:
    lines = protocol._interfaces({OneRequest}, {ErrorEvent})
    line = next(block for block in lines if "interface OneRequest" in block)
    assert '  type: "one";' in line
    assert "  number: number;" in line
    assert "  point?: [number, number] | null;" in line
    error = next(block for block in lines if "interface ErrorEvent" in block)
    assert "  reply_to: string | null;" in error
    assert "  retry: boolean;" in error


def test_page_and_server_have_one_version() -> None:
    client = (protocol.DECLARATIONS.parent / "socket.js").read_text()
    assert f"const PROTOCOL = {protocol.PROTOCOL};" in client


def test_the_command_line_starts_without_the_protocol() -> None:
    code = "import sys, semviz.cli; print({'pydantic', 'aiohttp'} & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


# -- the annotator's refusals


@pytest.fixture
def opened(tmp_path: Path) -> Any:
    """A page of a workspace with one sign, and what it was told."""
    workspace = Workspace.create_street(tmp_path / "street", 7, range(0, 2))
    draw_signs(workspace, [(0, 300.0)], "one")
    session = LabelSession(workspace, "tester")
    events: list[Event] = []
    later = SimpleNamespace(submit=lambda *_: None)
    shared = SimpleNamespace(
        session=session,
        lock=threading.RLock(),
        scenes=ViserServers(),
        scene_thread=later,
        search_thread=later,
        pose_steps=PoseUndo(),
        pages=[],
        role_of=lambda _: "annotate",
        people_changed=lambda: None,
        updates_queued=threading.Event(),
    )
    page = AnnotatorPage("id", events.append, shared)
    yield SimpleNamespace(page=page, session=session, events=events)
    session.close()


def asked(**fields: Any) -> Request:
    return HANDLERS.decode(json.dumps({"type": "apply_edit", "id": new_id()} | fields))


@pytest.mark.parametrize("text", ["Not saved: disk full.", "Something else, in other words."])
def test_an_edit_that_the_disk_refuses_is_refused_by_code(
    opened: Any, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise NotSavedError(text)

    monkeypatch.setattr(opened.session._store, "apply", refuse)
    request = asked(edit=sign(0, "left", (500.0, 40.0)))
    opened.page.receive(request)
    (told,) = opened.events
    assert told == ErrorEvent(reply_to=request.id, code="not_saved", text=text, retry=True)


def test_a_conflict_comes_with_the_requests_that_it_would_overwrite(opened: Any) -> None:
    (row,) = opened.session.labels.observations.values()
    (drawn,) = opened.session._store.operations()
    move = {"kind": "move", "observation_id": row.id, "anchor_px": [5.0, 5.0]}
    base = {"operation": 0, "known": []}
    opened.page.receive(asked(edit=move, base=base))
    (told,) = opened.events
    assert (told.type, told.code) == ("error", "conflict")
    assert (told.overwritten, told.is_deleted) == ([drawn.request_id], False)
    opened.events.clear()
    opened.page.receive(asked(edit=move, base=base | {"known": told.overwritten}))
    assert [event.type for event in opened.events] == ["saved_operation", "edit_saved"]


def test_an_edit_is_answered_by_its_id(opened: Any) -> None:
    request = asked(edit=sign(0, "left", (500.0, 40.0)))
    opened.page.receive(request)
    assert [(event.type, event.reply_to) for event in opened.events] == [
        ("saved_operation", request.id),
        ("edit_saved", request.id),
    ]
    with pytest.raises(SemvizError, match="no observation"):
        opened.page.receive(asked(edit={"kind": "delete", "observation_id": new_id()}))
    with pytest.raises(RefusedError, match="not in this sequence") as error:
        opened.page.receive(asked(type="go_to_frame", frame=77))
    assert error.value.code == "not_found"
