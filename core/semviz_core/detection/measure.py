"""Regions to elements: axes, ends and middles measured in the image, each with its sigma."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from semviz_core.classes import POLE, RECTANGULAR
from semviz_core.detection.region import Region
from semviz_core.elements import Elements2D
from semviz_core.measuring.picture import Picture

Measuring = Literal["edges", "paper"]


def measure(picture: Picture, regions: Sequence[Region], measuring: Measuring) -> Elements2D:
    """The elements in a picture, one for each region that shows one, best score first."""
    ordered = sorted(regions, key=lambda one: -one.score)
    ends = np.array([_ends(one) for one in ordered]).reshape(-1, 2, 2)
    is_line = ~np.isnan(ends[:, 1, 0])
    known = [one.ends_known or (True, True) for one in ordered]
    return Elements2D(
        anchor_px=ends[:, 0],
        end_px=ends[:, 1],
        class_id=np.array(
            [RECTANGULAR if one.class_id is None else one.class_id for one in ordered], np.int64
        ),
        score=np.array([one.score for one in ordered]),
        sigma_px=np.full((len(ordered), 2), 2.0),
        anchor_known=np.array([one[0] for one in known], bool) | ~is_line,
        end_known=np.array([one[1] for one in known], bool) & is_line,
    )


def _ends(region: Region) -> np.ndarray:
    """(2, 2) of a pole; the second NaN for signs."""
    if region.class_id != POLE:
        return np.array([region.middle_px, [np.nan, np.nan]])
    if region.ends_px is not None:
        return region.ends_px
    left, top, right, bottom = region.box_px
    return np.array([[(left + right) / 2, top], [(left + right) / 2, bottom]])
