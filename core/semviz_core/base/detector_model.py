"""Rates and noise of a detector of poles and signs, and its calibration in one TOML file.

Association scores follow from the rates: false positives per image, recall near and far, and the
share of pole bottoms that are hidden although the detector reports them as known. The rates were
measured on images with known elements. Noise and range are those of a simulated detection, and
are shared by simulation, localizability and evaluation.

``semviz detect choose`` measures a calibration on images with known elements. A calibrated score is
the probability that a detection is right; sigmas are scaled to the errors that were measured. Rates
depend on the minimum score, so they are given for several.
"""

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from semviz_core.base.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.base.elements import SIGMA_PX_RANGE, Elements2D
from semviz_core.common.arrays import FloatArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.files import replacing
from semviz_core.common.limits import first_line, read_toml

NoiseName = Literal["paper", "low"]


class DetectorModel(NamedTuple):
    """Rates of a detector of poles and signs, measured on images with known elements."""

    false_detections: float = 1.5
    """Mean number per image of detections without a map element."""
    recall_near: float = 0.6
    """Probability that a mapped element in view within ``near_m`` is detected. Lower than the
    recall of detectors, because buildings, hedges and cars hide elements."""
    recall_far: float = 0.1
    """The same at ``far_m``; linear in between, constant from there to ``reach_m``."""
    near_m: float = 20.0
    far_m: float = 45.0
    reach_m: float = 1000.0
    """Almost nothing is detected beyond."""
    hidden_bottoms: float = 0.1
    """Share of pole bottoms reported as known that are in truth the last visible point above a car
    or hedge. The default costs nothing if there are none (``LABELS``: annotators flag them), and
    finds two thirds more poses if there are many (docs/results/benchmark.md)."""

    def recall_at(self, away_m: FloatArray) -> FloatArray:
        """Return the probabilities (k,) that mapped elements in view at distances are detected."""
        at_m, recall = (self.near_m, self.far_m), (self.recall_near, self.recall_far)
        return np.where(away_m <= self.reach_m, np.interp(away_m, at_m, recall), 0.0)

    def checked(self) -> "DetectorModel":
        """Return self. Raise SemvizError if a rate is impossible."""
        if not 0.0 < self.false_detections < 1e3:
            raise SemvizError("detector model: false_detections must be above 0 and below 1000")
        if not 0.0 < self.recall_far <= self.recall_near < 1.0:
            raise SemvizError("detector model: 0 < recall_far <= recall_near < 1 does not hold")
        if not 0.0 <= self.near_m < self.far_m <= self.reach_m:
            raise SemvizError("detector model: 0 <= near_m < far_m <= reach_m does not hold")
        if not 0.0 <= self.hidden_bottoms < 1.0:
            raise SemvizError("detector model: hidden_bottoms must be in [0, 1)")
        return self


LABELS = DetectorModel(hidden_bottoms=0.0)
"""Model of labels: annotators flag hidden ends."""
RANGE_M = (3.0, 40.0)
"""Distance of the nearest and the farthest element that the simulated detector finds."""
SIMULATED_DETECTOR = DetectorModel(
    false_detections=0.5,
    recall_near=0.75,
    recall_far=0.42,
    near_m=20.0,
    far_m=40.0,
    reach_m=RANGE_M[1] + 1.0,
    hidden_bottoms=0.0,
)
"""Model of ``SimulatedDetector``. Recall is measured over all mapped elements in view, hidden ones
included, on four streets of 60 frames. It flags the bottoms that it cannot see."""
SHIPPED_DETECTOR = DetectorModel(hidden_bottoms=0.06)
"""Model of the shipped detector: default recall and false detections, measured hidden bottoms.
On rendered streets it detects more (bench/images_to_poses.py: recall 0.9 or more up to 40 m, 0.3
false positives per image), on real images much less. The default rates cost nothing on the former
and give more correct poses on the latter."""


class Noise(NamedTuple):
    """Standard deviations of a detector's errors."""

    pole_across_px: float
    pole_along_px: float
    pole_angle_rad: float
    sign_px: dict[int, float]
    """Along each image axis, by class id."""


NOISE: dict[NoiseName, Noise] = {
    # Signs: root mean square errors of the paper's table, mean errors included.
    "paper": Noise(
        1.5, 4.0, float(np.deg2rad(1.32)), {TRIANGULAR: 1.81, RECTANGULAR: 4.10, ROUNDED: 3.17}
    ),
    "low": Noise(
        1.0, 1.0, float(np.deg2rad(0.3)), {TRIANGULAR: 1.0, RECTANGULAR: 1.0, ROUNDED: 1.0}
    ),
}
"""Noise of the simulated detector, by name."""
SHIPPED_NOISE = Noise(
    0.4, 3.0, float(np.deg2rad(0.5)), {TRIANGULAR: 0.3, RECTANGULAR: 0.3, ROUNDED: 0.3}
)
"""About the errors that ``semviz detect evaluate`` prints for rendered streets; along poles
rounded."""


CALIBRATION_ENDING = ".calibration.toml"
CALIBRATION_HEADER = "# Calibration of a detector, written by 'semviz detect choose'."
"""Also of files of 'semviz detect rates': it marks what semviz wrote."""
Kind = Literal["pole", "sign"]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Scale = Annotated[float, Field(gt=0.0, le=100.0)]


