"""Small perceptrons."""

import torch
from torch import Tensor, nn


def perceptron(inputs: int, hidden: int, outputs: int) -> nn.Module:
    """With one hidden layer."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def single(network: nn.Module, inputs: list[Tensor]) -> Tensor:
    """(...,) float32, the one number that comes of inputs (..., k) side by side."""
    found: Tensor = network(torch.cat(inputs, dim=-1))[..., 0].float()
    return found
