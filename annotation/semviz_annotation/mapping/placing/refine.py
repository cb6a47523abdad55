"""All things and the poses of all frames improved together, under what is known of the poses.

Each frame's pose may move a little from the given one, its cameras as one. All right images may be
shifted by one offset, as rectified images often are. Bundle adjustment (Triggs et al. 2000) with
points and lines.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from semviz_annotation.mapping.placing.least_squares import PlaceOptions, information
from semviz_annotation.mapping.placing.placed import Placed, measured
from semviz_annotation.mapping.placing.residuals import Residuals, residuals
from semviz_annotation.mapping.placing.schur import Bonds, Normal, Unknowns
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import FloatArray, IntArray
from semviz_core.errors import SemvizError

_STEPS = 50
_DONE = 1e-9
"""Settled when a step promises less than this for each sighting, in multiples of sigma squared."""


@dataclass(frozen=True)
class RefineOptions:
    """How far poses may be from the given ones, and how well things were seen."""

    place: PlaceOptions = field(default_factory=PlaceOptions)
    pose_sigma_m: float = 0.01
    """Standard deviation of each frame's place, in each direction."""
    pose_sigma_deg: float = 0.02
    """Standard deviation of its rotation, about each axis."""
    offset_sigma_px: float = 0.5
    """Standard deviation of how far all right images are shifted along u."""

    def __post_init__(self) -> None:
        for name in ("pose_sigma_m", "pose_sigma_deg", "offset_sigma_px"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise SemvizError(f"{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class Refined:
    """What came out."""

    views: Views
    """At the improved poses, and the principal points of right images moved by the offset."""
    placed: Placed
    """With covariances that include the poses' uncertainty."""
    frame_index: IntArray
    """(f,) ascending"""
    moved: FloatArray
    """(f, 6) by how much (m) each frame's camera moved from the given pose, and the rotation vector
    (rad) of its turn; both along the map's axes."""
    offset_px: float
    """By how much right images show everything further to the right than calibrated."""
    costs: tuple[float, ...]
    """Robust, the prior's share included, at the start and after each step."""
    settled: bool


def refine(
    views: Views,
    sightings: Sightings,
    placed: Placed,
    options: RefineOptions = RefineOptions(),
    on_progress: Callable[[int, int], None] = lambda done, of: None,
) -> Refined:
    """Things that ``placed`` has a place for, and the frames of ``views``, from where they are.

    ``on_progress`` counts steps; there may be fewer. Raises SemvizError where nothing has a place.
    """
    if not placed.ok.any():
        raise SemvizError("no element has a place, so there is nothing to refine; label more views")
    chosen = sightings.only(placed.ok)
    problem = Problem(views, chosen, options)
    here = problem.at(problem.start(placed))
    costs, damping, settled = [here.cost], 1e-4, False
    for number in range(_STEPS):
        on_progress(number, _STEPS)
        step = here.normal.step(damping)
        there = problem.at(_after(here.at, step))
        better = there.cost <= here.cost
        settled = -here.normal.gradient.dot(step) <= _DONE * len(chosen)
        here = there if better else here
        costs.append(here.cost)
        damping = float(np.clip(damping * (0.1 if better else 10.0), 1e-9, 1e9))
        if settled:
            break
    refined = problem.views(here.at)
    return Refined(
        views=refined,
        placed=_measured(refined, sightings, placed, here, options.place),
        frame_index=problem.frame_index,
        moved=here.at.frames,
        offset_px=here.at.shared,
        costs=tuple(costs),
        settled=settled,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """Things, frames' moves (as ``Refined.moved``) and the offset, and how well they fit."""

    at: Unknowns
    cost: float
    normal: Normal


class Problem:
    """The sightings, and how far poses may be from the given ones."""

    def __init__(self, views: Views, sightings: Sightings, options: RefineOptions) -> None:
        self._given, self._sightings, self._place = views, sightings, options.place
        self.frame_index, first, frame = np.unique(
            views.frame_index, return_index=True, return_inverse=True
        )
        self._frame_of_view = frame
        self._center_m = views.center_m[first]
        self._bonds = Bonds.of(sightings, frame[sightings.view], len(first))
        sigmas = [options.pose_sigma_m] * 3 + [float(np.deg2rad(options.pose_sigma_deg))] * 3
        self._by_prior = np.array(sigmas) ** -2.0
        self._by_offset = options.offset_sigma_px**-2.0

    def start(self, placed: Placed) -> Unknowns:
        """Things where they were placed, frames where they were given."""
        things = placed.anchor_and_end_m[placed.ok]
        return Unknowns(things, np.zeros((len(self.frame_index), 6)), 0.0)

    def views(self, at: Unknowns) -> Views:
        """The cameras of each frame moved as one, and the images of right ones shifted."""
        given, frame = self._given, self._frame_of_view
        turn = Rotation.from_rotvec(at.frames[:, 3:]).as_matrix()[frame]
        middle, shift = self._center_m[frame], at.frames[frame, :3]
        center = middle + shift + (turn @ (given.center_m - middle)[:, :, None])[:, :, 0]
        R, K = given.R @ turn.transpose(0, 2, 1), given.K.copy()
        K[given.is_right, 0, 2] += at.shared
        return replace(given, R=R, t=-(R @ center[:, :, None])[:, :, 0], K=K)

    def at(self, at: Unknowns) -> _State:
        """Cost and normal equations there."""
        fit = residuals(self.views(at), self._sightings, at.things[:, :3], at.things[:, 3:])
        cost, weights = fit.robust(self._place.sigma_px, self._place.outlier_sigmas)
        prior = (at.frames**2 * self._by_prior).sum() + at.shared**2 * self._by_offset
        return _State(at, float(cost.sum() + prior), self._normal(at, fit, weights))

    def _normal(self, at: Unknowns, fit: Residuals, weights: FloatArray) -> Normal:
        sightings, bonds = self._sightings, self._bonds
        sigma_px = self._place.sigma_px
        by_frame = self.by_frame(at, fit)
        by_offset = np.where(self._given.is_right[sightings.view, None], fit.by_u, 0.0)
        weight = weights / sigma_px**2
        thing_rows = (weight[:, :, None] * fit.J).transpose(0, 2, 1)
        frame_rows = (weight[:, :, None] * by_frame).transpose(0, 2, 1)
        gradient = Unknowns(
            things=sightings.per_thing(np.add, _times(thing_rows, fit.error_px)),
            frames=bonds.per_frame(_times(frame_rows, fit.error_px)) + at.frames * self._by_prior,
            shared=(weight * by_offset * fit.error_px).sum() + at.shared * self._by_offset,
        )
        return Normal(
            bonds=bonds,
            things=information(sightings, fit, weights, sigma_px),
            frames=bonds.per_frame(frame_rows @ by_frame) + np.diag(self._by_prior),
            shared=(weight * by_offset**2).sum() + self._by_offset,
            between=bonds.per_pair(thing_rows @ by_frame),
            things_shared=sightings.per_thing(np.add, _times(thing_rows, by_offset)),
            frames_shared=bonds.per_frame(_times(frame_rows, by_offset)),
            gradient=gradient,
        )

    def by_frame(self, at: Unknowns, fit: Residuals) -> FloatArray:
        """(k, 4, 6) derivatives of the measured rows by the frames' moves.

        A camera that moves by d and turns by w sees a point p at c from it as if that had moved by
        -d - w x (p - c).
        """
        frame = self._frame_of_view[self._sightings.view]
        center = self._center_m[frame] + at.frames[frame, :3]
        result = np.zeros_like(fit.J)
        for ends in (slice(0, 3), slice(3, 6)):
            away = at.things[self._sightings.thing, ends] - center
            J = np.where(fit.counts[:, :, None], fit.J[:, :, ends], 0.0)
            result[:, :, :3] -= J
            result[:, :, 3:] += np.cross(J, away[:, None])
        return result


def _times(rows: FloatArray, values: FloatArray) -> FloatArray:
    """(k, 6) of matrices (k, 6, 4) and vectors (k, 4)."""
    return np.asarray((rows @ values[:, :, None])[:, :, 0])


def _after(at: Unknowns, step: Unknowns) -> Unknowns:
    turn = Rotation.from_rotvec(step.frames[:, 3:]) * Rotation.from_rotvec(at.frames[:, 3:])
    moved = np.concatenate([at.frames[:, :3] + step.frames[:, :3], turn.as_rotvec()], axis=1)
    return Unknowns(at.things + step.things, moved, at.shared + step.shared)


def _measured(
    views: Views, sightings: Sightings, placed: Placed, state: _State, options: PlaceOptions
) -> Placed:
    """Things at their new places."""
    X = np.zeros((sightings.count, 6))
    X[placed.ok] = state.at.things
    result = measured(
        views, sightings, X, placed.failure, placed.too_narrow, placed.angle_rad, options
    )
    covariance = state.normal.things_covariance()
    is_line = sightings.of(sightings.is_line)[placed.ok]
    covariance[~is_line, 3:, 3:] = 0.0
    result.covariance_m2[placed.ok] = covariance
    return result
