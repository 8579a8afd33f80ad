"""The information bottleneck with an estimated penalty: the paper's rival SVIB, as the paper ran it."""

from __future__ import annotations

from typing import Literal

from torch import Tensor
from torch.func import functional_call

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.bottlenecks.mutual_information import StatisticsNetwork, donsker_varadhan, mismatched
from repdib_lightning.bottlenecks.precision import at_least_single, without_autocast
from repdib_lightning.bottlenecks.variational import Variational
from repdib_lightning.errors import UserError
from repdib_lightning.records import BottleneckOutput


class SVIB(Bottleneck):
    """Gaussian bottleneck whose penalty is an estimate of I(X; Z), for observations X and representation Z.

    The published method (Pei and Hou 2019, arXiv 1911.05695; paper, comparison with bottlenecks) maximises
    E[return] - beta I(X; Z) and moves the encoder by Stein variational gradient descent towards the target
    p*(z | x) ~ u(z) exp(Q / beta). The paper replaced that by Adam "for fairness", and gives neither beta nor the
    estimator. What is left, and is here, is::

        loss of the objective + beta * I_T(h; z),        z = mu(h) + sigma(h) * noise
        I_T(h; z) = E[T(h_i, z_i)] - log E[exp T(h_i, z_j)]         (MINE, Donsker-Varadhan form)

    with h the encoder's output. I(X; Z) = I(h; Z), since Z depends on X through h alone. The difference from
    :class:`Variational` is the penalty: there a closed bound, the divergence from a fixed prior, here an estimate from
    below by a network that is trained beside it. Evaluation gives the mean.

    One optimiser plays both sides, which are two losses: ``information``, the estimate with the network held fixed,
    which mean, deviation and encoder descend (weight beta, see ``DEFAULT_LOSS_WEIGHTS``); ``estimator``, minus the
    estimate at fixed h and z, by which the network ascends (weight 1; leave it there, with 0 nothing is estimated).
    Rows of neighbouring frames count as strangers too; in a batch of many episodes these are few.

    Metrics: ``sigma``, ``mean_rms`` and ``kl_nats`` as those of :class:`Variational`; the divergence is not a loss.

    In evaluation the two losses are the same number up to the sign, of the noiseless mean, whose true information is
    infinite: read them in training.

    Args:
        width: M.
        hidden: width of both hidden layers of the statistics network T.
        log_variance_start: see :class:`Variational`, as the rest.
        log_variance_low: smooth lower bound.
        log_variance_high: smooth upper bound.
        head: ``linear`` or ``split``.

    Raises:
        UserError: ``hidden`` below 1, or as :class:`Variational`.
    """

    def __init__(
        self,
        width: int,
        *,
        hidden: int = 256,
        log_variance_start: float = -4.0,
        log_variance_low: float = -10.0,
        log_variance_high: float = 2.0,
        head: Literal["linear", "split"] = "linear",
    ) -> None:
        super().__init__(width)
        if hidden < 1:
            raise UserError(f"{type(self).__name__}: hidden must be at least 1, is {hidden}")
        self.gaussian = Variational(
            width,
            log_variance_start=log_variance_start,
            log_variance_low=log_variance_low,
            log_variance_high=log_variance_high,
            head=head,
        )
        self.statistics = StatisticsNetwork(2 * width, hidden, bias=False)

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Pass (N, M) through the Gaussian and estimate what passes."""
        sample, _, output = self.gaussian.sample(latent)
        with without_autocast(latent):
            precise = latent.to(at_least_single(latent.dtype))
            strangers = mismatched(sample, training=self.training)
            information = self._estimate(precise, sample, strangers, fixed=True)
            estimate = self._estimate(precise.detach(), sample.detach(), strangers.detach(), fixed=False)
        losses = {"information": information, "estimator": -estimate}
        return BottleneckOutput(sample.to(latent.dtype), losses, metrics=output.metrics)

    def _estimate(self, latent: Tensor, sample: Tensor, strangers: Tensor, *, fixed: bool) -> Tensor:
        weights = {name: value.detach() if fixed else value for name, value in self.statistics.named_parameters()}
        scores = [functional_call(self.statistics, weights, (latent, other)) for other in (sample, strangers)]
        return donsker_varadhan(scores[0], scores[1], equal=self.training)
