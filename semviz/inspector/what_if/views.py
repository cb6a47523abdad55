"""Answers before and after a change, as JSON values."""

from typing import Any

from semviz.inspector.views import place
from semviz.pose_errors import errors_of
from semviz.projection import project_elements
from semviz.recording.run import FrameRecord, Run
from semviz.trying.again import as_asked
from semviz.trying.change import Change
from semviz.trying.over import matter

Json = dict[str, Any]


def result_view(run: Run, position: int, found: FrameRecord, changes: tuple[Change, ...]) -> Json:
    """A frame before and after, and where the map is in its image under the new pose."""
    record = run.frames[position]
    return {
        "position": position,
        "matters": matter(run, record, changes),
        "before": side_view(as_asked(run, record)),
        "after": side_view(found),
        "reason": found.localization.reason,
        "ms": sum(found.localization.time_ms.values()),
        "mapped": _mapped(found),
    }


def side_view(record: FrameRecord) -> Json:
    """An answer in numbers."""
    one, errors = record.localization, errors_of(record)
    return {
        "status": one.status,
        "errorM": None if errors is None else errors.distance_m,
        "errorDeg": None if errors is None else errors.angle_deg,
        "fitting": 0 if one.refinement is None else int(one.refinement.inlier.sum()),
        "seen": len(one.observed),
    }


def _mapped(record: FrameRecord) -> list[Json]:
    """Elements of the submap that are in the image under the answer."""
    one = record.localization
    if one.T_camera_map is None:
        return []
    projected = project_elements(one.submap, one.T_camera_map, one.camera)
    classes = one.submap.class_id.tolist()
    places = [(class_id, place(projected, row)) for row, class_id in enumerate(classes)]
    return [{"class": class_id, "place": there} for class_id, there in places if there]
