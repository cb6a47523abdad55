"""What a detector's false poles on KITTI odometry 02 are, and which poles it misses.

    python bench/false_poles.py /data/kitti [--model espnet.toml] [--false 2]

Poles up to 40 m in frames 0 to 19, left and right, by docs/kitti02/labels.jsonl, at the lowest
score with at most ``--false`` false ones an image. Each false one is counted once, as the first of:
on the axis of a labelled pole at any distance, but of a part of it that is too short to match;
beside a labelled pole or turned against it; at a labelled sign or board; elsewhere.
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from detector_curve import LEAST_SCORE, judged, labelled_drive
from real_chain import BOARDS, SIDES

from semviz.research.detector_evaluation import EvaluationImage, labelled_images
from semviz_core.base.elements import Elements2D
from semviz_core.common.arrays import FloatArray
from semviz_core.detection.detector import load_detector
from semviz_core.metrics.detection import FALSE_POSITIVE, ImageGroundTruth, match_detections

FENCE_POSTS = range(28, 36)
"""Element numbers in ``LABELS``."""
ON_PX, BESIDE_PX, TURNED_DEG = 4.0, 12.0, 11.0
"""Largest distance from a pole's axis, of its parts and of what is beside it; largest angle."""
AT_SIGN_M = 1.1
"""Largest distance from a sign's middle: half a board, and what holds it."""
KINDS = ("part of a labelled pole", "beside a labelled pole, or turned", "at a sign or board",
         "elsewhere")  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kitti", type=Path, help="folder that holds sequences and poses")
    parser.add_argument("--model", help="as of 'semviz detect'; default: the shipped network")
    parser.add_argument("--false", type=float, default=2.0, help="false poles an image")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        workspace = labelled_drive(folder, arguments.kitti)
        images = labelled_images(workspace, None, SIDES, ignored=BOARDS)
        detector = load_detector(arguments.model, least_score=LEAST_SCORE)
        found = [detector.detect(image.read()) for image in images]
        without_posts = labelled_images(workspace, None, SIDES, ignored=(*BOARDS, *FENCE_POSTS))
    recall, least = judged(found, images)["poles"].at(arguments.false)
    print(f"{detector.model.name}, score from {least:.2f}: {recall:.0%} of the poles found")
    chosen = [elements[elements.score >= least] for elements in found]
    for name, judging in (("all", images), ("fence posts neither right nor wrong", without_posts)):
        poles = judged(chosen, judging)["poles"]
        false = poles.false.sum() / poles.images
        print(f"  {name}: {poles.right.sum()} of {poles.there}, {false:.2f} false an image")
    print_false(chosen, images, workspace.source.rig.left.K[0, 0])


def print_false(
    found: Sequence[Elements2D], images: Sequence[EvaluationImage], focal_px: float
) -> None:
    counts: Counter[str] = Counter()
    for elements, image in zip(found, images, strict=True):
        truth = image.truth()
        is_false = (match_detections(elements, truth) == FALSE_POSITIVE) & elements.is_line
        for row in np.flatnonzero(is_false).tolist():
            line = np.stack([elements.anchor_px[row], elements.end_px[row]])
            counts[kind_of(line, truth, focal_px)] += 1
    print(f"  false: {counts.total()} in {len(images)} images")
    for kind in KINDS:
        print(f"    {counts[kind]} {kind}")


def kind_of(line_px: FloatArray, truth: ImageGroundTruth, focal_px: float) -> str:
    """Return which of ``KINDS`` a false pole (2, 2) is."""
    elements, middle = truth.elements, line_px.mean(axis=0)
    kinds = {
        beside_kind(line_px, np.stack([elements.anchor_px[row], elements.end_px[row]]))
        for row in np.flatnonzero(elements.is_line)
    }
    signs = np.flatnonzero(~elements.is_line)
    away = np.linalg.norm(elements.anchor_px[signs] - middle, axis=1)
    if (away < AT_SIGN_M * focal_px / truth.distance_m[signs]).any():
        kinds.add(KINDS[2])
    return next((kind for kind in KINDS if kind in kinds), KINDS[3])


def beside_kind(line_px: FloatArray, true_px: FloatArray) -> str:
    """Return how a false pole lies to a true one (2, 2); empty if apart from it."""
    length = float(np.linalg.norm(true_px[1] - true_px[0]))
    along = (true_px[1] - true_px[0]) / max(length, 1e-9)
    places = (line_px - true_px[0]) @ along
    off = np.abs((line_px - true_px[0]) @ np.array([along[1], -along[0]]))
    angle = np.rad2deg(np.arctan2(*np.ptp(np.stack([off, places]), axis=1)))
    if min(places.max(), length) <= max(places.min(), 0.0) or angle > TURNED_DEG:
        return ""
    return KINDS[0] if off.max() <= ON_PX else KINDS[1] if off.mean() <= BESIDE_PX else ""


if __name__ == "__main__":
    main()
