"""A detector looks at images of which is known what they show; what comes of it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from time import process_time
from typing import Any

from semviz.known_images import KnownImage
from semviz.progress import track
from semviz_core.classes import DEFAULT_CLASSES
from semviz_core.detection.detector import Detector
from semviz_core.errors import SemvizError
from semviz_core.evaluation.detection_figures import (
    FALSE_A_FRAME,
    DetectionFigures,
    Judged,
    detection_figures,
)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What a detector reached."""

    settings: dict[str, str]
    """What was measured and how, for people."""
    notes: tuple[str, ...]
    """What readers of the figures should know."""
    images: tuple[KnownImage, ...]
    judged: tuple[Judged, ...]
    """Each image with all that the detector found."""
    figures: DetectionFigures

    @cached_property
    def above(self) -> tuple[Judged, ...]:
        """Each image with what scores enough."""
        return tuple(one.above(self.figures.threshold) for one in self.judged)

    def as_json(self) -> dict[str, Any]:
        """The object that ``semviz detect evaluate --json`` prints."""
        return {
            "settings": self.settings,
            "notes": list(self.notes),
            "figures": self.figures.as_dict(),
        }


def evaluate(
    detector: Detector,
    images: Sequence[KnownImage],
    least_score: float | None = None,
    told: Mapping[str, str] | None = None,
) -> Evaluation:
    """Of one image or more; ``least_score`` as the threshold of ``detection_figures``, ``told`` is
    what else belongs to the settings.

    Times are the processor's, whatever else is at work, after a first call that is not counted.
    """
    detector.detect(images[0].read())
    judged = tuple(_judge(detector, one) for one in track(images, "looking", len(images)))
    figures = detection_figures(judged, DEFAULT_CLASSES, least_score)
    settings = {
        "model": detector.finder.name,
        "measuring": detector.measuring,
        "images": _where(images),
        "threshold": _threshold(figures.threshold, least_score),
        **(told or {}),
    }
    return Evaluation(settings, tuple(_notes(images)), tuple(images), judged, figures)


def _judge(detector: Detector, image: KnownImage) -> Judged:
    pixels, truth = image.read(), image.truth()
    start_s = process_time()
    try:
        found = detector.detect(pixels)
    except SemvizError as error:
        raise SemvizError(f"{image.name}: {error}") from None
    return Judged(found, truth, process_time() - start_s)


def _threshold(threshold: float, asked: float | None) -> str:
    if asked is not None:
        return f"{asked:g}, as given"
    if threshold == 0.0:
        return f"none, what the model tells is within {FALSE_A_FRAME:g} false a frame"
    return f"{threshold:.3f}, chosen on these images"


def _where(images: Sequence[KnownImage]) -> str:
    """``100 of 20 places, street-30000 to street-30019``."""
    places = list(dict.fromkeys(one.place for one in images))
    if len(places) == 1:
        return f"{len(images)} of {places[0]}"
    return f"{len(images)} of {len(places)} places, {places[0]} to {places[-1]}"


def _notes(images: Sequence[KnownImage]) -> list[str]:
    partial = sum(not one.is_complete for one in images)
    if not partial:
        return []
    return [
        f"{partial} of {len(images)} images are labelled but not reviewed; what is not labelled "
        "in them counts as false"
    ]
