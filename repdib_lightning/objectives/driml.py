"""Deep reinforcement and InfoMax learning: recognise the future that a state and an action lead to."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.errors import UserError
from repdib_lightning.objectives.contrast import TemporalContrast
from repdib_lightning.records import DataSpec


class DRIML(TemporalContrast):
    """Action-conditioned temporal contrast with a separable critic (DRIML, Mazoure et al. 2020, and its published
    program).

    The score of a pair is psi1([z_t, e(a_t)]) . psi2(z_{t+k}) / sqrt(H), softly clipped to (-clip, clip) by
    clip * tanh(score / clip). psi1, psi2 and e are blocks of one hidden ReLU layer beside a linear skip. The critic
    is not told k, which the data module draws from 1..K: the published k in {1, 2} is ``data.horizon: 2``.

    This is the paper's global-global term. Its local terms compare positions of a feature map, of which the bottleneck
    leaves one vector. Weights start as torch's layers do, where the published ones start orthogonal.

    Args:
        width: M.
        spec: the actions.
        hidden: H, width of psi1 and psi2, hidden and out (512 as published).
        action_features: width of e, hidden and out (64 as published); without effect where no action is fed.
        clip: bound of the scores.
        feed_action: condition on the action; without it, this is contrast over time alone.

    Raises:
        UserError: ``feed_action`` with data without actions, or an option out of range.
    """

    needs_actions = True

    def __init__(
        self,
        width: int,
        spec: DataSpec,
        *,
        hidden: int = 512,
        action_features: int = 64,
        clip: float = 20.0,
        feed_action: bool = True,
    ) -> None:
        super().__init__(spec)
        for name, value in (("hidden", hidden), ("action_features", action_features)):
            if value < 1:
                raise UserError(f"DRIML: {name} must be at least 1, is {value}")
        if not (clip > 0 and math.isfinite(clip)):
            raise UserError(f"DRIML: clip must be a positive number, is {clip}")
        if feed_action and spec.actions is None:
            raise UserError(
                "DRIML: feeds actions to its critic, but the data has none ('actions' is missing); set feed_action to "
                "false"
            )
        self.hidden, self.clip, self.needs_actions = hidden, clip, feed_action
        self.actions = spec.actions if feed_action else None
        self.action_encoder = None
        if self.actions is not None:
            self.action_encoder = SkipBlock(self.actions.size, action_features, action_features)
        self.anchor_block = SkipBlock(width + (action_features if feed_action else 0), hidden, hidden)
        self.future_block = SkipBlock(width, hidden, hidden)

    def describe_anchors(self, latents: Tensor, actions: Tensor | None) -> Tensor:
        """psi1: anchors (B, M) and actions (B,) int64 or (B, A) to (B, H)."""
        if self.action_encoder is not None and self.actions is not None:
            assert actions is not None
            if self.actions.kind == "discrete":
                actions = F.one_hot(actions, self.actions.size)
            latents = torch.cat([latents, self.action_encoder(actions.to(latents.dtype))], dim=-1)
        described: Tensor = self.anchor_block(latents)
        return described

    def describe_futures(self, latents: Tensor) -> Tensor:
        """psi2: futures (..., M) to (..., H)."""
        described: Tensor = self.future_block(latents)
        return described

    def score(self, products: Tensor) -> Tensor:
        """Scale by 1 / sqrt(H) and clip softly."""
        return self.clip * torch.tanh(products / (math.sqrt(self.hidden) * self.clip))


class SkipBlock(nn.Module):
    """One hidden ReLU layer beside a linear skip: (..., inputs) to (..., outputs).

    Args:
        inputs, hidden, outputs: widths.
    """

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))
        self.skip = nn.Linear(inputs, outputs, bias=False)

    def forward(self, rows: Tensor) -> Tensor:
        """The sum of both paths."""
        mapped: Tensor = self.layers(rows) + self.skip(rows)
        return mapped
