"""Learning rates over a training."""

from math import cos, pi

from semviz_core.learning.task import Progress

PAPER_RATE = 5e-4
"""Adam's, from the first sample to the last (paper, "Implementation Details")."""
WARM_UP = 0.01


def cosine(progress: Progress, highest: float = PAPER_RATE) -> float:
    """Up to ``highest`` within the first hundredth, then down to 0 along half a cosine."""
    if progress.share < WARM_UP:
        return highest * (progress.share + 1e-3) / (WARM_UP + 1e-3)
    return highest * 0.5 * (1.0 + cos(pi * (progress.share - WARM_UP) / (1.0 - WARM_UP)))
