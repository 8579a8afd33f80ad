"""One bottleneck for all positions: the same as calling it on each of them."""

from __future__ import annotations

import pytest
import torch

from repdib_lightning.bottlenecks import BOTTLENECKS, PerPosition, RepDIB, VectorQuantiser, for_positions

QUANTISED = {"groups": 2, "codes": 7, "start": "random", "start_step": 0}


def build(name):
    torch.manual_seed(0)
    return BOTTLENECKS[name](6, **(QUANTISED if name in ("RepDIB", "VectorQuantiser") else {}))


@pytest.mark.parametrize("name", sorted(BOTTLENECKS))
def test_positions_are_rows_of_the_inner_one(name):
    latents = torch.randn(4, 5 * 6)
    whole = PerPosition(build(name), 5).eval()
    output, alone = whole(latents), build(name).eval()(latents.reshape(20, 6))
    assert torch.equal(output.latent, alone.latent.reshape(4, 30))
    assert output.losses.keys() == alone.losses.keys()
    for key, value in alone.losses.items():
        assert torch.equal(output.losses[key], value)
    if alone.codes is not None:
        assert torch.equal(output.codes.reshape(4, 5, 2), alone.codes.reshape(4, 5, 2))
        torch.testing.assert_close(whole.decode(output.codes), output.latent)
    assert (whole.groups, whole.codes) == (5 * build(name).groups, build(name).codes)


def test_training_moves_the_one_book_by_all_positions():
    latents = torch.randn(8, 3 * 6)
    books = []
    for bottleneck, rows in ((PerPosition(build("VectorQuantiser"), 3), latents), (build("VectorQuantiser"), None)):
        bottleneck.train()
        bottleneck(latents.reshape(24, 6) if rows is None else rows)
        books.append(next(m for m in bottleneck.modules() if isinstance(m, VectorQuantiser)).codebook.clone())
    assert torch.equal(*books)
    assert not torch.equal(books[0], build("VectorQuantiser").codebook)


def test_evaluation_changes_no_buffer():
    bottleneck = PerPosition(RepDIB(6, **QUANTISED), 3).eval()
    before = {name: value.clone() for name, value in bottleneck.state_dict().items()}
    bottleneck(torch.randn(4, 18))
    assert all(torch.equal(value, before[name]) for name, value in bottleneck.state_dict().items())


def test_without_a_grid_there_is_no_wrapper():
    assert isinstance(for_positions(lambda width: RepDIB(width, **QUANTISED), 6, 1), RepDIB)
    assert for_positions(lambda width: RepDIB(width, **QUANTISED), 24, 4).width == 24
    waiting = for_positions(lambda width: RepDIB(width, groups=2, codes=3, start_step=5), 24, 4)
    assert not waiting.ready
