"""Map and localize simulated drives through lenses, and by a rig, and compare with a pinhole pair.

    python bench/own_drive_simulated.py [--frames 20] [--seeds 3,5] [--drives pinhole,rig]
        [--browser] [--folder DIR]

Each street is recorded by a stereo pair without distortion, with Brown-Conrady and with
Kannala-Brandt lenses, and by a rig of four cameras without distortion, all at one time, and with
both lenses and images up to 41 ms apart. The files are imported as a user would, everything visible
is labelled 0.5 px off, a map is built, and every camera is localized in it. Prints the errors of
map and poses, over all streets, and how many times those of the pinhole pair, or of that camera of
the pinhole rig, they are. A camera that looks aside sees few elements; frames with fewer than four
cannot be localized alone and are counted apart.

With ``--browser``, each label is drawn in Chromium, by mouse and keys, and the map is built there;
how far labels are from what was meant is printed to stderr. A label takes one to three seconds of
CPU. With ``--folder``, drives and labels are kept there: stopped at any time, the same command goes
on.
"""

import argparse
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tests_support  # noqa: F401
from labelled_rig import SIGMA_PX, labels_of

from semviz.annotator.views import label_element_name
from semviz.workspace.localization.localize import LocalizeOptions, localize_workspace
from semviz.workspace.workspace import MAIN, Workspace
from semviz_annotation.labels.edits import AddMany, AddObservation
from semviz_annotation.mapping.build import build_map
from semviz_core.base.elements import Elements3D
from semviz_core.base.map_file import save_map
from semviz_core.common.arrays import FloatArray
from semviz_core.datasets.own_drive.recorded_drive import read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.datasets.rig_cameras import camera_names
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


def four_pinholes() -> dict[str, MountedCamera]:
    """Return the rig of four with equal lenses, all at one time."""
    pinhole = stereo_pair("pinhole")["left"].lens
    return {
        name: replace(camera, lens=pinhole, late_s=0.0) for name, camera in four_cameras().items()
    }


DRIVES: dict[str, tuple[str, dict[str, MountedCamera]]] = {
    "pinhole": ("pinhole pair", stereo_pair("pinhole")),
    "brown-conrady": ("Brown-Conrady pair", stereo_pair("brown-conrady")),
    "fisheye": ("Kannala-Brandt pair", stereo_pair("fisheye")),
    "pinhole-rig": ("pinhole rig of four,", four_pinholes()),
    "rig": ("rig of four,", four_cameras()),
}

LEAST_SEEN = 4
"""Elements that a frame needs."""


class Errors(NamedTuple):
    """Of one camera, or stereo pair, on one street."""

    labels: int
    map_m: FloatArray
    """(k,) of anchors, of elements placed to 0.5 m."""
    rte_m: FloatArray
    rre_deg: FloatArray
    """(n,) of frames that are ok."""
    frames: int
    """With at least four elements."""
    few: int
    """Frames with fewer."""


def measure(
    street: Street, cameras: dict[str, MountedCamera], frames: int, folder: Path, browser: bool
) -> dict[str, Errors]:
    """Record, import, label, map and localize one drive; return the errors of each camera."""
    if not (folder / "town").exists():
        _import(street, cameras, frames, folder)
    workspace = Workspace.open(folder / "town")
    meant = labels_of(workspace, street, cameras, SIGMA_PX)
    if browser:
        _draw_and_build(workspace, meant)
    else:
        with workspace.open_labels() as store:
            if not store.labels.observations:
                store.apply(AddMany(tuple(meant)), "ann")
        built, _ = build_map(workspace.read_labels(), workspace.source)
        save_map(built, workspace.map_path(MAIN))
    map_m = _map_errors(workspace.read_map(MAIN).elements, street)
    names = camera_names(workspace.source)
    return {name: _localized(workspace, name or None, len(meant), map_m) for name in names or ("",)}


def _import(street: Street, cameras: dict[str, MountedCamera], frames: int, folder: Path) -> None:
    shutil.rmtree(folder / "drive", ignore_errors=True)
    record_rig(folder / "drive", street, cameras, range(frames))
    start = time.process_time()
    drive = read_drive(_files(folder / "drive", cameras))
    workspace = Workspace.create_images(folder / "town", drive)
    workspace.source.image(workspace.source.frames[0].index, "left")
    print(f"import {time.process_time() - start:.1f} s CPU", file=sys.stderr)


