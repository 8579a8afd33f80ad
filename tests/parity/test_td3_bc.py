"""TD3+BC and behaviour cloning against small slow versions."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import nn

from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.networks import Actor, ShiftedPictures, StandardisedLatents, TwinCritic
from repdib_lightning.rl.td3_bc import TD3BC, BehaviourCloning
from repdib_lightning.rl.transitions import TransitionBatch

WIDTH, ACTIONS, BATCH = 5, 2, 12
PICTURES = DataSpec({"pixels": ArraySpec((3, 8, 8))})


def agent(kind=TD3BC, features=None, hidden=7, **options) -> TD3BC:
    torch.manual_seed(1)
    features = features or StandardisedLatents(torch.randn(WIDTH), torch.rand(WIDTH) + 0.5)
    made = kind(features, WIDTH, ACTIONS, hidden=hidden, learning_rate=3e-3, **options)
    for parameter in made.parameters():  # biases begin at 0, and the target as the critic
        if parameter.is_floating_point():
            parameter.data += 0.2 * torch.randn_like(parameter)
    optimizers = made.configure_optimizers()
    made.optimizers = lambda **_: optimizers  # no trainer is attached
    return made


def end_to_end(kind=TD3BC, **options):
    torch.manual_seed(0)
    encoder = ConvolutionalEncoder(PICTURES, features=WIDTH, channels=3, strides=[2, 1])
    return agent(kind, ShiftedPictures(encoder, 1), **options)


def batch(seed=0, seen=lambda g: torch.randn(BATCH, WIDTH, generator=g)) -> TransitionBatch:
    g = torch.Generator().manual_seed(seed)
    return TransitionBatch(
        seen(g),
        seen(g),
        torch.rand(BATCH, ACTIONS, generator=g) * 2 - 1,
        torch.randn(BATCH, generator=g),
        torch.rand(BATCH, generator=g) * (torch.arange(BATCH) % 4 > 0),
    )


def pictures(g):
    return {"pixels": torch.randint(0, 256, (BATCH, 3, 8, 8), dtype=torch.uint8, generator=g)}


def noise_of(seed, options, draws):
    torch.manual_seed(seed)
    deviation, clip = options.get("noise", 0.2), options.get("noise_clip", 0.3)
    return [(torch.randn(BATCH, ACTIONS) * deviation).clamp(-clip, clip) for _ in range(draws)]


def slow_network(network, inputs: list[float]) -> list[float]:
    """Three layers, number by number."""
    values = inputs
    for place in (0, 2, 4):
        weight, bias = network[place].weight.tolist(), network[place].bias.tolist()
        values = [sum(w * v for w, v in zip(row, values, strict=True)) + b for row, b in zip(weight, bias, strict=True)]
        values = [max(v, 0.0) for v in values] if place < 4 else values
    return values


def slow_act(made, features, noise):
    means = [math.tanh(value) for value in slow_network(made.actor.network, features)]
    return [min(1.0, max(-1.0, mean + e)) for mean, e in zip(means, noise, strict=True)]


def slow_values(critic, features, action):
    return [slow_network(network, [*features, *action])[0] for network in (critic.first, critic.second)]


OPTIONS = [{}, {"noise": 0.0}, {"noise": 3.0, "noise_clip": 0.5}, {"alpha": 0.4}]


@pytest.mark.parametrize("options", OPTIONS)
def test_the_critic_s_loss_is_that_of_a_slow_loop(options):
    made, given = agent(**options), batch()
    (noise,) = noise_of(3, options, 1)
    seen, later = (made.features(part).tolist() for part in (given.seen, given.later))
    errors, values = 0.0, []
    for place in range(BATCH):
        action = slow_act(made, later[place], noise[place].tolist())
        target = float(given.returns[place])
        target += float(given.discounts[place]) * min(slow_values(made.target, later[place], action))
        both = slow_values(made.critic, seen[place], given.actions[place].tolist())
        errors += sum((value - target) ** 2 for value in both) / BATCH
        values += both
    torch.manual_seed(3)
    loss, mean = made.critic_loss(made.features(given.seen), given)
    assert float(loss.detach()) == pytest.approx(errors, rel=1e-4)
    assert float(mean) == pytest.approx(sum(values) / len(values), rel=1e-4, abs=1e-5) and not mean.requires_grad


@pytest.mark.parametrize("options", OPTIONS)
def test_the_actor_s_losses_are_those_of_a_slow_loop(options):
    made, given = agent(**options), batch()
    (noise,) = noise_of(3, options, 1)
    seen = made.features(given.seen).tolist()
    least, cloning = [], 0.0
    for place in range(BATCH):
        action = slow_act(made, seen[place], noise[place].tolist())
        least.append(min(slow_values(made.critic, seen[place], action)))
        data = given.actions[place].tolist()
        cloning += sum((one - other) ** 2 for one, other in zip(action, data, strict=True)) / (BATCH * ACTIONS)
    weight = options.get("alpha", 2.5) / (sum(map(abs, least)) / BATCH)
    torch.manual_seed(3)
    of_values, of_data = made.actor_losses(made.features(given.seen), given.actions)
    assert float(of_values.detach()) == pytest.approx(-weight * sum(least) / BATCH, rel=1e-4, abs=1e-5)
    assert float(of_data.detach()) == pytest.approx(cloning, rel=1e-4)


class SlowTD3BC:
    """The same agent of torch's own layers, spelled out, with the noise given."""

    def __init__(self, made: TD3BC):
        def plain(network):
            layers = copy.deepcopy(network)
            for place in (0, 2, 4):
                linear = nn.Linear(layers[place].in_features, layers[place].out_features)
                linear.load_state_dict(layers[place].state_dict())
                layers[place] = linear
            layers[1], layers[3] = nn.ReLU(), nn.ReLU()
            return layers.requires_grad_(True)

        self.features, self.actor = copy.deepcopy(made.features), plain(made.actor.network)
        self.critics = [plain(made.critic.first), plain(made.critic.second)]
        self.targets = [plain(made.target.first), plain(made.target.second)]
        self.made = made
        of_critic = [p for module in (self.features, *self.critics) for p in module.parameters()]
        self.of_critic = torch.optim.Adam(of_critic, lr=made.learning_rate)
        self.of_actor = torch.optim.Adam(self.actor.parameters(), lr=made.learning_rate)

    def update(self, given, later_noise, noise):
        made = self.made
        with torch.no_grad():
            later = self.features(given.later)
            action = (torch.tanh(self.actor(later)) + later_noise).clamp(-1, 1)
            values = [target(torch.cat([later, action], 1))[:, 0] for target in self.targets]
            wanted = given.returns + given.discounts * torch.minimum(*values)
        seen = self.features(given.seen)
        joined = torch.cat([seen, given.actions], 1)
        loss = sum(((critic(joined)[:, 0] - wanted) ** 2).mean() for critic in self.critics)
        self.of_critic.zero_grad()
        loss.backward()
        self.of_critic.step()

        seen = seen.detach()
        mean = torch.tanh(self.actor(seen))
        clipped = (mean + noise).clamp(-1, 1).detach()
        action = clipped + mean - mean.detach()
        values = torch.minimum(*[critic(torch.cat([seen, action], 1))[:, 0] for critic in self.critics])
        weight = made.alpha / values.abs().mean().item()
        loss = -weight * values.mean() + ((action - given.actions) ** 2).mean()
        self.of_actor.zero_grad()
        loss.backward()
        self.of_actor.step()
        with torch.no_grad():
            for critic, target in zip(self.critics, self.targets, strict=True):
                for new, old in zip(critic.parameters(), target.parameters(), strict=True):
                    old.copy_((1 - made.tau) * old + made.tau * new)


