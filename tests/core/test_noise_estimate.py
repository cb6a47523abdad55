"""Sigmas that a detector states wrongly are found over a run, of poles and of signs."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from rig_frames import RigFrame, RigKind, make_rig_frame

from semviz_core.base.detector_model import DetectorModel
from semviz_core.base.elements import Elements2D
from semviz_core.localization.localizer import Localizer
from semviz_core.localization.noise_estimate import NoiseEstimate, NoiseScales

FRAMES = 25
DETECTOR = DetectorModel()


@cache
def frame(seed: int) -> RigFrame:
    return make_rig_frame(seed, RigKind(most_seen=10))


def planted(observed: Elements2D, true: NoiseScales, seed: int) -> Elements2D:
    """The elements with larger errors than they state."""
    rng = np.random.default_rng(seed)
    scale = np.where(observed.is_line, true.pole, true.sign)[:, None]
    off = np.sqrt(scale**2 - 1.0) * rng.normal(0.0, 1.0, (2, len(observed), 2))
    return replace(observed, anchor_px=observed.anchor_px + off[0], end_px=observed.end_px + off[1])


@cache
def run(true: NoiseScales, fits: bool = True) -> tuple[NoiseScales, float]:
    """The scales found over a run, and the NEES a degree of freedom of its `ok` poses."""
    noise, nees = NoiseEstimate(), []
    for seed in range(FRAMES):
        view, given = frame(seed).views[0], frame(seed)
        stated = planted(view.observed, true, seed)
        observed = noise.applied(stated) if fits else stated
        found = Localizer().localize(observed, given.submap, view.camera, given.prior)
        noise = noise.after(found, stated, DETECTOR)
        if found.status == "ok" and found.T_camera_map is not None and seed > 4:
            off = (given.T_first_map @ found.T_camera_map.inverse()).log()
            nees.append(float(off @ np.linalg.solve(found.covariance, off)) / 6.0)
    return noise.scales, float(np.mean(nees))


@pytest.mark.parametrize(
    "true", [NoiseScales(3.0, 3.0), NoiseScales(1.0, 3.0), NoiseScales(3.0, 1.0)]
)
def test_errors_that_are_larger_than_stated_are_found(true: NoiseScales) -> None:
    scales, _ = run(true)
    np.testing.assert_allclose(scales, true, rtol=0.25)


def test_what_is_stated_truly_stays() -> None:
    scales, nees = run(NoiseScales())
    assert scales == (1.0, 1.0)
    assert 0.6 < nees < 1.4


def test_covariances_follow() -> None:
    large = NoiseScales(3.0, 3.0)
    assert run(large, fits=False)[1] > 1.6
    assert 0.6 < run(large)[1] < 1.4


def test_the_sentence_names_what_is_too_small() -> None:
    assert NoiseScales().sentence == ""
    assert NoiseScales(2.8, 2.8).sentence == "The stated sigma is about 2.8x too small."
    assert NoiseScales(1.0, 3.0).sentence == "The stated sigma of signs is about 3x too small."
    both = "The stated sigma of poles is about 2x and that of signs is about 4x too small."
    assert NoiseScales(2.0, 4.0).sentence == both


def test_frames_that_are_not_sure_tell_nothing() -> None:
    given, view = frame(0), frame(0).views[0]
    found = Localizer().localize(view.observed[:3], given.submap, view.camera, given.prior)
    noise = NoiseEstimate()
    assert noise.after(found, view.observed[:3], DETECTOR) is noise
