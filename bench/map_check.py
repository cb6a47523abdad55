"""Findings and runtime of 'semviz map check'.

    python bench/map_check.py [--kitti /data/kitti] [--streets 10] [--elements 10000]

Prints how often a planted click of 5 px comes first among all labels, what lint says of maps built
from careful labels (nothing is wrong with them), and the processor times for a map of so many
elements with ten labels each. Streets: seeds from 1000 on.
"""

import argparse
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tests_support  # noqa: F401
from support.street_labels import careful, label_street

from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import LabelElement, Labels, Observation
from semviz_annotation.labels.rows import derived_id
from semviz_annotation.labels.views import rig_view
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.placement.observations import (
    ObservationArray,
    ViewArray,
    collect_observations,
)
from semviz_annotation.mapping.placement.triangulation import PlaceOptions, triangulate_landmarks
from semviz_annotation.mapping.quality.check import delete_each, leave_one_out, mapping_accuracy
from semviz_annotation.mapping.quality.lint import lint
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.camera import Rig
from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Dataset, Frame, Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import MapFrame, Provenance, SemanticMap
from semviz_core.common.arrays import ByteImage, FloatArray
from semviz_core.simulation.street import Street, camera_axes

LABELS = Path(__file__).parents[1] / "docs" / "kitti02" / "labels.jsonl"
FIRST_SEED = 1000
CLICK_PX = 5.0
PLANTS = 100
"""Of each street."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kitti", type=Path, help="folder with sequences and poses")
    parser.add_argument("--streets", type=int, default=10)
    parser.add_argument("--elements", type=int, default=10_000)
    arguments = parser.parse_args()
    seeds = range(FIRST_SEED, FIRST_SEED + arguments.streets)
    for sigma_px in (0.5, 1.0):
        print_plants(seeds, sigma_px)
    print_lint_of_streets(seeds)
    if arguments.kitti is not None:
        print_lint_of_kitti(arguments.kitti)
    print_times(arguments.elements)


def labels_of(street: Street, sigma_px: float) -> Labels:
    """Of a careful person, in every second frame."""
    see = careful(street, sigma_px, street.seed)
    return label_street(see, range(0, len(street.frames), 2), memory=1000).labels


def print_plants(seeds: range, sigma_px: float) -> None:
    """How often one click that is 5 px off comes first, and how often among the first five."""
    ranks: list[int] = []
    labels = 0
    for seed in seeds:
        street = Street(seed)
        views, observations, _, _ = collect_observations(labels_of(street, sigma_px), street)
        rng = np.random.default_rng(seed)
        good = normalized(views, observations)
        labels += len(observations)
        for row in rng.choice(np.flatnonzero(good), PLANTS, replace=False):
            landmark = np.arange(observations.count) == observations.landmark[row]
            mine = np.flatnonzero(landmark[observations.landmark])
            planted = good.copy()
            planted[mine] = normalized(views, with_plant(observations, row, rng).only(landmark))
            ranks.append(int((planted > planted[row]).sum()))
    first, first_five = np.mean(np.equal(ranks, 0)), np.mean(np.less(ranks, 5))
    print(
        f"a click {CLICK_PX:g} px off among {labels / len(seeds):.0f} good to {sigma_px} px: "
        f"first in {first:.1%}, among the first five in {first_five:.1%} of {len(ranks)}"
    )


def normalized(views: ViewArray, observations: ObservationArray) -> FloatArray:
    """(k,) residuals when left out; 0 where the others say nothing."""
    options = PlaceOptions()
    placed = triangulate_landmarks(views, observations, options)
    left_out = delete_each(views, observations, placed.anchor_m, placed.end_m, options)
    return np.nan_to_num(left_out.normalized)


def with_plant(
    observations: ObservationArray, row: int, rng: np.random.Generator
) -> ObservationArray:
    """One click moved in any direction; across the pole at an end that is hidden."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    by = CLICK_PX * np.array([np.cos(angle), np.sin(angle)])
    at_end = observations.is_line[row] and rng.random() < 0.5
    if not (observations.end_known if at_end else observations.anchor_known)[row]:
        u, v = observations.end_px[row] - observations.anchor_px[row]
        by = CLICK_PX * np.array([-v, u]) / np.hypot(u, v)
    name = "end_px" if at_end else "anchor_px"
    pixels = getattr(observations, name).copy()
    pixels[row] += by
    return replace(observations, **{name: pixels})


