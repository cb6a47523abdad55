"""The paper's map building, for comparison (Chen, Xue and Pang 2022, section IV-B).

Each stereo pair is triangulated linearly by itself, with the true poses. DBSCAN clusters the points
of each class; a landmark is the mean of its cluster. Neither association across frames is used,
nor the constraint that one image shows a landmark once.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from semviz_annotation.mapping.association.merging import main_first
from semviz_annotation.mapping.association.nodes import LEFT_OUT, ReviewConstraints, TrackNodes
from semviz_annotation.mapping.association.tracks import Tracks
from semviz_annotation.mapping.placement.landmarks import Landmarks, measure_landmarks
from semviz_annotation.mapping.placement.observations import LabelObservations, ObservationArray
from semviz_annotation.mapping.placement.reprojection import PlaceOptions
from semviz_annotation.mapping.placement.triangulation import triangulate_linearly
from semviz_core.common.arrays import BoolArray, FloatArray, IntArray
from semviz_core.common.errors import SemvizError


@dataclass(frozen=True)
class PaperOptions:
    """Options of the paper's method."""

    eps_m: float = 1.0
    """DBSCAN's radius; the paper does not state it."""
    min_points: int = 1
    """DBSCAN's core size, in stereo pairs."""
    sigma_px: float = 1.0
    """Standard deviation of labels, for the covariances."""
    min_angle_deg: float = 0.5
    """Pairs with a smaller ray angle are left out: with KITTI's baseline, from 62 m on."""

    def __post_init__(self) -> None:
        for name in ("eps_m", "min_points"):
            if not getattr(self, name) > 0:
                raise SemvizError(f"{name} must be positive, not {getattr(self, name)}")

    @property
    def place(self) -> PlaceOptions:
        return PlaceOptions(self.sigma_px, float(np.deg2rad(self.min_angle_deg)))


def paper_tracks(gathered: LabelObservations, options: PaperOptions) -> Tracks:
    """Return tracks with one landmark per cluster of stereo pairs."""
    pair, pairs = _pairs(gathered)
    if not pairs.count:
        raise SemvizError(
            "method paper triangulates stereo pairs, and no element is labelled in both images "
            "of a frame; use method joint"
        )
    places = triangulate_linearly(gathered.views, pairs, options.place)
    cluster = _clusters(gathered, pairs, places, options)
    kept = np.where(pair != LEFT_OUT, cluster[pair], LEFT_OUT)
    part = main_first(gathered.observations, kept)
    nodes = TrackNodes.of(gathered.observations, part)
    first = np.cumsum(nodes.observations.seen) - nodes.observations.seen
    landmark = kept[nodes.observations.label_row[first]]
    observations = gathered.observations.regrouped(kept, int(cluster.max(initial=LEFT_OUT)) + 1)
    return Tracks(
        gathered=gathered,
        constraints=ReviewConstraints.nothing(len(gathered.elements)),
        failure=_failures(gathered, pair, places, options),
        nodes=nodes,
        alone=triangulate_linearly(gathered.views, nodes.observations, options.place),
        landmark=landmark,
        observations=observations,
        placed=_means(gathered, observations, places, cluster, options),
        apart=(),
        unclear=np.zeros(len(gathered.observations), dtype=bool),
        unused="in no stereo pair that has a place in the map",
    )


def _pairs(gathered: LabelObservations) -> tuple[IntArray, ObservationArray]:
    """Return the stereo pair (k,) of each observation, or ``LEFT_OUT``, and the pairs as
    landmarks."""
    observations = gathered.observations
    frame = gathered.views.frame_index[observations.view]
    seen = np.stack([observations.landmark, frame], axis=1)
    _, index, count = np.unique(seen, axis=0, return_inverse=True, return_counts=True)
    both = count == 2
    number = np.where(both, np.cumsum(both) - 1, LEFT_OUT)
    pair = number[index.ravel()]
    return pair, observations.regrouped(pair, int(both.sum()))


