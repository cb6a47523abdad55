"""What is taken for granted when a map is judged: who looks, how well, and what is known before."""

from dataclasses import dataclass, field

import numpy as np

from semviz_core.classes import RECTANGULAR, ROUNDED, TRIANGULAR
from semviz_core.detector_model import DetectorModel
from semviz_core.errors import SemvizError
from semviz_core.sources.priors import PriorOptions
from semviz_core.sources.street.detector import Noise

LABEL_NOISE = Noise(1.0, 1.0, 0.0, {TRIANGULAR: 1.0, RECTANGULAR: 1.0, ROUNDED: 1.0})
"""Of labels, which people draw."""


@dataclass(frozen=True)
class Conditions:
    """Under which the camera will be localized."""

    detector: DetectorModel = field(default_factory=DetectorModel)
    noise: Noise = LABEL_NOISE
    hidden_bottoms: float = 0.5
    """Share of poles whose bottom cars or hedges hide. The detector notices, unless its model has
    ``hidden_bottoms`` too."""
    prior: PriorOptions = field(default_factory=PriorOptions)
    crop_radius_m: float = 120.0
    road_radius_m: float = 60.0
    """Of the map's road round the fix, which tells the height."""
    outcomes: int = 64
    """So many draws, at each position, of which elements are found."""
    trials: int = 4
    """So many made-up frames, at each position, are localized."""
    seed: int = 0

    def __post_init__(self) -> None:
        self.detector.checked()
        if not 0.0 <= self.hidden_bottoms < 1.0:
            raise SemvizError("hidden_bottoms must be in [0, 1)")
        if not 0.0 < self.crop_radius_m < np.inf:
            raise SemvizError(f"crop radius {self.crop_radius_m:g} m: give a positive number")
        if min(self.outcomes, self.trials, self.seed) < 0 or not self.outcomes:
            raise SemvizError(
                "outcomes, trials and seed are whole numbers; give at least 1 outcome"
            )
