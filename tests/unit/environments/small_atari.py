"""Files of small random networks that play Breakout from pictures of 36 x 36."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from repdib_lightning.environments.atari_network import NatureNetwork, write_atari_policy

SMALL_AGES = (30, 400)


def write_small(path: Path, *, stated: dict[str, Any] | None = None) -> Path:
    """Networks of both ages, which differ; ``stated`` facts are not those of the networks."""
    states = {}
    for age in SMALL_AGES:
        torch.manual_seed(age)
        network = NatureNetwork(4, 36, 4)
        for parameter in network.parameters():
            torch.nn.init.normal_(parameter, std=0.2)
        states[age] = network.state_dict()
    facts = {"game": "breakout", "frame_skip": 4, "sticky": 0.0, "stack": 4, "image_size": 36, "actions": 4}
    told = {str(age): {"return": 1.0} for age in SMALL_AGES}
    write_atari_policy(path, facts | {"networks": told} | (stated or {}), states)
    return path
