"""The messages between a page and its server: JSON objects with a ``type``, typed once, here.

A page sends requests (imperatives: ``go_to_frame``), the server sends events (nouns: ``frame``).
Every request has an ``id``; the event that answers it names it in ``reply_to``, and so does the
``error`` that refuses it. Each tool defines its messages in a module ``messages`` of its own.
``python -m semviz.web.protocol --jsdoc`` writes their TypeScript declarations for the pages.
"""

import importlib
import inspect
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError
from pydantic.json_schema import models_json_schema

from semviz.web.shapes import Theme
from semviz_core.common.errors import SemvizError

PROTOCOL: Literal[3] = 3
"""Version of the protocol. A page of another version reloads itself."""

Code = Literal["not_saved", "conflict", "replaced", "invalid", "not_found", "busy", "internal"]
"""``replaced``: a backup replaced the labels that it is about. ``internal``: a bug in the server;
the request is valid."""


MAX_DIGITS = 16
"""Longest integer in a request: beyond 2^53 pages have no exact numbers either."""
MAX_SHOWN = 200
"""Characters of a malformed request that its refusal repeats."""


class Part(BaseModel):
    """A value inside messages. NaN and infinity are refused: JSON has neither."""

    model_config: ClassVar[ConfigDict] = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        json_schema_serialization_defaults_required=True,
    )


class Request(Part):
    """A message from a page; a subclass fixes ``type``. Values are validated, never cast."""

    model_config: ClassVar[ConfigDict] = ConfigDict(strict=True)

    type: str
    id: str
    """Chosen by the page, unique among its requests."""


class Event(Part):
    """A message from the server; a subclass fixes ``type``."""

    type: str
    reply_to: str | None = None
    """The request that this answers; None if the page did not request it."""


class HelloEvent(Event):
    """The first event on every connection."""

    type: Literal["hello"] = "hello"
    protocol: Literal[3] = PROTOCOL
    session: str


class SceneEvent(Event):
    """The 3D scene can be opened."""

    type: Literal["scene"] = "scene"


class ErrorEvent(Event):
    """A refused request, or a failure in the server; ``text`` is shown to the user."""

    type: Literal["error"] = "error"
    code: Code
    text: str
    retry: bool = False
    """Whether the same request may succeed later."""


class SetThemeRequest(Request):
    """Use dark or light colours."""

    type: Literal["set_theme"] = "set_theme"
    theme: Theme


class SetBackdropRequest(Request):
    """Show or hide the backdrop in 3D; one that was made meanwhile is found."""

    type: Literal["set_backdrop"] = "set_backdrop"
    shown: bool


class BackdropEvent(Event):
    """Whether there is a backdrop to show; if not, ``note`` says why and what to do."""

    type: Literal["backdrop"] = "backdrop"
    available: bool
    note: str


class ImageSize(Part):
    """Size of a camera's images, px."""

    width: int
    height: int


class RefusedError(SemvizError):
    """A refusal with a code of its own; any other SemvizError is refused as ``invalid``."""

    def __init__(self, code: Code, text: str) -> None:
        super().__init__(text)
        self.code = code


class MalformedRequestError(SemvizError):
    """Text from a page that is not a request of its tool."""

    def __init__(self, text: str, request_id: str | None) -> None:
        super().__init__(text)
        self.request_id = request_id


def error_event(error: SemvizError, reply_to: str | None) -> ErrorEvent:
    """Return the event that refuses the request ``reply_to``."""
    code: Code = error.code if isinstance(error, RefusedError) else "invalid"
    return ErrorEvent(reply_to=reply_to, code=code, text=str(error), retry=code == "busy")


def encode(event: Event) -> str:
    """Return ``event`` as JSON."""
    return event.model_dump_json()


def decode(text: str, requests: TypeAdapter[Any]) -> Request:
    """Return a request from JSON. Raise MalformedRequestError for anything but ``requests``."""
    try:
        value = json.loads(text, parse_int=_integer)
    except (ValueError, RecursionError) as error:
        raise _malformed(f"{type(error).__name__}: {error}", None) from None
    try:
        request: Request = requests.validate_json(text)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(str(part) for part in fault["loc"])
        raise _malformed(f"{where}: {fault['msg']}" if where else fault["msg"], value) from None
    return request


