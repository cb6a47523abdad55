"""A model that finds the labelled poles in the real images of KITTI 02, in place of a network."""

from pathlib import Path

import cv2
import numpy as np
from onnx_models import describe, knowing

from semviz.research.detector_evaluation import labelled_images
from semviz.workspace.workspace import Workspace
from semviz_annotation.storage.backup import import_operations

LABELS = Path(__file__).parents[1] / "docs" / "kitti02" / "labels.jsonl"
SIZE, FRAMES, WIDTH_PX = (1248, 384), range(20), 4


def write_model(toml: Path, kitti: Path) -> None:
    """Write an ONNX model beside the TOML that describes it."""
    workspace = Workspace.create_kitti(toml.parent / "labelled", kitti, "02", (2, 3), FRAMES)
    with workspace.open_labels() as store:
        import_operations(LABELS, store)
    images, maps = [], []
    for image in labelled_images(workspace, None, ("left", "right")):
        picture, poles = image.read(), image.truth().elements
        shown = np.zeros(picture.shape[:2], np.uint8)
        for row in np.flatnonzero(poles.is_line):
            ends = np.round(np.stack([poles.anchor_px[row], poles.end_px[row]]) * 16).astype(int)
            cv2.line(shown, ends[0], ends[1], 1, WIDTH_PX, cv2.LINE_8, 4)
        images.append(cv2.resize(picture, SIZE))
        maps.append(cv2.resize(shown, SIZE, interpolation=cv2.INTER_NEAREST))
    knowing(toml.with_suffix(".onnx"), np.stack(images), np.stack(maps))
    describe(toml.with_suffix(".onnx"), SIZE, outputs=["labels"], input={"resize": "stretch"})
