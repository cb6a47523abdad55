"""Simulate the fixes and the odometry of a sequence from its true poses."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from semviz.workspace.drive.rig_views import OdometrySource
from semviz_core.base.frame import Frame, Odometry, OdometryNoise, Prior
from semviz_core.common.errors import SemvizError
from semviz_core.datasets.priors import PriorOptions, simulate_prior

if TYPE_CHECKING:
    from semviz.workspace.localization.localize import LocalizeOptions

ODOMETRY_NOISE = OdometryNoise()
_ODOMETRY_SEED = 2  # 0 and 1 seed the prior and the detector

PriorSource = Callable[[Frame], Prior | None]
"""Returns the prior of a frame; None if it has none."""


def prior_options(options: "LocalizeOptions") -> PriorOptions:
    """Return the accuracy of the simulated GPS and compass."""
    heading_deg = options.heading_sigma_deg
    return PriorOptions(
        distance_m=options.prior_distance_m,
        heading_sigma_rad=None if heading_deg is None else float(np.deg2rad(heading_deg)),
    )


def simulated_odometry(seed: int) -> OdometrySource:
    """Simulate odometry: the true motion between two frames, with noise."""

    def odometry_of(before: Frame, now: Frame) -> Odometry | None:
        if now.T_map_camera is None or before.T_map_camera is None:
            return None
        rng = np.random.default_rng([seed, now.index, _ODOMETRY_SEED])
        return ODOMETRY_NOISE.measure(now.T_map_camera.inverse() @ before.T_map_camera, rng)

    return odometry_of


def simulated_prior(options: "LocalizeOptions") -> PriorSource:
    """Simulate a GPS fix that is off by a known distance, gravity, and optionally a compass."""
    accuracy = prior_options(options)

    def prior_of(frame: Frame) -> Prior:
        if frame.T_map_camera is None:
            raise SemvizError(f"frame {frame.index} has no pose to simulate a GPS fix from")
        return simulate_prior(frame.T_map_camera, accuracy, (options.seed, frame.index))

    return prior_of
