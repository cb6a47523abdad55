"""Recall of detectors at fixed numbers of false detections, and what they mark in other photos.

    python bench/detector_curve.py /data/kitti [MODEL ...] [--photos FOLDER ...]

On KITTI odometry 02, frames 0 to 19, left and right, judged by docs/kitti02/labels.jsonl up to
40 m; advert and notice boards are neither right nor wrong. Scores are cut after detection, so a
model is looked at once. The photos are not labelled: their marks are counted, at the scores that
leave 2 false poles and 2 false signs an image on KITTI 02, and at the model's own thresholds. A
MODEL is one of 'semviz detect --model'; none: the shipped network.
"""

import argparse
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from real_chain import BOARDS, LABELS, SIDES

from semviz.research.detector_evaluation import EvaluationImage, labelled_images
from semviz.workspace.workspace import Workspace
from semviz_annotation.storage.backup import import_operations
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray
from semviz_core.detection.detector import Detector, load_detector
from semviz_core.metrics.detection import FALSE_POSITIVE, match_detections

LEAST_SCORE = 0.08
FALSE_AN_IMAGE = (0.1, 0.5, 1.0, 2.0, 4.0)
AT_FALSE = 2.0
"""False detections of a kind at which marks in photos are counted."""
KINDS = {"poles": True, "signs": False}


class Judged(NamedTuple):
    """The d detections of one kind in n images."""

    score: FloatArray
    """(d,) highest first"""
    right: BoolArray
    """(d,) of an element that counts"""
    false: BoolArray
    """(d,)"""
    there: int
    """Elements that count."""
    images: int

    def at(self, false_an_image: float) -> tuple[float, float]:
        """Return recall and score at the lowest score with at most so many false detections."""
        false = np.cumsum(self.false) / self.images
        last = np.searchsorted(false, false_an_image + 1e-9, side="right") - 1
        return float(self.right[: last + 1].sum() / self.there), float(self.score[last])


def labelled_drive(folder: str, kitti: Path) -> Workspace:
    """Return a workspace of KITTI 02 in ``folder``, with all its labels."""
    workspace = Workspace.create_kitti(Path(folder) / "drive", kitti, "02", (2, 3), range(20))
    with workspace.open_labels() as store:
        import_operations(LABELS, store)
    return workspace


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kitti", type=Path, help="folder that holds sequences and poses")
    parser.add_argument("models", nargs="*", default=[None], help="default: the shipped network")
    parser.add_argument("--photos", nargs="*", type=Path, default=[], help="folders, with theirs")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        workspace = labelled_drive(folder, arguments.kitti)
        images = labelled_images(workspace, None, SIDES, ignored=BOARDS)
        for model in arguments.models:
            detector = load_detector(model, least_score=LEAST_SCORE)
            print(f"\n{detector.model.name}: {len(images)} images")
            found = [detector.detect(image.read()) for image in images]
            least = {name: shown(name, of_kind) for name, of_kind in judged(found, images).items()}
            own = load_detector(model)
            for photos in arguments.photos:
                print_marks(photos, detector, own, least)


def judged(
    detections: Sequence[Elements2D], images: Sequence[EvaluationImage]
) -> dict[str, Judged]:
    """Judge the poles and signs found in each image."""
    rows: dict[str, list[tuple[float, bool, bool]]] = {name: [] for name in KINDS}
    there = dict.fromkeys(KINDS, 0)
    for found, image in zip(detections, images, strict=True):
        truth = image.truth()
        matches = match_detections(found, truth)
        for name, is_line in KINDS.items():
            there[name] += int((truth.counts & (truth.elements.is_line == is_line)).sum())
            rows[name] += (
                (float(found.score[row]), matches[row] >= 0, matches[row] == FALSE_POSITIVE)
                for row in np.flatnonzero(found.is_line == is_line).tolist()
            )
    return {name: _sorted(rows[name], there[name], len(images)) for name in KINDS}


def _sorted(rows: Iterable[tuple[float, bool, bool]], there: int, images: int) -> Judged:
    score, right, false = (np.array(column) for column in zip(*rows, strict=True))
    order = np.argsort(-score, kind="stable")
    return Judged(score[order], right[order], false[order], there, images)


def shown(name: str, found: Judged) -> float:
    """Print the recall of one kind; return the score at which its marks in photos are counted."""
    figures = (f"{false:g}: {{:.0%}} (from {{:.2f}})".format(*found.at(false))
               for false in FALSE_AN_IMAGE)  # fmt: skip
    print(f"  {name}, {found.there} in view; at false ones an image of {', '.join(figures)}")
    return found.at(AT_FALSE)[1]


def print_marks(folder: Path, detector: Detector, own: Detector, least: dict[str, float]) -> None:
    """Print the marks in all photos below a folder: mean, fewest and most of an image."""
    photos = sorted(path for path in folder.rglob("*") if path.suffix in (".jpg", ".png"))
    for text, chosen in ((f"at those of {AT_FALSE:g} false", detector), ("own thresholds", own)):
        found = [chosen.detect(_read(path)) for path in photos]
        limits = least if chosen is detector else dict.fromkeys(KINDS, 0.0)
        figures = (
            f"{np.mean(counts):.1f} {name} ({min(counts)} to {max(counts)})"
            for name, is_line in KINDS.items()
            for counts in [[_count(row, is_line, limits[name]) for row in found]]
        )
        print(f"  {folder.name}, {len(photos)} photos, {text}: {', '.join(figures)}", flush=True)


def _count(found: Elements2D, is_line: bool, least: float) -> int:
    return int(((found.is_line == is_line) & (found.score >= least)).sum())


def _read(path: Path) -> ByteImage:
    image = cv2.imread(str(path))
    assert image is not None, f"{path}: no image"
    return np.ascontiguousarray(image[..., ::-1])


if __name__ == "__main__":
    main()
