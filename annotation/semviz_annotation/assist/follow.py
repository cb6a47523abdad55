"""Find a mapped element in another frame: expected from its place, refined in the image."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semviz_annotation.assist.align import aligned_pole, aligned_sign
from semviz_annotation.assist.ends import with_visible_ends
from semviz_annotation.assist.look import (
    LIKENESS,
    half_of,
    likeness,
    pole_look,
    pole_points,
    sign_points,
    width_of,
)
from semviz_annotation.assist.pole import Axis, across, shifted, support
from semviz_annotation.assist.profile import refine
from semviz_annotation.assist.score import probability
from semviz_annotation.assist.shot import Mark, Proposed, Shot, clipped
from semviz_annotation.triangulate import Triangulated
from semviz_annotation.view import View
from semviz_core.arrays import FloatArray
from semviz_core.classes import ElementClass

SIGMA_PX = 1.5
"""What slightly wrong poses add to an expected place."""
_REACH_PX = 24.0
"""Nothing is looked for further away from where it is expected."""
_NEAR_PX = 1.0
_LEAN_PX = 0.4
_UPRIGHT_RAD = 0.02


@dataclass(frozen=True, eq=False)
class Followed:
    """What was found, with what speaks for it."""

    mark: Mark
    evidence: FloatArray


def follow(
    seen: Sequence[tuple[Shot, Mark]],
    element: Triangulated,
    there: Shot,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
) -> Proposed | None:
    """A mapped element in an image in which it is not labelled yet; None where it is out of it.

    ``seen`` are images in which it is labelled, the nearest first; ``element`` and all views share
    the map frame. What is hidden there, or cannot be told, comes with a low score.
    """
    found = found_in(seen, element, there, element_class, sigma_px)
    if found is None:
        return None
    what = "follow pole" if element.is_line else "follow sign"
    return Proposed(found.mark, probability(what, found.evidence))


def expected_px(element: Triangulated, view: View) -> FloatArray | None:
    """(1 or 2, 2) an element's projection; None where it is out of the image."""
    points = np.stack([element.anchor_m, element.end_m])[: 1 + element.is_line]
    pixels = view.project(points)
    if not np.isfinite(pixels).all():
        return None
    along = np.linspace(0.0, 1.0, 9)[:, None]
    return (
        pixels if view.camera.contains(pixels[0] + along * (pixels[-1] - pixels[0])).any() else None
    )


def found_in(
    seen: Sequence[tuple[Shot, Mark]],
    element: Triangulated,
    there: Shot,
    element_class: ElementClass,
    sigma_px: float = SIGMA_PX,
) -> Followed | None:
    """As ``follow``, not judged yet."""
    element = upright(element)
    expected = expected_px(element, there.view)
    if expected is None or not seen:
        return None
    spread = _spread_px2(element, there.view, sigma_px)
    mark = Mark((0.0, 0.0), None, element.anchor_known, element.end_known)
    if element.is_line:
        return _pole(seen[0], element, there, expected, spread, mark)
    return _sign(seen[0], element, there, expected, spread, mark, element_class)


def upright(element: Triangulated) -> Triangulated:
    """A pole with what is known of all poles: they stand upright, to about ``_UPRIGHT_RAD``.

    One stereo pair tells little of how a pole leans towards it, and other frames see that from
    aside. The update of a Gaussian by one more measurement (Kalman); z is up in the map frame.
    """
    if not element.is_line:
        return element
    ends = np.concatenate([element.anchor_m, element.end_m])
    length = float(np.linalg.norm(element.end_m - element.anchor_m))
    H = np.array([[-1.0, 0, 0, 1.0, 0, 0], [0, -1.0, 0, 0, 1.0, 0]])
    P = element.covariance_m2
    S = H @ P @ H.T + (_UPRIGHT_RAD * length) ** 2 * np.eye(2)
    gain = P @ H.T @ np.linalg.inv(S)
    ends = ends - gain @ (H @ ends)
    return replace(element, anchor_m=ends[:3], end_m=ends[3:], covariance_m2=P - gain @ H @ P)


