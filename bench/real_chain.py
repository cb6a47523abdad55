"""From images to poses without a hand: KITTI odometry 02, frames 0 to 19, or a drive of your own.

    python bench/real_chain.py /data/kitti --model espnet/espnet.toml
    python bench/real_chain.py /data/kitti --proposals town/proposals.parquet

Detects poles and signs in all images (or reads the detections), builds a map from those in the even
frames, and localizes the odd frames in it from their own detections, with GPS 5-10 m off and an
unknown heading. Labels judge the detector, and are not used for the map.

Columns of the second table. ok: share of frames with status ok; below 1 m: of all frames. RTE:
mean error of ok frames. wrong: ok frames that are more than 1 m or 1 deg off. false: poles and
signs of the map that stand on nothing labelled (more of their detections are false than right; the
labels tell up to 200 m), and those that nobody can tell.
"""

import argparse
import tempfile
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from semviz.research.detector_evaluation import labelled_images
from semviz.workspace.detect import DetectOptions, detect_images, images_of
from semviz.workspace.localization.localize import LocalizeOptions, localize_workspace
from semviz.workspace.workspace import Workspace
from semviz_annotation.labels.detections import as_elements
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.proposals import (
    Proposals,
    load_proposals,
    read_proposals,
    save_proposals,
)
from semviz_annotation.labels.rows import derived_id
from semviz_annotation.mapping.association.detection_tracks import TrackOptions
from semviz_annotation.mapping.build import BuildReport, build_map
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.camera import Camera
from semviz_core.base.classes import POLE
from semviz_core.base.detector_model import DetectorCalibration
from semviz_core.base.frame import Side
from semviz_core.base.localization import Localization
from semviz_core.base.map_file import save_map
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.detection.detector import load_detector
from semviz_core.metrics.detection import IGNORED, REACH_M
from semviz_core.metrics.detection_summary import ImageEvaluation, detection_figures
from semviz_core.metrics.pose_errors import pose_error

LABELS = Path(__file__).parents[1] / "docs" / "kitti02" / "labels.jsonl"
SIDES: tuple[Side, Side] = ("left", "right")
BOARDS = (1, 2, 18, 25)
"""Element numbers of adverts, notices and a container in ``LABELS``: no traffic signs."""
FAR_M = 200.0
"""Labels tell this far which elements of a map are false."""


@dataclass(frozen=True)
class Case:
    """Which detections a map is built from, and which ones are localized."""

    name: str
    sides: tuple[Side, ...]
    classes: tuple[int, ...] | None
    """None: all"""
    least_score: float = 0.0

    def of(self, detections: Proposals) -> Proposals:
        """Return the detections of the case; all of one side are kept for localizing."""
        rows = (
            row
            for row in detections.rows()
            if row.score >= self.least_score
            and (self.classes is None or row.class_id in self.classes)
        )
        return Proposals.of([*rows], detections.processed)


class Seen(NamedTuple):
    """How detections are localized: frames alone or tracked, some left out, false ones added."""

    track: bool = False
    left_out: float = 0.0
    """Share of the detections."""
    false: float = 0.0
    """False poles added to each image, on average, anywhere above the road."""

    def of(self, detections: Proposals, camera: Camera, frames: range, seed: int) -> Proposals:
        """Return the left detections in ``frames`` as they are localized."""
        rng = np.random.default_rng(seed)
        left = (
            row for row in detections.rows() if row.side == "left" and row.frame_index in frames
        )
        rows = [row for row in left if rng.random() >= self.left_out]
        for frame in frames:
            for number in range(int(rng.poisson(self.false))):
                u, v = rng.uniform([5.0, 40.0], [camera.width - 5.0, camera.height / 2.0])
                foot = (float(u + rng.normal(0.0, 2.0)), float(v + rng.uniform(30.0, 140.0)))
                rows.append(
                    Proposal(
                        derived_id(f"false {seed} {frame} {number}"), frame, "left", POLE,
                        (float(u), float(v)), foot, True, True, 0.6, 1.0, 3.0, rows[0].detector,
                    )
                )  # fmt: skip
        return Proposals.of(rows, detections.processed)


AS_THEY_ARE = Seen()
CASES = (
    Case("one camera", ("left",), None),
    Case("one camera, poles only", ("left",), (POLE,)),
    Case("one camera, poles of score 0.5", ("left",), (POLE,), 0.5),
    Case("two cameras", SIDES, None),
    Case("two cameras, poles only", SIDES, (POLE,)),
)


