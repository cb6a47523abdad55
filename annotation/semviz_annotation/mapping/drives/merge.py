"""Which elements of several drives are one landmark, and how the drives are corrected.

The poses of each drive have slowly varying errors of decimetres, so its map is shifted and turned a
little, and every landmark would stand in the joint map once for each drive. In rounds, elements of
different drives are paired where a whole stretch is shifted alike, and the drives are corrected by
these pairs; corrected drives lie closer, so the next round can tell nearer neighbours apart.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from semviz_annotation.mapping.drives.alignment import LEAST_M, Alignment, align, information_of
from semviz_annotation.mapping.drives.corrections import Knots, PoseErrors
from semviz_annotation.mapping.drives.shift_votes import Pairs, Places, vote
from semviz_core.base.semantic_map import SemanticMap, footprint_covariance_m2
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray

ROUNDS = (1.0, 0.5, 0.3)
"""Share of the poses' errors that is left before each round."""
FIRST_SCATTER = 0.15
"""Share of the poses' errors by which elements scatter, before it is known."""
CHANCE = 1e-5
"""Probability that an element is taken out of its landmark by chance."""


@dataclass(frozen=True)
class MergeOptions:
    """What is known of the drives."""

    errors: PoseErrors = field(default_factory=PoseErrors)
    fixed: tuple[int, ...] = ()
    """Numbers of the maps that stay where they are."""


DEFAULT_OPTIONS = MergeOptions()


@dataclass(frozen=True, eq=False)
class Stack:
    """The n elements of several maps."""

    ends_m: FloatArray
    """(n, 6); NaN for the end of a sign."""
    covariance_m2: FloatArray
    """(n, 6, 6)"""
    known: BoolArray
    """(n, 2) whether anchor and end are."""
    is_line: BoolArray
    """(n,)"""
    kind: IntArray
    """(n,) class"""
    drive: IntArray
    """(n,) number of the map"""
    rank: IntArray
    """(n,) of the map in an order that follows from the maps alone, not from that of ``drive``"""
    id: IntArray
    """(n,) in its own map"""
    on_ground_m2: FloatArray
    """(n, 3, 3) covariance of the middle, and of the anchor's height"""

    @classmethod
    def of(cls, maps: Sequence[SemanticMap]) -> "Stack":
        parts = [one.elements for one in maps]
        counts = [len(part) for part in parts]
        rank = np.argsort(np.argsort([one.digest for one in maps], kind="stable"))
        footprints = np.concatenate([footprint_covariance_m2(part) for part in parts])
        heights_m2 = np.concatenate([part.covariance_m2[:, 2, 2] for part in parts])
        footprints[:, 2, 2] = heights_m2
        footprints += LEAST_M**2 * np.eye(3)
        return cls(
            np.concatenate([np.hstack([part.anchor_m, part.end_m]) for part in parts]),
            np.concatenate([part.covariance_m2 for part in parts]),
            np.concatenate([np.stack([part.anchor_known, part.end_known], 1) for part in parts]),
            np.concatenate([part.is_line for part in parts]),
            np.concatenate([part.class_id for part in parts]),
            np.repeat(np.arange(len(maps)), counts),
            np.repeat(rank, counts),
            np.concatenate([part.id for part in parts]),
            footprints,
        )

    @property
    def variances_m2(self) -> FloatArray:
        """(n,) of the middle on the ground, mean of both directions"""
        return np.asarray(np.trace(self.on_ground_m2[:, :2, :2], axis1=1, axis2=2) / 2.0)

    def where(self, rows: IntArray) -> "Stack":
        """Return some of the elements."""
        return Stack(*(getattr(self, one.name)[rows] for one in fields(self)))

    def information(self, scatter_m: FloatArray) -> FloatArray:
        """Return that (n, 6, 6) of the elements, which scatter (n,) beyond their covariance."""
        return information_of(self.ends_m, self.covariance_m2, self.is_line, self.known, scatter_m)

    def places(self, ends_m: FloatArray) -> Places:
        """Return the elements at ``ends_m`` (n, 6) on the ground."""
        anchor, end = ends_m[:, :3], ends_m[:, 3:]
        middle = np.where(self.is_line[:, None], (anchor + end) / 2.0, anchor)
        middle[:, 2] = anchor[:, 2]
        _, order = np.unique(self.rank, return_inverse=True)
        return Places(middle, self.on_ground_m2, self.is_line, self.kind, order)


