"""``graph`` for one frame in NumPy: nobody who only localizes waits for torch, and it is faster.

``bench/learned_latency.py`` measures both; a test holds one to the other.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from semviz_core.learning.networks.edge_kernels import mean_of_edges

CHANNELS = 128
LAYERS = 12
EPSILON = 1e-3
"""Added to variances: a frame whose elements agree in a channel has none there."""
Float32 = NDArray[np.float32]


def graph_features(
    tensors: Mapping[str, Float32], stream: str, elements: Float32, neighbours: int
) -> Float32:
    """(n, CHANNELS) of elements (n, inputs), as ``GraphNetwork.forward``.

    ``tensors`` hold its parameters by torch's names, which begin with ``stream``. KeyError or
    ValueError where they are another network's.
    """

    def linear(name: str, inputs: Float32) -> Float32:
        weight, bias = tensors[f"{stream}.{name}.weight"], tensors[f"{stream}.{name}.bias"]
        return np.asarray(inputs @ weight.T + bias)

    features = linear("inlet", elements)
    for layer in range(LAYERS):
        normal = _context_norm(features)
        near = _nearest(normal, neighbours)
        hidden = mean_of_edges(linear(f"layers.{layer}.before", normal), near)
        features = features + linear(f"layers.{layer}.after", hidden)
    return linear("outlet", _context_norm(features))


def _context_norm(features: Float32) -> Float32:
    centred = features - features.mean(axis=0)
    variance = np.square(centred).mean(axis=0)
    return np.asarray(centred / np.sqrt(variance + np.float32(EPSILON)))


def _nearest(features: Float32, neighbours: int) -> NDArray[np.int64]:
    """(n, neighbours); the element itself where there are too few others."""
    n = len(features)
    itself = np.arange(n)
    product = features @ features.T
    distance = product.diagonal() - 2.0 * product
    distance[itself, itself] = np.inf
    count = min(neighbours, n - 1)
    near = np.tile(itself[:, None], (1, neighbours))
    if count:
        near[:, :count] = np.argpartition(distance, count - 1, axis=1)[:, :count]
    return near
