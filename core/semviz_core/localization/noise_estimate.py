"""Estimate from the frames of a run how much larger the errors of detections are than stated.

Each frame whose pose is sure tells how well each scale of its sigmas explains it, of poles and of
signs: the score of the pose fitted with them. These log-likelihoods add up over the frames.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D
from semviz_core.base.frame import Prior
from semviz_core.base.localization import Localization
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.least_squares import information
from semviz_core.localization.problem import PoseProblem
from semviz_core.localization.search import mode_near
from semviz_core.localization.upright import assumed_upright

GRID: FloatArray = np.sqrt(2.0) ** np.arange(-2, 7)
"""Scales that are compared: 0.5 to 8."""
STATED = 2
"""Index of scale 1."""
PRIOR_NATS: FloatArray = np.tile(-0.5 * (np.log(GRID) / np.log(2.0)) ** 2, (2, 1))
"""Detectors know their sigma to a factor of two (one sigma)."""
KEPT = 0.99
"""What a frame told counts so much less with each frame after it."""
LEAST_SCALE, SURE_NATS = 1.3, 4.0
"""Sigmas are scaled if their scale is larger than the first, and likelier by the second."""


class NoiseScales(NamedTuple):
    """Likely sigmas of detections over the stated ones."""

    pole: float = 1.0
    sign: float = 1.0

    @property
    def sentence(self) -> str:
        """What they say; empty if the stated sigmas may be true."""
        pole, sign = f"{self.pole:.2g}", f"{self.sign:.2g}"
        if pole == sign:
            return "" if pole == "1" else f"The stated sigma is about {pole}x too small."
        scales = [("poles", pole), ("signs", sign)]
        told = [f"of {kind} is about {scale}x" for kind, scale in scales if scale != "1"]
        return f"The stated sigma {' and that '.join(told)} too small."


@dataclass(frozen=True, eq=False)
class NoiseEstimate:
    """What the frames so far tell about the sigmas of detections.

    ``applied`` scales the sigmas of the next frame, ``after`` learns from its result.
    """

    nats: FloatArray = field(default_factory=PRIOR_NATS.copy)
    """(2, len(GRID)) log-probability of each scale, of poles and of signs."""

    @property
    def scales(self) -> NoiseScales:
        """1 where the stated sigmas may be true, or are too large."""
        likely = []
        for nats in self.nats:
            weight = np.exp(nats - nats.max())
            scale = float(np.exp(weight @ np.log(GRID) / weight.sum()))
            sure = nats.max() - nats[STATED] > SURE_NATS and scale > LEAST_SCALE
            likely.append(scale if sure else 1.0)
        return NoiseScales(*likely)

    def applied(self, observed: Elements2D) -> Elements2D:
        """Return ``observed`` with the likely sigmas."""
        return _scaled(observed, self.scales)

    def after(
        self, found: Localization, stated: Elements2D, detector: DetectorModel
    ) -> "NoiseEstimate":
        """Return the estimate after a frame; ``stated`` are its elements with stated sigmas."""
        if found.status != "ok" or found.T_camera_map is None:
            return self
        frame = replace(found, observed=stated)
        prior, T = assumed_upright(found.given_prior), found.T_camera_map
        told = np.array([
            [
                _nats(frame, self.scales._replace(**{kind: scale}), prior, T, detector)
                for scale in GRID.tolist()
            ]
            for kind in NoiseScales._fields
        ])  # fmt: skip
        told -= told.max(axis=1, keepdims=True)
        return NoiseEstimate(PRIOR_NATS + KEPT * (self.nats - PRIOR_NATS) + told)


def _nats(
    frame: Localization, scales: NoiseScales, prior: Prior, T: Pose, detector: DetectorModel
) -> float:
    """Return the log-likelihood of a frame with scaled sigmas, integrated over poses near ``T``.

    At the optimum alone (without Laplace's term), a pose fitted to few elements explains part of
    their errors, and scales come out too small.
    """
    observed = _scaled(frame.observed, scales)
    problem = PoseProblem.of(frame.camera, observed, frame.submap, detector)
    mode = mode_near(problem, prior, T)
    pose = Pose(mode.rotation[0], mode.translation[0])
    of_pose = information(problem, prior, pose, mode.pairs(0))
    return float(mode.score[0] - 0.5 * np.linalg.slogdet(of_pose)[1])


def _scaled(observed: Elements2D, scales: NoiseScales) -> Elements2D:
    scale = np.where(observed.is_line, scales.pole, scales.sign)[:, None]
    return replace(observed, sigma_px=observed.sigma_px * scale)
