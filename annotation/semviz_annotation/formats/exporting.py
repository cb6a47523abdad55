"""Labels into other tools' formats: a file, or a folder of files, whole or not at all."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from semviz_annotation.formats.coco import write_coco
from semviz_annotation.formats.cvat import write_cvat, write_cvat_video
from semviz_annotation.formats.importing import KEPT
from semviz_annotation.formats.kept import load_kept
from semviz_annotation.formats.labelme import write_labelme
from semviz_annotation.formats.writing import Writing
from semviz_annotation.storing.store import LabelStore
from semviz_core.errors import SemvizError
from semviz_core.files import new_folder
from semviz_core.sources.source import Side

ExportFormat: TypeAlias = Literal["cvat", "cvat-video", "labelme", "coco"]


@dataclass(frozen=True)
class ExportReport:
    """What an export wrote."""

    path: str
    format: ExportFormat
    images: int
    observations: int
    dropped: Mapping[str, int] = field(default_factory=dict)
    """What the format cannot hold, and how often."""

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)

    def as_text(self) -> str:
        head = f"{self.path}: {self.observations} labels in {self.images} images ({self.format})"
        return "\n".join(
            [head, *(f"  dropped: {n} x {what}" for what, n in sorted(self.dropped.items()))]
        )


def export_labels(
    store: LabelStore, path: Path, format_: ExportFormat, side: Side | None = None
) -> ExportReport:
    """Write the labels of ``store``, which knows its rig, to ``path``.

    ``labelme`` makes the folder ``path``, the others one file. ``side`` writes the images of one
    side only; ``cvat-video`` has one side, the left unless told. Raises SemvizError where it
    cannot be written; then nothing is.
    """
    rig = store.rules.rig
    if rig is None:
        raise SemvizError(f"{store.path}: opened without its cameras, so image sizes are not known")
    if format_ == "cvat-video":
        side = side or "left"
    writing = Writing.of(store.labels, store.rules.classes, rig, side)
    if format_ == "cvat":
        write_cvat(writing, path)
    elif format_ == "cvat-video":
        write_cvat_video(writing, path)
    elif format_ == "coco":
        write_coco(writing, path)
    else:
        kept = load_kept(store.path.parent / KEPT)
        with new_folder(path) as folder:
            write_labelme(writing, folder, kept)
    observations = sum(len(sheet.observations) for sheet in writing.sheets)
    return ExportReport(
        str(path), format_, len(writing.sheets), observations, dict(writing.dropped)
    )
