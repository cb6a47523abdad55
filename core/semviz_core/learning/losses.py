"""What the paper trains with: the correspondence loss (eq. 9) and the pose loss (eq. 10, 11)."""

import torch
from torch import Tensor

_NO_ANGLE = 1e-9
"""Below, angles and distances (rad, m) have no direction to go: their gradient fades to 0."""


def correspondence_loss(P: Tensor, pairs: Tensor, possible: Tensor) -> Tensor:
    """(b,) of eq. 9 for the P of ``transport.sinkhorn``: from 1, no mass on ``pairs``, to -1.

    With two differences from the paper, which gives no scale. All of P sums to the same whatever
    the network says, so only true pairs matter. And each counts alike, by its share of the most
    that uniform priors allow, the smaller of 1 / m and 1 / n of its block; as they stand, pairs of
    small blocks would count more and pairs of crowded maps hardly. Where m = n = the number of
    pairs in one block it is eq. 9.
    """
    seen_in_block, mapped_in_block = (
        possible.sum(dim=1, keepdim=True),
        possible.sum(dim=2)[..., None],
    )
    share = P * torch.maximum(seen_in_block, mapped_in_block)
    true = pairs & possible
    return 1.0 - 2.0 * (share * true).sum(dim=(1, 2)) / true.sum(dim=(1, 2)).clamp_min(1)


def pose_loss(
    rotation: Tensor, translation: Tensor, true_rotation: Tensor, true_translation: Tensor
) -> Tensor:
    """(b,) of eq. 10: the angle (rad) between two rotations (b, 3, 3) plus the distance (m).

    Like eq. 10 it compares translations of T_camera_local: where the angle is wrong, the camera is
    further off than that. The arccos of eq. 10 has no digits and no gradient near 0; this is the
    same angle by its sine and cosine.
    """
    between = true_rotation.transpose(1, 2) @ rotation
    cosine = 0.5 * (between.diagonal(dim1=1, dim2=2).sum(dim=1) - 1.0)
    twice = between - between.transpose(1, 2)
    sine = 0.5 * _length(torch.stack([twice[:, 2, 1], twice[:, 0, 2], twice[:, 1, 0]], dim=1))
    return torch.atan2(sine, cosine) + _length(translation - true_translation)


def whole_loss(correspondence: Tensor, pose: Tensor, ok: Tensor, gamma: float) -> Tensor:
    """Eq. 11, a mean over the batch; items whose pose is not ``ok`` (b,) have no pose loss."""
    return (correspondence + gamma * torch.where(ok, pose, 0.0)).mean()


def _length(vector: Tensor) -> Tensor:
    """(b,) of (b, 3)."""
    return torch.sqrt((vector**2).sum(dim=1) + _NO_ANGLE**2) - _NO_ANGLE
