"""The pair matcher's network in NumPy: candidate pairs exchange evidence for a pose.

Cross-attention whose weights geometry restricts. The attending unit is a pair of an observed
and a mapped element under a heading, so it is a whole pose hypothesis. Geometry decides whether
two pairs agree (`couples`). The network has learned how much that, the slopes, the fix and the
compass are worth. Every pair receives, from each other observed element, the best evidence of
its correspondences, with "no match" among them. So the rounds approach the probabilities of
one-to-one pairs, as belief propagation does.

The best couples are fitted as upright poses and rated by all pairs that agree. A pose is a camera
(complex, local metres) and a turn (complex unit, from the level frame to the local one). A pair
agrees if its azimuth and its distance do.

Training runs the same network on batches in torch
(`semviz_core.research.pair_matcher.network`); a test compares the two.
"""

from collections.abc import Mapping
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from semviz_core.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from semviz_core.common.jit import compiled
from semviz_core.common.linalg import cholesky, solve_cholesky
from semviz_core.localization.correspondences.candidate_pairs import (
    BINS,
    NEAREST_M,
    USUAL_FIX_SIGMAS,
    CandidatePairs,
    Compass,
    compass_chi2,
    in_bins,
)
from semviz_core.localization.correspondences.couples import Couples, FrameGeometry, pair_features

POSES = 192
"""Most couples of a frame that become poses: those with the highest score."""
_CELL_M, _CELLS = 2.0, 512
"""Only the best couple per square of the ground and heading becomes a pose."""
_DOUBTS = ((1.2, 0.05), (0.6, 0.02))
"""Sigmas (m, rad) of poses before each fit, which widen the gates."""
_LEFT = (0.3, 0.01)
"""Sigmas (m, rad) of fitted poses."""
_MOST_CHI2 = 12.0
_CAUCHY_CHI2 = 4.0
_NOTHING = 0.05
"""Likelihood that an observed element has no mapped one, relative to a perfect pair."""
_MAP_SIGMA_M = 0.15
_STAY = (0.25, 0.25, 100.0)
"""Information of the start pose, per square metre and square radian."""
_LONGEST_STEP = 2.0


class ProposedPoses(NamedTuple):
    """h fitted poses of one frame, and their k agreements with pairs."""

    couple: IntArray  # (h,) row of the couple that proposed the pose
    prior: FloatArray  # (h, 3) distances from the fix and from the compass
    pose: IntArray  # (k,) row of a pose
    pair: IntArray  # (k,) row of a pair that agrees with it
    feature: FloatArray  # (k, 7)


def proposed_poses(
    pairs: CandidatePairs, compass: Compass, couples: Couples, couple_score: FloatArray
) -> ProposedPoses:
    """Return the fitted poses of the best couples by score (E,)."""
    chosen = _apart(couples, couple_score)[:POSES]
    camera_m, turn = couples.camera_m[chosen], couples.turn[chosen]
    fit_poses(pairs, camera_m, turn)
    pose, pair, feature = _support(pairs, camera_m, turn)
    from_fix = np.abs(camera_m) / pairs.fix_sigma_m
    heading = np.angle(turn).tolist()
    chi2 = np.array([compass_chi2(compass, angle, _LEFT[1] ** 2) for angle in heading])
    prior = [
        np.minimum(np.square(from_fix), 12.0) / 3.0,
        np.minimum(np.abs(from_fix - USUAL_FIX_SIGMAS), 2.0),
        np.minimum(chi2, 16.0) / 5.0,
    ]
    return ProposedPoses(chosen, np.column_stack(prior), pose, pair, feature)


def _apart(couples: Couples, score: FloatArray) -> IntArray:
    """Return the rows of couples, best first, but for those in one square and heading."""
    order = np.argsort(-score, kind="stable")
    place = np.column_stack([couples.camera_m.real, couples.camera_m.imag])[order]
    square = np.clip(np.round(place / _CELL_M), -_CELLS, _CELLS - 1).astype(np.int64) + _CELLS
    cell = (square[:, 0] * 2 * _CELLS + square[:, 1]) * BINS + couples.bin[order, 1]
    _, first = np.unique(cell, return_index=True)
    return order[np.sort(first)]


class _Off(NamedTuple):
    """Residuals of a pair under a pose."""

    angle: float  # rad, of azimuths
    nearness: float  # of 1 / distance
    angle_variance: float
    nearness_variance: float
    sight: complex  # from the camera to the mapped element, in the level frame
    chi2: float  # infinite if they do not agree


