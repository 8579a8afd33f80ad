"""Inverse dynamics: predict the action from the latents before and after it."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.errors import UserError, nearest
from repdib_lightning.objectives.base import Encode, Objective, drawn, require_futures
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput


class InverseDynamics(Objective):
    """Multi-step inverse dynamics, p(a_t | z_t, z_{t+k}[, k]) for k in 1..K (AC-State, Lamb et al. 2022; paper
    section 4.4 and appendix, robot arm). With horizon K = 1 it is the one-step inverse model (Pathak et al. 2017).

    The loss is the mean over samples and futures of the cross-entropy (discrete actions) or of the squared error
    (continuous). All frames are encoded in one pass.

    Args:
        width: M.
        spec: actions and horizon K.
        hidden: width of the two hidden layers.
        feed_offset: give k to the predictor, as a learned embedding (the paper's Atari runs do not).
        action_loss: for continuous actions: ``squared``, or ``cosine``, the squared distance of the normalised
            vectors (ACRO, Islam et al. 2022). Discrete actions always use the cross-entropy.

    Raises:
        UserError: data without actions, samples without futures, or an unknown ``action_loss``.
    """

    needs_actions = True

    def __init__(
        self,
        width: int,
        spec: DataSpec,
        *,
        hidden: int = 256,
        feed_offset: bool = True,
        action_loss: str = "squared",
    ) -> None:
        super().__init__()
        if spec.actions is None:
            raise UserError("InverseDynamics: predicts actions, but the data has none ('actions' is missing)")
        require_futures("InverseDynamics", spec)
        if action_loss not in ("squared", "cosine"):
            raise UserError(
                f"InverseDynamics: unknown action_loss '{action_loss}', {nearest(action_loss, ('squared', 'cosine'))}"
            )
        if hidden < 1:
            raise UserError(f"InverseDynamics: hidden must be at least 1, is {hidden}")
        self.spec, self.actions, self.action_loss = spec, spec.actions, action_loss
        self.offset_embedding = nn.Embedding(spec.horizon, hidden) if feed_offset and spec.horizon > 1 else None
        inputs = 2 * width + (hidden if self.offset_embedding is not None else 0)
        self.predictor = nn.Sequential(
            nn.Linear(inputs, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, spec.actions.size),
        )

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode (B, F) frames once and predict the anchor's action from each of the drawn futures."""
        assert batch.actions is not None
        latents = encode(batch.observations)
        after, offsets = drawn(batch, latents, self.spec)
        prediction = self.predict(latents[:, :1].expand_as(after), after, offsets)
        if self.actions.kind == "discrete":
            return self._discrete(prediction, batch.actions)
        return self._continuous(prediction, batch.actions)

    def predict(self, before: Tensor, after: Tensor, offsets: Tensor) -> Tensor:
        """Logits or actions (..., A) from latents (..., M), (..., M) and offsets k (...) in 1..K."""
        inputs = [before, after]
        if self.offset_embedding is not None:
            inputs.append(self.offset_embedding(offsets - 1))
        prediction: Tensor = self.predictor(torch.cat(inputs, dim=-1))
        return prediction

    def _discrete(self, logits: Tensor, actions: Tensor) -> ObjectiveOutput:
        targets = actions[:, None].expand(logits.shape[:2])
        loss = F.cross_entropy(logits.flatten(0, 1), targets.flatten())
        accuracy = (logits.detach().argmax(-1) == targets).float().mean()
        return ObjectiveOutput({"inverse": loss}, {"action_accuracy": accuracy})

    def _continuous(self, predicted: Tensor, actions: Tensor) -> ObjectiveOutput:
        targets = actions[:, None].expand_as(predicted)
        error = (predicted.detach() - targets).square().mean()
        if self.action_loss == "cosine":
            predicted, targets = F.normalize(predicted, dim=-1), F.normalize(targets, dim=-1)
        return ObjectiveOutput({"inverse": F.mse_loss(predicted, targets)}, {"action_error": error})
