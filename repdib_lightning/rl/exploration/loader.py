"""Batches of an exploration: taking the next one steps the environments."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import torch

from repdib_lightning.rl.exploration.collection import Collection
from repdib_lightning.rl.exploration.replay import ReplayBatch

if TYPE_CHECKING:
    from repdib_lightning.rl.exploration.data import ExplorationDataModule

REPLAY = "replay.h5"
"""Name of the store in the run's folder."""


class ExplorationLoader:
    """Batches of a run, one an update; resumable after any of them.

    Args:
        data: the data module.
    """

    def __init__(self, data: ExplorationDataModule) -> None:
        self._data = data
        self.collection: Collection | None = None
        self._state: dict[str, Any] = {"steps": 0, "updates": 0, "episodes": 0, "seeds": [], "actions": torch.zeros(0)}

    def __len__(self) -> int:
        """Updates of the whole run."""
        return self._data.schedule.updates

    @property
    def steps(self) -> int:
        """Actions so far, of all environments."""
        return int(self._state["steps"]) if self.collection is None else self.collection.steps

    @property
    def episodes(self) -> int:
        """Whole episodes so far."""
        return int(self._state["episodes"]) if self.collection is None else self.collection.replay.episodes

    def __iter__(self) -> Iterator[ReplayBatch]:
        """Yield what is left."""
        collection = self._opened()
        for number in collection.updates(self._data.act):
            yield collection.replay.draw(number, self._data.batch_size)

    def _opened(self) -> Collection:
        if self.collection is None:
            begun = bool(self._state["steps"])
            self.collection = self._data.open_collection(self._state["episodes"] if begun else None)
            self.collection.load_state_dict(self._state)
        return self.collection

    def state_dict(self) -> dict[str, Any]:
        """See :meth:`Collection.state_dict`."""
        return self._state if self.collection is None else self.collection.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on after the batch at which the state was taken."""
        assert self.collection is None, "a run that has begun cannot be put somewhere else"
        self._state = state

    def finish(self) -> None:
        """Where every update is done, take what actions are left and publish the replay."""
        published = self._data.folder is not None and (self._data.folder / REPLAY).exists()
        if not published and self.state_dict()["updates"] == len(self):
            collection = self._opened()
            collection.finish(self._data.act)
            collection.replay.finish()
        self.close()

    def close(self) -> None:
        """Close environments and replay."""
        if self.collection is not None:
            self._state = self.collection.state_dict()
            self.collection.close()
            self.collection = None
