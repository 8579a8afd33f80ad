"""A slowly following copy of a module, as a target that does not run away."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.func import functional_call

from repdib_lightning.bottlenecks.precision import SinglePrecision


class MomentumCopy(SinglePrecision):
    """The weights of a module as running averages: copy <- (1 - rate) copy + rate * weights (He et al. 2020).

    They are buffers: no optimiser moves them, checkpoints hold them, half precision leaves them float32. Processes
    that train the same weights keep the same copy. Buffers of the module itself are not averaged.

    Args:
        module: what is copied, at its weights of this moment.
        rate: in (0, 1].
    """

    def __init__(self, module: nn.Module, rate: float) -> None:
        super().__init__()
        self.rate = rate
        self.names = [name for name, _ in module.named_parameters()]
        for name, value in module.named_parameters():
            self.register_buffer(name.replace(".", "_"), value.detach().clone())

    @torch.no_grad()
    def follow(self, module: nn.Module) -> None:
        """Go a step towards the module's weights."""
        for name, value in module.named_parameters():
            average = self.get_buffer(name.replace(".", "_"))
            average.lerp_(value.to(average.dtype), self.rate)

    @torch.no_grad()
    def apply_to(self, module: nn.Module, rows: Tensor) -> Tensor:
        """What the module gives for (N, *) with these weights in place of its own; no gradient."""
        weights = {name: self.get_buffer(name.replace(".", "_")) for name in self.names}
        given: Tensor = functional_call(module, weights, (rows.to(weights[self.names[0]].dtype),))
        return given
