"""Why a frame came out as it did, in words and numbers."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from semviz.recording.run import FrameRecord
from semviz_core.localization import Localization
from semviz_core.pose import Pose

SURE_AND_WRONG_M = 1.0
LISTED = 2
"""So many alternatives are listed; the card must not scroll."""


@dataclass(frozen=True)
class Errors:
    """Against the truth: distance of camera centres, angle between rotations."""

    distance_m: float
    angle_deg: float


def errors_of(record: FrameRecord) -> Errors | None:
    """None without a truth or without a pose."""
    truth, estimate = record.frame.T_map_camera, record.localization.T_camera_map
    if truth is None or estimate is None:
        return None
    return difference(estimate.inverse(), truth)


def difference(a: Pose, b: Pose) -> Errors:
    """Between two poses T_map_camera."""
    apart = a.inverse() @ b
    angle = float(np.linalg.norm(apart.log()[3:]))
    return Errors(float(np.linalg.norm(a.translation - b.translation)), float(np.rad2deg(angle)))


def sure_and_wrong(localization: Localization, errors: Errors | None) -> bool:
    """The worst kind: status ok, and yet more than a metre off."""
    off_m = 0.0 if errors is None else errors.distance_m
    return localization.status == "ok" and off_m > SURE_AND_WRONG_M


def verdict(localization: Localization, errors: Errors | None) -> str:
    """A few words for lists; frames in a row with the same words are one row there."""
    if localization.status != "ok":
        return localization.reason
    if errors is not None and sure_and_wrong(localization, errors):
        return f"sure, but {errors.distance_m:.1f} m off"
    return "healthy"


def why_card(record: FrameRecord) -> dict[str, Any]:
    """Title, the solver's sentence, and rows of (label, value)."""
    one = record.localization
    answer, errors = one.T_camera_map, errors_of(record)
    return {
        "title": _title(one, errors),
        "sentence": one.reason,
        "rows": [row for row in _rows(record, errors) if row[1]],
        "alternatives": _alternatives(one),
        "alternativesLeft": 0 if answer is None else max(0, len(one.alternatives) - LISTED),
        "times": [[stage, ms] for stage, ms in one.time_ms.items()],
        "hypotheses": None if one.search is None else one.search.hypotheses,
    }


def _title(localization: Localization, errors: Errors | None) -> str:
    if localization.status == "cannot":
        return "No answer"
    if localization.status == "ambiguous":
        return "Ambiguous"
    if sure_and_wrong(localization, errors):
        return "Sure and wrong"
    return "Healthy"


def _rows(record: FrameRecord, errors: Errors | None) -> list[tuple[str, str]]:
    one = record.localization
    error = "" if errors is None else f"{errors.distance_m:.2f} m · {errors.angle_deg:.2f}°"
    return [
        ("Error against the truth", error),
        ("Seen / matched / fit", _counts(one)),
        ("χ² of the pairs that fit", _chi2(one)),
        ("Uncertainty, 1σ", _sigma(one)),
        ("Prior off by", _prior(record)),
    ]


def _counts(localization: Localization) -> str:
    fine = localization.refinement
    seen = len(localization.observed)
    if fine is None:
        return f"{seen} / none / none"
    return f"{seen} / {len(fine.pairs)} / {int(fine.inlier.sum())}"


def _chi2(localization: Localization) -> str:
    fine = localization.refinement
    if fine is None or not fine.inlier.any():
        return ""
    fitting = fine.chi2[fine.inlier]
    return f"{np.nansum(fitting):.1f} in {len(fitting)} pairs"


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
