"""Calibrate a detector on labelled or mapped images, and choose its minimum score."""

from collections.abc import Sequence
from dataclasses import dataclass

from semviz.presentation.progress import track
from semviz.presentation.tables import Table
from semviz.research.detector_evaluation import EvaluationImage, evaluate_image
from semviz_core.base.detector_calibration import DetectorCalibration
from semviz_core.detection.detector import Detector
from semviz_core.metrics import detection_calibration
from semviz_core.metrics.detection_calibration import CalibrationImage, FittedCalibration

CHOSEN = "<- chosen"


def calibration_images(
    detector: Detector | None, images: Sequence[EvaluationImage]
) -> list[CalibrationImage]:
    """Detect in images, or take their stored detections if ``detector`` is None."""
    evaluated = ((evaluate_image(detector, image), image.is_complete) for image in images)
    return [
        CalibrationImage.of(seen.detections, seen.truth, is_complete)
        for seen, is_complete in track(evaluated, "looking", len(images))
    ]


@dataclass(frozen=True, eq=False)
class DetectorChoice:
    """The calibration of a detector, with the figures it was chosen by."""

    fitted: FittedCalibration
    calibration: DetectorCalibration
    most_false: float | None
    """Limit of false detections per image, if one was given."""

    def as_text(self) -> str:
        """Return the thresholds with their figures, why one was chosen, and the sigma scale."""
        scale, best = self.calibration.sigma_scale, self.fitted.best
        why = "the most right detections minus false ones"
        if self.most_false is not None:
            why = f"the lowest with at most {self.most_false:g} false an image"
        return "\n\n".join(
            [
                f"{self.calibration.detector} on {self.calibration.truth}",
                self._table().as_text(),
                f"minimum score {best.rates.least_score:g}: {why}; scores are probabilities now",
                f"sigma, measured over stated: across poles {scale.pole_across:.2f}, along them "
                f"{scale.pole_along:.2f}, signs {scale.sign:.2f}",
            ]
        )

    def _table(self) -> Table:
        rows = tuple(
            (
                f"{row.rates.least_score:g}",
                f"{row.recall:.0%}".replace("%", " %"),
                f"{row.precision:.0%}".replace("%", " %"),
                f"{row.right:.2f}",
                f"{row.rates.false_detections:.2f}",
                f"{row.surplus:+.2f}",
                f"{row.rates.recall_near:.2f}",
                f"{row.rates.recall_far:.2f}",
                f"{row.rates.hidden_bottoms:.2f}",
                CHOSEN if row is self.fitted.best else "",
            )
            for row in self.fitted.figures
        )
        header = (
            "score from", "recall to 40 m", "precision", "right an image", "false", "right - false",
            "in view: near", "far", "hidden bottoms", "",
        )  # fmt: skip
        return Table("Minimum scores", header, rows, words=0)


def choose(
    images: Sequence[CalibrationImage],
    detector: str,
    settings: tuple[str, str],
    truth: str,
    most_false: float | None = None,
) -> DetectorChoice:
    """Return the calibration on one image or more.

    ``settings`` are the hash of the model's files and the measuring, ``truth`` describes the
    images. Raise SemvizError if too few detections are known to be right or false.
    """
    fitted = detection_calibration.fit_calibration(images, most_false)
    calibration = DetectorCalibration(
        detector=detector,
        model=settings[0],
        measuring=settings[1],
        truth=truth,
        least_score=fitted.best.rates.least_score,
        scores=fitted.scores,
        sigma_scale=fitted.sigma_scale,
        rates=tuple(row.rates for row in fitted.figures),
    )
    return DetectorChoice(fitted, calibration, most_false)
