"""Exploration with mutual information: the paper's rival EMI, as an auxiliary objective."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from repdib_lightning.bottlenecks.mutual_information import StatisticsNetwork, jensen_shannon_loss, mismatched
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
from repdib_lightning.processes import gather_with_gradients, rows_of_all
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput

_LEAST_VARIANCE = 1e-6


class EMI(Objective):
    """Embeddings of states and actions that are informative of each other and in which actions add up (EMI, Kim et al.
    2019, equations 3 to 7, and its published program).

    With s and s' the latents z_t and z_{t+1}, phi(s) = P s the state embedding, psi(a) the action embedding, S an error
    model, E the mean over the batch, and T_1, T_2 statistics networks::

        emi_dynamics    = E |phi(s') - phi(s) - psi(a) - S(s, a)|^2
        emi_error       = E |S(s, a)|^2
        emi_information = E[softplus(-T_1(phi(s'), phi(s), psi(a))) + softplus(T_1(phi(s'~), phi(s), psi(a)))]
                        + E[softplus(-T_2(psi(a), phi(s), phi(s'))) + softplus(T_2(psi(a~), phi(s), phi(s')))]
        emi_action_kl   = sum over dimensions of KL(N(mean of psi(a), variance of psi(a)) || N(0, 1))

    where ~ marks another sample of the batch. The third raises I([phi(s), psi(a)]; phi(s')) and
    I([phi(s), phi(s')]; psi(a)); it and the fourth keep the embeddings from collapsing, which the first alone rewards.

    Deviations. The state embedding is a linear map of a shared latent instead of the last layer of a network of its
    own, and has 32 dimensions instead of 2: what an agent gets is the latent, of which 2 would constrain next to
    nothing. The KL is that of each dimension's moments instead of the full covariance, which is singular for discrete
    actions wherever dimensions >= choices. The error model has no convolutions of its own; it reads the latent, through
    a stop-gradient, so that its penalty shapes nothing else, as where it reads pixels. Strangers are drawn from the
    whole batch instead of its other half. There is no intrinsic reward.

    Weights: those of the published program for pixels, see ``DEFAULT_LOSS_WEIGHTS``. At 100, S takes up about one
    percent of what the linear model leaves over; at the 1e4 that it has for states, next to none.

    Metrics: ``emi_recognised``, how often T_1 and T_2 tell pairs from strangers (0.5 is chance), and
    ``emi_explained``, the share of the variance of phi(s') - phi(s) that psi(a) explains.

    Args:
        width: M.
        spec: the actions; ``data.next_frame`` must be on, or the horizon be 1.
        dimensions: of both embeddings (2 as published).
        hidden: width of the hidden layer of psi and of the two of T_1 and T_2 (64 as published).
        error_hidden: width of the hidden layer of S (256 as published).

    Raises:
        UserError: data without actions or without the next frame, or an option below 1.
    """

    needs_actions = True

    def __init__(
        self, width: int, spec: DataSpec, *, dimensions: int = 32, hidden: int = 64, error_hidden: int = 256
    ) -> None:
        super().__init__()
        for name, value in (("dimensions", dimensions), ("hidden", hidden), ("error_hidden", error_hidden)):
            if value < 1:
                raise UserError(f"EMI: {name} must be at least 1, is {value}")
        self.spec, self.actions = spec, require_transitions("EMI", spec)
        self.state_embedding = nn.Linear(width, dimensions)
        self.action_embedding = _perceptron(self.actions.size, hidden, dimensions)
        self.error_model = _perceptron(width + self.actions.size, error_hidden, dimensions)
        self.next_statistics = StatisticsNetwork(3 * dimensions, hidden, bias=True)
        self.action_statistics = StatisticsNetwork(3 * dimensions, hidden, bias=True)

    def forward(self, batch: Batch, encode: Encode) -> ObjectiveOutput:
        """Encode (B, F) frames once and relate the first two of each sample and the action between them.

        Raises:
            UserError: training on a single sample.
        """
        assert batch.actions is not None
        require_several(self, rows_of_all(len(batch)), "tells pairs from strangers")
        latents = encode(batch.observations)
        before, after = latents[:, 0], next_latents(latents, self.spec)
        actions = action_vectors(batch.actions, self.actions, before)
        with without_autocast(latents):
            states, nexts = (_precise(self.state_embedding(self._own(rows))) for rows in (before, after))
            moves = _precise(self.action_embedding(self._own(actions)))
            errors = _precise(self.error_model(self._own(torch.cat([before.detach(), actions], dim=-1))))
            information, recognised = self._information(states, nexts, moves)
            left = nexts - states - moves
            losses = {
                "emi_dynamics": (left - errors).square().sum(-1).mean(),
                "emi_error": errors.square().sum(-1).mean(),
                "emi_information": information,
                "emi_action_kl": self._action_kl(moves),
            }
        total = (nexts - states).detach().square().sum()
        explained = 1 - left.detach().square().sum() / total.clamp_min(torch.finfo(total.dtype).tiny)
        return ObjectiveOutput(losses, {"emi_recognised": recognised, "emi_explained": explained})

    def _own(self, rows: Tensor) -> Tensor:
        """In the precision of the weights."""
        return rows.to(self.state_embedding.weight.dtype)

    def _information(self, states: Tensor, nexts: Tensor, moves: Tensor) -> tuple[Tensor, Tensor]:
        """Both Jensen-Shannon losses together, and the share of pairs and strangers told apart."""
        other_nexts, other_moves = (mismatched(rows, training=self.training) for rows in (nexts, moves))
        scores = [
            (self.next_statistics(nexts, states, moves), self.next_statistics(other_nexts, states, moves)),
            (self.action_statistics(moves, states, nexts), self.action_statistics(other_moves, states, nexts)),
        ]
        loss = torch.stack([jensen_shannon_loss(pairs, strangers) for pairs, strangers in scores]).sum()
        right = torch.stack([torch.stack([pairs > 0, strangers < 0]) for pairs, strangers in scores])
        return loss, right.to(loss.dtype).mean()

    def _action_kl(self, moves: Tensor) -> Tensor:
        """KL of N(mean, variance), of each dimension over the rows of all processes, from N(0, 1), summed."""
        everywhere, _ = gather_with_gradients(moves, equal=self.training)
        mean = everywhere.mean(0)
        variance = (everywhere - mean).square().mean(0) + _LEAST_VARIANCE
        return 0.5 * (mean.square() + variance - 1 - variance.log()).sum()


def _perceptron(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.ReLU(), nn.Linear(hidden, outputs))


def _precise(rows: Tensor) -> Tensor:
    return rows.to(at_least_single(rows.dtype))
