"""The variational information bottleneck: stage one of RepDIB."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.bottlenecks.precision import at_least_single, without_autocast
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.processes import own_rows, rows_of_all
from repdib_lightning.records import BottleneckOutput

_HEADS = ("linear", "split")
_REDUCTIONS = ("mean", "sum")


def standard_normal_kl(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Kullback-Leibler divergence of N(mean, exp(log_variance)) from N(0, 1), in nats, elementwise."""
    return 0.5 * (mean.square() + torch.expm1(log_variance) - log_variance)


def bounded(raw: Tensor, low: float, high: float) -> Tensor:
    """Squash smoothly into (low, high): the identity well inside, and a gradient that never vanishes at the ends."""
    below = high - functional.softplus(high - raw)
    return low + functional.softplus(below - low)


def unbounded(value: float, low: float, high: float) -> float:
    """Inverse of :func:`bounded` for one number strictly between the bounds."""
    below = low + _inverse_softplus(value - low)
    return high - _inverse_softplus(high - below)


def _inverse_softplus(value: float) -> float:
    return value + math.log(-math.expm1(-value))


class Variational(Bottleneck):
    """Gaussian bottleneck (paper, section on the VIB): a sample in training, the mean in evaluation.

    Losses: ``kl``, the divergence from N(0, I). The paper calls its prior a "uniform Gaussian", read as N(0, I), and
    weighs the loss by 0.01 without saying over what it is reduced; see ``kl_reduction``.
    Metrics: ``kl_nats`` (summed over dimensions, mean over N), ``sigma`` (mean standard deviation) and ``mean_rms``
    (root mean square of the mean): the scale of the signal against that of the noise.

    Args:
        width: M.
        log_variance_start: log-variance of every dimension before training. It holds exactly, whatever the input.
        log_variance_low: smooth lower bound of the log-variance.
        log_variance_high: smooth upper bound of the log-variance.
        kl_reduction: ``mean`` over dimensions and N, or ``sum`` over dimensions and mean over N. The same weight is M
            times stronger with ``sum``.
        head: ``linear``: one M -> 2M layer gives mean and log-variance; the mean starts as a copy of the input, so
            that training starts from the encoder's own scale. ``split``: one half of the input is the mean, the other
            steers the log-variance, and a linear layer maps the M / 2 sampled dimensions back to M.

    Raises:
        UserError: unknown choices, a start that is not between the bounds, an odd width with ``split``.
    """

    def __init__(
        self,
        width: int,
        *,
        log_variance_start: float = -4.0,
        log_variance_low: float = -10.0,
        log_variance_high: float = 2.0,
        kl_reduction: Literal["mean", "sum"] = "mean",
        head: Literal["linear", "split"] = "linear",
    ) -> None:
        super().__init__(width)
        name = type(self).__name__
        if head not in _HEADS:
            raise UserError(f"{name}: unknown head '{head}', {nearest(head, _HEADS)}")
        if kl_reduction not in _REDUCTIONS:
            raise UserError(f"{name}: unknown kl_reduction '{kl_reduction}', {nearest(kl_reduction, _REDUCTIONS)}")
        if not log_variance_low < log_variance_start < log_variance_high:
            raise UserError(
                f"{name}: log_variance_start {log_variance_start} must lie between log_variance_low "
                f"{log_variance_low} and log_variance_high {log_variance_high}"
            )
        if head == "split" and width % 2:
            raise UserError(f"{name}: head 'split' needs an even width, is {width} (nearest: {width - 1}, {width + 1})")
        self.low, self.high = log_variance_low, log_variance_high
        self.kl_reduction = kl_reduction
        raw_start = unbounded(log_variance_start, log_variance_low, log_variance_high)
        self.head = LinearHead(width, raw_start) if head == "linear" else SplitHead(width, raw_start)

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Pass (N, M) through the Gaussian."""
        sample, _, output = self.sample(latent)
        output.latent = sample.to(latent.dtype)
        return output

    def sample(self, latent: Tensor) -> tuple[Tensor, Tensor, BottleneckOutput]:
        """Return the sample and the mean, (N, M) in float32 or wider, and the output with the loss and metrics.

        In evaluation mode the sample is the mean.
        """
        self.check_input(latent)
        with without_autocast(latent):
            mean, raw = self.head(latent)
            log_variance = bounded(raw, self.low, self.high)
            sigma = torch.exp(0.5 * log_variance)
            kl = standard_normal_kl(mean, log_variance)
            centre = self.head.back(mean)
            sample = self.head.back(mean + sigma * _noise(mean)) if self.training else centre
        nats = kl.sum(-1).mean()
        metrics = {
            "kl_nats": nats.detach(),
            "sigma": sigma.detach().mean(),
            "mean_rms": mean.detach().square().mean().sqrt(),
        }
        losses = {"kl": nats if self.kl_reduction == "sum" else kl.mean()}
        return sample, centre, BottleneckOutput(sample, losses, metrics=metrics)


def _noise(like: Tensor) -> Tensor:
    """Standard normal noise of the shape (N, M) of ``like``."""
    drawn = torch.randn(rows_of_all(len(like)), like.shape[1], dtype=like.dtype, device=like.device)
    return own_rows(drawn)


class LinearHead(nn.Module):
    """Mean and unbounded log-variance, (N, M) each, from one linear layer on (N, M)."""

    def __init__(self, width: int, raw_start: float) -> None:
        super().__init__()
        self.layer = nn.Linear(width, 2 * width)
        with torch.no_grad():
            self.layer.weight.zero_()
            self.layer.weight[:width].fill_diagonal_(1.0)
            self.layer.bias[:width].zero_()
            self.layer.bias[width:].fill_(raw_start)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Map (N, M) to mean and raw log-variance, (N, M) each."""
        both = self.layer(latent.to(self.layer.weight.dtype))
        mean, raw = both.to(at_least_single(both.dtype)).chunk(2, dim=-1)
        return mean, raw

    def back(self, sample: Tensor) -> Tensor:
        """Return the (N, M) sample as it is: it has the bottleneck's width already."""
        return sample


class SplitHead(nn.Module):
    """Mean and unbounded log-variance, (N, M / 2) each, from the two halves of (N, M)."""

    def __init__(self, width: int, raw_start: float) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.zeros(width // 2))
        self.start = nn.Parameter(torch.full((width // 2,), raw_start))
        self.widen = nn.Linear(width // 2, width)

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Map (N, M) to mean and raw log-variance, (N, M / 2) each."""
        mean, steering = latent.to(at_least_single(latent.dtype)).chunk(2, dim=-1)
        return mean, self.start + self.scale * steering

    def back(self, sample: Tensor) -> Tensor:
        """Map the (N, M / 2) sample to (N, M)."""
        widened: Tensor = self.widen(sample.to(self.widen.weight.dtype))
        return widened.to(at_least_single(widened.dtype))