def _spread_px2(element: Triangulated, view: View, sigma_px: float) -> FloatArray:
    """(e, 2, e, 2) px^2 covariance of the projections of an element's e ends."""
    points = (element.anchor_m, element.end_m)[: 1 + element.is_line]
    size = len(points)
    J = np.zeros((2 * size, 3 * size))
    for k, point in enumerate(points):
        J[2 * k : 2 * k + 2, 3 * k : 3 * k + 3] = view.jacobian(point)
    covariance = J @ element.covariance_m2[: 3 * size, : 3 * size] @ J.T
    covariance += sigma_px**2 * np.tile(np.eye(2), (size, size))  # a turned camera moves all alike
    return covariance.reshape(size, 2, size, 2)


def _pole(
    seen: tuple[Shot, Mark],
    element: Triangulated,
    there: Shot,
    expected: FloatArray,
    spread: FloatArray,
    mark: Mark,
) -> Followed | None:
    here, before = seen
    part = _part(element, here.view, before, there.view, expected)
    if part is None:
        return None
    ends_here, shares = part
    axis = _axis(here, ends_here, width_of(here, ends_here))
    ends_here, width = axis.ends_px, axis.width_px
    start = expected[0] + shares[:, None] * (expected[1] - expected[0])
    scale = np.linalg.norm(start[1] - start[0]) / np.linalg.norm(ends_here[1] - ends_here[0])
    there_width = float(np.clip(width * scale, 0.7, 60.0))
    # beside the pole, both looks reach equally far relative to its width
    look = here.sample(pole_points(ends_here, width))
    normal = across(expected)
    sideways = np.einsum("aibj,i,j->ab", spread, normal, normal)
    sigma = float(np.sqrt(np.trace(sideways) / 2.0))
    lean = float(np.sqrt(max(sideways[0, 0] + sideways[1, 1] - 2.0 * sideways[0, 1], 0.0)))
    along = np.array([-normal[1], normal[0]])
    lengthwise = float(np.sqrt(np.einsum("aiai->i", spread) @ along**2 / 2.0))
    reach = float(np.clip(3.0 * sigma, 2.0, _REACH_PX))
    offs = np.arange(-np.ceil(reach), np.ceil(reach) + 0.5)
    points = np.stack([pole_points(shifted(start, off, off), there_width) for off in offs])
    looks = there.sample(points.reshape(-1, *points.shape[2:])).reshape(len(offs), *look.shape)
    total = likeness(look, looks) @ LIKENESS - 0.5 * (offs / (3.0 * sigma)) ** 2
    at = int(np.argmax(total))
    rest = total[np.abs(offs - offs[at]) > 2.5]
    begun = shifted(start, offs[at], offs[at])
    ends = aligned_pole(look, there, begun, there_width, max(lean, _LEAN_PX), lengthwise)
    alike = likeness(look, pole_look(there, ends, there_width)[None])[0]
    ends = _axis(there, ends, there_width).ends_px
    moved = ends - start
    whole = _extended(ends, shares)
    evidence = np.array(
        [
            *alike, *support(there, ends, there_width), total[at],
            np.clip(total[at] - rest.max(), -0.5, 0.5) if len(rest) else 0.5,
            np.abs(moved @ normal).max() / sigma, np.log(lengthwise), abs(np.log(scale)),
            np.log(there_width),
        ]
    )  # fmt: skip
    found = clipped(mark, whole, there.view.camera)
    found, *_ = with_visible_ends(
        there, found, there_width, float(np.clip(3.0 * lengthwise, 2.0, 15.0))
    )
    return Followed(found, evidence)


