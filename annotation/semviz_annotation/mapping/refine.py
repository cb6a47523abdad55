"""All things and the poses of all frames improved together, under what is known of the poses.

Each frame's pose may move a little from the given one: by ``pose_sigma_m`` and ``pose_sigma_deg``.
The cameras of a frame move as one. Bundle adjustment (Triggs et al. 2000) with points and lines.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from semviz_annotation.mapping.least_squares import PlaceOptions, information
from semviz_annotation.mapping.placed import Placed, measured
from semviz_annotation.mapping.residuals import Residuals, residuals
from semviz_annotation.mapping.schur import Bonds, Normal
from semviz_annotation.mapping.sightings import Sightings, Views
from semviz_core.arrays import FloatArray, IntArray

_STEPS = 30
_DONE = 1e-9
"""Settled when a step promises less than this for each sighting, in multiples of sigma squared."""


@dataclass(frozen=True)
class RefineOptions:
    """How far poses may be from the given ones, and how well things were seen."""

    place: PlaceOptions = field(default_factory=PlaceOptions)
    pose_sigma_m: float = 0.05
    """Standard deviation of each frame's place, in each direction."""
    pose_sigma_deg: float = 0.1
    """Standard deviation of its rotation, about each axis."""


@dataclass(frozen=True, eq=False)
class Refined:
    """What came out."""

    views: Views
    """At the improved poses."""
    placed: Placed
    """With covariances that include the poses' uncertainty."""
    frame_index: IntArray
    """(f,) ascending"""
    moved: FloatArray
    """(f, 6) by how much (m) each frame's camera moved from the given pose, and the rotation vector
    (rad) of its turn; both along the map's axes."""
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

    ``on_progress`` counts steps; there may be fewer.
    """
    chosen = sightings.only(placed.ok)
    problem = _Problem(views, chosen, options)
    X = np.concatenate([placed.anchor_m, np.nan_to_num(placed.end_m)], axis=1)[placed.ok]
    here = problem.at(X, np.zeros((len(problem.frame_index), 6)))
    costs, damping, settled = [here.cost], 1e-4, False
    for number in range(_STEPS):
        on_progress(number, _STEPS)
        step = here.normal.step(damping)
        promised = -sum((g * s).sum() for g, s in zip(here.normal.gradients, step, strict=True))
        there = problem.at(here.X + step[0], _turned_on(here.moved, step[1]))
        if there.cost <= here.cost:
            here = there
        costs.append(here.cost)
        damping = float(np.clip(damping * (0.1 if there is here else 10.0), 1e-9, 1e9))
        if promised <= _DONE * len(chosen):
            settled = True
            break
    refined = problem.views(here.moved)
    return Refined(
        views=refined,
        placed=_measured(refined, sightings, placed, here, options.place),
        frame_index=problem.frame_index,
        moved=here.moved,
        costs=tuple(costs),
        settled=settled,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """Things and frames somewhere."""

    X: FloatArray
    """(n, 6) anchor and end of each thing"""
    moved: FloatArray
    """(f, 6) as ``Refined.moved``"""
    cost: float
    normal: Normal


class _Problem:
    """The sightings, and how far poses may be from the given ones."""

    def __init__(self, views: Views, sightings: Sightings, options: RefineOptions) -> None:
        self._given, self._sightings, self._options = views, sightings, options
        self.frame_index, first, frame = np.unique(
            views.frame_index, return_index=True, return_inverse=True
        )
        self._frame_of_view = frame
        self._center_m = views.center_m[first]
        self._bonds = Bonds.of(sightings, frame[sightings.view], len(first))
        sigmas = [options.pose_sigma_m] * 3 + [float(np.deg2rad(options.pose_sigma_deg))] * 3
        self._prior = np.array(sigmas) ** -2.0

    def views(self, moved: FloatArray) -> Views:
        """The cameras of each frame moved by (f, 6) as one."""
        given, frame = self._given, self._frame_of_view
        turn = Rotation.from_rotvec(moved[:, 3:]).as_matrix()[frame]
        middle = self._center_m[frame]
        center = (turn @ (given.center_m - middle)[:, :, None])[:, :, 0] + middle + moved[frame, :3]
        R = given.R @ turn.transpose(0, 2, 1)
        return replace(given, R=R, t=-(R @ center[:, :, None])[:, :, 0])

    def at(self, X: FloatArray, moved: FloatArray) -> _State:
        """Cost and normal equations with things at X (n, 6) and frames moved by (f, 6)."""
        sigma_px, bonds = self._options.place.sigma_px, self._bonds
        at = residuals(self.views(moved), self._sightings, X[:, :3], X[:, 3:])
        cost, weights = at.robust(sigma_px, self._options.place.outlier_sigmas)
        by_frame = self._by_frame(at, X, moved)
        weighted = weights[:, :, None] * at.J / sigma_px**2
        frame_weighted = weights[:, :, None] * by_frame / sigma_px**2
        pull = (weighted.transpose(0, 2, 1) @ at.error_px[:, :, None])[:, :, 0]
        frame_pull = (frame_weighted.transpose(0, 2, 1) @ at.error_px[:, :, None])[:, :, 0]
        frames = bonds.per_frame(frame_weighted.transpose(0, 2, 1) @ by_frame)
        normal = Normal(
            bonds=bonds,
            things=information(self._sightings, at, weights, sigma_px),
            frames=frames + np.diag(self._prior),
            between=bonds.per_pair(weighted.transpose(0, 2, 1) @ by_frame),
            things_gradient=self._sightings.per_thing(np.add, pull),
            frames_gradient=bonds.per_frame(frame_pull) + moved * self._prior,
        )
        return _State(X, moved, float(cost.sum() + (moved**2 * self._prior).sum()), normal)

    def _by_frame(self, at: Residuals, X: FloatArray, moved: FloatArray) -> FloatArray:
        """(k, 4, 6) derivatives of the measured rows by the frames' moves.

        A camera that moves by d and turns by w sees a point p at c from it as if that had moved by
        -d - w x (p - c).
        """
        frame = self._frame_of_view[self._sightings.view]
        center = self._center_m[frame] + moved[frame, :3]
        result = np.zeros_like(at.J)
        for ends in (slice(0, 3), slice(3, 6)):
            away = X[self._sightings.thing, ends] - center
            J = np.where(at.counts[:, :, None], at.J[:, :, ends], 0.0)
            result[:, :, :3] -= J
            result[:, :, 3:] += np.cross(J, away[:, None])
        return result


def _turned_on(moved: FloatArray, step: FloatArray) -> FloatArray:
    """Moves (f, 6) after another (f, 6)."""
    turn = Rotation.from_rotvec(step[:, 3:]) * Rotation.from_rotvec(moved[:, 3:])
    return np.concatenate([moved[:, :3] + step[:, :3], turn.as_rotvec()], axis=1)


def _measured(
    views: Views, sightings: Sightings, placed: Placed, state: _State, options: PlaceOptions
) -> Placed:
    X = np.zeros((sightings.count, 6))
    X[placed.ok] = state.X
    result = measured(
        views, sightings, X, placed.failure, placed.too_narrow, placed.angle_rad, options
    )
    result.covariance_m2[placed.ok] = state.normal.things_covariance()
    points = ~sightings.of(sightings.is_line)
    result.covariance_m2[points, 3:] = 0.0
    result.covariance_m2[points, :, 3:] = 0.0
    return result
