"""Send random messages to both web tools: each may only be answered or refused, never fail inside.

    python bench/fuzz_messages.py --minutes 10
    python bench/fuzz_messages.py annotate --seed 3

Messages are of every kind that the tool's page sends, made from the types of ``messages``: known
ids and others, numbers at their limits, missing parts and wrong ones; some are no JSON of a page at
all. The exit status is 1 if one was answered as an internal error, or the label file is damaged.
"""

import asyncio
import json
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import tests_support  # noqa: F401
import tyro
from aiohttp import ClientSession, ClientWebSocketResponse, WSMsgType
from annotator_page import annotating, draw_signs
from pydantic import TypeAdapter
from recording import make_info, make_jpeg, make_map, make_records
from serving import at
from streets import street_workspace

from semviz.annotator.messages import AnnotatorRequest
from semviz.inspector.messages import InspectorRequest
from semviz.inspector.server import Inspector
from semviz.runs.writer import RunWriter
from semviz.web.gateway import Gateway
from semviz.workspace.workspace import Workspace
from semviz_annotation.storage.backup import check_labels

Tool = Literal["annotate", "serve"]
ANY = (
    *(None, True, 0, 1, -1, 2**53, 2**53 - 1, 1e308, -1e308, 5e-324, 0.5, "", "x", "a" * 3000),
    *("\x00", "\u202e", "../../labels.db", "P-01", "left", "\U0001f600", "<script>", [], {}, [[]]),
)
RAW = (
    *("NaN", "Infinity", "1e999", "9" * 5000, '"\\ud800"', "[" * 100_000, '{"a":' * 50_000),
    '"' + "x" * 2_000_000 + '"',
)
"""Texts in the place of a value."""
NUMBERS = (0, 1, 2, 3, 4, 9, 999, -1, 2**53 - 1)
PER_PAGE = 60
"""Messages after which the page is opened again."""


@dataclass(frozen=True)
class Options:
    tools: tyro.conf.Positional[tuple[Tool, ...]] = ("annotate", "serve")
    minutes: float = 10.0
    """For each tool."""
    seed: int = 1


@dataclass
class Messages:
    """Makes messages from the JSON schema of a tool's requests."""

    schema: dict[str, Any]
    rng: random.Random
    ids: list[str]
    """Of labels and of elements, known so far."""
    kinds: Counter[str] = field(default_factory=Counter)

    def text(self) -> str:
        value = self.value(self.rng.choice(self.schema["oneOf"]))
        if not isinstance(value, dict):
            return json.dumps(value)
        self.kinds[str(value.get("type"))[:30]] += 1
        value["id"] = f"m{self.rng.randrange(10**9)}" if self.rng.random() < 0.9 else self._any()
        names = [name for name in value if name != "type"]
        if self.rng.random() < 0.03:
            changed = json.dumps(value | {self.rng.choice(names): "@@"})
            return changed.replace('"@@"', self.rng.choice(RAW))
        return json.dumps(value)

    def value(self, schema: dict[str, Any]) -> Any:
        """A value of a schema, or at times of none."""
        if self.rng.random() < 0.04:
            return self._any()
        if "$ref" in schema:
            return self.value(self.schema["$defs"][schema["$ref"].rpartition("/")[2]])
        if "const" in schema:
            return schema["const"]
        choices = schema.get("enum") or schema.get("anyOf") or schema.get("oneOf")
        if choices:
            chosen = self.rng.choice(choices)
            return chosen if "enum" in schema else self.value(chosen)
        return self._of_type(schema)

    def _of_type(self, schema: dict[str, Any]) -> Any:
        rng = self.rng
        match schema.get("type"):
            case "object":
                needed = schema.get("required", ())
                parts = schema.get("properties", {}).items()
                return {
                    name: self.value(part)
                    for name, part in parts
                    if name in needed or rng.random() < 0.7
                }
            case "array" if "prefixItems" in schema:
                return [self.value(part) for part in schema["prefixItems"]]
            case "array":
                count = max(rng.choice((0, 1, 1, 2, 3, 40)), schema.get("minItems", 0))
                return [self.value(schema.get("items", {})) for _ in range(count)]
            case "string":
                return rng.choice(self.ids[-60:])
            case "integer":
                return rng.choice(NUMBERS)
            case "number":
                return rng.choice((rng.uniform(-50.0, 1500.0), rng.uniform(0.0, 400.0), 1e308, 0.0))
            case "boolean":
                return rng.random() < 0.5
        return self._any()

    def _any(self) -> Any:
        return json.loads(json.dumps(self.rng.choice(ANY)))


