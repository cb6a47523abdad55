"""semviz labels export, semviz labels import"""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class LabelsExport:
    """Write every label operation of a workspace as a line of JSON."""

    workspace: Positional[Path]
    """The workspace."""
    file: Positional[Path]
    """The .jsonl file to write."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.exchange import export_operations
        from semviz_annotation.store import LabelStore

        workspace = Workspace.open(self.workspace)
        with LabelStore.open(workspace.labels_path, workspace.classes) as store:  # needs no images
            export_operations(store, self.file)
            print(f"{self.file}: {store.last_operation} operations")
        return 0


@dataclass(frozen=True)
class LabelsImport:
    """Fill a workspace without labels from a file of 'semviz labels export'."""

    workspace: Positional[Path]
    """The workspace."""
    file: Positional[Path]
    """The .jsonl file to read."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.exchange import import_operations

        with Workspace.open(self.workspace).open_labels() as store:
            import_operations(self.file, store)
            print(f"{self.workspace}: {store.last_operation} operations")
        return 0
