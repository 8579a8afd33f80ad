"""An episode while it is played."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class Episode:
    """An episode that an environment is playing.

    Attributes:
        seed: of its beginning. frames: name -> (1, ...) rows of observations. actions, rewards, factors: so far.
    """

    seed: int
    frames: dict[str, list[np.ndarray]]
    factors: list[dict[str, np.ndarray]]
    actions: list[np.ndarray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)

    def stacked(self, name: str, stack: int) -> np.ndarray:
        """(S * C, ...) of the newest frames; the first one is repeated where there are fewer."""
        frames = self.frames[name]
        places = range(len(frames) - stack, len(frames))
        return frames[-1] if stack == 1 else np.concatenate([frames[max(place, 0)] for place in places])

    def as_stored(self) -> dict[str, Any]:
        """Arguments of :meth:`Replay.add`."""
        names = self.factors[0]
        factors = {name: np.stack([row[name] for row in self.factors]) for name in names}
        return {
            "observations": {name: np.stack(rows) for name, rows in self.frames.items()},
            "actions": np.stack(self.actions),
            "rewards": np.array(self.rewards, np.float32),
            "factors": {name: values[:, 0] if values.shape[1:] == (1,) else values for name, values in factors.items()},
        }
