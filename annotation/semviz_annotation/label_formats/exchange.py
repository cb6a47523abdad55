"""Import and export of labels, completely or not at all.

The plan of an import says which shapes form one element, and which are already labelled. An import
is one operation and can be undone. Labels that already exist, equal to the last digit, are skipped,
so an extended file can be imported again. Elements keep their numbers where these are free. The
format is recognized from the file's content.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
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
from semviz_annotation.label_formats.labelme import labelme_files, read_labelme, write_labelme
from semviz_annotation.label_formats.reading import ParsedObservation, at, quoted
from semviz_annotation.label_formats.writing import OriginalPixels, write_table
from semviz_annotation.labels import rows
from semviz_annotation.labels.labels import Labels
from semviz_annotation.storage.store import LabelStore
from semviz_core.base.frame import Side
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import new_folder

MOST_NUMBER = 1_000_000
"""Larger element numbers of a file are replaced."""
_Content: TypeAlias = tuple[int, Side, int, rows.Pixel, rows.Pixel | None]


@dataclass(frozen=True)
class ImportLabels:
    """Add the elements and observations of a file, as one edit.

    New elements keep their numbers if no element ever had them.
    """

    elements: tuple[rows.LabelElement, ...]
    observations: tuple[rows.Observation, ...]
    kind: Literal["import"] = "import"

    def changes(self, labels: Labels, rules: rows.Rules) -> Iterator[rows.RowChange]:
        classes = {element.id: element.class_id for element in labels.elements.values()}
        for element in _numbered(self.elements, labels.next_number):
            classes[element.id] = rules.check_class(element).class_id
            yield rows.RowChange(None, element)
        for row in self.observations:
            yield rows.RowChange(None, rules.check(row, classes[row.element_id]))
            dismissal = labels.dismissals.get(
                rows.proposal_id(row.element_id, row.frame_index, row.side)
            )
            if dismissal is not None:  # the element is visible there after all
                yield rows.RowChange(dismissal, None)


def _numbered(elements: Sequence[rows.LabelElement], first: int) -> Iterator[rows.LabelElement]:
    wanted = Counter(element.number for element in elements)
    free = {n for n, count in wanted.items() if count == 1 and first <= n < MOST_NUMBER}
    following = max(free, default=first - 1)
    for element in elements:
        if element.number in free:
            yield element
        else:
            following += 1
            yield replace(element, number=following)


@dataclass
class ImportPlan:
    """What an import adds, and how many labels it skips."""

    elements: list[rows.LabelElement] = field(default_factory=list)
    observations: list[rows.Observation] = field(default_factory=list)
    kept: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """Keys that only the file's format understands, by observation id."""
    already: int = 0
    repeated: int = 0
    """Number of labels that the file has twice."""


def plan_import(observations: Sequence[ParsedObservation], labels: Labels) -> ImportPlan:
    """Return which elements and observations a file adds to ``labels``.

    Observations with the same name, or with the same number and class, are one element. An element
    without a semviz id is the one in ``labels`` with an equal observation, if there is one. Raise
    SemvizError, naming the item, if an element is twice in one image, has two classes, or
    contradicts ``labels``.
    """
    plan, present = ImportPlan(), _contents(labels)
    digest = hashlib.sha256(
        repr([(_content(observation), observation.number) for observation in observations]).encode()
    )
    for key, group in _groups(observations).items():
        with at(group[0].where):
            element_id = _element_id(key, group, present, digest.hexdigest())
        _add(plan, element_id, group, labels)
    return plan


_Key: TypeAlias = tuple[str, object]


def _groups(observations: Sequence[ParsedObservation]) -> dict[_Key, list[ParsedObservation]]:
    """Group the observations by element, in the order of the file."""
    names = {
        (observation.class_id, observation.number): observation.name
        for observation in observations
        if observation.name is not None
    }
    groups: dict[_Key, list[ParsedObservation]] = {}
    for observation in observations:
        number = (observation.class_id, observation.number)
        name = observation.name
        if name is None and observation.number is not None:
            name = names.get(number)  # drawn later, and given only the number of a named one
        key: _Key = ("alone", _content(observation))
        if name is not None:
            key = ("name", name)
        elif observation.number is not None:
            key = ("number", number)
        groups.setdefault(key, []).append(observation)
    return groups


