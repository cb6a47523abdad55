"""What the trained matcher says of one frame, as NumPy: log-odds of each pair."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from semviz_core.arrays import FloatArray
from semviz_core.camera import Camera
from semviz_core.classes import ClassSet
from semviz_core.elements import Elements2D, Elements3D
from semviz_core.frame import Prior
from semviz_core.learning.batch import Batch
from semviz_core.learning.candidates.poses import Poses
from semviz_core.learning.candidates.prepared import Prepared
from semviz_core.learning.networks.consensus import ConsensusNetwork
from semviz_core.learning.sample import Sample
from semviz_core.learning.weights import Weights, load_trained
from semviz_core.matching.sinkhorn import sinkhorn_with_dustbin

TASK = "matcher"


@dataclass(frozen=True, eq=False)
class PairOdds:
    """Pairs of m seen and n mapped elements against no pair."""

    log_odds: FloatArray
    """(m, n) nats; LEAST_ODDS for what the prior rules out, -inf for pairs of two classes."""
    probability: FloatArray
    """(m + 1, n + 1) of one-to-one pairs, and of none."""
    pose: FloatArray
    """(h, 5) upright cameras that explain them, the likeliest first: x, y, z in the map, cosine
    and sine of the heading, as ``solving.hypotheses`` has them."""
    share: FloatArray
    """(h,) probability of these."""


@dataclass(frozen=True, eq=False)
class PairMatcher:
    """The trained network with the classes that it knows."""

    network: ConsensusNetwork
    classes: ClassSet

    def match(
        self, observed: Elements2D, submap: Elements3D, camera: Camera, prior: Prior
    ) -> PairOdds:
        """Of one frame, with at least one element seen and one mapped."""
        sample = Sample.of(observed, submap, camera, prior, self.classes)
        batch = Batch.of([sample])
        with torch.inference_mode():
            found = self.network(Prepared.of(batch))
        log_odds = found.log_odds[0].double().numpy()
        odds = np.where(batch.same_class[0].numpy(), log_odds, -np.inf)
        share = found.rated.share.double().numpy()
        order = np.argsort(-share, kind="stable")
        pose = _upright(found.rated.poses, sample)[order]
        return PairOdds(odds, sinkhorn_with_dustbin(odds), pose, share[order])


def _upright(poses: Poses, sample: Sample) -> FloatArray:
    """(h, 5) in the map, at the height of the road."""
    camera, turn = poses.camera_m.numpy(), poses.turn.numpy()
    place = np.column_stack([camera.real, camera.imag]).astype(np.float64)
    height = sample.road[0] + place @ sample.road[1:]
    at = np.column_stack([place, height]) + sample.origin_m
    return np.column_stack([at, turn.real, turn.imag])


def load_pair_matcher(path: Path | None, classes: ClassSet) -> PairMatcher:
    """With the weights at ``path``, or those that come with semviz.

    Raises SemvizError where there are none, or they are for something else.
    """
    return load_trained(TASK, path, classes, _built)


def _built(weights: Weights, classes: ClassSet, path: Path) -> PairMatcher:
    network = ConsensusNetwork(len(classes))
    weights.put_into(network, path)
    return PairMatcher(network.eval(), classes)
