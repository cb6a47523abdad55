"""Import and export of labels, completely or not at all.

An import is one operation and can be undone; see ``import_plan``. The format is recognized from
the file's content.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from semviz_annotation.label_formats import reading, writing
from semviz_annotation.label_formats.coco import read_coco, write_coco
from semviz_annotation.label_formats.cvat import read_cvat, write_cvat, write_cvat_video
from semviz_annotation.label_formats.import_context import (
    LabelImportContext,
    NamedImages,
    PixelsOf,
)
from semviz_annotation.label_formats.import_plan import ImportLabels, plan_import
from semviz_annotation.label_formats.labelme import labelme_files, read_labelme, write_labelme
from semviz_annotation.label_formats.writing import OriginalPixels, write_table
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import new_folder

ForeignFormat: TypeAlias = Literal["cvat", "labelme", "coco"]
KEPT = "kept"
"""Folder next to the label file for keys that only other tools understand."""
_READERS: Mapping[ForeignFormat, Callable[[Path, LabelImportContext], reading.ParsedLabels]] = {
    "cvat": read_cvat,
    "labelme": read_labelme,
    "coco": read_coco,
}


@dataclass(frozen=True)
class ImportReport:
    """The result of an import."""

    path: str
    format: ForeignFormat
    images: int
    observations: int
    """Number of added observations."""
    elements: int
    """Number of new elements."""
    attributes: int
    """Number of added attributes of elements."""
    outlines: int
    """Number of boxes and polygons that are kept with their labels."""
    already: int
    """Number of observations that existed before."""
    dropped: Mapping[str, int] = field(default_factory=dict)
    """Count of dropped content, by what it was and why."""
    assumed: Mapping[str, int] = field(default_factory=dict)
    """Count of labels that were converted on an assumption."""
    upside_down: int = 0
    """Poles whose first point is below their second; the peak should come first."""
    triangle_points: int = 0
    """Triangular signs marked by a point, which was taken for the centroid of the corners."""
    triangle_boxes: int = 0
    """Triangular signs marked by a box, which were taken to stand upright."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def as_text(self) -> str:
        lines = [
            f"{self.path}: {self.observations} labels of {self.elements} new elements "
            f"from {self.images} images ({self.format})"
        ]
        if self.already:
            lines.append(f"  {self.already} were there already")
        if self.upside_down:
            lines.append(f"  {self.upside_down} poles start at their lower end; R swaps the ends")
        if self.triangle_points:
            lines.append(
                f"  {self.triangle_points} triangular signs are points: taken for the centroid of "
                "their corners, as in this workspace; the middle of a box is a sixth higher"
            )
        if self.triangle_boxes:
            lines.append(
                f"  {self.triangle_boxes} triangular signs are boxes: taken to stand upright; "
                "move those of give-way signs"
            )
        lines += [f"  dropped: {count} x {what}" for what, count in sorted(self.dropped.items())]
        lines += [f"  assumed: {count} x {what}" for what, count in sorted(self.assumed.items())]
        return "\n".join(lines)


def import_labels(
    path: Path,
    store: LabelStore,
    author: str,
    format_: ForeignFormat | None = None,
    *,
    frames: Collection[int] | None = None,
    side: Side | None = None,
    class_map: Mapping[str, str] | None = None,
    recorded: NamedImages | None = None,
    pixels: PixelsOf | None = None,
) -> ImportReport:
    """Add the labels of ``path`` to ``store``, as one operation of ``author``.

    ``path`` is a CVAT 1.1 .xml, a COCO .json, or a .json or folder of labelme; ``format_`` None
    recognizes it by content. ``frames`` are the existing frames; ``side`` is that of images whose
    names do not state it; ``class_map`` maps class names of the file to semviz names or ``ignore``,
    ``*`` all others. Files may name ``recorded`` images; ``pixels`` None: drawn in what they name.
    Points must be inside the images. Raise SemvizError, naming file and item, if something is
    invalid. Nothing is imported then.
    """
    format_ = format_ or guess_format(path)
    center = store.labels.triangle_center
    context = LabelImportContext(
        store.rules, frames, side, class_map or {}, center, recorded, pixels
    )
    parsed = _READERS[format_](path, context)
    return _commit(path, format_, parsed, store, author)


