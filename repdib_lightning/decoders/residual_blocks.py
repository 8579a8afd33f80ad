"""The mirror image of :class:`~repdib_lightning.encoders.residual_blocks.ResidualEncoder`."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.decoders.base import Decoder
from repdib_lightning.encoders.residual_blocks import (
    ResidualBlock,
    check_sizes,
    halved_sizes,
    stage_widths,
)
from repdib_lightning.encoders.views import image_views
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


class ResidualDecoder(Decoder):
    """Doubles a small map ``stages`` times, with residual blocks at every size, until it has the picture's size.

    Args:
        spec: observations; the picture gives the sizes.
        width: M, of the latent.
        channels: of the largest map; twice as many at the next, four times at all smaller ones.
        stages: doublings.
        blocks: residual blocks at every size.
        grid: the latent is a grid of positions, as an encoder with ``grid`` and as many stages gives it; otherwise a
            linear layer spreads it over the smallest map.
        view: name of the picture; the only one by default.

    Raises:
        UserError: as the encoder, or a width that no grid of this size has.
    """

    def __init__(
        self,
        spec: DataSpec,
        width: int,
        *,
        channels: int = 32,
        stages: int = 4,
        blocks: int = 1,
        grid: bool = False,
        view: str | None = None,
    ) -> None:
        name = type(self).__name__
        view = single_view(spec, view, name)
        shape = spec.observations[view].shape
        super().__init__(spec, width, view)
        check_sizes(name, shape, channels, stages, blocks)
        self.sizes = halved_sizes(shape, stages)[::-1]
        positions = self.sizes[0][0] * self.sizes[0][1]
        widths = stage_widths(channels, stages)[::-1]
        if grid and width % positions:
            raise UserError(
                f"{name}: {stages} stages leave {self.sizes[0][0]} x {self.sizes[0][1]} positions, which do not share "
                f"a latent of {width}; give encoder and decoder the same stages and grid"
            )
        self.head = nn.Conv2d(width // positions, widths[0], 1) if grid else nn.Linear(width, widths[0] * positions)
        self.stages = nn.ModuleList()
        for before, after in zip(widths, [*widths[1:], channels], strict=True):
            layers: list[nn.Module] = [ResidualBlock(before) for _ in range(blocks)]
            self.stages.append(nn.Sequential(*layers, nn.ReLU(), nn.Conv2d(before, after, 3, padding=1)))
        self.last = nn.Conv2d(channels, shape[0], 3, padding=1)

    def forward(self, latents: Tensor) -> Tensor:
        """Draw (N, M) as (N, S * C, H, W), 0 to 1 up to errors."""
        height, width = self.sizes[0]
        if isinstance(self.head, nn.Linear):
            maps: Tensor = self.head(latents).unflatten(1, (-1, height, width))
        else:
            maps = self.head(latents.unflatten(1, (height * width, -1)).transpose(1, 2).unflatten(2, (height, width)))
        maps = maps.contiguous(memory_format=torch.channels_last)  # (N, H, W, C) in memory: fastest on a CPU
        for stage, size in zip(self.stages, self.sizes[1:], strict=True):
            maps = F.interpolate(stage(maps), size=size, mode="nearest")
        drawn: Tensor = self.last(F.relu(maps)) + 0.5  # untrained, it draws grey
        return drawn


def single_view(spec: DataSpec, view: str | None, owner: str) -> str:
    """The picture that is drawn: the one chosen, or the only one.

    Raises:
        UserError: no picture, several of which none is chosen, or an unknown one.
    """
    found = image_views(spec, None if view is None else [view], owner)
    if len(found) > 1:
        raise UserError(f"{owner}: the data has several pictures ({', '.join(found)}); choose one as view")
    return found[0]
