"""The dynamic bottleneck: the paper's rival DB, as an auxiliary objective."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.bottlenecks.precision import at_least_single, without_autocast
from repdib_lightning.bottlenecks.variational import standard_normal_kl
from repdib_lightning.errors import UserError
from repdib_lightning.objectives.base import (
    Encode,
    Objective,
    action_vectors,
    next_latents,
    require_several,
    require_transitions,
)
from repdib_lightning.objectives.contrast import recognition
from repdib_lightning.objectives.momentum import MomentumCopy
from repdib_lightning.objectives.spread import centre_and_spread
from repdib_lightning.processes import gather_with_gradients, own_rows, rows_of_all
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput

_LEAST_SIGMA = 1e-3
_LEAST_SCALE = 0.1
_SLOPE = 0.2


class DynamicBottleneck(Objective):
    """A code c of latent and action that keeps what the next latent needs (DB, Bai et al. 2021, section 4, and its
    published program): maximise I(c; s'), minimise I([s, a]; c).

    With s the latent z_t, s' the latent z_{t+1} behind a stop-gradient and standardised (below), q(c | s, a) a
    Gaussian, r(s' | c) = N(g(c), scale^2), h a projection, h_m its momentum copy and N the samples of all processes::

        db_kl         = E KL(q(c | s, a) || N(0, I))                upper bound of I([s, a]; c), in nats
        db_prediction = E -log r(s' | c), summed over M             the negative of a lower bound of I(c; s')
        db_contrast   = E -log softmax_j(h(g(c_i))' W h_m(s'_j))_i  another: log N - db_contrast <= I(c; s')

    c is sampled in training and the mean in evaluation.

    Deviations. The published target s' comes from a momentum copy of the convolutional network; an objective has
    latents only, so that here the network itself makes it, behind a stop-gradient, and momentum is left for the
    projection. s' is moved and scaled to mean 0 and mean variance 1 over the batch, where the published program
    standardises observations: latents that start close together say nothing to a likelihood of scale 1, at which r
    starts, and the code collapses to its prior. g's mean is projected, where the published program projects a sample
    of r. W starts as the identity / sqrt(size) instead of uniform, at which scores start in the tens. The deviations of
    q and r approach their lower bounds of 0.001 and 0.1 smoothly instead of being cut there. The code is no part of
    what is exported: a frozen encoder gives the latent that DB has shaped. There is no intrinsic reward.

    Weights: a tenth of the published program's, see ``DEFAULT_LOSS_WEIGHTS``.

    Nothing alone prevents latents from becoming constant but ``db_contrast``, which then stays at log N; use it beside
    an objective that needs the state, in ``SeveralObjectives``.

    Metrics: ``db_contrast_accuracy`` and ``db_contrast_nats`` as those of :func:`recognition`; ``db_sigma``, mean
    deviation of q; ``db_scale``, that of r.

    Args:
        width: M.
        spec: the actions; ``data.next_frame`` must be on, or the horizon be 1.
        code: width of c (128 as published).
        hidden: width of the hidden layers (256 as published).
        projection: width of h (128 as published).
        momentum_rate: how far h_m follows h in a training step (0.001 as published).

    Raises:
        UserError: data without actions or without the next frame, or an option out of range.
    """

    needs_actions = True

    def __init__(
        self,
        width: int,
        spec: DataSpec,
        *,
        code: int = 128,
        hidden: int = 256,
        projection: int = 128,
        momentum_rate: float = 0.001,
    ) -> None:
        super().__init__()
        for name, value in (("code", code), ("hidden", hidden), ("projection", projection)):
            if value < 1:
                raise UserError(f"DynamicBottleneck: {name} must be at least 1, is {value}")
        if not 0 < momentum_rate <= 1:
            raise UserError(f"DynamicBottleneck: momentum_rate must be in (0, 1], is {momentum_rate}")
        self.spec, self.actions = spec, require_transitions("DynamicBottleneck", spec)
        self.transition = Transition(width, self.actions.size, hidden, 2 * code)
        self.prediction = Prediction(code, hidden, width)
        self.raw_scale = nn.Parameter(torch.tensor(math.log(math.expm1(1 - _LEAST_SCALE))))
        self.projection = nn.Sequential(
            nn.Linear(width, hidden),
            nn.LayerNorm(hidden),
            nn.ReLU(),
            nn.Linear(hidden, projection),
            nn.LayerNorm(projection),
        )
        self.bilinear = nn.Parameter(torch.eye(projection) / math.sqrt(projection))
        self.momentum = MomentumCopy(self.projection, momentum_rate)

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode (B, F) frames once and predict the second from the first. In training h_m goes a step towards h.

        Raises:
            UserError: training on a single sample.
        """
        assert batch.actions is not None
        require_several(self, rows_of_all(len(batch)), "tells the next frames of a batch apart")
        latents = encode(batch.observations)
        if self.training:
            self.momentum.follow(self.projection)
        with without_autocast(latents):
            latents = latents.to(self.bilinear.dtype)
            before, after = latents[:, 0], self._standardised(next_latents(latents, self.spec).detach())
            mean, sigma = self.encode_transition(before, action_vectors(batch.actions, self.actions, before))
            code = mean + sigma * _noise(mean) if self.training else mean
            predicted = self.prediction(code.to(before.dtype))
            scale = _LEAST_SCALE + F.softplus(self.raw_scale.to(sigma.dtype))
            contrast = self._contrast(predicted, after)
            losses = {
                "db_kl": standard_normal_kl(mean, 2 * sigma.log()).sum(-1).mean(),
                "db_prediction": _negative_log_likelihood(after.to(scale.dtype), predicted.to(scale.dtype), scale),
                "db_contrast": contrast.losses["contrast"],
            }
        metrics = {f"db_{name}": value for name, value in contrast.metrics.items()}
        return ObjectiveOutput(losses, metrics | {"db_sigma": sigma.detach().mean(), "db_scale": scale.detach()})

    def encode_transition(self, latents: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and deviation of q(c | s, a), (B, code) each in float32 or wider, from (B, M) and (B, A)."""
        parameters = self.transition(latents, actions)
        mean, raw = parameters.to(at_least_single(parameters.dtype)).chunk(2, dim=-1)
        return mean, _LEAST_SIGMA + F.softplus(raw)

    def _standardised(self, rows: Tensor) -> Tensor:
        centre, spread = centre_and_spread(rows.to(at_least_single(rows.dtype)))
        return ((rows - centre) / (spread / rows.shape[1]).sqrt()).to(rows.dtype)

    def _contrast(self, predicted: Tensor, after: Tensor) -> ObjectiveOutput:
        target = self.momentum.apply_to(self.projection, after)
        candidates, places = gather_with_gradients(target, equal=self.training)
        anchors = (self.projection(predicted) @ self.bilinear).to(candidates.dtype)
        return recognition((anchors @ candidates.T)[None], places)


class Transition(nn.Module):
    """(B, M) and actions (B, A) to (B, outputs): two residual blocks, and the action given to every layer."""

    def __init__(self, width: int, actions: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.enter = nn.Linear(width + actions, hidden)
        self.blocks = nn.ModuleList(ActionBlock(hidden, actions) for _ in range(2))
        self.leave = nn.Linear(hidden + actions, outputs)

    def forward(self, latents: Tensor, actions: Tensor) -> Tensor:
        """Parameters of q."""
        rows = F.leaky_relu(self.enter(torch.cat([latents, actions], dim=-1)), _SLOPE)
        for block in self.blocks:
            rows = block(rows, actions)
        parameters: Tensor = self.leave(torch.cat([rows, actions], dim=-1))
        return parameters


class ActionBlock(nn.Module):
    """A residual block on (B, hidden) both layers of which are given the action (B, A)."""

    def __init__(self, hidden: int, actions: int) -> None:
        super().__init__()
        self.first = nn.Linear(hidden + actions, hidden)
        self.second = nn.Linear(hidden + actions, hidden)

    def forward(self, rows: Tensor, actions: Tensor) -> Tensor:
        """Return (B, hidden)."""
        inner = F.leaky_relu(self.first(torch.cat([rows, actions], dim=-1)), _SLOPE)
        changed: Tensor = rows + self.second(torch.cat([inner, actions], dim=-1))
        return changed


class Prediction(nn.Module):
    """g: codes (B, code) to latents (B, M), through two residual blocks."""

    def __init__(self, code: int, hidden: int, width: int) -> None:
        super().__init__()
        self.enter = nn.Sequential(nn.Linear(code, hidden), nn.LeakyReLU(_SLOPE))
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.Linear(hidden, hidden), nn.LeakyReLU(_SLOPE), nn.Linear(hidden, hidden)) for _ in range(2)
        )
        self.leave = nn.Linear(hidden, width)

    def forward(self, code: Tensor) -> Tensor:
        """Mean of r."""
        rows = self.enter(code)
        for block in self.blocks:
            rows = rows + block(rows)
        predicted: Tensor = self.leave(rows)
        return predicted


def _negative_log_likelihood(rows: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Of (B, M) under N(mean, scale^2), in nats: summed over M, mean over B."""
    nats = 0.5 * ((rows - mean) / scale).square() + scale.log() + 0.5 * math.log(2 * math.pi)
    return nats.sum(-1).mean()


def _noise(like: Tensor) -> Tensor:
    drawn = torch.randn(rows_of_all(len(like)), like.shape[1], dtype=like.dtype, device=like.device)
    return own_rows(drawn)
