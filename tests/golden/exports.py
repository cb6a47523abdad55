"""G9: a fixed map, labels and a run, written in every format and read back."""

import json
import shutil
from pathlib import Path
from typing import Any

from golden import workspaces
from golden.canonical import digest, numbered_ids, sha
from golden.command import call
from golden.files import FIXTURES, masked, run_content, table_content, unpacked

ANCHOR = "--anchor=49.01,8.42,115"
LABELS = {
    "log": ("labels.jsonl",),
    "cvat": ("labels.xml",),
    "cvat left": ("left.xml", "--side", "left"),
    "cvat-video": ("video.xml", "--format", "cvat-video"),
    "cvat-video right": ("video-right.xml", "--format", "cvat-video", "--side", "right"),
    "labelme": ("labelme", "--format", "labelme"),
    "coco": ("labels.json",),
    "coco right": ("right.json", "--side", "right"),
}
READ_BACK = {
    "cvat": ("labels.xml",),
    "cvat-video": ("video.xml", "--side", "left"),
    "labelme": ("labelme",),
    "coco": ("labels.json",),
}
MAPS = {
    "geojson": ("map.geojson", ANCHOR, "--anchor-heading", "33"),
    "lanelet2": ("map.osm", ANCHOR),
    "colmap": ("model", "--format", "colmap"),
    "ply": ("map.ply",),
    "glb": ("map.glb",),
    "csv": ("map.csv",),
}
MAPS_BACK = {"geojson": ("map.geojson",), "lanelet2": ("map.osm", ANCHOR), "csv": ("map.csv",)}
VARYING = {"time", "hash", "author", "operations"}
"""Fields of a log that differ with every import, or with the number of lines."""
OPENDRIVE = """<?xml version="1.0"?><OpenDRIVE><header/><road id="1" length="100"><planView>
<geometry s="0" x="0" y="0" hdg="0.3" length="60"><line/></geometry>
<geometry s="60" x="57.3" y="17.7" hdg="0.3" length="40"><arc curvature="0.02"/></geometry>
</planView><objects>
<object id="1" type="pole" name="pole" s="20" t="4" zOffset="0" height="5" radius="0.1" hdg="0"/>
<object id="2" type="pole" name="pole" s="75" t="-4" zOffset="0.1" height="6" radius="0.1" hdg="0"/>
</objects><signals>
<signal id="3" s="30" t="5" zOffset="2.2" height="0.8" width="0.8" type="205" country="DE"
 dynamic="no" orientation="+" name="yield"/>
</signals></road></OpenDRIVE>
"""


def golden_values(folder: Path) -> dict[str, Any]:
    """Return hashes of the files, and the losses that the exports report."""
    workspaces.make(folder, "town")
    map_file = unpacked(FIXTURES / "main.parquet.gz", folder)
    shutil.copy(map_file, folder / "town" / "maps")
    return {**_labels(folder), **_maps(folder), **_poses(folder)}


def _labels(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, (file, *options) in LABELS.items():
        report = call(folder, "labels", "export", "town", file, "--json", *options)
        found[f"labels as {name}"] = content(folder / file)
        found[f"words: labels as {name}"] = _words(report)
        found[f"counts of labels as {name}"] = _counts(report)
    for name, (file, *options) in READ_BACK.items():
        call(folder, "new", f"from {name}", "--simulate", "7", "--frames", "0:24")
        report = call(folder, "labels", "import", f"from {name}", file, "--json", *options)
        found[f"counts of labels from {name}"] = _counts(report)
        call(folder, "labels", "export", f"from {name}", f"{name}.jsonl")
        found[f"labels from {name}"] = _log_content(folder / f"{name}.jsonl")
    return found


def _maps(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, (file, *options) in MAPS.items():
        report = call(folder, "map", "export", "town", file, "--json", *options)
        found[f"map as {name}"] = content(folder / file)
        found[f"words: map as {name}"] = _words(report)
        found[f"counts of map as {name}"] = _counts(report)
    (folder / "road.xodr").write_text(OPENDRIVE)
    for name, (file, *options) in (MAPS_BACK | {"opendrive": ("road.xodr",)}).items():
        report = call(folder, "map", "import", "town", file, "--name", name, "--json", *options)
        found[f"counts of map from {name}"] = _counts(report)
        found[f"map from {name}"] = table_content(folder / "town" / "maps" / f"{name}.parquet")
    return found


def _poses(folder: Path) -> dict[str, Any]:
    """Return the exported poses of the workspace and of a recorded run."""
    run = unpacked(FIXTURES / "run-version-3.rrd.gz", folder)
    found: dict[str, Any] = {"run": digest(run_content(run))}
    for name, source, *options in (
        ("workspace", "town"), ("run", run.name), ("run's truth", run.name, "--truth"),
    ):  # fmt: skip
        for format_ in ("tum", "kitti"):
            file = f"{name} {format_}.txt"
            call(folder, "trajectory", source, file, "--format", format_, *options)
            found[f"poses of {name} as {format_}"] = content(folder / file)
    return found


def content(path: Path) -> Any:
    """Return the hash of a file, with times and versions masked in texts; of a folder, of each
    file."""
    if path.is_dir():
        return {file.name: content(file) for file in sorted(path.iterdir())}
    try:
        return sha(masked(path.read_text(encoding="utf-8"), ids=False))
    except UnicodeDecodeError:
        return sha(path.read_bytes())


def _log_content(path: Path) -> str:
    """Return the hash of an imported log, with numbered ids, and without times and hashes."""
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    kept = [{key: line[key] for key in line.keys() - VARYING} for line in lines]
    return sha(numbered_ids(json.dumps(kept, sort_keys=True)))


def _counts(report: str) -> Any:
    """Return the numbers of a report, without their names."""
    values = json.loads(report)
    return {key: _numbers(value) for key, value in values.items() if key not in ("path", "map")}


def _numbers(value: Any) -> Any:
    return sorted(value.values()) if isinstance(value, dict) else value


def _words(report: str) -> str:
    values = json.loads(report)
    return digest({key: list(value) for key, value in values.items() if isinstance(value, dict)})
