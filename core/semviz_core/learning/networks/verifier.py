"""The verifier's weights as torch trains them; what they do is in ``learning.verification``."""

import torch
from torch import Tensor, nn

from semviz_core.learning.verification import layer_sizes, log_odds


class Verifier(nn.Module):
    """Probabilities of modes."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        for name, (inputs, outputs) in layer_sizes(classes).items():
            self.add_module(name, nn.Linear(inputs, outputs))
        for name in ("right", "straight", "none"):
            nn.init.zeros_(self.get_parameter(f"{name}.weight"))
            nn.init.zeros_(self.get_parameter(f"{name}.bias"))

    def forward(
        self,
        mode: Tensor,
        weight: Tensor,
        mapped: Tensor,
        near: Tensor,
        seen: Tensor,
        is_seen: Tensor,
    ) -> Tensor:
        """(f, b + 1) log-probabilities that each mode, or in the end none, is right."""
        right, none = log_odds(
            dict(self.named_parameters()), mode, weight, mapped, near, seen, is_seen
        )
        right = right.masked_fill(weight == 0.0, -torch.inf)
        return torch.cat([right, none[:, None]], dim=1).log_softmax(dim=1)
