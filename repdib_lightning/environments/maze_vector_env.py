"""Many mazes as one gymnasium vector environment, stepped by array operations."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from repdib_lightning.environments.maze_batch import NO_GOAL, CellName, MazeBatch
from repdib_lightning.environments.maze_pictures import draw_for_people
from repdib_lightning.environments.mazes import MOVES
from repdib_lightning.errors import UserError


class MazeVectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """n mazes with the rules and options of :class:`~repdib_lightning.environments.maze_env.MazeEnv`.

    The step after the end of an episode ignores its action and begins the next one, with reward 0 (gymnasium's
    ``NEXT_STEP``). ``infos["factors"]`` holds the ground truth, (n,) int64 each, with masks as in gymnasium.

    Args:
        num_envs: n.
        world, size, cell_pixels, goals, start, evaluation, episode_length, show_walls, distractors, distractor_seed,
        render_mode: see ``MazeEnv``.

    Raises:
        UserError: as ``MazeEnv``.
    """

    metadata = {  # noqa: RUF012 (gymnasium's own convention)
        "render_modes": ["rgb_array"],
        "render_fps": 4,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        world: str = "GridWorld",
        *,
        size: int = 6,
        cell_pixels: int = 5,
        goals: str | Iterable[CellName] | None = None,
        start: CellName = "random",
        evaluation: bool = False,
        episode_length: int | None = None,
        show_walls: bool = False,
        distractors: str | None = None,
        distractor_seed: int = 0,
        render_mode: str | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UserError(f"render_mode={render_mode}: must be rgb_array or None")
        self.render_mode = render_mode
        self.num_envs = num_envs
        self.batch = MazeBatch(
            num_envs,
            world,
            size=size,
            cell_pixels=cell_pixels,
            goals=goals,
            start=start,
            evaluation=evaluation,
            episode_length=episode_length,
            show_walls=show_walls,
            distractors=distractors,
            distractor_seed=distractor_seed,
        )
        self.maze = self.batch.maze
        pixels = self.batch.painter.pixels
        self.single_observation_space = gymnasium.spaces.Box(0, 255, (3, pixels, pixels), np.uint8)
        self.single_action_space = gymnasium.spaces.Discrete(len(MOVES))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended: np.ndarray | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start episodes.

        Args:
            seed: of all n mazes together.
            options: ``start`` and ``goal`` choose, each one cell for all mazes or a sequence of n cells, as the
                arguments name cells; ``reset_mask`` (n,) bool: the mazes to reset, all by default.

        Returns:
            Observations (n, 3, H, W) uint8 of all mazes; infos of those that were reset.

        Raises:
            UserError: another option, a wrong mask, a cell outside the maze, or a start on its goal.
        """
        super().reset(seed=seed)
        chosen = dict(options or {})
        which = self._mask(chosen.pop("reset_mask", np.ones(self.num_envs, bool)))
        self.batch.reset(which, self.np_random, **self.batch.chosen(chosen))
        self._ended = np.zeros(self.num_envs, bool) if self._ended is None else self._ended & ~which
        return self.batch.pictures(), self._infos(which)

    def _mask(self, given: Any) -> np.ndarray:
        if isinstance(given, np.ndarray) and given.dtype == bool and given.shape == (self.num_envs,) and given.any():
            if self._ended is None and not given.all():
                raise UserError("reset_mask: the first reset must be of all mazes")
            return given
        raise UserError(f"reset_mask: expected a numpy array of {self.num_envs} booleans, at least one of them True")

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Move the mazes whose episode goes on, reset the others.

        Args:
            actions: (n,) integers.

        Returns:
            Observations (n, 3, H, W) uint8, rewards (n,) float64, terminations and truncations (n,) bool, infos.

        Raises:
            UserError: actions that do not exist.
        """
        assert self._ended is not None, "call reset() first"
        rewards, reached, truncated = self.batch.move(actions, ~self._ended)
        if self._ended.any():
            self.batch.reset(self._ended, self.np_random)
        self._ended = reached | truncated
        return self.batch.pictures(), rewards, reached, truncated, self._infos(np.ones(self.num_envs, bool))

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """A picture for people of each maze, (H, W, 3) uint8; None without ``render_mode="rgb_array"``."""
        if self.render_mode is None:
            return None
        backgrounds = self.batch.backgrounds()
        return tuple(
            np.asarray(
                draw_for_people(
                    self.maze,
                    int(self.batch.cells[index]),
                    None if self.batch.goals[index] == NO_GOAL else int(self.batch.goals[index]),
                    None if backgrounds is None else backgrounds[index],
                )
            )
            for index in range(self.num_envs)
        )

    def _infos(self, which: np.ndarray) -> dict[str, Any]:
        """Gymnasium's form: beside each entry a mask of the mazes that it is about; elsewhere it is 0."""
        factors: dict[str, np.ndarray] = {}
        for name, values in self.batch.factors().items():
            factors |= {name: np.where(which, values, 0), f"_{name}": which.copy()}
        return {"factors": factors, "_factors": which.copy()}