def _integer(digits: str) -> int:
    """An integer as JavaScript has them. Raise ValueError for a larger one."""
    if len(digits.lstrip("-")) > MAX_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def _malformed(fault: str, value: object) -> MalformedRequestError:
    """The refusal of a request, with its id if it has one that can be sent back."""
    request_id = value.get("id") if isinstance(value, dict) else None
    if not isinstance(request_id, str) or _shown(request_id) != request_id:
        request_id = None
    return MalformedRequestError(
        f"not a message of this page ({_shown(fault)}); reload it", request_id
    )


def _shown(text: str) -> str:
    """The text, short and as valid Unicode: a request may contain half a surrogate pair."""
    return text[:MAX_SHOWN].encode(errors="replace").decode()


# -- handlers

Owner = TypeVar("Owner")
AnyRequest = TypeVar("AnyRequest", bound=Request)
Method = Callable[[Owner, AnyRequest], None]


def handles(
    kind: type[AnyRequest],
) -> Callable[[Method[Owner, AnyRequest]], Method[Owner, AnyRequest]]:
    """Mark the method that handles requests of ``kind``."""

    def mark(method: Method[Owner, AnyRequest]) -> Method[Owner, AnyRequest]:
        method.handled_request = kind  # type: ignore[attr-defined]
        return method

    return mark


class Handlers:
    """The requests of one tool, each with the one method that handles it.

    ``requests`` is the tool's union, discriminated by ``type``; ``owners`` are the classes with
    methods marked by ``handles``. A tool creates it on import: raise TypeError for a request that
    has no handler or two, and for a handler of another tool's request.
    """

    def __init__(self, requests: Any, *owners: type) -> None:
        self._adapter: TypeAdapter[Any] = TypeAdapter(requests)
        self._methods: dict[type[Request], tuple[type, str]] = {}
        for owner in owners:
            for name, method in inspect.getmembers(owner, inspect.isfunction):
                kind = getattr(method, "handled_request", None)
                if kind is not None and kind in self._methods:
                    raise TypeError(f"{kind.__name__} has two handlers")
                if kind is not None:
                    self._methods[kind] = owner, name
        for kind in self._methods.keys() ^ members(requests):
            known = "no handler" if kind not in self._methods else "a handler but no tool"
            raise TypeError(f"{kind.__name__} has {known}")

    def decode(self, text: str) -> Request:
        """Return a request from JSON. Raise MalformedRequestError for anything else."""
        return decode(text, self._adapter)

    def bound_to(self, *owners: object) -> Callable[[Request], None]:
        """Return a function that passes a request to its handler; ``owners``: one of each class."""
        methods: Mapping[type[Request], Callable[[Request], None]] = {
            kind: getattr(next(owner for owner in owners if isinstance(owner, class_)), name)
            for kind, (class_, name) in self._methods.items()
        }
        return lambda request: methods[type(request)](request)


def members(union: Any) -> set[type[Part]]:
    """Return the classes in ``A | B``, also if the union is ``Annotated`` or a single class."""
    if isinstance(union, type):
        return {union} if issubclass(union, Part) else set()
    return set().union(*map(members, get_args(union)))


# -- declarations for the pages

TOOLS = {"annotator": "Annotator", "inspector": "Inspector"}
"""Packages of ``semviz`` with a module ``messages``, and the prefix of its unions' names.

They are imported by name when needed, because they import this module.
"""
DECLARATIONS = Path(__file__).parent / "static" / "protocol.d.ts"
_HEAD = """// Written by `python -m semviz.web.protocol --jsdoc` from the messages of both tools.
// Change those, not this file.
"""