@compiled
def _residuals(
    pairs: CandidatePairs, row: int, camera_m: complex, turn: complex, doubt: tuple[float, float]
) -> _Off:
    """Return the residuals of the pair in ``row`` under a pose of these sigmas (m, rad)."""
    sight = (pairs.place_m[row] - camera_m) * np.conj(turn)
    relative = sight * np.conj(pairs.direction[row])
    ahead, beside = relative.real, relative.imag
    own = pairs.azimuth_sigma[row] ** 2 + doubt[1] ** 2
    wide_m2 = _MAP_SIGMA_M**2 + doubt[0] ** 2
    most = _MOST_CHI2 * (own * (ahead * ahead + beside * beside) + wide_m2)
    if not (ahead > 0.0 and beside * beside < most):
        return _Off(0.0, 0.0, 1.0, 1.0, sight, np.inf)
    angle = np.arctan2(beside, ahead)
    distance = max(np.hypot(ahead, beside), NEAREST_M)
    variance = own + wide_m2 / distance**2
    uphill = (np.conj(pairs.rise) * pairs.direction[row] * turn).real
    nearness = 1.0 / distance - pairs.nearness[row] + pairs.by_slope[row] * uphill
    spread = (pairs.sigma_m[row] * pairs.nearness[row] ** 2) ** 2 + (doubt[0] / distance**2) ** 2
    chi2 = angle * angle / variance + nearness * nearness / spread
    if not chi2 < _MOST_CHI2:
        chi2 = np.inf
    return _Off(angle, nearness, variance, spread, sight, chi2)


@compiled
def fit_poses(pairs: CandidatePairs, camera_m: ComplexArray, turn: ComplexArray) -> None:
    """Fit cameras (h,) and turns (h,) in place to the pairs that agree with them."""
    seen = pairs.seen.max() + 1 if len(pairs.seen) else 0
    total = np.empty(seen)
    likelihood = np.empty(len(pairs.seen))
    for h in range(len(turn)):
        for doubt in _DOUBTS:
            total[:] = _NOTHING
            for row in range(len(pairs.seen)):
                off = _residuals(pairs, row, camera_m[h], turn[h], doubt)
                likelihood[row] = np.exp(-0.5 * off.chi2)
                total[pairs.seen[row]] += likelihood[row]
            camera_m[h], turn[h] = _stepped(pairs, camera_m[h], turn[h], doubt, likelihood, total)


@compiled
def _stepped(
    pairs: CandidatePairs,
    camera_m: complex,
    turn: complex,
    doubt: tuple[float, float],
    likelihood: FloatArray,
    total: FloatArray,
) -> tuple[complex, complex]:
    """Return a pose after a Gauss-Newton step of position and heading.

    A pair counts by its share among its observed element's pairs under the pose, and none.
    """
    information, step = np.zeros((3, 3)), np.zeros(3)
    by = np.zeros((2, 3))
    for k in range(3):
        information[k, k] = _STAY[k]
    for row in range(len(pairs.seen)):
        if likelihood[row] == 0.0:
            continue
        off = _residuals(pairs, row, camera_m, turn, doubt)
        distance = max(abs(off.sight), NEAREST_M)
        by_place = -np.conj(turn) / off.sight  # the angle grows by Im(by_place dx)
        toward = off.sight * turn / distance**3
        by[0, 0], by[0, 1], by[0, 2] = by_place.imag, by_place.real, -1.0
        by[1, 0], by[1, 1] = toward.real, toward.imag
        angle_variance = pairs.azimuth_sigma[row] ** 2 + (_MAP_SIGMA_M / distance) ** 2
        nearness_variance = (pairs.sigma_m[row] * pairs.nearness[row] ** 2) ** 2
        chi2 = off.angle**2 / angle_variance + off.nearness**2 / nearness_variance
        share = likelihood[row] / total[pairs.seen[row]] / (1.0 + chi2 / _CAUCHY_CHI2)
        for k in range(2):
            residual = off.angle if k == 0 else off.nearness
            weight = share / (angle_variance if k == 0 else nearness_variance)
            for a in range(3):
                step[a] -= weight * by[k, a] * residual
                for b in range(3):
                    information[a, b] += weight * by[k, a] * by[k, b]
    cholesky(information, 3)
    solve_cholesky(information, step)
    for k in range(3):
        step[k] = min(max(step[k], -_LONGEST_STEP), _LONGEST_STEP)
    return camera_m + complex(step[0], step[1]), turn * np.exp(1j * step[2])


@compiled
def _support(
    pairs: CandidatePairs, camera_m: ComplexArray, turn: ComplexArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return poses (k,) and pairs (k,) that agree, and the features (k, 7) of their residuals."""
    agrees: BoolArray = np.zeros((len(turn), len(pairs.seen)), np.bool_)
    for h in range(len(turn)):
        for row in range(len(pairs.seen)):
            chi2 = _residuals(pairs, row, camera_m[h], turn[h], _LEFT).chi2
            agrees[h, row] = chi2 < np.inf
    pose, pair = np.nonzero(agrees)
    feature = np.empty((len(pose), 7))
    for k in range(len(pose)):
        row = pair[k]
        off = _residuals(pairs, row, camera_m[pose[k]], turn[pose[k]], _LEFT)
        feature[k, 0] = off.angle**2 / off.angle_variance / 3.0
        feature[k, 1] = off.nearness**2 / off.nearness_variance / 3.0
        feature[k, 2] = 0.5 * np.log(off.angle_variance) + 4.0
        feature[k, 3] = 0.5 * np.log(off.nearness_variance) + 5.0
        feature[k, 4] = np.log(abs(off.sight)) - 2.7
        feature[k, 5] = min(pairs.off[row, 0] ** 2, 16.0) / 4.0
        feature[k, 6] = min(max(pairs.off[row, 1], -6.0), 6.0) / 2.0
    return pose, pair, feature


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