def _axis(shot: Shot, ends_px: FloatArray, width_px: float) -> Axis:
    """The axis of a pole of known width, where the image shows it near a line; or the line."""
    line = Axis(ends_px, width_px, np.zeros(0), 0.0)
    found = refine(shot, line)
    near = np.abs(found.ends_px - ends_px).max() < _NEAR_PX
    return found if near and abs(np.log(found.width_px / width_px)) < 0.4 else line


def _part(
    element: Triangulated, here: View, mark: Mark, there: View, expected: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """The part of a pole that ``here`` shows and ``there`` has in its image.

    Its ends (2, 2) in ``here``, on the mark, and where along the projection in ``there`` (2,).
    """
    ends_m = np.stack([element.anchor_m, element.end_m])
    share = np.linspace(0.0, 1.0, 65)
    points = ends_m[0] + share[:, None] * (ends_m[1] - ends_m[0])
    at_here, at_there = here.project(points), there.project(points)
    marked = mark.ends_px
    along = marked[1] - marked[0]
    place = (at_here - marked[0]) @ along / (along @ along)
    step = expected[1] - expected[0]
    place_there = (at_there - expected[0]) @ step / (step @ step)
    ok = np.isfinite(place) & (place > -0.02) & (place < 1.02)
    ok &= np.isfinite(place_there) & there.camera.contains(np.nan_to_num(at_there, nan=-9.0))
    rows = np.flatnonzero(ok)
    if len(rows) < 2:
        return None
    chosen = rows[[0, -1]]
    return marked[0] + place[chosen][:, None] * along, place_there[chosen]


def _extended(ends: FloatArray, shares: FloatArray) -> FloatArray:
    """(2, 2) the whole line of which ``ends`` are at ``shares``."""
    step = (ends[1] - ends[0]) / (shares[1] - shares[0])
    first = ends[0] - shares[0] * step
    return np.stack([first, first + step])


def _sign(
    seen: tuple[Shot, Mark],
    element: Triangulated,
    there: Shot,
    expected: FloatArray,
    spread: FloatArray,
    mark: Mark,
    element_class: ElementClass,
) -> Followed | None:
    here, before = seen
    half = half_of(here, before.ends_px[0], element_class)
    depths = [float(one.depth_m(element.anchor_m[None])[0]) for one in (here.view, there.view)]
    focal = there.view.camera.K[0, 0] / here.view.camera.K[0, 0]
    scale = focal * depths[0] / depths[1]
    look = here.sample(sign_points(before.ends_px[0], half))
    variances, axes = np.linalg.eigh(spread[0, :, 0])
    sigmas = np.sqrt(variances)
    places = [_places(3.0 * one) for one in sigmas]
    grid = np.stack(np.meshgrid(*places), axis=-1).reshape(-1, 2)
    offs = grid @ axes.T
    points = sign_points(expected[0], half * scale) + offs[:, None, None]
    looks = there.sample(points.reshape(-1, *points.shape[2:])).reshape(len(offs), *look.shape)
    total = likeness(look, looks) @ LIKENESS - 0.5 * ((grid / (3.0 * sigmas)) ** 2).sum(axis=1)
    at = int(np.argmax(total))
    far = np.linalg.norm(offs - offs[at], axis=1) > 3.5
    found, fit = aligned_sign(look, there, expected[0] + offs[at], half * scale)
    moved = float(np.linalg.norm((found - expected[0]) @ axes / sigmas))
    margin = float(np.clip(total[at] - total[far].max(), -0.5, 0.5)) if far.any() else 0.5
    evidence = np.array(
        [*fit, total[at], margin, moved, abs(np.log(scale)), np.log(half.mean() * scale)]
    )
    return Followed(clipped(mark, found[None], there.view.camera), evidence)


def _places(reach_px: float) -> FloatArray:
    """Evenly from -reach to reach, as far as is looked; closely where that is not far."""
    reach = float(np.clip(reach_px, 2.0, _REACH_PX))
    return np.linspace(-reach, reach, 2 * int(np.ceil(reach / 1.5)) + 1)
