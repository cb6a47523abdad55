"""Poses that couples propose, fitted to the candidate pairs that agree, and what these say."""

from typing import NamedTuple

import torch
from torch import Tensor

from semviz_core.learning.candidates.combos import of_one_sample, rows_of
from semviz_core.learning.candidates.headings import USUAL_FIX_SIGMAS, Compass
from semviz_core.learning.candidates.pairs import NEAREST_M, Pairs

SUPPORT_FEATURES, POSE_FEATURES = 7, 3
_DOUBTS = ((1.2, 0.05), (0.6, 0.02))
"""How far off (m, rad) poses are before each fit: widens what agrees."""
_LEFT = (0.3, 0.01)
"""How far off fitted poses are."""
_MOST_CHI2 = 12.0
_CAUCHY_CHI2 = 4.0
_NOTHING = 0.05
"""Likelihood that a seen element is none of the mapped ones, against a perfect pair."""
_MAP_SIGMA_M = 0.15
_STAY = (0.5, 0.5, 10.0)
"""Square roots of the information that a pose stays where it is, per metre and radian."""
_LONGEST_STEP = 2.0


class Poses(NamedTuple):
    """h upright cameras."""

    sample: Tensor  # (h,)
    camera_m: Tensor  # (h,) complex
    turn: Tensor  # (h,) complex, unit: from the level frame to the local one

    def to_prior(self, fix_sigma_m: Tensor, compass: Compass) -> Tensor:
        """(h, POSE_FEATURES): how far they are from fixes with ``fix_sigma_m`` (b,) and compass."""
        from_fix = self.camera_m.abs() / fix_sigma_m[self.sample]
        chi2 = compass.chi2(self.sample, torch.angle(self.turn), _LEFT[1] ** 2)
        features = [
            from_fix.square().clamp_max(12.0) / 3.0,
            (from_fix - USUAL_FIX_SIGMAS).abs().clamp_max(2.0),
            chi2.clamp_max(16.0) / 5.0,
        ]
        return torch.stack(features, dim=1)


class Support(NamedTuple):
    """k pairs that agree with poses."""

    pose: Tensor  # (k,)
    pair: Tensor  # (k,)
    feature: Tensor  # (k, SUPPORT_FEATURES)


class _Off(NamedTuple):
    """By how much k pairs are off under poses."""

    pose: Tensor
    pair: Tensor
    sight: Tensor  # complex: from the camera to the mapped element, in the level frame
    angle: Tensor  # rad, of azimuths
    nearness: Tensor  # of 1 / distance
    angle_variance: Tensor
    nearness_variance: Tensor

    @property
    def chi2(self) -> Tensor:
        """(k,)"""
        return (
            self.angle.square() / self.angle_variance
            + self.nearness.square() / self.nearness_variance
        )


def fitted(poses: Poses, pairs: Pairs, size: int) -> Poses:
    """Poses of ``size`` samples, fitted to the pairs that agree with them."""
    for doubt in _DOUBTS:
        poses = _stepped(poses, pairs, _agreeing(poses, pairs, size, *doubt))
    return poses


def support(poses: Poses, pairs: Pairs, size: int) -> Support:
    """What agrees with fitted poses."""
    off = _agreeing(poses, pairs, size, *_LEFT)
    anchor, end = pairs.off[off.pair].unbind(dim=1)
    features = [
        off.angle.square() / off.angle_variance / 3.0,
        off.nearness.square() / off.nearness_variance / 3.0,
        0.5 * off.angle_variance.log() + 4.0,
        0.5 * off.nearness_variance.log() + 5.0,
        off.sight.abs().log() - 2.7,
        anchor.square().clamp_max(16.0) / 4.0,
        end.clamp(-6.0, 6.0) / 2.0,
    ]
    return Support(off.pose, off.pair, torch.stack(features, dim=1))


