"""The maps of drives through a simulated city, merged: duplicates, wrong merges, accuracy, time.

    python bench/merged_drives.py
    python bench/merged_drives.py --drives 50 200 800 --drives-per-block 4
    python bench/merged_drives.py --drives 200 --borders 100 200 300 400
    python bench/merged_drives.py --kitti-poses /data/kitti/poses --pole-maps /data/pole_maps
    python bench/merged_drives.py --streets 40 41 42 43
    python bench/merged_drives.py --picture docs/images/merged-drives.png

Drives are simulated without images (``tests/toy_city.py``). *Twice* are landmarks that
several drives map and that stand in the map more than once; *merged* are landmarks of the map
that are several; the *bound* is the error with the true associations. *Local* is the error against
the mean of the neighbours within 40 m, which is what a vehicle localizes by. *MB* is the peak
memory of the process.
"""

import resource
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tests_support  # noqa: F401  tests beside bench
import toy_city
import tyro
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from toy_city import CityDrive, Drift

from semviz.reports.merged_drives import draw_merging
from semviz_annotation.labels.detections import as_proposals
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import ProcessedImages
from semviz_annotation.labels.proposals import Proposals
from semviz_annotation.mapping.build import build_map
from semviz_annotation.mapping.drives import regions
from semviz_annotation.mapping.drives.alignment import Alignment, align
from semviz_annotation.mapping.drives.corrections import PoseErrors
from semviz_annotation.mapping.drives.merge import MergeOptions, Merging
from semviz_annotation.mapping.drives.merged_map import merge_maps
from semviz_annotation.mapping.drives.regions import merge_elements
from semviz_core.base.elements import Elements3D
from semviz_core.base.frame import Side
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap, footprint_m
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.datasets.rig_cameras import DatasetWithFrames
from semviz_core.research.evaluation.roads import kitti_road, true_elements
from semviz_core.simulation.detector import SimulatedDetector
from semviz_core.simulation.layout import StreetOptions
from semviz_core.simulation.street import Street

SIDES: tuple[Side, Side] = ("left", "right")
NEIGHBOURS_M = 40.0
HEAD = "place  drives off by elements  shared  twice merged error, m bound  local    s ms each   MB"


@dataclass(frozen=True)
class Options:
    drives: tuple[int, ...] = (10, 50, 200)
    length_m: float = 500.0
    """Of a drive."""
    blocks: int = 7
    """7 by 7 blocks have 22 km of streets."""
    drives_per_block: float | None = None
    """Instead, the city grows with the drives, so that each meets as many others."""
    sigma_m: tuple[float, ...] = (0.3,)
    """Errors of poses in each direction."""
    stated_m: float = 0.5
    """What is stated of them."""
    seed: int = 1000
    kitti_poses: Path | None = None
    """Also drives along KITTI 00, beside its surveyed poles."""
    pole_maps: Path | None = None
    picture: Path | None = None
    """Instead, draw how seven drives of a small city are moved to this PNG file."""
    at_once: bool = False
    """A large city is one region."""
    borders: tuple[float, ...] = ()
    """Instead, the city is merged in squares of 400 m with borders of these widths, and at once."""
    streets: tuple[int, ...] = ()
    """Instead, streets with these seeds, each driven four times and mapped from detections."""


def main(options: Options) -> None:
    if options.picture is not None:
        _, drives = city(replace(options, blocks=2, length_m=700.0), 7, Drift(0.4))
        merging = merge_elements([one.semantic_map for one in drives])
        draw_merging(merging, [f"drive {number}" for number in range(1, 8)], options.picture)
        return
    if options.streets:
        for seed in options.streets:
            print(street_row(seed, options))
        return
    if options.borders:
        for row in border_rows(options):
            print(row)
        return
    if options.at_once:
        regions.REGION_M = 1e9
    print(HEAD)
    stated = PoseErrors(options.stated_m)
    for sigma_m in options.sigma_m:
        drift = replace(Drift(), sigma_m=sigma_m)
        for count in options.drives:
            print(row_of("city", *city(of_size(options, count), count, drift), drift, stated))
        if options.kitti_poses and options.pole_maps:
            print(row_of("KITTI 00", *kitti(options, drift), drift, stated))