def _clusters(
    gathered: LabelObservations, pairs: ObservationArray, places: Landmarks, options: PaperOptions
) -> IntArray:
    """Return the cluster (p,) of each pair, counted over all classes; ``LEFT_OUT`` for noise."""
    elements = gathered.observations.landmark[pairs.label_row[::2]]
    class_id = np.array([element.class_id for element in gathered.elements])[elements]
    result = np.full(pairs.count, LEFT_OUT)
    count = 0
    for kind in np.unique(class_id[places.ok]):
        rows = np.flatnonzero(places.ok & (class_id == kind))
        labels = dbscan(_points(places, rows), options.eps_m, options.min_points)
        result[rows] = np.where(labels >= 0, labels + count, LEFT_OUT)
        count += int(labels.max(initial=-1)) + 1
    return result


def dbscan(points: FloatArray, eps: float, min_points: int) -> IntArray:
    """Return the cluster (m,) of each of ``points`` (m, 3), from 0; -1 for noise (DBSCAN).

    Points closer than ``eps`` are neighbours; each point is its own neighbour. A core has
    ``min_points`` neighbours. Clusters are numbered by their first core; a border point of several
    clusters belongs to the first. (Ester et al. 1996.)
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    m = len(points)
    i, j = cKDTree(points).query_pairs(eps * (1.0 + 1e-9), output_type="ndarray").T
    near = ((points[i] - points[j]) ** 2).sum(axis=1) < eps * eps
    i, j = np.concatenate([i[near], j[near]]), np.concatenate([j[near], i[near]])
    core = np.bincount(i, minlength=m) + 1 >= min_points
    joined = core[i] & core[j]
    graph = coo_array((np.ones(joined.sum(), bool), (i[joined], j[joined])), (m, m))
    part = connected_components(graph, directed=False)[1]
    _, first, row = np.unique(part[core], return_index=True, return_inverse=True)
    cluster = np.full(m, m)
    cluster[core] = np.argsort(np.argsort(first))[row]
    border = core[j] & ~core[i]
    np.minimum.at(cluster, i[border], cluster[j[border]])
    return np.where(cluster < m, cluster, -1)


def _points(places: Landmarks, rows: IntArray) -> FloatArray:
    """Return signs' centres and poles' ground positions (m, 3), as pole ends may be unseen."""
    anchor, end = places.anchor_m[rows], places.end_m[rows]
    return np.where(np.isnan(end), anchor, (anchor + end) / 2.0 * [1.0, 1.0, 0.0])


def _means(
    gathered: LabelObservations,
    observations: ObservationArray,
    places: Landmarks,
    cluster: IntArray,
    options: PaperOptions,
) -> Landmarks:
    """Return the mean of each cluster; an end is the mean of the pairs that show it, if any do."""
    n = observations.count
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
    placed = measure_landmarks(
        gathered.views,
        observations,
        X,
        np.full(n, "", dtype=object),
        np.zeros(n, dtype=bool),
        np.zeros(n),
        options.place,
    )
    return replace(placed, covariance_m2=covariance)


def _shares(cluster: IntArray, known: BoolArray, count: int) -> FloatArray:
    """Return the weight (p,) of each pair in its cluster: equal for pairs with a known end."""
    knows = np.bincount(cluster[known], minlength=count) > 0
    counts = known | ~knows[cluster]
    return counts / np.bincount(cluster[counts], minlength=count)[cluster]


def _failures(
    gathered: LabelObservations, pair: IntArray, places: Landmarks, options: PaperOptions
) -> NDArray[np.object_]:
    """Return why label elements (n,) are in no cluster."""
    few = f"fewer than {options.min_points} pairs within {options.eps_m:g} m"
    alone = "in no frame labelled in both images"
    result = np.full(len(gathered.elements), alone, dtype=object)
    for row, number in zip(gathered.observations.landmark, pair, strict=True):
        if number != LEFT_OUT:
            result[row] = places.failure[number] or few
    return result