def print_lint_of_streets(seeds: range) -> None:
    """False alarms: the labels are good to 0.5 px, and each element keeps its name."""
    said: Counter[str] = Counter()
    elements = 0
    for seed in seeds:
        street = Street(seed)
        labels = labels_of(street, 0.5)
        built, _ = build_map(labels, street)
        elements += len(built)
        said.update(
            f"{finding.severity}, {finding.rule}" for finding in lint(built, labels, street)
        )
    print(f"\nlint of {len(seeds)} streets without faults, {elements} elements:")
    print("\n".join(f"  {count:4} {what}" for what, count in sorted(said.items())) or "  nothing")


def print_lint_of_kitti(kitti: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        workspace = Workspace.create_kitti(Path(folder) / "town", kitti, "02", (2, 3), range(20))
        with workspace.open_labels() as store:
            import_operations(LABELS, store)
            labels = store.labels
        built, _ = build_map(labels, workspace.source)
        print(f"\nlint of KITTI 02, {len(built)} elements:")
        for finding in lint(built, labels, workspace.source):
            print(f"  {finding.severity}, {finding.rule}: {finding.message}")


# -- times


@dataclass(frozen=True, eq=False)
class LongRoad:
    """A straight drive of ``count`` frames, 1 m apart; a source without images."""

    count: int
    rig: Rig = field(default_factory=lambda: Street(0).rig)
    map_frame: MapFrame = field(default_factory=lambda: MapFrame("long-road"))

    @property
    def frames(self) -> tuple[Frame, ...]:
        axes = camera_axes(0.0)
        return tuple(
            Frame(i, 0.1 * i, Pose(axes, np.array([float(i), 0.0, 1.65])))
            for i in range(self.count)
        )

    def image(self, index: int, side: Side) -> ByteImage:
        raise NotImplementedError


def long_map(count: int) -> tuple[SemanticMap, Labels, Dataset]:
    """``count`` poles, two beside each frame, each labelled in five frames (left and right)."""
    source = LongRoad(count // 2 + 20)
    rng = np.random.default_rng(0)
    sides: tuple[Side, ...] = ("left", "right")
    views = {
        (frame.index, side): rig_view(source.rig, side, frame.T_map_camera.inverse())
        for frame in source.frames
        if frame.T_map_camera is not None
        for side in sides
    }
    foot = np.array([[20.0 + i // 2, 6.0 if i % 2 else -6.0, 0.0] for i in range(count)])
    peak = foot + np.array([0.0, 0.0, 3.0])
    rows: list[LabelElement | Observation] = []
    for i in range(count):
        element = LabelElement(derived_id(f"element {i}"), i + 1, 0)
        rows.append(element)
        for index in range(i // 2, i // 2 + 10, 2):
            for side in sides:
                ends = views[index, side].project(np.stack([peak[i], foot[i]]))
                (a, b), (c, d) = (ends + rng.normal(0.0, 0.5, (2, 2))).tolist()
                name = derived_id(f"observation {i} {index} {side}")
                rows.append(Observation(name, element.id, index, side, (a, b), (c, d), True, True))
    provenance = tuple(Provenance((derived_id(f"element {i}"),)) for i in range(count))
    elements = Elements3D.from_ends(np.arange(count) + 1, peak, foot, np.zeros(count, dtype=int))
    trajectory = np.array([[float(i), 0.0, 1.65] for i in range(source.count)])
    semantic_map = SemanticMap(
        elements, source.map_frame, trajectory_m=trajectory, provenance=provenance
    )
    return semantic_map, Labels.from_rows(rows), source


def print_times(count: int) -> None:
    semantic_map, labels, source = long_map(count)
    print(f"\n{count} elements, {len(labels.observations)} labels:")
    for name, work in (
        ("accuracy", mapping_accuracy),
        ("each label left out", leave_one_out),
        ("lint", lint),
    ):
        start = time.process_time()
        work(semantic_map, labels, source)
        print(f"  {name:<20} {time.process_time() - start:6.1f} s")


if __name__ == "__main__":
    main()
