"""What the result for a drive was made from, so that a batch sees when that has changed.

Images are not looked at, since reading them all would take as long as the work.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from itertools import pairwise
from pathlib import Path

from semviz.batch.batch import DriveOutcome, Plan
from semviz.collection.collection import Drive
from semviz.workspace.drive.drive_file import DRIVE_FILE
from semviz.workspace.poses.pose_choices import FILE as POSE_CHOICES
from semviz.workspace.poses.pose_review import FILE as MOTIONS
from semviz.workspace.settings import SETTINGS, KittiSettings, find_place
from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.storage.integrity import last_hash
from semviz_core.common.errors import SemvizError

_READERS = 8
"""Workspaces that are read at once."""


def inputs_of(plan: Plan, drive: Drive) -> dict[str, str]:
    """Return a digest of each thing that the command of a batch reads of a drive, by its name;
    nothing if the workspace cannot be read, which the command will say."""
    try:
        workspace = Workspace.open(drive.workspace)
        found = {name: _digest(path) for name, path in _files(plan, drive, workspace)}
        if plan.command != "detect" and workspace.labels_path.is_file():
            found["labels"] = last_hash(workspace.labels_path)
    except (SemvizError, OSError):
        return {}
    return {name: digest for name, digest in found.items() if digest}


def changes_since(
    plan: Plan, done: Sequence[tuple[Drive, DriveOutcome]]
) -> tuple[dict[str, list[str]], int]:
    """Return the names of what has changed since drives were done, by drive; and how many drives
    cannot be read here."""
    with ThreadPoolExecutor(_READERS) as readers:
        now = list(readers.map(lambda one: inputs_of(plan, one[0]), done))
    again = {
        drive.name: changed
        for (drive, outcome), inputs in zip(done, now, strict=True)
        if (changed := changed_inputs(outcome.inputs, inputs))
    }
    return again, now.count({})


def changed_inputs(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return the names of what differs, sorted; none if either is not known."""
    if not before or not now:
        return []
    return sorted(name for name in {*before, *now} if before.get(name) != now.get(name))


def _files(plan: Plan, drive: Drive, workspace: Workspace) -> Iterator[tuple[str, Path]]:
    """Yield the files that the command may read, which need not exist, and what they are called."""
    path, source = workspace.path, workspace.settings.source
    for name in (SETTINGS, DRIVE_FILE):
        yield name, path / name
    if isinstance(source, KittiSettings):
        if source.poses:
            yield "poses", find_place(path, "poses", source.poses)
        else:
            root = find_place(path, "root", source.root)
            yield "poses", root / "poses" / f"{source.sequence}.txt"
    for option in plan.options_for(drive):
        for value in (option, option.partition("=")[2]):
            if Path(value).is_absolute():
                yield value, Path(value)
    if plan.command == "detect":
        return
    for name in (POSE_CHOICES, MOTIONS, "detector.calibration.toml"):
        yield name, path / name
    yield "detections", workspace.proposals_path
    if plan.command == "localize" and plan.map_version is None:
        name = _map_name(plan.options_for(drive))
        yield f"map {name}", workspace.map_path(name)


def _map_name(options: list[str]) -> str:
    """Return the name of the map that options of localize choose."""
    for option, after in pairwise([*options, ""]):
        name, equals, value = option.partition("=")
        if name == "--map":
            return value if equals else after
    return MAIN


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file; empty if there is none."""
    return sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