@pytest.mark.parametrize("options", [{}, {"tau": 0.5, "noise": 1.0, "alpha": 1.0}])
@pytest.mark.parametrize("kind", ["latents", "end to end", "wide"])
def test_updates_are_those_of_a_slow_agent(options, kind):
    options = options | ({"hidden": 256} if kind == "wide" else {})  # there the fast layer is taken
    made = end_to_end(**options) if kind == "end to end" else agent(**options)
    made.eval()  # pictures that are not shifted: their noise would be another
    slow = SlowTD3BC(made)
    for number in range(4):
        given = batch(number, pictures) if kind == "end to end" else batch(number)
        slow.update(given, *noise_of(number, options, 2))
        torch.manual_seed(number)
        made.training_step(given, number)
    ours = [
        made.features,
        made.actor.network,
        made.critic.first,
        made.critic.second,
        made.target.first,
        made.target.second,
    ]
    theirs = [slow.features, slow.actor, *slow.critics, *slow.targets]
    for one, other in zip(ours, theirs, strict=True):
        for (name, value), wanted in zip(one.state_dict().items(), other.state_dict().values(), strict=True):
            torch.testing.assert_close(value, wanted, rtol=1e-3, atol=2e-5, msg=name)


def gradients(module):
    return [p.grad for p in module.parameters()]


def test_the_critic_s_loss_trains_critic_and_encoder_and_nothing_else():
    made = end_to_end()
    given = batch(0, pictures)
    made.critic_loss(made.features(given.seen), given)[0].backward()
    for trained in (made.features, made.critic):
        assert all(grad is not None and grad.any() for grad in gradients(trained))
    assert gradients(made.actor) == [None] * 6 and gradients(made.target) == [None] * 12
    optimizer, of_actor = made.configure_optimizers()
    held = {id(p) for group in optimizer.param_groups for p in group["params"]}
    assert held == {id(p) for p in [*made.features.parameters(), *made.critic.parameters()]}
    assert {id(p) for g in of_actor.param_groups for p in g["params"]} == set(map(id, made.actor.parameters()))


