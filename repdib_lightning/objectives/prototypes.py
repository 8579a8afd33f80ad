"""Prototypes: later frames are spread over prototypes, earlier ones predict which."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from repdib_lightning.bottlenecks.codebook import count_codes, perplexity
from repdib_lightning.bottlenecks.precision import at_least_single, without_autocast
from repdib_lightning.encoders.convolutional import initialise_orthogonally
from repdib_lightning.errors import UserError
from repdib_lightning.objectives.base import Encode, Objective, require_futures, require_several
from repdib_lightning.objectives.batch_standardisation import BatchStandardisation
from repdib_lightning.objectives.momentum import MomentumCopy
from repdib_lightning.processes import gather_with_gradients, rows_of_all, sum_over_processes
from repdib_lightning.records import Batch, DataSpec, ObjectiveOutput


class Prototypes(Objective):
    """Predicts to which prototype a later frame is assigned (ProtoRL, Yarats et al. 2021, and its published program).

    With h the latent of the anchor, h' that of the sample's last frame by the target network, f the predictor, f' its
    running average, g the projector, C the prototypes (K, P) with rows of length 1, and tau the temperature::

        s = g(f(h)) / |g(f(h))|         log p = log_softmax(C s / tau)
        t = f'(h') / |f'(h')|           q = Sinkhorn(C t / tau)
        prototypes = mean over samples of -(q log p), summed over K

    Nothing but f, g, C and the online encoder is given a gradient: q is a constant. What prevents collapse is that q
    uses all prototypes equally.

    The rows of C are divided by their length at each use, where the published program overwrites them before each step:
    so the gradient is that of what is computed, and evaluation changes no weight. Weights start orthogonal, as there.

    With ``standardise`` each dimension of f(h), and of f'(h'), is first brought to mean 0 and deviation 1 over the
    batch. Frames of one environment are so alike that without it all embeddings point the same way; being all the same
    is then what lowers the loss fastest (to log K), and within some ten thousand steps it does not recover.

    Where several processes train, the batch that is spread over the prototypes is that of all of them, so that the
    mean of their losses is the loss of the global batch.

    Metrics, of this batch: ``prototype_perplexity``, how many prototypes are the nearest of some s, as the exponential
    of the entropy of these counts; ``prototype_nats``, the entropy of the mean p less the mean entropy of p: what p
    tells of the sample, at most log(min(B, K)). They are 1 and 0 where all samples are alike. The mean of q would show
    nothing: Sinkhorn spreads even samples that are all alike.

    Args:
        width: M.
        spec: samples must have a later frame: ``data.futures`` or ``data.next_frame``.
        prototypes: K.
        projected: P, width in which samples meet prototypes.
        hidden: width of the projector's hidden layer.
        temperature: tau; divides the cosines.
        sinkhorn_iterations: rounds of :func:`sinkhorn`.
        standardise: see above; not in the published program.
        target_rate: how far the target network and f' follow in a step, in (0, 1].

    Attributes:
        projected: P.

    Raises:
        UserError: samples of one frame, or an option out of range.
    """

    def __init__(
        self,
        width: int,
        spec: DataSpec,
        *,
        prototypes: int = 512,
        projected: int = 128,
        hidden: int = 512,
        temperature: float = 0.1,
        sinkhorn_iterations: int = 3,
        standardise: bool = False,
        target_rate: float = 0.05,
    ) -> None:
        super().__init__()
        if not spec.next_frame:
            require_futures("Prototypes", spec)
        for name, value, least in (
            ("prototypes", prototypes, 2),
            ("projected", projected, 1),
            ("hidden", hidden, 1),
            ("sinkhorn_iterations", sinkhorn_iterations, 1),
        ):
            if value < least:
                raise UserError(f"Prototypes: {name} must be at least {least}, is {value}")
        if not (temperature > 0 and math.isfinite(temperature)):
            raise UserError(f"Prototypes: temperature must be a positive number, is {temperature}")
        if not 0 < target_rate <= 1:
            raise UserError(f"Prototypes: target_rate must be in (0, 1], is {target_rate}")
        self.temperature, self.sinkhorn_iterations, self.target_rate = temperature, sinkhorn_iterations, target_rate
        self.projected = projected
        self.predictor = nn.Linear(width, projected)
        self.projector = nn.Sequential(nn.Linear(projected, hidden), nn.ReLU(), nn.Linear(hidden, projected))
        self.prototypes = nn.Linear(projected, prototypes, bias=False)
        self.apply(initialise_orthogonally)
        self.target_predictor = MomentumCopy(self.predictor, target_rate)
        self.standardised = BatchStandardisation(projected) if standardise else nn.Identity()
        self.target_standardised = BatchStandardisation(projected) if standardise else nn.Identity()

    def forward(self, batch: Batch, encode: Encode, target: Encode | None = None) -> ObjectiveOutput:
        """Encode the anchors by the online network and the last frames by the target, once each.

        Raises:
            UserError: training on a single sample, or no target network.
        """
        if target is None:
            raise UserError("Prototypes: has no target network; it cannot be a part, make it the only objective")
        require_several(self, rows_of_all(len(batch)), "spreads a batch over its prototypes")
        online = encode({name: frames[:, :1] for name, frames in batch.observations.items()})[:, 0]
        later = target({name: frames[:, -1:] for name, frames in batch.observations.items()})[:, 0]
        with without_autocast(online):
            predicted = self.projector(self.standardised(self.predictor(online.to(self.predictor.weight.dtype))))
            log_chosen = (self._cosines(_unit(predicted)) / self.temperature).log_softmax(-1)
            with torch.no_grad():
                averaged = _unit(self.target_standardised(self.target_predictor.apply_to(self.predictor, later)))
                assigned = sinkhorn(self._cosines(averaged) / self.temperature, self.sinkhorn_iterations)
            loss = -(assigned * log_chosen).sum(-1).mean()
        return ObjectiveOutput({"prototypes": loss}, _describe_use(log_chosen.detach()))

    def embed(self, latents: Tensor) -> Tensor:
        """f(h) / |f(h)|: latents (N, M) to unit vectors (N, P), where distances are measured (ProtoRL)."""
        with without_autocast(latents):
            predicted = self.predictor(latents.to(self.predictor.weight.dtype))
            known = self.standardised
            return _unit(known.as_before(predicted) if isinstance(known, BatchStandardisation) else predicted)

    @torch.no_grad()
    def candidates(self, embeddings: Tensor) -> Tensor:
        """For each prototype one of the (N, P) unit vectors, drawn by the softmax of C z over them: (K,) int64 indices.

        Without the temperature, as published. Drawn from torch's generator of the vectors' device.
        """
        with without_autocast(embeddings):
            scores = self._cosines(embeddings)
            # The largest weight over an exponential variable: a draw in proportion to the weights.
            return (scores - torch.empty_like(scores).exponential_().log()).argmax(0)

    def follow(self) -> None:
        """Let f' go a step towards f."""
        self.target_predictor.follow(self.predictor)

    def _cosines(self, embeddings: Tensor) -> Tensor:
        """Unit vectors (N, P) against the prototypes, (N, K)."""
        return embeddings @ _unit(self.prototypes.weight).to(embeddings.dtype).T