@dataclass
class Answers:
    """What a tool answered."""

    codes: Counter[str] = field(default_factory=Counter)
    internal: list[str] = field(default_factory=list)


async def listen(page: ClientWebSocketResponse, answers: Answers, ids: list[str]) -> None:
    async for message in page:
        if message.type != WSMsgType.TEXT:
            continue
        event = json.loads(message.data)
        if event["type"] == "error":
            answers.codes[event["code"]] += 1
            if event["code"] == "internal":
                answers.internal.append(event["text"])
        elif event["type"] == "frame":
            ids += [element["id"] for element in event["frame"].get("elements", ())]


async def attack(url: str, messages: Messages, first: str | None, seconds: float) -> Answers:
    """Send messages for so long, from one page after the other."""
    answers, stop = Answers(), time.monotonic() + seconds
    async with ClientSession() as client:
        while time.monotonic() < stop:
            async with client.ws_connect(at(url, "socket?session="), max_msg_size=0) as page:
                listening = asyncio.create_task(listen(page, answers, messages.ids))
                if first is not None and messages.rng.random() < 0.9:
                    await page.send_str(first)
                for _ in range(PER_PAGE):
                    if page.closed:  # a message was too long
                        break
                    await page.send_str(messages.text())
                    await asyncio.sleep(0.01)
                await asyncio.sleep(0.5)
                listening.cancel()
    return answers


@contextmanager
def serving(tool: Tool, workspace: Workspace) -> Iterator[str]:
    """Serve a tool; yield its address."""
    if tool == "annotate":
        with annotating(workspace) as served:
            yield served.url
        return
    semantic_map, names = make_map(length_m=60.0), ("a", "b")
    for name in names:
        with RunWriter(workspace.run_path(name), make_info(name), semantic_map) as writer:
            for record in make_records(semantic_map, 5, make_jpeg()):
                writer.write(record)
    inspector = Inspector([workspace.run_path(name) for name in names])
    with Gateway(inspector).running() as url:
        yield url
    inspector.close()


def fuzz(tool: Tool, options: Options) -> bool:
    """Attack one tool; return whether nothing failed inside."""
    schema = TypeAdapter(AnnotatorRequest if tool == "annotate" else InspectorRequest).json_schema()
    first = None if tool == "annotate" else '{"type": "open_run", "id": "first"}'
    with tempfile.TemporaryDirectory() as folder:
        workspace = street_workspace(Path(folder) / "street", 7, 4)
        draw_signs(workspace, [(0, 300.0), (1, 320.0)], "one")
        labels = workspace.read_labels()
        ids = ["P-01", "", *labels.observations, *labels.elements]
        messages = Messages(schema, random.Random(options.seed), ids)
        with serving(tool, workspace) as url:
            answers = asyncio.run(attack(url, messages, first, 60.0 * options.minutes))
        check_labels(workspace.labels_path)
    kinds = sum(count > 0 for count in messages.kinds.values())
    print(f"{tool}: {messages.kinds.total()} messages of {kinds} kinds; refused: ", end="")
    print(", ".join(f"{code} {count}" for code, count in answers.codes.most_common()))
    for text in dict.fromkeys(answers.internal):
        print(f"  FAILED inside: {text[:300]}")
    return not answers.internal


def main(options: Options) -> int:
    failed = [tool for tool in options.tools if not fuzz(tool, options)]
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
