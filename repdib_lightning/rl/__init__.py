"""Reinforcement learning on exported encoders, with Stable-Baselines3's algorithms."""

from __future__ import annotations

AGENTS = {"dqn": "repdib_lightning.rl.finetune_dqn:finetune_dqn"}
"""Agent -> ``module:function`` behind ``finetune AGENT``."""

CHECKS = {"dqn": "repdib_lightning.rl.finetune_dqn:check_dqn"}
"""Agent -> ``module:function`` that takes the same options and raises UserError for what is wrong with them, as far as
that can be known without a bundle and before anything runs."""

FRESH_OPTIONS = ("features", "channels", "strides")
"""Options of a fresh encoder, which mean nothing beside one that is given."""
