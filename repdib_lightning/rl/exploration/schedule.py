"""When environments are stepped, and when what learns from them is updated."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Schedule:
    """When environments are stepped, and when agents are updated; counts of actions of all environments together.

    Attributes:
        environments: E, stepped together. episode: actions of one, T.
        total: actions in all. seed: before the first update. update_every: between two updates.
        random: of the first ones, which are drawn evenly; the policy is asked for all later ones.
    """

    environments: int
    episode: int
    total: int
    seed: int
    update_every: int
    random: int

    @classmethod
    def of_frames(
        cls, *, frames: int, action_repeat: int, episode: int, environments: int, seed_frames: int, update_every: int
    ) -> Schedule:
        """From counts of frames, each of which is a control step of an environment.

        All environments play whole episodes, so that there may be more frames than asked for. No update comes before
        the first episodes are in the replay.
        """
        together = environments * episode
        total = math.ceil(frames / (together * action_repeat)) * together
        seed = max(math.ceil(seed_frames / action_repeat), together + environments)
        return cls(environments, episode, total, seed, update_every, seed)

    @property
    def episodes(self) -> int:
        """Of all environments."""
        return self.total // self.episode

    @property
    def updates(self) -> int:
        """Until the last action."""
        return max(0, self.total - self.seed) // self.update_every

    @property
    def episodes_at_first(self) -> int:
        """Whole ones in the replay at the first update; the step under way is not in yet."""
        return (math.ceil(self.seed / self.environments) - 1) // self.episode * self.environments

    def actions_before(self, update: int) -> int:
        """How many actions have been taken when an update (from 0 on) is due."""
        return self.seed + update * self.update_every
