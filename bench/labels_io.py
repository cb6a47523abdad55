"""Time to import and export labels in each format, and to import a detector's proposals.

    python bench/labels_io.py
    python bench/labels_io.py --labels 100000 --proposals 10000

The labels are synthetic: poles and signs in ten images each. Times include writing to disk.
"""

import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import tyro

from semviz_annotation.label_formats.exchange import (
    ForeignFormat,
    export_labels,
    import_labels,
)
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.labels import LabelElement, Observation
from semviz_annotation.labels.proposals import load_proposals, read_proposals, save_proposals
from semviz_annotation.labels.rows import derived_id
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.pose import Pose

CAMERA = Camera(1241, 376, np.array([[718.9, 0.0, 607.2], [0.0, 718.9, 185.2], [0.0, 0.0, 1.0]]))
RIG = Rig(CAMERA, CAMERA, Pose(np.eye(3), np.array([-0.54, 0.0, 0.0])))
IMAGES_OF_ONE = 10


@dataclass(frozen=True)
class Options:
    labels: int = 20_000
    proposals: int = 10_000
    seed: int = 0


@contextmanager
def timed(what: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    print(f"{what:<44}{time.perf_counter() - start:8.2f} s", flush=True)


def main(options: Options) -> None:
    rng = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        time_proposals(folder, options.proposals, rng)
        with LabelStore.open(folder / "labels.db", rig=RIG) as store:
            with timed(f"{options.labels} labels into a label file"):
                store.apply(made_up(options.labels, rng), "bench")
            for format_ in get_args(ForeignFormat):
                time_format(folder, store, format_)


def time_format(folder: Path, store: LabelStore, format_: ForeignFormat) -> None:
    out = folder / format_
    with timed(f"{format_}: out"):
        export_labels(store, out, format_)
    if out.is_file():
        print(f"    {out.stat().st_size / 1e6:.1f} MB")
    (folder / f"{format_}-in").mkdir()
    with (
        LabelStore.open(folder / f"{format_}-in" / "labels.db", rig=RIG) as other,
        timed(f"{format_}: in"),
    ):
        import_labels(out, other, "bench")


def time_proposals(folder: Path, count: int, rng: np.random.Generator) -> None:
    rows: list[dict[str, Any]] = []
    for number in range(count):
        u, v = map(float, rng.uniform(0, 300, 2))
        row = {"frame_index": number // 20, "side": ("left", "right")[number % 2]}
        proposal = {"class": "pole", "anchor_px": [u, v], "end_px": [u, v + 50.0]}
        rows.append({**row, **proposal, "score": float(rng.random()), "sigma_px": 1.5})
    document = {"format": "semviz-proposals", "version": 1, "proposals": rows}
    (folder / "found.json").write_text(json.dumps(document))
    path = folder / "proposals.parquet"
    for source in (folder / "found.json", path):
        with timed(f"{count} proposals read from {source.suffix}, stored"):
            save_proposals(load_proposals(path).joined(read_proposals(source, rig=RIG)), path)


def made_up(count: int, rng: np.random.Generator) -> ImportLabels:
    elements, rows = [], []
    for number in range(1, -(-count // IMAGES_OF_ONE) + 1):
        element = LabelElement(derived_id(f"{number}"), number, number % 4)
        elements.append(element)
        for image in range(IMAGES_OF_ONE):
            u, v = map(float, rng.uniform(0, 300, 2))
            is_pole = element.class_id == 0
            rows.append(
                Observation(
                    derived_id(f"{number} {image}"), element.id, number // 10 + image // 2,
                    "right" if image % 2 else "left", (u, v), (u, v + 50.0) if is_pole else None,
                    anchor_known=True, end_known=is_pole,
                )
            )  # fmt: skip
    return ImportLabels(tuple(elements), tuple(rows[:count]))


if __name__ == "__main__":
    main(tyro.cli(Options))
