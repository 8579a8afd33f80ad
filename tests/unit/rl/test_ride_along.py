"""A loss that rides along gives the gradient of the explicit sum, once, and nothing where nothing is learnt."""

from __future__ import annotations

import torch
from torch import nn

from repdib_lightning.rl.ride_along import ride_along


def parts() -> tuple[nn.Linear, nn.Linear, torch.Tensor]:
    torch.manual_seed(0)
    return nn.Linear(5, 3).double(), nn.Linear(3, 2).double(), torch.randn(4, 5, dtype=torch.float64)


def gradients(*modules: nn.Module) -> list[torch.Tensor]:
    return [parameter.grad.clone() for module in modules for parameter in module.parameters()]


def test_the_gradient_is_that_of_the_sum_of_both_losses():
    lower, upper, x = parts()
    hidden = lower(x)
    joined = ride_along(hidden, 0.7 * hidden.square().mean())
    torch.testing.assert_close(joined, hidden, rtol=0, atol=0)
    upper(joined).exp().mean().backward()
    found = gradients(lower, upper)

    lower.zero_grad()
    upper.zero_grad()
    hidden = lower(x)
    (upper(hidden).exp().mean() + 0.7 * hidden.square().mean()).backward()
    for ours, wanted in zip(found, gradients(lower, upper), strict=True):
        torch.testing.assert_close(ours, wanted)


def test_the_loss_counts_once_however_the_tensor_is_used_and_scaled():
    lower, upper, x = parts()
    hidden = lower(x)
    joined = ride_along(hidden, hidden.sum())
    (1e-9 * (upper(joined).mean() + upper(joined).square().mean() + joined.sum())).backward()
    torch.testing.assert_close(lower.bias.grad, torch.full((3,), 4.0, dtype=torch.float64))


def test_it_reaches_what_only_the_loss_depends_on():
    lower, _, x = parts()
    steering = nn.Parameter(torch.tensor(2.0, dtype=torch.float64))
    ride_along(lower(x), steering.square()).sum().backward()
    torch.testing.assert_close(steering.grad, torch.tensor(4.0, dtype=torch.float64))


def test_nothing_is_recorded_where_nothing_is_learnt():
    lower, _, x = parts()
    hidden = lower(x)
    with torch.no_grad():
        assert ride_along(hidden, hidden.sum()) is hidden
    detached = hidden.detach()
    assert ride_along(detached, torch.tensor(1.0)) is detached


def test_a_loss_that_is_cut_off_from_the_agent_is_not_trained():
    lower, upper, x = parts()
    hidden = lower(x)
    upper(ride_along(hidden, hidden.sum()).detach()).sum().backward()
    assert lower.weight.grad is None


def test_gradients_of_several_batches_add_up():
    lower, upper, x = parts()
    for _ in range(2):
        hidden = lower(x)
        upper(ride_along(hidden, hidden.mean())).sum().backward()
    found = gradients(lower)
    lower.zero_grad()
    hidden = lower(x)
    (2 * (upper(hidden).sum() + hidden.mean())).backward()
    for ours, wanted in zip(found, gradients(lower), strict=True):
        torch.testing.assert_close(ours, wanted)
