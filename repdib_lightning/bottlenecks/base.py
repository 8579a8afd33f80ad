"""The contract of a bottleneck: the slot between an encoder and an objective."""

from __future__ import annotations

from torch import Tensor

from repdib_lightning.arguments import RememberedArguments
from repdib_lightning.errors import UserError
from repdib_lightning.records import BottleneckOutput

DEFAULT_LOSS_WEIGHTS = {
    "kl": 0.01,
    "commitment": 0.25,
    "information": 1e-4,
    "forward": 0.1,
    "emi_error": 100.0,
    "emi_information": 0.1,
    "emi_action_kl": 0.5,
    "db_kl": 0.01,
    "db_prediction": 0.01,
    "db_contrast": 0.01,
}
"""Weight of each named loss term; every other term weighs 1.

``kl``: VIB coefficient of the paper, in all three tables. ``commitment``: VQ-VAE.

``information`` (SVIB): published nowhere. A nat costs what it costs the VIB, whose 0.01 weighs the mean over 128
dimensions. From 0.001 on, multi-step inverse dynamics in the mazes never starts: the latents become constant.

``forward``: ours, an auxiliary that must not outweigh its objective.

``emi_*``: the published program's for pixels (Atari); for states it has 1e4, 0.05 and 0.1.

``db_*``: a tenth of the published program's, whose terms stand alone (0.1 each; by game down to 0.001 for ``db_kl`` and
0.01 for ``db_contrast``). At those, multi-step inverse dynamics beside them never starts in the mazes.
"""


class Bottleneck(RememberedArguments):
    """Maps (N, M) to a :class:`BottleneckOutput` of the same width.

    Subclasses are built as ``Bottleneck(width, *, ...)``. In training mode a forward pass may draw noise and update
    buffers (running codebooks); in evaluation mode it is deterministic and changes no buffer. The latent has the
    input's dtype; everything inside is computed in float32 or wider, under autocast too.

    Attributes:
        width: M.
        groups: G, or 0 where nothing is quantised.
        codes: L, or 0 where nothing is quantised.
    """

    groups: int = 0
    codes: int = 0

    def __init__(self, width: int) -> None:
        super().__init__()
        if width < 1:
            raise UserError(f"{type(self).__name__}: width must be at least 1, is {width}")
        self.width = width

    @property
    def ready(self) -> bool:
        """Whether evaluation already gives what it will give after training (a quantiser may start late)."""
        return True

    def require_ready(self) -> None:
        """Raise UserError, with what to do about it, unless :attr:`ready`. For those who export or read codes."""

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Pass (N, M) float through the bottleneck."""
        raise NotImplementedError

    def decode(self, codes: Tensor) -> Tensor:
        """Map (N, G) int64 indices to the (N, M) latent that they stand for. Only where something is quantised."""
        raise UserError(f"{type(self).__name__}: has no codes to decode")

    def check_input(self, latent: Tensor) -> None:
        """Raise UserError unless ``latent`` is (N, M)."""
        if latent.ndim != 2 or latent.shape[1] != self.width:
            raise UserError(f"{type(self).__name__}: takes (N, {self.width}), was given {tuple(latent.shape)}")
