"""Choose a place in each of several images of one moment, so that they suit one another."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from semviz_core.arrays import FloatArray

_TRIED = 6
"""Places in each image that are tried with those in the others."""
_APART_PX = 1.6
_OTHER_PX = 2.5
"""A place so far away is another one."""
_SOFT = 9.0
"""Likeness is worth this many times more than what is expected: three sigma count as one."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The place that was chosen in one image."""

    off: FloatArray
    """(m,)"""
    total: float
    """Its likeness."""
    margin: float
    """By how much the best choice with another place here is worse."""


def chosen(
    offs: Sequence[FloatArray], totals: Sequence[FloatArray], information: FloatArray
) -> list[Choice]:
    """One place in each of v images: likely ones that are off alike.

    ``offs`` (n, m) are px from where it is expected, ``totals`` (n,) their likeness, and
    ``information`` (v m, v m) the inverse covariance of all offs together.
    """
    m = offs[0].shape[1]
    peaks = [
        _peaks(off, total, information[m * k : m * k + m, m * k : m * k + m])
        for k, (off, total) in enumerate(zip(offs, totals, strict=True))
    ]
    tried = list(product(*peaks))
    sums = np.empty(len(tried))
    for n, places in enumerate(tried):
        whole = np.concatenate([one[at] for one, at in zip(offs, places, strict=True)])
        alike = sum(one[at] for one, at in zip(totals, places, strict=True))
        sums[n] = alike - 0.5 * whole @ information @ whole / _SOFT
    best = int(np.argmax(sums))
    result = []
    for k, off in enumerate(offs):
        at = tried[best][k]
        away = [np.linalg.norm(off[places[k]] - off[at]) > _OTHER_PX for places in tried]
        margin = float(np.clip(sums[best] - sums[away].max(initial=-np.inf), 0.0, 0.5))
        result.append(Choice(off[at], float(totals[k][at]), margin))
    return result


def _peaks(offs: FloatArray, total: FloatArray, information: FloatArray) -> list[int]:
    """The likeliest places in one image, apart from one another."""
    pull = np.einsum("ni,ij,nj->n", offs, information, offs)
    found: list[int] = []
    for at in np.argsort(-(total - 0.5 * pull / _SOFT), kind="stable"):
        gaps = [np.abs(offs[at] - offs[one]).max() for one in found]
        if min(gaps, default=np.inf) > _APART_PX:
            found.append(int(at))
        if len(found) == _TRIED:
            break
    return found
