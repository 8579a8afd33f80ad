"""Makes data sets of the mazes: a random policy that no reward and no end of an episode interrupts."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.environments.episode_workers import evaluation_episodes
from repdib_lightning.environments.maze_batch import MazeBatch
from repdib_lightning.environments.mazes import MOVES, Cell
from repdib_lightning.errors import UserError
from repdib_lightning.records import ActionSpec, ArraySpec

VIEW = "picture"
"""Name of the observation."""


@dataclass(frozen=True)
class MazeRecording:
    """What a recording is made of, as :func:`collect_maze` names it; together it decides every byte."""

    world: str
    samples: int
    episode_length: int
    seed: int
    goals: str
    distractors: str | None
    cell_pixels: int
    show_walls: bool

    def __post_init__(self) -> None:
        for name, least in {"samples": 1, "episode_length": 1, "seed": 0}.items():
            if getattr(self, name) < least:
                raise UserError(f"{name}={getattr(self, name)}: must be at least {least}")

    @property
    def lengths(self) -> list[int]:
        """Actions of each episode; the last one takes what is left."""
        bounds = [*range(0, self.samples, self.episode_length), self.samples]
        return [end - start for start, end in pairwise(bounds)]

    def mazes(self) -> tuple[MazeBatch, MazeBatch]:
        """One maze for training, and one for evaluation: with the same goals, and other clips."""
        training = self._maze(self.goals or None, evaluation=False)
        goals = [training.maze.place(cell) for cell in training.goal_cells]
        return training, self._maze(goals or "none", evaluation=True)

    def _maze(self, goals: str | list[Cell] | None, evaluation: bool) -> MazeBatch:
        return MazeBatch(
            1,
            self.world,
            goals=goals,
            evaluation=evaluation,
            cell_pixels=self.cell_pixels,
            show_walls=self.show_walls,
            distractors=self.distractors,
            distractor_seed=self.seed,
        )


def collect_maze(
    path: str | Path,
    *,
    world: str = "GridWorld",
    samples: int = 10_000,
    episode_length: int = 100,
    seed: int = 0,
    goals: str = "",
    distractors: str | None = None,
    cell_pixels: int = 5,
    show_walls: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Record a maze under a uniform random policy, without reward (paper, maze navigation: 10,000 frames of GridWorld).

    Observation ``picture``, (3, H, W) uint8, with the agent's mask; 4 discrete actions. Each episode starts in a random
    cell and shows a goal, as the task later will, but goes on where the agent stands on it. About 30 % of the
    episodes, spread over the recording, are marked for evaluation; behind these play other clips.

    Args:
        path: the file to make.
        world: ``GridWorld``, ``SpiralWorld`` or ``LoopWorld``.
        samples: actions over all episodes; the last episode is shorter where they do not divide.
        episode_length: actions an episode.
        seed: of starts, goals, policy and clips.
        goals: cells that an episode's goal is drawn from, such as ``"centre 0,5"``; ``none`` draws no goal. By default
            the goals of training: the four cells in the middle.
        distractors: what plays behind the maze: ``procedural``, ``procedural_images``, a folder of pictures or videos,
            or of CIFAR-10. None: a black floor.
        cell_pixels: height and width of a cell.
        show_walls: draw the walls.
        overwrite: replace an existing file.
        progress: show a progress bar.

    Returns:
        The path.

    Raises:
        UserError: an option out of range, a file that exists or cannot be written, unreadable distractors.
    """
    recording = MazeRecording(
        world, samples, episode_length, seed, goals, distractors, cell_pixels=cell_pixels, show_walls=show_walls
    )
    training, held_out = recording.mazes()
    pixels = training.painter.pixels
    lengths, rows = recording.lengths, samples + len(recording.lengths)
    writer = EpisodeWriter(
        path,
        rows=rows,
        episodes=len(lengths),
        observations={VIEW: ArraySpec((3, pixels, pixels))},
        actions=ActionSpec("discrete", len(MOVES)),
        factors=factor_specs(training),
        masks={VIEW: (pixels, pixels)},
        attributes={
            "environment": "maze",
            "configuration": asdict(recording),
            "seed": seed,
            "classes": {"actions": list(MOVES)},
            "licence": "generated",
        },
        overwrite=overwrite,
    )
    evaluation = evaluation_episodes(len(lengths))
    with writer, _progress_bar(samples, progress) as bar:
        for episode, length in enumerate(lengths):
            batch = held_out if episode in evaluation else training
            recorded = _record_episode(batch, length, np.random.default_rng([seed, episode]))
            first = episode * (episode_length + 1)
            recorded["factors"]["time_step"] = np.arange(first, first + length + 1) / rows
            writer.add_episode(**recorded, evaluation=episode in evaluation)
            bar.update(length)
    return Path(path)


def factor_specs(batch: MazeBatch) -> dict[str, FactorSpec]:
    """The ground-truth factors of a recording.

    - ``position``: cell of the agent, row * size + column.
    - ``goal``: cell of the goal; only where there are goals. It never changes in an episode.
    - ``time_step``: row within the whole recording, divided by the number of rows: [0, 1). Nothing in the picture
      shows it, unless backgrounds betray the episode.
    - ``clip``: which background is seen; numbers of training clips come first. Only with distractors.
    """
    found = {"position": FactorSpec("endogenous", "categorical", classes=batch.maze.cells)}
    if len(batch.goal_cells):
        found["goal"] = FactorSpec("endogenous", "categorical", classes=batch.maze.cells)
    found["time_step"] = FactorSpec("exogenous", "continuous")
    if batch.clip_count:
        found["clip"] = FactorSpec("exogenous", "categorical", classes=batch.clip_count)
    return found


def _record_episode(batch: MazeBatch, length: int, random: np.random.Generator) -> dict[str, Any]:
    """Arguments of :meth:`EpisodeWriter.add_episode` but for what depends on the place in the recording."""
    batch.reset(np.ones(1, bool), random)
    actions = random.integers(len(MOVES), size=length)
    pictures, factors = [batch.pictures()], [batch.factors()]
    for action in actions:
        batch.move(action[None])  # the goal ends nothing: there is no reward yet
        pictures.append(batch.pictures())
        factors.append(batch.factors())
    joined = {name: np.concatenate([factor[name] for factor in factors]) for name in factors[0]}
    return {
        "observations": {VIEW: np.concatenate(pictures)},
        "actions": actions,
        "factors": joined,
        "masks": {VIEW: batch.painter.agent_masks(joined["position"])},
    }


def _progress_bar(samples: int, shown: bool) -> Any:
    from tqdm import tqdm

    return tqdm(total=samples, unit=" samples", desc="maze", disable=not shown)
