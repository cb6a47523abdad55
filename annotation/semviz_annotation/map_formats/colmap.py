"""COLMAP's text model, out: cameras, posed images with labels, elements as points.

Two conventions differ (COLMAP's documentation, "Output Format"): the top-left pixel's CENTRE is
(0.5, 0.5), and quaternions are w, x, y, z. Poses are world to camera in both: ``T_camera_map``.
The world is the map frame, z up.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from semviz_annotation.label_formats.reading import quoted
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import Observation, Pixel
from semviz_annotation.labels.views import PosedView, rig_view
from semviz_annotation.map_formats.attributes import drop_attributes
from semviz_annotation.map_formats.conversion import (
    ConversionTally,
    drop_history,
    unseen_ends,
)
from semviz_core.base.camera import Camera
from semviz_core.base.frame import Dataset, Side
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import new_folder

PIXEL_CENTRE = 0.5


@dataclass(frozen=True, eq=False)
class _Image:
    """One image with the labels in it."""

    id: int
    camera_id: int
    name: str
    view: PosedView
    marks: list[tuple[Pixel, int]] = field(default_factory=list)
    """Position in semviz pixels, and id of the point."""


@dataclass(frozen=True, eq=False)
class _Point:
    """An end of an element."""

    id: int
    place_m: FloatArray
    color: tuple[int, int, int]
    track: list[tuple[_Image, int]] = field(default_factory=list)
    """Images, and the index of the mark in each."""

    @property
    def error_px(self) -> float:
        """Mean reprojection error of its marks."""
        errors = [
            np.hypot(*(image.view.project(self.place_m[None])[0] - image.marks[row][0]))
            for image, row in self.track
        ]
        return float(np.nan_to_num(np.mean(errors))) if errors else 0.0


def write_colmap(
    semantic_map: SemanticMap, labels: Labels, source: Dataset, path: Path
) -> ConversionTally:
    """Write the new folder ``path`` with cameras.txt, images.txt and points3D.txt.

    Points are signs' centres, and known peaks (id 2 * element + 1) and bottoms (2 * element + 2) of
    poles. Images are named like ``left/000012.png``.
    """
    if semantic_map.frame.name != source.map_frame.name:
        raise SemvizError(
            f"the map is in the frame {quoted(semantic_map.frame.name)}, the poses are in "
            f"{quoted(source.map_frame.name)}; build the map of this workspace"
        )
    tally = ConversionTally()
    points = {point.id: point for point in _points(semantic_map, tally)}
    images = _images(source, tally)
    _mark(images, points, semantic_map, labels, tally)
    cameras = [camera for camera in (source.rig.left, source.rig.right) if camera is not None]
    with new_folder(path) as folder:
        _write(folder / "cameras.txt", [_camera_line(*camera) for camera in enumerate(cameras, 1)])
        _write(folder / "images.txt", [line for image in images.values() for line in _lines(image)])
        _write(folder / "points3D.txt", [_point_line(point) for point in points.values()])
    tally.drop("lines of poles: their ends are points", int(semantic_map.elements.is_line.sum()))
    tally.drop("classes: colours only", len(semantic_map))
    tally.drop("standard deviations and correlations", len(semantic_map))
    drop_history(semantic_map, tally)
    drop_attributes(semantic_map, tally)
    return tally


def _points(semantic_map: SemanticMap, tally: ConversionTally) -> Iterator[_Point]:
    elements = semantic_map.elements
    if (elements.id < 0).any():
        raise SemvizError("COLMAP's points have no negative numbers; some elements have")
    tally.drop("ends that nobody saw", unseen_ends(semantic_map))
    for row, id_ in enumerate(elements.id.tolist()):
        element_class = semantic_map.classes[int(elements.class_id[row])]
        color = tuple(bytes.fromhex(element_class.color.removeprefix("#")))
        assert len(color) == 3
        if elements.anchor_known[row]:
            yield _Point(2 * id_ + 1, elements.anchor_m[row], color)
        if elements.end_known[row]:
            yield _Point(2 * id_ + 2, elements.end_m[row], color)


def _images(source: Dataset, tally: ConversionTally) -> dict[tuple[int, Side], _Image]:
    """Return all images of frames with a pose, by frame and side."""
    sides = source.rig.sides
    images: dict[tuple[int, Side], _Image] = {}
    for frame in source.frames:
        if frame.T_map_camera is None:
            tally.drop("frames without a pose")
            continue
        for camera_id, side in enumerate(sides, 1):
            view = rig_view(source.rig, side, frame.T_map_camera.inverse())
            name = f"{side}/{frame.index:06d}.png"
            images[frame.index, side] = _Image(len(images) + 1, camera_id, name, view)
    if not images:
        raise SemvizError("no frame of this workspace has a pose; COLMAP's images need one")
    return images


def _mark(
    images: dict[tuple[int, Side], _Image], points: dict[int, _Point],
    semantic_map: SemanticMap, labels: Labels, tally: ConversionTally,
) -> None:  # fmt: skip
    """Add the observations of the map's elements to images and tracks."""
    ids = semantic_map.elements.id.tolist()
    for id_, origin in zip(ids, semantic_map.provenance, strict=False):
        for observation_id in origin.observation_ids:
            row = labels.observations.get(observation_id)
            image = None if row is None else images.get((row.frame_index, row.side))
            if row is None or image is None:
                tally.drop("observations that were deleted since, or are of no posed frame")
                continue
            for pixel, point_id in _seen_ends(row, id_):
                if point_id in points:
                    points[point_id].track.append((image, len(image.marks)))
                    image.marks.append((pixel, point_id))


