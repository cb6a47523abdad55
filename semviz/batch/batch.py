"""A batch: one command for every drive of a collection, and what came of it.

Its files are in the collection, below ``batches/NAME``:

    plan.json             the command and its options; they never change
    done/DRIVE.json       that the command is done for a drive, and what it printed
    runs/DRIVE.rrd        of localize
    maps/DRIVE.parquet    of map
    frames/DRIVE.parquet  of evaluate: a row for each frame of the run

Each is written once and as a whole, the one in ``done`` after all others of its drive. So work that
is lost is done again, and work that two processes do at once counts once, whoever ends first. If
what a drive was done from has changed, its files are removed, and it is done again.
"""

import json
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

from semviz.collection.collection import Collection, Drive
from semviz.workspace.outputs import checked_name
from semviz_core.common.errors import SemvizError
from semviz_core.common.store import Store

BatchCommand: TypeAlias = Literal["detect", "localize", "map"]
Output: TypeAlias = Literal["runs", "maps", "frames"]
OUTPUTS: dict[Output, str] = {"runs": "rrd", "maps": "parquet", "frames": "parquet"}
"""Folders of outputs, and how their files end."""
_READERS = 16
"""Files that are read at once: an object store answers after a while, but many."""


@dataclass(frozen=True)
class Plan:
    """What a batch does for each drive."""

    command: BatchCommand
    options: tuple[str, ...] = ()
    """Of the command; ``{drive}`` stands for the name of the drive, ``{workspace}`` for its
    folder."""
    map_version: int | None = None
    """Version of the collection's map; None for the map of each workspace."""
    semviz: str = field(default_factory=lambda: version("semviz"))
    """Its version."""

    def options_for(self, drive: Drive) -> list[str]:
        """Return the options with the names of a drive in their places."""
        places = {"{drive}": drive.name, "{workspace}": drive.workspace}
        return [_filled(option, places) for option in self.options]

    def as_json(self) -> bytes:
        return json.dumps(asdict(self), indent=1).encode()

    @classmethod
    def from_json(cls, data: bytes, where: str) -> "Plan":
        """Raise SemvizError if ``data`` is no plan."""
        try:
            values = json.loads(data)
            plan = cls(**{**values, "options": tuple(values["options"])})
        except (ValueError, TypeError, KeyError):
            plan = None
        if plan is None or plan.command not in get_args(BatchCommand):
            raise SemvizError(f"{where}: no plan of a batch that this semviz reads")
        return plan


def _filled(option: str, places: Mapping[str, str]) -> str:
    for name, value in places.items():
        option = option.replace(name, value)
    return option


@dataclass(frozen=True)
class DriveOutcome:
    """What came of the command for one drive."""

    drive: str
    failure: str = ""
    """Why it failed; empty if it is done."""
    printed: dict[str, Any] = field(default_factory=dict)
    """The JSON object that the command printed."""
    notes: tuple[str, ...] = ()
    """Other lines of the command."""
    seconds: float = 0.0
    inputs: dict[str, str] = field(default_factory=dict)
    """Digests of what the result was made from, by name; see ``inputs``."""
    was_done: bool = False
    """Whether it had been done before."""