def main() -> None:
    options = _arguments()
    with tempfile.TemporaryDirectory() as folder:
        frames = range(options.first, options.first + options.frames)
        workspace = Workspace.create_kitti(
            Path(folder) / "drive", options.kitti, options.sequence, (2, 3), frames
        )
        detections = _detections(workspace, options.model, options.proposals, options.least_score)
        save_proposals(detections, workspace.proposals_path)
        judge = None
        if options.labels.is_file():
            print_detector(workspace, detections, options.labels)
            judge = Judge.of(workspace, detections, options.labels)
        print(
            f"\n{'map of the even frames':<34}{'poles':>6}{'signs':>6}{'frames':>8}{'ok':>6}",
            end="",
        )
        print(f"{'below 1 m':>11}{'RTE':>9}{'wrong':>7}")
        calibration = options.calibration and DetectorCalibration.load(options.calibration)
        seen = Seen(options.track, options.left_out, options.false)
        for case in CASES:
            print_case(workspace, case, detections, frames, options.seeds, calibration, judge, seen)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kitti", type=Path, help="folder that holds sequences and poses")
    parser.add_argument("--model", help="as in 'semviz detect'; default: the shipped network")
    parser.add_argument("--calibration", type=Path, help="file of 'semviz detect choose'")
    parser.add_argument("--proposals", type=Path, help="detections instead of a model")
    parser.add_argument("--least-score", type=float, help="as in 'semviz detect'")
    parser.add_argument("--sequence", default="02")
    parser.add_argument("--first", type=int, default=0, help="first frame")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--labels", type=Path, default=LABELS, help="to judge the detector by")
    parser.add_argument("--seeds", type=int, default=3, help="simulated GPS fixes per frame")
    parser.add_argument("--track", action="store_true", help="follow the camera")
    parser.add_argument("--left-out", type=float, default=0.0, help="share of what is localized")
    parser.add_argument("--false", type=float, default=0.0, help="poles added to each image")
    return parser.parse_args()


def _detections(
    workspace: Workspace,
    model: str | None,
    proposals: Path | None,
    least_score: float | None = None,
) -> Proposals:
    if proposals is not None:
        known = [frame.index for frame in workspace.source.frames]
        is_ours = proposals.suffix == ".parquet"  # with the images in which nothing was found
        found = (
            load_proposals(proposals, workspace.classes)
            if is_ours
            else read_proposals(proposals, workspace.classes, workspace.source.rig)
        )
        rows = [row for row in found.rows() if row.frame_index in known]
        return Proposals.of(rows, found.processed)
    images = images_of(workspace, None, SIDES)
    options = DetectOptions(model=model, least_score=least_score)
    detector = load_detector(model, least_score=least_score)
    return detect_images(workspace, detector, options, images)


def print_detector(workspace: Workspace, detections: Proposals, labels: Path) -> None:
    """Recall and false detections up to 40 m, in all images; boards are neither."""
    ignored = BOARDS if labels == LABELS else ()
    images = [image for _, image in _judged(workspace, detections, labels, REACH_M, ignored)]
    figures = detection_figures(images, workspace.classes, 0.0)
    print(f"{len(detections)} detections in {len(images)} images, up to 40 m:")
    for name, of_class in figures.classes.items():
        if of_class.recall.of:
            print(
                f"  {name}: {of_class.recall.count} of {of_class.recall.of} found, "
                f"{of_class.false_a_frame:.1f} false an image"
            )


def _judged(
    workspace: Workspace,
    detections: Proposals,
    labels: Path,
    reach_m: float,
    ignored: Collection[int] = (),
) -> list[tuple[list[Proposal], ImageEvaluation]]:
    """Return the detections of each image, and how they compare with the labels, which the
    workspace has meanwhile."""
    judged = Workspace.open(workspace.path)
    with judged.open_labels() as store:
        import_operations(labels, store)
    images = []
    for image in labelled_images(judged, None, SIDES, reach_m, ignored):
        found = detections.in_frame(image.frame_index, image.side)
        elements = as_elements(found, image.triangle_center)
        images.append((found, ImageEvaluation(elements, image.truth(), 0.0)))
    judged.labels_path.unlink()
    return images


