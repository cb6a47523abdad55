"""Draw curves and status lanes over a run's frames in rerun.

Write also its texts: a readme, and the reason for each frame's status.
"""

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from semviz.presentation.plots import ALTERNATIVE, ESTIMATE, PRIOR, STATUS, TRUTH, Tone, rgba
from semviz.runs.columns import Columns
from semviz.runs.diagnosis import STARTING_OR_LOST, diagnosis_name, frame_diagnosis, noticed_faults
from semviz.runs.run import FrameRecord, Run, RunInfo
from semviz_core.base.localization import Localization, Status
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.diagnosis.fault import EvidenceItem, FrameDiagnosis
from semviz_core.metrics.pose_errors import pose_error

LEVELS: dict[Status, str] = {"ok": "INFO", "ambiguous": "WARN", "cannot": "ERROR"}


def readme(info: RunInfo, semantic_map: SemanticMap) -> str:
    """Return Markdown that describes the run, and how to read the views."""
    camera = f", camera {info.camera}" if info.camera else ""
    options = "".join(f"- {key}: `{value}`\n" for key, value in info.options.items())
    kinds = ", ".join(f"{class_.letter} {class_.name}" for class_ in semantic_map.classes)
    return f"""# {info.name}
A run of semviz {info.version}, {info.created}: method `{info.method}`, seed {info.seed},
observations from {info.observations or "elsewhere"}{camera}, map `{info.map_name}`
({len(semantic_map)} elements, frame {semantic_map.frame.name}, {semantic_map.digest[:12]}).

**3D.** Map by class ({kinds}). White: true camera and its path. Orange: estimate, with its image;
dots: estimates by status, each tied to its true position. Grey circle: one sigma of the prior.
Violet: other poses that explain the image. Lines from the camera: pairs, by residual.

**Image.** Class colours: detections, named by their matched element. Orange: the map
seen from the estimate. White: seen from the truth. Short bars: residuals, ten times as long;
blue under 1 px, light blue under 2, yellow under 3, orange under 5, red above.

**Matrix.** Probability of each pair, 0 to 1; detections down, map across, both sorted by class;
last row and column: not seen, not in the map. White dots: true pairs. Orange: estimated pairs.

**Status.** ok; ambiguous: another pose explains the image as well; cannot: no pose, and why.

**Diagnosis.** healthy, or what broke first. Orange: detections. Violet: the map. Grey: the prior.
Yellow: the place itself. Red: the method.

{options}"""


def frame_text(
    record: FrameRecord,
    errors: tuple[float, float] | None,
    diagnosis: FrameDiagnosis | None,
    noticed: str,
) -> str:
    """Return Markdown with status, reason and figures.

    ``errors`` are RTE (m) and RRE (deg); ``diagnosis`` is None for a healthy frame, of which
    ``noticed`` names faults that did no harm.
    """
    result = record.localization
    rows = [_error_row(result, errors), ("Elements", _elements(record))]
    if diagnosis is not None:
        rows += [("Evidence", ", ".join(map(_evidence, diagnosis.evidence)))]
    if noticed:
        rows += [("Also found", noticed)]
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
    cause = ""
    if diagnosis is not None:
        cause = f"\n\n**{diagnosis.kind.capitalize()}.** {diagnosis.sentence}"
    return f"{title}\n{result.reason}{cause}\n\n| | |\n|---|---|\n{table}\n"


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


def _evidence(evidence: EvidenceItem) -> str:
    return f"{evidence.name} {evidence.value:.3g} {evidence.unit}".rstrip()


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
    distances = "none"
    if result.T_camera_map is not None:
        center = result.T_camera_map.inverse().translation
        nearest = result.alternatives[:3]
        centers = [alternative.T_camera_map.inverse().translation for alternative in nearest]
        distances = ", ".join(f"{np.linalg.norm(other - center):.1f} m away" for other in centers)
    return f"{len(result.alternatives)}: {distances}"


ERROR_M, ERROR_DEG = "/error/translation_m", "/error/rotation_deg"
COUNTS, TIME_MS = "/elements", "/time_ms"
STATUSES, DIAGNOSES, WHY = "/status", "/verdict", "/why"

