"""Latent forward prediction: what an action does to the latent."""

from __future__ import annotations

import torch
from torch import nn

from repdib_lightning.bottlenecks.precision import at_least_single, without_autocast
from repdib_lightning.errors import UserError
from repdib_lightning.objectives.base import (
    Encode,
    Objective,
    action_vectors,
    next_latents,
    require_several,
    require_transitions,
)
from repdib_lightning.objectives.spread import centre_and_spread
from repdib_lightning.processes import rows_of_all
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput

_LEAST_MOVE = 1e-4
"""Of a batch in which nothing moves, as a share of the spread."""


class ForwardPrediction(Objective):
    """Predicts the next latent from the latent and the action: the repair of multi-step inverse dynamics, which can
    merge states that only a forward model tells apart ("Multistep inverse is not all you need", arXiv 2403.11940).

    With s' the latent z_{t+1} behind a stop-gradient, less its mean and over its root mean variance in the batch::

        forward = mean of (f(z_t, a_t) - s')^2 over samples and M

    the share of the next latent's variance that is not predicted: 0 is perfect, 1 is no better than the batch mean. The
    published loss is a cross-entropy of discrete latent states; this one takes any latent, also a quantised one.

    Nothing here alone prevents collapse: constant latents are predictable. The stop-gradient takes away the direct pull
    of the target towards the prediction, the standardisation what shrinking all latents would gain, and f does not add
    to z_t, which would pull each latent to the next. What keeps the state in the latents is the objective beside it:
    use it in ``SeveralObjectives``, with inverse dynamics. Even so it favours what changes slowly, also where that is
    noise, and weighs 0.1 by default.

    Metrics: ``forward_to_copying``, the squared error relative to that of predicting z_t itself: below 1 the predictor
    knows what the action does.

    Args:
        width: M.
        spec: the actions; ``data.next_frame`` must be on, or the horizon be 1.
        hidden: width of the two hidden layers.

    Raises:
        UserError: data without actions or without the next frame, or ``hidden`` below 1.
    """

    needs_actions = True

    def __init__(self, width: int, spec: DataSpec, *, hidden: int = 256) -> None:
        super().__init__()
        if hidden < 1:
            raise UserError(f"ForwardPrediction: hidden must be at least 1, is {hidden}")
        self.spec, self.actions = spec, require_transitions("ForwardPrediction", spec)
        self.predictor = nn.Sequential(
            nn.Linear(width + self.actions.size, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, width),
        )

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode (B, F) frames once and predict the second from the first.

        Raises:
            UserError: training on a single sample.
        """
        assert batch.actions is not None
        require_several(self, rows_of_all(len(batch)), "measures its error against the spread of a batch")
        latents = encode(batch.observations)
        before, after = latents[:, 0], next_latents(latents, self.spec).detach()
        predicted = self.predictor(torch.cat([before, action_vectors(batch.actions, self.actions, before)], dim=-1))
        with without_autocast(latents):
            precise = at_least_single(after.dtype)
            after, before = after.to(precise), before.detach().to(precise)
            centre, spread = centre_and_spread(after)
            scale = (spread / after.shape[1]).sqrt()
            error = (predicted.to(precise) - (after - centre) / scale).square().mean()
            moved = ((after - before) / scale).square().mean()
        return ObjectiveOutput(
            {"forward": error}, {"forward_to_copying": error.detach() / moved.clamp_min(_LEAST_MOVE)}
        )