@dataclass(frozen=True)
class Judge:
    """Tells which elements of a map from detections stand on nothing labelled."""

    is_right: dict[str, bool]
    """Whether a detection is of a label, by id; without those that cannot be told."""

    @classmethod
    def of(cls, workspace: Workspace, detections: Proposals, labels: Path) -> "Judge":
        return cls(
            {
                row.id: match >= 0
                for found, image in _judged(workspace, detections, labels, FAR_M)
                for row, match in zip(found, image.matches.tolist(), strict=True)
                if match != IGNORED
            }
        )

    def told(self, built: SemanticMap) -> str:
        """Return the number of false poles and signs of a map, and of those that nobody can
        tell."""
        names: dict[bool | None, list[str]] = {False: [], None: []}
        for id_, origin in zip(built.elements.id.tolist(), built.provenance, strict=True):
            votes = [self.is_right[row] for row in origin.observation_ids if row in self.is_right]
            is_right = 2 * sum(votes) >= len(votes) if votes else None
            if not is_right:
                names[is_right].append(built.name_of(id_))
        return "; ".join(
            " ".join([f"{len(some)} {text}:", *some]) if some else f"0 {text}"
            for some, text in zip(names.values(), ("false", "not told"), strict=True)
        )


def print_case(
    workspace: Workspace,
    case: Case,
    detections: Proposals,
    frames: range,
    seeds: int,
    calibration: DetectorCalibration | None,
    judge: Judge | None,
    seen: Seen,
) -> None:
    chosen = case.of(detections)
    save_proposals(chosen, workspace.proposals_path)
    try:
        built, report = _map(workspace, case, chosen, frames[::2], calibration)
    except SemvizError as error:
        print(f"{case.name:<34}  {error}")
        return
    save_map(built, workspace.map_path("own"))
    found = list(localized(workspace, frames[1::2], seeds, calibration, seen))
    errors = np.array([errors_of(*pair) for pair in found])
    ok = np.array([result.status == "ok" for result, _ in found])
    wrong = ok & (errors > 1.0).any(axis=1)
    poles = int(built.elements.is_line.sum())
    print(
        f"{case.name:<34}{poles:6d}{len(built) - poles:6d}{len(found):8d}{ok.sum():6d}"
        f"{(errors[:, 0] < 1.0).mean():11.0%}{errors[ok, 0].mean() if ok.any() else np.nan:7.3f} m"
        f"{wrong.sum():7d}",
        flush=True,
    )
    print(f"  {report.detections}")
    if judge is not None:
        print(f"  of the map's elements {judge.told(built)}")


def _map(
    workspace: Workspace,
    case: Case,
    detections: Proposals,
    frames: range,
    calibration: DetectorCalibration | None,
) -> tuple[SemanticMap, BuildReport]:
    """Build the map without any label."""
    seen = of_sides(detections, case.sides)
    return build_map(
        Labels(),
        workspace.source,
        frames=frames,
        detections=seen,
        tracking=TrackOptions(calibration=calibration),
    )


def of_sides(detections: Proposals, sides: tuple[Side, ...]) -> Proposals:
    """Return the detections of some cameras, as if no detector had processed the others' images."""
    rows = [row for row in detections.rows() if row.side in sides]
    processed = detections.processed
    if processed is not None:
        images = frozenset(image for image in processed.images if image[1] in sides)
        processed = replace(processed, images=images)
    return Proposals.of(rows, processed)


def localized(
    workspace: Workspace,
    frames: range,
    seeds: int,
    calibration: DetectorCalibration | None,
    seen: Seen = AS_THEY_ARE,
) -> Iterator[tuple[Localization, Pose]]:
    """Yield each localization with the true T_map_camera."""
    detections = load_proposals(workspace.proposals_path, workspace.classes)
    camera = workspace.source.rig.left
    least = 0.0 if calibration is None else calibration.least_score
    for seed in range(seeds):
        save_proposals(seen.of(detections, camera, frames, seed), workspace.proposals_path)
        options = LocalizeOptions(
            observations="detected", seed=seed, least_score=least, track=seen.track
        )
        for record in localize_workspace(workspace, "own", options, frames, calibration):
            assert record.frame.T_map_camera is not None
            yield record.localization, record.frame.T_map_camera
    save_proposals(detections, workspace.proposals_path)


def errors_of(result: Localization, truth: Pose) -> tuple[float, float]:
    """RTE (m) and RRE (deg); infinite without a pose."""
    if result.T_camera_map is None:
        return np.inf, np.inf
    return pose_error(result.T_camera_map, truth.inverse())


if __name__ == "__main__":
    main()
