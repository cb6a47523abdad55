"""Run the pair matcher on one frame: log-odds of each pair, and proposed poses in NumPy.

Proposed upright poses are fitted and ranked among the search's modes.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from semviz_core.base.camera import Camera
from semviz_core.base.classes import ClassSet
from semviz_core.base.elements import Elements2D, Elements3D
from semviz_core.base.frame import Prior
from semviz_core.base.pose import Pose, nearest_rotation
from semviz_core.base.weights import NetworkWeights, load_trained
from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.localization import search
from semviz_core.localization.association import sinkhorn_with_dustbin
from semviz_core.localization.problem import PoseProblem, PriorRecord
from semviz_core.localization.upright import likely_ups, upright_view
from semviz_core.research.pair_matcher.couples import Prepared
from semviz_core.research.pair_matcher.network import ConsensusNetwork, Poses
from semviz_core.research.training.batch import Batch
from semviz_core.research.training.samples import Sample

TASK = "matcher"


@dataclass(frozen=True, eq=False)
class PairOdds:
    """Odds of the pairs of m observed and n mapped elements, and poses that explain them."""

    log_odds: FloatArray
    """(m, n) nats against no pair; LEAST_ODDS if the prior rules the pair out, -inf between
    different classes."""
    probability: FloatArray
    """(m + 1, n + 1) of one-to-one pairs, with dustbins."""
    pose: FloatArray
    """(h, 5) upright cameras, the likeliest first: x, y, z in the map, cosine and sine of the
    heading, as in ``heading_votes.PoseCandidates``."""
    share: FloatArray
    """(h,) their probabilities."""


@dataclass(frozen=True, eq=False)
class PairMatcher:
    """The trained network with its classes."""

    network: ConsensusNetwork
    classes: ClassSet

    def match(
        self, observed: Elements2D, submap: Elements3D, camera: Camera, prior: Prior
    ) -> PairOdds:
        """Return the odds of a frame with at least one observed and one mapped element."""
        sample = Sample.of(observed, submap, camera, prior, self.classes)
        batch = Batch.of([sample])
        with torch.inference_mode():
            output = self.network(Prepared.of(batch))
        log_odds = output.log_odds[0].double().numpy()
        odds = np.where(batch.same_class[0].numpy(), log_odds, -np.inf)
        share = output.rated.share.double().numpy()
        order = np.argsort(-share, kind="stable")
        pose = _upright(output.rated.poses, sample)[order]
        return PairOdds(odds, sinkhorn_with_dustbin(odds), pose, share[order])


def _upright(poses: Poses, sample: Sample) -> FloatArray:
    """Return poses (h, 5) in the map, at the height of the road."""
    camera, turn = poses.camera_m.numpy(), poses.turn.numpy()
    position = np.column_stack([camera.real, camera.imag]).astype(np.float64)
    height = sample.road[0] + position @ sample.road[1:]
    position_m = np.column_stack([position, height]) + sample.origin_m
    return np.column_stack([position_m, turn.real, turn.imag])


def load_pair_matcher(path: Path | None, classes: ClassSet) -> PairMatcher:
    """Return the matcher with the weights at ``path`` (default: the shipped ones).

    Raise SemvizError if the file is missing or holds another network.
    """
    return load_trained(TASK, path, classes, _built)


def _built(weights: NetworkWeights, classes: ClassSet, path: Path) -> PairMatcher:
    network = ConsensusNetwork(len(classes))
    weights.load_into(network, path)
    return PairMatcher(network.eval(), classes)


MOST_PROPOSED = 12
"""Most proposed poses that are fitted, at about 0.25 ms each."""


def with_proposed(
    modes: search.Modes, problem: PoseProblem, prior: Prior, pose: FloatArray
) -> search.Modes:
    """Return the modes together with those near upright poses, best first.

    ``pose`` (h, 5) is as in ``heading_votes.PoseCandidates``, without tilt; the first MOST_PROPOSED
    are used.
    """
    chosen = np.pad(pose[:MOST_PROPOSED], ((0, 0), (0, 1)))
    if not len(chosen):
        return modes
    ups, up_sigma_rad = likely_ups(problem, PriorRecord.of(prior))
    view = upright_view(problem, ups[0], up_sigma_rad)
    parts = [modes]
    for row in chosen:
        rotation, translation = search.camera_pose(view, row)
        parts.append(
            search.mode_near(problem, prior, Pose(nearest_rotation(rotation), translation))
        )
    all_modes = _concatenated(parts)
    return _rows_of(all_modes, _distinct(all_modes))


def _concatenated(parts: list[search.Modes]) -> search.Modes:
    return search.Modes(
        sum(part.evaluated for part in parts),
        sum(part.passed for part in parts),
        np.concatenate([part.rotation for part in parts]),
        np.concatenate([part.translation for part in parts]),
        np.concatenate([part.score for part in parts]),
        np.concatenate([part.match for part in parts]),
        np.concatenate([part.gain for part in parts]),
    )


def _distinct(modes: search.Modes) -> IntArray:
    """Return the rows of modes, best first, without those close to a better one."""
    kept: list[int] = []
    for row in np.argsort(-modes.score, kind="stable").tolist():
        pose = modes.rotation[row], modes.translation[row]
        distance, angle = search.pose_distances(
            *pose, modes.rotation[kept], modes.translation[kept]
        )
        if not ((distance <= search.APART_M) & (angle <= search.APART_RAD)).any():
            kept.append(row)
    return np.array(kept, dtype=np.int64)


def _rows_of(modes: search.Modes, rows: IntArray) -> search.Modes:
    return search.Modes(
        modes.evaluated,
        modes.passed,
        modes.rotation[rows],
        modes.translation[rows],
        modes.score[rows],
        modes.match[rows],
        modes.gain[rows],
    )
