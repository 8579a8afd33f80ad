"""Two processes must end with the codebook that one process gets from all their rows."""

import pytest
import torch
from torch import distributed, multiprocessing

from repdib_lightning.bottlenecks import VectorQuantiser, codebook
from repdib_lightning.processes import gather_rows, own_rows, pick_rows, process_count, rows_of_all

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
    torch.manual_seed(100)
    for step in range(STEPS):
        for quantiser in quantisers.values():
            quantiser(batch(step).chunk(2)[rank])
    drawn = own_rows(torch.randn(rows_of_all(3), 2))
    picked = pick_rows(torch.arange(6.0).view(3, 2) + 6 * rank, torch.tensor([5, 0, 3, 0]))
    naive = train_naively(rank)
    uneven = gather_rows(torch.full((rank + 1, 2), float(rank)))
    state = {name: quantiser.state_dict() for name, quantiser in quantisers.items()}
    torch.save(
        {"state": state, "uneven": uneven, "count": process_count(), **naive, "drawn": drawn, "picked": picked},
        f"{folder}/{rank}.pt",
    )
    distributed.destroy_process_group()


def train_naively(rank):
    """The same codebook without an exchange; once as it is, once with rank 0's buffers copied, as DDP does."""
    codebook.sum_over_processes = lambda tensor: tensor
    states = {}
    for name in ("naive", "naive_copied"):
        quantiser = build("ema")
        for step in range(STEPS):
            quantiser(batch(step).chunk(2)[rank])
            if name == "naive_copied":
                for buffer in quantiser.buffers():
                    distributed.broadcast(buffer, src=0)
        states[name] = quantiser.state_dict()
    return states


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("processes")
    multiprocessing.spawn(train_one_of_two, args=(str(folder),), nprocs=2)
    return [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(2)]


@pytest.mark.parametrize("name", list(RUNS))
def test_codebook_equals_that_of_one_process(both, name):
    alone = {kind: build(kind) for kind in RUNS}
    torch.manual_seed(100)
    for step in range(STEPS):
        for quantiser in alone.values():
            quantiser(batch(step))
    for result in both:
        torch.testing.assert_close(result["state"][name], alone[name].state_dict())


def test_without_exchange_the_processes_would_differ(both):
    first, second = (result["naive"]["book.vectors"] for result in both)
    assert (first - second).abs().max() > 0.1


def test_with_copied_buffers_alone_they_would_agree_and_be_wrong(both):
    """What distributed training does with buffers by itself hides the mistake: half of the rows count."""
    first, second = (result["naive_copied"]["book.vectors"] for result in both)
    assert torch.equal(first, second)
    assert (first - both[0]["state"]["ema"]["book.vectors"]).abs().max() > 0.1


def test_noise_of_all_is_shared_out(both):
    left, right = (result["drawn"] for result in both)
    assert left.shape == right.shape == (3, 2) and not torch.equal(left, right)


def test_picked_rows_come_from_whoever_holds_them(both):
    for result in both:
        assert result["picked"].tolist() == [[10.0, 11.0], [0.0, 1.0], [6.0, 7.0], [0.0, 1.0]]


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
