"""How the fixtures were made, once; they are input, so they stay as they are.

    PYTHONPATH=tests python -m golden fixtures

town, lane, mono: logs of label operations. run-version-3: a run that ``semviz localize`` wrote.
main: a map that ``semviz map build`` wrote. version-1: a log of the first version (KITTI 02).
"""

import gzip
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from golden import workspaces
from golden.command import call
from golden.files import FIXTURES
from golden.label_log import derived_id
from semviz import Workspace
from semviz_annotation.labels.edits import edit_from_json

SIGMA_PX = {"town": 0.3, "lane": 1.5, "mono": 0.5}
MEMORY = {"town": 1000, "lane": 4, "mono": 1000}
"""After so many frames an element gets another name."""
WRONG = {"town": 0.0, "lane": 0.06, "mono": 0.0}
"""Share of observations under the name of another element."""


def make(folder: Path) -> None:
    """Write those that are missing; nothing is made anew."""
    FIXTURES.mkdir(exist_ok=True)
    for name in workspaces.NAMES:
        if not _path(f"{name}.jsonl").exists():
            _label(workspaces.make(folder, name, labelled=False), name)
            call(folder, "labels", "export", name, f"{name}.jsonl")
            _keep(folder / f"{name}.jsonl")
    call(folder, "map", "build", "town")
    if not _path("main.parquet").exists():
        _keep(folder / "town" / "maps" / "main.parquet")
    if not _path("run-version-3.rrd").exists():
        run = ("--frames", "4:12:4", "--out", "run-version-3.rrd", "--images", "embedded")
        call(folder, "localize", "town", *run)
        _keep(folder / "run-version-3.rrd")


def _path(name: str) -> Path:
    return FIXTURES / f"{name}.gz"


def _keep(path: Path) -> None:
    _path(path.name).write_bytes(gzip.compress(path.read_bytes(), mtime=0))


def _label(path: Path, name: str) -> None:
    """Everything that can be seen, an operation an image."""
    workspace = Workspace.open(path)
    street = workspace.street if name != "mono" else Workspace.open(path.parent / "street").street
    sides = ("left", "right") if name != "mono" else ("left",)
    known: set[str] = set()
    with workspace.open_labels() as store:
        for frame in street.frames:
            for side in sides:
                drawn = list(_drawn(street, name, frame.index, side, known))
                if drawn:
                    edit = {"kind": "add many", "observations": drawn}
                    store.apply(edit_from_json(edit), "golden", origin="human")


def _drawn(street: Any, name: str, index: int, side: str, known: set[str]) -> Iterator[Any]:
    rng = np.random.default_rng([street.seed, index, side == "right"])
    seen, ids = street.labels(index, side)
    corner = np.array([street.rig.left.width - 1.0, street.rig.left.height - 1.0])
    taken: set[str] = set()
    for row, thing in enumerate(ids.tolist()):
        if rng.random() < WRONG[name]:
            thing = int(rng.choice(ids))
        anchor, end = (
            (px[row] + rng.normal(0.0, SIGMA_PX[name], 2)).clip(0.0, corner).tolist()
            for px in (seen.anchor_px, seen.end_px)
        )
        is_line, class_id = bool(seen.is_line[row]), int(seen.class_id[row])
        element = derived_id(f"{name} {thing} {class_id} {(index + thing) // MEMORY[name]}")
        if element in taken or (is_line and np.hypot(*np.subtract(anchor, end)) < 3.0):
            continue
        taken.add(element)
        observed = {
            "kind": "add", "observation_id": derived_id(f"{name} {index} {side} {row}"),
            "element_id": element, "frame_index": index, "side": side, "anchor_px": anchor,
            "end_px": end if is_line else None, "anchor_known": bool(seen.anchor_known[row]),
            "end_known": is_line and bool(seen.end_known[row]),
        }  # fmt: skip
        yield observed if element in known else observed | {"class_id": class_id}
        known.add(element)
