"""Import one real drive from several formats, and measure how well they agree.

    python bench/own_drive.py UTBM_STEREO [--pages]

UTBM_STEREO holds five stereo frames of a car with strong distortion: bb2_left, bb2_right,
bb2_left.yaml (ROS camera_info), poses_left_tum.txt, kapture_records_camera.txt, COLMAP models
sparse_text and sparse/0, and nerfstudio's transforms.json; mcap_rosbag/utbm_mcap beside it the same
as MCAP, whose world has x ahead and z up. They are not part of the project.
Prints for each import the median distance (px) of COLMAP's points from where COLMAP
observed them in the left images, and the largest distance (px) of a point from its place in the
first import, both in recorded pixels. With ``--pages``, the time from the folder to the first page
as well: of `semviz new` with its checks, in s of one core, and of `semviz annotate` until Chromium
shows the first image, in s by the clock.
"""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tests_support  # noqa: F401
from annotator_page import Killable
from journeys.driver import LabelDriver
from playwright.sync_api import sync_playwright

from semviz.workspace.drive.drive_file import DriveFile, ImageFolders
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder
from semviz_core.datasets.own_drive.recorded_drive import RecordedDrive, read_drive
from semviz_core.datasets.own_drive.recording import DriveFiles
from semviz_core.datasets.trajectory import T_MAP_WORLD


def imports(root: Path, folder: Path) -> dict[str, DriveFiles]:
    """Return the files of each import; a file of times is written to ``folder``."""
    times = folder / "times.txt"
    records = (root / "kapture_records_camera.txt").read_text().splitlines()
    rows = [line.split(", ") for line in records if ", bb2_left, " in line]
    times.write_text("".join(f"{stamp} {name}\n" for stamp, _, name in rows))
    left, right = root / "bb2_left", root / "bb2_right"
    bag = root.parent / "mcap_rosbag" / "utbm_mcap" / "utbm_mcap.mcap"
    model = {"images": left, "right": right, "metric": True}
    return {
        "camera_info, TUM": DriveFiles(
            images=left,
            calibration=root / "bb2_left.yaml",
            poses=root / "poses_left_tum.txt",
            times=times,
        ),
        "COLMAP text": DriveFiles(**model, poses=root / "sparse_text"),
        "COLMAP binary": DriveFiles(**model, poses=root / "sparse" / "0"),
        "nerfstudio": DriveFiles(**model, poses=root / "transforms.json"),
        "MCAP": DriveFiles(images=bag, extracted=folder / "recorded"),
    }


def colmap_points(root: Path) -> tuple[dict[int, FloatArray], dict[str, FloatArray]]:
    """Return the points (3,) by id, and by image the observations (n, 3): x, y, id of the point."""
    lines = (root / "sparse_text" / "points3D.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    points = {int(row[0]): np.array(row[1:4], dtype=np.float64) for row in rows}
    lines = (root / "sparse_text" / "images.txt").read_text().splitlines()
    lines = [line for line in lines if not line.startswith("#")]
    seen = {}
    for image, observed in zip(lines[::2], lines[1::2], strict=True):
        table = np.array(observed.split(), dtype=np.float64).reshape(-1, 3)
        seen[image.split()[9]] = table[table[:, 2] >= 0]
    return points, seen


def recorded_pixels(
    dataset: ImageFolder, T_map_world: Pose, points: FloatArray
) -> list[FloatArray]:
    """Return the recorded pixels (n, 2) of points (n, 3) in each left image."""
    pixels = []
    for frame in dataset.frames:
        assert frame.T_map_camera is not None
        in_camera = frame.T_map_camera.inverse().apply(T_map_world.apply(points))
        pixels.append(dataset.to_original(dataset.rig.left.project(in_camera), frame.index, "left"))
    return pixels


def reprojection_px(
    drive: RecordedDrive, pixels: list[FloatArray], ids: list[int], seen: dict[str, FloatArray]
) -> FloatArray:
    """Return the distances (n,) of points from their observations; COLMAP's are 0.5 px larger."""
    rows = {number: row for row, number in enumerate(ids)}
    distances = []
    for frame, image in zip(drive.frames, pixels, strict=True):
        observed = seen[f"bb2_left/frame_{frame.index + 1:09d}.jpg"]
        places = image[[rows[int(number)] for number in observed[:, 2]]]
        distances.append(np.linalg.norm(places - (observed[:, :2] - 0.5), axis=1))
    return np.concatenate(distances)


def measure(root: Path) -> dict[str, tuple[float, float]]:
    """Return median reprojection (px) and largest difference (px) of each import."""
    points, seen = colmap_points(root)
    ids = sorted(points)
    positions = np.array([points[number] for number in ids])
    first: FloatArray | None = None
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, files in imports(root, Path(folder)).items():
            drive = read_drive(files)
            content = DriveFile.of(drive, "utbm")
            dataset = content.dataset(ImageFolders.of_drive(drive), Path(folder) / name)
            assert drive.axes is not None
            T_world_colmap = T_MAP_WORLD if name == "MCAP" else Pose.identity()
            T_map_colmap = drive.axes.T_map_world @ T_world_colmap
            pixels = recorded_pixels(dataset, T_map_colmap, positions)
            distances = reprojection_px(drive, pixels, ids, seen)
            here = np.array(pixels)
            first = here if first is None else first
            apart = float(np.linalg.norm(here - first, axis=2).max())
            results[name] = float(np.median(distances)), apart
    return results


def first_page(files: DriveFiles, town: Path) -> tuple[float, float]:
    """Return CPU time (s) of `semviz new`, and time (s) of `semviz annotate` to its first image."""
    named = ("images", "right", "calibration", "poses", "times")
    given = [(f"--{name}", str(getattr(files, name))) for name in named if getattr(files, name)]
    words = [word for pair in given for word in pair] + ["--metric"] * files.metric
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "semviz.cli", "new", str(town), *words]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium")
        start = time.perf_counter()
        annotate = Killable(town)
        LabelDriver(browser.new_page()).open(annotate.start())
        page_s = time.perf_counter() - start
        browser.close()
        annotate.kill()
    return spent_s, page_s


def main() -> None:
    root, pages = Path(sys.argv[1]), "--pages" in sys.argv
    print("| import | reprojection, median (px) | difference (px) | new, CPU (s) | page (s) |")
    print("|---|--:|--:|--:|--:|")
    for name, (reprojection_median_px, apart_px) in measure(root).items():
        row = f"| {name} | {reprojection_median_px:.3f} | {apart_px:.3f} |"
        if pages:
            with tempfile.TemporaryDirectory() as folder:
                files = imports(root, Path(folder))[name]
                new_s, page_s = first_page(files, Path(folder) / "town")
            row += f" {new_s:.1f} | {page_s:.1f} |"
        print(row, flush=True)


if __name__ == "__main__":
    main()
