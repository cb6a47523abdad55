"""Corrections of drives by the landmarks that they share: one sparse least-squares problem.

Each element measures its landmark: landmark = element + design @ corrections + noise, with the
element's own covariance. Landmarks are eliminated, so the unknowns are the corrections alone.
Elements that fit badly count less (Cauchy's weights).

The equations are never written down: m drives that pass a landmark would each meet the m - 1
others. Conjugate gradients multiply by them in a time that grows with the elements alone, and need
as many steps however many drives pass (``_System.preconditioner``).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from semviz_annotation.mapping.drives.corrections import PoseModel
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray, unit_vectors

if TYPE_CHECKING:
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import LinearOperator

_ALONG_M = 5.0
"""Sigma along a pole of an end that no view shows: what was seen of it is no end."""
LEAST_M = 0.01
"""Least sigma of an element, in each direction."""
_CAUCHY = 3.0
_MEDIAN_CHI2 = 2.0 * np.log(2.0)
"""Of two degrees of freedom."""
_STEPS = 4
_SYMMETRIC: dict[str, Any] = {
    "permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True},
}  # fmt: skip
"""Without it, factors have many times as many entries."""
_TOLERANCE = 1e-6
"""Of the residual, as a share of the right side."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Corrected elements, and the landmarks that they measure."""

    correction: FloatArray
    """(k, 4) of the knots: x, y, z (m), turn (rad)."""
    ends_m: FloatArray
    """(n, 6) corrected elements; 0 for a sign's end."""
    landmark_m: FloatArray
    """(l, 6) anchor and end; 0 for a sign's end."""
    covariance_m2: FloatArray
    """(l, 6, 6) of landmarks where their drives are corrected as estimated: errors that a whole
    stretch shares are not in it."""

    def scatter_m(self, landmark: IntArray, variance_m2: FloatArray) -> float:
        """Return the sigma, in each direction on the ground, by which elements scatter about their
        landmarks (n,) beyond what their variances (n,) explain; 0 if no landmark has two."""
        count = np.bincount(landmark)[landmark]
        off_m2 = ((self.ends_m - self.landmark_m[landmark])[:, :2] ** 2).sum(axis=1)
        shared = count > 1
        if not shared.any():
            return 0.0
        free = (1.0 - 1.0 / count[shared]) * _MEDIAN_CHI2
        excess_m2 = np.median(off_m2[shared] / free) - np.median(variance_m2[shared])
        return float(np.sqrt(max(excess_m2, 0.0)))

    def chi2(self, information: FloatArray, landmark: IntArray) -> FloatArray:
        """Return the squared misfit (n,) of each element to its landmark (n,), in sigmas."""
        off = self.ends_m - self.landmark_m[landmark]
        return np.asarray(np.einsum("ni,nij,nj->n", off, information, off))


def information_of(
    ends_m: FloatArray,
    covariance_m2: FloatArray,
    is_line: BoolArray,
    known: BoolArray,
    scatter_m: FloatArray,
) -> FloatArray:
    """Return the information (n, 6, 6) of elements (n, 6).

    An unknown end tells nothing along its pole, a sign nothing of an end. ``known`` is (n, 2).
    ``scatter_m`` (n,) is the sigma, in each direction, of what moves an element as a whole and is
    neither in its covariance nor a correction of its drive.
    """
    axis = unit_vectors(np.nan_to_num(ends_m[:, :3] - ends_m[:, 3:]))
    along_m2 = np.einsum("ni,nj->nij", axis, axis) * _ALONG_M**2
    whole_m2 = scatter_m[:, None, None] ** 2 * np.kron(np.ones((2, 2)), np.eye(3))
    spread_m2 = covariance_m2 + whole_m2 + LEAST_M**2 * np.eye(6)
    for end, rows in enumerate((slice(0, 3), slice(3, 6))):
        is_open = is_line & ~known[:, end]
        spread_m2[:, rows, rows] += along_m2 * is_open[:, None, None]
    spread_m2[~is_line, :3, 3:] = spread_m2[~is_line, 3:, :3] = 0.0
    information = np.linalg.inv(spread_m2)
    information[~is_line, 3:, 3:] = 0.0
    return np.asarray(information)


