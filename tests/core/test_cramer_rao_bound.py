"""The Cramer-Rao bound, against what maximum likelihood makes of noise drawn again and again.

The bound's model: detections and mapped elements are off by Gaussians. The map's errors are
unknowns that nobody asks for; they are marginalized by adding their covariance, projected into the
image, to that of the detections. So the bound is that of a pose in a map as uncertain as it says.
"""

from dataclasses import replace

import numpy as np
import pytest
from problem_frames import EXACT, NOISY, flagged, frames
from scipy.stats import chi2

from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose
from semviz_core.common.arrays import FloatArray
from semviz_core.localization.least_squares import fit_pairs
from semviz_core.localization.problem import PoseProblem, perpendicular
from semviz_core.research.evaluation.methods import bound_covariance
from semviz_core.research.evaluation.problems import CAMERA, LocalizationProblem

DRAWS = 1_000
CHANCE = 1e-4
"""Of a frame to fail although all is right, over its six directions together."""
AHEAD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CENTER_M = np.array([0.4, -0.3, 1.65])
VAGUE = {"horizontal_sigma_m": 1e5, "vertical_sigma_m": 1e5}
"""A fix that says nothing."""


def frame(
    seed: int, poles: int, signs: int, ends: bool = True, **prior: object
) -> LocalizationProblem:
    """A frame without noise, of elements 8 to 30 m ahead: ``observed`` and ``submap`` are true, and
    state the noise that ``redrawn`` adds.

    ``ends`` is whether poles' ends are known, ``prior`` fields of the Prior at the true place.
    """
    rng = np.random.default_rng(seed)
    n = poles + signs
    tilt = Pose.from_rotvec(rng.normal(0.0, 0.03, 3), np.zeros(3)).rotation
    T_camera_map = Pose(tilt @ AHEAD, -tilt @ AHEAD @ CENTER_M)
    x = rng.uniform(8.0, 30.0, n)
    anchor = np.column_stack([x, rng.uniform(-0.6, 0.6, n) * x, rng.uniform(2.5, 7.0, n)])
    foot = anchor * [1.0, 1.0, 0.0] + rng.normal(0.0, 0.05, (n, 3))
    line = np.arange(n) < poles
    foot[~line] = np.nan
    class_id = np.where(line, 0, 1)
    submap = Elements3D.from_ends(np.arange(n), anchor, foot, class_id)
    submap = replace(submap, covariance_m2=map_covariance(rng, line))
    observed = Elements2D.from_ends(
        CAMERA.project(T_camera_map.apply(anchor)),
        CAMERA.project(T_camera_map.apply(foot)),
        class_id,
    )
    known = np.full(n, ends) | ~line
    observed = replace(
        observed,
        sigma_px=rng.uniform(0.5, 2.0, (n, 1)) * np.where(line[:, None], [1.0, 1.5], 1.0),
        anchor_known=known,
        end_known=known & line,
    )
    pairs = np.column_stack([np.arange(n), np.arange(n)])
    known_before = Prior(CENTER_M, **prior)
    return LocalizationProblem(
        observed, submap, CAMERA, known_before, T_camera_map, pairs, observed.end_known
    )


def map_covariance(rng: np.random.Generator, line: np.ndarray) -> FloatArray:
    """(n, 6, 6) of a few centimetres, correlated anyhow."""
    root = rng.normal(0.0, 0.02, (len(line), 6, 6))
    root[~line, 3:] = 0.0
    return root @ root.transpose(0, 2, 1)


def with_up(problem: LocalizationProblem, sigma_rad: float) -> LocalizationProblem:
    up = problem.T_camera_map.rotation[:, 2]
    return replace(problem, prior=replace(problem.prior, up_camera=up, up_sigma_rad=sigma_rad))


def with_heading(problem: LocalizationProblem, sigma_rad: float) -> LocalizationProblem:
    x, y = problem.T_camera_map.rotation[2, :2]
    heading = {"heading_rad": float(np.arctan2(y, x)), "heading_sigma_rad": sigma_rad}
    return replace(problem, prior=replace(problem.prior, **heading))


def street_frame(number: int) -> LocalizationProblem:
    """A frame of the benchmark's generator; the noise that it states has not been added yet."""
    problem = frames(3, EXACT, 8)[number]
    m, center_m = len(problem.observed), problem.T_camera_map.inverse().translation
    covariance = map_covariance(np.random.default_rng(number), problem.submap.is_line)
    return replace(
        problem,
        observed=replace(problem.observed, sigma_px=np.tile([1.0, 1.5], (m, 1))),
        submap=replace(problem.submap, covariance_m2=covariance),
        prior=Prior(center_m, vertical_sigma_m=0.06, up_camera=problem.T_camera_map.rotation[:, 2]),
    )


