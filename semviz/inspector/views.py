"""A run and its frames as JSON values: what the page draws. NaN and missing are null."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from semviz.inspector.session import State
from semviz.pose_errors import errors_of, sure_and_wrong
from semviz.projection import Projected, offsets, project_elements
from semviz.recording.run import FrameRecord, Run
from semviz.verdicts import detection_failed, verdict
from semviz.why import why_card
from semviz_core.arrays import IntArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet
from semviz_core.localization import Localization
from semviz_core.pose import Pose

Json = dict[str, Any]


def run_view(name: str, run: Run) -> Json:
    """Everything about a run that does not change from frame to frame."""
    return {
        **run_head(name, run),
        "note": run.note,
        "frames": [_frame_row(run, record) for record in run.frames],
        **_summary(run),
    }


def run_head(name: str, run: Run) -> Json:
    """What it was made with, and what its images are."""
    rig = run.info.rig
    return {
        "name": name,
        "method": run.info.method,
        "map": run.info.map_name,
        "mapFrame": run.semantic_map.frame.name,
        "created": run.info.created,
        "elements": len(run.semantic_map),
        "image": _size(rig.left),
        "imageRight": None if rig.right is None else _size(rig.right),
        "classes": _classes(run.semantic_map.classes),
    }


def frame_view(run: Run, position: int) -> Json:
    """One frame: detections, map under estimate and truth, pairs, probabilities, where detection
    failed (rows of map and detections), the why card."""
    record = run.frames[position]
    one = record.localization
    truth = record.frame.T_map_camera
    estimated = _projected(one, one.T_camera_map)
    true = _projected(one, None if truth is None else truth.inverse())
    mapped, failed = _mapped_columns(record), detection_failed(run, record)
    return {
        "position": position,
        "index": record.frame.index,
        "hasTruth": truth is not None,
        "observed": _observed(one, mapped),
        "mapped": _mapped(one, run.semantic_map.classes, estimated, true),
        "pairs": _pairs(one, estimated),
        "truePairs": _true_pairs(one, mapped, true),
        "matrix": _matrix(one),
        "missed": np.flatnonzero(np.isin(one.submap.id, failed.missed)).tolist(),
        "false": list(failed.false),
        "why": why_card(run, record),
        **_frame_row(run, record),
    }


def state_view(state: State) -> Json:
    """What is selected and how it is looked at."""
    return {
        "observed": state.selection.observed,
        "element": state.selection.element,
        "view": state.view,
        "alternatives": state.alternatives,
        "forecast": state.forecast,
        "colors": state.colors,
        "ellipsoids": state.ellipsoids,
        "base": state.base,
        "comparing": state.comparing,
        "mode": state.mode,
        "side": state.side,
        "neighbours": state.neighbours,
    }


def _size(camera: Camera) -> Json:
    return {"width": camera.width, "height": camera.height}


def _frame_row(run: Run, record: FrameRecord) -> Json:
    one = record.localization
    errors = errors_of(record)
    matched = 0 if one.refinement is None else int(one.refinement.inlier.sum())
    return {
        "index": record.frame.index,
        "status": one.status,
        "reason": one.reason,
        "verdict": verdict(run, record),
        "sureAndWrong": sure_and_wrong(one, errors),
        "errorM": None if errors is None else errors.distance_m,
        "errorDeg": None if errors is None else errors.angle_deg,
        "ms": sum(one.time_ms.values()),
        "seen": len(one.observed),
        "matched": matched,
    }


def _summary(run: Run) -> Json:
    measured = [errors for record in run.frames if (errors := errors_of(record)) is not None]
    ok = sum(record.localization.status == "ok" for record in run.frames)
    return {
        "medianM": float(np.median([one.distance_m for one in measured])) if measured else None,
        "okShare": ok / len(run.frames) if run.frames else None,
    }


def _classes(classes: ClassSet) -> list[Json]:
    return [
        {
            "id": one.id,
            "name": one.name,
            "letter": one.letter,
            "kind": one.kind,
            "shape": one.shape,
            "color": one.color,
            "colorLight": one.color_light,
        }
        for one in classes
    ]


def _projected(localization: Localization, pose: Pose | None) -> Projected | None:
    if pose is None:
        return None
    return project_elements(localization.submap, pose, localization.camera)


def _mapped_columns(record: FrameRecord) -> IntArray:
    """(m,) row of the submap that each observed row truly is; -1 where unknown or not there."""
    rows = {int(id): row for row, id in enumerate(record.localization.submap.id)}
    found = [rows.get(int(id), -1) for id in record.element_id]
    return np.array(found, dtype=np.int64)


def _observed(localization: Localization, mapped: IntArray) -> list[Json]:
    seen = localization.observed
    return [
        {
            "class": int(seen.class_id[row]),
            "anchor": numbers(seen.anchor_px[row]),
            "end": numbers(seen.end_px[row]) if seen.is_line[row] else None,
            "anchorKnown": bool(seen.anchor_known[row]),
            "endKnown": bool(seen.end_known[row]),
            "score": float(seen.score[row]),
            "truth": None if mapped[row] < 0 else int(mapped[row]),
        }
        for row in range(len(seen))
    ]


def _mapped(
    localization: Localization,
    classes: ClassSet,
    estimated: Projected | None,
    true: Projected | None,
) -> list[Json]:
    submap = localization.submap
    return [
        {
            "id": int(submap.id[row]),
            "name": classes.element_name(int(submap.class_id[row]), int(submap.id[row])),
            "class": int(submap.class_id[row]),
            "estimate": place(estimated, row),
            "truth": place(true, row),
            "behind": _is_behind(estimated or true, row),
        }
        for row in range(len(submap))
    ]


def _is_behind(projected: Projected | None, row: int) -> bool:
    return projected is not None and bool(projected.behind[row])


def place(projected: Projected | None, row: int) -> list[Any] | None:
    """[anchor, end] in the image, or null where it is not shown."""
    if projected is None or not projected.shown[row]:
        return None
    end = numbers(projected.end_px[row])
    return [numbers(projected.anchor_px[row]), None if None in end else end]


def _pairs(localization: Localization, estimated: Projected | None) -> list[Json]:
    """Pairs that the answer rests on or turned down, with the solver's own residuals."""
    fine = localization.refinement
    if fine is None or estimated is None:
        return []
    start, vector = offsets(localization.observed, estimated, fine.pairs)
    size = np.sqrt(np.nansum(fine.residual_px**2, axis=1))
    return [
        {
            "observed": int(i),
            "mapped": int(j),
            "inlier": bool(fine.inlier[row]),
            "residualPx": float(size[row]),
            "chi2": number(fine.chi2[row]),
            "start": numbers(start[row]),
            "vector": numbers(vector[row]),
        }
        for row, (i, j) in enumerate(fine.pairs)
    ]


