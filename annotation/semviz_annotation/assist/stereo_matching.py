"""Correspondence of a mark in another image, searched along epipolar lines at plausible depths.

Detections of two images are matched by the same geometry, without image content.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semviz_annotation.assist import appearance
from semviz_annotation.assist.expected_position import SIGMA_PX, expected_px, spread_px2
from semviz_annotation.assist.marked_image import Mark, MarkedImage, ProposedMark, clip_to_image
from semviz_annotation.assist.score import probability
from semviz_annotation.labels.proposal import Proposal
from semviz_annotation.labels.views import PLAUSIBLE_DEPTH_M, PosedView
from semviz_annotation.mapping.placement.triangulation import Triangulated
from semviz_core.base.classes import ElementClass
from semviz_core.common.arrays import BoolArray, FloatArray
from semviz_core.subpixel.pole_axis import across, edge_support
from semviz_core.subpixel.sampling import Samples

_STEP_PX = 1.0
_MAX_CANDIDATES = 3
_APART_PX = 3.0
_MAX_PRIOR = 2.0
"""Largest penalty of an element's known position, in squares of 3 sigma."""
_LEAN = 0.05
"""Largest inclination (rad) of a pole towards the camera, or of the camera."""


@dataclass(frozen=True)
class ImageCorrespondences:
    """Proposed correspondences of a mark in another image."""

    best: ProposedMark
    runner_up: ProposedMark | None
    """The next best at another depth."""


@dataclass(frozen=True, eq=False)
class MatchCandidate:
    """A possible correspondence with its evidence."""

    mark: Mark
    ends_px: FloatArray
    evidence: FloatArray


def find_correspondence(
    source: MarkedImage,
    target: MarkedImage,
    mark: Mark,
    element_class: ElementClass,
    element: Triangulated | None = None,
) -> ImageCorrespondences | None:
    """Return the correspondence in ``target`` of a mark in ``source``; None if it is not visible.

    The views share one map frame: two cameras of a rig, or two frames of one camera. Poles are
    assumed to be nearly upright; ``element`` is the position of the element, if it is known.
    """
    matches = candidates(source, target, mark, element_class, element)
    if not matches:
        return None
    what = "stereo pole" if mark.end_px is not None else "stereo sign"
    scored = sorted(
        (ProposedMark(match.mark, probability(what, match.evidence)) for match in matches),
        key=lambda proposal: -proposal.score,
    )
    return ImageCorrespondences(scored[0], scored[1] if len(scored) > 1 else None)


def candidates(
    source: MarkedImage,
    target: MarkedImage,
    mark: Mark,
    element_class: ElementClass,
    element: Triangulated | None = None,
) -> list[MatchCandidate]:
    """Return the most likely correspondences, at distinct positions."""
    ends = mark.ends_px
    depths = appearance.inverse_depths(
        source.view, target.view, ends.mean(axis=0), PLAUSIBLE_DEPTH_M, _STEP_PX
    )
    if not len(depths):
        return []
    places = appearance.transfer(source.view, target.view, ends, depths)  # (d, ends, 2)
    inside = np.isfinite(places).all(axis=(1, 2))
    inside &= target.view.camera.contains(np.nan_to_num(places.mean(axis=1), nan=-9.0))
    depths, places = depths[inside], places[inside]
    if len(depths) < 2:
        return []
    prior = np.zeros(len(depths)) if element is None else _prior(target, element, mark, places)
    if len(ends) == 2:
        return _poles(source, target, mark, depths, places, prior)
    return _signs(source, target, mark, element_class, depths, places, prior)


def _prior(
    target: MarkedImage, element: Triangulated, mark: Mark, places: FloatArray
) -> FloatArray:
    """Return the log-prior (d,) of ``places`` given an element's position; 0 is the maximum."""
    expected = expected_px(element, target.view)
    if expected is None:
        return np.zeros(len(places))
    spread = spread_px2(element, [target.view], SIGMA_PX)[0, :, :, 0]
    axes = across(expected)[None] if mark.end_px is not None else np.eye(2)
    off = (places - expected).mean(axis=1) @ axes.T
    covariance = axes @ np.einsum("aiaj->ij", spread) / len(expected) @ axes.T
    pull = np.einsum("di,ij,dj->d", off, np.linalg.inv(covariance), off)
    return np.asarray(-0.5 * np.minimum(pull / 9.0, _MAX_PRIOR))


