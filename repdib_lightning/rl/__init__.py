"""Reinforcement learning on exported encoders: online with Stable-Baselines3's algorithms, offline with our own."""

from __future__ import annotations

AGENTS = {
    "bc": "repdib_lightning.rl.finetune_offline:finetune_bc",
    "ddpg": "repdib_lightning.rl.finetune_online:finetune_ddpg",
    "dqn": "repdib_lightning.rl.finetune_dqn:finetune_dqn",
    "dt": "repdib_lightning.rl.finetune_dt:finetune_dt",
    "sac": "repdib_lightning.rl.finetune_online:finetune_sac",
    "td3bc": "repdib_lightning.rl.finetune_offline:finetune_td3bc",
}
"""Agent -> ``module:function`` behind ``finetune AGENT``."""

CHECKS = {
    "bc": "repdib_lightning.rl.finetune_offline:check_bc",
    "ddpg": "repdib_lightning.rl.finetune_online:check_ddpg",
    "dqn": "repdib_lightning.rl.finetune_dqn:check_dqn",
    "dt": "repdib_lightning.rl.finetune_dt:check_dt",
    "sac": "repdib_lightning.rl.finetune_online:check_sac",
    "td3bc": "repdib_lightning.rl.finetune_offline:check_td3bc",
}
"""Agent -> ``module:function`` that takes the same options and raises UserError for what is wrong with them, as far as
that can be known without a bundle and before anything runs."""

RESUMABLE = ("dt",)
"""Agents whose ``finetune`` takes ``--resume``."""

FRESH_OPTIONS = ("features", "channels", "strides", "frame_stack")
"""Options of a fresh encoder, which mean nothing beside one that is given."""

GIVEN_OPTIONS = ("frozen", "bottleneck", "bottleneck_losses")
"""Options of an encoder that is given, which mean nothing without one."""
