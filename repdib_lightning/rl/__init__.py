"""Reinforcement learning on exported encoders, with Stable-Baselines3's algorithms."""

from __future__ import annotations

AGENTS = {"dqn": "repdib_lightning.rl.finetune_dqn:finetune_dqn"}
"""Agent -> ``module:function`` behind ``finetune AGENT``."""