def align(
    ends_m: FloatArray, information: FloatArray, model: PoseModel, landmark: IntArray
) -> Alignment:
    """Return the corrections that bring the elements (n, 6) of each landmark (n,) together.

    ``information`` is (n, 6, 6). Landmarks count from 0.
    """
    start_m, sums = np.nan_to_num(ends_m), _sums_of(landmark)
    middle_m = (sums @ start_m) / sums.sum(axis=1)[:, None]
    offset_m = start_m - middle_m[landmark]
    weight, precondition, c = np.ones(len(ends_m)), None, None
    for _ in range(_STEPS):
        system = _System.of(information * weight[:, None, None], model, landmark, sums)
        precondition = precondition or system.preconditioner()  # near enough for other weights
        c = system.solved(offset_m, precondition, c)
        moved_m = (model.design @ c).reshape(-1, 6)
        landmark_m = middle_m + system.mean(offset_m + moved_m)
        result = Alignment(c.reshape(-1, 4), start_m + moved_m, landmark_m, system.covariance_m2)
        weight = 1.0 / (1.0 + result.chi2(information, landmark) / _CAUCHY**2)
    return result


@dataclass(frozen=True, eq=False)
class _System:
    """The normal equations of the corrections c: elements x with information W move by A c and
    measure their landmarks y = (sum W)^-1 sum W (x + A c), which are eliminated."""

    information: FloatArray
    """(n, 6, 6)"""
    covariance_m2: FloatArray
    """(l, 6, 6)"""
    model: PoseModel
    landmark: IntArray
    sums: "csr_array"
    """(l, n) adds up the elements of each landmark."""

    @classmethod
    def of(
        cls, information: FloatArray, model: PoseModel, landmark: IntArray, sums: "csr_array"
    ) -> "_System":
        total = (sums @ information.reshape(-1, 36)).reshape(-1, 6, 6)
        covariance_m2 = np.linalg.inv(total + np.eye(6) * (total == 0.0))
        return cls(information, covariance_m2, model, landmark, sums)

    def mean(self, offset_m: FloatArray) -> FloatArray:
        """Return the landmarks (l, 6) of elements (n, 6)."""
        return _times(self.covariance_m2, self.sums @ _times(self.information, offset_m))

    def pull(self, offset_m: FloatArray) -> FloatArray:
        """Return the gradient (4k,) where elements are off by (n, 6)."""
        off_m = offset_m - self.mean(offset_m)[self.landmark]
        return np.asarray(self.model.design.T @ _times(self.information, off_m).ravel())

    def solved(
        self, offset_m: FloatArray, precondition: "LinearOperator", start: FloatArray | None
    ) -> FloatArray:
        """Return the corrections (4k,), searched from ``start``."""
        from scipy.sparse.linalg import LinearOperator, cg

        def product(c: FloatArray) -> FloatArray:
            by_elements = self.pull((self.model.design @ c).reshape(-1, 6))
            return np.asarray(self.model.prior @ c + by_elements)

        matrix = LinearOperator(precondition.shape, matvec=product, dtype=np.float64)
        right = -self.pull(offset_m)
        return np.asarray(cg(matrix, right, start, rtol=_TOLERANCE, M=precondition)[0])

    def preconditioner(self) -> "LinearOperator":
        """Return the sum of two approximate inverses: each drive corrected while the others
        stay, and all that pass a place corrected alike.

        The second one keeps the number of steps small: landmarks tell nothing of an error that all
        drives share, but to each drive alone it looks well known.
        """
        from scipy.sparse import csr_array, eye_array, kron
        from scipy.sparse.linalg import LinearOperator, splu

        design, prior, together = self.model.design, self.model.prior, self.model.together
        others = self.information @ self.covariance_m2[self.landmark] @ self.information
        own = prior + design.T @ (_blocks(self.information - others) @ design)

        moved = design @ together
        pulled = _blocks(self.information) @ moved
        by_landmark = csr_array(kron(self.sums, eye_array(6))) @ pulled
        alike = together.T @ prior @ together + moved.T @ pulled
        alike -= by_landmark.T @ (_blocks(self.covariance_m2) @ by_landmark)

        drives, places = (splu(each.tocsc(), **_SYMMETRIC) for each in (own, alike))

        def product(pull: FloatArray) -> FloatArray:
            return np.asarray(drives.solve(pull) + together @ places.solve(together.T @ pull))

        return LinearOperator(prior.shape, matvec=product, dtype=np.float64)


def _times(blocks: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the products (n, 6) of blocks (n, 6, 6) and vectors (n, 6)."""
    return np.asarray(np.einsum("nij,nj->ni", blocks, vectors))


def _sums_of(landmark: IntArray) -> "csr_array":
    """Return the matrix (l, n) that adds up the elements of each landmark."""
    from scipy.sparse import csr_array

    count, number = int(landmark.max(initial=-1)) + 1, np.arange(len(landmark))
    return csr_array((np.ones(len(landmark)), (landmark, number)), (count, len(landmark)))


def _blocks(blocks: FloatArray) -> "csr_array":
    """Return the block-diagonal matrix of (n, 6, 6)."""
    from scipy.sparse import bsr_array

    n = len(blocks)
    return bsr_array((blocks, np.arange(n), np.arange(n + 1)), (6 * n, 6 * n)).tocsr()
