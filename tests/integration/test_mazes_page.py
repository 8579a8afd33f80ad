"""The Python on the page about the mazes: another algorithm on a frozen encoder, and with one that it trains."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from repdib_lightning.__main__ import main
from repdib_lightning.environments.collect_maze import collect_maze

PAGE = Path(__file__).parents[2] / "docs/mazes.md"
SMALL = ["--data.batch_size", "8", "--trainer.max_steps", "3", "--trainer.val_check_interval", "2",
         "--trainer.limit_val_batches", "1", "--model.bottleneck.init_args.start_step", "1"]  # fmt: skip


@pytest.fixture
def parts(tmp_path, monkeypatch):
    """What the page's code leaves behind."""
    monkeypatch.chdir(tmp_path)
    collect_maze("data/gridworld.h5", samples=240, episode_length=24, progress=False)
    assert main(["fit", "--config", "mazes", *SMALL, "--run", "runs/maze"]) == 0
    assert main(["export", "runs/maze"]) == 0
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    names: dict = {}
    exec(code, names)
    return names


def test_one_agent_leaves_the_encoder_alone_and_the_other_trains_it(parts):
    encoder, features = parts["encoder"], parts["trained"].policy.features_extractor
    pictures = torch.randint(0, 256, (4, 3, 30, 30), dtype=torch.uint8)
    latent = encoder.encode(pictures)
    features.train(False)
    torch.testing.assert_close(features({"picture": pictures}), latent)
    for name in ("frozen", "trained"):
        parts[name].learn(64)
    assert torch.equal(encoder.encode(pictures), latent)
    features.train(False)
    assert not torch.allclose(features({"picture": pictures}), latent)
