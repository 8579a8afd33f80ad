"""A bottleneck for rows of which some are missing: they neither train it nor pass it."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.bottlenecks import Bottleneck
from repdib_lightning.processes import gather_rows, gather_with_gradients, process_count, several_processes
from repdib_lightning.records import BottleneckOutput

MISSING = -1
"""The code of a row that is missing."""


def pass_present(bottleneck: Bottleneck, vectors: Tensor, present: Tensor) -> BottleneckOutput:
    """Pass those of (N, M) that are ``present`` (N,) through; the others give zeros, and codes of -1.

    In training several processes share all their present rows out evenly (a few twice, so that each has as many), since
    they must call a bottleneck together and with equally many rows. Where no row is present, anywhere, all losses are
    0, there are no metrics, no buffer changes, and the parameters stay in the graph, as distributed training asks.
    """
    if torch.compiler.is_compiling():  # a traced program has no rows to choose: only the latent and codes count there
        return _masked(bottleneck(vectors), present)
    places = present.nonzero().squeeze(1)
    chosen, own = vectors[places], torch.arange(len(places), device=places.device)
    together = bottleneck.training and several_processes()
    if together:
        chosen, own = gather_with_gradients(chosen, equal=False)
    if not len(chosen):
        return _without_rows(bottleneck, vectors)
    output: BottleneckOutput = bottleneck(_own_share(chosen) if together else chosen)
    latent, codes = output.latent, output.codes
    if together:
        latent, _ = gather_with_gradients(latent, equal=True)
        codes = None if codes is None else gather_rows(codes)
    passed = torch.zeros_like(vectors).index_put((places,), latent[own])
    if codes is not None:
        all_codes = codes.new_full((len(vectors), codes.shape[1]), MISSING)
        codes = all_codes.index_put((places,), codes[own])
    return BottleneckOutput(passed, output.losses, codes, output.metrics)


def _own_share(rows: Tensor) -> Tensor:
    """This process's share of the rows of all; the first come again where they do not divide evenly."""
    share = -(-len(rows) // process_count())
    first = torch.distributed.get_rank() * share
    return rows[torch.arange(first, first + share, device=rows.device) % len(rows)]


def _without_rows(bottleneck: Bottleneck, vectors: Tensor) -> BottleneckOutput:
    training = bottleneck.training
    output = bottleneck.eval()(vectors.new_zeros(1, vectors.shape[1]))  # which draws nothing and changes no buffer
    bottleneck.train(training)
    losses = {name: loss * 0.0 for name, loss in output.losses.items()}
    latent = (vectors + output.latent) * 0.0
    codes = None if output.codes is None else output.codes.new_full((len(vectors), output.codes.shape[1]), MISSING)
    return BottleneckOutput(latent, losses, codes)


def _masked(output: BottleneckOutput, present: Tensor) -> BottleneckOutput:
    missing = ~present.unsqueeze(1)
    codes = None if output.codes is None else output.codes.masked_fill(missing, MISSING)
    return BottleneckOutput(output.latent.masked_fill(missing, 0.0), output.losses, codes, output.metrics)
