"""The grouped quantiser beside explicit loops in float64."""

import pytest
import torch

from repdib_lightning.bottlenecks import VectorQuantiser
from repdib_lightning.bottlenecks.codebook import count_codes, perplexity

N, M, G, L = 37, 12, 3, 5
D = M // G


def build(**options):
    torch.manual_seed(0)
    return VectorQuantiser(M, groups=G, codes=L, start="random", start_step=0, **options).double()


def slow_quantise(latent, codebook):
    """One row, one group, one code at a time."""
    codes = torch.zeros(N, G, dtype=torch.int64)
    chosen = torch.zeros_like(latent)
    for row in range(N):
        for group in range(G):
            segment = latent[row, group * D : (group + 1) * D]
            book = codebook[group % len(codebook)]
            distances = [float(((segment - code) ** 2).sum()) for code in book]
            codes[row, group] = distances.index(min(distances))
            chosen[row, group * D : (group + 1) * D] = book[codes[row, group]]
    return codes, chosen


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("rule", ["ema", "gradient"])
def test_codes_latent_and_losses(rule, shared):
    quantiser = build(codebook=rule, shared=shared)
    latent = torch.randn(N, M, dtype=torch.float64)
    codes, chosen = slow_quantise(latent, quantiser.codebook.detach().clone())
    output = quantiser(latent)
    assert torch.equal(output.codes, codes)
    assert torch.equal(output.latent, chosen)
    error = sum(float((a - b) ** 2) for a, b in zip(latent.flatten(), chosen.flatten(), strict=True)) / (N * M)
    assert set(output.losses) == ({"commitment"} if rule == "ema" else {"commitment", "codebook"})
    for loss in output.losses.values():
        assert loss.item() == pytest.approx(error, rel=1e-12)


@pytest.mark.parametrize("shared", [False, True])
def test_gradients(shared):
    quantiser = build(codebook="gradient", shared=shared)
    latent = torch.randn(N, M, dtype=torch.float64, requires_grad=True)
    weights = torch.randn(N, M, dtype=torch.float64)
    before = quantiser.codebook.detach().clone()
    codes, chosen = slow_quantise(latent.detach(), before)
    output = quantiser(latent)

    (straight,) = torch.autograd.grad((output.latent * weights).sum(), latent, retain_graph=True)
    assert torch.equal(straight, weights)

    (pull,) = torch.autograd.grad(output.losses["commitment"], latent, retain_graph=True)
    torch.testing.assert_close(pull, 2 * (latent.detach() - chosen) / (N * M))

    (moved,) = torch.autograd.grad(output.losses["codebook"], quantiser.book.vectors)
    expected = torch.zeros_like(before)
    for row in range(N):
        for group in range(G):
            book, code = group % len(before), codes[row, group]
            segment = latent.detach()[row, group * D : (group + 1) * D]
            expected[book, code] += 2 * (before[book, code] - segment) / (N * M)
    torch.testing.assert_close(moved, expected)


@pytest.mark.parametrize("chunk", [30, 10**6])
@pytest.mark.parametrize("shared", [False, True])
def test_running_averages_over_three_steps(shared, chunk, monkeypatch):
    monkeypatch.setattr("repdib_lightning.bottlenecks.chunks._CHUNK_ELEMENTS", chunk)
    decay, smoothing = 0.8, 1e-5
    quantiser = build(shared=shared, decay=decay, revive_after=0)
    vectors = quantiser.codebook.clone()
    sizes, sums = torch.ones(vectors.shape[:2], dtype=torch.float64), vectors.clone()
    for _ in range(3):
        latent = torch.randn(N, M, dtype=torch.float64)
        codes, _ = slow_quantise(latent, vectors)
        quantiser(latent)
        for book in range(len(vectors)):
            for code in range(L):
                chose = [
                    latent[row, group * D : (group + 1) * D]
                    for row in range(N)
                    for group in range(G)
                    if group % len(vectors) == book and codes[row, group] == code
                ]
                total = torch.stack(chose).sum(0) if chose else torch.zeros(D, dtype=torch.float64)
                sizes[book, code] = decay * sizes[book, code] + (1 - decay) * len(chose)
                sums[book, code] = decay * sums[book, code] + (1 - decay) * total
        for book in range(len(vectors)):
            mass = sizes[book].sum()
            for code in range(L):
                smooth = (sizes[book, code] + smoothing) / (mass + L * smoothing) * mass
                vectors[book, code] = sums[book, code] / smooth
        torch.testing.assert_close(quantiser.codebook, vectors)


def test_histogram_and_perplexity():
    codes = torch.tensor([[0, 1], [0, 2], [0, 1], [0, 4]])
    counts = count_codes(codes, L)
    assert counts.tolist() == [[4, 0, 0, 0, 0], [0, 2, 1, 0, 1]]
    expected = [1.0, 2 ** (0.5 * 1 + 0.25 * 2 + 0.25 * 2)]
    assert perplexity(counts).tolist() == pytest.approx(expected)