def border_rows(options: Options) -> Iterator[str]:
    """Yield what differs from drives that are merged at once."""
    _, drives = city(options, options.drives[-1], Drift(options.sigma_m[0]))
    maps = [one.semantic_map for one in drives]
    whole = merge_elements(maps, MergeOptions(PoseErrors(options.stated_m)))
    for border_m in options.borders:
        regions.REGION_M, regions.BORDER_M = 400.0, border_m
        parts = merge_elements(maps, MergeOptions(PoseErrors(options.stated_m)))
        other = int((parts.landmark != whole.landmark).sum())
        off_m = (parts.alignment.ends_m - whole.alignment.ends_m)[:, :2]
        most_m = np.linalg.norm(off_m, axis=1).max()
        yield f"border {border_m:g} m: {other} others, {rms(off_m):.4f} m off, most {most_m:.4f} m"


def of_size(options: Options, count: int) -> Options:
    """Return the options with as many blocks as so many drives need."""
    if options.drives_per_block is None:
        return options
    return replace(options, blocks=round(float(np.sqrt(count / options.drives_per_block))))


def city(options: Options, count: int, drift: Drift) -> tuple[Elements3D, list[CityDrive]]:
    truth = toy_city.city(options.blocks, options.seed)
    seeds = range(options.seed, options.seed + count)
    ways = [toy_city.random_way(options.blocks, options.length_m, seed) for seed in seeds]
    return truth, _drives(truth, ways, drift, options.seed)


def kitti(options: Options, drift: Drift) -> tuple[Elements3D, list[CityDrive]]:
    """Return 50 stretches of the drive 00, which passes some streets twice."""
    assert options.kitti_poses is not None
    assert options.pole_maps is not None
    road = kitti_road(options.kitti_poses / "00.txt", options.pole_maps / "kitti_00.npz", "00")
    length = int(options.length_m)
    rng = np.random.default_rng(options.seed)
    starts = rng.integers(0, len(road.thinned_m) - length, 50)
    ways = [road.thinned_m[start : start + length] for start in starts.tolist()]
    truth = true_elements(road, options.seed)
    return truth, _drives(truth, ways, drift, options.seed)


def _drives(
    truth: Elements3D, ways: list[FloatArray], drift: Drift, first_seed: int
) -> list[CityDrive]:
    return [
        toy_city.drive(truth, way, drift, first_seed + number) for number, way in enumerate(ways)
    ]


def street_row(seed: int, options: Options) -> str:
    """Return what four drives of 60 frames through one street become, each mapped by itself."""
    street = Street(seed, StreetOptions(60))
    drift = replace(Drift(), sigma_m=options.sigma_m[0])
    maps = {f"{drive}": detected_map(street, drive, drift) for drive in range(4)}
    merged = merge_maps(maps, MergeOptions(PoseErrors(options.stated_m))).semantic_map
    truth = street.truth_map.elements
    counts = Counter(nearest(truth, merged.elements))
    single = [len(set(nearest(truth, one.elements)) - {-1}) for one in maps.values()]
    invented = counts.pop(-1, 0)
    return (
        f"street {seed}: {single} landmarks in the maps of the drives; {len(counts)} in the merged "
        f"one, {sum(count > 1 for count in counts.values())} of them twice, {invented} invented"
    )


def detected_map(street: Street, drive: int, drift: Drift) -> SemanticMap:
    """Return the map of simulated detections of one drive, whose poses drift."""
    detector = SimulatedDetector(street, "low", drive)
    images = [(frame.index, side) for frame in street.frames for side in SIDES]
    rows = [
        row
        for index, side in images
        for row in as_proposals(
            index,
            side,
            detector.detect(index, side).observed,
            street.rig.left,
            "simulated",
            "centroid",
        )
    ]
    found = Proposals.of(rows, ProcessedImages("simulated", images=frozenset(images)))
    return build_map(Labels(), drifted(street, drive, drift), detections=found)[0]


def drifted(street: Street, drive: int, drift: Drift) -> DatasetWithFrames:
    poses = [frame.T_map_camera for frame in street.frames if frame.T_map_camera is not None]
    way_m = np.array([pose.translation for pose in poses])
    along_m = np.linalg.norm(np.diff(way_m, axis=0, prepend=way_m[:1]), axis=1).cumsum()
    errors = toy_city.pose_errors(int(along_m[-1]) + 1, drift, np.random.default_rng(drive))
    frames = []
    for frame, pose, row in zip(street.frames, poses, along_m.astype(int), strict=True):
        turn = Rotation.from_rotvec([0.0, 0.0, errors[row, 3]]).as_matrix()
        wrong = Pose(turn @ pose.rotation, pose.translation + errors[row, :3])
        frames.append(replace(frame, T_map_camera=wrong))
    return DatasetWithFrames(street, tuple(frames))


