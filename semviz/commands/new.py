"""semviz new"""

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import (
    OptionalInt,
    OptionalPath,
    OptionalText,
    parse_cameras,
    parse_frames,
)
from semviz_core.errors import SemvizError


@dataclass(frozen=True)
class New:
    """Make a workspace from a KITTI odometry folder or a simulated street."""

    folder: Positional[Path]
    """The folder to make."""
    kitti: OptionalPath = None
    """Root of a KITTI odometry dataset: holds sequences/ and poses/."""
    sequence: str = "02"
    """Sequence of the KITTI dataset."""
    cameras: str = "2,3"
    """Left and right camera, or one alone: 2,3 are the colour pair, 0,1 the grey one."""
    simulate: OptionalInt = None
    """Seed of a simulated street, in place of --kitti."""
    frames: OptionalText = None
    """FIRST:END[:STEP], end excluded; all frames (KITTI) or 60 (street) if not given."""
    poses: OptionalPath = None
    """File of poses in place of KITTI's own, such as a SLAM wrote: TUM's or KITTI's format, poses
    of the left camera."""
    trust_poses: bool = False
    """Take poses that jump, or lead backwards all the way, for what they are."""

    def run(self) -> int:
        from semviz.workspace import Workspace

        frames = parse_frames(self.frames)
        if (self.kitti is None) == (self.simulate is None):
            raise SemvizError("say where frames come from: --kitti ROOT or --simulate SEED")
        if self.kitti is not None:
            cameras = parse_cameras(self.cameras)
            made = Workspace.create_kitti(
                self.folder,
                self.kitti,
                self.sequence,
                cameras,
                frames,
                self.trust_poses,
                self.poses,
            )
        else:
            assert self.simulate is not None
            if self.poses is not None:
                raise SemvizError("--poses: a simulated street has its own; say --kitti ROOT")
            made = Workspace.create_street(self.folder, self.simulate, frames)
        print(f"{made.path}: {len(made.source.frames)} frames, {made.source.map_frame.name}")
        print(f"next: semviz annotate {self.folder}")
        return 0