def guess_format(path: Path) -> ForeignFormat:
    """Return the format of a file or folder by its content. Raise SemvizError if it is unknown."""
    with reading.at(path):
        file = labelme_files(path)[0]
        start = reading.read_bytes(file, reading.MOST_XML_BYTES, 2**16)
        if path.is_dir():
            return "labelme"
        text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
        if text.startswith(b"<"):
            return "cvat"
        if text.startswith(b"{"):
            return _json_format(path)
        if text.startswith(b"PK"):
            raise SemvizError("a zip archive; unpack it and import what is in it")
        raise SemvizError("neither CVAT, labelme nor COCO; let its tool export one of these")


def _json_format(path: Path) -> ForeignFormat:
    document = reading.read_json(reading.read_bytes(path, reading.MOST_JSON_BYTES))
    if "annotations" in document and "images" in document:
        return "coco"
    if "shapes" in document:
        return "labelme"
    raise SemvizError("JSON, but neither labelme's nor COCO's; let its tool export one of these")


def _commit(
    path: Path, format_: ForeignFormat, parsed: reading.ParsedLabels, store: LabelStore, author: str
) -> ImportReport:
    plan = plan_import(parsed.observations, store.labels)
    if plan.repeated:
        parsed.drop("labels that the file has twice", plan.repeated)
    for what, count in plan.dropped.items():
        parsed.drop(what, count)
    if plan.adds:
        kept = writing.Sidecar.made(parsed.kept_images, plan.kept)
        writing.save_sidecar(kept, store.path.parent / KEPT)  # first: unused if the import fails
        with reading.at(path):
            store.apply(ImportLabels.of(plan), author)
    upside_down = sum(
        observation.end_px is not None and observation.anchor_px[1] > observation.end_px[1]
        for observation in parsed.observations
    )
    images = {(observation.frame_index, observation.side) for observation in parsed.observations}
    return ImportReport(
        path=str(path),
        format=format_,
        images=parsed.images or len(images),  # tracks have frames only
        observations=len(plan.observations),
        elements=len(plan.elements),
        attributes=len(plan.attributes),
        outlines=len(plan.outlines),
        already=plan.already,
        dropped=dict(parsed.dropped),
        assumed=dict(parsed.assumed),
        upside_down=upside_down,
        triangle_points=parsed.triangle_points,
        triangle_boxes=parsed.triangle_boxes,
    )


ExportFormat: TypeAlias = Literal["cvat", "cvat-video", "labelme", "coco", "csv"]


@dataclass(frozen=True)
class ExportReport:
    """The result of an export."""

    path: str
    format: ExportFormat
    images: int
    observations: int
    dropped: Mapping[str, int] = field(default_factory=dict)
    """Count of content that the format cannot hold."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def as_text(self) -> str:
        head = f"{self.path}: {self.observations} labels in {self.images} images ({self.format})"
        return "\n".join(
            [head, *(f"  dropped: {n} x {what}" for what, n in sorted(self.dropped.items()))]
        )


def export_labels(
    store: LabelStore,
    path: Path,
    format_: ExportFormat,
    side: Side | None = None,
    original: OriginalPixels | None = None,
    frames: Collection[int] = (),
    start_frame: int | None = None,
) -> ExportReport:
    """Write the labels of ``store``, opened with its rig, to ``path``.

    ``labelme`` creates the folder ``path``, the others one file. ``side`` writes the images of one
    side only; ``cvat-video`` always has one side, default: left. ``original`` is what ``csv``
    needs. ``frames`` are those of the workspace, for ``cvat-video``; ``start_frame`` numbers them
    from there on. Raise SemvizError if ``path`` cannot be written. Nothing is written then.
    """
    rig = store.rig
    if rig is None:
        raise SemvizError(f"{store.path}: opened without its cameras, so image sizes are not known")
    if format_ == "cvat-video":
        side = side or "left"
    context = writing.LabelExportContext.of(store.labels, store.rules.classes, rig, side, frames)
    if format_ == "cvat":
        write_cvat(context, path)
    elif format_ == "cvat-video":
        write_cvat_video(context, path, start_frame)
    elif format_ == "coco":
        write_coco(context, path)
    elif format_ == "csv":
        assert original is not None
        write_table(context, path, original)
    else:
        kept = writing.load_sidecar(store.path.parent / KEPT)
        with new_folder(path) as folder:
            write_labelme(context, folder, kept)
    observations = sum(len(labelled.observations) for labelled in context.images)
    return ExportReport(
        str(path), format_, len(context.images), observations, dict(context.dropped)
    )
