"""Strided convolutions with residual blocks: the encoder of autoencoders, for pictures of any size."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from repdib_lightning.encoders.base import Encoder
from repdib_lightning.encoders.views import centred, image_views, seen_only
from repdib_lightning.errors import UserError
from repdib_lightning.records import DataSpec


class ResidualEncoder(Encoder):
    """Halves a picture ``stages`` times, with residual blocks at every size, then maps it to M.

    The paper's demonstration on PACS has "CNN and ResNet blocks" and a latent of 32 at 224 px, and no more detail; this
    is the shape of VQ-VAE's encoder (van den Oord et al. 2017, section 4.1).

    With ``grid`` every position of the last map keeps a vector of its own: the latent is P vectors of ``features``,
    one after the other, the bottleneck takes each of them alone, and a picture has P * G codes. Without it there is one
    vector, and G codes a picture. The paper leaves open which of both it has.

    Args:
        spec: observations; pictures of any size and channel count, each with convolutions of its own.
        features: width of the latent, or of each position's with ``grid``.
        channels: of the first map; twice as many at the second size, four times from the third on.
        stages: halvings. 4 leave 4 x 4 positions of 64 px and 14 x 14 of 224; 6 leave 4 x 4 of 224.
        blocks: residual blocks at every size.
        grid: keep the positions apart; of one picture only.
        views: names of the pictures to use; all by default.

    Raises:
        UserError: no picture, an unknown one, several with ``grid``, or a picture smaller than the halvings.
    """

    def __init__(
        self,
        spec: DataSpec,
        *,
        features: int = 32,
        channels: int = 32,
        stages: int = 4,
        blocks: int = 1,
        grid: bool = False,
        views: list[str] | None = None,
    ) -> None:
        name = type(self).__name__
        views = image_views(spec, views, name)
        if grid and len(views) > 1:
            raise UserError(f"{name}: a grid is of one picture, the data has {', '.join(views)}; choose one with views")
        shapes = {view: spec.observations[view].shape for view in views}
        for shape in shapes.values():
            check_sizes(name, shape, channels, stages, blocks)
        places = [height * width for height, width in (halved_sizes(shape, stages)[-1] for shape in shapes.values())]
        super().__init__(seen_only(spec, views), features * (places[0] if grid else 1))
        self.views, self.positions = views, places[0] if grid else 1
        self.stacks = nn.ModuleDict({view: _stack(shapes[view][0], channels, stages, blocks) for view in views})
        last = stage_widths(channels, stages)[-1]
        self.head = nn.Conv2d(last, features, 1) if grid else nn.Linear(last * sum(places), features)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """Encode name -> (N, S * C, H, W) uint8 into (N, M); with a grid M is (position, feature), rows first."""
        maps = [self.stacks[view](centred(observations[view])) for view in self.views]
        if isinstance(self.head, nn.Conv2d):
            grid: Tensor = self.head(maps[0])
            return grid.flatten(2).transpose(1, 2).flatten(1)
        latent: Tensor = self.head(torch.cat([part.flatten(1) for part in maps], dim=1))
        return latent


def _stack(in_channels: int, channels: int, stages: int, blocks: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for before, after in pairwise([in_channels, *stage_widths(channels, stages)]):
        layers.append(nn.Conv2d(before, after, 3, stride=2, padding=1))
        layers += [ResidualBlock(after) for _ in range(blocks)]
    return nn.Sequential(*layers, nn.ReLU())


class ResidualBlock(nn.Module):
    """x + convolutions of x (He et al. 2016, with the ReLUs in front), on (N, C, H, W).

    Args:
        channels: C.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.branch = nn.Sequential(
            nn.GroupNorm(1, channels),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 1),
        )

    def forward(self, maps: Tensor) -> Tensor:
        """(N, C, H, W) to the same."""
        summed: Tensor = maps + self.branch(maps)
        return summed


def stage_widths(channels: int, stages: int) -> list[int]:
    """Channels after each halving."""
    return [channels * min(2**stage, 4) for stage in range(stages)]


def halved_sizes(shape: tuple[int, ...], stages: int) -> list[tuple[int, int]]:
    """Height and width before and after each halving, rounded up: ``stages + 1`` pairs."""
    sizes = [(shape[1], shape[2])]
    for _ in range(stages):
        height, width = sizes[-1]
        sizes.append(((height + 1) // 2, (width + 1) // 2))
    return sizes


def check_sizes(owner: str, shape: tuple[int, ...], channels: int, stages: int, blocks: int) -> None:
    """Raise UserError for numbers out of range, or halvings that leave less than 2 pixels."""
    if channels < 1 or stages < 1 or blocks < 0:
        raise UserError(f"{owner}: channels ({channels}) and stages ({stages}) must be at least 1, blocks not negative")
    smallest = min(shape[1:])
    most = max(smallest - 1, 1).bit_length() - 1
    if stages > most:
        raise UserError(f"{owner}: {stages} stages are too many for {shape[1]} x {shape[2]} pixels; at most {most}")
