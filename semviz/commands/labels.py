"""The commands labels export, import, propose, check, backup and restore."""

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from tyro.conf import Positional, UseAppendAction, arg

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.workspace import Workspace

OptionalSide: TypeAlias = Annotated[
    Literal["left", "right"] | None, arg(metavar="{left,right}", help_behavior_hint="")
]
ExportFormat: TypeAlias = Annotated[
    Literal["log", "cvat", "cvat-video", "labelme", "coco", "csv"] | None,
    arg(metavar="{log,cvat,cvat-video,labelme,coco,csv}", help_behavior_hint=""),
]
ImportFormat: TypeAlias = Annotated[
    Literal["log", "cvat", "labelme", "coco"] | None,
    arg(metavar="{log,cvat,labelme,coco}", help_behavior_hint=""),
]
Pixels: TypeAlias = Annotated[
    Literal["recorded", "rectified"] | None,
    arg(metavar="{recorded,rectified}", help_behavior_hint=""),
]
_CVAT = (b"<annotations>\n  <version>1.1</version>\n  <meta>\n    <task>\n      <name>",)
_MARKS = {
    "log": (b'{"format": "semviz-operations"',),
    "cvat": _CVAT,  # CVAT itself writes the task's id first
    "cvat-video": _CVAT,
    "csv": (b"frame,side,image,element,class,",),
    "coco": (b'{"info": {"description": "poles and traffic signs", "version": "1.0"}',),
}
"""What the start of an export contains, by format."""
_BY_ENDING: Mapping[str, ExportFormat] = {
    ".xml": "cvat",
    ".json": "coco",
    ".csv": "csv",
    ".jsonl": "log",
}


@dataclass(frozen=True)
class LabelsExportCommand:
    """Export the labels of a workspace: the log of all operations, or another tool's format.

    Examples: 'semviz labels export town labels.jsonl'; 'semviz labels export town town.xml'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    file: Positional[Path]
    """File to write; for labelme a new folder."""
    format: ExportFormat = None
    """Default by ending: .xml cvat, .json coco, .csv a table that also has the pixels of the
    recorded images, .jsonl the log with one operation per line."""
    side: OptionalSide = None
    """Images of one side only; default for cvat-video: left."""
    start_frame: parsing.OptionalInt = None
    """cvat-video: number of the workspace's first image in the CVAT task, the others follow one by
    one; default: frame numbers of the workspace, for a task of the whole sequence."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of lines: counts, and losses of the format."""

    def run(self) -> int:
        from semviz_annotation.label_formats.exchange import export_labels
        from semviz_annotation.label_formats.writing import original_pixels

        workspace = parsing.open_workspace(self.workspace)
        format_ = self.format or _BY_ENDING.get(self.file.suffix.lower())
        if format_ is None:
            raise SemvizError(
                f"{self.file}: no format has this ending; take {', '.join(_BY_ENDING)}, or say "
                "which with --format"
            )
        self._check_file(format_)
        if format_ == "log":
            return self._export_log(workspace)
        source = workspace.source
        frames = {frame.index for frame in source.frames}
        with workspace.open_labels() as store:
            original = original_pixels(source) if format_ == "csv" else None
            report = export_labels(
                store, self.file, format_, self.side, original, frames, self.start_frame
            )
        print(json.dumps(report.as_dict()) if self.json else report.as_text())
        return 0

    def _check_file(self, format_: str) -> None:
        from semviz.workspace import outputs

        if self.start_frame is not None and format_ != "cvat-video":
            raise SemvizError("--start-frame is for --format cvat-video; leave it out")
        if self.start_frame is not None and not 0 <= self.start_frame < 2**30:
            raise SemvizError(f"--start-frame {self.start_frame}: give 0 or more")
        if format_ == "labelme":
            outputs.check_new_folder(self.file, [self.workspace])
            return
        ours = outputs.contains(*_MARKS[format_])
        outputs.check_outputs(self.file, ours, force=self.force, reads=[self.workspace])

    def _export_log(self, workspace: "Workspace") -> int:
        from semviz_annotation.storage.backup import export_operations
        from semviz_annotation.storage.store import LabelStore

        if self.side is not None:
            raise SemvizError("--side: the log holds both sides; leave the option out")
        with LabelStore.open(workspace.labels_path) as store:  # needs no images
            export_operations(store, self.file)
            _print_operations(self.file, store.last_operation, self.json)
        return 0


@dataclass(frozen=True)
class LabelsImportCommand:
    """Import labels of another tool, or fill a new workspace from a log of operations.

    Example: 'semviz labels import town theirs.json --class-map lamp=pole --class-map "*=ignore"'.
    """

    workspace: Positional[Path]
    """Folder of the workspace."""
    file: Positional[Path]
    """Export of 'semviz labels export', CVAT 1.1 .xml, COCO keypoints .json, labelme .json, or a
    folder of these."""
    format: ImportFormat = None
    """Default: detected from the content."""
    side: OptionalSide = None
    """Side of images whose names do not tell it."""
    class_map: UseAppendAction[tuple[str, ...]] = ()
    """NAME=CLASS: class for a name in the file, or 'ignore'; one option per name. The NAME '*' is
    all others."""
    pixels: Pixels = None
    """Images that were drawn in, for drives of your own: as recorded, or rectified by semviz.
    Default: recorded if the file has their names, rectified for names such as left/000012.png."""
    author: parsing.OptionalText = None
    """Author in the history; default: your login name."""
    json: bool = False
    """Print one JSON object instead of lines: counts and dropped items."""

    def run(self) -> int:
        from semviz.workspace.settings import login_name
        from semviz.workspace.workspace import Workspace
        from semviz_annotation.label_formats.exchange import import_labels
        from semviz_annotation.label_formats.import_context import NamedImages
        from semviz_annotation.label_formats.reading import parse_class_map

        workspace = Workspace.open(self.workspace)
        class_map = parse_class_map(self.class_map)
        frames = {frame.index for frame in workspace.source.frames}
        with workspace.open_labels() as store:
            if self.format == "log" or (self.format is None and _is_log(self.file)):
                from semviz_annotation.storage.backup import import_operations, tells_its_length

                if class_map or self.side is not None or self.pixels is not None:
                    raise SemvizError(
                        "--side, --class-map and --pixels do not apply to a log of operations; "
                        "leave them out"
                    )
                import_operations(self.file, store, frames)
                note = "" if tells_its_length(self.file) else UNCHECKED
                _print_operations(self.workspace, store.last_operation, self.json, note)
                return 0
            report = import_labels(
                self.file,
                store,
                self.author or login_name(),
                self.format,
                frames=frames,
                side=self.side,
                class_map=class_map,
                recorded=NamedImages.of(workspace.source),
                pixels=self.pixels,
            )
        print(json.dumps(report.as_dict()) if self.json else report.as_text())
        return 0


