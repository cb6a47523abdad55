"""G3: label files replayed from a seeded sequence of edits, and from logs of every version."""

import gzip
import hashlib
import json
import sqlite3
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from golden.canonical import digest, sha
from golden.command import call
from golden.files import FIXTURES
from semviz import SemvizError, Workspace
from semviz_annotation.labels.edits import edit_from_json

SEED, STEPS, FRAMES = 20, 600, 8
AUTHORS = ("ann", "ben")
STATES = ("unseen", "in work", "reviewed", "reviewed, empty")
Edit = dict[str, Any]


def golden_values(folder: Path) -> dict[str, Any]:
    """Return head hashes and counts; the chain is computed again without times."""
    return _replayed(folder) | dict(_imported(folder))


def _replayed(folder: Path) -> dict[str, Any]:
    call(folder, "new", "replayed", "--simulate", SEED, "--frames", f"0:{FRAMES}")
    refused, reasons = [], []
    with Workspace.open(folder / "replayed").open_labels() as store:
        for number, act in enumerate(_Editor(store.path, SEED).steps(store)):
            try:
                act()
            except SemvizError as error:
                refused.append(number)
                reasons.append(str(error))
    call(folder, "labels", "export", "replayed", "replayed.jsonl")
    lines = (folder / "replayed.jsonl").read_text().splitlines()
    header, log = json.loads(lines[0]), [json.loads(line) for line in lines[1:]]
    checked = json.loads(call(folder, "labels", "check", "replayed", "--json"))
    real_head = checked.pop("hash")
    kinds = Counter(f"{entry['kind']} by {entry['origin']}" for entry in log)
    texts = [state["text"] for state in log]
    masked = [entry | {"time": "", "text": ""} for entry in log]
    return {
        "replayed: check": checked,
        "replayed: the chain follows the rule of the format": chained(log) == real_head,
        "replayed: head without times and texts": chained(masked),
        "replayed: the header's hash is the last one": header.pop("hash") == real_head,
        "replayed: header": header,
        "replayed: kinds": dict(sorted(kinds.items())),
        "replayed: refused": refused,
        "words: refusals": digest(reasons),
        "words: texts of operations": digest(texts),
    }


def chained(log: list[dict[str, Any]]) -> str:
    """Return the head hash of a log, computed by the rule of the format."""
    head = ""
    for entry in log:
        content = {name: value for name, value in entry.items() if name != "hash"}
        text = json.dumps(content, sort_keys=True, separators=(",", ":"))
        head = hashlib.sha256((head + text).encode()).hexdigest()
    return head


def _imported(folder: Path) -> Iterator[tuple[str, Any]]:
    """Import and export logs with their times, byte for byte."""
    logs = {
        "version 1": gzip.decompress((FIXTURES / "version-1.jsonl.gz").read_bytes()),
        "town": gzip.decompress((FIXTURES / "town.jsonl.gz").read_bytes()),
        "lane": gzip.decompress((FIXTURES / "lane.jsonl.gz").read_bytes()),
    }
    for name, log in logs.items():
        (folder / f"{name}.jsonl").write_bytes(log)
        call(folder, "new", name, "--simulate", 2, "--frames", "0:60")
        call(folder, "labels", "import", name, f"{name}.jsonl")
        yield f"{name}: check", json.loads(call(folder, "labels", "check", name, "--json"))
        call(folder, "labels", "export", name, f"{name} again.jsonl")
        yield f"{name}: log", sha((folder / f"{name} again.jsonl").read_bytes())


