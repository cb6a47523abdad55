"""The readers that ``fuzz.py`` attacks: a file's name, and all that is done with its content.

Each takes the bytes of one file and may raise SemvizError only. Label formats go on through the
plan of an import up to new labels; the database has tests of its own.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_corpus import CALIBRATION, RIG, TIMES, run_rows

from semviz.runs import reader as run_reader
from semviz.runs import run
from semviz.workspace import settings
from semviz_annotation.label_formats.coco import read_coco
from semviz_annotation.label_formats.cvat import read_cvat
from semviz_annotation.label_formats.import_plan import ImportLabels, plan_import
from semviz_annotation.label_formats.labelme import read_labelme
from semviz_annotation.label_formats.reading import LabelImportContext, ParsedLabels
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposals import load_proposals, read_proposals
from semviz_annotation.labels.rows import Rules
from semviz_annotation.map_formats.exchange import ImportFormat, import_map
from semviz_annotation.map_formats.reading import MapImportContext
from semviz_annotation.mapping.backdrop.backdrop import load_backdrop
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.map_file import load_map
from semviz_core.base.semantic_map import MapFrame
from semviz_core.base.weights import read_weights
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import decode_image
from semviz_core.datasets.kitti import KittiSequence
from semviz_core.datasets.trajectory import load_trajectory
from semviz_core.detection.model_config import model_classes, read_settings
from semviz_core.detection.onnx_model import OnnxSettings

Read = Callable[[Path], object]


@dataclass(frozen=True)
class Reader:
    """A reader, and the name of the file that it is given."""

    file: str
    read: Read


def _labels(read: Callable[[Path, LabelImportContext], ParsedLabels]) -> Read:
    rules = Rules(rig=RIG)
    context = LabelImportContext(rules, range(100), "left", {"car": "ignore"})

    def import_all(path: Path) -> None:
        plan = plan_import(read(path, context).observations, Labels())
        edit = ImportLabels(tuple(plan.elements), tuple(plan.observations))
        labels = Labels().changed(edit.changes(Labels(), rules))
        assert len(labels.observations) == len(plan.observations)

    return import_all


def _map(format_: ImportFormat) -> Read:
    context = MapImportContext(MapFrame("town"), class_map={"car": "ignore"})
    return lambda path: import_map(path, context, format_)


def _proposals(path: Path) -> None:
    read_proposals(path, rig=RIG, frames=range(100))
    load_proposals(path)


def _kitti(path: Path) -> None:
    """``path`` is a calib.txt; the rest of the sequence is right."""
    folder = path.parent / "sequences" / "07"
    if not folder.is_dir():
        for camera in (2, 3):
            (folder / f"image_{camera}").mkdir(parents=True)
            image = Path(__file__).parent / "corpus" / "image" / "grey.png"
            shutil.copy(image, folder / f"image_{camera}" / "000000.png")
        (folder / "times.txt").write_text(TIMES)
    shutil.copy(path, folder / "calib.txt")
    KittiSequence(path.parent, "07")


def _poses(path: Path) -> None:
    """``path`` is KITTI's file of poses, and a trajectory."""
    (path.parent / "calib.txt").write_text(CALIBRATION)
    _kitti(path.parent / "calib.txt")
    (path.parent / "poses").mkdir(exist_ok=True)
    shutil.copy(path, path.parent / "poses" / "07.txt")
    try:
        KittiSequence(path.parent, "07")
    except SemvizError as error:
        if "\n" in str(error):
            raise ValueError("more than one line") from error
    load_trajectory(path)


def _run(path: Path) -> None:
    """A whole file."""
    run_reader.check_run_file(path)
    try:
        rows, damaged = run_reader.read_rows(path)
    except OSError:
        return
    run_reader.assemble(path, rows, damaged)


def _run_values(path: Path) -> None:
    """The structure of a run's values, as JSON by entity; their numbers are right."""
    rows = run_rows()
    try:
        structures: Any = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        structures = {run.INFO: path.read_bytes().decode(errors="surrogateescape")}
    if isinstance(structures, dict):
        for entity, structure in structures.items():
            for _, values in rows.get(entity, []):
                text = structure if isinstance(structure, str) else json.dumps(structure)
                values[run.STRUCTURE] = np.array([text], object)
    run_reader.assemble(path, rows, False)


def _settings(path: Path) -> None:
    settings.read_settings(path.parent)


def _model(path: Path) -> None:
    settings = read_settings(path, OnnxSettings)
    model_classes(settings.label_names, settings.classes, DEFAULT_CLASSES, path)


def _weights(path: Path) -> None:
    read_weights(path).check("matcher", DEFAULT_CLASSES, path)


READERS: Mapping[str, Reader] = {
    "cvat": Reader("input.xml", _labels(read_cvat)),
    "labelme": Reader("input.json", _labels(read_labelme)),
    "coco": Reader("input.json", _labels(read_coco)),
    "proposals": Reader("input.json", _proposals),
    "proposals-parquet": Reader("proposals.parquet", _proposals),
    "geojson": Reader("input.geojson", _map("geojson")),
    "lanelet2": Reader("input.osm", _map("lanelet2")),
    "opendrive": Reader("input.xodr", _map("opendrive")),
    "csv": Reader("input.csv", _map("csv")),
    "map": Reader("input.parquet", load_map),
    "run": Reader("input.rrd", _run),
    "run-values": Reader("input.json", _run_values),
    "poses": Reader("input.txt", _poses),
    "calibration": Reader("input.txt", _kitti),
    "image": Reader("input.png", lambda path: decode_image(path.read_bytes(), path)),
    "settings": Reader("semviz.toml", _settings),
    "model": Reader("model.toml", _model),
    "weights": Reader("input.safetensors", _weights),
    "backdrop": Reader("backdrop.safetensors", load_backdrop),
}
