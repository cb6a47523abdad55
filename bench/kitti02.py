"""Results on real images: KITTI odometry 02, frames 0 to 19, with our own labels.

    python bench/kitti02.py /data/kitti

Builds the map from the even frames and measures on the odd ones. Prints the tables of
docs/results/kitti02.md, from the labels of docs/kitti02 that were measured in each image.
The images are not part of the project.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from semviz.workspace.localization.localize import LocalizeOptions, localize_workspace
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.labels import Labels
from semviz_annotation.mapping.build import BuildOptions, build_map
from semviz_annotation.mapping.placement.bundle_adjustment import (
    BundleProblem,
    BundleResult,
    RefineOptions,
    Unknowns,
    bundle_adjust,
)
from semviz_annotation.mapping.placement.observations import (
    LabelObservations,
    ViewArray,
    collect_observations,
)
from semviz_annotation.mapping.placement.reprojection import residuals
from semviz_annotation.mapping.placement.triangulation import (
    triangulate_landmarks,
    triangulate_linearly,
)
from semviz_annotation.mapping.quality.check import mapping_accuracy
from semviz_annotation.mapping.quality.label_links import observe
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.frame import Dataset, Side
from semviz_core.base.localization import Localization
from semviz_core.base.map_file import save_map
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.residuals import pair_residuals
from semviz_core.metrics.pose_errors import summarize

LABELS = Path(__file__).parents[1] / "docs" / "kitti02" / "labels.jsonl"
MEASURED = 809
"""Operations whose labels were measured in each image; later ones were carried by triangulation."""
EVEN, ODD = range(0, 20, 2), range(1, 20, 2)
POSE_SIGMAS = ((0.01, 0.02), (0.02, 0.05), (0.05, 0.1))
"""How far the given poses may be off, m and deg: the default, and more."""
SEEDS = range(20)
"""Of the simulated GPS fixes: 20 times 10 frames."""


def main() -> None:
    kitti = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as folder:
        workspace = Workspace.create_kitti(Path(folder) / "town", kitti, "02", (2, 3), range(20))
        with workspace.open_labels() as store:
            import_operations(LABELS, store)
            store.restore(MEASURED, "bench")
            labels = store.labels
        print(f"{len(labels.elements)} elements, {len(labels.observations)} observations\n")
        semantic_map, report = build_map(labels, workspace.source, BuildOptions(), EVEN)
        save_map(semantic_map, workspace.map_path("even"))
        print(f"map from the even frames: {len(semantic_map)} elements\n{report}")
        print("\nmap projected into the odd frames, minus labels")
        print(mapping_accuracy(semantic_map, labels, workspace.source, ODD).as_text())
        print_methods(labels, workspace.source)
        print_residuals(semantic_map, labels, workspace.source)
        print_localization(workspace)


def print_methods(labels: Labels, source: Dataset) -> None:
    """How well places found from the even frames, one way or another, fit the odd ones."""
    even, odd = (
        collect_observations(labels, source, EVEN),
        collect_observations(labels, source, ODD),
    )
    placed = triangulate_landmarks(even.views, even.observations)
    print(
        "\nplaces from the even frames, seen in the odd ones: RMSE (px) of poles (across) and signs"
    )
    ways = {
        "stereo pairs, linear, mean (the paper's)": mean_of_pairs(even),
        "all views, linear": triangulate_linearly(even.views, even.observations).anchor_and_end_m,
        "all views, least squares": placed.anchor_and_end_m,
    }
    for name, places in ways.items():
        print_fit(name, even, odd, odd.views, places)
    for sigma_m, sigma_deg in POSE_SIGMAS:
        options = RefineOptions(pose_sigma_m=sigma_m, pose_sigma_deg=sigma_deg)
        found = bundle_adjust(even.views, even.observations, placed, options)
        places = found.placed.anchor_and_end_m
        problem = BundleProblem(odd.views, odd.observations, options)
        free = f"refined, poses free by {sigma_m} m and {sigma_deg} deg"
        print(f"{free}; right images are {found.offset_px:+.2f} px off")
        print_fit("  poses and calibration as given", even, odd, odd.views, places)
        still, between = np.zeros((len(ODD), 6)), between_frames(found)
        for words, moved in (("  with the offset", still), ("  and poses as neighbours'", between)):
            at = Unknowns(np.zeros((0, 6)), moved, found.offset_px)
            print_fit(words, even, odd, problem.views(at), places)


def mean_of_pairs(seen: LabelObservations) -> FloatArray:
    """(n, 6) of each element: the mean over its stereo pairs."""
    observations = seen.observations
    frame = seen.views.frame_index[seen.observations.view]
    pairs, pair = np.unique(observations.landmark * 1000 + frame, return_inverse=True)
    each = triangulate_linearly(seen.views, observations.regrouped(pair, len(pairs)))
    whose = np.where(each.ok, pairs // 1000, -1)
    return np.array(
        [
            each.anchor_and_end_m[whose == landmark].mean(axis=0)
            for landmark in range(observations.count)
        ]
    )


def between_frames(found: BundleResult) -> FloatArray:
    """(10, 6) moves of the odd frames: the mean of the even ones before and after."""
    after = np.vstack([found.moved[1:], found.moved[-1:]])
    return np.asarray((found.moved + after) / 2.0)


def print_fit(
    name: str,
    even: LabelObservations,
    odd: LabelObservations,
    views: ViewArray,
    places_m: FloatArray,
) -> None:
    number = {element.id: row for row, element in enumerate(even.elements)}
    landmark = np.array([number[element.id] for element in odd.elements])[odd.observations.landmark]
    seen = odd.observations.regrouped(landmark, len(places_m))
    at = residuals(views, seen, places_m[:, :3], places_m[:, 3:])
    squares = np.square(at.error_px[:, :2])
    poles = np.sqrt(squares[seen.is_line].mean())
    signs = np.sqrt(squares[~seen.is_line].sum(axis=1).mean())
    print(f"{name:<42} {poles:5.2f} {signs:5.2f}")


def print_residuals(semantic_map: SemanticMap, labels: Labels, source: Dataset) -> None:
    """Label minus map under the true poses: by element, by frame, and between the cameras."""
    rows = [
        residual
        for index in range(20)
        for residual in label_residuals(semantic_map, labels, source, index)
    ]
    across = np.array([row[3] for row in rows])
    names = np.array([row[0] for row in rows])
    frames = np.array([row[1] for row in rows])
    right = np.array([row[2] == "right" for row in rows])
    print("\nacross-track residual by element, all frames, both images: rms and mean, px")
    for name in np.unique(names):
        of = across[names == name]
        print(f"  {name:<6} {np.sqrt(np.square(of).mean()):5.2f} {of.mean():+6.2f}  ({len(of)})")
    print("\nmean residual by frame, left image: across (u), along (v, signs only), px")
    v = np.array([row[4] for row in rows])
    for index in range(20):
        of = (frames == index) & ~right
        print(f"  {index:>3} {across[of].mean():+6.2f} {np.nanmean(v[of]):+6.2f}")
    offset = across[right].mean() - across[~right].mean()
    print(f"\nright image against left: {offset:+.2f} px in u")


def label_residuals(
    semantic_map: SemanticMap, labels: Labels, source: Dataset, index: int
) -> list[tuple[str, int, str, float, float]]:
    """(name, frame, side, across px, along px) of every label in one frame."""
    pose = source.frames[index].T_map_camera
    rig = source.rig
    assert pose is not None
    assert rig.right is not None
    assert rig.T_right_left is not None
    views: tuple[tuple[Side, Pose], ...] = (
        ("left", pose.inverse()),
        ("right", rig.T_right_left @ pose.inverse()),
    )
    found = []
    for side, T_camera_map in views:
        camera = rig.left if side == "left" else rig.right
        seen, ids = observe(labels, index, side, semantic_map)
        pairs = np.argwhere(ids[:, None] == semantic_map.elements.id[None, :])
        at = pair_residuals(T_camera_map, camera, seen, semantic_map.elements, pairs)
        for (row, column), px in zip(pairs, at.residual_px, strict=True):
            element_id = int(semantic_map.elements.id[column])
            name = semantic_map.classes.element_name(seen.class_id[row], element_id)
            along = np.nan if seen.is_line[row] else float(px[1])
            found.append((name, index, side, float(px[0]), along))
    return found


def print_localization(workspace: Workspace) -> None:
    found: list[Localization] = []
    truths: list[Pose | None] = []
    for seed in SEEDS:
        options = LocalizeOptions(seed=seed)
        for record in localize_workspace(workspace, "even", options, ODD):
            truth = record.frame.T_map_camera
            found.append(record.localization)
            truths.append(None if truth is None else truth.inverse())
    print(f"\nodd frames localized, {len(SEEDS)} simulated GPS fixes each, 5-10 m off")
    print(summarize(found, truths).as_text())


if __name__ == "__main__":
    main()
