"""RepDIB: the variational bottleneck, then the grouped quantiser."""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.bottlenecks.variational import Variational
from repdib_lightning.bottlenecks.vector_quantiser import VectorQuantiser
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.records import BottleneckOutput

_NOISES = ("before", "after")


class RepDIB(Bottleneck):
    """:class:`Variational`, then :class:`VectorQuantiser` on what it gives, without a normalisation between.

    Losses and metrics are those of both; evaluation quantises the mean. The options are theirs, described there; one
    is added. The nearest to the paper's words, where they are silent to VQ-VAE's: ``codebook="gradient"``,
    ``start="random"``, ``start_step=0``, ``revive_after=0``, with a weight of 0.01 on ``kl`` (either reduction).

    Args:
        width: M.
        log_variance_start: see :class:`Variational`, as the next four.
        log_variance_low: smooth lower bound.
        log_variance_high: smooth upper bound.
        kl_reduction: ``mean`` or ``sum`` over dimensions.
        head: ``linear`` or ``split``.
        groups: see :class:`VectorQuantiser`, as the rest.
        codes: L.
        codebook: ``ema`` or ``gradient``.
        shared: one book for all groups.
        decay: of the running averages.
        start: ``kmeans`` or ``random``.
        start_step: training steps before quantising starts; until then this is a :class:`Variational`.
        revive_after: idle steps after which a code is moved; 0 = never.
        bypass: chance that the objective sees a row unquantised in training.
        group_dropout: chance that the objective sees zeros in place of a group in training.
        noise: where the Gaussian noise of the training enters. ``before``: the sample is quantised, as in the paper;
            noise in front of a nearest-neighbour choice flips codes at random. ``after``: the mean is quantised, and
            the noise is added to the chosen codes, so that training and evaluation choose alike while each dimension
            still pays for the precision it needs.

    Raises:
        UserError: as the two parts.
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
        groups: int = 8,
        codes: int = 50,
        codebook: Literal["ema", "gradient"] = "ema",
        shared: bool = False,
        decay: float = 0.99,
        start: Literal["kmeans", "random"] = "kmeans",
        start_step: int = 200,
        revive_after: int = 50,
        bypass: float = 0.0,
        group_dropout: float = 0.0,
        noise: Literal["before", "after"] = "before",
    ) -> None:
        super().__init__(width)
        if noise not in _NOISES:
            raise UserError(f"{type(self).__name__}: unknown noise '{noise}', {nearest(noise, _NOISES)}")
        self.noise = noise
        self.variational = Variational(
            width,
            log_variance_start=log_variance_start,
            log_variance_low=log_variance_low,
            log_variance_high=log_variance_high,
            kl_reduction=kl_reduction,
            head=head,
        )
        if group_dropout and noise == "after":
            raise UserError("RepDIB: noise after the quantiser fills the groups that group_dropout empties; take one")
        self.quantiser = VectorQuantiser(
            width,
            groups=groups,
            codes=codes,
            codebook=codebook,
            shared=shared,
            decay=decay,
            start=start,
            start_step=start_step,
            revive_after=revive_after,
            bypass=bypass,
            group_dropout=group_dropout,
        )
        self.groups, self.codes = groups, codes

    @property
    def ready(self) -> bool:
        """Whether the quantiser has started."""
        return self.quantiser.ready

    def require_ready(self) -> None:
        """Raise UserError unless the quantiser has started."""
        self.quantiser.require_ready()

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Pass (N, M) through both stages."""
        sample, mean, first = self.variational.sample(latent)
        second: BottleneckOutput = self.quantiser(mean if self.noise == "after" else sample)
        passed = second.latent + (sample - mean) if self.noise == "after" and self.training else second.latent
        return BottleneckOutput(
            passed.to(latent.dtype),
            first.losses | second.losses,
            second.codes,
            first.metrics | second.metrics,
        )

    def decode(self, codes: Tensor) -> Tensor:
        """Map (N, G) int64 indices to the (N, M) latent that they stand for."""
        return self.quantiser.decode(codes)
