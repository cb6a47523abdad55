"""A run in named numbers, as gates and reports call them."""

from typing import Literal

from semviz.measure import summarize_run
from semviz.pose_errors import errors_of, sure_and_wrong
from semviz.recording.run import Run

Metrics = dict[str, float | None]
"""By name; None where a run cannot tell, such as errors without true poses."""

Trend = Literal["better", "worse", "same"]
MORE_IS_BETTER = frozenset({"share_below_1m", "share_below_1deg", "coverage"})
NEITHER = frozenset({"frames", "share_ambiguous"})
"""More ambiguous answers are good where there was none before, and bad where there was one."""


def metrics_of(run: Run) -> Metrics:
    """Errors of the frames with a pose and a true one; ``share_below_...`` and
    ``share_sure_and_wrong`` of all frames with a true pose; other shares of all frames."""
    summary, frames = summarize_run(run), len(run.frames)
    whole = summary.accuracy
    with_truth = sum(truth is not None for truth in run.truths)
    status = {name: one.frames for name, one in summary.by_status.items()}
    wrong = sum(sure_and_wrong(one.localization, errors_of(one)) for one in run.frames)
    return {
        "frames": float(frames),
        "mean_rte_m": whole.rte_m.mean,
        "q1_rte_m": whole.rte_m.q1,
        "median_rte_m": whole.rte_m.q2,
        "q3_rte_m": whole.rte_m.q3,
        "mean_rre_deg": whole.rre_deg.mean,
        "q1_rre_deg": whole.rre_deg.q1,
        "median_rre_deg": whole.rre_deg.q2,
        "q3_rre_deg": whole.rre_deg.q3,
        "share_below_1m": whole.share_below_1m,
        "share_below_1deg": whole.share_below_1deg,
        "coverage": _share(status["ok"], frames),
        "share_ambiguous": _share(status["ambiguous"], frames),
        "share_cannot": _share(status["cannot"], frames),
        "share_sure_and_wrong": _share(wrong, with_truth),
        "median_time_ms": summary.time_ms_median,
        "p95_time_ms": summary.time_ms_p95,
    }


def trend(name: str, base: float | None, other: float | None) -> Trend:
    """Whether the other run is better by a metric; ``same`` where that cannot be said."""
    if base is None or other is None or base == other or name in NEITHER:
        return "same"
    return "better" if (other > base) == (name in MORE_IS_BETTER) else "worse"


def _share(members: int, of: int) -> float | None:
    return members / of if of else None
