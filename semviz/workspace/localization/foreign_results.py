"""Record what another localizer returned, from a file of poses and one of matches."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semviz.presentation.terminal import track
from semviz.runs.recorder import MatchedPose, RunRecorder
from semviz.workspace.chosen_frames import check_map_frame
from semviz.workspace.localization.measurements import Measurements
from semviz.workspace.workspace import Workspace
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Dataset, Frame
from semviz_core.base.pose import Pose
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.limits import parsed_json, shown, table_rows
from semviz_core.datasets.measured_poses import MeasuredPoses
from semviz_core.datasets.own_drive.recording import poses_at_times
from semviz_core.datasets.trajectory import read_text

_NUMBERS = ("u_px", "v_px", "end_u_px", "end_v_px", "sigma_px", "score")
_COLUMNS = ("frame", *_NUMBERS, "class", "element")


@dataclass
class FrameMatches:
    """The observed elements of a frame, and the map elements that they were matched with."""

    anchor_px: list[list[float]] = field(default_factory=list)
    end_px: list[list[float]] = field(default_factory=list)
    class_id: list[int] = field(default_factory=list)
    sigma_px: list[float] = field(default_factory=list)
    matches: list[tuple[int, int]] = field(default_factory=list)
    score: list[float] = field(default_factory=list)

    def elements(self) -> Elements2D:
        """Return the m observed elements."""
        m = len(self.class_id)
        end_px = np.reshape(self.end_px, (m, 2))
        return Elements2D(
            np.reshape(self.anchor_px, (m, 2)),
            end_px,
            np.array(self.class_id, dtype=np.int64),
            np.ones(m),
            np.repeat(np.reshape(self.sigma_px, (m, 1)), 2, axis=1),
            np.ones(m, dtype=bool),
            np.asarray(np.isfinite(end_px).all(axis=1)),
        )

    def matched_pose(self, T_camera_map: Pose | None, **known: Any) -> MatchedPose:
        """Return them with a pose; matches go by score, best first."""
        best_first = np.argsort(-np.array(self.score), kind="stable")
        matches = np.array(self.matches, dtype=np.int64).reshape(-1, 2)
        return MatchedPose(
            self.elements(),
            T_camera_map,
            matches[best_first],
            np.array(self.score)[best_first],
            **known,
        )


def read_matches(path: Path, semantic_map: SemanticMap) -> dict[int, FrameMatches]:
    """Return the observed elements by frame, from a CSV table or a JSON list of objects.

    A row is an observed element: ``frame``, ``u_px``, ``v_px``; of a pole also ``end_u_px`` and
    ``end_v_px``. ``element`` is the id of its map element, empty without one; ``class`` a name or
    number, by default that of the element. Raise SemvizError with the wrong row.
    """
    frames: dict[int, FrameMatches] = {}
    row_of = {int(id_): row for row, id_ in enumerate(semantic_map.elements.id)}
    for number, row in enumerate(_rows(path), 1):
        where = f"{path}, row {number}"
        frame = _whole(row, "frame", where)
        element = None if row.get("element") in (None, "") else _whole(row, "element", where)
        if element is not None and element not in row_of:
            raise SemvizError(f"{where}: the map has no element {element}")
        into = frames.setdefault(frame, FrameMatches())
        mapped = None if element is None else row_of[element]
        into.class_id.append(_class(row, semantic_map, mapped, where))
        into.anchor_px.append([_number(row, name, where) for name in ("u_px", "v_px")])
        ends = [_optional(row, name, where) for name in ("end_u_px", "end_v_px")]
        into.end_px.append([np.nan if end is None else end for end in ends])
        if ends.count(None) == 1:
            raise SemvizError(f"{where}: an end needs both end_u_px and end_v_px")
        sigma_px = _optional(row, "sigma_px", where)
        if sigma_px is not None and sigma_px <= 0.0:
            raise SemvizError(f"{where}: sigma_px is {sigma_px:g}; give a number above 0")
        into.sigma_px.append(1.0 if sigma_px is None else sigma_px)
        if element is not None:
            into.matches.append((len(into.class_id) - 1, element))
            score = _optional(row, "score", where)
            into.score.append(1.0 if score is None else score)
    return frames


def _rows(path: Path) -> Sequence[Mapping[str, Any]]:
    """Return the rows of a CSV table or a JSON list."""
    text = read_text(path)
    if path.suffix == ".json":
        try:
            rows = parsed_json(text)
        except ValueError as error:
            raise SemvizError(f"{path}: no JSON ({shown(error)}); write it again") from None
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise SemvizError(f"{path}: expected a list of objects with {', '.join(_COLUMNS)}")
        return rows
    names, *rows = table_rows(text.splitlines(), path) or [[]]
    if missing := {"frame", "u_px", "v_px"} - set(names):
        raise SemvizError(
            f"{path}: no column {', '.join(sorted(missing))}; columns are {', '.join(_COLUMNS)}"
        )
    return [dict(zip(names, row, strict=False)) for row in rows if row]


def _optional(row: Mapping[str, Any], name: str, where: str) -> float | None:
    """Return a number, None if it is missing or empty."""
    value = row.get(name)
    if value is None or value == "":
        return None
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not abs(number) < 1e9:
        raise SemvizError(f"{where}: {name} {shown(value, 40)!r} is not a finite number")
    return number


def _number(row: Mapping[str, Any], name: str, where: str) -> float:
    value = _optional(row, name, where)
    if value is None:
        raise SemvizError(f"{where}: {name} is empty; give a number")
    return value


def _whole(row: Mapping[str, Any], name: str, where: str) -> int:
    value = _number(row, name, where)
    if value != int(value):
        raise SemvizError(f"{where}: {name} is {value:g}; give a whole number")
    return int(value)


def _class(
    row: Mapping[str, Any], semantic_map: SemanticMap, mapped: int | None, where: str
) -> int:
    name, classes = row.get("class"), semantic_map.classes
    if name in (None, ""):
        if mapped is None:
            raise SemvizError(f"{where}: without an element, a class is needed")
        return int(semantic_map.elements.class_id[mapped])
    return _class_id(str(name), classes, where)


def _class_id(name: str, classes: ClassSet, where: str) -> int:
    for class_ in classes:
        if name in (class_.name, str(class_.id)):
            return class_.id
    known = ", ".join(f"{class_.id} or {class_.name}" for class_ in classes)
    raise SemvizError(f"{where}: unknown class {shown(name, 40)}; known are {known}")


def poses_of_frames(measured: MeasuredPoses, frames: Sequence[Frame]) -> dict[int, Pose]:
    """Return T_camera_map by the number of the frame; a frame between two poses has none.

    Raise SemvizError if no frame has one.
    """
    poses = measured.poses()
    found: dict[int, Pose] = {}
    if measured.time_s is None:
        numbers = [] if measured.frame is None else measured.frame.tolist()
        by_number = dict(zip(numbers, poses, strict=True))
        at: list[Pose | None] = [by_number.get(frame.index) for frame in frames]
    else:
        rows = [row for row, pose in enumerate(poses) if pose is not None]
        times: FloatArray = np.array([frame.time_s for frame in frames])
        whole = [pose for pose in poses if pose is not None]
        at = poses_at_times(whole, measured.time_s[rows], times, 0.0) if rows else []
    for frame, pose in zip(frames, at, strict=False):
        if pose is not None:
            found[frame.index] = pose.inverse()
    if not found:
        raise SemvizError(f"{measured.path}: no pose is that of a frame of the workspace")
    return found


def record_results(
    recorder: RunRecorder,
    source: Dataset,
    frames: Sequence[Frame],
    poses: Mapping[int, Pose],
    matches: Mapping[int, FrameMatches],
    measured: Measurements,
) -> None:
    """Record the frames, with the truth, images and priors that are known."""
    for frame in track(frames, "recording", len(frames)):
        found = matches.get(frame.index, FrameMatches())
        recorder.add(
            frame.index,
            found.matched_pose(poses.get(frame.index), prior=measured.prior_of(frame)),
            time_s=frame.time_s,
            truth=frame.T_map_camera,
            image=source.image(frame.index, "left") if recorder.has_images else None,
        )


def check_results(
    workspace: Workspace, semantic_map: SemanticMap, matches: Mapping[int, FrameMatches]
) -> None:
    """Raise SemvizError if matches are of other frames, or the map is of another place."""
    check_map_frame(semantic_map, workspace.source)
    unknown = sorted(set(matches) - {frame.index for frame in workspace.source.frames})
    if unknown:
        raise SemvizError(
            f"matches are of frame {unknown[0]}, which the workspace does not have "
            f"({len(unknown)} such frames)"
        )
