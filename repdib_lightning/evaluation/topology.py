"""Whether distances between latents follow how an agent can move (paper, figure on relative distances)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist
from scipy.stats import spearmanr

from repdib_lightning.environments.maze_batch import MazeBatch
from repdib_lightning.export.frozen import FrozenEncoder

BACKGROUNDS = 8
"""Backgrounds that distances are averaged over, where a maze has any."""


@dataclass(frozen=True)
class Topology:
    """Distances in a maze, as an encoder has them and as they are.

    Attributes:
        latent: (cells, cells) Euclidean distance of the latents, with the goal where the evaluation has it.
        path: (cells, cells) moves on the shortest path.
        straight: (cells, cells) Euclidean distance of the cells, walls ignored.
        centre: the cell that the map is drawn from.
    """

    latent: np.ndarray
    path: np.ndarray
    straight: np.ndarray
    centre: int

    def measures(self) -> dict[str, float]:
        """Rank correlations (Spearman) of the latent distance; 0 where all latents are the same.

        - ``topology``: with the shortest path, from the centre; ``topology_pairs``: over all pairs of cells.
        - ``straight_line``, ``straight_line_pairs``: the same with the straight line.
        """
        others = np.arange(len(self.path)) != self.centre
        pairs = np.triu_indices(len(self.path), 1)
        found = {}
        for name, wanted in (("topology", self.path), ("straight_line", self.straight)):
            found[name] = _rank_correlation(self.latent[self.centre, others], wanted[self.centre, others])
            found[f"{name}_pairs"] = _rank_correlation(self.latent[pairs], wanted[pairs])
        return found

    @property
    def latent_map(self) -> np.ndarray:
        """(cells,) latent distance from the centre."""
        return self.latent[self.centre]

    @property
    def path_map(self) -> np.ndarray:
        """(cells,) moves from the centre."""
        return self.path[self.centre]


def latent_topology(encoder: FrozenEncoder, mazes: MazeBatch) -> Topology:
    """Encode the agent in every cell and compare the distances.

    Args:
        encoder: takes one observation, a picture of the maze; a stack of frames is one of standing still.
        mazes: one maze for each cell; its goal is that of the evaluation. They are moved.
    """
    maze = mazes.maze
    assert len(mazes.cells) == maze.cells, "one maze for each cell"
    random = np.random.default_rng(0)
    distances = []
    for _ in range(BACKGROUNDS if mazes.clip_count else 1):
        mazes.reset(np.ones(maze.cells, bool), random)
        mazes.share_background()
        for cell in range(maze.cells):
            mazes.place(cell, cell, maze.centre)
        pictures = np.concatenate([mazes.pictures()] * encoder.spec.frame_stack, axis=1)
        latents = encoder.encode(pictures).cpu().numpy().astype(np.float64)
        distances.append(cdist(latents, latents))
    places = np.array([maze.place(cell) for cell in range(maze.cells)], np.float64)
    return Topology(np.mean(distances, axis=0), maze.distances, cdist(places, places), maze.centre)


def _rank_correlation(ours: np.ndarray, wanted: np.ndarray) -> float:
    return 0.0 if np.ptp(ours) == 0 else float(spearmanr(ours, wanted).statistic)
