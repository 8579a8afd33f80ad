"""A recurrent network over the steps of a clip."""

from __future__ import annotations

from torch import Tensor, nn

from repdib_lightning.encoders.clip_steps import zero_unobserved


class Recurrence(nn.Module):
    """An LSTM that runs forward over (N, T, d), with zeros at what was not observed, before and after.

    What stands in an unobserved step never enters, and a step sees nothing behind it, so the padding of short clips
    needs no packing.

    Args:
        width: d, of the input and of the state.
        layers: of the LSTM; 0 leaves the steps as they are.
        dropout: between the layers.
    """

    def __init__(self, width: int, layers: int, dropout: float) -> None:
        super().__init__()
        between = dropout if layers > 1 else 0.0
        self.network = nn.LSTM(width, width, layers, batch_first=True, dropout=between) if layers else None

    def forward(self, steps: Tensor, observed: Tensor) -> Tensor:
        """(N, T, d) and (N, T) bool to (N, T, d)."""
        steps = zero_unobserved(steps, observed)
        return steps if self.network is None else zero_unobserved(self.network(steps)[0], observed)
