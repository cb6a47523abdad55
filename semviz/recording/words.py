"""The texts that a recording shows: its readme, and why each frame came out as it did."""

import numpy as np

from semviz.recording.run import FrameRecord, RunInfo
from semviz_core.explaining.told import Evidence, Verdict
from semviz_core.localization import Localization, Status
from semviz_core.semantic_map import SemanticMap

LEVELS: dict[Status, str] = {"ok": "INFO", "ambiguous": "WARN", "cannot": "ERROR"}


def readme(info: RunInfo, semantic_map: SemanticMap) -> str:
    """Markdown: what this run is, and how to read the views."""
    options = "".join(f"- {key}: `{value}`\n" for key, value in info.options.items())
    kinds = ", ".join(f"{one.letter} {one.name}" for one in semantic_map.classes)
    return f"""# {info.name}
A run of semviz {info.version}, {info.created}: method `{info.method}`, seed {info.seed},
observations from {info.observations or "elsewhere"}, map `{info.map_name}`
({len(semantic_map)} elements, frame {semantic_map.frame.name}, {semantic_map.digest[:12]}).

**3D.** Map by class ({kinds}). White: true camera and its path. Orange: estimate, with its image;
dots: estimates by status, each tied to its true position. Grey circle: one sigma of the prior.
Violet: other poses that explain the image. Lines from the camera: pairs, by residual.

**Image.** Class colours: detections, named by the element they were paired with. Orange: the map
seen from the estimate. White: seen from the truth. Short bars: residuals, ten times as long;
blue under 1 px, light blue under 2, yellow under 3, orange under 5, red above.

**Matrix.** Probability of each pair, 0 to 1; detections down, map across, both sorted by class;
last row and column: not seen, not in the map. White dots: true pairs. Orange: pairs of the answer.

**Status.** ok; ambiguous: another pose explains the image as well; cannot: no answer, and why.

**Verdict.** healthy, or what broke first. Orange: what was seen. Violet: the map. Grey: the prior.
Yellow: the place itself. Red: the method.

{options}"""


def explain(record: FrameRecord, errors: tuple[float, float] | None, told: Verdict | None) -> str:
    """Markdown: status, reason and the numbers behind them.

    ``errors`` are RTE (m) and RRE (deg); ``told`` is the verdict where something went wrong.
    """
    result = record.localization
    rows = [_error_row(result, errors), ("Elements", _elements(record))]
    rows += [] if told is None else [("Evidence", ", ".join(map(_evidence, told.evidence)))]
    if result.refinement is not None:
        rows += [("Pairs", _pairs(result))]
    if result.covariance is not None:
        sigma = np.sqrt(np.maximum(np.diag(result.covariance), 0.0))
        sigma_text = f"{sigma[0]:.2f} right, {sigma[1]:.2f} down, {sigma[2]:.2f} ahead (m)"
        rows += [("1 sigma", sigma_text)]
    rows += [("Other poses", _alternatives(result))]
    rows += [("Time", ", ".join(f"{name} {ms:.1f}" for name, ms in result.time_ms.items()) + " ms")]
    table = "\n".join(f"| {name} | {text} |" for name, text in rows)
    title = f"## Frame {record.frame.index}: {result.status}"
    why = "" if told is None else f"\n\n**{told.kind.capitalize()}.** {told.sentence}"
    return f"{title}\n{result.reason}{why}\n\n| | |\n|---|---|\n{table}\n"


def _error_row(result: Localization, errors: tuple[float, float] | None) -> tuple[str, str]:
    if result.T_camera_map is None:
        return "Error", "none: there is no pose"
    if errors is None:
        return "Error", "unknown: there is no true pose"
    return "Error", f"{errors[0]:.2f} m, {errors[1]:.2f} deg"


def _elements(record: FrameRecord) -> str:
    result = record.localization
    reachable = int(np.isin(record.element_id, result.submap.id).sum())
    return f"{len(result.observed)} seen, {reachable} of them in the submap of {len(result.submap)}"


def _evidence(one: Evidence) -> str:
    return f"{one.name} {one.value:.3g} {one.unit}".rstrip()


def _pairs(result: Localization) -> str:
    refinement = result.refinement
    assert refinement is not None
    text = f"{len(refinement.pairs)}, {int(refinement.inlier.sum())} inliers"
    across = np.abs(refinement.residual_px[refinement.inlier, 0])
    if len(across):
        text += f", median {np.median(across):.1f} px"
    return text


def _alternatives(result: Localization) -> str:
    if not result.alternatives:
        return "none as good"
    shift = "none"
    if result.T_camera_map is not None:
        center = result.T_camera_map.inverse().translation
        there = [one.T_camera_map.inverse().translation for one in result.alternatives]
        shift = ", ".join(f"{np.linalg.norm(one - center):.1f} m away" for one in there[:3])
    return f"{len(result.alternatives)}: {shift}"
