"""k-means over several groups at once: where a codebook starts."""

from __future__ import annotations

import torch
from torch import Tensor

from repdib_lightning.bottlenecks.nearest import nearest_codes


@torch.no_grad()
def kmeans(points: Tensor, clusters: int, *, iterations: int = 10) -> tuple[Tensor, Tensor]:
    """Cluster (P, R, D) points, each of the P groups on its own.

    Seeds are drawn by k-means++ from torch's generator of the points' device, then Lloyd's iterations follow. An empty
    cluster keeps its seed. With fewer distinct points than clusters some centres coincide.

    Returns:
        Centres (P, clusters, D), and the share of the points that each holds, (P, clusters).
    """
    assert points.shape[1] > 0, "k-means needs points"
    groups, rows, size = points.shape
    centres = spread_seeds(points, clusters)
    counts = points.new_zeros(groups, clusters)
    first = torch.arange(groups, device=points.device).unsqueeze(1) * clusters
    for _ in range(iterations):
        flat = (nearest_codes(points, centres) + first).flatten()
        counts = points.new_zeros(groups * clusters).index_add_(0, flat, points.new_ones(groups * rows))
        counts = counts.view(groups, clusters)
        sums = points.new_zeros(groups * clusters, size).index_add_(0, flat, points.reshape(-1, size))
        means = sums.view_as(centres) / counts.unsqueeze(-1).clamp(min=1)
        centres = torch.where(counts.unsqueeze(-1) > 0, means, centres)
    return centres, counts / rows


def spread_seeds(points: Tensor, clusters: int) -> Tensor:
    """k-means++ (Arthur and Vassilvitskii 2007): draw each seed with a chance that grows with its squared distance.

    (P, R, D) -> (P, clusters, D). A weight over an exponential variable is largest with a chance proportional to the
    weight, which draws without a cumulative sum (that of a GPU is not reproducible).
    """
    groups, rows, _ = points.shape
    every_group = torch.arange(groups, device=points.device)
    chosen = torch.randint(rows, (groups,), device=points.device)
    seeds = [points[every_group, chosen]]
    squares = points.square().sum(-1, keepdim=True)
    distance = points.new_full((groups, rows), torch.inf)
    for _ in range(clusters - 1):
        seed = seeds[-1].unsqueeze(-1)
        to_seed = torch.baddbmm(squares, points, seed, alpha=-2) + seed.square().sum(1, keepdim=True)
        distance = torch.minimum(distance, to_seed.squeeze(-1).clamp(min=0.0))
        chosen = (distance / torch.empty_like(distance).exponential_()).argmax(-1)
        seeds.append(points[every_group, chosen])
    return torch.stack(seeds, dim=1)