def redrawn(problem: LocalizationProblem, rng: np.random.Generator) -> LocalizationProblem:
    """A frame without noise, with the noise that it states."""
    seen, mapped, prior = problem.observed, problem.submap, problem.prior
    line = seen.is_line
    down = np.tile([0.0, 1.0], (len(seen), 1))
    axis = seen.end_px[line] - seen.anchor_px[line]
    down[line] = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    across = np.stack([down[:, 1], -down[:, 0]], axis=1)
    off = rng.standard_normal((2, len(seen), 2)) * seen.sigma_px
    off_px = off[..., :1] * across + off[..., 1:] * down
    factor = np.linalg.cholesky(mapped.covariance_m2 + 1e-18 * np.eye(6))
    off_m = (factor @ rng.standard_normal((len(mapped), 6, 1)))[..., 0]
    return replace(
        problem,
        observed=replace(
            seen, anchor_px=seen.anchor_px + off_px[0], end_px=seen.end_px + off_px[1]
        ),
        submap=replace(
            mapped, anchor_m=mapped.anchor_m + off_m[:, :3], end_m=mapped.end_m + off_m[:, 3:]
        ),
        prior=redrawn_prior(prior, rng),
    )


def redrawn_prior(prior: Prior, rng: np.random.Generator) -> Prior:
    sigma = np.array([prior.horizontal_sigma_m, prior.horizontal_sigma_m, prior.vertical_sigma_m])
    values: dict[str, object] = {"position_m": prior.position_m + sigma * rng.standard_normal(3)}
    tilt, turn = rng.standard_normal(2), rng.standard_normal()
    if prior.up_camera is not None:
        axis = prior.up_sigma_rad * tilt @ perpendicular(prior.up_camera)
        values["up_camera"] = Pose.from_rotvec(axis, np.zeros(3)).rotation @ prior.up_camera
    if prior.heading_rad is not None:
        values["heading_rad"] = prior.heading_rad + prior.heading_sigma_rad * turn
    return replace(prior, **values)


def fitted_errors(
    problem: LocalizationProblem, stated: LocalizationProblem | None = None
) -> FloatArray:
    """(DRAWS, 6) errors of maximum likelihood with true pairs, noise drawn anew each time.

    ``stated`` holds the sigmas that the fit is told, if others than the true ones.
    """
    rng, errors = np.random.default_rng(7), []
    told = stated or problem
    for _ in range(DRAWS):
        drawn = redrawn(problem, rng)
        seen = replace(drawn.observed, sigma_px=told.observed.sigma_px)
        mapped = replace(drawn.submap, covariance_m2=told.submap.covariance_m2)
        scene = PoseProblem.of(drawn.camera, seen, mapped)
        fit = fit_pairs(scene, drawn.prior, drawn.T_camera_map, drawn.pairs)
        errors.append((fit.T_camera_map @ problem.T_camera_map.inverse()).log())
    return np.array(errors)


def squares_outside(errors: FloatArray, bound: FloatArray | None) -> int:
    """In how many of the bound's six axes the errors' squares do not agree with it."""
    assert bound is not None
    variance, axes = np.linalg.eigh(bound)
    squares = ((errors @ axes) ** 2).sum(axis=0) / variance  # a chi-square of DRAWS each
    low, high = chi2.ppf([0.5 * CHANCE / 6.0, 1.0 - 0.5 * CHANCE / 6.0], DRAWS)
    return int(((squares < low) | (squares > high)).sum())