def _agreeing(poses: Poses, pairs: Pairs, size: int, doubt_m: float, doubt_rad: float) -> _Off:
    """Pairs whose azimuth and distance agree with poses that are off by the doubt."""
    pose, pair = of_one_sample(poses.sample, pairs.sample, size)
    back, against = poses.turn.conj()[pose], pairs.direction.conj()[pair]
    sight = (pairs.place_m[pair] - poses.camera_m[pose]) * back
    relative = torch.view_as_real(sight * against)
    ahead, beside = relative.unbind(dim=1)
    own = pairs.azimuth_sigma.square() + doubt_rad**2
    wide_m2 = _MAP_SIGMA_M**2 + doubt_m**2
    most = _MOST_CHI2 * (own[pair] * relative.square().sum(dim=1) + wide_m2)
    kept = rows_of((ahead > 0.0) & (beside.square() < most))
    pose, pair, sight, ahead, beside = (
        one.index_select(0, kept) for one in (pose, pair, sight, ahead, beside)
    )
    turn, direction = poses.turn[pose], pairs.direction[pair]
    angle = torch.atan2(beside, ahead)
    distance = torch.hypot(ahead, beside).clamp_min(NEAREST_M)
    variance = own[pair] + wide_m2 / distance.square()
    uphill = (pairs.rise[pair].conj() * direction * turn).real
    nearness = 1.0 / distance - pairs.nearness[pair] + pairs.by_slope[pair] * uphill
    spread = pairs.nearness_variance[pair] + (doubt_m / distance.square()).square()
    off = _Off(pose, pair, sight, angle, nearness, variance, spread)
    kept = rows_of(off.chi2 < _MOST_CHI2)
    return _Off(*(one.index_select(0, kept) for one in off))


def _stepped(poses: Poses, pairs: Pairs, off: _Off) -> Poses:
    """After a Gauss-Newton step of place and heading."""
    turn = poses.turn[off.pose]
    distance = off.sight.abs().clamp_min(NEAREST_M)
    by_place = -turn.conj() / off.sight  # the angle grows by Im(by_place dx)
    toward = off.sight * turn / distance**3
    zero, one = torch.zeros_like(distance), torch.ones_like(distance)
    rows = [by_place.imag, by_place.real, -one, toward.real, toward.imag, zero]
    J = torch.stack(rows, dim=1).view(-1, 2, 3)
    angle_variance = pairs.azimuth_sigma[off.pair].square() + (_MAP_SIGMA_M / distance).square()
    variance = torch.stack([angle_variance, pairs.nearness_variance[off.pair]], dim=1)
    residual = torch.stack([off.angle, off.nearness], dim=1)
    doubtless = 1.0 + (residual.square() / variance).sum(dim=1) / _CAUCHY_CHI2
    weight = (_shares(off, pairs) / doubtless)[:, None] / variance
    weighted = (weight[:, :, None] * J).mT
    h = len(poses.sample)
    stay = torch.diag(torch.tensor(_STAY, device=weight.device).square())
    information = stay.repeat(h, 1, 1).index_add(0, off.pose, weighted @ J)
    right = torch.zeros_like(information[:, 0]).index_add(
        0, off.pose, (weighted @ residual[:, :, None])[..., 0]
    )
    step = torch.linalg.solve(information, -right).clamp(-_LONGEST_STEP, _LONGEST_STEP)
    return Poses(
        poses.sample,
        poses.camera_m + torch.complex(step[:, 0], step[:, 1]),
        poses.turn * torch.polar(torch.ones_like(step[:, 2]), step[:, 2]),
    )


def _shares(off: _Off, pairs: Pairs) -> Tensor:
    """(k,) of each seen element, among the mapped ones that it may be, and nothing."""
    seen = int(pairs.seen.max()) + 1 if len(pairs.seen) else 1
    row = off.pose * seen + pairs.seen[off.pair]
    likelihood = torch.exp(-0.5 * off.chi2)
    rows = seen * (int(off.pose.max()) + 1 if len(off.pose) else 1)
    total = torch.full((rows,), _NOTHING, device=row.device).index_add(0, row, likelihood)
    return likelihood / total[row]
