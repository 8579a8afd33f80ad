"""Hand-made features of readings: what they are, and how they are standardised."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from small_clips import SMALL, SPEC, clips

from repdib_lightning.encoders import MultimodalEncoder
from repdib_lightning.encoders.running_standardisation import RunningStandardisation
from repdib_lightning.encoders.window_statistics import STATISTICS, window_statistics

OF_WINDOWS = {"sensor_network": "statistics", "layers": 0}


def test_statistics_are_numpys_of_what_was_observed():
    windows = np.random.default_rng(0).normal(size=(4, 3, 20))
    windows[1, :, 5:9], windows[2, 1], windows[3] = np.nan, np.nan, np.nan
    got = window_statistics(torch.tensor(windows)).unflatten(-1, (3, STATISTICS)).numpy()
    for window, channel in [(0, 0), (0, 2), (1, 1), (2, 2)]:
        values = windows[window, channel]
        there = values[np.isfinite(values)]
        expected = [there.mean(), there.std(), *np.quantile(there, [0, 0.25, 0.5, 0.75, 1]), _mean_step(values)]
        np.testing.assert_allclose(got[window, channel], expected)
    assert not got[2, 1].any() and not got[3].any()


def _mean_step(values):
    steps = [abs(b - a) for a, b in pairwise(values) if np.isfinite(a) and np.isfinite(b)]
    return np.mean(steps)


def test_standardisation_is_by_all_rows_that_were_observed_in_training():
    torch.manual_seed(0)
    module = RunningStandardisation(3)
    rows = torch.randn(500, 3) * torch.tensor([1.0, 100.0, 0.0]) + torch.tensor([5.0, -300.0, 1234.567])
    observed = torch.rand(500) < 0.7
    for part in torch.arange(500).split(64):
        module(rows[part].masked_fill(~observed[part].unsqueeze(-1), 1e6), observed[part])
    seen = module.eval()(rows, observed)[observed]
    torch.testing.assert_close(seen.mean(0), torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(seen.std(0, correction=0), torch.tensor([1.0, 1.0, 0.0]), atol=1e-3, rtol=0)


def test_evaluation_changes_no_buffer_and_a_batch_without_readings_none_either():
    module = RunningStandardisation(2)
    module(torch.randn(10, 2), torch.ones(10, dtype=torch.bool))
    before = {name: buffer.clone() for name, buffer in module.named_buffers()}
    module(torch.randn(4, 2), torch.zeros(4, dtype=torch.bool))
    module.eval()(torch.randn(4, 2), torch.ones(4, dtype=torch.bool))
    for name, buffer in module.named_buffers():
        torch.testing.assert_close(buffer, before[name], msg=name)


@pytest.mark.parametrize("missing", [False, True])
def test_an_encoder_of_statistics_sees_each_clip_alone_and_is_saved_whole(missing):
    torch.manual_seed(0)
    encoder, other = (MultimodalEncoder(SPEC, **{**SMALL, **OF_WINDOWS}) for _ in range(2))
    for seed in range(3):
        encoder(clips(seed=seed))
    batch = clips(seed=5)
    if missing:
        batch["acceleration"][2] = torch.nan
    together = encoder.eval()(batch)
    alone = torch.cat([encoder({name: array[i : i + 1] for name, array in batch.items()}) for i in range(5)])
    torch.testing.assert_close(together, alone)
    other.load_state_dict(encoder.state_dict())
    assert torch.equal(other.eval()(batch), together)


def test_strong_readings_weigh_no_more_than_weak_ones():
    """Statistics of any size come to the same after the standardisation."""
    torch.manual_seed(0)
    windows, observed = torch.randn(64, 2, 20), torch.ones(64, dtype=torch.bool)
    latents = []
    for factor in (1.0, 1000.0):
        module = RunningStandardisation(2 * STATISTICS)
        latents.append(module(window_statistics(windows * factor), observed))
    torch.testing.assert_close(latents[0], latents[1], atol=1e-3, rtol=1e-3)
