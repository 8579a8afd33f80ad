"""The fast linear layer against torch's."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from repdib_lightning.rl.fast_linear import FastLinear


def pair(inputs, outputs):
    torch.manual_seed(2)
    fast = FastLinear(inputs, outputs)
    plain = nn.Linear(inputs, outputs)
    plain.load_state_dict(fast.state_dict())
    return fast, plain


@pytest.mark.parametrize(("inputs", "outputs"), [(262, 256), (300, 1000), (20, 8)])
def test_the_fast_layer_gives_values_and_gradients_of_a_linear_layer(inputs, outputs):
    found = []
    for layer in pair(inputs, outputs):
        given = torch.randn(33, inputs, generator=torch.Generator().manual_seed(0)).requires_grad_()
        out = layer(given)
        (out * torch.linspace(-1, 1, outputs)).square().mean().backward()
        found.append([out, given.grad, layer.weight.grad, layer.bias.grad])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-5)


def test_only_asked_gradients_are_computed():
    fast, _ = pair(300, 300)
    fast.requires_grad_(False)
    given = torch.randn(4, 300, requires_grad=True)
    fast(given).sum().backward()
    assert fast.weight.grad is None and given.grad is not None
    fast.requires_grad_(True)
    fast(given.detach()).sum().backward()
    assert fast.weight.grad.any()


@pytest.mark.skipif(not torch.backends.mkldnn.is_available(), reason="this torch is built without oneDNN")
def test_wide_layers_take_the_fast_product_and_others_do_not():
    def products(layer, given):
        with torch.profiler.profile() as profile, torch.inference_mode():
            layer(given)
        return {event.key for event in profile.key_averages()}

    fast, _ = pair(300, 300)
    assert "aten::mkldnn_linear" in products(fast, torch.randn(4, 300))
    assert "aten::mkldnn_linear" not in products(pair(300, 20)[0], torch.randn(4, 300))
    assert "aten::mkldnn_linear" not in products(fast.double(), torch.randn(4, 300, dtype=torch.float64))


@pytest.mark.filterwarnings("ignore:TF32")
def test_the_fast_layer_takes_what_a_linear_layer_takes():
    fast, plain = pair(300, 300)
    for given in (torch.randn(0, 300), torch.randn(2, 3, 300), torch.randn(300)):
        torch.testing.assert_close(fast(given), plain(given), rtol=1e-4, atol=1e-5)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert fast(torch.randn(3, 300)).dtype == torch.bfloat16
    with torch.backends.mkldnn.flags(enabled=False):
        given = torch.randn(5, 300)
        assert torch.equal(fast(given), plain(given))
