"""k-means over several groups at once: where a codebook starts."""

from __future__ import annotations

import torch
from torch import Tensor

_SCORES_AT_ONCE = 4_000_000


@torch.no_grad()
def kmeans(points: Tensor, clusters: int, *, iterations: int = 20) -> tuple[Tensor, Tensor]:
    """Cluster (P, R, D) points, each of the P groups on its own.

    Seeds are drawn by k-means++ from torch's generator of the points' device, then Lloyd's iterations follow. An empty
    cluster keeps its seed. With fewer distinct points than clusters some centres coincide.

    Returns:
        Centres (P, clusters, D), and the share of the points that each holds, (P, clusters).
    """
    assert points.shape[1] > 0, "k-means needs points"
    centres = spread_seeds(points, clusters)
    counts = points.new_zeros(centres.shape[:2])
    for _ in range(iterations):
        assigned = assign_in_chunks(points, centres)
        counts.zero_().scatter_add_(1, assigned, torch.ones_like(assigned, dtype=points.dtype))
        sums = torch.zeros_like(centres).scatter_add_(1, assigned.unsqueeze(-1).expand_as(points), points)
        centres = torch.where(counts.unsqueeze(-1) > 0, sums / counts.unsqueeze(-1).clamp(min=1), centres)
    return centres, counts / points.shape[1]


def spread_seeds(points: Tensor, clusters: int) -> Tensor:
    """k-means++ (Arthur and Vassilvitskii 2007): draw each seed with a chance that grows with its squared distance.

    (P, R, D) -> (P, clusters, D).
    """
    groups, rows, _ = points.shape
    every_group = torch.arange(groups, device=points.device)
    chosen = torch.randint(rows, (groups,), device=points.device)
    seeds = [points[every_group, chosen]]
    distance = torch.full((groups, rows), torch.inf, dtype=points.dtype, device=points.device)
    for _ in range(clusters - 1):
        distance = torch.minimum(distance, (points - seeds[-1].unsqueeze(1)).square().sum(-1))
        reached = distance.cumsum(-1)
        drawn = torch.rand(groups, 1, dtype=points.dtype, device=points.device) * reached[:, -1:]
        chosen = torch.searchsorted(reached, drawn, right=True).squeeze(-1).clamp(max=rows - 1)
        seeds.append(points[every_group, chosen])
    return torch.stack(seeds, dim=1)


def nearest_codes(points: Tensor, codes: Tensor) -> Tensor:
    """Index of the nearest code (Euclidean): points (P, R, D), codes (P, L, D) -> (P, R) int64.

    |z|^2 is the same for all codes and is left out; ``torch.cdist`` is avoided because it breaks ``torch.export``.
    """
    squares = codes.square().sum(-1).unsqueeze(1)
    return torch.baddbmm(squares, points, codes.transpose(1, 2), alpha=-2).min(-1).indices


def assign_in_chunks(points: Tensor, codes: Tensor) -> Tensor:
    """:func:`nearest_codes` with bounded memory, for many points."""
    rows = max(1, _SCORES_AT_ONCE // (codes.shape[0] * codes.shape[1]))
    return torch.cat([nearest_codes(chunk, codes) for chunk in points.split(rows, dim=1)], dim=1)
