"""Clips handed to a frozen encoder: what is missing is let through, and what nearly fits gets a hint."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from repdib_lightning.errors import UserError
from repdib_lightning.export.observations import batched_observations
from repdib_lightning.records import ArraySpec, DataSpec

SPEC = DataSpec({"cam": ArraySpec((4, 3, 8, 10)), "pulse": ArraySpec((20, 6), "float32")})
CAM, PULSE = np.zeros((2, 4, 3, 8, 10), np.uint8), np.full((2, 20, 6), np.nan, np.float32)


def test_clips_pass_one_by_one_and_in_batches_with_all_that_is_missing():
    tensors, is_batched = batched_observations({"cam": CAM, "pulse": PULSE}, SPEC, torch.device("cpu"))
    assert is_batched and tensors["cam"].shape == CAM.shape and tensors["pulse"].isnan().all()
    tensors, is_batched = batched_observations({"cam": CAM[0], "pulse": PULSE[0]}, SPEC, torch.device("cpu"))
    assert not is_batched and tensors["cam"].shape == (1, 4, 3, 8, 10)


@pytest.mark.parametrize(
    ("cam", "pulse", "complaint"),
    [
        (CAM.transpose(0, 1, 3, 4, 2), PULSE, r"'cam' has shape \(2, 4, 8, 10, 3\), expected .*; channels come first$"),
        (CAM[0].transpose(0, 2, 3, 1), PULSE[0], r"'cam' has shape \(4, 8, 10, 3\), .*; channels come first$"),
        (CAM[:, :3], PULSE, "'cam' has shape .*; a clip has 4 steps: cut it, or fill it up with frames of zeros$"),
        (CAM, PULSE.transpose(0, 2, 1), r"'pulse' has shape \(2, 6, 20\), .*; steps come first, then channels$"),
        (CAM, PULSE[:, :7], "'pulse' has shape .*; a clip has 20 steps: cut it, or fill it up with NaN$"),
        (CAM[..., :9], PULSE, r"'cam' has shape \(2, 4, 3, 8, 9\), expected .*\)$"),
        (CAM[0, 0], PULSE, r"'cam' has shape \(3, 8, 10\), expected .*\)$"),
        (CAM, PULSE[..., :3], r"'pulse' has shape \(2, 20, 3\), expected .*\)$"),
    ],
)
def test_what_nearly_fits_gets_a_hint(cam, pulse, complaint):
    with pytest.raises(UserError, match=complaint):
        batched_observations({"cam": cam, "pulse": pulse}, SPEC, torch.device("cpu"))
