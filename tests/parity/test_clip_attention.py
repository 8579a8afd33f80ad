"""Pooling over steps and fusion of modalities beside loops over one clip, and beside torch's own attention."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from repdib_lightning.encoders.modality_fusion import AttentionFusion, KeylessFusion, WeightingFusion
from repdib_lightning.encoders.self_attention import MaskedSelfAttention
from repdib_lightning.encoders.temporal_pooling import AttentionPooling, KeylessPooling

D, HEADS, N, T = 6, 2, 4, 5
SEEN = torch.tensor([[1, 1, 1, 1, 1], [1, 1, 0, 0, 0], [0, 1, 0, 1, 1], [0, 0, 0, 0, 0]]).bool()


@pytest.fixture
def rows():
    torch.manual_seed(0)
    return torch.randn(N, T, D, dtype=torch.float64)


def softmax(scores):
    total = sum(math.exp(score) for score in scores)
    return [math.exp(score) / total for score in scores]


def keyless(vectors, seen, weight):
    """e_t = w^T h_t, lambda = softmax(e), of one clip: lambda and the lambda_t h_t."""
    shares = torch.zeros(len(vectors), dtype=torch.float64)
    observed = [t for t in range(len(vectors)) if seen[t]]
    for t, share in zip(observed, softmax([float(weight @ vectors[t]) for t in observed]), strict=True):
        shares[t] = share
    return shares, torch.stack([shares[t] * vectors[t] for t in range(len(vectors))])


def attend(vectors, seen, module):
    """Multi-head self-attention of one clip: what each step becomes, and how much it is attended to on average."""
    size = D // HEADS
    asked, keys, values = (
        vectors @ module.inputs.weight[part * D : (part + 1) * D].T + module.inputs.bias[part * D : (part + 1) * D]
        for part in range(3)
    )
    observed = [t for t in range(len(vectors)) if seen[t]]
    mixed = torch.zeros(len(vectors), D, dtype=torch.float64)
    received = torch.zeros(len(vectors), dtype=torch.float64)
    for head in range(HEADS):
        part = slice(head * size, (head + 1) * size)
        for t in observed:
            shares = softmax([float(asked[t, part] @ keys[s, part]) / math.sqrt(size) for s in observed])
            for share, s in zip(shares, observed, strict=True):
                mixed[t, part] += share * values[s, part]
                received[s] += share / len(observed) / HEADS
    outputs = torch.zeros(len(vectors), D, dtype=torch.float64)
    for t in observed:
        outputs[t] = module.output.weight @ mixed[t] + module.output.bias
    return outputs, received


def shaken(module):
    """With biases other than zero."""
    for parameter in module.parameters():
        nn.init.normal_(parameter, std=0.5)
    return module.double().requires_grad_(False)


def test_keyless_pooling(rows):
    module = shaken(KeylessPooling(D))
    pooled, weights = module(rows, SEEN)
    for row in range(N):
        shares, parts = keyless(rows[row], SEEN[row], module.score.weight[0])
        torch.testing.assert_close(weights[row], shares)
        torch.testing.assert_close(pooled[row], parts.sum(0))


def test_attention_pooling(rows):
    module = shaken(AttentionPooling(D, HEADS))
    pooled, weights = module(rows, SEEN)
    for row in range(N):
        outputs, received = attend(rows[row], SEEN[row], module.attention)
        torch.testing.assert_close(weights[row], received)
        torch.testing.assert_close(pooled[row], outputs.sum(0) / max(int(SEEN[row].sum()), 1))


@pytest.mark.parametrize("join", ["sum", "concat"])
def test_attention_fusion(rows, join):
    module = shaken(AttentionFusion(D, T, join, HEADS))
    fused, weights = module(rows, SEEN)
    for row in range(N):
        outputs, received = attend(rows[row], SEEN[row], module.attention)
        torch.testing.assert_close(weights[row], received)
        torch.testing.assert_close(fused[row], outputs.sum(0) if join == "sum" else outputs.flatten())


@pytest.mark.parametrize("join", ["sum", "concat"])
def test_keyless_fusion(rows, join):
    module = shaken(KeylessFusion(D, T, join))
    fused, weights = module(rows, SEEN)
    for row in range(N):
        shares, parts = keyless(rows[row], SEEN[row], module.score.weight[0])
        torch.testing.assert_close(weights[row], shares)
        torch.testing.assert_close(fused[row], parts.sum(0) if join == "sum" else parts.flatten())


@pytest.mark.parametrize("join", ["sum", "concat"])
def test_weighting_fusion(rows, join):
    module = shaken(WeightingFusion(D, T, join))
    fused, weights = module(rows, SEEN)
    kernel = module.score.weight[0]  # (D, 3)
    for row in range(N):
        present = [m for m in range(T) if SEEN[row, m]]
        scores = [
            sum(float(kernel[:, k] @ rows[row, m + k - 1]) for k in range(3) if m + k - 1 in present) for m in present
        ]
        shares = torch.zeros(T, dtype=torch.float64)
        for m, share in zip(present, softmax(scores), strict=True):
            shares[m] = share
        parts = shares[:, None] * rows[row]
        torch.testing.assert_close(weights[row], shares)
        torch.testing.assert_close(fused[row], parts.sum(0) if join == "sum" else parts.flatten())


def test_attention_equals_that_of_torch(rows):
    module = shaken(MaskedSelfAttention(D, HEADS))
    peer = nn.MultiheadAttention(D, HEADS, batch_first=True).double()
    names = {"in_proj_weight": module.inputs.weight, "in_proj_bias": module.inputs.bias}
    names |= {"out_proj.weight": module.output.weight, "out_proj.bias": module.output.bias}
    peer.load_state_dict(names)
    some = SEEN.any(1)  # where nothing is observed, torch's gives NaN
    theirs, weights = peer(rows[some], rows[some], rows[some], key_padding_mask=~SEEN[some])
    ours, received = module(rows, SEEN)
    torch.testing.assert_close(ours[some][SEEN[some]], theirs[SEEN[some]])
    for row, (seen, shares) in enumerate(zip(SEEN[some], weights, strict=True)):
        torch.testing.assert_close(received[some][row], shares[seen].mean(0))
    assert (ours[~SEEN] == 0).all()


@pytest.mark.parametrize("module", [KeylessPooling(D), AttentionPooling(D, HEADS), AttentionFusion(D, T, "sum", HEADS),
                                    KeylessFusion(D, T, "concat"), WeightingFusion(D, T, "sum")])  # fmt: skip
def test_what_was_not_observed_has_neither_weight_nor_gradient(rows, module):
    rows = rows.float().requires_grad_()
    outputs, weights = module(rows, SEEN)
    outputs.square().sum().backward()
    assert (weights[~SEEN] == 0).all() and (rows.grad[~SEEN] == 0).all()
    assert outputs.isfinite().all() and all(parameter.grad.isfinite().all() for parameter in module.parameters())
    torch.testing.assert_close(weights.sum(1), SEEN.any(1).float())
