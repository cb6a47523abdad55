"""Find what is marked in one image in another: along the epipolar lines, at plausible depths."""

from dataclasses import dataclass

import numpy as np

from semviz_annotation.assist.align import aligned_pole, aligned_sign
from semviz_annotation.assist.expect import SIGMA_PX, expected_px, spread_px2
from semviz_annotation.assist.look import (
    LIKENESS,
    half_of,
    likeness,
    pole_look,
    pole_points,
    sign_points,
    width_of,
)
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.shot import Mark, Proposed, Shot, clipped
from semviz_annotation.assist.warp import depth_on_line, inverse_depths, transfer
from semviz_annotation.stereo import PLAUSIBLE_DEPTH_M
from semviz_annotation.triangulate import Triangulated
from semviz_core.arrays import FloatArray
from semviz_core.classes import ElementClass
from semviz_core.measuring.picture import Samples
from semviz_core.measuring.pole import across, support

_STEP_PX = 1.0
_TRIED = 3
_APART_PX = 3.0
_MOST = 2.0
"""The most that an element's known place speaks against another: squares of 3 sigma."""
_LEAN = 0.05
"""How much a pole, or the camera, may lean towards the other: radians."""


@dataclass(frozen=True)
class Partners:
    """What a mark may be in another image."""

    best: Proposed
    runner_up: Proposed | None
    """The next best at another depth."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A possible partner with what speaks for it."""

    mark: Mark
    ends_px: FloatArray
    evidence: FloatArray


def find_partner(
    here: Shot,
    there: Shot,
    mark: Mark,
    element_class: ElementClass,
    element: Triangulated | None = None,
) -> Partners | None:
    """The mark in ``there`` of what is marked in ``here``; None where it cannot be in it.

    The views share one map frame: two cameras of a rig, or two frames of one camera. Both ends of
    a pole get the depth that suits an upright one; ``element`` is what is known of its place.
    """
    found = candidates(here, there, mark, element_class, element)
    if not found:
        return None
    what = "partner pole" if mark.end_px is not None else "partner sign"
    scored = sorted(
        (Proposed(one.mark, probability(what, one.evidence)) for one in found),
        key=lambda one: -one.score,
    )
    return Partners(scored[0], scored[1] if len(scored) > 1 else None)


def candidates(
    here: Shot,
    there: Shot,
    mark: Mark,
    element_class: ElementClass,
    element: Triangulated | None = None,
) -> list[Candidate]:
    """The likeliest partners, at distinct places."""
    ends = mark.ends_px
    depths = inverse_depths(here.view, there.view, ends.mean(axis=0), PLAUSIBLE_DEPTH_M, _STEP_PX)
    if not len(depths):
        return []
    places = transfer(here.view, there.view, ends, depths)  # (d, ends, 2)
    inside = np.isfinite(places).all(axis=(1, 2))
    inside &= there.view.camera.contains(np.nan_to_num(places.mean(axis=1), nan=-9.0))
    depths, places = depths[inside], places[inside]
    if len(depths) < 2:
        return []
    prior = np.zeros(len(depths)) if element is None else _prior(there, element, mark, places)
    if len(ends) == 2:
        return _poles(here, there, mark, depths, places, prior)
    return _signs(here, there, mark, element_class, depths, places, prior)


def _prior(there: Shot, element: Triangulated, mark: Mark, places: FloatArray) -> FloatArray:
    """(d,) what an element's place says about where its partner is: 0 there, else less."""
    expected = expected_px(element, there.view)
    if expected is None:
        return np.zeros(len(places))
    spread = spread_px2(element, [there.view], SIGMA_PX)[0, :, :, 0]
    axes = across(expected)[None] if mark.end_px is not None else np.eye(2)
    off = (places - expected).mean(axis=1) @ axes.T
    covariance = axes @ np.einsum("aiaj->ij", spread) / len(expected) @ axes.T
    pull = np.einsum("di,ij,dj->d", off, np.linalg.inv(covariance), off)
    return np.asarray(-0.5 * np.minimum(pull / 9.0, _MOST))


# -- poles


def _poles(
    here: Shot,
    there: Shot,
    mark: Mark,
    depths: FloatArray,
    places: FloatArray,
    prior: FloatArray,
) -> list[Candidate]:
    width = width_of(here, mark.ends_px)
    points = pole_points(mark.ends_px, width)
    look = here.sample(points)
    alike = likeness(look, _looks(here, there, points, mark.ends_px, depths))
    total = alike @ LIKENESS + prior
    found = []
    for at in _peaks(total, places):
        lean = _lean_px(here, there, mark.ends_px, depths[at])
        found.append((at, aligned_pole(look, there, places[at], width, lean)))
    return _described(here, there, mark, look, width, depths, places, total, found)


