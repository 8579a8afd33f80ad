"""Pictures become floats in the layout of the convolutions, and the input stays as it was."""

import pytest
import torch

from repdib_lightning.encoders.views import centred


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
@pytest.mark.parametrize("memory_format", [torch.contiguous_format, torch.channels_last])
def test_values_and_layout(dtype, memory_format):
    given = torch.randint(0, 256, (4, 3, 6, 5)).to(dtype).contiguous(memory_format=memory_format)
    before = given.clone()
    found = centred(given)
    assert torch.equal(found, before.float() / 255.0 - 0.5)
    assert found.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(given, before)