class _Editor:
    """Makes seeded edits of a label file, of which some must be refused."""

    def __init__(self, path: Path, seed: int) -> None:
        self._path = path
        self._rng = np.random.default_rng(seed)
        self._elements: list[tuple[str, int]] = []
        self._observations: list[str] = []

    def steps(self, store: Any) -> Iterator[Callable[[], object]]:
        for number in range(STEPS):
            self._read_ids()
            author, request = AUTHORS[self._below(2)], self._id()
            last = store.last_operation
            if number % 10 == 9:
                yield lambda a=author, r=request: store.undo(a, r)
            elif number % 20 == 18:
                yield lambda a=author, r=request: store.redo(a, r)
            elif number % 97 == 96:
                back = last - self._below(20)
                yield lambda a=author, r=request, n=back: store.restore(n, a, r)
            elif number % 89 == 88:
                yield lambda a=author, r=request, n=number: store.name_state(f"state {n}", a, r)
            else:
                edit = self._edit()
                origin = "machine" if self._below(8) == 0 else "human"
                yield lambda e=edit, a=author, r=request, o=origin: store.apply(
                    edit_from_json(e), a, r, o
                )

    def _read_ids(self) -> None:
        with closing(sqlite3.connect(self._path)) as file:
            self._elements = file.execute(
                "SELECT id, class_id FROM elements ORDER BY id"
            ).fetchall()
            rows = file.execute("SELECT id FROM observations ORDER BY id")
            self._observations = [row for (row,) in rows]

    def _edit(self) -> Edit:
        if len(self._elements) < 12 or len(self._observations) < 12:
            return self._new()
        (a, class_id), (b, _), (c, _) = (self._one(self._elements) for _ in range(3))
        row, other = self._one(self._observations), self._one(self._observations)
        alike = [element for element, of in self._elements if of == class_id][:3]
        place, new = self._place(), self._new()
        more = self._observed(new["element_id"], self._place(), new["class_id"] == 0)
        choices: list[Edit] = [
            new,
            new,
            {"kind": "add many", "observations": [new, more]},
            self._observed(a, place, class_id == 0),
            self._observed(a, place, class_id == 0),
            {"kind": "move", "observation_id": row, "anchor_px": self._pixel(), "end_px": None},
            {"kind": "set known", "observation_id": row, "anchor_known": bool(self._below(2))},
            {"kind": "swap ends", "observation_id": row},
            {"kind": "delete", "observation_id": row},
            {"kind": "delete many", "observation_ids": [row, other]},
            {"kind": "delete element", "element_id": a},
            {"kind": "link", "element_ids": [a, alike[-1]]},
            {"kind": "link", "element_ids": alike},
            {"kind": "unlink", "observation_ids": [row], "new_element_id": self._id()},
            {"kind": "set class", "element_id": a, "class_id": self._below(4)},
            {"kind": "review", "frame_index": self._below(FRAMES), "state": self._state()},
            {"kind": "dismiss", "dismissals": [self._dismissal(a, place)]},
            {"kind": "judge", "judgements": [self._apart(a, b)]},
            {"kind": "judge", "judgements": [self._judged(c), self._judged(a)]},
            {"kind": "take back", "judgement_id": derived_id(f"judgement {a}")},
        ]
        return choices[self._below(len(choices))]

    def _state(self) -> str:
        return STATES[self._below(4)]

    def _place(self) -> Edit:
        return {"frame_index": self._below(FRAMES), "side": ("left", "right")[self._below(2)]}

    def _new(self) -> Edit:
        class_id = self._below(4)
        return self._observed(self._id(), self._place(), class_id == 0) | {"class_id": class_id}

    def _observed(self, element: str, place: Edit, is_pole: bool) -> Edit:
        end = self._pixel() if is_pole else None
        names = {"kind": "add", "observation_id": self._id(), "element_id": element}
        return names | place | {"anchor_px": self._pixel(), "end_px": end}

    def _dismissal(self, element: str, place: Edit) -> Edit:
        name = derived_id(f"{element} {place['frame_index']} {place['side']}")
        why = ("rejected", "occluded", "absent")[self._below(3)]
        return {"id": name, "why": why, "element_id": element} | place

    @staticmethod
    def _apart(a: str, b: str) -> Edit:
        first, second = sorted((a, b))
        name = derived_id(f"judgement {first} {second}")
        return {"id": name, "verdict": "apart", "element_id": first, "other_id": second}

    def _judged(self, a: str) -> Edit:
        verdict = ("keep", "leave out")[self._below(2)]
        name = derived_id(f"judgement {a}")
        return {"id": name, "verdict": verdict, "element_id": a, "other_id": None}

    def _below(self, end: int) -> int:
        return int(self._rng.integers(end))

    def _one(self, rows: list[Any]) -> Any:
        return rows[self._below(len(rows))]

    def _pixel(self) -> list[float]:
        return [float(value) for value in self._rng.uniform(0.0, 370.0, 2)]

    def _id(self) -> str:
        return derived_id(f"golden {self._rng.integers(2**60)}")


def derived_id(text: str) -> str:
    """Return a UUID of version 8 from the SHA-256 of ``text``, as in label files."""
    value = int.from_bytes(hashlib.sha256(text.encode()).digest()[:16])
    value = value & ~(0xF << 76) | 8 << 76
    return str(uuid.UUID(int=value & ~(0b11 << 62) | 0b10 << 62))