def _described(
    here: Shot,
    there: Shot,
    mark: Mark,
    look: Samples,
    width: float,
    depths: FloatArray,
    places: FloatArray,
    total: FloatArray,
    found: list[tuple[int, FloatArray]],
) -> list[Candidate]:
    result: list[Candidate] = []
    order = [total[at] for at, _ in found]
    for n, (at, line) in enumerate(found):
        ends = _on_epipolar_lines(here, there, mark, line, places[at], depths[at])
        alike = likeness(look, pole_look(there, ends, width)[None])[0]
        others = [one for k, one in enumerate(order) if k != n]
        margin = order[n] - max(others) if others else 0.5
        moved = float(np.abs(line - places[at]).max())
        evidence = np.array(
            [
                *alike, *support(there, ends, width), total[at], np.clip(margin, -0.5, 0.5),
                moved, np.log(width),
            ]
        )  # fmt: skip
        result.append(Candidate(clipped(mark, ends, there.view.camera), ends, evidence))
    return result


def _lean_px(here: Shot, there: Shot, ends_px: FloatArray, depth_m: float) -> float:
    """How differently a pole's ends may move because it leans."""
    length_m = np.linalg.norm(np.diff(here.view.camera.normalize(ends_px), axis=0)) * depth_m
    depths = depth_m + _LEAN * length_m * np.array([-0.5, 0.5])
    places = transfer(here.view, there.view, ends_px.mean(axis=0)[None], depths)[:, 0]
    return float(np.linalg.norm(places[1] - places[0]))


def _on_epipolar_lines(
    here: Shot, there: Shot, mark: Mark, line: FloatArray, place: FloatArray, depth_m: float
) -> FloatArray:
    """(2, 2) ends on a line, each where its own epipolar line crosses it."""
    ends = place.copy()
    for k in range(2):
        at = depth_on_line(here.view, there.view, mark.ends_px[k], line, depth_m)
        if at is None:  # the epipolar line runs along the pole
            along = line[1] - line[0]
            ends[k] = line[0] + along * ((place[k] - line[0]) @ along) / (along @ along)
        else:
            ends[k] = at
    return ends


# -- signs


def _signs(
    here: Shot,
    there: Shot,
    mark: Mark,
    element_class: ElementClass,
    depths: FloatArray,
    places: FloatArray,
    prior: FloatArray,
) -> list[Candidate]:
    half = half_of(here, mark.ends_px[0], element_class)
    points = sign_points(mark.ends_px[0], half)
    look = here.sample(points)
    alike = likeness(look, _looks(here, there, points, mark.ends_px[:1], depths))
    total = alike @ LIKENESS + prior
    peaks = _peaks(total, places)
    result = []
    for n, at in enumerate(peaks):
        scale = _scale(here, there, mark.ends_px[0], depths[at])
        place, fit = aligned_sign(look, there, places[at, 0], half * scale)
        others = [total[one] for k, one in enumerate(peaks) if k != n]
        margin = total[at] - max(others) if others else 0.5
        moved = float(np.linalg.norm(place - places[at, 0]))
        evidence = np.array(
            [*fit, total[at], np.clip(margin, -0.5, 0.5), moved, np.log(half.mean())]
        )
        found = clipped(mark, place[None], there.view.camera)
        result.append(Candidate(found, place[None], evidence))
    return result


def _scale(here: Shot, there: Shot, pixel_px: FloatArray, depth_m: float) -> float:
    """How much larger things at a pixel's depth are in ``there``."""
    beside = pixel_px + np.array([[-2.0, 0.0], [2.0, 0.0]])
    found = transfer(here.view, there.view, beside, np.array([depth_m]))[0]
    return float(np.clip(np.linalg.norm(found[1] - found[0]) / 4.0, 0.3, 3.0))


# -- both


def _looks(
    here: Shot, there: Shot, points: FloatArray, ends: FloatArray, depths: FloatArray
) -> Samples:
    """(d, rows, columns, 3) colours at points (rows, columns, 2) of ``here`` at depths (d,)."""
    rows, columns = points.shape[:2]
    corners = points[[0, 0, -1, -1], [0, -1, 0, -1]]
    moved = transfer(here.view, there.view, corners, depths)  # (d, 4, 2)
    moved = np.nan_to_num(moved, nan=-9.0)
    v = np.linspace(0.0, 1.0, rows)[:, None, None]
    u = np.linspace(0.0, 1.0, columns)[:, None]
    a, b, c, d = (moved[:, None, None, k] for k in range(4))
    at = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    return there.sample(at.reshape(-1, columns, 2)).reshape(len(depths), rows, columns, 3)


def _peaks(total: FloatArray, places: FloatArray) -> list[int]:
    """The best local maxima, apart from one another."""
    padded = np.concatenate([[-np.inf], total, [-np.inf]])
    peak = (total >= padded[:-2]) & (total >= padded[2:])
    found: list[int] = []
    for at in np.flatnonzero(peak)[np.argsort(-total[peak], kind="stable")]:
        apart = [np.linalg.norm(places[at] - places[one], axis=1).min() for one in found]
        if not found or min(apart) > _APART_PX:
            found.append(int(at))
        if len(found) == _TRIED:
            break
    return found
