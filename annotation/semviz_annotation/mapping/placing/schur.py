"""Normal equations of things and the frames that see them, solved by way of the frames alone.

Things are not bound to each other, so they are eliminated first (Triggs et al. 2000, 6.1): what is
left is sparse, as frames are only bound to those that see the same things.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve
from scipy.sparse import bsr_matrix, csr_matrix
from scipy.sparse.linalg import splu

from semviz_annotation.mapping.placing.sightings import Sightings
from semviz_core.arrays import FloatArray, IntArray

_AT_ONCE = 32
"""Things whose covariances are found together."""


@dataclass(frozen=True, eq=False)
class Bonds:
    """Which of f frames see which of n things: p pairs, sorted by thing and frame."""

    things: int
    """n"""
    frames: int
    """f"""
    pair: IntArray
    """(k,) of each sighting, 0 to p - 1"""
    frame: IntArray
    """(p,)"""
    first: IntArray
    """(n + 1,) where each thing's pairs begin, and the last ends"""

    @classmethod
    def of(cls, sightings: Sightings, frame: IntArray, frames: int) -> "Bonds":
        """``frame`` (k,) is that of each sighting, 0 to ``frames`` - 1."""
        keys, pair = np.unique(sightings.thing * frames + frame, return_inverse=True)
        first = np.searchsorted(keys, np.arange(sightings.count + 1) * frames)
        return cls(sightings.count, frames, pair, keys % frames, first)

    @cached_property
    def thing(self) -> IntArray:
        """(p,)"""
        return np.repeat(np.arange(self.things), np.diff(self.first))

    def per_pair(self, values: FloatArray) -> FloatArray:
        """(p, ...) sums of values (k, ...)."""
        return _summed(self.pair, values, len(self.frame))

    def per_frame(self, values: FloatArray) -> FloatArray:
        """(f, ...) sums of values (k, ...)."""
        return _summed(self.frame[self.pair], values, self.frames)

    def matrix(self, blocks: FloatArray) -> bsr_matrix:
        """(6 n, 6 f) with blocks (p, 6, 6)."""
        shape = (6 * self.things, 6 * self.frames)
        return bsr_matrix((blocks, self.frame, self.first), shape=shape)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """A value for each unknown: where things and frames are, a step, or a gradient."""

    things: FloatArray
    """(n, 6)"""
    frames: FloatArray
    """(f, 6)"""
    shared: float

    def dot(self, other: "Unknowns") -> float:
        """Sum of the products."""
        things, frames = (self.things * other.things).sum(), (self.frames * other.frames).sum()
        return float(things + frames + self.shared * other.shared)


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations: six unknowns of each thing and of each frame, and one that all share."""

    bonds: Bonds
    things: FloatArray
    """(n, 6, 6)"""
    frames: FloatArray
    """(f, 6, 6)"""
    shared: float
    between: FloatArray
    """(p, 6, 6) rows by thing, columns by frame"""
    things_shared: FloatArray
    """(n, 6) what binds each thing to the shared unknown"""
    frames_shared: FloatArray
    """(f, 6)"""
    gradient: Unknowns

    def step(self, damping: float) -> Unknowns:
        """Levenberg-Marquardt's.

        Without things, S frames + w shared = -r and w^T frames + s shared = -q are left.
        """
        more = 1.0 + damping * np.eye(6)
        inverse = np.asarray(np.linalg.inv(self.things * more))
        Y, S = self._reduced(inverse, self.frames * more)
        follow = self.bonds.matrix(Y)
        w = self.frames_shared.ravel() - follow.T @ self.things_shared.ravel()
        r = self.gradient.frames.ravel() - follow.T @ self.gradient.things.ravel()
        things_by_shared = _times(inverse, self.things_shared)
        s = self.shared * (1.0 + damping) - (self.things_shared * things_by_shared).sum()
        q = self.gradient.shared - (self.gradient.things * things_by_shared).sum()
        factors = splu(S.tocsc(), "MMD_AT_PLUS_A", options={"SymmetricMode": True})
        alone, by_shared = factors.solve(np.stack([-r, -w], axis=1)).T
        shared = float(-(q + w @ alone) / (s + w @ by_shared))
        frames = alone + shared * by_shared
        things = -_times(inverse, self.gradient.things) - shared * things_by_shared
        return Unknowns(
            things=things - (follow @ frames).reshape(-1, 6),
            frames=frames.reshape(-1, 6),
            shared=shared,
        )

    def things_covariance(self) -> FloatArray:
        """(n, 6, 6) of each thing, the frames' uncertainty included.

        Frames that see nothing of what its frames see, and what all share, are taken as exact.
        """
        result = np.asarray(np.linalg.inv(self.things))
        Y, S = self._reduced(result, self.frames)
        S_rows = S.tocsr()
        order = np.argsort(self.bonds.frame[self.bonds.first[:-1]], kind="stable")
        for start in range(0, len(order), _AT_ONCE):  # things near each other share frames
            things = np.sort(order[start : start + _AT_ONCE])
            pairs = np.flatnonzero(np.isin(self.bonds.thing, things))
            seeing = self.bonds.frame[pairs]
            near = np.unique(np.concatenate([_bound_to(S, one) for one in np.unique(seeing)]))
            follow = np.zeros((len(things), 6, len(near), 6))
            row = np.searchsorted(things, self.bonds.thing[pairs])
            follow[row, :, np.searchsorted(near, seeing)] = Y[pairs]
            flat = follow.reshape(-1, 6 * len(near))
            spread = solve(_blocks(S_rows, near), flat.T, assume_a="pos").T
            wide = (len(things), 6, -1)
            result[things] += flat.reshape(wide) @ spread.reshape(wide).transpose(0, 2, 1)
        return result

    def _reduced(self, things: FloatArray, frames: FloatArray) -> tuple[FloatArray, bsr_matrix]:
        """What is left for frames (6 f, 6 f) once things are eliminated, whose information has the
        inverse ``things``; and (p, 6, 6) how these follow the frames."""
        f = self.bonds.frames
        Y = things[self.bonds.thing] @ self.between
        alone = bsr_matrix((frames, np.arange(f), np.arange(f + 1)), shape=(6 * f, 6 * f))
        return Y, alone - self.bonds.matrix(self.between).T @ self.bonds.matrix(Y)


def _times(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """(n, 6) of matrices (n, 6, 6) and vectors (n, 6)."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def _summed(where: IntArray, values: FloatArray, count: int) -> FloatArray:
    ones = np.ones(len(where))
    chooser = csr_matrix((ones, (where, np.arange(len(where)))), shape=(count, len(where)))
    return np.asarray(chooser @ values.reshape(len(values), -1)).reshape(count, *values.shape[1:])


def _bound_to(S: bsr_matrix, frame: int) -> IntArray:
    """Frames bound to one, itself too."""
    return np.asarray(S.indices[S.indptr[frame] : S.indptr[frame + 1]])


def _six(rows: IntArray) -> IntArray:
    """(6 m,) rows of the unknowns of m."""
    return (6 * rows[:, None] + np.arange(6)).ravel()


def _blocks(matrix: csr_matrix, frames: IntArray) -> FloatArray:
    """(6 m, 6 m) of the m frames."""
    rows = _six(frames)
    return np.asarray(matrix[rows][:, rows].toarray())
