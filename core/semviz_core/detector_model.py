"""What a detector finds and invents: the odds behind every score."""

from typing import NamedTuple

from semviz_core.errors import SemvizError


class DetectorModel(NamedTuple):
    """Rates of a detector of poles and signs, as measured on images with known elements."""

    false_detections: float = 1.5
    """Mean number in an image of detections that are nothing in the map."""
    recall_near: float = 0.6
    """Chance that a mapped element in view within ``near_m`` is detected. Lower than detectors
    reach, because buildings, hedges and cars hide what the map cannot know of."""
    recall_far: float = 0.1
    """The same at ``far_m``; between, it falls evenly, and stays so up to ``reach_m``."""
    near_m: float = 20.0
    far_m: float = 45.0
    reach_m: float = 1000.0
    """Beyond, next to nothing is detected."""
    hidden_bottoms: float = 0.0
    """Share of pole bottoms given as known that are really the end of what a car or hedge left to
    see. 0 for labels, whose makers flag what is hidden."""

    def checked(self) -> "DetectorModel":
        """Itself. Raises SemvizError where a rate is impossible."""
        if not 0.0 < self.false_detections < 1e3:
            raise SemvizError("detector model: false_detections must be above 0 and below 1000")
        if not 0.0 < self.recall_far <= self.recall_near < 1.0:
            raise SemvizError("detector model: 0 < recall_far <= recall_near < 1 does not hold")
        if not 0.0 <= self.near_m < self.far_m <= self.reach_m:
            raise SemvizError("detector model: 0 <= near_m < far_m <= reach_m does not hold")
        if not 0.0 <= self.hidden_bottoms < 1.0:
            raise SemvizError("detector model: hidden_bottoms must be in [0, 1)")
        return self