# -- poles


def _poles(
    source: MarkedImage,
    target: MarkedImage,
    mark: Mark,
    depths: FloatArray,
    places: FloatArray,
    prior: FloatArray,
) -> list[MatchCandidate]:
    width = appearance.pole_width(source, mark.ends_px)
    points = appearance.pole_points(mark.ends_px, width)
    patch = source.sample(points)
    alike = appearance.similarity(patch, _patches(source, target, points, mark.ends_px, depths))
    total = alike @ appearance.SIMILARITY_WEIGHTS + prior
    lines = []
    for at in _peaks(total, places):
        lean = _lean_px(source, target, mark.ends_px, depths[at])
        lines.append((at, appearance.align_pole(patch, target, places[at], width, lean)))
    return _match_candidates(source, target, mark, patch, width, depths, places, total, lines)


def _match_candidates(
    source: MarkedImage,
    target: MarkedImage,
    mark: Mark,
    patch: Samples,
    width: float,
    depths: FloatArray,
    places: FloatArray,
    total: FloatArray,
    lines: list[tuple[int, FloatArray]],
) -> list[MatchCandidate]:
    result: list[MatchCandidate] = []
    order = [total[at] for at, _ in lines]
    for n, (at, line) in enumerate(lines):
        ends = _on_epipolar_lines(source, target, mark, line, places[at], depths[at])
        alike = appearance.similarity(patch, appearance.pole_patch(target, ends, width)[None])[0]
        other_totals = [other_total for k, other_total in enumerate(order) if k != n]
        margin = order[n] - max(other_totals) if other_totals else 0.5
        moved = float(np.abs(line - places[at]).max())
        evidence = np.array(
            [
                *alike, *edge_support(target, ends, width), total[at], np.clip(margin, -0.5, 0.5),
                moved, np.log(width),
            ]
        )  # fmt: skip
        result.append(MatchCandidate(clip_to_image(mark, ends, target.view.camera), ends, evidence))
    return result


def _lean_px(
    source: MarkedImage, target: MarkedImage, ends_px: FloatArray, depth_m: float
) -> float:
    """Return by how much a pole's ends may move differently due to its inclination."""
    length_m = np.linalg.norm(np.diff(source.view.camera.normalize(ends_px), axis=0)) * depth_m
    depths = depth_m + _LEAN * length_m * np.array([-0.5, 0.5])
    places = appearance.transfer(source.view, target.view, ends_px.mean(axis=0)[None], depths)[:, 0]
    return float(np.linalg.norm(places[1] - places[0]))


def _on_epipolar_lines(
    source: MarkedImage,
    target: MarkedImage,
    mark: Mark,
    line: FloatArray,
    place: FloatArray,
    depth_m: float,
) -> FloatArray:
    """Return the ends (2, 2) on a line, at the intersections with their epipolar lines."""
    ends = place.copy()
    for k in range(2):
        at = appearance.depth_on_line(source.view, target.view, mark.ends_px[k], line, depth_m)
        if at is None:  # the epipolar line runs along the pole
            along = line[1] - line[0]
            ends[k] = line[0] + along * ((place[k] - line[0]) @ along) / (along @ along)
        else:
            ends[k] = at
    return ends


# -- signs


def _signs(
    source: MarkedImage,
    target: MarkedImage,
    mark: Mark,
    element_class: ElementClass,
    depths: FloatArray,
    places: FloatArray,
    prior: FloatArray,
) -> list[MatchCandidate]:
    half = appearance.sign_half_size(source, mark.ends_px[0], element_class)
    points = appearance.sign_points(mark.ends_px[0], half)
    patch = source.sample(points)
    alike = appearance.similarity(patch, _patches(source, target, points, mark.ends_px[:1], depths))
    total = alike @ appearance.SIMILARITY_WEIGHTS + prior
    peaks = _peaks(total, places)
    result = []
    for n, at in enumerate(peaks):
        scale = _scale(source, target, mark.ends_px[0], depths[at])
        place, fit = appearance.align_sign(patch, target, places[at, 0], half * scale)
        other_totals = [total[peak] for k, peak in enumerate(peaks) if k != n]
        margin = total[at] - max(other_totals) if other_totals else 0.5
        moved = float(np.linalg.norm(place - places[at, 0]))
        evidence = np.array(
            [*fit, total[at], np.clip(margin, -0.5, 0.5), moved, np.log(half.mean())]
        )
        matched = clip_to_image(mark, place[None], target.view.camera)
        result.append(MatchCandidate(matched, place[None], evidence))
    return result


