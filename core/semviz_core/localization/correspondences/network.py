"""The pair matcher's network in NumPy: candidate pairs exchange evidence for a pose.

Cross-attention whose weights geometry restricts. The attending unit is a pair of an observed
and a mapped element under a heading, so it is a whole pose hypothesis. Geometry decides whether
two pairs agree (`couples`). The network has learned how much that, the slopes, the fix and the
compass are worth. Every pair receives, from each other observed element, the best evidence of
its correspondences, with "no match" among them. So the rounds approach the probabilities of
one-to-one pairs, as belief propagation does. The best couples are fitted as poses and rated by
all pairs that agree (`pose_support`).

Training runs the same network on batches in torch
(`semviz_core.research.pair_matcher.network`); a test compares the two.
"""

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.localization.correspondences.candidate_pairs import BINS, in_bins
from semviz_core.localization.correspondences.couples import FrameGeometry, pair_features
from semviz_core.localization.correspondences.pose_support import proposed_poses

ROUNDS = 2
CHANNELS, HIDDEN, COUPLE_HIDDEN = 8, 16, 24
PAIR_FEATURES, BIN_FEATURES, COUPLE_FEATURES, POST_FEATURES = 14, 3, 7, 3
SUPPORT_FEATURES, POSE_FEATURES, LAST_FEATURES = 7, 3, 9
LEAST_ODDS, MOST_ODDS = -12.0, 15.0
"""Limits of the log-odds of pairs."""
RULED_OUT = -30.0
LARGEST = 8.0
"""Nats of a single message."""
SMALLEST = 1e-9
MOST_NATS = 10.0
"""Of a pair under a pose."""
LEAST = 1e-5
Weights: TypeAlias = Mapping[str, NDArray[np.float32]]


def layer_sizes() -> dict[str, tuple[int, int, int]]:
    """Return the numbers of inputs, hidden units and outputs of each perceptron by its name."""
    later = BIN_FEATURES + CHANNELS + 5
    sizes = {
        "of_pair": (PAIR_FEATURES + CHANNELS, 2 * HIDDEN, 1 + CHANNELS),
        "of_couple": (COUPLE_FEATURES, COUPLE_HIDDEN, ROUNDS),
        "of_post": (POST_FEATURES, CHANNELS, ROUNDS),
        "of_belief.0": (BIN_FEATURES + CHANNELS + 1, HIDDEN, 1),
        "by_pose.of_support": (SUPPORT_FEATURES + 1 + CHANNELS, HIDDEN, 1),
        "by_pose.of_pose": (POSE_FEATURES + 3, HIDDEN, 1),
        "last": (LAST_FEATURES, HIDDEN, 1),
    }
    return sizes | {f"of_belief.{k + 1}": (later, HIDDEN, 1) for k in range(ROUNDS)}