def _true_pairs(localization: Localization, mapped: IntArray, true: Projected | None) -> list[Json]:
    """What the residuals would be at the true pose, between true pairs."""
    if true is None:
        return []
    rows = np.flatnonzero(mapped >= 0)
    pairs = np.stack([rows, mapped[rows]], axis=1)
    start, vector = offsets(localization.observed, true, pairs)
    size = np.linalg.norm(vector, axis=1)
    return [
        {
            "observed": int(i),
            "mapped": int(mapped[i]),
            "inlier": True,
            "residualPx": number(size[row]),
            "chi2": None,
            "start": numbers(start[row]),
            "vector": numbers(vector[row]),
        }
        for row, i in enumerate(rows)
    ]


def _matrix(localization: Localization) -> Json | None:
    """Probabilities, and the order of rows and columns that makes classes blocks."""
    if localization.match is None:
        return None
    return {
        "probability": np.round(localization.match.probability, 4).tolist(),
        "rows": np.argsort(localization.observed.class_id, kind="stable").tolist(),
        "columns": np.argsort(localization.submap.class_id, kind="stable").tolist(),
    }


def numbers(values: ArrayLike) -> list[float | None]:
    """Numbers rounded to a hundredth; NaN and infinity as null."""
    return [number(one) for one in np.asarray(values, dtype=np.float64).ravel()]


def number(value: float | np.floating[Any]) -> float | None:
    """A number rounded to a hundredth; NaN and infinity as null."""
    return round(float(value), 2) if np.isfinite(value) else None
