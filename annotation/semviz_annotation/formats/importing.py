"""Labels of other tools into a label file: one operation, all or none, undone like any.

What is there already, the same to the last digit, is left alone, so that a file can be imported
again when it has grown. Each element keeps its number where that is still free.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from semviz_annotation.formats.coco import read_coco
from semviz_annotation.formats.cvat import read_cvat
from semviz_annotation.formats.kept import Kept, save_kept
from semviz_annotation.formats.labelme import labelme_files, read_labelme
from semviz_annotation.formats.plan import ImportLabels, plan_import
from semviz_annotation.formats.reading import (
    MOST_JSON_BYTES,
    Found,
    Reading,
    at,
    read_bytes,
    read_json,
)
from semviz_annotation.storing.store import LabelStore
from semviz_core.errors import SemvizError
from semviz_core.sources.source import Side

ForeignFormat: TypeAlias = Literal["cvat", "labelme", "coco"]
KEPT = "kept"
"""Folder beside the label file for what only other tools understand."""
_READERS: Mapping[ForeignFormat, Callable[[Path, Reading], Found]] = {
    "cvat": read_cvat,
    "labelme": read_labelme,
    "coco": read_coco,
}


@dataclass(frozen=True)
class ImportReport:
    """What an import did."""

    path: str
    format: ForeignFormat
    images: int
    observations: int
    """That were added."""
    elements: int
    """That are new."""
    already: int
    """Observations that were there before, the same."""
    dropped: Mapping[str, int] = field(default_factory=dict)
    """What was left out and why, and how often."""
    upside_down: int = 0
    """Poles whose first point is below their second; the peak should come first."""

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
        lines += [f"  dropped: {count} x {what}" for what, count in sorted(self.dropped.items())]
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
) -> ImportReport:
    """Add the labels of ``path`` to ``store``, as one operation of ``author``.

    ``path`` is a CVAT 1.1 .xml, a COCO .json, or a .json or folder of labelme; ``format_`` None
    tells by what is in it. ``frames`` are those there are; ``side`` is that of images whose names
    do not tell; ``class_map`` maps the file's class names to ours, or to ``ignore``. Points are
    checked against the rig of the store. Raises SemvizError naming file and item where something
    is wrong; then nothing is imported.
    """
    format_ = format_ or guess_format(path)
    reading = Reading(store.rules, frames, side, class_map or {})
    found = _READERS[format_](path, reading)
    return _commit(path, format_, found, store, author)


def guess_format(path: Path) -> ForeignFormat:
    """The format of a file or folder, by what is in it; SemvizError where that does not tell."""
    with at(path):
        file = labelme_files(path)[0]
        try:
            with file.open("rb") as opened:
                start = opened.read(2**16)
        except OSError as error:
            raise SemvizError(f"cannot be read ({error.strerror})") from None
        if path.is_dir():
            return "labelme"
        text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
        if text.startswith(b"<"):
            return "cvat"
        if text.startswith(b"{"):
            return _json_format(path)
        if text.startswith(b"PK"):
            raise SemvizError("a zip archive; unpack it and import what is in it")
        raise SemvizError("neither CVAT, labelme nor COCO; say which with --format")


def _json_format(path: Path) -> ForeignFormat:
    document = read_json(read_bytes(path, MOST_JSON_BYTES))
    if "annotations" in document and "images" in document:
        return "coco"
    if "shapes" in document:
        return "labelme"
    raise SemvizError("JSON, but neither labelme's nor COCO's; say which with --format")


def _commit(
    path: Path, format_: ForeignFormat, found: Found, store: LabelStore, author: str
) -> ImportReport:
    plan = plan_import(found.seen, store.labels)
    if plan.repeated:
        found.drop("labels that the file has twice", plan.repeated)
    if plan.observations:
        kept = Kept.made(found.kept_images, plan.kept)
        save_kept(kept, store.path.parent / KEPT)  # first: by itself it changes nothing
        with at(path):
            store.apply(ImportLabels(tuple(plan.elements), tuple(plan.observations)), author)
    upside_down = sum(
        one.end_px is not None and one.anchor_px[1] > one.end_px[1] for one in found.seen
    )
    images = {(one.frame_index, one.side) for one in found.seen}
    return ImportReport(
        path=str(path),
        format=format_,
        images=found.images or len(images),  # tracks have frames only
        observations=len(plan.observations),
        elements=len(plan.elements),
        already=plan.already,
        dropped=dict(found.dropped),
        upside_down=upside_down,
    )