def _localized(workspace: Workspace, camera: str | None, labels: int, map_m: FloatArray) -> Errors:
    records = list(localize_workspace(workspace, MAIN, LocalizeOptions(), camera=camera))
    errors = [
        pose_error(record.localization.T_camera_map, record.frame.T_map_camera.inverse())
        for record in records
        if record.localization.status == "ok"
        and record.localization.T_camera_map is not None
        and record.frame.T_map_camera is not None
    ]
    rte_m, rre_deg = np.array(errors).reshape(-1, 2).T
    few = sum(len(record.localization.observed) < LEAST_SEEN for record in records)
    return Errors(labels, map_m, rte_m, rre_deg, len(records) - few, few)


def _draw_and_build(workspace: Workspace, meant: list[AddObservation]) -> None:
    """Draw labels in Chromium and build the map there; print how far labels are from what was
    meant.

    An element that the page does not list in a frame, as in a rig's camera that looks elsewhere, is
    drawn as a new one, which the map merges.
    """
    from annotator_page import annotating
    from journeys.driver import LabelDriver
    from playwright.sync_api import sync_playwright

    names: dict[str, str] = {}
    classes = {row.element_id: row.class_id for row in meant if row.class_id is not None}
    with annotating(workspace) as served, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium")
        driver = LabelDriver(browser.new_page(viewport={"width": 1600, "height": 950}))
        driver.open(served.url)
        there = served.observations
        for row, drawn in zip(meant, there, strict=False):
            element = served.labels.elements[drawn.element_id]
            names[row.element_id] = label_element_name(element, served.labels.classes)
        for row in meant[len(there) :]:
            driver.goto(row.frame_index)
            name = names.get(row.element_id)
            if name is not None and not driver.is_listed(name):
                name = None
            if row.end_px is None:
                done = driver.draw_sign(row.side, row.anchor_px, classes[row.element_id], name)
            else:
                done = driver.draw_pole(
                    row.side, row.anchor_px, row.end_px, name, row.anchor_known, row.end_known
                )
            names[row.element_id] = done
        driver.press("Shift+M")
        driver.page.wait_for_function(
            "() => semviz.state.labels.map.built && semviz.state.labels.map.building === null"
        )
        browser.close()
        rows = zip(served.observations, meant, strict=True)
        off_px = [np.hypot(*np.subtract(drawn.anchor_px, row.anchor_px)) for drawn, row in rows]
    print(f"{len(off_px)} labels drawn, at most {max(off_px):.3f} px off", file=sys.stderr)


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
    parser.add_argument("--drives", default=",".join(DRIVES))
    parser.add_argument("--browser", action="store_true")
    parser.add_argument("--folder", type=Path, help="keep drives and labels here")
    args = parser.parse_args()
    firsts: dict[str, list[float]] = {}
    head = "drive | labels | elements | map, median (m) | ok | fewer than four | RTE, median (m) | "
    print(f"| {head}RRE (deg) | times |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    for drive in args.drives.split(","):
        name, cameras = DRIVES[drive]
        found: dict[str, list[Errors]] = {}
        for seed in map(int, args.seeds.split(",")):
            street = Street(seed, StreetOptions(args.frames + 2))
            with tempfile.TemporaryDirectory() as passing:
                folder = (args.folder or Path(passing)) / f"{drive}-{seed}-{args.frames}"
                measured = measure(street, cameras, args.frames, folder, args.browser)
            for camera, errors in measured.items():
                found.setdefault(camera, []).append(errors)
        for camera, all_errors in found.items():
            row = f"{name} {camera}".strip()
            firsts.setdefault(camera, _print_row(row, all_errors, firsts.get(camera)))


def _print_row(name: str, found: list[Errors], first: list[float] | None) -> list[float]:
    map_m, rte_m, rre_deg = (
        np.concatenate([getattr(one, field) for one in found])
        for field in ("map_m", "rte_m", "rre_deg")
    )
    medians = [
        float(np.median(values)) if len(values) else float("nan")
        for values in (map_m, rte_m, rre_deg)
    ]
    times = " / ".join(
        f"{now / then:.2f}" for now, then in zip(medians, first or medians, strict=True)
    )
    labels, frames, few = (
        sum(getattr(one, field) for one in found) for field in ("labels", "frames", "few")
    )
    print(
        f"| {name} | {labels} | {len(map_m)} | {medians[0]:.3f} | {len(rte_m)} of {frames} | {few} "
        f"| {medians[1]:.4f} | {medians[2]:.4f} | {times} |",
        flush=True,
    )
    return medians


if __name__ == "__main__":
    main()
