"""The readers that ``fuzz.py`` attacks: a file's name, and all that is done with its content.

Each takes the bytes of one file and may raise SemvizError only. Label formats go on through the
plan of an import up to new labels; the database has tests of its own. ``fuzz_drive_readers`` has
the readers of own drives.
"""

import json
import shutil
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fuzz_drive_readers as drive
import numpy as np
from fuzz_corpus import CALIBRATION, CORPUS, RIG, TIMES, run_rows
from map_files import small_map

from semviz.runs import reader as run_reader
from semviz.runs import run
from semviz.runs.stored_run import open_run
from semviz.workspace import settings
from semviz.workspace.localization import foreign_results
from semviz.workspace.maps import map_decisions
from semviz.workspace.poses import pose_choices
from semviz_annotation.label_formats.coco import read_coco
from semviz_annotation.label_formats.cvat import read_cvat
from semviz_annotation.label_formats.import_context import LabelImportContext
from semviz_annotation.label_formats.import_plan import ImportLabels, plan_import
from semviz_annotation.label_formats.labelme import read_labelme
from semviz_annotation.label_formats.reading import ParsedLabels
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposals import load_proposals, read_proposals
from semviz_annotation.labels.rows import Rules
from semviz_annotation.map_formats.conversion import MapImportContext
from semviz_annotation.map_formats.exchange import ImportFormat, import_map
from semviz_annotation.mapping.backdrop import load_backdrop
from semviz_core.base.classes import DEFAULT_CLASSES
from semviz_core.base.detector_model import DetectorCalibration
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Frame
from semviz_core.base.map_file import load_map
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame
from semviz_core.base.weights import read_weights
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import decode_image
from semviz_core.datasets.kitti import KittiSequence
from semviz_core.datasets.trajectory import load_trajectory
from semviz_core.detection.foreign_models import OnnxSettings
from semviz_core.detection.model_config import model_classes, read_settings
from semviz_core.pose_checks.image_motions import load_motions
from semviz_core.research.evaluation.roads import kitti_road
from semviz_core.research.training import annotated_images
from semviz_core.research.training.annotated_images import MASK_TABLE, SegmentationImages

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
            shutil.copy(CORPUS / "image" / "grey.png", folder / f"image_{camera}" / "000000.png")
        (folder / "times.txt").write_text(TIMES)
    shutil.copy(path, folder / "calib.txt")
    KittiSequence(path.parent, "07")


def _poses(path: Path) -> None:
    """``path`` is KITTI's file of poses, and a trajectory."""
    (path.parent / "calib.txt").write_text(CALIBRATION)
    _kitti(path.parent / "calib.txt")
    (path.parent / "poses").mkdir(exist_ok=True)
    shutil.copy(path, path.parent / "poses" / "07.txt")
    drive.all_of(lambda: KittiSequence(path.parent, "07"), lambda: load_trajectory(path))


def _run(path: Path) -> None:
    """A whole file."""
    run_reader.check_run_file(path)
    try:
        rows, damaged = run_reader.read_rows(path)
    except OSError:
        return
    run_reader.assemble(path, rows, damaged)


def _opened_run(path: Path) -> None:
    """A whole file, whose frames are read one by one, with those that are damaged left out."""
    opened = open_run(path)
    for position in range(len(opened.frames)):
        with suppress(SemvizError):
            _ = opened.frames[position]


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
    """Up to the places of its images."""
    read = settings.read_settings(path.parent)
    for name, relative in settings.places_of(read.source).items():
        settings.find_place(path.parent, name, relative)


def _model(path: Path) -> None:
    settings = read_settings(path, OnnxSettings)
    model_classes(settings.label_names, settings.classes, DEFAULT_CLASSES, path)


def _weights(path: Path) -> None:
    read_weights(path).check("matcher", DEFAULT_CLASSES, path)


def _card(path: Path) -> None:
    """``path`` is the model card of weights that are right."""
    weights = CORPUS / "weights" / "small.safetensors"
    shutil.copy(weights, path.with_suffix(".safetensors"))
    read_weights(path.with_suffix(".safetensors"))


def _detector_calibration(path: Path) -> None:
    calibration = DetectorCalibration.load(path)
    top, bottom = np.array([[10.0, 20.0], [30.0, 40.0]]), np.array([[10.0, 90.0], [30.0, 90.0]])
    calibration.calibrated(Elements2D.from_ends(top, bottom, np.array([0, 1])))
    calibration.detector_model(calibration.least_score)
    calibration.save(path.with_name("again.toml"))
    assert DetectorCalibration.load(path.with_name("again.toml")).least_score <= 1.0


def _segmentation(path: Path) -> None:
    """``path`` describes a data set of two images and their masks."""
    for name in ("images", "masks"):
        if not (path.parent / name).is_dir():
            (path.parent / name).mkdir()
            for file in ("a.png", "b.png"):
                shutil.copy(CORPUS / "mask" / "ids.png", path.parent / name / file)
    images = SegmentationImages.of(path.parent, path.parent / "prepared")
    images.describe()
    images.prepare(0)


