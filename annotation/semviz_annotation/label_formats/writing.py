"""Helpers of the label writers, labels as a table (CSV), and the sidecar for keys of other tools.

The table has one line for each label. Columns end with ``_px`` for the image that is labelled,
which has no distortion, and with ``_original_px`` for the image as recorded; (0, 0) is the centre
of the top-left pixel in both. Both ends of a pole are points; between them the recorded pole may
bend.

Each import writes one JSON file into the workspace's folder ``kept``, which never changes again. It
holds the keys of labelme's files by image, and those of its shapes by observation. Keys of a
deleted observation stay, and apply again if the deletion is undone.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from semviz_annotation.label_formats.shapes import outline_corners
from semviz_annotation.labels.labels import Labels
from semviz_annotation.labels.rows import Observation, Pixel
from semviz_core.base.camera import Camera, Rig
from semviz_core.base.classes import ClassSet
from semviz_core.base.frame import Dataset, Side
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import csv_text, replacing
from semviz_core.common.limits import MOST_TEXT_BYTES, parsed_json, read_limited
from semviz_core.datasets.own_drive.images.image_folder import ImageFolder

SIDES: tuple[Side, Side] = ("left", "right")
ATTRIBUTES: Mapping[str, Mapping[str, Literal["text", "checkbox"]]] = {
    "line": {"element": "text", "anchor_known": "checkbox", "end_known": "checkbox"},
    "point": {"element": "text", "anchor_known": "checkbox"},
}
"""Attributes of a pole and of a sign, with their input types."""


@dataclass(frozen=True)
class ImageLabels:
    """One image with its labels."""

    frame_index: int
    side: Side
    width: int
    height: int
    observations: tuple[Observation, ...]

    @property
    def stem(self) -> str:
        return f"{self.frame_index:06d}"

    @property
    def name(self) -> str:
        """File name of the image, from which readers get frame and side."""
        return f"{self.side}/{self.stem}.png"


@dataclass(frozen=True)
class LabelExportContext:
    """The labels to be written, and counts of what the format cannot hold."""

    labels: Labels
    classes: ClassSet
    images: tuple[ImageLabels, ...]
    dropped: "Counter[str]"
    side: Side | None = None
    """The side to be written; None for both."""
    frames: tuple[int, ...] = ()
    """All frames of the workspace, in order, also those without a label."""

    @classmethod
    def of(
        cls, labels: Labels, classes: ClassSet, rig: Rig, side: Side | None = None,
        frames: Collection[int] = (),
    ) -> "LabelExportContext":  # fmt: skip
        """Return all images of frames with labels or a review; ``side`` None: both sides.

        ``frames`` are those of the workspace; those with labels are, whatever it says.

        Elements that a person left out of maps are not written: another tool would take them for
        landmarks.
        """
        kept = labels.without_left_out()
        cameras: dict[Side, Camera | None] = {"left": rig.left, "right": rig.right}
        images = tuple(
            ImageLabels(
                frame, image_side, camera.width, camera.height, kept.in_frame(frame, image_side)
            )
            for frame in sorted({*kept.frames, *kept.reviews})
            for image_side in SIDES
            if (camera := cameras[image_side]) is not None and side in (None, image_side)
        )
        dropped: Counter[str] = Counter()
        dropped["reviews of frames: the format has no word for them"] = len(labels.reviews)
        dropped["proposals turned down: the format has no word for them"] = len(labels.dismissals)
        dropped["notes on elements: the format has no word for them"] = len(labels.notes)
        dropped["decisions for map building: the format has no word for them"] = len(
            labels.review_decisions
        )
        written = sum(len(labelled.observations) for labelled in images)
        other = "right" if side == "left" else "left"
        dropped[f"labels of {other} images: export them with --side {other}"] = (
            len(kept.observations) - written
        )
        dropped["labels of elements that a person left out of maps"] = len(
            labels.observations
        ) - len(kept.observations)
        all_frames = sorted({*frames, *(labelled.frame_index for labelled in images)})
        return cls(kept, classes, images, +dropped, side, tuple(all_frames))

    def class_name(self, row: Observation) -> str:
        return self.classes[self.labels.element(row.element_id).class_id].name

    def attributes(self, row: Observation) -> dict[str, str]:
        """Return the attributes of an observation's element, by name."""
        found = self.labels.attributes_of(row.element_id)
        return {attribute.name: attribute.value for attribute in found}

    def outline(self, row: Observation) -> tuple[Pixel, ...]:
        """Return the corners of the box or polygon of an observation; none if it has none."""
        outline = self.labels.outline_of(row.id)
        return () if outline is None else outline_corners(outline)

    @property
    def attribute_names(self) -> list[str]:
        """The names of all attributes that elements have."""
        return sorted({row.name for row in self.labels.attributes.values()})


