"""Seen elements with gravity taken out: azimuths and slopes, of a batch at once.

The same as ``solving.upright`` does for one frame, in tensors.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from semviz_core.learning.batch import Batch
from semviz_core.solving.upright import (
    ASSUMED_UP,
    ASSUMED_UP_SIGMA_RAD,
    CAUCHY_SIGMAS,
    POLE_LEAN_RAD,
)

_LEAST_LENGTH = 1e-4  # of what is seen of a line (rad); shorter ones are points
_EXACT_RAD = 0.01  # unit of the sigma among the prior's numbers


@dataclass(frozen=True, eq=False)
class Level:
    """Seen elements in the level frame: x is the optical axis laid flat, z is up."""

    direction: Tensor
    """(b, m) complex, of length 1: where the element is, x + iy; of a pole, its middle."""
    slope: Tensor
    """(b, m, 2) tangents of the elevation of anchor and end."""
    up_sigma_rad: Tensor
    """(b,)"""


def levelled(batch: Batch) -> Level:
    """Gravity is the prior's, or a camera's that looks about level, with that of seen poles."""
    up, sigma = _up(batch)
    ahead, left = _across(up)
    R = torch.stack([ahead, left, up], dim=1)
    anchor, end = batch.ray @ R.mT, batch.bottom_ray @ R.mT
    middle = (anchor + end)[..., :2]
    unit = middle / middle.norm(dim=2, keepdim=True).clamp_min(1e-9)
    slope = [one[..., 2] / one[..., :2].norm(dim=2).clamp_min(1e-3) for one in (anchor, end)]
    return Level(torch.view_as_complex(unit.contiguous()), torch.stack(slope, dim=2), sigma)


def _up(batch: Batch) -> tuple[Tensor, Tensor]:
    """(b, 3) up in camera axes and (b,) its sigma: the prior and the vertical vanishing point of
    the poles, least squares, reweighted (Cauchy) since a false pole may lean anyhow."""
    start, information = _prior_up(batch)
    x, y = _across(start)
    normal = torch.linalg.cross(batch.ray, batch.bottom_ray)
    length = normal.norm(dim=2).clamp_min(1e-9)
    normal = normal / length[..., None]
    line = batch.seen & (length > _LEAST_LENGTH)
    variance = 2.0 * (batch.sigma_rad[..., 0] / length).square() + POLE_LEAN_RAD**2
    off, by_x, by_y = ((normal * axis[:, None]).sum(dim=2) for axis in (start, x, y))
    tilt_x = tilt_y = torch.zeros_like(information)
    for _ in range(3):
        left = off + by_x * tilt_x[:, None] + by_y * tilt_y[:, None]
        weight = torch.where(line, 1.0 / (variance + left.square() / CAUCHY_SIGMAS**2), 0.0)
        a = (weight * by_x.square()).sum(dim=1) + information
        b = (weight * by_x * by_y).sum(dim=1)
        d = (weight * by_y.square()).sum(dim=1) + information
        right_x, right_y = (weight * by_x * off).sum(dim=1), (weight * by_y * off).sum(dim=1)
        determinant = a * d - b.square()
        tilt_x = (b * right_y - d * right_x) / determinant
        tilt_y = (b * right_x - a * right_y) / determinant
    up = torch.nn.functional.normalize(start + tilt_x[:, None] * x + tilt_y[:, None] * y, dim=1)
    return up, torch.sqrt(0.5 * (a + d) / determinant)


def _prior_up(batch: Batch) -> tuple[Tensor, Tensor]:
    """(b, 3) and (b,) information (1 / rad^2): the prior's, or that of cameras on vehicles."""
    given = batch.prior[:, :3]
    known = given.square().sum(dim=1) > 0.5
    assumed = torch.as_tensor(ASSUMED_UP, dtype=given.dtype, device=given.device)
    sigma = torch.where(known, _EXACT_RAD * batch.prior[:, 3].exp(), ASSUMED_UP_SIGMA_RAD)
    return torch.where(known[:, None], given, assumed), sigma**-2


def _across(up: Tensor) -> tuple[Tensor, Tensor]:
    """(b, 3) units across ``up`` (b, 3): the optical axis laid flat, and left of it."""
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=up.dtype, device=up.device)
    ahead = torch.nn.functional.normalize(axis - up * up[:, 2:], dim=1)
    return ahead, torch.linalg.cross(up, ahead)