@dataclass(frozen=True)
class DriveBatch:
    """A batch of a collection."""

    store: Store
    name: str
    plan: Plan

    @classmethod
    def begin(cls, collection: Collection, name: str, plan: Plan) -> "DriveBatch":
        """Return the batch ``name``, new, or going on if it has the same plan.

        Raise SemvizError if it has another one.
        """
        batch = cls(collection.store, checked_name(name), plan)
        if batch.store.write_new(batch.key("plan.json"), plan.as_json()):
            return batch
        begun = cls.open(collection, name)
        if begun.plan != plan:
            raise SemvizError(
                f"batch {name}: has another plan ({_difference(begun.plan, plan)}); choose another "
                "--name, or give the same command to go on"
            )
        return begun

    @classmethod
    def find(cls, collection: Collection, name: str) -> "DriveBatch | None":
        """Return the batch ``name``; None if it was not begun."""
        store, key = collection.store, f"batches/{checked_name(name)}/plan.json"
        if not store.exists(key):
            return None
        return cls(store, name, Plan.from_json(store.read(key), f"{store.where}/{key}"))

    @classmethod
    def open(cls, collection: Collection, name: str) -> "DriveBatch":
        """Return an existing batch. Raise SemvizError if there is none of this name."""
        if (found := cls.find(collection, name)) is not None:
            return found
        names = sorted({key.split("/")[1] for key in collection.store.keys("batches/")})
        known = f"choose from {', '.join(names)}" if names else "there is none yet"
        raise SemvizError(f"{collection.store.where}: no batch {name}; {known}")

    def key(self, *parts: str) -> str:
        """Return the key of a file of the batch in the store."""
        return "/".join(("batches", self.name, *parts))

    def output(self, kind: Output, drive: str) -> str:
        """Return the key of an output."""
        return self.key(kind, f"{drive}.{OUTPUTS[kind]}")

    def drives_with(self, kind: Output) -> list[str]:
        """Return the names of the drives that have an output, sorted."""
        return _names(self.store, self.key(kind, ""))

    def done_before(self) -> list[DriveOutcome]:
        """Return what came of the drives that are done, by name."""
        names = _names(self.store, self.key("done", ""))
        with ThreadPoolExecutor(_READERS) as readers:
            return [one for one in readers.map(self.outcome, names) if one is not None]

    def outcome(self, drive: str) -> DriveOutcome | None:
        """Return what came of a drive that is done; None for another one. Raise SemvizError if the
        file that says so is damaged."""
        key = self.key("done", f"{drive}.json")
        if not self.store.exists(key):
            return None
        try:
            values = json.loads(self.store.read(key))
            printed, notes = values["printed"], tuple(values["notes"])
            seconds, inputs = values["seconds"], values.get("inputs", {})
            return DriveOutcome(drive, "", printed, notes, seconds, inputs, was_done=True)
        except (ValueError, TypeError, KeyError):
            raise SemvizError(
                f"{self.store.where}/{key}: damaged; delete it, and the drive is done again"
            ) from None

    def finish(self, done: DriveOutcome, outputs: Mapping[Output, Path]) -> DriveOutcome:
        """Store the outputs of a drive, then that it is done. What another process stored before
        stays, and is returned."""
        for kind, path in outputs.items():
            key = self.output(kind, done.drive)
            while not self.store.put_file_new(key, path):
                if (before := self.outcome(done.drive)) is not None:
                    return before
                self.store.remove(key)  # of a process that was killed, perhaps of other labels
        values = {
            "printed": done.printed,
            "notes": done.notes,
            "seconds": round(done.seconds, 3),
            "inputs": done.inputs,
        }
        data = json.dumps(values, indent=1).encode()
        if self.store.write_new(self.key("done", f"{done.drive}.json"), data):
            return done
        return self.outcome(done.drive) or done

    def forget(self, drive: str) -> None:
        """Remove what was stored for a drive, so that it is done again."""
        for kind in OUTPUTS:
            self.store.remove(self.output(kind, drive))
        self.store.remove(self.key("done", f"{drive}.json"))


def _names(store: Store, prefix: str) -> list[str]:
    return [key.removeprefix(prefix).rpartition(".")[0] for key in store.keys(prefix)]


def _difference(given: Plan, plan: Plan) -> str:
    old, new = asdict(given), asdict(plan)
    return "; ".join(
        f"{name.replace('_', ' ')} {_shown(old[name])}, not {_shown(new[name])}"
        for name in old
        if old[name] != new[name]
    )


def _shown(value: Any) -> str:
    return " ".join(value) or "none" if isinstance(value, tuple) else str(value)
