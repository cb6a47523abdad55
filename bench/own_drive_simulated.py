"""Map and localize simulated drives through lenses, and by a rig, and compare with a pinhole pair.

    python bench/own_drive_simulated.py [--frames 20] [--seeds 3,5]

Each street is recorded by a stereo pair without distortion, with Brown-Conrady and with
Kannala-Brandt lenses, and by a rig of four cameras with both, whose images are up to 41 ms apart.
The files are imported as a user would, everything visible is labelled 0.5 px off, a map is built,
and the (left, or front) camera is localized in it. Prints the errors of map and poses, over all
streets, and how many times those of the pinhole pair they are.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tests_support  # noqa: F401
from labelled_rig import SIGMA_PX, label

from semviz.workspace.localize import LocalizeOptions, localize_workspace
from semviz.workspace.workspace import Workspace
from semviz_annotation.mapping.build import build_map
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import save_map
from semviz_core.common.arrays import FloatArray
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.metrics.pose_errors import pose_error
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street
from semviz_core.simulation.street_rig import (
    CALIBRATION,
    POSES,
    MountedCamera,
    four_cameras,
    record_rig,
    stereo_pair,
)

DRIVES: dict[str, dict[str, MountedCamera]] = {
    "pinhole pair": stereo_pair("pinhole"),
    "Brown-Conrady pair": stereo_pair("brown-conrady"),
    "Kannala-Brandt pair": stereo_pair("fisheye"),
    "rig of four, front": four_cameras(),
}


class Errors(NamedTuple):
    """Of one drive."""

    labels: int
    map_m: FloatArray
    """(k,) of anchors, of elements placed to 0.5 m."""
    rte_m: FloatArray
    rre_deg: FloatArray
    """(n,) of frames that are ok."""
    frames: int
    import_s: float


def measure(street: Street, cameras: dict[str, MountedCamera], frames: int, folder: Path) -> Errors:
    """Record, import, label, map and localize one drive."""
    record_rig(folder / "drive", street, cameras, range(frames))
    start = time.process_time()
    drive = read_drive(_files(folder / "drive", cameras))
    workspace = Workspace.create_images(folder / "town", drive)
    workspace.source.image(workspace.source.frames[0].index, "left")
    seconds = time.process_time() - start
    labels = label(workspace, street, cameras, SIGMA_PX)
    built, _ = build_map(workspace.read_labels(), workspace.source)
    save_map(built, workspace.map_path("main"))
    records = list(localize_workspace(workspace, "main", LocalizeOptions()))
    errors = [
        pose_error(record.localization.T_camera_map, record.frame.T_map_camera.inverse())
        for record in records
        if record.localization.status == "ok"
        and record.localization.T_camera_map is not None
        and record.frame.T_map_camera is not None
    ]
    rte_m, rre_deg = np.array(errors).reshape(-1, 2).T
    return Errors(labels, _map_errors(built.elements, street), rte_m, rre_deg, frames, seconds)


def _files(folder: Path, cameras: dict[str, MountedCamera]) -> DriveFiles:
    """Return the recorded files as a user names them: of a pair, or of a rig."""
    names = tuple(cameras)
    common = {"poses": folder / POSES, "extrinsic": "camera"}
    if len(names) > 2:
        return DriveFiles(folder, rig=names, calibration=folder / CALIBRATION, **common)
    own = folder / "pair.toml"
    text = (folder / CALIBRATION).read_text()
    T_right_left = cameras["right"].T_body_camera.inverse().as_matrix()[:3].tolist()
    lines = [line for line in text.splitlines() if not line.startswith("T_body_camera")]
    head = f"T_right_left = {T_right_left}\n"
    own.write_text(head + "\n".join(lines).replace("[cameras.", "["))
    return DriveFiles(folder / "left", right=folder / "right", calibration=own, **common)


def _map_errors(built: Elements3D, street: Street) -> FloatArray:
    truth = street.truth_map.elements
    sigma_m = np.sqrt(np.trace(built.covariance_m2[:, :3, :3], axis1=1, axis2=2))
    rows = np.flatnonzero((sigma_m < 0.5) & built.anchor_known)
    apart = np.linalg.norm(built.anchor_m[rows][:, None] - truth.anchor_m[None], axis=2)
    return np.asarray(apart.min(axis=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--seeds", default="3,5")
    args = parser.parse_args()
    first: list[float] | None = None
    head = "drive | labels | elements | map, median (m) | ok | RTE, median (m) | RRE (deg) | times"
    print(f"| {head} |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    for name, cameras in DRIVES.items():
        found = []
        for seed in map(int, args.seeds.split(",")):
            street = Street(seed, StreetOptions(args.frames + 2))
            with tempfile.TemporaryDirectory() as folder:
                found.append(measure(street, cameras, args.frames, Path(folder)))
            print(f"{name}, street {seed}: import {found[-1].import_s:.1f} s CPU", file=sys.stderr)
        map_m, rte_m, rre_deg = (
            np.concatenate([getattr(one, field) for one in found])
            for field in ("map_m", "rte_m", "rre_deg")
        )
        medians = [float(np.median(values)) for values in (map_m, rte_m, rre_deg)]
        first = medians if first is None else first
        times = " / ".join(f"{now / then:.2f}" for now, then in zip(medians, first, strict=True))
        labels, frames = sum(one.labels for one in found), sum(one.frames for one in found)
        print(
            f"| {name} | {labels} | {len(map_m)} | {medians[0]:.3f} | {len(rte_m)} of {frames} | "
            f"{medians[1]:.4f} | {medians[2]:.4f} | {times} |"
        )


if __name__ == "__main__":
    main()
