"""The mazes as data, collected on first use."""

from __future__ import annotations

import json
import sys

from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.errors import UserError


class MazeDataModule(EpisodeDataModule):
    """A maze of the paper under a random policy; the file is collected first if it does not exist.

    Args:
        path: the store.
        world: ``GridWorld``, ``SpiralWorld`` or ``LoopWorld``.
        samples: actions to record where the file has to be collected (paper: 10,000).
        distractors: what plays behind the maze; see :mod:`repdib_lightning.environments.distractors`. None: nothing.
        collection_seed: of that recording.
        batch_size, horizon, futures, frame_stack, views, workers, seed, resident, next_frame: see
            :class:`EpisodeDataModule`.
    """

    def __init__(
        self,
        path: str = "data/gridworld.h5",
        world: str = "GridWorld",
        samples: int = 10_000,
        distractors: str | None = None,
        collection_seed: int = 0,
        batch_size: int = 128,
        horizon: int = 2,
        futures: int = 1,
        frame_stack: int = 1,
        views: list[str] | None = None,
        workers: int = 0,
        seed: int = 0,
        resident: bool = False,
        next_frame: bool = False,
    ) -> None:
        super().__init__(path, batch_size, horizon, futures, frame_stack, views, workers, seed, resident, next_frame)
        self.world, self.distractors = world, distractors
        self.samples, self.collection_seed = samples, collection_seed

    def prepare_data(self) -> None:
        """Collect the recording if there is none (some seconds), and say so."""
        if not self.path.exists():
            from repdib_lightning.environments.collect_maze import collect_maze  # reading does not need it

            print(f"{self.path}: no such file; collecting {self.world} there", file=sys.stderr, flush=True)
            collect_maze(
                self.path,
                world=self.world,
                samples=self.samples,
                seed=self.collection_seed,
                distractors=self.distractors,
            )

    def setup(self, stage: str | None = None) -> None:
        """Open and validate the store.

        Raises:
            UserError: something in the file is wrong (named), or it was recorded in another world, or with other
                distractors, than the options name.
        """
        super().setup(stage)
        assert self.store is not None
        if self.store.attributes.get("environment") != "maze":
            return
        recorded = json.loads(self.store.attributes["configuration"])
        for name, wanted in (("world", self.world), ("distractors", self.distractors)):
            if recorded[name] != wanted:
                raise UserError(
                    f"{self.path}: was recorded with {name}={recorded[name]}, data.{name} is {wanted}; "
                    "choose another data.path, or the option that it was recorded with"
                )