@torch.no_grad()
def sinkhorn(scores: Tensor, iterations: int) -> Tensor:
    """Spread samples over prototypes: (B, K) scores to shares (B, K), no gradient (Cuturi 2013; as in SwAV, Caron et
    al. 2020).

    exp(scores) is scaled in turns so that every prototype has as much of the batch of all processes, B_all / K, and
    every sample sums to 1; the last turn is the samples', so that theirs holds exactly. In logarithms: any scores do.

    Args:
        scores: of the rows of this process; processes may have different numbers of them.
        iterations: turns of both.
    """
    shares = scores
    for _ in range(iterations):
        of_prototypes, _ = gather_with_gradients(shares.logsumexp(0, keepdim=True), equal=True)
        shares = (shares - of_prototypes.logsumexp(0)).log_softmax(-1)
    return shares.exp()


def _describe_use(log_chosen: Tensor) -> dict[str, Tensor]:
    """Metrics of log p (B, K), over the rows of all processes."""
    chosen, kinds = log_chosen.exp(), log_chosen.shape[1]
    nearest = count_codes(log_chosen.argmax(-1, keepdim=True), kinds)[0].to(chosen.dtype)
    entropy, rows = -(chosen * log_chosen).sum(), torch.ones_like(chosen[:, 0]).sum()
    sums = sum_over_processes(torch.cat([nearest, chosen.sum(0), torch.stack([entropy, rows])]))
    nearest, mean, entropy, rows = sums[:kinds], sums[kinds : 2 * kinds] / sums[-1], sums[-2], sums[-1]
    nats = torch.special.entr(mean).sum() - entropy / rows
    return {"prototype_perplexity": perplexity(nearest[None])[0], "prototype_nats": nats.clamp_min(0.0)}


def _unit(rows: Tensor) -> Tensor:
    return F.normalize(rows.to(at_least_single(rows.dtype)), dim=-1)
