"""For matchers that take only points (BPnPNet): poles become two points."""

from dataclasses import replace

import numpy as np

from semviz_core.common.arrays import BoolArray, IntArray
from semviz_core.localization.correspondences.sample import Sample, SampleTarget


def split_lines(sample: Sample) -> Sample:
    """Return the sample as points only: first all anchors, then the known bottoms of poles.

    The bottoms of a true pair are a true pair too, hidden or not.
    """
    seen, mapped = _bottoms(sample.seen_known), _bottoms(sample.mapped_known)
    seen_rows = np.append(np.arange(len(sample.ray)), seen)
    mapped_rows = np.append(np.arange(len(sample.point_m)), mapped)
    ray = np.concatenate([sample.ray, sample.bottom_ray[seen]])
    point_m = np.concatenate([sample.point_m, sample.bottom_m[mapped]])
    truth = sample.truth
    if truth is not None:
        below = truth.pairs[np.ix_(seen, mapped)]
        corner = np.zeros((len(sample.ray), len(mapped)), dtype=bool)
        other = np.zeros((len(seen), len(sample.point_m)), dtype=bool)
        pairs = np.block([[truth.pairs, corner], [other, below]])
        truth = SampleTarget(truth.rotation, truth.translation, pairs)
    return replace(
        sample,
        ray=ray,
        bottom_ray=ray,
        sigma_rad=sample.sigma_rad[seen_rows],
        score=sample.score[seen_rows],
        seen_class=sample.seen_class[seen_rows],
        seen_known=_points_known(sample.seen_known, seen),
        point_m=point_m,
        bottom_m=point_m,
        mapped_class=sample.mapped_class[mapped_rows],
        mapped_known=_points_known(sample.mapped_known, mapped),
        truth=truth,
    )


def _bottoms(known: BoolArray) -> IntArray:
    """Return the rows of poles whose bottom is known; points have none."""
    return np.flatnonzero(known[:, 1])


def _points_known(known: BoolArray, bottoms: IntArray) -> BoolArray:
    """Return (k, 2) the known flags of anchors, then bottoms; points have no end."""
    first = np.append(known[:, 0], np.ones(len(bottoms), dtype=bool))
    return np.column_stack([first, np.zeros(len(first), dtype=bool)])