def nearest(truth: Elements3D, elements: Elements3D) -> list[int]:
    """Return the row of the true element of each class that is nearest, -1 beyond 1.5 m."""
    places = [
        np.column_stack([footprint_m(each)[:, :2], 1e6 * each.class_id])
        for each in (truth, elements)
    ]
    distance_m, row = cKDTree(places[0]).query(places[1])
    return np.where(distance_m < 1.5, row, -1).tolist()


def row_of(
    place: str, truth: Elements3D, drives: list[CityDrive], drift: Drift, stated: PoseErrors
) -> str:
    start = time.process_time()
    merging = merge_elements([one.semantic_map for one in drives], MergeOptions(stated))
    seconds = time.process_time() - start
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    true_row = np.concatenate([one.true_row for one in drives])
    shared, twice, merged = associations(merging.landmark, true_row, merging.stack.drive)
    best, known = with_true_associations(merging, true_row, stated)
    real = true_row >= 0
    error_m = off_m(merging.alignment, merging.landmark, truth, true_row, real)
    bound_m = off_m(best, known, truth, true_row, real)
    return (
        f"{place:8}{len(drives):5}{drift.sigma_m:7.1f}{len(true_row):9}{shared:8}"
        f"{twice / shared:7.2%}{merged:7.2%}{rms(error_m):9.3f}{rms(bound_m):6.3f}"
        f"{local(error_m, truth.anchor_m[true_row[real], :2], merging.landmark[real]):7.3f}"
        f"{seconds:5.1f}{seconds / len(drives) * 1e3:7.0f}{peak_mb:6.0f}"
    )


def associations(landmark: IntArray, true_row: IntArray, drive: IntArray) -> tuple[int, int, float]:
    """Return how many landmarks several drives map, how many of them stand in the map more than
    once, and the share of landmarks of the map that are several."""
    real = true_row >= 0
    passes = np.bincount(np.unique(np.stack([true_row, drive])[:, real], axis=1)[0])
    copies = np.bincount(np.unique(np.stack([true_row, landmark])[:, real], axis=1)[0])
    different = np.bincount(np.unique(np.stack([landmark, true_row]), axis=1)[0])
    is_shared = passes > 1
    return int(is_shared.sum()), int((copies[is_shared] > 1).sum()), float((different > 1).mean())


def with_true_associations(
    merging: Merging, true_row: IntArray, stated: PoseErrors
) -> tuple[Alignment, IntArray]:
    """Return the alignment with known landmarks, and the landmark (n,) of each element."""
    stack, knots = merging.stack, merging.knots
    own = true_row.max() + 1 + np.arange(len(true_row))
    _, known = np.unique(np.where(true_row >= 0, true_row, own), return_inverse=True)
    information = stack.information(merging.scatter_m)
    model = knots.model(stack.ends_m, stack.drive, stated)
    return align(stack.ends_m, information, model, known), known


def off_m(
    alignment: Alignment, landmark: IntArray, truth: Elements3D, true_row: IntArray, real: BoolArray
) -> FloatArray:
    """Return the errors (k, 2) on the ground of the landmarks of real elements."""
    found = alignment.landmark_m[landmark[real], :2]
    return np.asarray(found - truth.anchor_m[true_row[real], :2])


def local(error_m: FloatArray, at_m: FloatArray, landmark: IntArray) -> float:
    """Return the RMS error (m) of landmarks against the mean of their neighbours."""
    _, first = np.unique(landmark, return_index=True)
    error_m, at_m = error_m[first], at_m[first]
    tree = cKDTree(at_m)
    near = tree.query_ball_point(at_m, NEIGHBOURS_M)
    return rms(
        np.array(
            [own - error_m[rows].mean(axis=0) for own, rows in zip(error_m, near, strict=True)]
        )
    )


def rms(off_m: FloatArray) -> float:
    return float(np.sqrt((off_m**2).sum(axis=1).mean()))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
