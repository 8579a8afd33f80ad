"""The search in chunks and on two levels beside all distances in float64."""

import pytest
import torch

from repdib_lightning.bottlenecks import nearest
from repdib_lightning.bottlenecks.nearest import nearest_codes


def slow(rows, codes):
    found = torch.empty(rows.shape[:2], dtype=torch.int64)
    for book, (own_rows, own_codes) in enumerate(zip(rows.double(), codes.double(), strict=True)):
        for row, point in enumerate(own_rows):
            found[book, row] = (own_codes - point).square().sum(-1).argmin()
    return found


@pytest.mark.parametrize("codes", [1, 2, 50, 255, 256, 300, 512])
@pytest.mark.parametrize("strided", [False, True])
def test_finds_what_a_loop_finds(codes, strided):
    torch.manual_seed(codes)
    rows = torch.randn(90, 3, 8).transpose(0, 1) if strided else torch.randn(3, 90, 8)
    vectors = torch.randn(3, codes, 8)
    assert torch.equal(nearest_codes(rows, vectors), slow(rows, vectors))


@pytest.mark.parametrize("kilobytes", [0, 1, 3, 40, 2000])
@pytest.mark.parametrize("codes", [50, 300])
def test_chunks_of_any_size_find_the_same(kilobytes, codes, monkeypatch):
    torch.manual_seed(0)
    rows, vectors = torch.randn(4, 77, 6), torch.randn(4, codes, 6)
    monkeypatch.setitem(nearest._CACHE_BYTES, "cpu", kilobytes << 10)
    assert torch.equal(nearest_codes(rows, vectors), slow(rows, vectors))


@pytest.mark.parametrize("codes", [50, 300])
def test_far_from_the_origin_and_equal_codes(codes):
    """Padding must never win, however large the scores, and equal codes are all right."""
    rows, vectors = torch.full((1, 5, 4), 1e3), torch.full((1, codes, 4), -1e3)
    found = nearest_codes(rows, vectors)
    assert found.min() >= 0 and found.max() < codes
    vectors[0, -1] = 999.0
    assert (nearest_codes(rows, vectors) == codes - 1).all()


def test_no_rows():
    assert nearest_codes(torch.empty(2, 0, 4), torch.randn(2, 300, 4)).shape == (2, 0)
