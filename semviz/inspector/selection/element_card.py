"""What is known of one map element: how sure its place is, its part in the run, its labels."""

from collections import defaultdict
from functools import lru_cache
from typing import Any

import numpy as np

from semviz.inspector.selection.origins import Origin, Origins, map_row, provenance_of
from semviz.recording.run import FrameRecord, Run
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.elements import Elements3D
from semviz_core.errors import SemvizError
from semviz_core.semantic_map import Decision

Json = dict[str, Any]


def element_card(run: Run, record: FrameRecord, element_id: int) -> Json:
    """Of an element of the run's map, from the camera of one frame."""
    return {
        "name": run.semantic_map.name_of(element_id),
        "class": int(mapped(run, element_id).class_id[0]),
        "place": _place(mapped(run, element_id), _eye_m(record)),
        "meaning": _meaning(run, element_id),
        "inRun": _in_run(run, element_id),
        "decisions": _decisions(run, element_id),
    }


def mapped(run: Run, element_id: int) -> Elements3D:
    """An element of the run's map, alone. Raises SemvizError where there is none."""
    row = map_row(run.semantic_map, element_id)
    if row is None:
        raise SemvizError(f"the map of this run has no element {element_id}; reload the page")
    return run.semantic_map.elements[[row]]


def _eye_m(record: FrameRecord) -> FloatArray:
    """(3,) the camera: where the answer has it, else the truth, else the prior."""
    answer = record.localization.T_camera_map
    pose = record.frame.T_map_camera if answer is None else answer.inverse()
    return record.localization.prior.position_m if pose is None else pose.translation


def _place(element: Elements3D, eye_m: FloatArray) -> list[Json]:
    """Of each end its distance and 1 sigma across and along the line of sight, and up (m)."""
    covariance_m2 = element.covariance_m2[0]
    is_line = bool(element.is_line[0])
    points_m = {"peak" if is_line else "middle": element.anchor_m[0]}
    known = [element.anchor_known[0], element.end_known[0]]
    if is_line:
        points_m["bottom"] = element.end_m[0]
    return [
        {
            "end": end,
            "known": bool(known[row]),
            "distanceM": float(np.linalg.norm(point_m - eye_m)),
            "sigmaM": _sigmas_m(_block(covariance_m2, row), point_m - eye_m),
        }
        for row, (end, point_m) in enumerate(points_m.items())
    ]


def _block(covariance_m2: FloatArray, row: int) -> FloatArray:
    """(3, 3) of the anchor (0) or the end (1)."""
    return covariance_m2[3 * row : 3 * row + 3, 3 * row : 3 * row + 3]


def _sigmas_m(covariance_m2: FloatArray, sight_m: FloatArray) -> list[float]:
    """Across and along a line of sight on the ground plane, and up; ``covariance_m2`` (3, 3)."""
    heading = np.arctan2(sight_m[1], sight_m[0])
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    axes = np.stack([across, along, [0.0, 0.0, 1.0]])
    variance = np.einsum("ki,ij,kj->k", axes, covariance_m2, axes)
    return [float(one) for one in np.sqrt(np.maximum(variance, 0.0))]


def _meaning(run: Run, element_id: int) -> str:
    """What the sigmas of ``_place`` rest on, in one line."""
    provenance = provenance_of(run.semantic_map, element_id)
    if provenance is None:
        return "1σ seen from this camera, as the map states it; it does not say from what."
    labels = len(provenance.observation_ids)
    return f"1σ seen from this camera, from {labels} labels, with their poses taken as exact."


def _in_run(run: Run, element_id: int) -> list[tuple[str, str]]:
    """In how many frames it is paired and, where that is known, seen."""
    seen, pairs = _over_run(run)
    mine = pairs[pairs[:, 1] == element_id]
    total = f"of {len(run.frames)} frames"
    rows = [("Paired, fits", f"{_frames(mine)}, {_frames(mine[mine[:, 2] == 1])} {total}")]
    if (seen[:, 1] >= 0).any():
        here, rightly = seen[seen[:, 1] == element_id], mine[mine[:, 3] == 1]
        rows.append(("Truly seen, paired rightly", f"{_frames(here)}, {_frames(rightly)} {total}"))
    return rows


def _frames(rows: IntArray) -> int:
    return len(np.unique(rows[:, 0]))


@lru_cache(maxsize=4)
def _over_run(run: Run) -> tuple[IntArray, IntArray]:
    """Position of the frame and true element of all that is seen (k, 2); position, element,
    whether it fits and is true of all pairs (m, 4)."""
    seen, pairs = [np.zeros((0, 2), np.int64)], [np.zeros((0, 4), np.int64)]
    for position, record in enumerate(run.frames):
        ids, fine = record.element_id, record.localization.refinement
        seen.append(np.stack([np.full(len(ids), position), ids], axis=1))
        if fine is not None:
            i, j = fine.pairs.T
            element = record.localization.submap.id[j]
            where = np.full(len(i), position)
            pairs.append(np.stack([where, element, fine.inlier, ids[i] == element], axis=1))
    return np.concatenate(seen), np.concatenate(pairs)


def _decisions(run: Run, element_id: int) -> list[Json]:
    """What was decided about the label elements that it was made of."""
    provenance = provenance_of(run.semantic_map, element_id)
    labels = set() if provenance is None else set(provenance.label_ids)
    decisions = run.semantic_map.decisions
    class_id = int(mapped(run, element_id).class_id[0])
    return [_decision(run, one, class_id) for one in decisions if labels & set(one.label_ids)]


def _decision(run: Run, one: Decision, class_id: int) -> Json:
    names = [run.semantic_map.classes.element_name(class_id, number) for number in one.numbers]
    return {"kind": one.kind, "by": one.by, "reason": one.reason, "names": names}


def origins_view(run: Run, origins: Origins, element_id: int) -> Json:
    """The label elements that it was made of; or in words why there are none."""
    try:
        found, reason = origins.of(element_id), origins.why_none(element_id)
    except SemvizError as error:
        found, reason = (), str(error)
    return {
        "element": element_id,
        "reason": reason,
        "entries": [_origin(run, one) for one in found],
    }


def _origin(run: Run, one: Origin) -> Json:
    """A label element: observations by frame and side, and who drew last."""
    sides: defaultdict[int, str] = defaultdict(str)
    for row in one.used:
        sides[row.frame_index] += row.side[0].upper()
    counts = {side: sum(row.side == side for row in one.used) for side in ("left", "right")}
    writer = one.writer
    return {
        "id": one.element.id,
        "number": one.element.number,
        "name": run.semantic_map.classes.element_name(one.element.class_id, one.element.number),
        "class": one.element.class_id,
        **counts,
        "frames": sorted(sides.items()),
        "others": one.others,
        "writer": None if writer is None else writer._asdict(),
        "isNewer": writer is not None and writer.number > run.semantic_map.operation,
    }
