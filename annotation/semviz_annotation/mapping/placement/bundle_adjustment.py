"""Bundle adjustment of landmarks and frame poses, with priors on the poses.

Each frame's pose may deviate a little from the given one, its cameras together. All right
images share one offset, as rectified images often need. Points and lines follow Triggs et al.
2000. Each landmark is independent of the others, so landmarks are eliminated first (Schur
complement; Triggs et al. 2000, 6.1). The rest is sparse: frames couple only where they see the
same landmarks.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from semviz_annotation.mapping.placement import reprojection
from semviz_annotation.mapping.placement.landmarks import Landmarks, measure_landmarks
from semviz_annotation.mapping.placement.observations import ObservationArray, ViewArray
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.errors import SemvizError
from semviz_core.common.progress import OnCount, unwatched
from semviz_core.pose_checks.pose_covariance import PoseCovariance

_AT_ONCE = 32
"""Number of landmarks whose covariances are computed together."""


@dataclass(frozen=True, eq=False)
class VisibilityGraph:
    """The p pairs of n landmarks and f frames that see them, sorted by landmark and frame."""

    landmarks: int
    """n"""
    frames: int
    """f"""
    pair: IntArray
    """(k,) pair of each observation, 0 to p - 1"""
    frame: IntArray
    """(p,)"""
    first: IntArray
    """(n + 1,) row of each landmark's first pair, and p"""

    @classmethod
    def of(cls, observations: ObservationArray, frame: IntArray, frames: int) -> "VisibilityGraph":
        """Return the graph of observations in frames (k,), 0 to ``frames`` - 1."""
        keys, pair = np.unique(observations.landmark * frames + frame, return_inverse=True)
        first = np.searchsorted(keys, np.arange(observations.count + 1) * frames)
        return cls(observations.count, frames, pair, keys % frames, first)

    @cached_property
    def landmark(self) -> IntArray:
        """(p,) landmark of each pair"""
        return np.repeat(np.arange(self.landmarks), np.diff(self.first))

    def per_pair(self, values: FloatArray) -> FloatArray:
        """Return the sums (p, ...) of values (k, ...)."""
        return _summed(self.pair, values, len(self.frame))

    def per_frame(self, values: FloatArray) -> FloatArray:
        """Return the sums (f, ...) of values (k, ...)."""
        return _summed(self.frame[self.pair], values, self.frames)

    def matrix(self, blocks: FloatArray) -> bsr_matrix:
        """Return the sparse matrix (6 n, 6 f) of blocks (p, 6, 6)."""
        shape = (6 * self.landmarks, 6 * self.frames)
        return bsr_matrix((blocks, self.frame, self.first), shape=shape)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """One value per unknown: a state, a step, or a gradient."""

    landmarks: FloatArray
    """(n, 6)"""
    frames: FloatArray
    """(f, 6)"""
    shared: float

    def dot(self, other: "Unknowns") -> float:
        """Return the scalar product."""
        landmarks, frames = (
            (self.landmarks * other.landmarks).sum(),
            (self.frames * other.frames).sum(),
        )
        return float(landmarks + frames + self.shared * other.shared)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations with six unknowns per landmark and per frame, and one shared unknown."""

    visibility: VisibilityGraph
    landmarks: FloatArray
    """(n, 6, 6)"""
    frames: FloatArray
    """(f, 6, 6)"""
    shared: float
    between: FloatArray
    """(p, 6, 6) rows by landmark, columns by frame"""
    landmarks_shared: FloatArray
    """(n, 6) coupling of each landmark with the shared unknown"""
    frames_shared: FloatArray
    """(f, 6)"""
    gradient: Unknowns

    def step(self, damping: float) -> Unknowns:
        """Return the Levenberg-Marquardt step.

        With the landmarks eliminated, S frames + w shared = -r and w^T frames + s shared = -q
        remain.
        """
        damped = 1.0 + damping * np.eye(6)
        inverse = np.asarray(np.linalg.inv(self.landmarks * damped))
        Y, S = self._reduced(inverse, self.frames * damped)
        follow = self.visibility.matrix(Y)
        w = self.frames_shared.ravel() - follow.T @ self.landmarks_shared.ravel()
        r = self.gradient.frames.ravel() - follow.T @ self.gradient.landmarks.ravel()
        landmarks_by_shared = _matrix_times_vector(inverse, self.landmarks_shared)
        s = self.shared * (1.0 + damping) - (self.landmarks_shared * landmarks_by_shared).sum()
        q = self.gradient.shared - (self.gradient.landmarks * landmarks_by_shared).sum()
        factors = splu(S.tocsc(), "MMD_AT_PLUS_A", options={"SymmetricMode": True})
        alone, by_shared = factors.solve(np.stack([-r, -w], axis=1)).T
        shared = float(-(q + w @ alone) / (s + w @ by_shared))
        frames = alone + shared * by_shared
        landmarks = (
            -_matrix_times_vector(inverse, self.gradient.landmarks) - shared * landmarks_by_shared
        )
        return Unknowns(
            landmarks=landmarks - (follow @ frames).reshape(-1, 6),
            frames=frames.reshape(-1, 6),
            shared=shared,
        )

    def landmark_covariance(self) -> FloatArray:
        """Return the covariances (n, 6, 6) of landmarks, including the uncertainty of the frames.

        Frames without a common frame with the landmark, and the shared unknown, are taken as exact.
        """
        result = np.asarray(np.linalg.inv(self.landmarks))
        Y, S = self._reduced(result, self.frames)
        S_rows = S.tocsr()
        order = np.argsort(self.visibility.frame[self.visibility.first[:-1]], kind="stable")
        for start in range(0, len(order), _AT_ONCE):  # landmarks near each other share frames
            landmarks = np.sort(order[start : start + _AT_ONCE])
            pairs = np.flatnonzero(np.isin(self.visibility.landmark, landmarks))
            seeing = self.visibility.frame[pairs]
            near = np.unique(
                np.concatenate([_coupled_frames(S, frame) for frame in np.unique(seeing)])
            )
            follow = np.zeros((len(landmarks), 6, len(near), 6))
            row = np.searchsorted(landmarks, self.visibility.landmark[pairs])
            follow[row, :, np.searchsorted(near, seeing)] = Y[pairs]
            flat = follow.reshape(-1, 6 * len(near))
            spread = solve(_blocks(S_rows, near), flat.T, assume_a="pos").T
            wide = (len(landmarks), 6, -1)
            result[landmarks] += flat.reshape(wide) @ spread.reshape(wide).transpose(0, 2, 1)
        return result

    def _reduced(self, landmarks: FloatArray, frames: FloatArray) -> tuple[FloatArray, bsr_matrix]:
        """Return the reduced matrix (6 f, 6 f) of the frames, and how landmarks follow them (p, 6,
        6).

        ``landmarks`` are the inverse information matrices (n, 6, 6) of the eliminated landmarks.
        """
        f = self.visibility.frames
        Y = landmarks[self.visibility.landmark] @ self.between
        alone = bsr_matrix((frames, np.arange(f), np.arange(f + 1)), shape=(6 * f, 6 * f))
        return Y, alone - self.visibility.matrix(self.between).T @ self.visibility.matrix(Y)


def _matrix_times_vector(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the products (n, 6) of matrices (n, 6, 6) and vectors (n, 6)."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _summed(where: IntArray, values: FloatArray, count: int) -> FloatArray:
    ones = np.ones(len(where))
    chooser = csr_matrix((ones, (where, np.arange(len(where)))), shape=(count, len(where)))
    return np.asarray(chooser @ values.reshape(len(values), -1)).reshape(count, *values.shape[1:])


def _coupled_frames(S: bsr_matrix, frame: int) -> IntArray:
    """Return the frames coupled with a frame, including itself."""
    return np.asarray(S.indices[S.indptr[frame] : S.indptr[frame + 1]])


def _six(rows: IntArray) -> IntArray:
    """Return the rows (6 m,) of the unknowns of m frames."""
    return (6 * rows[:, None] + np.arange(6)).ravel()


def _blocks(matrix: csr_matrix, frames: IntArray) -> FloatArray:
    """Return the dense block (6 m, 6 m) of m frames."""
    rows = _six(frames)
    return np.asarray(matrix[rows][:, rows].toarray())


_STEPS = 50
_DONE = 1e-9
"""Converged when a step promises less than this per observation, in multiples of sigma squared."""


@dataclass(frozen=True)
class RefineOptions:
    """Priors of poses, and options of the residuals."""

    place: reprojection.PlaceOptions = field(default_factory=reprojection.PlaceOptions)
    pose_sigma_m: float = 0.01
    """Standard deviation of each frame's position, in each direction."""
    pose_sigma_deg: float = 0.02
    """Standard deviation of each frame's rotation, about each axis."""
    offset_sigma_px: float = 0.5
    """Standard deviation of the common shift of all right images along u."""

    def __post_init__(self) -> None:
        for name in ("pose_sigma_m", "pose_sigma_deg", "offset_sigma_px"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise SemvizError(f"{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class BundleResult:
    """The result of bundle adjustment."""

    views: ViewArray
    """The optimized views; principal points of right images include the offset."""
    placed: Landmarks
    """Landmarks with covariances that include the uncertainty of the poses."""
    frame_index: IntArray
    """(f,) ascending"""
    moved: FloatArray
    """(f, 6) displacement (m) of each frame's camera from the given pose, and rotation vector
    (rad), both along the map's axes"""
    offset_px: float
    """Shift of right images to the right, relative to the calibration."""
    costs: tuple[float, ...]
    """Robust cost including the prior, at the start and after each step."""
    converged: bool


def bundle_adjust(
    views: ViewArray,
    observations: ObservationArray,
    placed: Landmarks,
    options: RefineOptions = RefineOptions(),
    on_progress: OnCount = unwatched,
) -> BundleResult:
    """Optimize the landmarks in ``placed`` that have a position, and the frames of ``views``.

    ``on_progress`` counts steps; there may be fewer. Raise SemvizError if no landmark has a
    position.
    """
    if not placed.ok.any():
        raise SemvizError("no element has a place, so there is nothing to refine; label more views")
    chosen = observations.only(placed.ok)
    problem = BundleProblem(views, chosen, options)
    state = problem.at(problem.start(placed))
    costs, damping, converged = [state.cost], 1e-4, False
    for number in range(_STEPS):
        on_progress(number, _STEPS)
        step = state.normal.step(damping)
        candidate = problem.at(_after(state.at, step))
        better = candidate.cost <= state.cost
        converged = -state.normal.gradient.dot(step) <= _DONE * len(chosen)
        state = candidate if better else state
        costs.append(state.cost)
        damping = float(np.clip(damping * (0.1 if better else 10.0), 1e-9, 1e9))
        if converged:
            break
    refined = problem.views(state.at)
    return BundleResult(
        views=refined,
        placed=_landmarks_at(refined, observations, placed, state, options.place),
        frame_index=problem.frame_index,
        moved=state.at.frames,
        offset_px=state.at.shared,
        costs=tuple(costs),
        converged=converged,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """A state with its cost and normal equations."""

    at: Unknowns
    cost: float
    normal: Normal


class BundleProblem:
    """The observations, and the priors of the poses."""

    def __init__(
        self, views: ViewArray, observations: ObservationArray, options: RefineOptions
    ) -> None:
        self._given, self._observations, self._place = views, observations, options.place
        self.frame_index, first, frame = np.unique(
            views.frame_index, return_index=True, return_inverse=True
        )
        self._frame_of_view = frame
        self.first_view = first
        self._center_m = views.center_m[first]
        self._visibility = VisibilityGraph.of(observations, frame[observations.view], len(first))
        sigmas = [options.pose_sigma_m] * 3 + [float(np.deg2rad(options.pose_sigma_deg))] * 3
        self._by_prior = np.array(sigmas) ** -2.0
        self._by_offset = options.offset_sigma_px**-2.0

    def start(self, placed: Landmarks) -> Unknowns:
        """Return the initial guess: landmarks as placed, frames as given."""
        landmarks = placed.anchor_and_end_m[placed.ok]
        return Unknowns(landmarks, np.zeros((len(self.frame_index), 6)), 0.0)

    def views(self, at: Unknowns) -> ViewArray:
        """Return the views with frames moved as rigid rigs, and right images shifted."""
        given, frame = self._given, self._frame_of_view
        turn = Rotation.from_rotvec(at.frames[:, 3:]).as_matrix()[frame]
        middle, shift = self._center_m[frame], at.frames[frame, :3]
        center = middle + shift + (turn @ (given.center_m - middle)[:, :, None])[:, :, 0]
        R, K = given.R @ turn.transpose(0, 2, 1), given.K.copy()
        K[given.is_right, 0, 2] += at.shared
        return replace(given, R=R, t=-(R @ center[:, :, None])[:, :, 0], K=K)

    def at(self, at: Unknowns) -> _State:
        """Return cost and normal equations of a state."""
        fit = reprojection.residuals(
            self.views(at), self._observations, at.landmarks[:, :3], at.landmarks[:, 3:]
        )
        cost, weights = fit.robust(self._place.sigma_px, self._place.outlier_sigmas)
        prior = (at.frames**2 * self._by_prior).sum() + at.shared**2 * self._by_offset
        return _State(at, float(cost.sum() + prior), self._normal(at, fit, weights))

    def _normal(self, at: Unknowns, fit: reprojection.Residuals, weights: FloatArray) -> Normal:
        observations, visibility = self._observations, self._visibility
        sigma_px = self._place.sigma_px
        by_frame = self.by_frame(at, fit)
        by_offset = np.where(self._given.is_right[observations.view, None], fit.by_u, 0.0)
        weight = weights / sigma_px**2
        landmark_rows = (weight[:, :, None] * fit.J).transpose(0, 2, 1)
        frame_rows = (weight[:, :, None] * by_frame).transpose(0, 2, 1)
        gradient = Unknowns(
            landmarks=observations.per_landmark(
                np.add, _rows_times_values(landmark_rows, fit.error_px)
            ),
            frames=visibility.per_frame(_rows_times_values(frame_rows, fit.error_px))
            + at.frames * self._by_prior,
            shared=(weight * by_offset * fit.error_px).sum() + at.shared * self._by_offset,
        )
        return Normal(
            visibility=visibility,
            landmarks=reprojection.information(observations, fit, weights, sigma_px),
            frames=visibility.per_frame(frame_rows @ by_frame) + np.diag(self._by_prior),
            shared=(weight * by_offset**2).sum() + self._by_offset,
            between=visibility.per_pair(landmark_rows @ by_frame),
            landmarks_shared=observations.per_landmark(
                np.add, _rows_times_values(landmark_rows, by_offset)
            ),
            frames_shared=visibility.per_frame(_rows_times_values(frame_rows, by_offset)),
            gradient=gradient,
        )

    def by_frame(self, at: Unknowns, fit: reprojection.Residuals) -> FloatArray:
        """Return the derivatives (k, 4, 6) of the residuals by the frames' moves.

        A camera that moves by d and turns by w sees a point p at c from it as if that had moved by
        -d - w x (p - c).
        """
        frame = self._frame_of_view[self._observations.view]
        center = self._center_m[frame] + at.frames[frame, :3]
        result = np.zeros_like(fit.J)
        for ends in (slice(0, 3), slice(3, 6)):
            away = at.landmarks[self._observations.landmark, ends] - center
            J = np.where(fit.counts[:, :, None], fit.J[:, :, ends], 0.0)
            result[:, :, :3] -= J
            result[:, :, 3:] += np.cross(J, away[:, None])
        return result


def with_pose_errors(
    views: ViewArray,
    observations: ObservationArray,
    placed: Landmarks,
    options: reprojection.PlaceOptions,
    poses: PoseCovariance,
) -> Landmarks:
    """Return the landmarks, where they are, with covariances that include errors of the poses.

    Each landmark follows the poses of the frames that see it. Frames that are not in ``poses`` are
    exact.
    """
    chosen = observations.only(placed.ok)
    problem = BundleProblem(views, chosen, RefineOptions(options))
    normal = problem.at(problem.start(placed)).normal
    visibility = normal.visibility
    Y = np.linalg.inv(normal.landmarks)[visibility.landmark] @ normal.between
    axes = np.kron(np.eye(2), views.R[problem.first_view].transpose(0, 2, 1))  # camera to map
    Y = Y @ axes[visibility.frame]
    frame_index = problem.frame_index[visibility.frame]
    known = np.isin(frame_index, poses.frame_index)
    covariance = placed.covariance_m2.copy()
    for landmark, place in enumerate(np.flatnonzero(placed.ok).tolist()):
        pairs = slice(visibility.first[landmark], visibility.first[landmark + 1])
        seen = frame_index[pairs][known[pairs]]
        follow = Y[pairs][known[pairs]].transpose(1, 0, 2).reshape(6, -1)
        spread = poses.at(np.searchsorted(poses.frame_index, seen))
        covariance[place] += follow @ spread @ follow.T
    is_point = ~observations.of(observations.is_line)
    covariance[is_point, 3:] = covariance[is_point, :, 3:] = 0.0
    return replace(placed, covariance_m2=covariance)


def _rows_times_values(rows: FloatArray, values: FloatArray) -> FloatArray:
    """Return the products (k, 6) of matrices (k, 6, 4) and vectors (k, 4)."""
    return np.asarray((rows @ values[:, :, None])[:, :, 0])


def _after(at: Unknowns, step: Unknowns) -> Unknowns:
    turn = Rotation.from_rotvec(step.frames[:, 3:]) * Rotation.from_rotvec(at.frames[:, 3:])
    moved = np.concatenate([at.frames[:, :3] + step.frames[:, :3], turn.as_rotvec()], axis=1)
    return Unknowns(at.landmarks + step.landmarks, moved, at.shared + step.shared)


def _landmarks_at(
    views: ViewArray,
    observations: ObservationArray,
    placed: Landmarks,
    state: _State,
    options: reprojection.PlaceOptions,
) -> Landmarks:
    """Return the landmarks at their new positions."""
    X = np.zeros((observations.count, 6))
    X[placed.ok] = state.at.landmarks
    result = measure_landmarks(
        views, observations, X, placed.failure, placed.too_narrow, placed.angle_rad, options
    )
    covariance = state.normal.landmark_covariance()
    is_line = observations.of(observations.is_line)[placed.ok]
    covariance[~is_line, 3:, 3:] = 0.0
    result.covariance_m2[placed.ok] = covariance
    return result
