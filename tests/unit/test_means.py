"""Held-out means weigh batches by their samples and hide nothing."""

import torch

from repdib_lightning.means import SampleMeans


def test_batches_count_by_their_samples():
    means = SampleMeans()
    means.add({"loss": torch.tensor(1.0), "error": torch.tensor(2.0)}, 30)
    means.add({"loss": torch.tensor(4.0), "error": torch.tensor(2.0)}, 10)
    assert {name: float(value) for name, value in means.take().items()} == {"loss": 1.75, "error": 2.0}
    means.add({"loss": torch.tensor(5.0)}, 2)
    assert {name: float(value) for name, value in means.take().items()} == {"loss": 5.0}


def test_nan_is_not_left_out():
    means = SampleMeans()
    means.add({"loss": torch.tensor(1.0)}, 4)
    means.add({"loss": torch.tensor(float("nan"))}, 4)
    assert means.take()["loss"].isnan()