DIAGNOSIS_COLORS = {
    "healthy": STATUS["ok"],
    STARTING_OR_LOST: PRIOR,
    **dict.fromkeys(
        (
            "not in the submap",
            "wrong heading prior",
            "wrong gravity prior",
            "wrong height prior",
            "wrong position prior",
            "wrong odometry",
        ),
        PRIOR,
    ),
    "ambiguous geometry": STATUS["ambiguous"],
    **dict.fromkeys(
        (
            "moved in the map",
            "missing in the map",
            "twice in the map",
            "misaligned map",
            "time offset",
            "wrong extrinsic",
            "wrong calibration",
        ),
        ALTERNATIVE,
    ),
    **dict.fromkeys(
        (
            "too few elements",
            "missed detection",
            "false detection",
            "wrong class",
            "false or not mapped",
            "wrong detection sigma",
        ),
        ESTIMATE,
    ),
    **dict.fromkeys(
        ("wrong matches", "search miss", "refinement diverged", "unexplained"), STATUS["cannot"]
    ),
}
"""Grey: the prior. Yellow: the place. Violet: the map. Orange: detections. Red: the method."""


def draw_plot_styles(stream: rr.RecordingStream) -> None:
    """Draw the static styles of the plots: names and colours."""
    for entity, name in ((ERROR_M, "translation error, m"), (ERROR_DEG, "rotation error, deg")):
        dots = rr.SeriesPoints(colors=_colors(ESTIMATE), names=name, marker_sizes=3.0)
        stream.log(entity, dots, static=True)
    names, colors = ["seen", "paired", "inliers"], _colors(TRUTH, PRIOR, STATUS["ok"])
    stream.log(COUNTS, rr.SeriesLines(colors=colors, names=names, widths=1.5), static=True)
    stream.log(WHY, rr.TextDocument.from_fields(media_type="text/markdown"), static=True)
    for entity, tones in ((STATUSES, STATUS), (DIAGNOSES, DIAGNOSIS_COLORS)):
        states = rr.StateConfiguration(values=list(tones), colors=_colors(*tones.values()))
        stream.log(entity, states, static=True)


def draw_frame_plots(columns: Columns, run: Run, record: FrameRecord) -> None:
    """Draw one frame of ``run``, which needs no frames of its own."""
    result, truth = record.localization, record.frame.T_map_camera
    errors = None
    if truth is not None and result.T_camera_map is not None:
        errors = pose_error(result.T_camera_map, truth.inverse())
    pairs, inliers = np.nan, np.nan
    if result.refinement is not None:
        pairs, inliers = len(result.refinement.pairs), int(result.refinement.inlier.sum())
    error_m, error_deg = errors or (np.nan, np.nan)
    columns.scalars(ERROR_M, error_m)
    columns.scalars(ERROR_DEG, error_deg)
    columns.scalars(COUNTS, len(result.observed), pairs, inliers)
    columns.scalars(TIME_MS, sum(result.time_ms.values()))
    _add_texts(columns, run, record, errors)


def _add_texts(
    columns: Columns, run: Run, record: FrameRecord, errors: tuple[float, float] | None
) -> None:
    result, name = record.localization, diagnosis_name(run, record)
    found = None if name == STARTING_OR_LOST else frame_diagnosis(run, record)
    diagnosis = None if name == "healthy" else found
    columns.text(STATUSES, "StateChange:state", result.status)
    columns.text(DIAGNOSES, "StateChange:state", name)
    columns.text(
        WHY, "TextDocument:text", frame_text(record, errors, diagnosis, noticed_faults(run, record))
    )
    line = result.reason if diagnosis is None else f"{diagnosis.kind}: {diagnosis.sentence}"
    columns.text(WHY, "TextLog:text", line)
    columns.text(WHY, "TextLog:level", LEVELS[result.status], "TextLogLevel")


def _colors(*tones: Tone) -> NDArray[np.uint32]:
    return np.array([rgba(tone.dark) for tone in tones], np.uint32)