def _content(observation: ParsedObservation) -> _Content:
    return (
        observation.frame_index,
        observation.side,
        observation.class_id,
        observation.anchor_px,
        observation.end_px,
    )


def _contents(labels: Labels) -> dict[_Content, str]:
    return {
        (row.frame_index, row.side, labels.element(row.element_id).class_id, row.anchor_px,
         row.end_px): row.element_id
        for row in labels.observations.values()
    }  # fmt: skip


def _element_id(
    key: _Key, group: Sequence[ParsedObservation], present: Mapping[_Content, str], digest: str
) -> str:
    kind, value = key
    if kind == "name" and rows.is_id(str(value)):
        return str(value)
    present_ids = {present[content] for content in map(_content, group) if content in present}
    if len(present_ids) > 1:
        raise SemvizError("one element here, but several in the workspace; link them there first")
    if present_ids:
        return present_ids.pop()
    if kind == "number":  # says nothing outside of this file
        return rows.derived_id(f"{digest} {value!r}")
    return rows.derived_id(f"{kind} {group[0].class_id} {value!r}")


def _add(
    plan: ImportPlan, element_id: str, group: Sequence[ParsedObservation], labels: Labels
) -> None:
    element = labels.elements.get(element_id)
    if element is None:
        ours = (
            observation.number for observation in group if observation.name == element_id
        )  # of others: no meaning
        element = rows.LabelElement(element_id, next(ours, None) or 0, group[0].class_id)
        plan.elements.append(element)
    by_image: dict[tuple[int, Side], ParsedObservation] = {}
    for observation in group:
        with at(observation.where):
            if observation.class_id != element.class_id:
                raise SemvizError(f"element {_name(observation)} is of another class elsewhere")
            twin = by_image.setdefault((observation.frame_index, observation.side), observation)
            if twin is observation:
                _add_observation(plan, element, observation, labels)
            elif _content(twin) == _content(observation):
                plan.repeated += 1
            else:
                raise SemvizError(f"element {_name(observation)} is twice in this image")


def _name(observation: ParsedObservation) -> str:
    return quoted(observation.name if observation.name is not None else observation.number)


def _add_observation(
    plan: ImportPlan, element: rows.LabelElement, parsed: ParsedObservation, labels: Labels
) -> None:
    row = rows.Observation(
        id=rows.proposal_id(element.id, parsed.frame_index, parsed.side),
        element_id=element.id,
        frame_index=parsed.frame_index,
        side=parsed.side,
        anchor_px=parsed.anchor_px,
        end_px=parsed.end_px,
        anchor_known=parsed.anchor_known,
        end_known=parsed.end_known and parsed.end_px is not None,
    )
    existing = labels.find(element.id, parsed.frame_index, parsed.side)
    if existing is None and row.id in labels.observations:
        raise SemvizError("its label was given to another element since; delete that one first")
    if existing is None:
        plan.observations.append(row)
    elif replace(existing, id=row.id) == row:
        plan.already += 1
    else:
        raise SemvizError(
            f"element {element.number} is labelled differently in this {parsed.side} image of "
            f"frame {parsed.frame_index}; delete that label first, or import into a new workspace"
        )
    if parsed.kept:
        plan.kept[row.id if existing is None else existing.id] = parsed.kept


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
        raise SemvizError("neither CVAT, labelme nor COCO; say which with --format")


def _json_format(path: Path) -> ForeignFormat:
    document = reading.read_json(reading.read_bytes(path, reading.MOST_JSON_BYTES))
    if "annotations" in document and "images" in document:
        return "coco"
    if "shapes" in document:
        return "labelme"
    raise SemvizError("JSON, but neither labelme's nor COCO's; say which with --format")


def _commit(
    path: Path, format_: ForeignFormat, parsed: reading.ParsedLabels, store: LabelStore, author: str
) -> ImportReport:
    plan = plan_import(parsed.observations, store.labels)
    if plan.repeated:
        parsed.drop("labels that the file has twice", plan.repeated)
    if plan.observations:
        kept = writing.Sidecar.made(parsed.kept_images, plan.kept)
        writing.save_sidecar(kept, store.path.parent / KEPT)  # first: unused if the import fails
        with reading.at(path):
            store.apply(ImportLabels(tuple(plan.elements), tuple(plan.observations)), author)
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
    rig = store.rules.rig
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