def tensor_shapes(classes: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all weights, by the names of torch's modules."""
    shapes: dict[str, tuple[int, ...]] = {"of_class.weight": (classes, CHANNELS)}
    for name, (inputs, hidden, outputs) in layer_sizes().items():
        for layer, (fan_in, fan_out) in ((0, (inputs, hidden)), (2, (hidden, outputs))):
            shapes[f"{name}.{layer}.weight"] = fan_out, fan_in
            shapes[f"{name}.{layer}.bias"] = (fan_out,)
    return shapes


def pair_log_odds(
    weights: Weights, frame: FrameGeometry, seen_class: IntArray, mapped: int
) -> FloatArray:
    """Return the log-odds (m, n) of pairs against no pair, LEAST_ODDS for those ruled out.

    ``seen_class`` (m,) are the numbers of the observed elements' classes, ``mapped`` is n.
    """
    m, seen = len(seen_class), frame.pairs.seen
    log_odds = np.full((m, mapped), LEAST_ODDS)
    if not len(seen):
        return log_odds
    of_class = weights["of_class.weight"][seen_class[seen]]
    feature = pair_features(frame.pairs, m)
    encoding = _perceptron(weights, "of_pair", np.column_stack([feature, of_class]))
    couple_nats = np.minimum(_perceptron(weights, "of_couple", frame.couples.feature), LARGEST)
    belief = _belief(weights, frame, encoding, couple_nats, m)
    share, total = _shares_by_heading(belief, seen, m)
    heading = _log_softmax(_headings(total))
    log_total = np.log(total)
    pair = _log_sum_exp(belief - log_total[seen] + heading)
    odds = pair - _log_sum_exp(heading - log_total)[seen]
    score = _couple_scores(frame, share, heading, couple_nats[:, -1])
    rated = _rated(weights, frame, encoding, score, m, mapped)
    known = np.column_stack(
        [
            odds / 4.0,
            np.maximum(belief.max(axis=1), LEAST_ODDS) / 4.0,
            encoding[:, 0],
            share.max(axis=1),
            np.full(len(seen), heading.max()),
            rated.odds / 4.0,
            rated.pair,
            np.full(len(seen), rated.largest_share),
            np.full(len(seen), rated.score / 10.0),
        ]
    )
    odds = 0.5 * (odds + rated.odds) + _single(weights, "last", known)
    log_odds[seen, frame.pairs.mapped] = np.clip(odds, LEAST_ODDS, MOST_ODDS)
    return log_odds


def _perceptron(weights: Weights, name: str, inputs: FloatArray) -> FloatArray:
    """Return the outputs (..., outputs) of a perceptron with one hidden layer."""
    inputs = inputs.astype(np.float32)
    hidden = inputs @ weights[f"{name}.0.weight"].T + weights[f"{name}.0.bias"]
    np.maximum(hidden, 0.0, out=hidden)
    out = hidden @ weights[f"{name}.2.weight"].T + weights[f"{name}.2.bias"]
    return out.astype(np.float64)


def _single(weights: Weights, name: str, inputs: FloatArray) -> FloatArray:
    return _perceptron(weights, name, inputs)[..., 0]


def _belief(
    weights: Weights, frame: FrameGeometry, encoding: FloatArray, couple_nats: FloatArray, m: int
) -> FloatArray:
    """Return the log-odds (N, BINS) of pairs under each heading, after all rounds."""
    bins, seen = in_bins(frame.pairs, frame.compass), frame.pairs.seen
    shape = (len(seen), BINS)
    alone = np.broadcast_to(encoding[:, :1], shape)
    channels = np.broadcast_to(encoding[:, None, 1:], (*shape, CHANNELS))
    inputs = np.concatenate([bins.feature, channels, alone[..., None]], axis=2)
    ruled_out = np.where(bins.possible, 0.0, RULED_OUT)
    by_couple = np.exp(couple_nats)
    by_post = np.exp(np.minimum(_perceptron(weights, "of_post", frame.posts.feature), LARGEST))
    belief = alone + _single(weights, "of_belief.0", inputs) + ruled_out
    for k in range(ROUNDS):
        share, total = _shares_by_heading(belief, seen, m)
        messages = _messages(frame, share, by_couple[:, k], by_post[:, k], m)
        heading = np.broadcast_to(_headings(total), shape)
        known = [messages, np.maximum(belief, LEAST_ODDS) / 4.0, heading, share]
        more = np.concatenate([inputs, np.stack(known, axis=2)], axis=2)
        belief = messages + _single(weights, f"of_belief.{k + 1}", more) + ruled_out
    return belief


def _shares_by_heading(belief: FloatArray, seen: IntArray, m: int) -> tuple[FloatArray, FloatArray]:
    """Return the probability (N, BINS) of each pair under each heading, among those of its observed
    element and none; and the normalization (m, BINS)."""
    odds = np.exp(np.minimum(belief, MOST_ODDS))
    total = np.ones((m, BINS))
    np.add.at(total, seen, odds)
    return odds / total[seen], total


def _headings(total: FloatArray) -> FloatArray:
    """Return the log-odds (BINS,) of headings against the average one."""
    evidence = np.log(total).sum(axis=0)
    return np.asarray(evidence - evidence.mean())


@compiled
def _messages(
    frame: FrameGeometry, share: FloatArray, by_couple: FloatArray, by_post: FloatArray, m: int
) -> FloatArray:
    """Return the nats (N, BINS) that each pair receives from the other observed elements."""
    seen, couples, posts = frame.pairs.seen, frame.couples, frame.posts
    message = np.zeros((len(seen), m, BINS))
    for e in range(len(couples.first)):
        a, b = couples.first[e], couples.second[e]
        for k in range(3):
            bin, weight = couples.bin[e, k], by_couple[e] * couples.weight[e, k]
            message[a, seen[b], bin] += weight * share[b, bin]
            message[b, seen[a], bin] += weight * share[a, bin]
    for e in range(len(posts.first)):
        a, b = posts.first[e], posts.second[e]
        for bin in range(BINS):
            message[a, seen[b], bin] += by_post[e] * share[b, bin]
            message[b, seen[a], bin] += by_post[e] * share[a, bin]
    nats = np.zeros((len(seen), BINS))
    for row in range(len(seen)):
        for i in range(m):
            for bin in range(BINS):
                if message[row, i, bin] > 0.0:
                    nats[row, bin] += np.log1p(message[row, i, bin])
    return nats


def _couple_scores(
    frame: FrameGeometry, share: FloatArray, heading: FloatArray, couple_nats: FloatArray
) -> FloatArray:
    """Return the nats (E,) of couples: of both pairs, their agreement and the heading."""
    nearest = frame.couples.bin[:, 1]
    score = couple_nats + heading[nearest]
    for end in (frame.couples.first, frame.couples.second):
        score = score + np.log(np.maximum(share[end, nearest], SMALLEST))
    return score


class _Rated(NamedTuple):
    """The pairs' probabilities that follow from the poses."""

    pair: FloatArray  # (N,) probability of each candidate pair
    odds: FloatArray  # (N,) log-odds against no pair of its observed element
    largest_share: float  # probability of the best pose
    score: float  # nats of the best pose, 0 if none is better than no pose


def _rated(
    weights: Weights,
    frame: FrameGeometry,
    encoding: FloatArray,
    couple_score: FloatArray,
    m: int,
    n: int,
) -> _Rated:
    """Rate the poses of the best couples by the pairs that agree with them."""
    poses = proposed_poses(frame.pairs, frame.compass, frame.couples, couple_score)
    seen, mapped = frame.pairs.seen[poses.pair], frame.pairs.mapped[poses.pair]
    inputs = np.column_stack([poses.feature, encoding[poses.pair]])
    nats = _single(weights, "by_pose.of_support", inputs)
    likelihood = np.exp(np.clip(nats, -MOST_NATS, MOST_NATS))
    h = len(poses.couple)
    by_seen = 1.0 + np.bincount(poses.pose * m + seen, likelihood, h * m).reshape(h, m)
    by_mapped = 1.0 + np.bincount(poses.pose * n + mapped, likelihood, h * n).reshape(h, n)
    ends = [np.log(by).sum(axis=1) for by in (by_seen, by_mapped)]
    known = np.column_stack([couple_score[poses.couple], *ends]) / 4.0
    of_pose = _single(weights, "by_pose.of_pose", np.column_stack([poses.prior, known]))
    score = np.minimum(*ends) + of_pose
    highest = float(score.max(initial=0.0))
    share = np.exp(score - highest)
    share = share / (np.exp(-highest) + share.sum())
    inside = likelihood / np.maximum(by_seen[poses.pose, seen], by_mapped[poses.pose, mapped])
    pair = np.bincount(poses.pair, share[poses.pose] * inside, len(frame.pairs.seen))
    taken = np.bincount(frame.pairs.seen, pair, m)
    left = 1.0 - np.minimum(taken, 1.0 - 10.0 * LEAST)
    odds = np.log(pair + LEAST) - np.log(left)[frame.pairs.seen]
    return _Rated(np.asarray(pair, np.float64), odds, float(share.max(initial=0.0)), highest)


def _log_softmax(value: FloatArray) -> FloatArray:
    return np.asarray(value - _log_sum_exp(value))


def _log_sum_exp(value: FloatArray) -> FloatArray:
    """Return the logarithm of the sum of exponentials along the last axis."""
    largest = value.max(axis=-1, keepdims=True)
    return np.asarray(largest[..., 0] + np.log(np.exp(value - largest).sum(axis=-1)))