@pytest.mark.parametrize("part", [0, 1])
def test_the_actor_s_losses_train_the_actor_and_nothing_else(part):
    made = end_to_end()
    given = batch(0, pictures)
    before = [torch.randn_like(p) for p in made.critic.parameters()]
    for parameter, kept in zip(made.critic.parameters(), before, strict=True):
        parameter.grad = kept.clone()
    made.actor_losses(made.features(given.seen).detach(), given.actions)[part].backward()
    assert all(grad is not None and grad.any() for grad in gradients(made.actor))
    assert gradients(made.features) == [None] * len(list(made.features.parameters()))
    assert gradients(made.target) == [None] * 12
    assert all(torch.equal(one, other) for one, other in zip(gradients(made.critic), before, strict=True))
    assert all(p.requires_grad for p in made.critic.parameters())


def test_a_step_moves_the_target_by_tau_and_never_trains_it():
    made = agent(tau=0.25)
    before = copy.deepcopy(made.target.state_dict())
    made.training_step(batch(), 0)
    for name, old in before.items():
        torch.testing.assert_close(made.target.state_dict()[name], 0.75 * old + 0.25 * made.critic.state_dict()[name])
    assert not any(p.requires_grad for p in made.target.parameters())


def test_the_target_begins_as_the_critic():
    torch.manual_seed(0)
    made = TD3BC(nn.Identity(), WIDTH, ACTIONS, hidden=4, learning_rate=1e-3)
    for one, other in zip(made.target.parameters(), made.critic.parameters(), strict=True):
        assert torch.equal(one, other) and one.data_ptr() != other.data_ptr()
    assert not torch.equal(made.critic.first[0].weight, made.critic.second[0].weight)


def test_noise_is_clipped_and_actions_stay_in_bounds():
    made = agent(noise=5.0, noise_clip=0.3)
    actions = (torch.rand(400, ACTIONS) * 2 - 1).requires_grad_()
    noisy = made.noisy(actions)
    assert noisy.min() >= -1.0 and noisy.max() <= 1.0 and (noisy == 1.0).any()
    moved = (noisy - actions).abs()
    assert moved.max() <= 0.3 + 1e-6 and (moved > 0.29).float().mean() > 0.5
    noisy.sum().backward()
    assert torch.equal(actions.grad, torch.ones_like(actions))  # also where it is clipped
    small = agent(noise=0.1, noise_clip=10.0).noisy(torch.zeros(20000, 1))
    assert small.std() == pytest.approx(0.1, rel=0.05) and small.mean().abs() < 0.005


def test_the_scale_of_rewards_does_not_change_what_the_actor_learns():
    made, given = agent(noise=0.0), batch()
    found = []
    for scale in (1.0, 1000.0):
        made.zero_grad()
        for network in (made.critic.first, made.critic.second):
            network[4].weight.data *= scale
            network[4].bias.data *= scale
        made.actor_losses(made.features(given.seen), given.actions)[0].backward()
        found.append([grad.clone() for grad in gradients(made.actor)])
    torch.testing.assert_close(*found, rtol=1e-4, atol=1e-6)


def test_a_critic_that_knows_nothing_yet_breaks_nothing():
    made, given = agent(), batch()
    for network in (made.critic.first, made.critic.second):
        nn.init.zeros_(network[4].weight)
        nn.init.zeros_(network[4].bias)
    assert made.actor_losses(made.features(given.seen), given.actions)[0] == 0.0


def test_cloning_is_the_mean_squared_error_and_trains_the_encoder():
    made = end_to_end(BehaviourCloning)
    made.eval()
    given = batch(0, pictures)
    acted = torch.tanh(made.actor.network(made.features.encoder(given.seen)))
    wanted = sum((acted[i, j].item() - given.actions[i, j].item()) ** 2 for i in range(BATCH) for j in range(ACTIONS))
    before = copy.deepcopy(made.state_dict())
    made.training_step(given, 0)
    assert float(made.latest["clone"]) == pytest.approx(wanted / (BATCH * ACTIONS), rel=1e-5)
    assert all(not torch.equal(value, before[name]) for name, value in made.state_dict().items())
    wanted = torch.optim.Adam([p := nn.Parameter(before["actor.network.4.weight"].clone())], lr=made.learning_rate)
    p.grad = made.actor.network[4].weight.grad
    wanted.step()
    torch.testing.assert_close(made.actor.network[4].weight, p, rtol=1e-5, atol=1e-7)


def test_networks_have_the_shapes_they_say():
    actor, critic = Actor(WIDTH, ACTIONS, 9), TwinCritic(WIDTH, ACTIONS, 9)
    seen = 100 * torch.randn(30, WIDTH)
    acted = actor(seen)
    assert acted.shape == (30, ACTIONS) and acted.abs().max() <= 1.0
    values = critic(seen, acted)
    assert values.shape == (2, 30)
    joined = torch.cat([seen, acted], 1)
    torch.testing.assert_close(values[1], critic.second(joined)[:, 0])
    for layer in (actor.network[0], actor.network[2], critic.second[2]):
        product = layer.weight @ layer.weight.T if layer.weight.shape[0] <= layer.weight.shape[1] else None
        product = layer.weight.T @ layer.weight if product is None else product
        torch.testing.assert_close(product, torch.eye(len(product)), rtol=0, atol=1e-5)
        assert not layer.bias.any()