def _scale(source: MarkedImage, target: MarkedImage, pixel_px: FloatArray, depth_m: float) -> float:
    """Return the magnification from ``source`` to ``target`` at a pixel's depth."""
    beside = pixel_px + np.array([[-2.0, 0.0], [2.0, 0.0]])
    beside_there = appearance.transfer(source.view, target.view, beside, np.array([depth_m]))[0]
    return float(np.clip(np.linalg.norm(beside_there[1] - beside_there[0]) / 4.0, 0.3, 3.0))


# -- both


def _patches(
    source: MarkedImage,
    target: MarkedImage,
    points: FloatArray,
    ends: FloatArray,
    depths: FloatArray,
) -> Samples:
    """Return the colours (d, rows, columns, 3) of points (rows, columns, 2) at d depths."""
    rows, columns = points.shape[:2]
    corners = points[[0, 0, -1, -1], [0, -1, 0, -1]]
    moved = appearance.transfer(source.view, target.view, corners, depths)  # (d, 4, 2)
    moved = np.nan_to_num(moved, nan=-9.0)
    v = np.linspace(0.0, 1.0, rows)[:, None, None]
    u = np.linspace(0.0, 1.0, columns)[:, None]
    a, b, c, d = (moved[:, None, None, k] for k in range(4))
    at = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    return target.sample(at.reshape(-1, columns, 2)).reshape(len(depths), rows, columns, 3)


def _peaks(total: FloatArray, places: FloatArray) -> list[int]:
    """Return the best local maxima with a minimum distance from each other."""
    padded = np.concatenate([[-np.inf], total, [-np.inf]])
    peak = (total >= padded[:-2]) & (total >= padded[2:])
    peaks: list[int] = []
    for at in np.flatnonzero(peak)[np.argsort(-total[peak], kind="stable")]:
        apart = [np.linalg.norm(places[at] - places[peak], axis=1).min() for peak in peaks]
        if not peaks or min(apart) > _APART_PX:
            peaks.append(int(at))
        if len(peaks) == _MAX_CANDIDATES:
            break
    return peaks


_SIGMAS = 3.0
_LEAST_PX, _LEAST_ALONG_PX = 1.0, 3.0
"""Lower bounds of standard deviations: poles lean, and their ends are not clear."""
_MOST_PX = 6.0
"""Upper bound of standard deviations."""


def stereo_pairs(
    source: PosedView,
    target: PosedView,
    sources: Sequence[Proposal],
    targets: Sequence[Proposal],
) -> list[tuple[int, int]]:
    """Return the pairs of indices in ``sources`` and ``targets`` that are one element.

    Both are of one class, agree within 3 sigma at some plausible depth, and agree with no other
    proposal. The views share one frame.
    """
    if not sources or not targets:
        return []
    agree = stereo_residuals(source, target, sources, targets) <= 1.0
    alone = agree & (agree.sum(axis=0) == 1) & (agree.sum(axis=1) == 1)[:, None]
    return [(int(row), int(column)) for row, column in np.argwhere(alone)]


