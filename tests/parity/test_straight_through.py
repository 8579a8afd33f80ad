"""The gradient written out beside that of automatic differentiation."""

import pytest
import torch
from torch import nn

from repdib_lightning.bottlenecks import chunks
from repdib_lightning.bottlenecks.straight_through import replace_by_codes

N, M, D, L = 29, 12, 4, 6


def slow(latent, vectors, chosen):
    codes = vectors.flatten(0, 1)[chosen].view_as(latent)
    passed = latent + (codes - latent).detach()
    return passed, (latent - codes.detach()).square().mean(), (codes - latent.detach()).square().mean()


@pytest.mark.parametrize("books", [1, M // D])
@pytest.mark.parametrize("chunk", [1, 50, 10**6])
@pytest.mark.parametrize("weights", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0.25, 2)])
def test_outputs_and_gradients(books, chunk, weights, monkeypatch):
    monkeypatch.setattr(chunks, "_CHUNK_ELEMENTS", chunk)
    torch.manual_seed(0)
    latent = torch.randn(N, M, dtype=torch.float64, requires_grad=True)
    vectors = torch.randn(books, L, D, dtype=torch.float64, requires_grad=True)
    chosen = torch.randint(0, L, (N, M // D)) + (torch.arange(M // D) * L if books > 1 else 0)
    mixture = torch.randn(N, M, dtype=torch.float64)
    results = []
    for function in (replace_by_codes, slow):
        outputs = function(latent, vectors, chosen.flatten())
        total = sum(w * part for w, part in zip(weights, ((outputs[0] * mixture).sum(), *outputs[1:]), strict=True))
        gradients = torch.autograd.grad(total, (latent, vectors), allow_unused=True, materialize_grads=True)
        results.append((*outputs, *gradients))
    for fast, right in zip(*results, strict=True):
        torch.testing.assert_close(fast, right, rtol=1e-12, atol=1e-14)


def test_latent_is_exactly_the_codes():
    latent, vectors = 1e3 * torch.randn(N, M), 1e-3 * torch.randn(M // D, L, D)
    chosen = (torch.randint(0, L, (N, M // D)) + torch.arange(M // D) * L).flatten()
    codes, _, _ = replace_by_codes(latent, vectors, chosen)
    assert torch.equal(codes, vectors.flatten(0, 1)[chosen].view(N, M))


def test_codes_of_a_frozen_book_train_the_encoder_alone():
    layer, vectors = nn.Linear(M, M), torch.randn(M // D, L, D)
    chosen = (torch.randint(0, L, (N, M // D)) + torch.arange(M // D) * L).flatten()
    codes, commitment, _ = replace_by_codes(layer(torch.randn(N, M)), vectors, chosen)
    (codes.sum() + commitment).backward()
    assert layer.weight.grad.abs().sum() > 0 and vectors.grad is None
