"""Replacing rows by their codes, with a gradient written out: it passes straight through the choice."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from repdib_lightning.bottlenecks.chunks import row_chunks


def replace_by_codes(latent: Tensor, vectors: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Replace each segment of a latent by its code (VQ-VAE, van den Oord et al. 2017, eq. 3).

    The same as a look-up, two mean squared errors and ``latent + (codes - latent).detach()``, without what automatic
    differentiation keeps and repeats for them. It can be differentiated once.

    Args:
        latent: (N, M).
        vectors: (P, L, D), the codes.
        chosen: (N * M / D,) int64, the code of each segment, counted through all books: book * L + code.

    Returns:
        The codes (N, M), whose gradient goes to ``latent`` unchanged; the commitment loss, mean square of latent minus
        codes, whose gradient goes to ``latent`` alone; and the codebook loss, the same number, whose gradient goes to
        ``vectors`` alone.
    """
    codes, commitment, codebook = _ReplaceByCodes.apply(latent, vectors, chosen)
    return codes, commitment, codebook


class _ReplaceByCodes(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, latent: Tensor, vectors: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        codes = vectors.flatten(0, 1).index_select(0, chosen).view_as(latent)
        squares = [torch.linalg.vector_norm(codes[rows] - latent[rows]).square() for rows in row_chunks(latent)]
        error = torch.stack(squares).sum() / latent.numel()
        ctx.save_for_backward(latent, codes, chosen)
        ctx.books = vectors.shape
        return codes, error, error.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_codes: Tensor, to_commitment: Tensor, to_codebook: Tensor) -> Any:
        latent, codes, chosen = ctx.saved_tensors
        books, per_book, size = ctx.books
        for_latent, for_vectors, _ = ctx.needs_input_grad
        to_latent = torch.empty_like(latent) if for_latent else None
        sums = latent.new_zeros(books * per_book, size) if for_vectors else None
        scale = 2.0 / latent.numel()
        for rows in row_chunks(latent):
            difference = codes[rows] - latent[rows]
            if to_latent is not None:
                torch.addcmul(to_codes[rows], difference, to_commitment * -scale, out=to_latent[rows])
            if sums is not None:
                segments = slice(rows.start * latent.shape[1] // size, rows.stop * latent.shape[1] // size)
                sums.index_add_(0, chosen[segments], difference.view(-1, size))
        to_vectors = sums.mul_(to_codebook * scale).view(ctx.books) if sums is not None else None
        return to_latent, to_vectors, None
