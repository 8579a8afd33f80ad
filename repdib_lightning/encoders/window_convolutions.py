"""Learned features of windows of readings."""

from __future__ import annotations

from torch import Tensor, nn

from repdib_lightning.encoders.clip_steps import finite_only


class WindowConvolutions(nn.Module):
    """Two 1-D convolutions and a maximum over time (HAMLET, section III-A), with zeros for what is missing.

    Args:
        inputs: X.
        channels: of the convolutions.
    """

    def __init__(self, inputs: int, channels: int) -> None:
        super().__init__()
        self.width = channels
        first, second = nn.Conv1d(inputs, channels, 3, padding=1), nn.Conv1d(channels, channels, 3, padding=1)
        self.layers = nn.Sequential(first, nn.ReLU(), second, nn.ReLU())

    def forward(self, windows: Tensor, observed: Tensor) -> Tensor:
        """(n, X, window), which may have NaN, to (n, channels); ``observed`` is not looked at."""
        return self.layers(finite_only(windows)).amax(-1)
