"""semviz map localizability"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from semviz.commands.parsing import OptionalPath, OptionalText, parse_frames

if TYPE_CHECKING:
    from collections.abc import Sequence

    from semviz.workspace import Workspace
    from semviz_core.frame import Frame
    from semviz_core.localizability.conditions import Conditions
    from semviz_core.semantic_map import SemanticMap


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
        from semviz.drive import check_same_frame, chosen_frames
        from semviz.localizability import positions
        from semviz.localizability_report import as_dict, as_text, check_plot_path, draw
        from semviz.progress import tell_of_compiling, track
        from semviz.workspace import Workspace
        from semviz_core.localizability.predict import predict

        if self.plot is not None:
            check_plot_path(self.plot)
        workspace = Workspace.open(self.workspace)
        semantic_map, source = workspace.read_map(self.map), workspace.source
        check_same_frame(semantic_map, source)
        frames = chosen_frames(source, parse_frames(self.frames))
        conditions = _conditions(workspace, semantic_map, frames)
        tell_of_compiling()
        predicted = predict(
            semantic_map, source.rig.left, positions(frames, semantic_map), conditions, track
        )
        told = predicted, semantic_map.classes, conditions.detector
        print(json.dumps(as_dict(*told)) if self.json else as_text(*told))
        if self.plot is not None:
            draw(predicted, self.plot)
        return 0


def _conditions(
    workspace: "Workspace", semantic_map: "SemanticMap", frames: "Sequence[Frame]"
) -> "Conditions":
    """As ``semviz localize`` has them; labels tell how much of the map is seen."""
    from semviz.drive import CROP_RADIUS_M, DriveOptions
    from semviz.localizability import conditions_of, with_measured_recall
    from semviz.observing import observe_labels

    kind = workspace.default_observations
    stated = conditions_of(DriveOptions(observations=kind, crop_radius_m=CROP_RADIUS_M[kind]))
    if kind != "labels":
        return stated
    observe = observe_labels(workspace, semantic_map)
    seen = [(one.T_map_camera, observe(one)[1]) for one in frames if one.T_map_camera is not None]
    return with_measured_recall(stated, semantic_map, workspace.source.rig.left, seen)
