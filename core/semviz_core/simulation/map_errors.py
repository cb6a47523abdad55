"""Add errors to a true map: the benchmark's errors, or one planted fault.

The benchmark's errors are noise and missing, obsolete and duplicated elements.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from semviz_core.base.elements import Elements3D, joined
from semviz_core.base.semantic_map import SemanticMap
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError

MISSING_SHARE = 0.05
DUPLICATED_SHARE = 0.03
OBSOLETE_SHARE = 0.05
OBSOLETE_M = 8.0
DUPLICATE_NOISE = 3.0
DEPTH_SIGMA_M = 0.10
"""Along the line of sight from which an element was mapped."""
SIDE_SIGMA_M = 0.02
"""Across it and vertically."""
DIRECTION_SIGMA_RAD = float(np.deg2rad(0.27))
MAPPED_FROM_M = 15.0


def with_errors(truth: SemanticMap, seed: int) -> SemanticMap:
    """Return a map with noise and with missing, obsolete and duplicated elements.

    Ids stay those of the truth; a duplicate gets a new one above all others. Covariances match the
    noise, but do not include obsolete and duplicated elements.
    """
    rng = np.random.default_rng(seed)
    true = truth.elements
    covariance = _covariance(true, _mapping_view(true, truth.trajectory_m))
    noisy = _noisy(true, covariance, 1.0, rng)
    copies = _noisy(true, covariance, DUPLICATE_NOISE, rng)
    noisy = _displaced(noisy, rng.random(len(true)) < OBSOLETE_SHARE, rng)
    kept = rng.random(len(true)) >= MISSING_SHARE
    copied = np.flatnonzero(kept & (rng.random(len(true)) < DUPLICATED_SHARE))
    new_ids = true.id.max(initial=0) + 1 + np.arange(len(copied))
    elements = joined(noisy[kept], _with(copies[copied], id=new_ids))
    return replace(truth, elements=elements, provenance=(), made_by=f"{truth.made_by}, seed {seed}")


def move_element(semantic_map: SemanticMap, element_id: int, by_m: ArrayLike) -> SemanticMap:
    """Return the map with one element shifted by a vector (3,)."""
    rows = _rows_of(semantic_map, element_id)
    old, by = semantic_map.elements, np.asarray(by_m, dtype=np.float64)
    anchor = old.anchor_m + rows[:, None] * by
    end = old.end_m + rows[:, None] * by
    return replace(semantic_map, elements=_with(old, anchor_m=anchor, end_m=end))


def duplicate_element(semantic_map: SemanticMap, element_id: int, by_m: ArrayLike) -> SemanticMap:
    """Return the map with a copy of one element, shifted by (3,), under the next free id."""
    rows = _rows_of(semantic_map, element_id)
    old = semantic_map.elements
    copy = _with(old[rows], id=np.array([old.id.max() + 1]))
    by = np.asarray(by_m, dtype=np.float64)
    copy = _with(copy, anchor_m=copy.anchor_m + by, end_m=copy.end_m + by)
    provenance = semantic_map.provenance
    if provenance:
        provenance = (*provenance, provenance[int(np.flatnonzero(rows)[0])])
    return replace(semantic_map, elements=joined(old, copy), provenance=provenance)


def remove_element(semantic_map: SemanticMap, element_id: int) -> SemanticMap:
    """Return the map without one element."""
    kept = ~_rows_of(semantic_map, element_id)
    provenance = tuple(
        entry for entry, keep in zip(semantic_map.provenance, kept, strict=False) if keep
    )
    return replace(semantic_map, elements=semantic_map.elements[kept], provenance=provenance)


def _rows_of(semantic_map: SemanticMap, element_id: int) -> BoolArray:
    """Return (n,) True for the element of this id."""
    rows = np.asarray(semantic_map.elements.id == element_id)
    if not rows.any():
        raise SemvizError(f"map of {semantic_map.frame.name} has no element {element_id}")
    return rows


def _mapping_view(true: Elements3D, trajectory_m: FloatArray) -> FloatArray:
    """Return (n, 3) horizontal unit vectors from the mapping camera, about 15 m away."""
    if not len(trajectory_m):
        raise SemvizError("the map has no trajectory_m; errors along the line of sight need one")
    offset = true.anchor_m[:, None, :2] - trajectory_m[None, :, :2]
    distance = np.linalg.norm(offset, axis=2)
    passed = np.arange(len(trajectory_m)) > distance.argmin(axis=1)[:, None]
    choice = np.where(passed, np.inf, np.abs(distance - MAPPED_FROM_M)).argmin(axis=1)
    view = np.zeros((len(true), 3))
    view[:, :2] = offset[np.arange(len(true)), choice]
    return np.asarray(view / np.maximum(np.linalg.norm(view, axis=1, keepdims=True), 1e-9))


def _covariance(true: Elements3D, view: FloatArray) -> FloatArray:
    """Return (n, 6, 6) of (anchor, end): both share an error; a pole's direction adds its own."""
    shared = SIDE_SIGMA_M**2 * np.eye(3)
    shared = shared + (DEPTH_SIGMA_M**2 - SIDE_SIGMA_M**2) * view[:, :, None] * view[:, None, :]
    line = true.is_line
    axis = np.where(line[:, None], true.end_m - true.anchor_m, 0.0)
    length2 = (axis**2).sum(axis=1)[:, None, None]
    turned = DIRECTION_SIGMA_RAD**2 * (length2 * np.eye(3) - axis[:, :, None] * axis[:, None, :])
    covariance = np.zeros((len(true), 6, 6))
    covariance[:, :3, :3] = shared
    covariance[line, :3, 3:] = covariance[line, 3:, :3] = shared[line]
    covariance[line, 3:, 3:] = shared[line] + turned[line]
    return covariance


def _noisy(
    true: Elements3D, covariance: FloatArray, scale: float, rng: np.random.Generator
) -> Elements3D:
    """Return the elements with errors drawn from the covariance, scaled by ``scale``."""
    values, vectors = np.linalg.eigh(covariance)
    draws = rng.standard_normal((len(true), 6)) * np.sqrt(np.maximum(values, 0.0))
    error = scale * np.einsum("nij,nj->ni", vectors, draws)
    return _with(
        true,
        anchor_m=true.anchor_m + error[:, :3],
        end_m=true.end_m + error[:, 3:],
        covariance_m2=covariance,
    )


def _displaced(elements: Elements3D, rows: BoolArray, rng: np.random.Generator) -> Elements3D:
    """Return the elements with some of them moved horizontally by 8 m, in any direction."""
    angle = rng.uniform(-np.pi, np.pi, len(elements))
    by = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(elements))], axis=1)
    by *= OBSOLETE_M * rows[:, None]
    return _with(elements, anchor_m=elements.anchor_m + by, end_m=elements.end_m + by)


def _with(elements: Elements3D, **values: FloatArray | IntArray) -> Elements3D:
    return Elements3D(**{**vars(elements), **values})
