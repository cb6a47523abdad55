"""How rerun lays a run out."""

from typing import Any

import numpy as np
import rerun.blueprint as rrb

from semviz.recording import layout, plots, scene
from semviz.recording.columns import FRAME
from semviz.recording.run import RunInfo
from semviz_core.arrays import FloatArray
from semviz_core.semantic_map import SemanticMap


def make_blueprint(info: RunInfo, semantic_map: SemanticMap) -> Any:
    """3D beside image and matrix, texts on the right, plots over the frames below."""
    everything = rrb.VisibleTimeRanges(
        timeline=FRAME,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.infinite(),
    )
    paths: dict[Any, Any] = dict.fromkeys((scene.TRUE_PATH, scene.PATH), everything)
    start, behind = _behind(semantic_map.trajectory_m)
    eye = rrb.EyeControls3D(position=behind, look_target=start, tracking_entity=scene.HERE)
    image: Any = rrb.Spatial2DView(name="Image", origin=layout.IMAGE)
    if info.images == "both":
        image = rrb.Tabs(image, rrb.Spatial2DView(name="Right image", origin=layout.IMAGE_RIGHT))
    columns = rrb.TextLogColumns(
        timeline_columns=[rrb.encodings.TimelineColumn(FRAME)],
        text_log_columns=["loglevel", "body"],
    )
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Vertical(
                    rrb.Spatial3DView(
                        name="Map and poses",
                        origin="/map",
                        contents=["$origin/**", f"- {layout.RIGHT_CAMERA}/**"],
                        overrides=paths,
                        eye_controls=eye,
                    ),
                    image,
                    row_shares=[6, 5],
                ),
                rrb.Vertical(
                    rrb.Tabs(
                        rrb.TextDocumentView(name="Why", origin=plots.WHY),
                        rrb.TextDocumentView(name="How to read this", origin=scene.README),
                    ),
                    rrb.Spatial2DView(name="Match probability", origin=scene.MATRIX),
                ),
                column_shares=[5, 2],
            ),
            rrb.Horizontal(
                rrb.Vertical(
                    rrb.Tabs(
                        _error_view("Error, m", plots.OFF_M),
                        _error_view("Error, deg", plots.OFF_DEG),
                    ),
                    rrb.StateTimelineView(
                        name="Status and verdict", contents=[plots.STATUSES, plots.VERDICTS]
                    ),
                    row_shares=[1, 1],
                ),
                rrb.TimeSeriesView(name="Elements", origin=plots.COUNTS),
                rrb.TextLogView(name="Reasons", origin=plots.WHY, columns=columns),
                column_shares=[3, 2, 2],
            ),
            row_shares=[7, 4],
        ),
        rrb.TimePanel(timeline=FRAME, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _error_view(name: str, origin: str) -> Any:
    return rrb.TimeSeriesView(name=name, origin=origin, plot_legend=rrb.PlotLegend(visible=False))


def _behind(road_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the drive starts (3,), and a place (3,) behind and above it."""
    if len(road_m) < 2:
        return np.zeros(3), np.array([-25.0, -8.0, 15.0])
    ahead = road_m[min(len(road_m) - 1, 10)] - road_m[0]
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-9)
    return road_m[0], road_m[0] - 25.0 * ahead + np.array([0.0, 0.0, 15.0])
