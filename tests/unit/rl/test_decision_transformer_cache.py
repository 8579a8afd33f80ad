"""Playing on with a cache gives what a full pass over the window gives, in every step."""

from __future__ import annotations

import pytest
import torch
from small_choices import network, windows_of

from repdib_lightning.rl.decision_transformer.cache import CachedContext


def full(net, given, first, last):
    """Logits (n, A) at step ``last`` of the window that begins at step ``first``."""
    part = slice(first, last + 1)
    start = torch.full((len(given["returns"]),), first)
    return net(given["states"][:, part], given["returns"][:, part], given["actions"][:, part], start)[:, -1]


def feed(cached, given, step, rows=slice(None)):
    before = None if step == 0 else given["actions"][rows, step - 1]
    return cached.step(given["states"][rows, step], given["returns"][rows, step], before)


@pytest.mark.parametrize("context", [1, 2, 3, 5, 8])
@torch.inference_mode()
def test_every_step_is_that_of_a_full_pass(context):
    net = network(context=context)
    given = windows_of(net.sizes, steps=30)  # longer than the 20 time steps that are known
    cached = CachedContext(net, 4)
    begins = []
    for step in range(30):
        found = feed(cached, given, step)
        torch.testing.assert_close(found, full(net, given, cached.first, step), rtol=1e-4, atol=1e-5)
        assert cached.first + cached.steps == step + 1 and 1 <= cached.steps <= context
        begins.append(cached.first)
    step = context - context // 2
    assert begins == [0] * context + [step * (1 + over // step) for over in range(30 - context)]


@torch.inference_mode()
def test_what_is_read_is_read_once(monkeypatch):
    net, counts = network(context=4), []
    given, plain = windows_of(net.sizes, steps=9), net.read

    def counted(tokens, *rest):
        counts.append(tokens.shape[1])
        return plain(tokens, *rest)

    monkeypatch.setattr(net, "read", counted)
    cached = CachedContext(net, 4)
    for step in range(9):
        feed(cached, given, step)
    assert counts == [2, 3, 3, 3, 8, 3, 8, 3, 8]


@torch.inference_mode()
def test_episodes_that_end_leave_the_others_as_they_are():
    net = network()
    given = windows_of(net.sizes, steps=14)
    cached, rows = CachedContext(net, 4), torch.arange(4)
    for step in range(14):
        for at, kept in ((3, [0, 2, 3]), (9, [2])):
            if step == at:
                cached.keep(torch.tensor(kept))
                rows = rows[kept]
        found = feed(cached, given, step, rows)
        torch.testing.assert_close(found, full(net, given, cached.first, step)[rows], rtol=1e-4, atol=1e-5)
    assert rows.tolist() == [3]
