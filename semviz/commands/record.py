"""The command record."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from semviz.commands import parsing
from semviz.commands.localize import print_run
from semviz.commands.parsing import MeasurementOptions
from semviz_core.common.errors import SemvizError


@dataclass(frozen=True)
class RecordCommand:
    """Record what another localizer returned as a run, from files of poses and matches.

    The run has diagnosis, inspector, comparison and report like any other. Example: 'semviz record
    town --poses hloc.tum --matches matches.csv --out town/runs/hloc.rrd'."""

    workspace: Positional[Path]
    """Folder of the workspace with the images."""
    poses: Path
    """Estimated poses: TUM, KITTI, a COLMAP model, or a table, as for 'semviz localize --priors'.
    Frames without a pose are recorded as such."""
    out: Path
    """Run to write, for example town/runs/hloc.rrd."""
    matches: parsing.OptionalPath = None
    """Observed elements and the map elements that they were matched with (CSV or JSON): frame,
    u_px, v_px, end_u_px, end_v_px, class, element, score, sigma_px."""
    method: parsing.OptionalText = None
    """Name of the method; default: that of the file."""
    map: str = "main"
    """Name of the map that matches and poses are in."""
    frames: parsing.OptionalText = None
    """FIRST:END[:STEP], END excluded; default: all frames."""
    images: Literal["embedded", "none"] = "embedded"
    """embedded: the left images in the run; none."""
    measurements: MeasurementOptions = field(default_factory=MeasurementOptions)
    force: parsing.Force = False
    json: bool = False
    """Print one JSON object instead of lines: the run's file, and frames by status."""

    def run(self) -> int:
        from semviz.runs.recorder import RunRecorder
        from semviz.workspace import outputs
        from semviz.workspace.chosen_frames import select_frames
        from semviz.workspace.localization import foreign_results
        from semviz_core.datasets.measured_poses import read_poses_or_table

        workspace, given = parsing.open_workspace(self.workspace), self.measurements
        given.check_used()
        if given.odometry is not None:
            raise SemvizError("--odometry is for tracking; a recorded run has its own poses")
        reads = [self.workspace, self.poses, *given.reads]
        reads += [] if self.matches is None else [self.matches]
        outputs.check_outputs(self.out, outputs.RUN, force=self.force, reads=reads, purpose="run")
        semantic_map = workspace.read_map(self.map)
        files = given.files(None)
        measured = files.read(workspace, semantic_map)
        matches = {}
        if self.matches is not None:
            matches = foreign_results.read_matches(self.matches, semantic_map)
        foreign_results.check_results(workspace, semantic_map, matches)
        frames = select_frames(workspace.source, parsing.parse_frames(self.frames))
        poses = foreign_results.poses_of_frames(
            read_poses_or_table(self.poses, files.around(workspace, semantic_map)), frames
        )
        for note in measured.notes(frames):
            print(note, file=sys.stderr)
        recorder = RunRecorder(
            self.out,
            semantic_map,
            workspace.source.rig,
            self.method or self.out.stem,
            workspace=self.workspace,
            map_name=self.map,
            options={"poses": str(self.poses), "matches": str(self.matches or "")},
            images=self.images == "embedded",
        )
        with recorder:
            foreign_results.record_results(
                recorder, workspace.source, frames, poses, matches, measured
            )
        print_run(self.out, recorder.statuses, self.json)
        return 0
