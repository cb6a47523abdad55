"""semviz trajectory"""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

from semviz_core.errors import SemvizError

if TYPE_CHECKING:
    from semviz.recording.run import Run
    from semviz_annotation.map_formats.tally import Tally
    from semviz_core.frame import Frame


@dataclass(frozen=True)
class Trajectory:
    """Write the poses of a run, or of a workspace, in a format that evo reads."""

    source: Positional[Path]
    """A run (.rrd), whose estimates are written, or a workspace, whose true poses are."""
    file: Positional[Path]
    """The file to write."""
    format: Literal["tum", "kitti"] = "tum"
    """tum: time and pose, in the map frame, z up; kitti: one pose a frame, in KITTI's axes."""
    truth: bool = False
    """The true poses of a run in place of the estimates."""
    json: bool = False
    """Print one JSON object instead of lines: counts, what was dropped, what was assumed."""

    def run(self) -> int:
        from semviz_annotation.map_formats.tally import ExchangeReport, Tally
        from semviz_core.sources.trajectory import save_trajectory

        tally = Tally()
        frames = self._frames(tally)
        save_trajectory(frames, self.file, self.format)
        _note(frames, self.format, tally)
        posed = sum(one.T_map_camera is not None for one in frames)
        report = ExchangeReport.of(self.file, self.format, {"poses": posed}, tally)
        print(json.dumps(report.as_dict()) if self.json else report.as_text())
        return 0

    def _frames(self, tally: "Tally") -> "Sequence[Frame]":
        """The frames, with the poses that are to be written."""
        if self.source.suffix != ".rrd":
            from semviz.workspace import Workspace

            if self.truth:
                raise SemvizError("--truth is for runs; the poses of a workspace are the true ones")
            return Workspace.open(self.source).source.frames
        from semviz.recording.reader import load_run

        run = load_run(self.source)
        return [one.frame for one in run.frames] if self.truth else _estimates(run, tally)


def _estimates(run: "Run", tally: "Tally") -> "list[Frame]":
    """The frames of a run with the poses that it found."""
    estimates = [one.T_camera_map for one in run.localizations]
    statuses = Counter(one.status for one in run.localizations)
    tally.drop("covariances", sum(one is not None for one in estimates))
    tally.drop("the word 'ambiguous': such poses are written like others", statuses["ambiguous"])
    return [
        replace(one.frame, T_map_camera=None if pose is None else pose.inverse())
        for one, pose in zip(run.frames, estimates, strict=True)
    ]


def _note(frames: "Sequence[Frame]", format_: str, tally: "Tally") -> None:
    without = [str(one.index) for one in frames if one.T_map_camera is None]
    more = ", ..." if len(without) > 10 else ""
    tally.drop(f"frames without a pose: {', '.join(without[:10])}{more}", len(without))
    if format_ == "kitti":
        tally.drop("times", len(frames))
        if [one.index for one in frames] != list(range(len(frames))):
            tally.drop("frame numbers: line n is the n-th frame, not frame n", len(frames))
