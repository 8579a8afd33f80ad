"""Stable-Baselines3's DQN for networks that hold a bottleneck."""

from __future__ import annotations

from stable_baselines3 import DQN
from stable_baselines3.common.utils import polyak_update
from torch import Tensor


class BottleneckDQN(DQN):
    """DQN whose target network follows in its running codebooks too.

    They are buffers, which the original leaves as they were when the agent was built. They follow at the rate ``tau``
    of the parameters, so that the target's codes belong to the target's encoder.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        self._followed = _running(self.q_net), _running(self.q_net_target)

    def _on_step(self) -> None:
        super()._on_step()
        if self._n_calls % max(self.target_update_interval // self.n_envs, 1) == 0:
            polyak_update(*self._followed, self.tau)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_followed"]


def _running(network: object) -> list[Tensor]:
    """Buffers with fractions; counters stay as they are."""
    return [buffer for buffer in network.buffers() if buffer.is_floating_point()]  # type: ignore[attr-defined]
