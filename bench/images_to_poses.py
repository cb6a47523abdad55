"""From images to poses: detection, then localization.

    python bench/images_to_poses.py [/data/kitti] [--model MODEL] [--tuned WEIGHTS]

On rendered streets that nothing was trained on, in the true map and in a map built from labels of
the even frames; on KITTI odometry 02, frames 0 to 19, in the map built from our labels of the even
ones (docs/kitti02/labels.jsonl). Measured on the odd frames, with simulated GPS fixes 5-10 m off.
Beside it the same frames with labels, and with the simulated detector, in place of detections; and
on KITTI with weights that were tuned on the even frames:

    semviz detect train WORKSPACE --frames 0:20:2 --from shipped --streets 0 --samples 1600
    semviz weights detector --out FOLDER

Prints the table of docs/detector.md, and the rates that semviz_core.base.detector_model states.
"""

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import tests_support  # noqa: F401
from support.street_labels import careful, label_street

from semviz.presentation.terminal import Table
from semviz.runs.metrics import errors_of, is_overconfident
from semviz.runs.run import FrameRecord, Observations
from semviz.workspace.detect import DetectOptions, detect_images, images_of
from semviz.workspace.localization.localize import (
    CROP_RADIUS_M,
    LocalizeOptions,
    localize_workspace,
)
from semviz.workspace.workspace import TRUTH, Workspace
from semviz_annotation.label_formats.import_plan import ImportLabels
from semviz_annotation.labels.labels import Observation
from semviz_annotation.mapping.build import BuildOptions, build_map
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.camera import Camera
from semviz_core.base.detector_model import NoiseName
from semviz_core.base.localization import Localization
from semviz_core.base.map_file import save_map
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray
from semviz_core.detection.detector import load_detector
from semviz_core.diagnosis.fault import FALSE_POSITIVE
from semviz_core.metrics.detection import HELD_OUT_SEED
from semviz_core.metrics.pose_errors import summarize
from semviz_core.simulation.street import Street

LABELS = Path(__file__).parents[1] / "docs" / "kitti02" / "labels.jsonl"
STREETS, FRAMES = 4, 40
LABEL_SIGMA_PX = 1.0
EVEN = "even"
KITTI_SEEDS, STREET_SEEDS = range(20), range(5)
"""Of the simulated GPS fixes."""
DEPTHS_M = (3, 10, 20, 30, 40, 50, 60, 80)
Seen = tuple[Observations, NoiseName]
HEADER = (
    "images", "map", "seen by", "frames", "elements", "false", "ok %", "ambiguous %", "RTE m",
    "RRE deg", "< 1 m %", "ok and wrong",
)  # fmt: skip
"""Elements and false ones are means of a frame; errors medians over all frames with an answer."""


@dataclass
class Found:
    """What came of one way to see."""

    localizations: list[Localization] = field(default_factory=list)
    truths: list[Pose | None] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)
    """Elements in each frame."""
    false: list[int] = field(default_factory=list)
    """Of those, nothing real; on labelled images nobody knows."""
    sure_and_wrong: int = 0
    """Frames that are ok and more than 1 m off."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kitti", nargs="?", type=Path)
    parser.add_argument("--model")
    parser.add_argument("--tuned")
    chosen = parser.parse_args()
    rows: list[tuple[str, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        streets = [made_street(Path(folder), seed) for seed in range(STREETS)]
        for street in streets:
            look(street, chosen.model)
        print_rates(streets)
        ways: list[Seen] = [
            ("labels", "low"), ("simulated", "low"), ("simulated", "paper"), ("detected", "low")
        ]  # fmt: skip
        for name in (TRUTH, EVEN):
            for way in ways:
                rows.append(row("rendered", name, way, found(streets, name, way, STREET_SEEDS)))
        if chosen.kitti is not None:
            kitti = [made_kitti(Path(folder), chosen.kitti)]
            look(kitti[0], chosen.model)
            for way in (ways[0], ways[-1]):
                rows.append(row("KITTI 02", EVEN, way, found(kitti, EVEN, way, KITTI_SEEDS)))
            if chosen.tuned is not None:
                look(kitti[0], chosen.tuned)
                there = found(kitti, EVEN, ways[-1], KITTI_SEEDS)
                rows.append(row("KITTI 02, tuned", EVEN, ways[-1], there))
    print(Table("From pixels to poses", HEADER, tuple(rows), words=3).as_markdown())


def made_street(folder: Path, number: int) -> Workspace:
    """Labelled in every frame by somebody careful who knows which elements are one."""
    seed = HELD_OUT_SEED + number
    workspace = Workspace.create_street(folder / f"street-{seed}", seed, range(FRAMES))
    street = workspace.street
    labels = label_street(careful(street, LABEL_SIGMA_PX, seed), range(FRAMES), FRAMES).labels
    rows = tuple(
        inside(observation, street.rig.left) for observation in labels.observations.values()
    )
    with workspace.open_labels() as store:
        store.apply(ImportLabels(tuple(labels.elements.values()), rows), "bench")
    build_even(workspace)
    return workspace


def inside(row: Observation, camera: Camera) -> Observation:
    """A label that an unsteady hand drew beyond the image's border ends there."""
    corner = np.array([camera.width - 1.0, camera.height - 1.0])
    (u, v), end = np.clip(row.anchor_px, 0.0, corner).tolist(), row.end_px
    if end is not None:
        x, y = np.clip(end, 0.0, corner).tolist()
        end = (x, y)
    return replace(row, anchor_px=(u, v), end_px=end)


