"""The command map changes."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional, UseAppendAction

from semviz.commands import parsing
from semviz_core.common.errors import SemvizError

if TYPE_CHECKING:
    from semviz.workspace.maps.map_decisions import ChangeDecisions
    from semviz.workspace.workspace import Workspace
    from semviz_annotation.map_formats.georeference import Georeference
    from semviz_annotation.mapping.passes.changes import MapChanges
    from semviz_annotation.mapping.passes.evidence import Pass
    from semviz_core.base.semantic_map import SemanticMap


@dataclass(frozen=True)
class MapChangesCommand:
    """Tell what changed since a map was made, from runs of several passes: elements that vanished,
    appeared or moved. Nothing is written without --write.

    Examples: 'semviz map changes town may.rrd june.rrd july.rrd --write next --keep P-04';
    'semviz map changes town may.rrd june.rrd --geojson changes.geojson'."""

    workspace: Positional[Path]
    """Folder of the workspace with the map."""
    runs: Positional[tuple[Path, ...]]
    """Runs of two or more passes, localized in the map, oldest first; with dates, in any order."""
    map: str = "main"
    """Name of the map."""
    write: parsing.OptionalText = None
    """Also write the changed map, under this name in the workspace. Decisions of 'semviz serve'
    apply; what is open and sure is changed."""
    keep: UseAppendAction[tuple[str, ...]] = ()
    """With --write: a change that is not to be made, by its name; one option for each. Stored as a
    decision."""
    replace: bool = False
    """Replace an existing map of this name."""
    geojson: parsing.OptionalPath = None
    """Also write the changes and the decisions on them to this file, for QGIS and other tools."""
    anchor: parsing.OptionalText = None
    """LATITUDE,LONGITUDE[,HEIGHT] of the map's origin (WGS84), for --geojson; default: that of the
    map or the workspace."""
    anchor_heading: parsing.OptionalFloat = None
    """Compass direction of the map's x axis at the anchor, in degrees; default: 90 (east)."""
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of text."""

    def run(self) -> int:
        from semviz.presentation.terminal import Steps, announce_compiling
        from semviz.workspace.maps.map_decisions import decisions_path, read_decisions
        from semviz_annotation.mapping.passes.changed_map import changed_map
        from semviz_annotation.mapping.passes.changes import find_changes
        from semviz_core.base.map_file import save_map

        if self.keep and self.write is None:
            raise SemvizError("--keep is for --write; add that, or leave it out")
        workspace = parsing.open_workspace(self.workspace)
        semantic_map, path = workspace.read_map(self.map), None
        place = self._place(semantic_map)
        if self.write is not None:
            path = parsing.path_of_new_map(workspace, self.write, replace=self.replace)
        announce_compiling("the search for tracks")
        with Steps() as steps:
            passes = _passes(self.runs, semantic_map)
            found = find_changes(passes, semantic_map, workspace.read_labels(), steps.show)
        decisions = read_decisions(decisions_path(workspace))
        changed = None
        if path is not None:
            decisions = self._decide(workspace, found, decisions)
            changed = changed_map(found, decisions.made(found))
            save_map(changed, path)
        if self.geojson is not None and place is not None:
            _write_geojson(found, self.geojson, place, passes, decisions)
        if self.json:
            print(
                json.dumps(decisions.as_dict(found) | ({} if path is None else {"map": str(path)}))
            )
            return 0
        print(found.as_text())
        for line in _decision_lines(found, decisions):
            print(line)
        if changed is not None:
            print(f"{path}: {len(changed)} elements")
        if self.geojson is not None:
            print(f"{self.geojson}: {len(found.changes)} changes")
        return 0

    def _place(self, semantic_map: "SemanticMap") -> "Georeference | None":
        """Return where the map is on Earth; None if no GeoJSON is wanted.

        Raise SemvizError if that is not known, or the file is not to be written.
        """
        from semviz.workspace.outputs import check_outputs, contains
        from semviz_annotation.map_formats.geojson import NEEDS_PLACE
        from semviz_annotation.map_formats.georeference import Georeference, require_georeference

        anchor = parsing.parse_anchor(self.anchor, self.anchor_heading)
        if self.geojson is None:
            if anchor is not None:
                raise SemvizError("--anchor is for --geojson; add that, or leave it out")
            return None
        ours = contains(b'{"type": "FeatureCollection", "semviz": {', b'"map_digest"')
        check_outputs(self.geojson, ours, force=self.force, reads=[self.workspace, *self.runs])
        return require_georeference(anchor or Georeference.of(semantic_map.frame), NEEDS_PLACE)

    def _decide(
        self, workspace: "Workspace", found: "MapChanges", before: "ChangeDecisions"
    ) -> "ChangeDecisions":
        """Store what is kept, and that what is open and sure is changed."""
        from semviz.workspace.maps.map_decisions import Answer, decide_in
        from semviz.workspace.settings import login_name

        digest = found.semantic_map.digest
        answers: dict[str, Answer] = {
            change.name: "make"
            for change in found.changes
            if change.name in found.sure and before.on(change, digest) is None
        }
        answers |= dict.fromkeys(self.keep, "keep")
        rows = [(name, answer, None) for name, answer in answers.items()]
        return decide_in(workspace, found, rows, login_name())


def _write_geojson(
    found: "MapChanges",
    path: Path,
    place: "Georeference",
    passes: "Iterable[Pass]",
    decisions: "ChangeDecisions",
) -> None:
    from semviz.workspace.maps.passes import date_of
    from semviz_annotation.map_formats.changes_geojson import write_changes

    decided = {
        change.name: {"answer": on.answer, "decided_by": on.author, "decided": on.time}
        for change in found.changes
        if (on := decisions.on(change, found.semantic_map.digest)) is not None
    }
    write_changes(found, path, place, {one.name: date_of(one) for one in passes}, decided)


def _passes(paths: Iterable[Path], semantic_map: "SemanticMap") -> "list[Pass]":
    from semviz.runs.stored_run import from_sound_frames
    from semviz.workspace.maps.passes import check_drive, in_time, pass_of

    passes = [
        from_sound_frames(path, partial(pass_of, path.stem, frame=semantic_map.frame))
        for path in paths
    ]
    drives: dict[bytes, str] = {}
    for one in passes:
        check_drive(one, drives)
    return in_time(passes)


def _decision_lines(found: "MapChanges", decisions: "ChangeDecisions") -> Iterator[str]:
    from semviz.workspace.maps.map_decisions import answer_word

    for change in found.changes:
        decision = decisions.on(change, found.semantic_map.digest)
        if decision is not None:
            word = answer_word(change.kind, decision.answer)
            yield f"decided: {change.name} {word}, by {decision.author} on {decision.time[:10]}"
