"""The grouped vector quantiser: stage two of RepDIB, the discrete information bottleneck."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from repdib_lightning.bottlenecks.base import Bottleneck
from repdib_lightning.bottlenecks.codebook import Codebook, count_codes, describe_use
from repdib_lightning.bottlenecks.kmeans import kmeans
from repdib_lightning.bottlenecks.precision import without_autocast
from repdib_lightning.bottlenecks.reservoir import Reservoir
from repdib_lightning.bottlenecks.straight_through import replace_by_codes
from repdib_lightning.errors import UserError, nearest
from repdib_lightning.processes import own_rows, process_count, rows_of_all
from repdib_lightning.records import BottleneckOutput

_RULES = ("ema", "gradient")
_STARTS = ("kmeans", "random")
_ROWS_PER_CODE = 40
_ROWS_AT_MOST = 8192


class VectorQuantiser(Bottleneck):
    """Cuts (N, M) into G segments and replaces each by the nearest of L codes (paper, section on the DIB).

    The gradient passes straight through the choice (van den Oord et al. 2017). Distances are Euclidean, in float32
    under autocast too; the latent has the input's dtype.

    Losses, means over all elements: ``commitment`` pulls the input to its codes; ``codebook`` (only with
    ``codebook="gradient"``) pulls the codes to the input.
    Metrics, of this batch: ``perplexity`` and ``perplexity_min`` (mean and lowest over groups, 1 to L) and
    ``used_codes`` (distinct codes, mean over groups).

    Until it starts, the input passes unchanged, ``codes`` is None and the losses are 0: see :attr:`ready`.
    Only training steps count, start, move or revive codes; one forward pass in training mode is one step.

    Args:
        width: M.
        groups: G; must divide M.
        codes: L.
        codebook: ``ema``: running averages; ``gradient``: a parameter, trained by the loss ``codebook``.
        shared: one book for all groups instead of one a group. The paper's notation allows both readings.
        decay: of the running averages, 0 <= decay < 1; memory of about 1 / (1 - decay) steps. ``ema`` only.
        start: ``kmeans``: codes start as cluster centres of the latest training latents (40 a code, 8192
            at most, of all processes); ``random``: drawn from N(0, I), the prior of the VIB.
        start_step: training steps that pass the input through before quantising starts. With 0 and ``random`` it
            quantises from the beginning; with 0 and ``kmeans`` it starts on the first batch alone.
        revive_after: a code that nothing chose for this many training steps moves onto a random row of the batch;
            0 = never.
        bypass: probability, for each row and training step, that the objective sees the unquantised input. The
            evaluation always quantises.
        group_dropout: probability, for each row, group and training step, that the objective sees zeros in place of
            the group, so that what is left must do without it, and a zeroed group is nothing new to a decoder. In a
            grid each position drops its groups by itself.

    Raises:
        UserError: groups that do not divide M, unknown choices, values out of range.
    """

    started: Tensor
    steps: Tensor

    def __init__(
        self,
        width: int,
        *,
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
    ) -> None:
        super().__init__(width)
        self._check_shape(width, groups, codes)
        self._check_choice("codebook", codebook, _RULES)
        self._check_choice("start", start, _STARTS)
        self._check_range("decay", decay, 0 <= decay < 1, "in [0, 1)")
        self._check_range("start_step", start_step, start_step >= 0, "at least 0")
        self._check_range("revive_after", revive_after, revive_after >= 0, "at least 0 (0 = never)")
        self._check_range("bypass", bypass, 0 <= bypass <= 1, "in [0, 1]")
        self._check_range("group_dropout", group_dropout, 0 <= group_dropout < 1, "in [0, 1)")
        self.groups, self.codes, self.shared = groups, codes, shared
        self.start, self.start_step, self.bypass = start, start_step, bypass
        self.group_dropout = group_dropout
        books = 1 if shared else groups
        self.book = Codebook(books, codes, width // groups, rule=codebook, decay=decay, revive_after=revive_after)
        begins = start == "random" and start_step == 0
        self._capacity = min(_ROWS_PER_CODE * codes, _ROWS_AT_MOST) if start == "kmeans" else 0
        self.reservoir = Reservoir(self._capacity, width)
        self.register_buffer("started", torch.tensor(begins))
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))
        # Plain copies of the two buffers: branching on a tensor would wait for the device and break compilation.
        self._started, self._steps = begins, 0

    @property
    def ready(self) -> bool:
        """Whether it quantises: it has started, in this run or in the one that was loaded."""
        return self._started

    def require_ready(self) -> None:
        """Raise UserError unless it quantises."""
        if not self._started:
            raise UserError(
                f"{type(self).__name__}: the quantiser has not started: {self._steps} of {self.start_step} training "
                f"steps done; train for longer or lower start_step"
            )

    @property
    def codebook(self) -> Tensor:
        """The codes: (G, L, D), or (1, L, D) where shared."""
        return self.book.vectors

    def forward(self, latent: Tensor) -> BottleneckOutput:
        """Quantise (N, M)."""
        self.check_input(latent)
        with without_autocast(latent):
            wide = latent.to(self.book.vectors.dtype)
            if self.training and not self._started:
                self._approach_start(wide.detach())
            if not self._started:
                return self._pass_through(latent)
            output = self._quantise(wide)
        output.latent = output.latent.to(latent.dtype)
        return output

    def decode(self, codes: Tensor) -> Tensor:
        """Map (N, G) int64 indices to the (N, M) latent that they stand for. Raises UserError before the start."""
        self.require_ready()
        if codes.ndim != 2 or codes.shape[1] != self.groups:
            raise UserError(f"{type(self).__name__}: decode takes (N, {self.groups}), was given {tuple(codes.shape)}")
        return self.book.look_up(self._by_book(codes)).reshape(-1, self.width)

    def _by_book(self, codes: Tensor) -> Tensor:
        """(N, G) -> (R, P), see :class:`Codebook`."""
        return codes.reshape(-1, len(self.book.vectors))

    def _quantise(self, latent: Tensor) -> BottleneckOutput:
        rows = latent.detach().reshape(-1, *self.book.vectors.shape[::2])
        indices = self.book.assign(rows)
        chosen = self.book.flat(indices)
        quantised, commitment, codebook = replace_by_codes(latent, self.book.vectors, chosen)
        losses = {"commitment": commitment}
        if self.book.rule == "gradient":
            losses["codebook"] = codebook
        codes = indices.reshape(-1, self.groups)
        counts = count_codes(codes, self.codes)
        if self.training:
            self.book.follow(rows, chosen, counts.sum(0, keepdim=True) if self.shared else counts)
            if self.bypass:
                drawn = torch.rand(rows_of_all(len(latent)), 1, device=latent.device)
                quantised = torch.where(own_rows(drawn) < self.bypass, latent, quantised)
            if self.group_dropout:
                quantised = self._without_some_groups(quantised)
        return BottleneckOutput(quantised, losses, codes, describe_use(counts))

    def _without_some_groups(self, latent: Tensor) -> Tensor:
        drawn = torch.rand(rows_of_all(len(latent)), self.groups, 1, device=latent.device)
        kept = own_rows(drawn) >= self.group_dropout
        return torch.flatten(latent.reshape(-1, self.groups, self.width // self.groups) * kept, 1)

    def _pass_through(self, latent: Tensor) -> BottleneckOutput:
        zero = torch.zeros((), dtype=self.book.vectors.dtype, device=latent.device)
        losses = {"commitment": zero}
        if self.book.rule == "gradient":
            # Keeps the parameter in the graph: distributed training refuses one that a step leaves out.
            losses["codebook"] = (self.book.vectors * 0.0).sum()
        return BottleneckOutput(latent, losses)

    def _approach_start(self, latent: Tensor) -> None:
        """Count a training step before the start, keep its latents, and start when its time has come."""
        if self.start == "kmeans":
            self.reservoir.add(latent)
        if self._steps < self.start_step:
            self._steps += 1
            self.steps += 1
            return
        if self.start == "kmeans":
            rows = self.reservoir.collect()
            points = rows.reshape(-1, *self.book.vectors.shape[::2]).transpose(0, 1).contiguous()
            centres, shares = kmeans(points, self.codes)
            step_rows = len(latent) * (self.groups if self.shared else 1) * process_count()
            self.book.place(centres, shares, step_rows)
            self.reservoir.release()
        self._started = True
        self.started.fill_(True)

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *rest: Any) -> None:
        started, gathered = state_dict.get(prefix + "started"), state_dict.get(prefix + "reservoir.rows")
        if started is not None and gathered is not None and not started and len(gathered) != self._capacity:
            raise UserError(
                f"{type(self).__name__}: saved before it started, while it kept {len(gathered)} rows to start from; "
                f"the configuration keeps {self._capacity} (see start and codes)"
            )
        super()._load_from_state_dict(state_dict, prefix, *rest)
        if started is not None:
            self._started, self._steps = bool(started), int(state_dict[prefix + "steps"])

    def _check_shape(self, width: int, groups: int, codes: int) -> None:
        self._check_range("groups", groups, groups >= 1, "at least 1")
        self._check_range("codes", codes, codes >= 1, "at least 1")
        if width % groups:
            divisors = [count for count in range(1, width + 1) if width % count == 0]
            below = max(count for count in divisors if count < groups)
            above = min((count for count in divisors if count > groups), default=below)
            choices = " or ".join(str(count) for count in dict.fromkeys((below, above)))
            raise UserError(
                f"{type(self).__name__}: groups {groups} does not divide the width {width} (nearest: {choices})"
            )

    def _check_choice(self, option: str, value: str, choices: tuple[str, ...]) -> None:
        if value not in choices:
            raise UserError(f"{type(self).__name__}: unknown {option} '{value}', {nearest(value, choices)}")

    def _check_range(self, option: str, value: float, valid: bool, wanted: str) -> None:
        if not valid:
            raise UserError(f"{type(self).__name__}: {option} must be {wanted}, is {value}")