def as_word(value: bool) -> str:
    return "true" if value else "false"


@dataclass(frozen=True)
class Sidecar:
    """Keys of other tools with their values, by image and by observation."""

    images: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    observations: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def made(
        cls,
        images: Mapping[tuple[Side, int], Mapping[str, Any]],
        observations: Mapping[str, Mapping[str, Any]],
    ) -> "Sidecar":
        named = {f"{side}/{frame}": keys for (side, frame), keys in images.items() if keys}
        return cls(named, {key: keys for key, keys in observations.items() if keys})

    def of_image(self, side: Side, frame_index: int) -> dict[str, Any]:
        return dict(self.images.get(f"{side}/{frame_index}", {}))

    def of_observation(self, observation_id: str) -> dict[str, Any]:
        return dict(self.observations.get(observation_id, {}))


def save_sidecar(kept: Sidecar, folder: Path) -> None:
    """Add a file to ``folder``, unless there is nothing to keep, or it already exists."""
    if not kept.images and not kept.observations:
        return
    text = json.dumps({"images": dict(kept.images), "observations": dict(kept.observations)})
    path = folder / f"labelme-{hashlib.sha256(text.encode()).hexdigest()[:16]}.json"
    if not path.exists():
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")


def load_sidecar(folder: Path) -> Sidecar:
    """Return the keys of all files in ``folder``; newer ones win. Raise SemvizError if damaged."""
    images: dict[str, Mapping[str, Any]] = {}
    observations: dict[str, Mapping[str, Any]] = {}
    for path in sorted(
        folder.glob("labelme-*.json"), key=lambda path: (path.stat().st_mtime_ns, path)
    ):
        try:
            document = parsed_json(read_limited(path, MOST_TEXT_BYTES))
            images.update(document["images"])
            observations.update(document["observations"])
        except (SemvizError, ValueError, KeyError, TypeError):
            raise SemvizError(f"{path}: damaged; delete it, its keys are lost then") from None
    return Sidecar(images, observations)


OriginalPixels: TypeAlias = Callable[[int, Side, FloatArray], tuple[str, FloatArray]]
"""The recorded image of a frame and side, and its pixels (n, 2) at those of the labelled image."""
COLUMNS = (
    "frame",
    "side",
    "image",
    "element",
    "class",
    *(f"anchor_{axis}{which}_px" for which in ("", "_original") for axis in "uv"),
    "anchor_known",
    *(f"end_{axis}{which}_px" for which in ("", "_original") for axis in "uv"),
    "end_known",
)


def original_pixels(source: Dataset) -> OriginalPixels:
    """Return the way from a dataset's pixels to recorded ones, which only own drives have apart."""

    def to_original(index: int, side: Side, pixels_px: FloatArray) -> tuple[str, FloatArray]:
        if isinstance(source, ImageFolder):
            path, camera = source.original_path(index, side), source.camera_of.get(index)
            name = path.name if camera is None else f"{camera}/{path.name}"
            return name, source.to_original(pixels_px, index, side)
        return f"{side}/{index:06d}.png", pixels_px

    return to_original


def write_table(context: LabelExportContext, path: Path, original: OriginalPixels) -> None:
    """Write the table; cells of a sign's missing end are empty."""
    if outlines := len(context.labels.outlines):
        context.dropped["boxes and polygons: a table has no place for them"] = outlines
    header = (*COLUMNS, *(f"attribute:{name}" for name in context.attribute_names))
    with replacing(path) as temporary:
        table = csv_text([header, *_rows(context, original)])
        temporary.write_text(table, encoding="utf-8", newline="")


def _rows(context: LabelExportContext, original: OriginalPixels) -> Iterator[Sequence[object]]:
    for labelled in context.images:
        for row in labelled.observations:
            ends = [row.anchor_px] if row.end_px is None else [row.anchor_px, row.end_px]
            pixels = np.array(ends, dtype=np.float64)
            name, recorded = original(labelled.frame_index, labelled.side, pixels)
            cells = np.hstack([pixels, recorded]).tolist()
            yield [
                labelled.frame_index,
                labelled.side,
                name,
                context.labels.element(row.element_id).number,
                context.class_name(row),
                *cells[0],
                as_word(row.anchor_known),
                *(cells[1] if row.end_px is not None else [""] * 4),
                as_word(row.end_known),
                *(context.attributes(row).get(name, "") for name in context.attribute_names),
            ]