@dataclass(frozen=True, eq=False)
class Merging:
    """Landmarks of several drives, and how the drives are corrected."""

    stack: Stack
    knots: Knots
    landmark: IntArray
    """(n,) of each element of the stack; numbered in the order of their first elements."""
    alignment: Alignment
    scatter_m: FloatArray
    """(n,) sigma, in each direction, by which elements around each scatter about their landmarks
    beyond their own covariance, as the drives say; it is in the covariance of landmarks."""

    def moves(self, ends_m: FloatArray, drive: IntArray) -> FloatArray:
        """Return by how much (n, 6) corrections move ends (n, 6) that the drives (n,) measured."""
        by = self.knots.design(ends_m, drive) @ self.alignment.correction.ravel()
        return np.asarray(by.reshape(-1, 6))


def merge_stack(
    stack: Stack, knots: Knots, options: MergeOptions, on_round: Callable[[], None]
) -> Merging:
    """Return which elements, all of one frame, are one landmark, and where it is. ``on_round`` is
    called after each of ``ROUNDS``."""
    model = knots.model(stack.ends_m, stack.drive, options.errors, options.fixed)
    ends_m = np.nan_to_num(stack.ends_m)
    scatter_m = np.full(len(stack.drive), FIRST_SCATTER * options.errors.sigma_m)
    for left in ROUNDS:
        pairs = vote(stack.places(ends_m), left * options.errors.sigma_m)
        landmark = landmarks_of(pairs, stack.drive)
        information = stack.information(scatter_m)
        alignment = align(stack.ends_m, information, model, landmark)
        ends_m = alignment.ends_m
        scatter_m[:] = alignment.scatter_m(landmark, stack.variances_m2)
        on_round()
    information = stack.information(scatter_m)
    landmark = _without_misfits(landmark, alignment.chi2(information, landmark), stack.is_line)
    alignment = align(stack.ends_m, information, model, landmark)
    return Merging(stack, knots, landmark, alignment, scatter_m)


def landmarks_of(pairs: Pairs, drive: IntArray) -> IntArray:
    """Return the landmark (n,) of each element: groups of ``pairs``, the surest first, each with at
    most one element of a drive (n,)."""
    group = list(range(len(drive)))
    drives = [{number} for number in drive.tolist()]

    def root(element: int) -> int:
        while group[element] != element:
            group[element] = group[group[element]]
            element = group[element]
        return element

    order = np.lexsort((pairs.second, pairs.first, -pairs.score))
    for first, second in zip(
        pairs.first[order].tolist(), pairs.second[order].tolist(), strict=True
    ):
        few, many = sorted((root(first), root(second)), key=lambda one: len(drives[one]))
        if few != many and drives[few].isdisjoint(drives[many]):
            group[few] = many
            drives[many] |= drives[few]
    return numbered(np.array([root(element) for element in range(len(group))], np.int64))


def _without_misfits(landmark: IntArray, chi2: FloatArray, is_line: BoolArray) -> IntArray:
    """Return the landmarks (n,) with elements that fit theirs badly as landmarks of their own."""
    from scipy.special import chdtri

    misfit = chi2 > chdtri(np.where(is_line, 6, 3), CHANCE)
    own = landmark.max(initial=-1) + 1 + np.arange(len(landmark))
    return numbered(np.where(misfit, own, landmark))


def numbered(group: IntArray) -> IntArray:
    """Return the groups (n,) numbered from 0 in the order of their first elements."""
    _, first, inverse = np.unique(group, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]
