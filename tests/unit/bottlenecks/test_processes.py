"""Two processes must end with the codebook that one process gets from all their rows."""

import pytest
import torch
from torch import distributed, multiprocessing

from repdib_lightning.bottlenecks import VectorQuantiser
from repdib_lightning.bottlenecks.processes import gather_rows, process_count

M, G, L, ROWS, STEPS = 8, 2, 6, 24, 4
# Built before the process group exists, as Lightning may do, and used after.
RUNS = {
    "ema": {"start": "random", "start_step": 0, "revive_after": 0},
    "shared": {"start": "random", "start_step": 0, "revive_after": 0, "shared": True},
    "kmeans": {"start_step": 2, "revive_after": 1},
    "gradient": {"start_step": 1, "revive_after": 1, "codebook": "gradient"},
}


def build(name):
    torch.manual_seed(0)
    return VectorQuantiser(M, groups=G, codes=L, decay=0.8, **RUNS[name])


def batch(step):
    return torch.randn(ROWS, M, generator=torch.Generator().manual_seed(step))


def train_one_of_two(rank, folder):
    torch.set_num_threads(1)
    quantisers = {name: build(name) for name in RUNS}
    distributed.init_process_group("gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2)
    torch.manual_seed(100 + rank)
    for step in range(STEPS):
        for quantiser in quantisers.values():
            quantiser(batch(step)[rank::2])
    uneven = gather_rows(torch.full((rank + 1, 2), float(rank)))
    state = {name: quantiser.state_dict() for name, quantiser in quantisers.items()}
    torch.save({"state": state, "uneven": uneven, "count": process_count()}, f"{folder}/{rank}.pt")
    distributed.destroy_process_group()


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("processes")
    multiprocessing.spawn(train_one_of_two, args=(str(folder),), nprocs=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)]


@pytest.mark.parametrize("name", ["ema", "shared"])
def test_codebook_equals_that_of_one_process(both, name):
    alone = build(name)
    for step in range(STEPS):
        alone(batch(step))
    for result in both:
        torch.testing.assert_close(result["state"][name], alone.state_dict())


@pytest.mark.parametrize("name", list(RUNS))
def test_processes_agree_bit_by_bit(both, name):
    first, second = (result["state"][name] for result in both)
    assert first["started"]
    for key, value in first.items():
        assert torch.equal(value, second[key]), key


def test_rows_of_unequal_number_are_gathered_in_order(both):
    for result in both:
        assert result["count"] == 2
        assert result["uneven"].tolist() == [[0.0, 0.0], [1.0, 1.0], [1.0, 1.0]]


def test_one_process_does_nothing():
    rows = torch.randn(3, 2)
    assert gather_rows(rows) is rows
    assert process_count() == 1
