import torch

from repdib_lightning.bottlenecks.reservoir import Reservoir


def numbered(first, last):
    return torch.arange(first, last, dtype=torch.float32).unsqueeze(1).expand(-1, 2)


def kept(reservoir):
    return sorted(reservoir.collect()[:, 0].tolist())


def test_keeps_the_latest_rows_in_any_portions():
    for portion in (1, 3, 7, 20, 50):
        reservoir = Reservoir(7, 2)
        for first in range(0, 50, portion):
            reservoir.add(numbered(first, min(first + portion, 50)))
        assert kept(reservoir) == list(range(43, 50)), portion


def test_gives_only_what_was_added():
    reservoir = Reservoir(7, 2)
    reservoir.add(numbered(5, 8))
    assert kept(reservoir) == [5, 6, 7]


def test_release_frees_the_memory():
    reservoir = Reservoir(7, 2)
    reservoir.release()
    assert reservoir.rows.shape == (0, 2)
    assert reservoir.rows.untyped_storage().nbytes() == 0