CASES = {
    "points alone": frame(0, 0, 8, **VAGUE),
    "poles alone": frame(1, 7, 0, **VAGUE),
    "points and poles": frame(2, 4, 4, **VAGUE),
    "lines and height": frame(3, 7, 0, ends=False, **{**VAGUE, "vertical_sigma_m": 0.06}),
    "lines, points": frame(4, 5, 2, ends=False, **VAGUE),
    "three poles, attitude": with_up(frame(5, 3, 0, **VAGUE), 0.01),
    "two points, height, attitude": with_up(
        frame(6, 0, 2, **{**VAGUE, "vertical_sigma_m": 0.06}), 0.009
    ),
    "two poles, heading": with_heading(with_up(frame(7, 2, 0, **VAGUE), 0.009), 0.02),
    "a place alone": with_heading(
        with_up(frame(8, 0, 1, horizontal_sigma_m=0.3, vertical_sigma_m=0.1), 0.009), 0.02
    ),
    "all": with_heading(
        with_up(frame(9, 5, 3, horizontal_sigma_m=0.3, vertical_sigma_m=0.06), 0.009), 0.02
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_maximum_likelihood_reaches_the_bound_and_no_more(name: str) -> None:
    errors = fitted_errors(CASES[name])
    assert squares_outside(errors, bound_covariance(CASES[name])) == 0


@pytest.mark.parametrize("number", range(3))
def test_it_does_so_beside_the_benchmark_s_road(number: int) -> None:
    problem = street_frame(number)
    assert squares_outside(fitted_errors(problem), bound_covariance(problem)) == 0


def scaled(
    problem: LocalizationProblem, sigma_px: float = 1.0, map_sigma: float = 1.0
) -> LocalizationProblem:
    """The same frame, more or less noisy."""
    seen, mapped = problem.observed, problem.submap
    return replace(
        problem,
        observed=replace(seen, sigma_px=sigma_px * seen.sigma_px),
        submap=replace(mapped, covariance_m2=map_sigma**2 * mapped.covariance_m2),
    )


@pytest.mark.parametrize("name", ["points alone", "poles alone", "all"])
def test_wrong_sigmas_are_caught(name: str) -> None:
    """A bound of other sigmas than the noise's, and a fit that is told others, do not agree."""
    true = CASES[name]
    errors = fitted_errors(true)
    for wrong in (scaled(true, 0.8), scaled(true, 1.25), scaled(true, 1.0, 0.0)):
        assert squares_outside(errors, bound_covariance(wrong)) > 0
    misled = fitted_errors(true, scaled(true, 0.1, 0.01))
    assert squares_outside(misled, bound_covariance(true)) > 0


def radius_m(covariance: FloatArray | None) -> float:
    assert covariance is not None
    return float(np.sqrt(np.trace(covariance[:3, :3])))


def least_eigenvalue(larger: FloatArray | None, smaller: FloatArray | None) -> float:
    assert larger is not None
    assert smaller is not None
    return float(np.linalg.eigvalsh(larger - smaller)[0])


def test_noise_of_the_map_widens_the_bound_like_that_of_detections() -> None:
    for problem in frames(20, NOISY):
        here = bound_covariance(problem)
        assert least_eigenvalue(bound_covariance(scaled(problem, 1.0, 2.0)), here) > 0.0
        assert least_eigenvalue(bound_covariance(scaled(problem, 2.0)), here) > 0.0
        assert least_eigenvalue(here, bound_covariance(scaled(problem, 1.0, 0.0))) > 0.0


def test_a_pair_more_narrows_the_bound() -> None:
    for problem in frames(20, NOISY):
        fewer = replace(problem, pairs=problem.pairs[1:])
        assert least_eigenvalue(bound_covariance(fewer), bound_covariance(problem)) > -1e-12


def test_bottoms_that_are_hidden_do_not_count() -> None:
    for problem in frames(20, NOISY):
        here = bound_covariance(problem)
        np.testing.assert_array_equal(here, bound_covariance(flagged(problem)))
    shown = CASES["poles alone"]
    covered = replace(shown, end_visible=np.zeros_like(shown.end_visible))
    assert radius_m(bound_covariance(covered)) > 1.01 * radius_m(bound_covariance(shown))


def test_the_noise_of_one_drawing_hardly_moves_the_bound() -> None:
    """It is taken at the frame's own noisy elements, as nothing else is at hand in benchmarks."""
    rng = np.random.default_rng(0)
    for problem in CASES.values():
        true = radius_m(bound_covariance(problem))
        drawn = [radius_m(bound_covariance(redrawn(problem, rng))) for _ in range(50)]
        assert np.median(drawn) == pytest.approx(true, rel=0.02)


def test_what_is_not_fixed_has_no_bound() -> None:
    assert bound_covariance(frame(0, 0, 2, **VAGUE)) is None
    assert bound_covariance(frame(0, 2, 0, ends=False, **VAGUE)) is None
    three = frame(0, 3, 0, **VAGUE)
    assert bound_covariance(three) is not None
    assert bound_covariance(replace(three, pairs=three.pairs[:0])) is None
