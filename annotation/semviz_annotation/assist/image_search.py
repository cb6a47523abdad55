"""The search of one image for a mapped element, and the choice of positions in several images.

Apart from errors in depth, the offset from the expected position is the same in all images of one
moment.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from semviz_annotation.assist.marked_image import Mark, MarkedImage
from semviz_core.common.arrays import FloatArray
from semviz_core.subpixel.sampling import Samples

_MAX_CANDIDATES = 6
"""Candidates in each image that are combined with those in the others."""
_APART_PX = 1.6
_OTHER_PX = 2.5
"""Candidates at this distance are different positions."""
_SOFTNESS = 9.0
"""Weight of similarity relative to the prior: three sigma count as one."""
REACH_PX = 24.0
"""Largest distance of a search from the expected position."""


@dataclass(frozen=True, eq=False)
class ReferenceView:
    """An image to search for an element, and one in which it is labelled."""

    target: MarkedImage
    source: MarkedImage
    marked: Mark


@dataclass(frozen=True, eq=False)
class PropagatedMark:
    """A propagated mark with its evidence."""

    mark: Mark
    what: str
    """Whether the image shows its edges, or it only follows another; see ``score``."""
    evidence: FloatArray
    is_longer: bool = False
    """Whether the image shows more of a pole than is labelled: somebody must look."""


@dataclass(frozen=True, eq=False)
class ExpectedMark:
    """The expected position of an element in one image."""

    reference: ReferenceView
    ends_px: FloatArray
    spread_px2: FloatArray
    """(e, 2, e, 2)"""
    mark: Mark
    """States which ends are known."""


@dataclass(frozen=True, eq=False)
class ImageSearch:
    """The similarity of each position in one image to the element."""

    expected: ExpectedMark
    patch: Samples
    start_px: FloatArray
    """(e, 2) expected ends of the part that is compared; of a pole perhaps not all."""
    shares: FloatArray
    """(2,) begin and end of that part, as shares of the pole."""
    size_px: FloatArray
    """A pole's width, or a sign's half width and height, in the target image."""
    scale: float
    """Magnification from the source to the target image."""
    axes: FloatArray
    """(m, 2) unit directions of the search: one across a pole, two for a sign."""
    offsets: FloatArray
    """(n, m) px along the axes from the expected position."""
    total: FloatArray
    """(n,) weighted similarity."""


@dataclass(frozen=True, eq=False)
class RefinedMark:
    """Found at sub-pixel accuracy, ``offset`` (m,) from where it was expected."""

    mark: Mark
    what: str
    """See ``PropagatedMark``."""
    offset: FloatArray
    evidence: FloatArray


@dataclass(frozen=True, eq=False)
class ChosenOffset:
    """The position chosen in one image."""

    offset: FloatArray
    """(m,)"""
    total: float
    """Its similarity."""
    margin: float
    """Lead over the best combination with another position in this image."""


def joint_maximum(
    offsets: Sequence[FloatArray], totals: Sequence[FloatArray], information: FloatArray
) -> list[ChosenOffset]:
    """Choose one position in each of v images, so that they are likely and have similar offsets.

    ``offsets`` (n, m) are px from the expected position, ``totals`` (n,) their similarities, and
    ``information`` (v m, v m) is the inverse covariance of all offsets together.
    """
    m = offsets[0].shape[1]
    peaks = [
        _peaks(offset, total, information[m * k : m * k + m, m * k : m * k + m])
        for k, (offset, total) in enumerate(zip(offsets, totals, strict=True))
    ]
    combinations = list(product(*peaks))
    sums = np.empty(len(combinations))
    for n, places in enumerate(combinations):
        whole = np.concatenate([offset[at] for offset, at in zip(offsets, places, strict=True)])
        alike = sum(total[at] for total, at in zip(totals, places, strict=True))
        sums[n] = alike - 0.5 * whole @ information @ whole / _SOFTNESS
    best = int(np.argmax(sums))
    result = []
    for k, offset in enumerate(offsets):
        at = combinations[best][k]
        away = [
            np.linalg.norm(offset[places[k]] - offset[at]) > _OTHER_PX for places in combinations
        ]
        margin = float(np.clip(sums[best] - sums[away].max(initial=-np.inf), 0.0, 0.5))
        result.append(ChosenOffset(offset[at], float(totals[k][at]), margin))
    return result


def _peaks(offsets: FloatArray, total: FloatArray, information: FloatArray) -> list[int]:
    """Return the most likely positions in one image, with a minimum distance."""
    pull = np.einsum("ni,ij,nj->n", offsets, information, offsets)
    peaks: list[int] = []
    for at in np.argsort(-(total - 0.5 * pull / _SOFTNESS), kind="stable"):
        gaps = [np.abs(offsets[at] - offsets[peak]).max() for peak in peaks]
        if min(gaps, default=np.inf) > _APART_PX:
            peaks.append(int(at))
        if len(peaks) == _MAX_CANDIDATES:
            break
    return peaks
