"""Write the corpus of ``fuzz.py``: small valid files of each reader, written by semviz itself.

python bench/fuzz_corpus.py      # replaces bench/corpus
"""

import csv
import hashlib
import json
import runpy
import shutil
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tests_support  # noqa: F401
from bags import KINDS
from drive_formats import CALIBRATIONS, colmap, colmap_binary, euroc, kitti, nerfstudio, stamps, tum
from fuzz_drive_readers import LAYOUTS, SMALL_K, recorded_tables, write_bag
from map_files import small_map

from semviz.runs import reader, run
from semviz.runs.writer import RunWriter
from semviz.workspace.drive.drive_file import CameraEntry, DriveFile, FrameEntry
from semviz.workspace.maps.map_decisions import ChangeDecision, ChangeDecisions, LabelPlace
from semviz.workspace.poses.pose_choices import PoseChoices, PoseOperation, RefinedPose
from semviz_annotation.label_formats.exchange import export_labels
from semviz_annotation.labels.edits import AddObservation
from semviz_annotation.labels.proposals import read_proposals, save_proposals
from semviz_annotation.labels.rows import derived_id
from semviz_annotation.map_formats.exchange import export_map
from semviz_annotation.map_formats.georeference import Georeference
from semviz_annotation.mapping.backdrop import Backdrop, BackdropSource, save_backdrop
from semviz_annotation.mapping.depth_fusion import FusionOptions
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.detector_model import (
    SHIPPED_DETECTOR,
    CalibratedRates,
    DetectorCalibration,
    ScoreCurve,
    SigmaScale,
)
from semviz_core.base.frame import Frame
from semviz_core.base.map_file import save_map
from semviz_core.base.pose import Pose
from semviz_core.base.weights import NetworkWeights
from semviz_core.datasets.own_drive.cameras.lens import OriginalCamera
from semviz_core.pose_checks.image_motions import ImageMotions, save_motions
from semviz_core.pose_checks.motion import Motion

