"""The images of a run, and map elements projected into them.

A recorded image is embedded in the run, or its file is referenced. Poles are clipped in front of
the camera, so that the visible part can be drawn; points that are not visible are NaN.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semviz.runs.run import FrameRecord, Images, Run
from semviz_core.base.camera import Camera
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Dataset, FileDataset, Side
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import BoolArray, ByteImage, FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import MOST_IMAGE_BYTES, check_image_size, read_limited, shown

JPEG_QUALITY = 90
SIDES: tuple[Side, ...] = ("left", "right")


def check_images_available(source: Dataset, images: Images) -> None:
    """Raise SemvizError if a source does not have the images that ``--images`` asks for."""
    if images == "both" and source.rig.right is None:
        raise SemvizError("--images both: the sequence has one camera; leave the option out")
    if images == "reference" and not isinstance(source, FileDataset):
        raise SemvizError(
            "--images reference: a simulated street has no image files; "
            "choose embedded, both or none"
        )


def with_images(record: FrameRecord, source: Dataset, images: Images, folder: Path) -> FrameRecord:
    """Return the frame with its images, or their paths, for a run in ``folder``."""
    index = record.frame.index
    has_right = source.rig.right is not None
    match images:
        case "none":
            return record
        case "reference":
            assert isinstance(source, FileDataset)
            left = _relative(source.image_path(index, "left"), folder)
            right = _relative(source.image_path(index, "right"), folder) if has_right else ""
            return replace(record, image_file=left, image_right_file=right)
        case "embedded":
            return replace(record, image=jpeg(source.image(index, "left")))
        case "both":
            left_jpeg, right_jpeg = (jpeg(source.image(index, side)) for side in SIDES)
            return replace(record, image=left_jpeg, image_right=right_jpeg)


def frame_image(run: Run, path: Path, position: int, side: Side) -> bytes | None:
    """Return an image of the frame at ``position`` of the run in ``path``, as JPEG or PNG.

    None if it was not recorded, or cannot be read; see ``missing_image_reason``.
    """
    try:
        return _read_image(run.frames[position], path, side)
    except SemvizError:
        return None


def _read_image(record: FrameRecord, path: Path, side: Side) -> bytes | None:
    """Return an image, None if it was not recorded. Raise SemvizError if none can be read.

    A run must not make a page serve any other file, nor an image that nobody can decode.
    """
    data, where = record.image if side == "left" else record.image_right, "embedded image"
    file = _file(record, path, side)
    if data is None and file is not None:
        data, where = read_limited(file, MOST_IMAGE_BYTES), str(file)
    if data is not None:
        check_image_size(data, where)
    return data


def missing_image_reason(run: Run, path: Path, position: int, side: Side) -> str:
    """Return one line that says why ``frame_image`` returns None."""
    file = _file(run.frames[position], path, side)
    if file is not None and not _exists(file):
        return f"{shown(file)}: the run references this image, but it does not exist any more."
    try:
        _read_image(run.frames[position], path, side)
    except SemvizError as error:
        if file is None:
            return str(error)
        why = str(error).removeprefix(f"{file}: ")
        return f"{shown(file)}: the run references this image, but it cannot be read ({why})."
    also = " of the right camera" if side == "right" else ""
    return f"This run was recorded without images{also}."


def _exists(file: Path) -> bool:
    try:
        return file.exists()
    except OSError:  # a name that is too long
        return False


def relocate_images(record: FrameRecord, old: Path, new: Path) -> FrameRecord:
    """Return the frame with image paths relative to the folder ``new`` instead of ``old``."""
    names = [
        _relative(old.resolve() / name, new) if name else ""
        for name in (record.image_file, record.image_right_file)
    ]
    return replace(record, image_file=names[0], image_right_file=names[1])


def _file(record: FrameRecord, path: Path, side: Side) -> Path | None:
    """Return the path of an image that the run in ``path`` references."""
    name = record.image_file if side == "left" else record.image_right_file
    return Path(os.path.normpath(path.resolve().parent / name)) if name else None


def _relative(file: Path, folder: Path) -> str:
    """Return a path relative to ``folder``, so that both can move together; absolute if they share
    no folder."""
    file, folder = file.resolve(), folder.resolve()
    shared = Path(os.path.commonpath([file, folder]))
    return str(file) if shared == Path(file.anchor) else os.path.relpath(file, folder)


def jpeg(image: ByteImage) -> bytes:
    """Return an image (height, width, 3), RGB, as a JPEG file."""
    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    return cv2.imencode(".jpg", image[:, :, ::-1], quality)[1].tobytes()


NEAR_M = 0.5
"""Poles are clipped at this depth."""
MARGIN = 0.25
"""Elements are near the image up to this share of its size outside."""


@dataclass(frozen=True, eq=False)
class Projected:
    """n map elements projected into a camera; points that are not visible are NaN."""

    anchor_px: FloatArray
    """(n, 2)"""
    end_px: FloatArray
    """(n, 2) NaN for signs."""
    shown: BoolArray
    """(n,) in front of the camera and in or near the image."""
    behind: BoolArray
    """(n,) completely behind the camera."""


def project_elements(elements: Elements3D, T_camera_map: Pose, camera: Camera) -> Projected:
    """Project n elements from the map frame into the image."""
    anchor, end = T_camera_map.apply(elements.anchor_m), T_camera_map.apply(elements.end_m)
    behind = np.fmax(anchor[:, 2], end[:, 2]) < NEAR_M
    anchor, end = _clip(anchor, end), _clip(end, anchor)
    anchor_px, end_px = camera.project(anchor), camera.project(end)
    size = np.array([camera.width, camera.height])
    low = np.fmin(anchor_px, end_px)
    high = np.fmax(anchor_px, end_px)
    shown = (high > -MARGIN * size).all(axis=1) & (low < (1 + MARGIN) * size).all(axis=1)
    return Projected(anchor_px, end_px, np.asarray(shown), np.asarray(behind))


def _clip(points: FloatArray, others: FloatArray) -> FloatArray:
    """Move points (n, 3) nearer than ``NEAR_M`` to it, along the line to their other end."""
    span = others[:, 2] - points[:, 2]
    behind = (points[:, 2] < NEAR_M) & (others[:, 2] > NEAR_M)
    share = np.where(behind, (NEAR_M - points[:, 2]) / np.where(span == 0, 1.0, span), 0.0)
    moved = points + share[:, None] * (others - points)
    return np.where(behind[:, None], moved, points)


def offsets(
    observed: Elements2D, projected: Projected, pairs: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return start points (k, 2) and residual vectors (k, 2) from detection to map, in pixels.

    ``pairs`` (k, 2) are rows (observed, projected). A sign's vector joins the two centers; a
    pole's goes from the middle of the detected line perpendicularly to the projected one.
    """
    i, j = pairs.T
    is_line = observed.is_line[i]
    start = observed.anchor_px[i].copy()
    start[is_line] = (observed.anchor_px[i][is_line] + observed.end_px[i][is_line]) / 2
    vector = projected.anchor_px[j] - start
    along = projected.end_px[j] - projected.anchor_px[j]
    length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    direction = along / length
    across = vector - (vector * direction).sum(axis=1, keepdims=True) * direction
    return start, np.where(is_line[:, None], across, vector)
