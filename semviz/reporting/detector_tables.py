"""The tables of a detector's evaluation, the first beside the paper's printed figures.

Chen, Xue, Pang: Sparse Semantic Map-Based Monocular Localization in Traffic Scenes Using Learned
2D-3D Point-Line Correspondences. IEEE Robotics and Automation Letters, 2022.
"""

from collections.abc import Sequence
from itertools import pairwise

from semviz.detector_evaluation import Evaluation
from semviz.tables import Table
from semviz_core.evaluation.detection_figures import (
    DISTANCES_M,
    DetectionFigures,
    EndsFigures,
    Share,
)
from semviz_core.evaluation.image_errors import CRITERIA

PRINTED = {
    "recall": "66 89 87 79",
    "RMSE (px)": "NA 1.81 4.10 3.17",
    "lateral ME (px)": "NA -1.38 -0.80 -0.61",
    "lateral SDE (px)": "NA 0.90 4.25 1.63",
    "longitudinal ME (px)": "NA -0.86 -1.74 1.49",
    "longitudinal SDE (px)": "NA 0.84 3.43 4.31",
    "angular ME (deg)": "-1.52 NA NA NA",
    "angular SDE (deg)": "1.32 NA NA NA",
}
"""The paper's table of detection accuracy: poles, triangular, rectangular and rounded signs."""
DIFFERENCES = (
    "Printed are the paper's figures, of 216 images of KITTI with its own labels. It does not say "
    "which detections are matched with which labels, nor how many are false; here both are stated. "
    "Here poles have lateral errors too, and what is far off or all but hidden does not count."
)
RULE = (
    "A sign is found within 4 px of its middle, or a quarter of its size; a pole where the visible "
    "parts share 30 % of what both cover, the line is within 4 px there and turned by less than "
    "5 deg. The best score takes the nearest of its class; a wrong class is a miss and a false "
    "one. What is out of reach (beyond 40 m, unless said otherwise, or nearer than 3 m), and poles "
    "of which less than 8 px are visible, do not count. Errors are found minus true: lateral and "
    "longitudinal are u and v of signs, across the line for poles. ME: mean, SDE: standard "
    "deviation."
)
STATED_RATES = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0)
NOTHING = "nothing"
_SHORT = {"pole": "pole", "triangular sign": "triangular", "rectangular sign": "rectangular",
          "rounded sign": "rounded"}  # fmt: skip


def as_text(evaluation: Evaluation) -> str:
    """For terminals of 120 columns."""
    figures = evaluation.figures
    told = [f"{name}: {value}" for name, value in evaluation.settings.items()]
    notes = [f"note: {note}" for note in evaluation.notes]
    time = (
        f"processor time for an image: median {figures.time_ms_median:.0f} ms, "
        f"p95 {figures.time_ms_p95:.0f} ms"
    )
    shown = (table.as_text() for table in tables(figures))
    return "\n\n".join(["\n".join([*told, *notes]), *shown, time])


def tables(figures: DetectionFigures) -> list[Table]:
    """What text and page both show."""
    return [
        _papers(figures),
        _curve(figures),
        _distances(figures),
        _ends(figures),
        _confusion(figures),
        _sigma(figures),
    ]


def _papers(figures: DetectionFigures) -> Table:
    """The paper's rows, then those that it does not have."""
    header = [""]
    for name in figures.classes:
        header += [f"{_short(name)}: paper", "here"]
    title = f"Found: at {figures.false_a_frame:.2f} false a frame, {figures.frames} images"
    if figures.threshold > 0.0:
        title += f" (score {figures.threshold:.3f} or more)"
    kinds = list(figures.classes.values())
    rows = [
        ("recall", [_percent(one.recall) for one in kinds]),
        *((title, [_figure(getattr(one.accuracy, name)) for one in kinds])
          for title, name in CRITERIA.items()),
        ("precision", [_percent(one.precision) for one in kinds]),
        ("false a frame", [f"{one.false_a_frame:.2f}" for one in kinds]),
        ("to be found", [str(one.recall.of) for one in kinds]),
    ]  # fmt: skip
    return Table(title, tuple(header), tuple(_beside(*row) for row in rows), words=1)


def _beside(title: str, here: Sequence[str]) -> tuple[str, ...]:
    """A row with the printed figures, where there are any."""
    printed = PRINTED.get(title, "- - - -").replace("NA", "-").split()
    if title == "recall":
        printed = [f"{one} %" for one in printed]
    return title, *(cell for pair in zip(printed, here, strict=True) for cell in pair)


def _curve(figures: DetectionFigures) -> Table:
    """Recall at some rates of false detections."""
    names = tuple(_short(name) for name in figures.classes)
    rows = tuple(
        (f"{one.false_a_frame:g}", f"{one.threshold:.3f}", *map(_share, one.recall.values()))
        for one in figures.curve
        if one.false_a_frame in STATED_RATES or one is figures.curve[-1]
    )
    header = ("false a frame", "score from", *names)
    return Table("Recall against false detections", header, rows, words=0)


def _distances(figures: DetectionFigures) -> Table:
    bins = held_distances(figures)
    rows = tuple(
        (_short(name), *(_percent_of(one.recall_by_distance[place]) for place in bins))
        for name, one in figures.classes.items()
    )
    return Table("Recall by distance", ("", *bins.values()), rows, words=1)


def held_distances(figures: DetectionFigures) -> dict[int, str]:
    """Bins of distances that hold anything, by their place among all."""
    return {
        place: f"{low:g} to {high:g} m"
        for place, (low, high) in enumerate(pairwise(DISTANCES_M))
        if any(one.recall_by_distance[place].of for one in figures.classes.values())
    }


def _ends(figures: DetectionFigures) -> Table:
    """Of poles."""
    rows = [
        row
        for one in figures.classes.values()
        if one.peaks is not None and one.bottoms is not None
        for row in (_ends_row("peak", one.peaks), _ends_row("bottom", one.bottoms))
    ]
    header = ("", "seen, and said so", "hidden, and said so", "along RMSE (px)")
    return Table("Ends of the poles found", header, tuple(rows), words=1)


def _ends_row(name: str, one: EndsFigures) -> tuple[str, ...]:
    return name, _percent_of(one.seen), _percent_of(one.hidden), _figure(one.along_rmse_px)


def _confusion(figures: DetectionFigures) -> Table:
    names = [*map(_short, figures.classes), NOTHING]
    rows = tuple(
        (name, *(str(count) if count else "" for count in row))
        for name, row in zip(names, figures.confusion, strict=True)
    )
    return Table("What was there (rows), found as (columns)", ("", *names), rows, words=1)


def _sigma(figures: DetectionFigures) -> Table:
    rows = tuple(
        (name, f"{one.sigma_px:.2f}", f"{one.error_px:.2f}", f"{one.ratio:.2f}", str(one.errors))
        for name, bins in figures.sigma.items()
        for one in bins
    )
    header = ("", "sigma (px)", "error RMS (px)", "RMS of error / sigma", "errors")
    return Table("How honest sigma is", header, rows, words=1)


def _short(name: str) -> str:
    return _SHORT.get(name, name)


def _percent(share: Share) -> str:
    return _share(share.share)


def _percent_of(share: Share) -> str:
    return f"{_share(share.share)} of {share.of}" if share.of else "-"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}".replace("%", " %")


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
