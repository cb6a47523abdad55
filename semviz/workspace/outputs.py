"""Check the output files of commands: what a command did not write itself is never overwritten.

A command may replace a file that it recognizes as its own, by its first bytes; with --force, any
other file. It never replaces a file that it reads, a folder, a device, or a file of a workspace
that is not the command's purpose. Links count as the file that they lead to.
"""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from semviz.workspace.settings import SETTINGS
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import HEAD_BYTES, IsOurs, check_output

_OWN: Final = {
    "settings": (re.compile(r"semviz\.toml"), "semviz.toml"),
    "places": (re.compile(r"places\.toml"), "places.toml"),
    "drive": (re.compile(r"drive\.json"), "drive.json"),
    "left-out": (re.compile(r"left-out\.csv"), "left-out.csv"),
    "rectified": (re.compile(r"rectified(/.*)?"), "rectified/**/*"),
    "recorded": (re.compile(r"recorded(/.*)?"), "recorded/**/*"),
    "checks": (re.compile(r"checks(/.*)?"), "checks/**/*"),
    "refined": (re.compile(r"calibration-refined\.toml"), "calibration-refined.toml"),
    "labels": (re.compile(r"labels\.db.*"), "labels.db*"),
    "proposals": (re.compile(r"proposals\.parquet"), "proposals.parquet"),
    "backdrop": (re.compile(r"backdrop\.safetensors"), "backdrop.safetensors"),
    "motions": (re.compile(r"image_motions\.safetensors"), "image_motions.safetensors"),
    "choices": (re.compile(r"pose_choices\.json"), "pose_choices.json"),
    "decisions": (re.compile(r"map_decisions\.json"), "map_decisions.json"),
    "calibration": (re.compile(r"detector\.calibration\.toml"), "detector.calibration.toml"),
    "people": (re.compile(r"people\.json"), "people.json"),
    "blind": (re.compile(r"blind(/.*)?"), "blind/**/*"),
    "kept": (re.compile(r"kept(/.*)?"), "kept/**/*"),
    "map": (re.compile(r"maps(/.*\.parquet)?"), "maps/**/*.parquet"),
    "run": (re.compile(r"runs(/.*\.rrd)?"), "runs/**/*.rrd"),
}
"""What a workspace holds, by the purpose of the commands that write it: the paths in its folder
that belong to it, existing or not, and how to list those that exist."""


MOST_NAME_BYTES = 200
"""File systems allow 255, with the ending and a temporary suffix."""


def checked_name(name: str) -> str:
    """Return the name of a map or run. Raise SemvizError if no file can have it."""
    fits = 0 < len(name.encode()) <= MOST_NAME_BYTES and name.isprintable()
    if not fits or name.startswith(".") or set(name) & set('/\\:*?"<>|'):
        raise SemvizError(f"{name!r} cannot be a file name; use letters, digits, '-' and '_'")
    return name


def check_outputs(
    paths: Path | Iterable[Path],
    is_ours: IsOurs,
    *,
    force: bool = False,
    can_force: bool = True,
    reads: Iterable[Path] = (),
    purpose: str = "",
) -> None:
    """Check all files that a command will write, before it does any work.

    ``reads`` are the files and workspaces that the command reads, ``purpose`` is the key of _OWN
    that it may replace. Raise SemvizError for the first file that must stay.
    """
    for path in [paths] if isinstance(paths, Path) else paths:
        _check_own(path, tuple(reads), purpose)
        check_output(path, is_ours, force=force and not _is_database(path), can_force=can_force)


def check_new_folder(path: Path, reads: Iterable[Path] = ()) -> None:
    """Check a folder that a command will make: it is no folder of a workspace.

    That it is empty is checked by ``check_empty``.
    """
    _check_own(path, tuple(reads), "")
    if path.exists() and not path.is_dir():
        raise SemvizError(f"{path}: exists and is not a folder; choose another name")


def check_empty(path: Path) -> None:
    """Raise SemvizError if there is something at ``path`` other than an empty folder."""
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise SemvizError(f"{path}: exists and is not empty; choose another name")


def starts_with(*starts: bytes) -> IsOurs:
    """Recognize files by their first bytes."""
    return lambda head: head.startswith(starts)


def contains(*marks: bytes) -> IsOurs:
    """Recognize files that hold all ``marks``, in this order, near their start."""
    pattern = re.compile(b".*?".join(map(re.escape, marks)), re.DOTALL)
    return lambda head: pattern.search(head) is not None


def never(head: bytes) -> bool:
    """Recognize nothing: the format has no place for a mark."""
    return False


PARQUET: Final = starts_with(b"PAR1")
PNG: Final = contains(b"\x89PNG", b"Software\0semviz")
RUN: Final = contains(b"RRF2", b"semviz")


DATABASE: Final = starts_with(b"SQLite format 3\0")


def _is_database(path: Path) -> bool:
    """Whether a file holds labels, perhaps by another name: not even --force replaces it."""
    try:
        if not path.is_file():  # opening a pipe would wait for ever
            return False
        with path.open("rb") as file:
            return DATABASE(file.read(HEAD_BYTES))
    except OSError:
        return False


def _check_own(path: Path, reads: tuple[Path, ...], purpose: str) -> None:
    """Raise SemvizError if ``path`` is a file that the command reads, or one of a workspace."""
    try:
        resolved = path.resolve()
        folders = {folder for folder in resolved.parents if (folder / SETTINGS).is_file()}
        folders |= {read.resolve() for read in reads if read.is_dir()}
        own = any(
            resolved.is_relative_to(folder)
            and _is_own(resolved.relative_to(folder).as_posix(), purpose)
            for folder in folders
        )
        if path.is_file() and not own:
            own = any(path.samefile(file) for file in reads if file.is_file())
            if path.stat().st_nlink > 1:
                files = (file for folder in folders for file in _files(folder, purpose))
                own = own or any(path.samefile(file) for file in files)
    except (OSError, RuntimeError) as error:  # of links in a circle, too
        raise SemvizError(f"{path}: cannot be written ({error}); choose another name") from None
    if own:
        raise SemvizError(
            f"{path}: belongs to a workspace, or is read by this command, and is never replaced "
            "by it; choose another name"
        )


def _is_own(name: str, purpose: str) -> bool:
    """Whether a path in a workspace is one of its files, apart from those of the purpose."""
    return any(own.fullmatch(name) for kind, (own, _) in _OWN.items() if kind != purpose)


def _files(folder: Path, purpose: str) -> Iterator[Path]:
    """Yield the files that a workspace holds, apart from those of the purpose."""
    for kind, (_, pattern) in _OWN.items():
        if kind != purpose:
            yield from (file for file in folder.glob(pattern) if file.is_file())