def declarations() -> str:
    """Return the TypeScript declarations of all messages, with a namespace for each tool."""
    shared: set[type[Event]] = {HelloEvent, ErrorEvent}
    blocks = [_HEAD, *_interfaces(set(), shared)]
    for package, name in TOOLS.items():
        messages = importlib.import_module(f"semviz.{package}.messages")
        requests = members(getattr(messages, f"{name}Request"))
        events = members(getattr(messages, f"{name}Event"))
        blocks.append(f"export namespace {package} {{")
        blocks += _interfaces(requests, events - shared)
        blocks += [_table("Requests", requests), _table("Events", events), "}\n"]
    return "\n".join(blocks)


def _interfaces(requests: set[type[Any]], events: set[type[Any]]) -> list[str]:
    """An interface for each message and for each value inside messages, by name."""
    inputs = [(kind, "validation") for kind in _by_name(requests)]
    outputs = [(kind, "serialization") for kind in _by_name(events)]
    _, schema = models_json_schema([*inputs, *outputs], ref_template="{model}")  # type: ignore[list-item]
    return [_interface(name, definition) for name, definition in sorted(schema["$defs"].items())]


def _by_name(kinds: Iterable[type[Any]]) -> list[type[Any]]:
    return sorted(kinds, key=lambda kind: kind.__name__)


def _interface(name: str, schema: Mapping[str, Any]) -> str:
    required = schema.get("required", ())
    description = " ".join(schema.get("description", "").split())
    lines = [f"/** {description} */"] if description else []
    lines.append(f"export interface {_plain(name)} {{")
    for key, value in schema.get("properties", {}).items():
        is_optional = key not in required and "const" not in value  # discriminators are required
        lines.append(f"  {key}{'?' if is_optional else ''}: {_type(value)};")
    return "\n".join([*lines, "}\n"])


def _table(name: str, kinds: Iterable[type[Any]]) -> str:
    """The messages by ``type``."""
    by_type: dict[str, list[str]] = {}
    for kind in _by_name(kinds):
        by_type.setdefault(kind.model_fields["type"].default, []).append(kind.__name__)
    lines = [f"  {key}: {' | '.join(names)};" for key, names in sorted(by_type.items())]
    return "\n".join([f"export interface {name} {{", *lines, "}\n"])


def _type(schema: Mapping[str, Any]) -> str:
    """The TypeScript type of a JSON schema."""
    match schema:
        case {"$ref": str(name)}:
            return _plain(name)
        case {"const": value}:
            return json.dumps(value)
        case {"enum": values}:
            return " | ".join(map(json.dumps, values))
        case {"anyOf": types} | {"oneOf": types}:
            return " | ".join(dict.fromkeys(map(_type, types)))
        case {"type": "array", "prefixItems": items}:
            return f"[{', '.join(map(_type, items))}]"
        case {"type": "array"}:
            return f"Array<{_type(schema.get('items', {}))}>"
        case {"additionalProperties": dict(values)}:
            return _record(schema.get("propertyNames", {}), _type(values))
        case {"patternProperties": patterns}:
            return _record({}, " | ".join(map(_type, patterns.values())))
        case {"type": "integer" | "number"}:
            return "number"
        case {"type": "string" | "boolean" | "null" as name}:
            return str(name)
    return "unknown"


def _record(keys: Mapping[str, Any], value: str) -> str:
    """The type of a mapping; listed keys are optional."""
    if "enum" in keys:
        return f"Partial<Record<{_type(keys)}, {value}>>"
    return f"Record<string, {value}>"


def _plain(name: str) -> str:
    """``MarkInput`` for ``Mark-Input``; it differs from ``MarkOutput`` in its optional fields."""
    return name.replace("-", "")


def main(arguments: list[str]) -> int:
    """Write ``protocol.d.ts``; return the exit status."""
    if arguments != ["--jsdoc"]:
        print("usage: python -m semviz.web.protocol --jsdoc", file=sys.stderr)
        return 2
    DECLARATIONS.write_text(declarations())
    return 0


if __name__ == "__main__":  # as the module that the tools import, not as a second one
    sys.exit(importlib.import_module("semviz.web.protocol").main(sys.argv[1:]))
