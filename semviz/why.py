"""Why a frame came out as it did, in words and numbers."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from semviz.pose_errors import Errors, difference, errors_of
from semviz.recording.run import FrameRecord, Run
from semviz.verdicts import blamed_elements, detection_failed, explained, verdict
from semviz_core.arrays import IntArray
from semviz_core.classes import ClassSet
from semviz_core.explaining.told import Verdict
from semviz_core.localization import Localization
from semviz_core.solving.residuals import pair_residuals

LISTED = 2
"""So many alternatives, and pairs that do not fit, are listed; the card must not scroll."""


def why_card(run: Run, record: FrameRecord) -> dict[str, Any]:
    """Title, what the solver and the verdict say, and rows of (label, value)."""
    one, told, title = record.localization, explained(run, record), verdict(run, record)
    answer, errors = one.T_camera_map, errors_of(record)
    rows = [*_failed(run, record), *_rows(record, errors, run.semantic_map.classes)]
    explains = title == told.kind != "healthy"
    # of rivals the solver has said all itself; elsewhere the verdict needs the room
    adds = explains and told.kind != "ambiguous geometry"
    listed = 1 if adds else LISTED
    return {
        "title": title.capitalize(),
        "sentence": f"{one.reason} {told.sentence}" if adds else one.reason,
        "sure": told.sure if explains else None,
        "blamed": [run.semantic_map.name_of(one) for one in blamed_elements(run, record)],
        "rows": [row for row in (("Noticed", _noticed(told)), *rows) if row[1]],
        "alternatives": _alternatives(one)[:listed],
        "alternativesLeft": 0 if answer is None else max(0, len(one.alternatives) - listed),
        "times": [[stage, ms] for stage, ms in one.time_ms.items()],
        "hypotheses": None if one.search is None else one.search.hypotheses,
    }


def _noticed(told: Verdict) -> str:
    """What is wrong in a frame that came out well all the same."""
    kinds = [one.kind for one in told.noticed] if told.kind == "healthy" else []
    return ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))


def _failed(run: Run, record: FrameRecord) -> list[tuple[str, str]]:
    """What the detector missed and made up."""
    failed = detection_failed(run, record)
    return [
        ("Missed or hidden", _some([run.semantic_map.name_of(one) for one in failed.missed])),
        ("Nothing real", _some([f"#{row}" for row in failed.false])),
    ]


def _some(names: Sequence[str]) -> str:
    """The first of them, and how many more there are."""
    left = [f"{len(names) - LISTED} more"] if len(names) > LISTED else []
    return ", ".join([*names[:LISTED], *left])


def _rows(record: FrameRecord, errors: Errors | None, classes: ClassSet) -> list[tuple[str, str]]:
    one = record.localization
    error = "" if errors is None else f"{errors.distance_m:.2f} m · {errors.angle_deg:.2f}°"
    return [
        ("Error against the truth", error),
        ("Seen / matched / fit", _counts(one)),
        ("Uncertainty, 1σ", _sigma(one)),
        ("Prior off by", _prior(record)),
        _misfits(record, classes),
    ]


def _misfits(record: FrameRecord, classes: ClassSet) -> tuple[str, str]:
    """Elements whose detection lies elsewhere than the map says, worst first: at the true pose
    where it is known, else among the pairs of the answer."""
    one, truth = record.localization, record.frame.T_map_camera
    if truth is not None:
        label = "Off at the true pose"
        pairs = true_pairs(record)
        fit = pair_residuals(truth.inverse(), one.camera, one.observed, one.submap, pairs)
        size_px, inlier = np.sqrt(np.nansum(fit.residual_px**2, axis=1)), fit.inlier
    elif one.refinement is not None:
        label, pairs = "Do not fit", one.refinement.pairs
        size_px = np.sqrt(np.nansum(one.refinement.residual_px**2, axis=1))
        inlier = one.refinement.inlier
    else:
        return "", ""
    named = []
    for row in (row for row in np.argsort(-size_px) if not inlier[row]):
        mapped = int(pairs[row, 1])
        name = classes.element_name(int(one.submap.class_id[mapped]), int(one.submap.id[mapped]))
        named.append(f"{name} {size_px[row]:.0f} px")
    return label, _some(named)


def true_pairs(record: FrameRecord) -> IntArray:
    """(k, 2) rows (observed, submap) that are the same thing, by the known ids."""
    rows = {int(id): row for row, id in enumerate(record.localization.submap.id)}
    pairs = [(i, rows[int(id)]) for i, id in enumerate(record.element_id) if int(id) in rows]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _counts(localization: Localization) -> str:
    """And chi2 of those that fit."""
    fine = localization.refinement
    seen = len(localization.observed)
    if fine is None:
        return f"{seen} / none / none"
    fitting = f"{seen} / {len(fine.pairs)} / {int(fine.inlier.sum())}"
    return (
        f"{fitting} · χ² {np.nansum(fine.chi2[fine.inlier]):.1f}" if fine.inlier.any() else fitting
    )


def _sigma(localization: Localization) -> str:
    if localization.covariance is None:
        return ""
    variance = np.diag(localization.covariance)
    if not np.isfinite(variance).all():
        return ""
    position_m = float(np.sqrt(max(variance[:3].sum(), 0.0)))
    angle_deg = float(np.rad2deg(np.sqrt(max(variance[3:].sum(), 0.0))))
    return f"{position_m:.2f} m · {angle_deg:.2f}°"


def _prior(record: FrameRecord) -> str:
    """From the truth where there is one, else from the estimate."""
    one = record.localization
    center = record.frame.T_map_camera
    if center is None and one.T_camera_map is not None:
        center = one.T_camera_map.inverse()
    if center is None:
        return ""
    off = np.linalg.norm((one.prior.position_m - center.translation)[:2])
    return f"{off:.1f} m (σ {one.prior.horizontal_sigma_m:.1f} m)"


def _alternatives(localization: Localization) -> list[dict[str, Any]]:
    """The first other poses: how far from the answer, and how much less likely."""
    answer = localization.T_camera_map
    if answer is None:
        return []
    best = None if localization.search is None else localization.search.score
    values = []
    for name, other in zip("BCDEFGH"[:LISTED], localization.alternatives, strict=False):
        apart = difference(answer.inverse(), other.T_camera_map.inverse())
        known = best is not None and len(best) and np.isfinite(best[0] - other.score)
        values.append(
            {
                "name": name,
                "distanceM": apart.distance_m,
                "angleDeg": apart.angle_deg,
                "gapNats": float(best[0] - other.score) if best is not None and known else None,
            }
        )
    return values
