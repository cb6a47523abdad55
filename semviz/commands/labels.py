"""semviz labels export, semviz labels import, semviz labels propose"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from tyro.conf import Positional, UseAppendAction, arg

from semviz.author import login_name
from semviz.commands.parsing import OptionalText
from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace import Workspace

OptionalSide: TypeAlias = Annotated[
    Literal["left", "right"] | None, arg(metavar="{left,right}", help_behavior_hint="")
]
ExportFormat: TypeAlias = Annotated[
    Literal["log", "cvat", "cvat-video", "labelme", "coco"] | None,
    arg(metavar="{log,cvat,cvat-video,labelme,coco}", help_behavior_hint=""),
]
ImportFormat: TypeAlias = Annotated[
    Literal["log", "cvat", "labelme", "coco"] | None,
    arg(metavar="{log,cvat,labelme,coco}", help_behavior_hint=""),
]
_BY_ENDING: Mapping[str, ExportFormat] = {".xml": "cvat", ".json": "coco"}


@dataclass(frozen=True)
class LabelsExport:
    """Write the labels of a workspace: all operations ever made, or another tool's format."""

    workspace: Positional[Path]
    """The workspace."""
    file: Positional[Path]
    """The file to write; for labelme a new folder."""
    format: ExportFormat = None
    """Unless given, .xml is cvat, .json is coco, and all else the log, one operation a line."""
    side: OptionalSide = None
    """Images of one side only; cvat-video has one, the left unless given."""
    json: bool = False
    """Print one JSON object instead of lines: counts, and what the format cannot hold."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.formats.exporting import export_labels

        workspace = Workspace.open(self.workspace)
        format_ = self.format or _BY_ENDING.get(self.file.suffix.lower())
        if format_ is None or format_ == "log":
            return self._export_log(workspace)
        with workspace.open_labels() as store:
            report = export_labels(store, self.file, format_, self.side)
        print(json.dumps(report.as_dict()) if self.json else report.as_text())
        return 0

    def _export_log(self, workspace: "Workspace") -> int:
        from semviz_annotation.storing.exchange import export_operations
        from semviz_annotation.storing.store import LabelStore

        if self.side is not None:
            raise SemvizError("--side: the log is of both sides")
        with LabelStore.open(workspace.labels_path, workspace.classes) as store:  # needs no images
            export_operations(store, self.file)
            _print_operations(self.file, store.last_operation, self.json)
        return 0


@dataclass(frozen=True)
class LabelsImport:
    """Add labels of another tool to a workspace, or fill a new one from a log of operations."""

    workspace: Positional[Path]
    """The workspace."""
    file: Positional[Path]
    """A file of 'semviz labels export', CVAT 1.1 .xml, COCO keypoints .json, labelme .json, or a
    folder of those."""
    format: ImportFormat = None
    """Unless given, what is in the file tells."""
    side: OptionalSide = None
    """Side of the images whose names do not tell."""
    class_map: UseAppendAction[tuple[str, ...]] = ()
    """NAME=CLASS: what the file calls NAME is CLASS here, or 'ignore'; give it once a name."""
    author: OptionalText = None
    """Name in the history; your login name unless given."""
    json: bool = False
    """Print one JSON object instead of lines: counts, and what was left out."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.formats.importing import import_labels
        from semviz_annotation.formats.reading import parse_class_map

        workspace = Workspace.open(self.workspace)
        class_map = parse_class_map(self.class_map)
        with workspace.open_labels() as store:
            if self.format == "log" or (self.format is None and _is_log(self.file)):
                from semviz_annotation.storing.exchange import import_operations

                if class_map or self.side is not None:
                    raise SemvizError("--side and --class-map are not for a log of operations")
                import_operations(self.file, store)
                _print_operations(self.workspace, store.last_operation, self.json)
                return 0
            report = import_labels(
                self.file,
                store,
                self.author or login_name(),
                self.format,
                frames={frame.index for frame in workspace.source.frames},
                side=self.side,
                class_map=class_map,
            )
        print(json.dumps(report.as_dict()) if self.json else report.as_text())
        return 0


@dataclass(frozen=True)
class LabelsPropose:
    """Take in what a detector proposes; people accept or reject it while they label."""

    workspace: Positional[Path]
    """The workspace."""
    file: Positional[Path]
    """JSON or Parquet of the contract in docs/formats.md."""
    replace: bool = False
    """Forget earlier proposals; otherwise these are added to them."""
    json: bool = False
    """Print one JSON object instead of a line."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.proposals import load_proposals, read_proposals, save_proposals

        workspace = Workspace.open(self.workspace)
        source, path = workspace.source, workspace.proposals_path
        frames = {frame.index for frame in source.frames}
        read = read_proposals(self.file, workspace.classes, source.rig, frames)
        before = load_proposals(path, workspace.classes)
        all_of_them = read if self.replace else before.joined(read)
        save_proposals(all_of_them, path, workspace.classes)
        if self.json:
            print(json.dumps({"path": str(path), "read": len(read), "kept": len(all_of_them)}))
        else:
            print(f"{path}: {len(read)} proposals read, {len(all_of_them)} in all")
        return 0


def _is_log(path: Path) -> bool:
    """Whether a file is a log of operations, by its ending or by its first bytes."""
    if path.suffix == ".jsonl" or not path.is_file():
        return path.suffix == ".jsonl"
    with path.open("rb") as file:
        return b'"semviz-operations"' in file.readline(1000)


def _print_operations(path: Path, count: int, as_json: bool) -> None:
    text = f"{path}: {count} operations"
    print(json.dumps({"path": str(path), "operations": count}) if as_json else text)
