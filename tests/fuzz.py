"""Fuzz the readers of foreign formats: whatever a file holds, only a SemvizError may come out.

    pip install '.[fuzz]'
    python tests/fuzz.py cvat --runs 1000000
    python tests/fuzz.py labelme --runs 1000000
    python tests/fuzz.py coco --runs 1000000
    python tests/fuzz.py proposals --runs 1000000

Inputs grow from files that semviz itself writes, guided by coverage (atheris, libFuzzer): half of
them by changes that leave them JSON or XML, half by changes of bytes. It ends with the first input
that raises anything else, takes more than 30 s or more than 2 GB; libFuzzer keeps that input in the
current folder. What is read goes on through the plan of the import up to new labels, the database
excepted.
"""

import random
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import atheris
import tyro

with atheris.instrument_imports(include=["semviz_annotation"]):
    from semviz_annotation.edits import AddObservation
    from semviz_annotation.formats.coco import read_coco
    from semviz_annotation.formats.cvat import read_cvat
    from semviz_annotation.formats.exporting import export_labels
    from semviz_annotation.formats.labelme import read_labelme
    from semviz_annotation.formats.plan import ImportLabels, plan_import
    from semviz_annotation.formats.reading import Found, Reading
    from semviz_annotation.labels import Labels
    from semviz_annotation.proposals import read_proposals
    from semviz_annotation.rows import derived_id
    from semviz_annotation.rules import Rules
    from semviz_annotation.storing.store import LabelStore

import numpy as np
from mutations import mutated

from semviz_core.camera import Camera, Rig
from semviz_core.errors import SemvizError
from semviz_core.pose import Pose

READERS: Mapping[str, Callable[[Path, Reading], Found]] = {
    "cvat": read_cvat,
    "labelme": read_labelme,
    "coco": read_coco,
}
CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]))
RIG = Rig(CAMERA, CAMERA, Pose(np.eye(3), np.array([-0.5, 0.0, 0.0])))
WORDS = (
    "polyline", "points", "box", "track", "image", "outside", "occluded", "group_id", "element",
    "anchor_known", "end_known", "true", "false", "null", "NaN", "1e999", "-Infinity", "0.5;1,2",
    "keypoints", "bbox", "track_id", "attributes", "shape_type", "linestrip", "rectangle", "flags",
    "<!DOCTYPE a [<!ENTITY b 'c'>]>", "&b;", "<![CDATA[", "encoding='utf-16'", "\\\\ud800", "[[[[",
    "pole", "rounded sign", "left/000001.png", "image_3/000002.png",
)  # fmt: skip
PROPOSALS = (
    '{"format":"semviz-proposals","version":1,"proposals":[{"frame_index":1,"side":"left",'
    '"class":"pole","anchor_px":[1,2],"end_px":[1.5,90],"score":0.5,"sigma_px":1.5},'
    '{"frame_index":2,"side":"right","class":"rounded sign","anchor_px":[9,9],"score":1}]}'
)


@dataclass(frozen=True)
class Options:
    reader: tyro.conf.Positional[Literal["cvat", "labelme", "coco", "proposals"]]
    runs: int = 1_000_000
    seed: int = 1


def main(options: Options) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        corpus = folder / "corpus"
        corpus.mkdir()
        _write_seeds(options.reader, folder, corpus)
        words = folder / "words"
        quoted = (word.replace("\\", "\\\\").replace('"', '\\"') for word in WORDS)
        words.write_text("".join(f'"{word}"\n' for word in quoted))
        path = folder / ("input.xml" if options.reader == "cvat" else "input.json")

        def one_input(data: bytes) -> None:
            path.write_bytes(data)
            try:
                _read(options.reader, path)
            except SemvizError as error:
                line = str(error)
                line.encode()  # what the terminal does
                assert "\n" not in line, line
                assert len(line) < 2000, line

        limits = ["-max_len=8192", "-timeout=30", "-rss_limit_mb=2048"]
        amount = [f"-atheris_runs={options.runs}", f"-seed={options.seed}", f"-dict={words}"]
        arguments = [sys.argv[0], *amount, *limits, str(corpus)]
        atheris.Setup(arguments, one_input, custom_mutator=_mutate)
        atheris.Fuzz()


def _mutate(data: bytes, most: int, seed: int) -> bytes:
    rng = random.Random(seed)
    if rng.random() < 0.5:
        return bytes(atheris.Mutate(data, most))
    return mutated(data, rng)[:most]


def _read(reader: str, path: Path) -> None:
    """All that an import does, but for the database."""
    if reader == "proposals":
        read_proposals(path, rig=RIG, frames=range(100))
        return
    rules = Rules(rig=RIG)
    reading = Reading(rules, range(100), "left", {"car": "ignore"})
    found = READERS[reader](path, reading)
    plan = plan_import(found.seen, Labels())
    edit = ImportLabels(tuple(plan.elements), tuple(plan.observations))
    labels = Labels().changed(edit.changes(Labels(), rules))
    assert len(labels.observations) == len(plan.observations)


def _write_seeds(reader: str, folder: Path, corpus: Path) -> None:
    """Small valid files in each form that the reader understands."""
    if reader == "proposals":
        (corpus / "1").write_text(PROPOSALS)
        return
    with LabelStore.open(folder / "labels.db", rig=RIG) as store:
        for number, (frame, side, class_id) in enumerate(
            [(1, "left", 0), (1, "right", 0), (2, "left", 3), (4, "right", 1)]
        ):
            end = (20.25, 200.0) if class_id == 0 else None
            name = derived_id(f"element {class_id}")
            known = name in store.labels.elements
            edit = AddObservation(
                derived_id(f"observation {number}"), name, frame, side, (10.1, 20.0 + number), end,
                end_known=number > 0, class_id=None if known else class_id,
            )  # fmt: skip
            store.apply(edit, "fuzz")
        if reader == "cvat":
            export_labels(store, corpus / "images", "cvat")
            export_labels(store, corpus / "tracks", "cvat-video")
        elif reader == "coco":
            export_labels(store, corpus / "coco", "coco")
        else:
            export_labels(store, folder / "labelme", "labelme")
            for file in (folder / "labelme").rglob("*.json"):
                file.rename(corpus / f"{file.parent.name}-{file.stem}")


if __name__ == "__main__":
    main(tyro.cli(Options))
