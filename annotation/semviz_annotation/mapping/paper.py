"""The paper's map (Chen, Xue & Pang 2022, section IV-B), to compare with.

Each stereo pair is triangulated linearly by itself, with the true poses. DBSCAN, class by class,
takes what is near for one thing, which is at the mean of its pairs. Who is who over frames, and
what one image shows twice, is not looked at.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.linking.misfits import main_first
from semviz_annotation.mapping.linking.nodes import LEFT_OUT, Judged, Nodes
from semviz_annotation.mapping.linking.tracks import Tracks
from semviz_annotation.mapping.placing.least_squares import PlaceOptions
from semviz_annotation.mapping.placing.place import place_linearly
from semviz_annotation.mapping.placing.placed import Placed, measured
from semviz_annotation.mapping.placing.sightings import Gathered, Sightings
from semviz_core.arrays import BoolArray, FloatArray, IntArray
from semviz_core.errors import SemvizError


@dataclass(frozen=True)
class PaperOptions:
    """How the paper's map is made."""

    eps_m: float = 1.0
    """DBSCAN's radius; the paper does not say."""
    min_points: int = 1
    """DBSCAN's core size, in stereo pairs."""
    sigma_px: float = 1.0
    """How well labels are placed, for the covariances."""
    min_angle_deg: float = 0.5
    """Pairs whose rays are nearer to parallel are left out: with KITTI's baseline, from 62 m on."""

    def __post_init__(self) -> None:
        for name in ("eps_m", "min_points"):
            if not getattr(self, name) > 0:
                raise SemvizError(f"{name} must be positive, not {getattr(self, name)}")

    @property
    def place(self) -> PlaceOptions:
        return PlaceOptions(self.sigma_px, float(np.deg2rad(self.min_angle_deg)))


def paper_tracks(gathered: Gathered, options: PaperOptions) -> Tracks:
    """Each cluster of stereo pairs is a thing."""
    pair, pairs = _pairs(gathered)
    places = place_linearly(gathered.views, pairs, options.place)
    cluster = _clusters(gathered, pairs, places, options)
    kept = np.where(pair != LEFT_OUT, cluster[pair], LEFT_OUT)
    part = main_first(gathered.sightings, kept)
    nodes = Nodes.of(gathered.sightings, part)
    first = np.cumsum(nodes.sightings.seen) - nodes.sightings.seen
    thing = kept[nodes.sightings.observation[first]]
    sightings = gathered.sightings.regrouped(kept, int(cluster.max(initial=LEFT_OUT)) + 1)
    return Tracks(
        gathered=gathered,
        judged=Judged.nothing(len(gathered.elements)),
        failure=_failures(gathered, pair, places, options),
        nodes=nodes,
        alone=place_linearly(gathered.views, nodes.sightings, options.place),
        thing=thing,
        sightings=sightings,
        placed=_means(gathered, sightings, places, cluster, options),
        apart=(),
        unclear=np.zeros(len(gathered.sightings), dtype=bool),
        unused="in no stereo pair that has a place in the map",
    )


def _pairs(gathered: Gathered) -> tuple[IntArray, Sightings]:
    """(k,) the stereo pair that each sighting is in, or ``LEFT_OUT``; and the pairs as things."""
    sightings = gathered.sightings
    frame = gathered.views.frame_index[sightings.view]
    seen = np.stack([sightings.thing, frame], axis=1)
    _, index, count = np.unique(seen, axis=0, return_inverse=True, return_counts=True)
    both = count == 2
    number = np.where(both, np.cumsum(both) - 1, LEFT_OUT)
    pair = number[index.ravel()]
    return pair, sightings.regrouped(pair, int(both.sum()))


def _clusters(
    gathered: Gathered, pairs: Sightings, places: Placed, options: PaperOptions
) -> IntArray:
    """(p,) cluster of each pair, counted over all classes; ``LEFT_OUT`` for noise."""
    import open3d

    elements = gathered.sightings.thing[pairs.observation[::2]]
    class_id = np.array([one.class_id for one in gathered.elements])[elements]
    result = np.full(pairs.count, LEFT_OUT)
    count = 0
    for kind in np.unique(class_id[places.ok]):
        rows = np.flatnonzero(places.ok & (class_id == kind))
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(_points(places, rows)))
        found = np.asarray(cloud.cluster_dbscan(options.eps_m, options.min_points))
        result[rows] = np.where(found >= 0, found + count, LEFT_OUT)
        count += int(found.max(initial=-1)) + 1
    return result


def _points(places: Placed, rows: IntArray) -> FloatArray:
    """(m, 3) a sign's middle; where a pole stands, as the heights of its ends may be unseen."""
    anchor, end = places.anchor_m[rows], places.end_m[rows]
    return np.where(np.isnan(end), anchor, (anchor + end) / 2.0 * [1.0, 1.0, 0.0])


def _means(
    gathered: Gathered,
    sightings: Sightings,
    places: Placed,
    cluster: IntArray,
    options: PaperOptions,
) -> Placed:
    """Of the pairs of each cluster; an end is at the mean of the pairs that show it, if any do."""
    n = sightings.count
    used = np.flatnonzero(cluster != LEFT_OUT)
    where = cluster[used]
    shares = [_shares(where, known[used], n) for known in (places.anchor_known, places.end_known)]
    X = np.zeros((n, 6))
    for which, ends in enumerate((places.anchor_m, places.end_m)):
        moved = shares[which][:, None] * np.nan_to_num(ends[used])
        np.add.at(X[:, 3 * which : 3 * which + 3], where, moved)
    weights = np.repeat(np.stack(shares, axis=1), 3, axis=1)
    covariance = np.zeros((n, 6, 6))
    spread = weights[:, :, None] * places.covariance_m2[used] * weights[:, None]
    np.add.at(covariance, where, spread)
    placed = measured(
        gathered.views,
        sightings,
        X,
        np.full(n, "", dtype=object),
        np.zeros(n, dtype=bool),
        np.zeros(n),
        options.place,
    )
    return replace(placed, covariance_m2=covariance)


def _shares(cluster: IntArray, known: BoolArray, count: int) -> FloatArray:
    """(p,) of each pair in the mean of its cluster (p,): of those that know, or of all."""
    knows = np.bincount(cluster[known], minlength=count) > 0
    counts = known | ~knows[cluster]
    return counts / np.bincount(cluster[counts], minlength=count)[cluster]


def _failures(
    gathered: Gathered, pair: IntArray, places: Placed, options: PaperOptions
) -> NDArray[np.object_]:
    """(n,) why label elements that are in no cluster are not."""
    few = f"fewer than {options.min_points} pairs within {options.eps_m:g} m"
    alone = "in no frame labelled in both images"
    result = np.full(len(gathered.elements), alone, dtype=object)
    for row, number in zip(gathered.sightings.thing, pair, strict=True):
        if number != LEFT_OUT:
            result[row] = places.failure[number] or few
    return result
