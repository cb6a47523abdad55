"""Choose the frames of a sequence that a command works on, and check a map against them."""

from semviz_core.base.frame import Dataset, Frame
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.rig_cameras import frames_of_camera


def check_map_frame(semantic_map: SemanticMap, source: Dataset) -> None:
    """Raise SemvizError if a map and the poses of a sequence are in different map frames."""
    map_frame, sequence_frame = semantic_map.frame.name, source.map_frame.name
    if map_frame != sequence_frame:
        raise SemvizError(
            f"the map is in frame '{map_frame}', the sequence in '{sequence_frame}': "
            "build a map from this sequence, or choose another with --map"
        )


def select_frames(
    source: Dataset, numbers: range | None, camera: str | None = None
) -> tuple[Frame, ...]:
    """Return the frames with these numbers (None: all), of one camera if the source is a rig.

    ``camera`` None takes that of the first of these frames. Raise SemvizError if there are none.
    """
    selected = [frame for frame in source.frames if numbers is None or frame.index in numbers]
    frames = frames_of_camera(source, camera, selected)
    if not frames:
        raise SemvizError("--frames: the sequence has none of these frames")
    return frames


def posed_frames(frames: tuple[Frame, ...]) -> tuple[Frame, ...]:
    """Return the frames with a pose: the prior is simulated from it, and the error measured by it.

    Raise SemvizError if there are none.
    """
    posed = tuple(frame for frame in frames if frame.T_map_camera is not None)
    if not posed:
        raise SemvizError(
            "none of the frames has a pose, so no prior can be simulated; make the workspace "
            "again with --poses"
        )
    return posed