CORPUS = Path(__file__).parent / "corpus"
CAMERA = Camera(640, 480, np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]))
RIG = Rig(CAMERA, CAMERA, Pose(np.eye(3), np.array([-0.5, 0.0, 0.0])))
CALIBRATION = "P2: 100 0 60 0 0 100 20 0 0 0 1 0\nP3: 100 0 60 -50 0 100 20 0 0 0 1 0\n"
TIMES = "0.0\n"
PROPOSALS = (
    '{"format":"semviz-proposals","version":1,"proposals":[{"frame_index":1,"side":"left",'
    '"class":"pole","anchor_px":[1,2],"end_px":[1.5,90],"score":0.5,"sigma_px":1.5},'
    '{"frame_index":2,"side":"right","class":"rounded sign","anchor_px":[9,9],"score":1}]}'
)
SETTINGS = """version = 1
name = "town"
[source]
kind = "kitti"
root = "../kitti"
sequence = "07"
cameras = [2, 3]
[source.frames]
first = 0
end = 10
step = 1
"""
MODEL = """model = "model.onnx"
kind = "segmentation"
labels = ["road", "pole", "traffic sign"]
outputs = ["logits"]
[input]
width = 640
height = 192
mean = [0.5, 0.5, 0.5]
[classes]
"pole" = "pole"
"2" = "sign"
"""
SEGMENTATION = """images = "images/*.png"
masks = "masks/{name}.png"
[classes]
"1" = "pole"
"2" = "sign"
"3" = "ignore"
"""
BOXES_COCO = """format = "coco"
images = "images"
boxes = "labels/boxes.json"
[classes]
"plate" = "sign"
"post" = "pole"
"tree" = "ignore"
"""
BOXES_YOLO = """format = "yolo"
images = "images/*.png"
boxes = "labels/{name}.txt"
[classes]
"0" = "sign"
"1" = "pole"
"2" = "ignore"
"""
COCO_BOXES = {
    "images": [{"id": id_, "file_name": f"{name}.png"} for id_, name in enumerate("ab")],
    "categories": [{"id": 1, "name": "plate"}, {"id": 2, "name": "post"}],
    "annotations": [
        {"image_id": image, "category_id": category, "bbox": box, "iscrowd": crowd}
        for image in range(2)
        for category, box, crowd in ((1, [60, 10, 20, 20], 0), (2, [20.5, 5, 6, 30], 1))
    ],
}
YOLO_BOXES = "0 0.58 0.5 0.17 0.5\n1 0.19 0.5 0.05 0.75\n2 0.9 0.5 0.1 0.1\n"
FIXES = """time_s,latency_s,latitude_deg,longitude_deg,height_m,heading_deg,horizontal_sigma_m
0.0,0.05,49.0,8.4,115,90,0.5
0.1,,49.00001,8.4,115,,
"""
POSED = """frame,x_m,y_m,z_m,qx,qy,qz,qw
0,0,0,0,0,0,0,1
1,1,0,0,0,0,0,1
2,2,0,0,0,0,0,1
"""
MATCHES = """frame,u_px,v_px,end_u_px,end_v_px,sigma_px,score,class,element
0,10,20,11,90,1.5,0.5,,4
0,30,20,,,,,,9
1,30,20,,,,,rounded sign,
"""
ACROSS = (1.0, 0.0, 0.0, -0.5, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
STEREO = """T_right_left = [[1, 0, 0, -0.12], [0, 1, 0, 0], [0, 0, 1, 0]]
T_body_left = [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]]
[left]
size_px = [64, 48]
model = "fisheye"
focal_px = [50.0, 50.0]
center_px = [31.5, 23.5]
distortion = [0.01, 0.0, 0.0, 0.0]
[right]
size_px = [64, 48]
model = "pinhole"
focal_px = [50.0, 50.0]
center_px = [31.5, 23.5]
"""
KALIBR_STEREO = """cam0:
  T_cam_imu: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  intrinsics: [50, 50, 31.5, 23.5]
  distortion_model: equidistant
  distortion_coeffs: [0.01, 0, 0, 0]
  resolution: [64, 48]
cam1:
  T_cn_cnm1: [[1, 0, 0, -0.12], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  intrinsics: [50, 50, 31.5, 23.5]
  distortion_model: none
  distortion_coeffs: []
  resolution: [64, 48]
"""
OPENDRIVE = """<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="6"/>
<road id="1" length="100" junction="-1"><planView>
<geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry>
<geometry s="50" x="50" y="0" hdg="0" length="50"><arc curvature="0.01"/></geometry></planView>
<elevationProfile><elevation s="0" a="1" b="0.01" c="0" d="0"/></elevationProfile>
<signals><signal id="5" s="10" t="-4" zOffset="2.2" type="274" subtype="50" country="DE"
 height="0.6" width="0.6" orientation="+" dynamic="no"/></signals>
<objects><object id="7" type="pole" s="60" t="4" zOffset="0" height="5" radius="0.1"/></objects>
</road></OpenDRIVE>
"""


def main() -> None:
    shutil.rmtree(CORPUS, ignore_errors=True)
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        _write_labels(work)
        _write_maps(work)
        _write_images()
        _write_tensors()
    _write("proposals", "small.json", PROPOSALS)
    save_proposals(
        read_proposals(CORPUS / "proposals" / "small.json"), _path("proposals-parquet", "small")
    )
    _write_run_values()
    _write("opendrive", "small.xodr", OPENDRIVE)
    _write("calibration", "calib.txt", CALIBRATION)
    _write("poses", "kitti.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 1.5\n")
    _write("poses", "tum.txt", "# t x y z q\n0 0 0 1.6 -0.5 0.5 -0.5 0.5\n")
    _write("settings", "kitti.toml", SETTINGS)
    _write("model", "segmentation.toml", MODEL)
    _write_detectors()
    _write_drives()


def _path(reader_name: str, name: str) -> Path:
    path = CORPUS / reader_name / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write(reader_name: str, name: str, text: str) -> None:
    _path(reader_name, name).write_text(text, "utf-8")


def _write_labels(work: Path) -> None:
    with LabelStore.open(work / "labels.db", rig=RIG) as store:
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
        export_labels(store, _path("cvat", "images.xml"), "cvat")
        export_labels(store, _path("cvat", "tracks.xml"), "cvat-video")
        export_labels(store, _path("coco", "small.json"), "coco")
        export_labels(store, work / "labelme", "labelme")
    for file in sorted((work / "labelme").rglob("*.json")):
        shutil.copy(file, _path("labelme", f"{file.parent.name}-{file.name}"))


def _write_maps(work: Path) -> None:
    semantic_map, place = small_map(), Georeference(49.01, 8.42, 115.0, 33.0)
    save_map(semantic_map, _path("map", "small.parquet"))
    export_map(semantic_map, _path("geojson", "small.geojson"), "geojson", place)
    export_map(semantic_map, _path("lanelet2", "small.osm"), "lanelet2", place)
    export_map(semantic_map, _path("csv", "small.csv"), "csv")


def _write_images() -> None:
    grey = np.full((40, 120, 3), 90, np.uint8)
    for suffix in ("png", "jpg"):
        _path("image", f"grey.{suffix}").write_bytes(cv2.imencode(f".{suffix}", grey)[1].tobytes())


def _write_tensors() -> None:
    classes = ["pole", "triangular sign", "rectangular sign", "rounded sign"]
    weights = NetworkWeights("matcher", {"classes": classes}, {"a": np.ones((2, 3), np.float32)})
    weights.save(_path("weights", "small.safetensors"))
    source = BackdropSource("town", "0", np.array([0]), np.eye(4)[None, :3], FusionOptions())
    points, colors = np.ones((3, 3), np.float32), np.zeros((3, 3), np.uint8)
    save_backdrop(Backdrop(points, colors, 0.05, source), _path("backdrop", "small.safetensors"))


def _write_detectors() -> None:
    """What a detector is trained, calibrated and compared with."""
    rates = CalibratedRates(least_score=0.0, **SHIPPED_DETECTOR._asdict())
    curve = ScoreCurve(score=(0.1, 0.9), probability=(0.2, 0.8))
    DetectorCalibration(
        detector="a detector", model="0" * 64, measuring="edges", truth="images", least_score=0.3,
        scores={"pole": curve, "sign": curve}, sigma_scale=SigmaScale(pole_along=2.0),
        rates=(rates, rates.model_copy(update={"least_score": 0.5})),
    ).save(_path("detector-calibration", "small.toml"))  # fmt: skip
    _write("segmentation", "small.toml", SEGMENTATION)
    ids = np.zeros((40, 120), np.uint8)
    ids[5:35, 20:26], ids[10:30, 60:80] = 1, 2
    colors = np.array([[0, 0, 0], [128, 192, 192], [9, 9, 9]], np.uint8)[ids]
    for name, mask in (("ids", ids), ("colours", colors)):
        _path("mask", f"{name}.png").write_bytes(cv2.imencode(".png", mask)[1].tobytes())
    _write("boxes", "coco.toml", BOXES_COCO)
    _write("boxes", "yolo.toml", BOXES_YOLO)
    _write("box-file", "coco.json", json.dumps(COCO_BOXES))
    _write("box-file", "yolo.txt", YOLO_BOXES)
    np.savez(_path("pole-map", "small.npz"), poleparams=np.array([[9.0, 4.0, 0.1]]))
    weights = (CORPUS / "weights" / "small.safetensors").read_bytes()
    _write("card", "small.json", json.dumps({"sha256": hashlib.sha256(weights).hexdigest()}))
    frames = [Frame(index, 0.1 * index, None) for index in range(2)]
    motion = Motion(Pose(np.eye(3), np.ones(3)), np.eye(9), np.ones(9), 9, 0.5, 2.0)
    save_motions(
        ImageMotions.of(frames, True, [motion]), "a source", _path("motions", "small.safetensors")
    )


def _write_drives() -> None:
    """The files of an own drive."""
    for name, text in CALIBRATIONS.items():
        kind = {".toml": "toml", ".txt": "text"}.get(Path(name).suffix, "yaml")
        _write(f"camera-{kind}", name, text)
    _write("camera-toml", "stereo.toml", STEREO)
    _write("camera-yaml", "stereo.yaml", KALIBR_STEREO)
    _write("drive-times", "times.txt", "".join(f"{t}\n" for t in stamps()))
    names = [f"{time},{time}.png" for time in stamps()]
    _write("drive-times", "names.csv", "#time,name\n" + "\n".join(names))
    _write("measured", "fixes.csv", FIXES)
    _write("matches", "table.csv", MATCHES)
    rows = list(csv.DictReader(MATCHES.splitlines()))
    _write("matches", "list.json", json.dumps(rows))
    _write("measured", "poses.csv", POSED)
    _write("measured", "speeds.csv", "time_s,speed_mps,yaw_rate_degps\n0,10,1\n0.2,10,1\n")
    refined = RefinedPose(frame=1, T_map_camera=ACROSS)
    operation = PoseOperation(
        choice="refine", first=0, last=1, author="me", time="", given="0", poses=(refined,)
    )
    choices = PoseChoices(standing=1, operations=(operation,))
    _write("pose-choices", "small.json", choices.model_dump_json()[1:])
    decision = ChangeDecision(
        map="0", kind="vanished", name="P-01", class_name="pole", place_m=(0, 1, 2), answer="label",
        existence=0.5, passes=("may",), author="me", time="",
        label=LabelPlace(workspace=".", run="may", frame=1),
    )  # fmt: skip
    decisions = ChangeDecisions(decisions=(decision,))
    _write("map-decisions", "small.json", decisions.model_dump_json()[1:])
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        for write in (tum, kitti, euroc):
            shutil.copy(write(work), _path("drive-poses", write.__name__))
        names = "t_ns,x [m],y [m],z [m],qw,qx,qy,qz"
        _write("drive-poses", "names.csv", f"{names}\n1,0,0,1.6,1,0,0,0\n2,0,1,1.6,1,0,0,0\n")
        record = {"t_ns": 1, "position": {"x": 0, "y": 1, "z": 1.6}, "rotation": [1, 0, 0, 0]}
        _write(
            "drive-records", "named.json", json.dumps({"poses": [record, {**record, "t_ns": 2}]})
        )
        shutil.copy(nerfstudio(work), _path("nerfstudio", "small.json"))
        for write, kind in ((colmap, "txt"), (colmap_binary, "bin")):
            model = write(work)
            parts = [(model / f"{part}.{kind}").read_bytes() for part in ("cameras", "images")]
            _path("colmap", kind).write_bytes(b"\n%%%%\n".join(parts))
    camera = OriginalCamera("brown-conrady", 64, 48, SMALL_K, np.array([-0.1, 0.01, 0, 0]))
    entry = CameraEntry.of(camera)
    DriveFile(
        map_frame="town", left=entry, right=entry, T_right_left=ACROSS, most_view_deg=110.0,
        origin_m=(0.0, 0.0, 0.0), statements=(("poses", "TUM"),), warnings=("a warning",),
        frames=tuple(
            FrameEntry(index=index, time_s=0.1 * index, left=name, right=name, T_map_camera=ACROSS)
            for index, name in enumerate(f"{time}.png" for time in stamps()[:2])
        ),
    ).save(_path("drive-file", "small.json"))  # fmt: skip


def _write_run_values() -> None:
    structures = {
        entity: json.loads(str(rows[0][1][run.STRUCTURE][0]))
        for entity, rows in run_rows().items()
        if run.STRUCTURE in rows[0][1]
    }
    _write("run-values", "small.json", json.dumps(structures))


def write_run(path: Path) -> Path:
    """Write a run of one frame, without images: 290 kB, too much for the corpus."""
    made: dict[str, Any] = runpy.run_path(str(Path(__file__).parent / "recording.py"))
    semantic_map = made["make_map"](length_m=20.0)
    with RunWriter(path, made["make_info"]("a run"), semantic_map) as writer:
        for record in made["make_records"](semantic_map, 1, None):
            writer.write(replace(record, image_file="000000.png"))
    return path


def write_recordings(folder: Path) -> None:
    """Write each file of the small recordings that tests read, but images, behind its name."""
    with tempfile.TemporaryDirectory() as name:
        for write in LAYOUTS:
            write(Path(name, write.__name__))
        for number, (file, path) in enumerate(recorded_tables(Path(name)).items()):
            (folder / f"{number}").write_bytes(file.encode() + b"\n" + path.read_bytes())


def write_bags(folder: Path) -> None:
    """Write a bag of two images, their calibration and odometry, of each kind."""
    with tempfile.TemporaryDirectory() as name:
        for kind in KINDS:
            path = Path(name, kind.replace(" ", ""))
            file = write_bag(path.with_suffix(".bag") if kind == "ROS 1" else path, kind)
            shutil.copy(file, folder / file.name)


def run_rows() -> dict[str, list[reader.Row]]:
    """Return the rows of a small run without checksums; their values may be changed."""
    return {
        entity: [
            (frame, {name: value for name, value in values.items() if name != run.CHECKSUM})
            for frame, values in rows
        ]
        for entity, rows in _readwrite_run().items()
    }


@cache
def _readwrite_run() -> dict[str, list[reader.Row]]:
    with tempfile.TemporaryDirectory() as folder:
        return reader.read_rows(write_run(Path(folder, "run.rrd")))[0]


if __name__ == "__main__":
    main()
