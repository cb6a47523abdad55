"""semviz map localizability"""

import json
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from semviz.commands.parsing import OptionalPath, OptionalText, parse_frames


@dataclass(frozen=True)
class MapLocalizability:
    """Say, from a map alone, how well a camera will know its place along the route, where it will
    be unsure, and which new element would help most."""

    workspace: Positional[Path]
    """The workspace: its camera, and its frames' poses for the route (else the map's own)."""
    map: str = "main"
    """Name of the map."""
    frames: OptionalText = None
    """FIRST:END[:STEP]: along these frames only."""
    plot: OptionalPath = None
    """Draw it along the route into this PNG file as well."""
    json: bool = False
    """Print one JSON object, with every position, instead of a table."""

    def run(self) -> int:
        from semviz.drive import CROP_RADIUS_M, DriveOptions, check_same_frame, chosen_frames
        from semviz.localizability import conditions_of, positions
        from semviz.localizability_report import as_dict, as_text, check_plot_path, draw
        from semviz.progress import tell_of_compiling, track
        from semviz.workspace import Workspace
        from semviz_core.localizability.predict import predict

        if self.plot is not None:
            check_plot_path(self.plot)
        workspace = Workspace.open(self.workspace)
        semantic_map = workspace.read_map(self.map)
        source, seen = workspace.source, workspace.default_observations
        check_same_frame(semantic_map, source)
        frames = chosen_frames(source, parse_frames(self.frames))
        conditions = conditions_of(
            DriveOptions(observations=seen, crop_radius_m=CROP_RADIUS_M[seen])
        )
        tell_of_compiling()
        predicted = predict(
            semantic_map, source.rig.left, positions(frames, semantic_map), conditions, track
        )
        classes = semantic_map.classes
        print(json.dumps(as_dict(predicted, classes)) if self.json else as_text(predicted, classes))
        if self.plot is not None:
            draw(predicted, self.plot)
        return 0
