"""Which code is nearest to each row: the one expensive step of a vector quantiser, kept within the cache."""

from __future__ import annotations

import torch
from torch import Tensor

_CACHE_BYTES = {"cpu": 4 << 20, "cuda": 256 << 20}
"""Scores to hold at once, for each of at most eight threads on a CPU: more would leave the cache, and with fewer the
threads wait for each other longer than they work. On a GPU this only bounds the memory."""
_BLOCKS = 16
_MANY_CODES = 256


@torch.no_grad()
def nearest_codes(rows: Tensor, codes: Tensor) -> Tensor:
    """Index of the nearest code (Euclidean): rows (P, R, D), codes (P, L, D) -> (P, R) int64.

    One product a chunk of rows gives |e|^2 - 2 z.e; |z|^2 is the same for all codes and is left out.
    ``torch.cdist`` is avoided because it breaks ``torch.export``. Of codes equally near, any one is returned.
    """
    # |e|^2 as the last coordinate of the codes and 1 as that of the rows would copy the rows; as a bias it is free.
    bias, product = codes.square().sum(-1).unsqueeze(1), codes.transpose(1, 2)
    if torch.compiler.is_compiling():
        # A compiler sees one expression for every size: no loop to unroll, and min and product to fuse.
        return torch.baddbmm(bias, rows, product, alpha=-2).min(-1).indices
    two_levels = rows.device.type == "cpu" and codes.shape[1] >= _MANY_CODES
    if two_levels:
        bias, product = _padded(bias, float("inf")), _padded(product, 0.0)
    books, count, _ = rows.shape
    nearest = torch.empty(books, count, dtype=torch.int64, device=rows.device)
    book_step, row_step = _chunk(rows, bias.shape[-1])
    # One piece of memory for all chunks: it stays in the cache.
    memory = rows.new_empty(min(book_step, books) * min(row_step, count) * bias.shape[-1])
    for book in range(0, books, book_step):
        here = slice(book, book + book_step)
        for row in range(0, count, row_step):
            chunk = slice(row, row + row_step)
            part = rows[here, chunk]
            scores = memory[: part.shape[0] * part.shape[1] * bias.shape[-1]].view(*part.shape[:2], -1)
            torch.baddbmm(bias[here], part, product[here], alpha=-2, out=scores)
            nearest[here, chunk] = _lowest(scores) if two_levels else scores.min(-1).indices
    return nearest


def _chunk(rows: Tensor, codes: int) -> tuple[int, int]:
    """How many books, and how many rows of each, have scores that fit the cache."""
    threads = min(8, torch.get_num_threads()) if rows.device.type == "cpu" else 1
    scores = _CACHE_BYTES.get(rows.device.type, _CACHE_BYTES["cuda"]) * threads // rows.element_size()
    at_once = max(1, scores // codes)
    count = max(1, rows.shape[1])
    return (max(1, at_once // count), count) if at_once >= count else (1, at_once)


def _padded(matrix: Tensor, value: float) -> Tensor:
    """(P, *, L) with L filled up to a multiple of the number of blocks."""
    return torch.nn.functional.pad(matrix, (0, -matrix.shape[-1] % _BLOCKS), value=value)


def _lowest(scores: Tensor) -> Tensor:
    """Index of the lowest of (P, R, L), exactly, in two levels.

    A minimum without its index takes a fifth of the time. So: the minimum over 16 blocks of codes, the place of the
    lowest within a block, and then which block it came from.
    """
    blocks = scores.unflatten(-1, (_BLOCKS, -1))
    place = blocks.amin(-2).min(-1, keepdim=True).indices
    block = blocks.gather(-1, place.unsqueeze(-2).expand(*blocks.shape[:-1], 1)).squeeze(-1).min(-1).indices
    lowest: Tensor = block * blocks.shape[-1] + place.squeeze(-1)
    return lowest