def _mask(path: Path) -> None:
    """``path`` is an image and its mask, of ids and of colours."""
    folder = path.parent
    for kind, key in (("ids", "2"), ("colours", "#c0c080")):
        table = f'images = "*.png"\nmasks = "{{name}}.png"\nclasses = {{"{key}" = "pole"}}\n'
        (folder / kind).mkdir(exist_ok=True)
        (folder / kind / MASK_TABLE).write_text(table)
        for name in ("a.png", "b.png"):
            shutil.copy(path, folder / kind / name)
    ids, colours = (SegmentationImages.of(folder / kind, folder) for kind in ("ids", "colours"))
    drive.all_of(lambda: ids.prepare(0), lambda: colours.prepare(0))


def _boxes(path: Path) -> None:
    """``path`` describes a data set of two images and their boxes."""
    for folder, name, source in (
        ("images", "a.png", CORPUS / "mask" / "ids.png"),
        ("images", "b.png", CORPUS / "mask" / "ids.png"),
        ("labels", "a.txt", CORPUS / "box-file" / "yolo.txt"),
        ("labels", "b.txt", CORPUS / "box-file" / "yolo.txt"),
        ("labels", "boxes.json", CORPUS / "box-file" / "coco.json"),
    ):
        if not (path.parent / folder / name).is_file():
            (path.parent / folder).mkdir(exist_ok=True)
            shutil.copy(source, path.parent / folder / name)
    annotated_images.BoxImages.of(path.parent, path.parent / "prepared").prepare(0)


def _box_file(path: Path) -> None:
    """``path`` is a COCO file, and the YOLO boxes of two images."""

    def read(kind: str, table: str, names: Sequence[str]) -> None:
        folder = path.parent / kind
        folder.mkdir(exist_ok=True)
        (folder / annotated_images.BOX_TABLE).write_text(table)
        for image in ("a.png", "b.png"):
            if not (folder / image).is_file():
                shutil.copy(CORPUS / "mask" / "ids.png", folder / image)
        for name in names:
            shutil.copy(path, folder / name)
        annotated_images.BoxImages.of(folder, folder / "prepared").prepare(0)

    coco, yolo = (CORPUS / "boxes" / f"{kind}.toml" for kind in ("coco", "yolo"))
    drive.all_of(
        lambda: read("coco", _flat(coco), ["boxes.json"]),
        lambda: read("yolo", _flat(yolo), ["a.txt", "b.txt"]),
    )


def _flat(table: Path) -> str:
    """Return a table of boxes for images and boxes in its own folder."""
    text = table.read_text().replace('"images"', '"."')
    return text.replace("images/", "").replace("labels/", "")


def _pole_map(path: Path) -> None:
    """``path`` is an npz file of surveyed poles."""
    poses = path.with_name("poses.txt")
    poses.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1.5\n")
    kitti_road(poses, path, "road")


def _matches(path: Path) -> None:
    """``path`` is a table of another localizer's matches, and a JSON list of them."""
    semantic_map = small_map()

    def read(file: Path) -> None:
        file.write_bytes(path.read_bytes())
        for found in foreign_results.read_matches(file, semantic_map).values():
            found.matched_pose(None)

    drive.all_of(
        lambda: read(path.with_name("again.csv")), lambda: read(path.with_name("again.json"))
    )


def _with_checksum(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(b'{"crc32":%d,' % zlib.crc32(content) + content)


def _map_decisions(path: Path) -> None:
    _with_checksum(path)
    map_decisions.read_decisions(path).labels_here()


def _pose_choices(path: Path) -> None:
    _with_checksum(path)
    frames = [Frame(index, 0.1 * index, Pose.identity()) for index in range(3)]
    choices = pose_choices.read_choices(path)
    choices.applied(frames)


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
    "run-opened": Reader("input.rrd", _opened_run),
    "run-values": Reader("input.json", _run_values),
    "poses": Reader("input.txt", _poses),
    "calibration": Reader("input.txt", _kitti),
    "image": Reader("input.png", lambda path: decode_image(path.read_bytes(), path)),
    "settings": Reader("semviz.toml", _settings),
    "model": Reader("model.toml", _model),
    "weights": Reader("input.safetensors", _weights),
    "backdrop": Reader("backdrop.safetensors", load_backdrop),
    "card": Reader("input.json", _card),
    "motions": Reader("input.safetensors", lambda path: load_motions(path, "a source")),
    "detector-calibration": Reader("input.toml", _detector_calibration),
    "segmentation": Reader(MASK_TABLE, _segmentation),
    "mask": Reader("input.png", _mask),
    "boxes": Reader(annotated_images.BOX_TABLE, _boxes),
    "box-file": Reader("input", _box_file),
    "pole-map": Reader("input.npz", _pole_map),
    "camera-toml": Reader("input.toml", drive.calibration),
    "camera-yaml": Reader("input.yaml", drive.calibration),
    "camera-text": Reader("input.txt", drive.calibration),
    "drive-poses": Reader("input.txt", drive.poses),
    "drive-records": Reader("input.json", drive.poses),
    "drive-times": Reader("input.txt", drive.times),
    "colmap": Reader("input", drive.colmap),
    "nerfstudio": Reader("input.json", drive.nerfstudio),
    "drive-file": Reader("drive.json", drive.drive_file),
    "recording": Reader("input", drive.recording),
    "bag": Reader("input", drive.bag),
    "measured": Reader("input.csv", drive.measured),
    "matches": Reader("input", _matches),
    "pose-choices": Reader("pose_choices.json", _pose_choices),
    "map-decisions": Reader("map_decisions.json", _map_decisions),
}
