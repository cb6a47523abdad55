"""Whether enough is known of a thing for the map."""

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.linking.nearby import HARDLY_KNOWN_M, stands
from semviz_annotation.mapping.placing.placed import Placed
from semviz_annotation.mapping.placing.sightings import Sightings, Views
from semviz_core.arrays import IntArray


def frames_of(views: Views, sightings: Sightings) -> IntArray:
    """(n,) in how many frames each thing is seen."""
    seen = np.stack([sightings.thing, views.frame_index[sightings.view]])
    return np.bincount(np.unique(seen, axis=1)[0], minlength=sightings.count)


def too_little(
    views: Views, sightings: Sightings, placed: Placed, min_frames: int
) -> NDArray[np.object_]:
    """(n,) str: why things have no place, or one that is not for the map; empty where it is."""
    failure = placed.failure.copy()
    failure[placed.ok & (frames_of(views, sightings) < min_frames)] = (
        f"seen in fewer than {min_frames} frames"
    )
    _, _, sigma_m = stands(placed)
    failure[placed.ok & ~(sigma_m < HARDLY_KNOWN_M)] = (
        f"where it stands is not known to {HARDLY_KNOWN_M:g} m"
    )
    return failure
