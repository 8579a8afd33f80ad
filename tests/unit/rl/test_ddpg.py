"""The exploring agent against one written out number by number, and what each of its steps moves."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from repdib_lightning.rl.actor_critic import descend, noisy
from repdib_lightning.rl.exploration.ddpg import DDPG

BATCH, WIDTH, ACTIONS = 6, 4, 2


def agent(**options):
    """Biases and the target differ from how they start."""
    torch.manual_seed(0)
    made = DDPG(WIDTH, ACTIONS, **{"hidden": 5, "tau": 0.1, **options})
    for parameter in made.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    return made


def batch(seed=0):
    """Features of t and of t + m, actions, returns, discounts."""
    g = torch.Generator().manual_seed(seed)
    actions = torch.rand(BATCH, ACTIONS, generator=g) * 2 - 1
    pair = torch.randn(BATCH, WIDTH, generator=g), torch.randn(BATCH, WIDTH, generator=g)
    return *pair, actions, torch.randn(BATCH, generator=g), 0.99 ** torch.arange(BATCH)


def drawn(seed, deviation, clip):
    torch.manual_seed(seed)
    return (torch.randn(BATCH, ACTIONS) * deviation).clamp(-clip, clip).tolist()


def slow_network(network, values):
    for place in (0, 2, 4):
        weight, bias = network[place].weight.tolist(), network[place].bias.tolist()
        values = [sum(w * v for w, v in zip(row, values, strict=True)) + b for row, b in zip(weight, bias, strict=True)]
        values = [max(v, 0.0) for v in values] if place < 4 else values
    return values


def slow_act(made, features, noise=(0.0, 0.0)):
    means = [math.tanh(value) for value in slow_network(made.actor.network, features)]
    return [min(1.0, max(-1.0, mean + e)) for mean, e in zip(means, noise, strict=True)]


def slow_values(critic, features, action):
    return [slow_network(network, [*features, *action])[0] for network in (critic.first, critic.second)]


OPTIONS = [{}, {"noise": 0.0}, {"noise": 3.0, "noise_clip": 0.5}, {"penalty": 0.7}]


@pytest.mark.parametrize("options", OPTIONS)
def test_the_critic_s_loss_is_that_of_a_slow_loop(options):
    made, (seen, later, actions, returns, discounts) = agent(**options), batch()
    noise = drawn(3, options.get("noise", 0.2), options.get("noise_clip", 0.3))
    loss, values = 0.0, []
    for i in range(BATCH):
        action = slow_act(made, later[i].tolist(), noise[i])
        least = min(slow_values(made.target, later[i].tolist(), action))
        wanted = float(returns[i]) + float(discounts[i]) * least
        both = slow_values(made.critic, seen[i].tolist(), actions[i].tolist())
        loss += sum((value - wanted) ** 2 for value in both) / BATCH
        values += both
    torch.manual_seed(3)
    found, mean = made.critic_loss(seen, later, actions, returns, discounts)
    assert float(found.detach()) == pytest.approx(loss, rel=1e-4)
    assert float(mean) == pytest.approx(sum(values) / len(values), rel=1e-4, abs=1e-5) and not mean.requires_grad


@pytest.mark.parametrize("options", OPTIONS)
def test_the_actor_s_loss_is_that_of_a_slow_loop(options):
    made, seen = agent(**options), batch()[0]
    noise = drawn(5, options.get("noise", 0.2), options.get("noise_clip", 0.3))
    least = [
        min(slow_values(made.critic, row, slow_act(made, row, e))) for row, e in zip(seen.tolist(), noise, strict=True)
    ]
    squares = [value**2 for row in seen.tolist() for value in slow_act(made, row)]
    wanted = options.get("penalty", 0.0) * sum(squares) / len(squares) - sum(least) / BATCH
    torch.manual_seed(5)
    assert float(made.actor_loss(seen).detach()) == pytest.approx(wanted, rel=1e-4)


def test_a_penalty_brings_an_actor_back_from_its_bounds():
    """Where no action is better than another one, it goes to 0; without the penalty it stays where it is."""
    seen, ends = batch()[0], []
    for penalty in (0.0, 1.0):
        made = agent(penalty=penalty, noise=0.0)
        for parameter in made.critic.parameters():
            parameter.data.zero_()
        made.actor.network[4].bias.data.fill_(2.0)
        _, optimizer = made.build_optimizers(1e-2)
        for _ in range(300):
            made.update_actor(seen, optimizer)
        ends.append(float(made.act(seen).abs().mean()))
    assert ends[0] > 0.5 and ends[1] < 0.05


def gradients(module):
    return [parameter.grad for parameter in module.parameters()]


def test_the_critic_s_loss_trains_critic_and_features_and_nothing_else():
    made, (seen, later, *rest) = agent(), batch()
    seen, later = seen.requires_grad_(), later.requires_grad_()
    made.critic_loss(seen, later, *rest)[0].backward()
    assert all(grad is not None and grad.any() for grad in gradients(made.critic))
    assert gradients(made.actor) == [None] * 6 and gradients(made.target) == [None] * 12
    assert seen.grad.any() and later.grad is None


def test_the_actor_s_loss_trains_the_actor_and_nothing_else():
    made, seen = agent(), batch()[0].requires_grad_()
    before = [torch.randn_like(p) for p in made.critic.parameters()]
    for parameter, kept in zip(made.critic.parameters(), before, strict=True):
        parameter.grad = kept.clone()
    made.actor_loss(seen).backward()
    assert all(grad is not None and grad.any() for grad in gradients(made.actor))
    assert gradients(made.target) == [None] * 12 and seen.grad is None
    assert all(torch.equal(one, other) for one, other in zip(gradients(made.critic), before, strict=True))
    assert all(p.requires_grad for p in made.critic.parameters())


def copied(module):
    return copy.deepcopy(module.state_dict())


def moved(module, before):
    return [not torch.equal(value, before[name]) for name, value in module.state_dict().items()]


def test_steps_move_what_they_should_and_the_target_by_tau():
    made, given = agent(tau=0.25), batch()
    of_critic, of_actor = made.build_optimizers(1e-2)
    before = {name: copied(part) for name, part in made.named_children()}
    descend(made.critic_loss(*given)[0], of_critic)
    assert all(moved(made.critic, before["critic"]))
    assert not any(moved(made.actor, before["actor"])) and not any(moved(made.target, before["target"]))
    critic = copied(made.critic)
    made.update_actor(given[0], of_actor)
    assert all(moved(made.actor, before["actor"])) and not any(moved(made.critic, critic))
    for name, value in made.target.state_dict().items():
        torch.testing.assert_close(value, 0.75 * before["target"][name] + 0.25 * critic[name])
    assert not any(p.requires_grad for p in made.target.parameters())


def test_the_target_begins_as_the_critic_and_is_another():
    torch.manual_seed(0)
    made = DDPG(WIDTH, ACTIONS)
    for one, other in zip(made.target.parameters(), made.critic.parameters(), strict=True):
        assert torch.equal(one, other) and one.data_ptr() != other.data_ptr()
    assert not torch.equal(made.critic.first[0].weight, made.critic.second[0].weight)


def test_every_trained_weight_has_one_optimizer_and_features_go_with_the_critic():
    made, extra = agent(), torch.nn.Linear(2, 2)
    held = [{id(p) for group in o.param_groups for p in group["params"]} for o in made.build_optimizers(0.1)]
    assert held == [set(map(id, part.parameters())) for part in (made.critic, made.actor)]
    assert sum(map(len, held)) == sum(p.requires_grad for p in made.parameters())
    of_critic, _ = made.build_optimizers(0.1, extra.parameters())
    together = {id(p) for group in of_critic.param_groups for p in group["params"]}
    assert together == held[0] | set(map(id, extra.parameters()))


def test_acting_is_the_mean_and_noise_is_scaled_added_and_clamped():
    made, seen = agent(noise=0.7, noise_clip=0.01), batch()[0]
    acted = made.act(seen)
    torch.testing.assert_close(acted, torch.tensor([slow_act(made, row) for row in seen.tolist()]))
    assert torch.equal(acted, made.act(seen)) and acted.abs().max() <= 1 and not acted.requires_grad
    noise = 3 * torch.randn(BATCH, ACTIONS, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(made.act(seen, noise), (acted + 0.7 * noise).clamp(-1, 1))  # noise_clip is the losses'
    assert torch.equal(made.act(seen, torch.zeros_like(noise)), acted)
    assert (made.act(seen, 1e6 * noise).abs() == 1).all()
    state = torch.get_rng_state()
    made.act(seen, noise)
    assert torch.equal(torch.get_rng_state(), state)


def test_values_are_the_smaller_ones_of_the_actor_s_own_actions():
    made, seen = agent(), batch()[0]
    wanted = [min(slow_values(made.critic, row, slow_act(made, row))) for row in seen.tolist()]
    found = made.values(seen)
    torch.testing.assert_close(found, torch.tensor(wanted))
    assert found.shape == (BATCH,) and not found.requires_grad


def test_noise_in_the_losses_is_clipped_and_gives_the_actions_their_gradient():
    actions = (torch.rand(400, ACTIONS) * 2 - 1).requires_grad_()
    found = noisy(actions, 5.0, 0.3)
    assert found.abs().max() <= 1.0 and (found == 1.0).any() and (found - actions).abs().max() <= 0.3 + 1e-6
    found.sum().backward()
    assert torch.equal(actions.grad, torch.ones_like(actions))  # also where it is clipped


def test_it_learns_to_do_what_is_paid_for():
    """The reward is how near the action is to a linear function of what is seen."""
    torch.manual_seed(0)
    made = DDPG(2, 1, hidden=32, tau=0.1)
    of_critic, of_actor = made.build_optimizers(3e-3)
    best = torch.tensor([[0.6], [-0.3]])
    for _ in range(400):
        seen, actions = torch.rand(64, 2) * 2 - 1, torch.rand(64, 1) * 2 - 1
        returns = 1 - (actions - seen @ best).square().sum(1)
        descend(made.critic_loss(seen, seen, actions, returns, torch.zeros(64))[0], of_critic)
        made.update_actor(seen, of_actor)
    seen = torch.rand(500, 2) * 2 - 1
    assert (made.act(seen) - seen @ best).square().mean() < 0.02 < (seen @ best).square().mean() / 5
    assert made.values(seen).mean() == pytest.approx(1.0, abs=0.1)


def test_standardised_features_are_those_of_a_slow_running_mean_and_deviation():
    made, plain = agent(standardise=True), agent()
    plain.load_state_dict({name: value for name, value in made.state_dict().items() if "statistics" not in name})
    seen, later, *rest = batch()
    torch.testing.assert_close(made.seen(seen), seen, rtol=1e-3, atol=1e-3)  # until anything is taken in
    mean, variance = torch.zeros(WIDTH), torch.ones(WIDTH)
    for seed in range(5):
        drawn = 3 + 0.1 * torch.randn(BATCH, WIDTH, generator=torch.Generator().manual_seed(seed))
        rate = 0.01 if seed else 1.0
        mean = (1 - rate) * mean + rate * drawn.mean(0)
        variance = (1 - rate) * variance + rate * drawn.var(0, correction=0)
        torch.manual_seed(seed)
        loss, value = made.critic_loss(drawn, later, *rest)
        torch.manual_seed(seed)
        pair = ((part - mean) / (variance + 1e-4).sqrt() for part in (drawn, later))
        wanted = plain.critic_loss(*pair, *rest)
        torch.testing.assert_close((loss, value), wanted, rtol=1e-4, atol=1e-5)
    at = (seen - mean) / (variance + 1e-4).sqrt()
    torch.testing.assert_close(made.seen(seen), at, rtol=1e-4, atol=1e-4)
    for own, other in ((made.act(seen), plain.act(at)), (made.values(seen), plain.values(at))):
        torch.testing.assert_close(own, other, rtol=1e-3, atol=1e-4)


def test_only_what_the_critic_learns_from_moves_the_statistics():
    made, (seen, later, *rest) = agent(standardise=True), batch()
    made.critic_loss(seen, later, *rest)
    before = copied(made.statistics)
    made.act(later), made.values(later), made.actor_loss(later)
    assert not any(moved(made.statistics, before))
    made.critic_loss(later.requires_grad_(), seen, *rest)[0].backward()
    assert later.grad.any() and all(moved(made.statistics, before)[:2])
    assert not list(made.statistics.parameters()) and "statistics.mean" in made.state_dict()