def _seen_ends(row: Observation, element_id: int) -> Iterator[tuple[Pixel, int]]:
    if row.anchor_known:
        yield row.anchor_px, 2 * element_id + 1
    if row.end_px is not None and row.end_known:
        yield row.end_px, 2 * element_id + 2


def _camera_line(camera_id: int, camera: Camera) -> str:
    model, parameters = _model(camera)
    numbers = " ".join(repr(float(parameter)) for parameter in parameters)
    return f"{camera_id} {model} {camera.width} {camera.height} {numbers}"


def _model(camera: Camera) -> tuple[str, list[float]]:
    """Return COLMAP's camera model and its parameters in COLMAP's order."""
    K, distortion = camera.K, camera.distortion.tolist()
    if K[0, 1]:
        raise SemvizError(f"the camera's axes are skewed ({K[0, 1]:g}); COLMAP has no such model")
    pinhole = [K[0, 0], K[1, 1], K[0, 2] + PIXEL_CENTRE, K[1, 2] + PIXEL_CENTRE]
    if not distortion:
        return "PINHOLE", pinhole
    if len(distortion) > 8:
        raise SemvizError(f"COLMAP has no model with {len(distortion)} numbers of distortion")
    return "FULL_OPENCV", pinhole + distortion + [0.0] * (8 - len(distortion))


def _lines(image: _Image) -> tuple[str, str]:
    """Return the two lines of an image: its pose and its points."""
    T_camera_map = image.view.T_camera_map
    x, y, z, w = T_camera_map.as_quaternion().tolist()
    pose = " ".join(repr(value) for value in (w, x, y, z, *T_camera_map.translation.tolist()))
    marks = " ".join(
        f"{u + PIXEL_CENTRE!r} {v + PIXEL_CENTRE!r} {point_id}" for (u, v), point_id in image.marks
    )
    return f"{image.id} {pose} {image.camera_id} {image.name}", marks


def _point_line(point: _Point) -> str:
    place = " ".join(repr(coordinate) for coordinate in point.place_m.tolist())
    color = " ".join(str(channel) for channel in point.color)
    track = " ".join(f"{image.id} {row}" for image, row in point.track)
    return f"{point.id} {place} {color} {point.error_px!r} {track}".rstrip()


def _write(path: Path, lines: Sequence[str]) -> None:
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
