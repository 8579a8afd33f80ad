"""Readings of sensors as sequences of vectors."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.clip_steps import observed_readings
from repdib_lightning.encoders.recurrence import Recurrence
from repdib_lightning.encoders.window_convolutions import WindowConvolutions
from repdib_lightning.encoders.window_statistics import WindowStatistics
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import ArraySpec

NETWORKS = ("convolution", "statistics")


class SensorSequence(nn.Module):
    """Windows of readings through two 1-D convolutions, a maximum over time and a linear layer to d, then an LSTM.

    HAMLET's encoder of sensors (section III-A), with zeros for what is missing after the normalisation: the mean. A
    window is a step of the clip if at least half of its readings were observed. Instead of the convolutions'
    maximum it can look at standardised statistics of each window (:class:`WindowStatistics`): data of few people
    suffice for these.

    Args:
        name: of the sensor, for messages.
        array: (T, X) with the statistics of its channels.
        width: d.
        network: of a window, ``convolution`` or ``statistics``.
        window: readings of a window.
        stride: readings from one window to the next.
        channels: of the convolutions.
        layers: of the LSTM.
        dropout: of the vectors of the windows, and between the layers.
        angles: the readings are degrees, and enter as sine and cosine.

    Raises:
        UserError: a window that is longer than the clip, or an unknown network.
    """

    mean: Tensor
    std: Tensor

    def __init__(
        self,
        name: str,
        array: ArraySpec,
        width: int,
        *,
        network: str,
        window: int,
        stride: int,
        channels: int,
        layers: int,
        dropout: float,
        angles: bool,
    ) -> None:
        super().__init__()
        readings, inputs = array.shape
        if window > readings:
            raise UserError(f"MultimodalEncoder: window {window} is longer than the {readings} readings of '{name}'")
        if network not in NETWORKS:
            raise UserError(f"MultimodalEncoder: unknown sensor_network '{network}', {nearest(network, NETWORKS)}")
        self.window, self.stride, self.angles = window, stride, angles
        mean, std = channel_statistics(array)
        self.register_buffer("mean", mean, persistent=False)
        self.register_buffer("std", std, persistent=False)
        inputs = 2 * inputs if angles else inputs
        self.network = WindowConvolutions(inputs, channels) if network == "convolution" else WindowStatistics(inputs)
        self.project = nn.Sequential(nn.Linear(self.network.width, width), nn.ReLU(), nn.Dropout(dropout))
        self.recurrence = Recurrence(width, layers, dropout)

    def forward(self, readings: Tensor) -> tuple[Tensor, Tensor]:
        """(N, T, X) float32 to step vectors (N, T', d), and which of them were observed, (N, T') bool."""
        share = observed_readings(readings).to(self.mean.dtype).unfold(1, self.window, self.stride).mean(-1)
        observed = share >= 0.5
        windows = self._normalised(readings).unfold(1, self.window, self.stride)  # (N, T', X, window)
        looked_at = self.network(windows.flatten(0, 1), observed.flatten())
        steps = self.project(looked_at).unflatten(0, observed.shape)
        return self.recurrence(steps, observed), observed

    def _normalised(self, readings: Tensor) -> Tensor:
        wide = readings.to(self.mean.dtype)
        if not self.angles:
            return (wide - self.mean) / self.std
        radians = wide * (math.pi / 180)
        return torch.cat([radians.sin(), radians.cos()], dim=-1)


def channel_statistics(array: ArraySpec) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each channel, (X,); 0 and 1 where nothing was measured, 1 of a constant."""
    channels = array.shape[-1]
    mean = torch.tensor(array.mean or (0.0,) * channels, dtype=torch.get_default_dtype())
    std = torch.tensor(array.std or (1.0,) * channels, dtype=torch.get_default_dtype())
    return mean, torch.where(std > 1e-6, std, 1.0)
