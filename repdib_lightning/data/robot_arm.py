"""The default data: the simulated robot arm, collected on first use."""

from __future__ import annotations

import sys

from repdib_lightning.data.datamodule import EpisodeDataModule


class RobotArmDataModule(EpisodeDataModule):
    """The robot arm of the paper's robot experiment; the file is collected first if it does not exist.

    Args:
        path: the store.
        samples: actions to record where the file has to be collected (paper: 14,000).
        collection_seed: of that recording.
        batch_size, horizon, futures, frame_stack, views, workers, seed, resident, next_frame: see
            :class:`EpisodeDataModule`.
    """

    def __init__(
        self,
        path: str = "data/robot_arm.h5",
        samples: int = 14_000,
        collection_seed: int = 0,
        batch_size: int = 128,
        horizon: int = 5,
        futures: int = 1,
        frame_stack: int = 1,
        views: list[str] | None = None,
        workers: int = 0,
        seed: int = 0,
        resident: bool = False,
        next_frame: bool = False,
    ) -> None:
        super().__init__(path, batch_size, horizon, futures, frame_stack, views, workers, seed, resident, next_frame)
        self.samples, self.collection_seed = samples, collection_seed

    def prepare_data(self) -> None:
        """Collect the recording if there is none (about two minutes on two cores), and say so."""
        if not self.path.exists():
            from repdib_lightning.environments.collect_robot_arm import collect_robot_arm  # needs MuJoCo

            print(f"{self.path}: no such file; collecting the robot arm there", file=sys.stderr, flush=True)
            collect_robot_arm(self.path, samples=self.samples, seed=self.collection_seed)
