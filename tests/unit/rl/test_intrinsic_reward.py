"""The nearest-neighbour reward beside a slow version, and what becomes of duplicates."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
import torch

from repdib_lightning.errors import UserError
from repdib_lightning.rl.exploration.intrinsic_reward import NearestNeighbourReward

WAYS = ("keep", "distinct", "count")


class Slow:
    """A list of rows and of what names them, one row at a time."""

    def __init__(self, queue, neighbours, duplicates, distance="euclidean"):
        self.queue, self.neighbours, self.duplicates, self.distance = queue, neighbours, duplicates, distance
        self.rows, self.names = [], []

    def between(self, one, other):
        if self.distance == "hamming":
            return np.mean(one != other)
        return math.sqrt(sum((float(a) - float(b)) ** 2 for a, b in zip(one, other, strict=True)))

    def __call__(self, rows, candidates, names=None):
        names = [tuple(row) for row in rows] if names is None else [tuple(name) for name in names]
        for index in candidates:
            self.rows.append(rows[index])
            self.names.append(names[index])
        self.rows, self.names = self.rows[-self.queue :], self.names[-self.queue :]
        return np.array([self.reward(row, name) for row, name in zip(rows, names, strict=True)])

    def reward(self, row, name):
        if self.duplicates == "keep":
            found = [self.between(row, other) for other in self.rows]
        else:
            best: dict[tuple, float] = {}
            for other, its in zip(self.rows, self.names, strict=True):
                best[its] = min(best.get(its, math.inf), self.between(row, other))
            found = list(best.values())
        found = sorted(found)[: self.neighbours]
        reward = found[-1] if found else 0.0
        return reward / math.sqrt(max(1, self.names.count(name))) if self.duplicates == "count" else reward


def unit_rows(generator, count, width, kinds=None):
    """Unit vectors; where ``kinds`` is given, of that many different ones."""
    rows = torch.randn(kinds or count, width, generator=generator)
    rows = torch.nn.functional.normalize(rows, dim=-1)
    return rows if kinds is None else rows[torch.randint(0, kinds, (count,), generator=generator)]


@pytest.mark.parametrize("kinds", [None, 3, 9])
@pytest.mark.parametrize("duplicates", WAYS)
def test_it_equals_the_slow_version_through_several_turns_of_the_queue(duplicates, kinds):
    """From an empty queue on, with fewer rows than k, partly filled, wrapped, and given more than it holds."""
    generator = torch.Generator().manual_seed(0)
    ours = NearestNeighbourReward(4, queue=11, neighbours=3, duplicates=duplicates)
    slow = Slow(11, 3, duplicates)
    seen = unit_rows(generator, 200, 4, kinds)
    for size in (0, 1, 1, 2, 4, 5, 5, 0, 15, 11, 3):
        batch = seen[torch.randint(0, 200, (9,), generator=generator)]
        candidates = torch.randint(0, 9, (size,), generator=generator)
        rewards = ours(batch, candidates)
        assert rewards.shape == (9,) and rewards.dtype == torch.float32
        wanted = slow(batch.numpy(), candidates.tolist())
        np.testing.assert_allclose(rewards.numpy(), wanted, rtol=1e-6, atol=1e-6)
        assert int(ours.filled) == len(slow.rows)


@pytest.mark.parametrize("duplicates", WAYS)
@pytest.mark.parametrize("kind", [torch.int64, torch.float32])
def test_codes_differ_in_a_share_of_their_groups(duplicates, kind):
    generator = torch.Generator().manual_seed(0)
    ours = NearestNeighbourReward(4, queue=13, neighbours=3, duplicates=duplicates, distance="hamming")
    slow = Slow(13, 3, duplicates, "hamming")
    for size in (2, 5, 5, 5):
        codes = torch.randint(0, 3, (8, 4), generator=generator)
        candidates = torch.randint(0, 8, (size,), generator=generator)
        wanted = slow(codes.numpy(), candidates.tolist())
        np.testing.assert_allclose(ours(codes.to(kind), candidates).numpy(), wanted, rtol=1e-6)
    one, other = torch.tensor([[1, 2, 3, 4]]), torch.tensor([[1, 2, 30, 4]])
    reward = NearestNeighbourReward(4, queue=5, neighbours=1, duplicates="keep", distance="hamming")
    assert reward(one, torch.tensor([0])) == 0 and reward(other, torch.tensor([], dtype=torch.int64)) == 0.25


@pytest.mark.parametrize("duplicates", WAYS)
def test_equal_codes_name_what_is_the_same_while_embeddings_move(duplicates):
    generator = torch.Generator().manual_seed(0)
    ours = NearestNeighbourReward(4, queue=11, neighbours=2, duplicates=duplicates, groups=3)
    slow = Slow(11, 2, duplicates)
    for _ in range(5):
        rows, codes = unit_rows(generator, 8, 4), torch.randint(0, 2, (8, 3), generator=generator)
        candidates = torch.randint(0, 8, (4,), generator=generator)
        wanted = slow(rows.numpy(), candidates.tolist(), codes.tolist())
        np.testing.assert_allclose(ours(rows, candidates, codes).numpy(), wanted, rtol=1e-6, atol=1e-6)


def test_before_a_quantiser_starts_no_row_is_another():
    reward = NearestNeighbourReward(3, queue=8, neighbours=2, duplicates="count", groups=2)
    rows = torch.eye(3)[[0, 0, 0, 1]]
    assert reward.duplicated(rows) == 0
    rewards = reward(rows, torch.arange(4))
    torch.testing.assert_close(rewards, torch.tensor([0.0, 0.0, 0.0, math.sqrt(2)]))
    assert reward.duplicated(rows) == 0
    reward(rows, torch.arange(2), torch.tensor([[0, 0], [0, 0], [1, 1], [0, 1]]))
    assert reward.duplicated(rows, torch.tensor([[0, 0], [0, 1], [0, 0], [1, 1]])) == 0.5


def test_candidates_enter_before_anything_is_measured():
    reward = NearestNeighbourReward(2, queue=10, neighbours=1, duplicates="keep")
    rows = torch.tensor([[0.0, 0.0], [3.0, 4.0]])
    torch.testing.assert_close(reward(rows, torch.tensor([0])), torch.tensor([0.0, 5.0]))
    torch.testing.assert_close(reward(rows, torch.tensor([1])), torch.tensor([0.0, 0.0]))


def test_an_empty_queue_gives_nothing_and_zeros_are_no_neighbours():
    for duplicates in WAYS:
        reward = NearestNeighbourReward(2, queue=10, neighbours=3, duplicates=duplicates)
        assert reward(torch.tensor([[1.0, 0.0]]), torch.tensor([], dtype=torch.int64)) == 0
        # One row alone, at distance 5; the nine unfilled rows would have been at 1.
        reward(torch.tensor([[4.0, 4.0]]), torch.tensor([0]))
        assert reward(torch.tensor([[1.0, 0.0]]), torch.tensor([], dtype=torch.int64)) == 5


def rewards_of_a_common_and_a_rare_code(duplicates):
    """Two codes as far from all others: one stands in the queue once, the other fifty times."""
    reward = NearestNeighbourReward(8, queue=100, neighbours=3, duplicates=duplicates)
    rows = torch.eye(8)
    entering = torch.tensor([0] * 50 + [1, 2, 3, 4, 5])
    common, rare, _, _, _, _, unseen, _ = reward(rows, entering).tolist()
    return common, rare, unseen


def test_what_is_common_is_worth_less_than_what_is_rare():
    far = math.sqrt(2)
    common, rare, unseen = rewards_of_a_common_and_a_rare_code("keep")
    assert common == 0.0 and (rare, unseen) == pytest.approx((far, far))
    common, rare, unseen = rewards_of_a_common_and_a_rare_code("distinct")
    assert (common, rare, unseen) == pytest.approx((far, far, far))
    common, rare, unseen = rewards_of_a_common_and_a_rare_code("count")
    assert (common, rare, unseen) == pytest.approx((far / math.sqrt(50), far, far))


def test_without_copies_all_ways_agree():
    generator = torch.Generator().manual_seed(0)
    rows, later = unit_rows(generator, 30, 6), unit_rows(generator, 30, 6)
    given = []
    for duplicates in WAYS:
        reward = NearestNeighbourReward(6, queue=40, duplicates=duplicates)
        given.append([reward(rows, torch.arange(0, 30, 2)), reward(later, torch.arange(25))])
    for first, second in (given[1], given[2]):
        torch.testing.assert_close(first, given[0][0])
        torch.testing.assert_close(second, given[0][1])


@pytest.mark.parametrize("duplicates", WAYS)
def test_what_is_close_is_measured_as_well_as_what_is_far(duplicates):
    """Distances of 1e-5 between unit vectors: a matrix product in float32 would lose them."""
    generator = torch.Generator().manual_seed(0)
    centre = unit_rows(generator, 1, 32)
    rows = centre + 1e-5 * torch.randn(20, 32, generator=generator) / math.sqrt(32)
    rewards = NearestNeighbourReward(32, queue=50, duplicates=duplicates)(rows, torch.arange(20))
    wanted = Slow(50, 3, duplicates)(rows.numpy(), range(20))
    np.testing.assert_allclose(rewards.numpy(), wanted, rtol=0.01)
    assert rewards.min() > 1e-6


def test_duplicates_are_counted_among_what_was_seen_before():
    reward = NearestNeighbourReward(3, queue=4)
    rows = torch.eye(3)[[0, 1, 1, 2]]
    assert reward.duplicated(rows) == 0
    reward(rows, torch.tensor([1]))
    assert reward.duplicated(rows) == 0.5
    reward(rows, torch.tensor([0, 0, 0, 3]))
    assert reward.duplicated(rows) == 0.5
    assert NearestNeighbourReward(3).duplicated(torch.zeros(2, 3)) == 0  # the unfilled rows are no rows


def test_a_saved_queue_goes_on_exactly():
    generator = torch.Generator().manual_seed(0)
    first, second = (NearestNeighbourReward(4, queue=10, groups=2) for _ in range(2))
    for _ in range(3):
        first(unit_rows(generator, 6, 4), torch.arange(4), torch.randint(0, 2, (6, 2), generator=generator))
    second.load_state_dict(first.state_dict())
    rows, codes = unit_rows(generator, 6, 4), torch.randint(0, 2, (6, 2), generator=generator)
    assert torch.equal(first(rows, torch.arange(3), codes), second(rows, torch.arange(3), codes))
    assert all(torch.equal(value, second.state_dict()[name]) for name, value in first.state_dict().items())
    assert {"rows", "codes", "filled", "position"} == set(first.state_dict())


def test_no_gradient_and_no_half_precision():
    reward = NearestNeighbourReward(4, queue=20).to(torch.bfloat16)
    rows = torch.randn(6, 4, requires_grad=True)
    plain = NearestNeighbourReward(4, queue=20)(rows, torch.arange(6))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rewards = reward(rows, torch.arange(6))
    assert torch.equal(rewards, plain) and not rewards.requires_grad and reward.rows.dtype == torch.float32


def test_it_costs_little():
    """ProtoRL's sizes, on one thread: some 30 ms where nothing else runs."""
    generator = torch.Generator().manual_seed(0)
    rows, candidates = unit_rows(generator, 1024, 128), torch.randint(0, 1024, (512,), generator=generator)
    for duplicates in WAYS:
        reward, taken = NearestNeighbourReward(128, duplicates=duplicates), []
        for _ in range(7):
            start = time.perf_counter()
            reward(rows, candidates)
            taken.append(time.perf_counter() - start)
        assert min(taken) < 0.2, duplicates


def test_bad_options():
    with pytest.raises(UserError, match=r"unknown duplicates 'distinkt', did you mean 'distinct'\?"):
        NearestNeighbourReward(4, duplicates="distinkt")
    with pytest.raises(UserError, match=r"unknown distance 'haming', did you mean 'hamming'\?"):
        NearestNeighbourReward(4, distance="haming")
    with pytest.raises(UserError, match="queue must be at least 1, is 0"):
        NearestNeighbourReward(4, queue=0)
    for neighbours in (0, 6):
        with pytest.raises(UserError, match=rf"neighbours must be in 1\.\.5 \(the queue\), is {neighbours}"):
            NearestNeighbourReward(4, queue=5, neighbours=neighbours)
