"""Estimates of mutual information from samples, by a network that tells pairs from strangers.

A pair is (x_i, y_i) of one sample; strangers are (x_i, y_j) of two, which stand for draws from the product of the
marginals. Where several processes train, strangers come from all of them and the estimates are those of the global
batch: the mean of the losses over the processes is the loss of one process with all rows.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.bottlenecks.precision import at_least_single
from repdib_lightning.processes import gather_with_gradients


class StatisticsNetwork(nn.Module):
    """T(x, y, ...): the concatenation of its arguments, (N, *) each, through two hidden ReLU layers to scores (N,).

    Args:
        inputs: width of the concatenation.
        hidden: width of both hidden layers.
        bias: let the last layer add a constant. :func:`donsker_varadhan` does not depend on one.
    """

    def __init__(self, inputs: int, hidden: int, *, bias: bool) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(inputs, hidden),
            nn.ReLU(),
            nn.Linear(hidden, hidden),
            nn.ReLU(),
            nn.Linear(hidden, 1, bias=bias),
        )

    def forward(self, *parts: Tensor) -> Tensor:
        """Scores (N,) in float32 or wider, of parts (N, *)."""
        dtype = next(self.parameters()).dtype
        joined = torch.cat([part.to(dtype) for part in parts], dim=-1)
        scores: Tensor = self.layers(joined).squeeze(-1)
        return scores.to(at_least_single(scores.dtype))


def donsker_varadhan(pairs: Tensor, strangers: Tensor, *, equal: bool) -> Tensor:
    """Lower bound on the mutual information, in nats: E_pairs[T] - log E_strangers[exp T] (Donsker and Varadhan 1983;
    MINE, Belghazi et al. 2018, equation 10).

    The bound holds in expectation over the data, not on the few rows that a network was trained on. Gradients are those
    of the batch's own estimate, without MINE's running average of the second term: its bias falls with the batch.

    Args:
        pairs: (N,), T of pairs.
        strangers: (N,), T of strangers.
        equal: each process has as many rows.
    """
    everywhere, _ = gather_with_gradients(strangers, equal=equal)
    count = torch.ones_like(everywhere).sum()
    return pairs.mean() - (everywhere.logsumexp(0) - count.log())


def jensen_shannon_loss(pairs: Tensor, strangers: Tensor) -> Tensor:
    """Loss whose minimum over T is 2 log 2 - 2 JSD(joint || product of marginals): at most 2 log 2, which only
    independent variables cannot get below (Nowozin et al. 2016; Hjelm et al. 2019, equation 4).

    Minimised by the network AND by what makes the variables, it raises their dependence: mean of softplus(-T) over
    pairs + mean of softplus(T) over strangers.

    Args:
        pairs: (N,), T of pairs.
        strangers: (N,), T of strangers.
    """
    return F.softplus(-pairs).mean() + F.softplus(strangers).mean()


def mismatched(rows: Tensor, *, training: bool) -> Tensor:
    """For each of (N, ...) the row of another sample, of any process, with gradients: (N, ...).

    In training one random cycle through all rows decides, drawn from torch's generator for the rows of all processes;
    in evaluation half the batch lies between the two, and nothing is drawn. A lone row is its own partner.

    Args:
        rows: one for each sample of this process.
        training: every process has as many rows then.
    """
    everywhere, places = gather_with_gradients(rows, equal=training)
    count = everywhere.shape[0]
    if not training:
        return everywhere[(places + count // 2) % count]
    order = torch.randperm(count, device=rows.device)
    partners = torch.empty_like(order)
    partners[order] = order.roll(1)
    return everywhere[partners[places]]
