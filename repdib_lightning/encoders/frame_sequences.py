"""Videos, and features that were computed of their frames before, as sequences of vectors."""

from __future__ import annotations

from torch import Tensor, nn

from repdib_lightning.encoders.clip_steps import finite_only, observed_frames, observed_readings
from repdib_lightning.encoders.frame_differences import frame_input, input_channels
from repdib_lightning.encoders.frame_networks import frame_network
from repdib_lightning.encoders.recurrence import Recurrence
from repdib_lightning.encoders.segments import segment_frames


class FrameSequence(nn.Module):
    """Some frames of a video through a network each, a linear layer to d, and an LSTM (HAMLET, section III-A).

    Args:
        shape: (T, C, H, W).
        width: d.
        network: see :func:`~repdib_lightning.encoders.frame_networks.frame_network`, as the next two.
        norm: of a ResNet.
        weights: file that a ResNet starts from.
        frame_input: see :func:`~repdib_lightning.encoders.frame_differences.frame_input`.
        segments: see :func:`~repdib_lightning.encoders.segments.segment_frames`.
        layers: of the LSTM.
        dropout: of the vectors of the frames, and between the layers.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        width: int,
        *,
        network: str,
        norm: str,
        weights: str | None,
        frame_input: str,
        segments: int,
        layers: int,
        dropout: float,
    ) -> None:
        super().__init__()
        self.segments, self.frame_input = segments, frame_input
        channels, *size = shape[1:]
        seen = (input_channels(frame_input, channels), *size)
        self.network, inputs = frame_network(network, seen, norm, weights)
        self.project = nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Dropout(dropout))
        self.recurrence = Recurrence(width, layers, dropout)

    def forward(self, video: Tensor) -> tuple[Tensor, Tensor]:
        """(N, T, C, H, W) uint8 to step vectors (N, T', d), and which of them were observed, (N, T') bool."""
        frames = segment_frames(video, self.segments, training=self.training)
        observed = observed_frames(frames)
        seen = frame_input(frames, observed, self.frame_input)
        steps = self.project(self.network(seen.flatten(0, 1))).unflatten(0, observed.shape)
        return self.recurrence(steps, observed), observed


class FeatureSequence(nn.Module):
    """As :class:`FrameSequence`, of frames whose features (T, X) were computed before.

    Args:
        shape: (T, X).
        width: d.
        segments: as there, with the rest.
        layers: of the LSTM.
        dropout: of the vectors of the frames, and between the layers.
    """

    def __init__(self, shape: tuple[int, ...], width: int, *, segments: int, layers: int, dropout: float) -> None:
        super().__init__()
        self.segments = segments
        self.project = nn.Sequential(nn.LayerNorm(shape[1]), nn.Linear(shape[1], width), nn.ReLU(), nn.Dropout(dropout))
        self.recurrence = Recurrence(width, layers, dropout)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """(N, T, X) float to step vectors (N, T', d), and which of them were observed, (N, T') bool."""
        chosen = segment_frames(features, self.segments, training=self.training)
        observed = observed_readings(chosen)
        steps = self.project(finite_only(chosen))
        return self.recurrence(steps, observed), observed