@dataclass(frozen=True)
class LabelsProposeCommand:
    """Import detections as proposals, to accept or reject while labelling.

    Example: 'semviz labels propose town detections.parquet'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    file: Positional[Path]
    """JSON or Parquet in the format of docs/formats.md."""
    replace: bool = False
    """Discard earlier proposals; default: add to them."""
    json: bool = False
    """Print one JSON object instead of a line."""

    def run(self) -> int:
        from semviz.workspace.outputs import PARQUET, check_outputs
        from semviz_annotation.labels import proposals

        workspace = parsing.open_workspace(self.workspace)
        source, path = workspace.source, workspace.proposals_path
        check_outputs(path, PARQUET, can_force=False, reads=[self.file], purpose="proposals")
        frames = {frame.index for frame in source.frames}
        imported = proposals.read_proposals(self.file, workspace.classes, source.rig, frames)
        earlier = proposals.load_proposals(path, workspace.classes)
        kept = imported if self.replace else earlier.joined(imported)
        has_labels = workspace.labels_path.exists()
        center = workspace.read_labels().triangle_center if has_labels else kept.triangle_center
        kept.following(center)  # raises if it cannot be done
        proposals.save_proposals(kept, path, workspace.classes)
        if self.json:
            print(json.dumps({"path": str(path), "read": len(imported), "kept": len(kept)}))
        else:
            print(f"{path}: {len(imported)} proposals read, {len(kept)} in total")
        return 0


def _is_log(path: Path) -> bool:
    """Whether a file is a log of operations, by its ending or its first line."""
    if path.suffix == ".jsonl" or not path.is_file():
        return path.suffix == ".jsonl"
    with path.open("rb") as file:
        return b'"semviz-operations"' in file.readline(1000)


UNCHECKED = "the log does not tell its length: whether it is complete was not checked"


def _print_operations(path: Path, count: int, as_json: bool, note: str = "") -> None:
    text = f"{path}: {count} operations" + (f"; {note}" if note else "")
    print(json.dumps({"path": str(path), "operations": count}) if as_json else text)
    if as_json and note:
        print(note, file=sys.stderr)


@dataclass(frozen=True)
class LabelsCheckCommand:
    """Check that no label was lost or altered: the log is complete, and the labels follow from it.

    Otherwise, exit with status 2 and name the operation at which the log breaks.

    Example: 'semviz labels check town'."""

    workspace: Positional[Path]
    """Workspace; others may use it meanwhile."""
    json: bool = False
    """Print one JSON object instead of a line."""

    def run(self) -> int:
        from semviz_annotation.storage.backup import check_labels

        path = parsing.open_workspace(self.workspace).labels_path
        state = check_labels(path)
        if self.json:
            print(json.dumps(asdict(state)))
        else:
            print(
                f"{path}: sound; {state.operations} operations, {state.elements} elements, "
                f"{state.observations} observations; hash {state.hash or 'none'}"
            )
        return 0


@dataclass(frozen=True)
class LabelsBackupCommand:
    """Copy all labels and their history into one file, even while others label.

    Example: 'semviz labels backup town labels.db'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    file: Positional[Path]
    """File to write (.db); it may replace only an earlier backup of the same labels."""
    json: parsing.Json = False

    def run(self) -> int:
        from semviz.workspace.outputs import DATABASE, check_outputs
        from semviz_annotation.storage.backup import backup_labels

        check_outputs(self.file, DATABASE, can_force=False, reads=[self.workspace])
        state = backup_labels(parsing.open_workspace(self.workspace).labels_path, self.file)
        if self.json:
            print(json.dumps({"path": str(self.file), "operations": state.operations}))
        else:
            print(f"{self.file}: {state.operations} operations, checked")
        return 0


@dataclass(frozen=True)
class LabelsRestoreCommand:
    """Restore the labels of a backup, even while others label; keep the replaced file beside it.

    Example: 'semviz labels restore town labels.db'."""

    workspace: Positional[Path]
    """Folder of the workspace."""
    file: Positional[Path]
    """Backup made by 'semviz labels backup'."""
    json: parsing.Json = False

    def run(self) -> int:
        from semviz_annotation.storage.backup import restore_labels

        path = parsing.open_workspace(self.workspace).labels_path
        state, replaced = restore_labels(path, self.file)
        kept = "" if replaced is None else f"; the replaced file is kept as {replaced}"
        if self.json:
            said = {"path": str(path), "operations": state.operations}
            print(json.dumps(said | {"kept": None if replaced is None else str(replaced)}))
        else:
            print(f"{path}: {state.operations} operations{kept}")
        return 0