class _Values(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ScoreCurve(_Values):
    """The probability that a detection is right, by its score: linear between k points."""

    score: tuple[Share, ...]
    """(k,) ascending."""
    probability: tuple[Share, ...]
    """(k,) never descending."""

    def model_post_init(self, _: Any) -> None:
        if not len(self.score) == len(self.probability) > 0:
            raise ValueError("score and probability need the same number of values, one or more")
        if (np.diff(self.score) <= 0.0).any() or (np.diff(self.probability) < 0.0).any():
            raise ValueError("score must ascend, and probability must not descend")

    def __call__(self, score: FloatArray) -> FloatArray:
        """Return the probabilities (m,) of scores (m,)."""
        return np.asarray(np.interp(score, self.score, self.probability))


class SigmaScale(_Values):
    """Factors of a detector's sigmas; 1 if they are as large as its errors."""

    pole_across: Scale = 1.0
    pole_along: Scale = 1.0
    sign: Scale = 1.0


def calibrated(
    detections: Elements2D, scores: Mapping[Kind, ScoreCurve], scale: SigmaScale
) -> Elements2D:
    """Return detections (m,) with scores from the curves, and scaled sigmas."""
    score, sigma_px = detections.score.copy(), detections.sigma_px.copy()
    line = detections.is_line
    for kind, curve in scores.items():
        rows = line if kind == "pole" else ~line
        score[rows] = curve(score[rows])
    sigma_px[line] *= (scale.pole_across, scale.pole_along)
    sigma_px[~line] *= scale.sign
    return replace(detections, score=score, sigma_px=np.clip(sigma_px, *SIGMA_PX_RANGE))


class CalibratedRates(_Values):
    """The rates of a detector for detections of a minimum score; see ``DetectorModel``."""

    least_score: Share
    """Minimum calibrated score."""
    false_detections: float
    recall_near: float
    recall_far: float
    near_m: float
    far_m: float
    reach_m: float
    hidden_bottoms: float

    def model_post_init(self, _: Any) -> None:
        try:
            self.detector_model.checked()
        except SemvizError as error:
            raise ValueError(str(error)) from None

    @property
    def detector_model(self) -> DetectorModel:
        return DetectorModel(**self.model_dump(exclude={"least_score"}))


class DetectorCalibration(_Values):
    """What is known about the detections of one model."""

    format: Literal[1] = 1
    detector: str
    """Its name, for people."""
    model: str
    """Hash of its files."""
    measuring: str
    """How its regions are measured, as in ``semviz detect --measuring``."""
    truth: str
    """The images and ground truth of the calibration, for people."""
    least_score: Share
    """The recommended minimum of the calibrated score."""
    scores: Mapping[Kind, ScoreCurve] = Field(default_factory=dict)
    """A kind without a curve keeps its scores."""
    sigma_scale: SigmaScale
    rates: tuple[CalibratedRates, ...] = Field(min_length=1)
    """By ascending minimum score; the first is 0."""

    def model_post_init(self, _: Any) -> None:
        least = [rates.least_score for rates in self.rates]
        if least[0] != 0.0 or (np.diff(least) <= 0.0).any():
            raise ValueError("rates must go by ascending least_score, from 0 on")

    def is_of(self, settings: Mapping[str, object]) -> bool:
        """Return whether it is of the detections with these settings, as stored with them."""
        return (self.model, self.measuring) == (settings.get("model"), settings.get("measuring"))

    def calibrated(self, detections: Elements2D) -> Elements2D:
        """Return detections (m,) with calibrated scores and sigmas."""
        return calibrated(detections, self.scores, self.sigma_scale)

    def detector_model(self, least_score: float) -> DetectorModel:
        """Return the rates of detections of at least this calibrated score."""
        below = [rates for rates in self.rates if rates.least_score <= least_score]
        return below[-1].detector_model

    def save(self, path: Path) -> None:
        """Write the TOML file, completely or not at all."""
        with replacing(path) as temporary:
            temporary.write_text(self._as_toml(), encoding="utf-8", newline="\n")

    @classmethod
    def load(cls, path: Path) -> "DetectorCalibration":
        """Read the file of ``save``. Raise SemvizError if it is missing or invalid."""
        if not path.is_file():
            raise SemvizError(f"{path}: no such file; 'semviz detect choose' writes it")
        try:
            return cls.model_validate(read_toml(path))
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            why = first_line(first["msg"].removeprefix("Value error, "))
            raise SemvizError(
                f"{path}: {where}: {why}; write it anew with 'semviz detect choose'"
            ) from None

    def _as_toml(self) -> str:
        values = self.model_dump()
        tables = {"sigma_scale": values.pop("sigma_scale")}
        tables |= {f"scores.{kind}": curve for kind, curve in values.pop("scores").items()}
        rates = values.pop("rates")
        parts = [
            CALIBRATION_HEADER,
            *_lines(values),
            *(line for name, table in tables.items() for line in ("", f"[{name}]", *_lines(table))),
            *(line for row in rates for line in ("", "[[rates]]", *_lines(row))),
        ]
        return "\n".join(parts) + "\n"


def _lines(values: Mapping[str, Any]) -> list[str]:
    """Return a table's lines; strings and lists of numbers are the same in JSON and TOML."""
    return [f"{key} = {json.dumps(_rounded(value))}" for key, value in values.items()]


def _rounded(value: Any) -> Any:
    """Round to six digits: more would pretend precision."""
    if isinstance(value, tuple):
        return [_rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