def stereo_residuals(
    source: PosedView,
    target: PosedView,
    sources: Sequence[Proposal],
    targets: Sequence[Proposal],
) -> FloatArray:
    """Return the residuals (n, m) of all pairs at their best depths, in units of 3 sigma.

    Infinite for different classes, and if no plausible depth maps one to the other.
    """
    starts = np.array([_ends(proposal) for proposal in sources])  # (n, 2, 2)
    middle = starts.mean(axis=(0, 1))
    depths = appearance.inverse_depths(source, target, middle, PLAUSIBLE_DEPTH_M, _STEP_PX)
    result = np.full((len(sources), len(targets)), np.inf)
    if not len(depths):
        return result
    places = appearance.transfer(source, target, starts.reshape(-1, 2), depths)
    places = places.reshape(len(depths), len(sources), 2, 2)
    for class_id in {proposal.class_id for proposal in sources} & {
        proposal.class_id for proposal in targets
    }:
        rows, columns = (
            [n for n, proposal in enumerate(proposals) if proposal.class_id == class_id]
            for proposals in (sources, targets)
        )
        first = _Marks.of([sources[n] for n in rows])
        second = _Marks.of([targets[n] for n in columns])
        near = _pole_residuals if second.is_line else _sign_residuals
        result[np.ix_(rows, columns)] = near(first, second, places[:, rows])
    return result


@dataclass(frozen=True, eq=False)
class _Marks:
    """Proposals of one class in one image."""

    ends_px: FloatArray
    """(n, 2, 2); both ends of a sign are its centre."""
    known: BoolArray
    """(n, 2)"""
    sigma_px: FloatArray
    """(n, 2) across and along."""
    is_line: bool

    @classmethod
    def of(cls, proposals: Sequence[Proposal]) -> "_Marks":
        return cls(
            ends_px=np.array([_ends(proposal) for proposal in proposals]),
            known=np.array([(proposal.anchor_known, proposal.end_known) for proposal in proposals]),
            sigma_px=np.array(
                [
                    (proposal.sigma_px, proposal.sigma_along_px or proposal.sigma_px)
                    for proposal in proposals
                ]
            ),
            is_line=proposals[0].end_px is not None,
        )


def _sign_residuals(first: _Marks, second: _Marks, places: FloatArray) -> FloatArray:
    """Return residuals (n, m) of ``places`` (d, n, 2, 2), the first at each depth, to the
    second."""
    off_px = np.linalg.norm(places[:, :, None, 0] - second.ends_px[:, 0], axis=3)
    return _least(off_px / _tolerance_px(first, second, 0, _LEAST_PX))


def _pole_residuals(first: _Marks, second: _Marks, places: FloatArray) -> FloatArray:
    """Return residuals of poles: across the lines and, for known ends, along them."""
    steps = second.ends_px[:, 1] - second.ends_px[:, 0]
    length = np.maximum(np.linalg.norm(steps, axis=1), 1e-9)
    along = steps / length[:, None]  # (m, 2)
    gaps = places[:, :, None] - second.ends_px[:, None, 0]  # (d, n, m, 2, 2)
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)[:, None]
    off_px = np.abs((gaps * across).sum(axis=4)).max(axis=3)  # (d, n, m)
    off = off_px / _tolerance_px(first, second, 0, _LEAST_PX)
    reached = (gaps * along[:, None]).sum(axis=4)  # (d, n, m, 2) from their peaks
    both_known = first.known[:, None] & second.known  # (n, m, 2)
    miss = np.abs(reached - np.stack([np.zeros_like(length), length], axis=1))
    miss = np.where(both_known, miss, 0.0).max(axis=3)
    off = np.maximum(off, miss / _tolerance_px(first, second, 1, _LEAST_ALONG_PX))
    beside = np.minimum(reached.max(axis=3), length) > np.maximum(reached.min(axis=3), 0.0)
    return _least(np.where(beside, off, np.inf))


def _least(off: FloatArray) -> FloatArray:
    """Return the minimum (n, m) of (d, n, m), ignoring NaN (behind a camera)."""
    return np.asarray(np.where(np.isfinite(off), off, np.inf).min(axis=0))


def _tolerance_px(first: _Marks, second: _Marks, axis: int, least_px: float) -> FloatArray:
    """Return tolerances (n, m)."""
    first_px, second_px = (
        np.clip(each.sigma_px[:, axis], least_px, _MOST_PX) for each in (first, second)
    )
    return _SIGMAS * np.hypot(first_px[:, None], second_px)


def _ends(proposal: Proposal) -> FloatArray:
    """Return the ends (2, 2); both ends of a sign are its centre."""
    return np.array([proposal.anchor_px, proposal.end_px or proposal.anchor_px])