def made_kitti(folder: Path, root: Path) -> Workspace:
    """With our own labels."""
    workspace = Workspace.create_kitti(folder / "kitti", root, "02", (2, 3), range(20))
    with workspace.open_labels() as store:
        import_operations(LABELS, store)
    build_even(workspace)
    return workspace


def build_even(workspace: Workspace) -> None:
    """The map that the labels of the even frames give."""
    indices = [frame.index for frame in workspace.source.frames]
    even = range(0, len(indices), 2)
    built, _ = build_map(workspace.read_labels(), workspace.source, BuildOptions(), even)
    save_map(built, workspace.map_path(EVEN))


def look(workspace: Workspace, model: str | None) -> None:
    """Detects in the odd left images."""
    options = DetectOptions(model)
    images = images_of(workspace, odd(workspace), ("left",))
    proposals = detect_images(workspace, load_detector(model), options, images)
    print(f"{workspace.name}: {len(proposals)} found in {len(images)} images")


def print_rates(streets: Sequence[Workspace]) -> None:
    """Of all mapped elements in view, the hidden ones too, how many are found, by depth; how many
    detections are nothing real; how many bottoms are given that cannot be seen."""
    depths, finds, false, bottoms = [], [], [], []
    options = next(each_seed(("detected", "low"), range(1)))
    for workspace in streets:
        street, camera = workspace.street, workspace.source.rig.left
        mapped = street.truth_map.elements
        is_line = mapped.is_line[:, None]
        middle_m = np.where(is_line, (mapped.anchor_m + mapped.end_m) / 2.0, mapped.anchor_m)
        for record in localize_workspace(workspace, TRUTH, options, odd(workspace)):
            pose = record.frame.T_map_camera
            assert pose is not None
            middle_c = pose.inverse().apply(middle_m)
            in_view = camera.contains(camera.project(middle_c)) & (middle_c[:, 2] > 1.0)
            depths.append(middle_c[in_view, 2])
            finds.append(np.isin(mapped.id, record.element_id)[in_view])
            false.append((record.element_id == FALSE_POSITIVE).sum())
            bottoms.append(invented_bottoms(street, record))
    depth_m, is_found = np.concatenate(depths), np.concatenate(finds)
    print(f"false detections in an image: {np.mean(false):.2f}")
    print(f"bottoms given that cannot be seen: {np.concatenate(bottoms).mean():.3f}")
    for low, high in pairwise(DEPTHS_M):
        rows = (depth_m >= low) & (depth_m < high)
        print(f"in view, {low} to {high} m: {is_found[rows].mean():.2f} of {rows.sum()} found")


def invented_bottoms(street: Street, record: FrameRecord) -> BoolArray:
    """(k,) of the bottoms that are given, whether something hides the true one."""
    labels, ids = street.labels(record.frame.index, "left")
    seen = record.localization.observed
    hidden = ids[labels.is_line & ~labels.end_known]
    return np.isin(record.element_id[seen.end_known], hidden)


def odd(workspace: Workspace) -> range:
    return range(1, len(workspace.source.frames), 2)


def found(workspaces: Sequence[Workspace], map_name: str, way: Seen, seeds: range) -> Found:
    """All frames of all workspaces, each with several GPS fixes."""
    result = Found()
    for workspace in workspaces:
        for options in each_seed(way, seeds):
            for record in localize_workspace(workspace, map_name, options, odd(workspace)):
                truth = record.frame.T_map_camera
                result.localizations.append(record.localization)
                result.truths.append(None if truth is None else truth.inverse())
                result.seen.append(len(record.element_id))
                result.false.append(int((record.element_id == FALSE_POSITIVE).sum()))
                result.sure_and_wrong += is_overconfident(record.localization, errors_of(record))
    return result


def each_seed(way: Seen, seeds: range) -> Iterator[LocalizeOptions]:
    observations, noise = way
    radius_m = CROP_RADIUS_M[observations]
    for seed in seeds:
        yield LocalizeOptions(
            observations=observations, noise=noise, crop_radius_m=radius_m, seed=seed
        )


def row(images: str, map_name: str, way: Seen, result: Found) -> tuple[str, ...]:
    """Of the table."""
    told = summarize(result.localizations, result.truths)
    everything = told.accuracy
    share = {
        name: 100.0 * value.frames / everything.frames for name, value in told.by_status.items()
    }
    observations, noise = way
    knows = observations != "labels" and images == "rendered"
    return (
        images,
        map_name,
        f"{observations}, {noise}" if observations == "simulated" else observations,
        str(everything.frames),
        f"{np.mean(result.seen):.1f}",
        f"{np.mean(result.false):.2f}" if knows else "-",
        f"{share['ok']:.0f}",
        f"{share['ambiguous']:.0f}",
        number(everything.rte_m.q2),
        number(everything.rre_deg.q2),
        f"{100.0 * (everything.share_below_1m or 0.0):.0f}",
        str(result.sure_and_wrong),
    )


def number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


if __name__ == "__main__":
    main()
