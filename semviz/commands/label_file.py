"""semviz labels check, semviz labels backup, semviz labels restore"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from tyro.conf import Positional


@dataclass(frozen=True)
class LabelsCheck:
    """Check that no label was lost or altered: the log is whole, and the labels follow from it.

    Exit status 2 where not; the line names the operation where it breaks.
    """

    workspace: Positional[Path]
    """The workspace; others may use it meanwhile."""
    json: bool = False
    """Print one JSON object instead of a line."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.storing.integrity import check_labels

        path = Workspace.open(self.workspace).labels_path
        found = check_labels(path)
        if self.json:
            print(json.dumps(asdict(found)))
        else:
            print(
                f"{path}: sound; {found.operations} operations, {found.elements} elements, "
                f"{found.observations} observations; hash {found.hash or 'none'}"
            )
        return 0


@dataclass(frozen=True)
class LabelsBackup:
    """Copy all labels with their history into one file, also while others label."""

    workspace: Positional[Path]
    """The workspace."""
    file: Positional[Path]
    """The .db file to write; only an earlier backup of the same labels is replaced."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.storing.backup import backup_labels

        found = backup_labels(Workspace.open(self.workspace).labels_path, self.file)
        print(f"{self.file}: {found.operations} operations, checked")
        return 0


@dataclass(frozen=True)
class LabelsRestore:
    """Bring back the labels of a backup, also while others label; today's are kept beside them."""

    workspace: Positional[Path]
    """The workspace."""
    file: Positional[Path]
    """A file of 'semviz labels backup'."""

    def run(self) -> int:
        from semviz.workspace import Workspace
        from semviz_annotation.storing.backup import restore_labels

        path = Workspace.open(self.workspace).labels_path
        found, aside = restore_labels(path, self.file)
        kept = "" if aside is None else f"; what was there is kept in {aside}"
        print(f"{path}: {found.operations} operations{kept}")
        return 0
