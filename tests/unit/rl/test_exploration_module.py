"""One update of representation, critics and actor: who is moved by what, what is paid for, and what breaks nothing."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from repdib_lightning.bottlenecks import Identity, RepDIB, Variational
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.objectives import InverseDynamics, Prototypes
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec
from repdib_lightning.representation import RepresentationModule
from repdib_lightning.rl.exploration.intrinsic_reward import NearestNeighbourReward
from repdib_lightning.rl.exploration.module import BrokenExploration, ExplorationModule
from repdib_lightning.rl.exploration.replay import ReplayBatch

BATCH, WIDTH, ACTIONS, SIDE = 12, 8, 2, 20
SPEC = DataSpec({"pixels": ArraySpec((3, SIDE, SIDE))}, ActionSpec("continuous", ACTIONS), 1, 3)


def encoder(spec):
    return ConvolutionalEncoder(spec, features=WIDTH, channels=4, strides=[3, 2])


def repdib(width):
    return RepDIB(width, groups=2, codes=5, start="random", start_step=0)


def late(width):
    return RepDIB(width, groups=2, codes=5, start_step=1000)


def spread(width):
    return RepDIB(width, groups=2, codes=5, start_step=2)


def prototypes(width, spec, **options):
    return Prototypes(width, spec, prototypes=6, projected=5, hidden=7, **options)


def standardised(width, spec):
    return prototypes(width, spec, standardise=True)


def module(bottleneck=repdib, objective=prototypes, **options):
    torch.manual_seed(0)
    options = {"hidden": 9, "queue": 40, "shift": 2, "agent_learning_rate": 1e-2, **options}
    made = ExplorationModule(encoder, bottleneck, objective, **options).build(SPEC)
    made.log = lambda *_, **__: None  # no trainer is attached
    optimizers = made.configure_optimizers()
    given = [optimizers[0], *(SimpleNamespace(optimizer=optimizer) for optimizer in optimizers[1:])]
    made.optimizers = lambda: given
    return made.train()


def batch(seed=0):
    g = torch.Generator().manual_seed(seed)
    coarse = torch.randint(0, 256, (BATCH, 2, 3, 4, 4), generator=g, dtype=torch.uint8)
    return ReplayBatch(
        observations={"pixels": coarse.repeat_interleave(5, -1).repeat_interleave(5, -2)},
        actions=torch.rand(BATCH, ACTIONS, generator=g) * 2 - 1,
        offsets=torch.tensor([[0, 3]] * BATCH),
        rows=torch.arange(BATCH),
        returns=torch.randn(BATCH, generator=g),
        discounts=torch.rand(BATCH, generator=g),
    )


def copied(*modules):
    return [copy.deepcopy(module.state_dict()) for module in modules]


def moved(part, before):
    return {name for name, value in part.state_dict().items() if not torch.equal(value, before[name])}


BOTTLENECKS = [repdib, Identity, Variational, late]
OBJECTIVES = [prototypes, standardised, InverseDynamics]


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("bottleneck", BOTTLENECKS)
def test_every_trained_weight_has_one_optimizer_and_moves(bottleneck, objective):
    made = module(bottleneck, objective)
    held = [id(p) for o in made.configure_optimizers() for group in o.param_groups for p in group["params"]]
    trained = {id(p) for p in made.parameters() if p.requires_grad}
    assert len(held) == len(set(held)) and set(held) == trained
    before = copy.deepcopy(dict(made.named_parameters()))
    for seed in range(4):
        made.training_step(batch(seed), seed)
    still = {name for name, p in made.named_parameters() if torch.equal(p, before[name])}
    waits = {name for name in still if "codebook" in name or "codes" in name}  # of a quantiser that has not started
    assert still == waits and (not waits or bottleneck is late)
    followers = {name for name, p in made.named_parameters() if not p.requires_grad}
    assert {name.split(".")[0] for name in followers} - {"objective"} <= {"target", "agent"}
    assert any(name.startswith("agent.target.") for name in followers)


@pytest.mark.parametrize("bottleneck", BOTTLENECKS)
def test_the_agent_has_no_say_in_the_representation(bottleneck):
    """With another agent, encoder, bottleneck and objective take the same step."""
    one, other = module(bottleneck), module(bottleneck)
    for parameter in other.agent.parameters():
        parameter.data += torch.randn_like(parameter)
    for made in (one, other):
        torch.manual_seed(4)
        made.training_step(batch(), 0)
    for name in ("encoder", "bottleneck", "objective", "target", "reward"):
        assert not moved(getattr(one, name), copied(getattr(other, name))[0]), name
    grads = [[p.grad for p in made.encoder.parameters()] for made in (one, other)]
    assert all(a.any() and torch.equal(a, b) for a, b in zip(*grads, strict=True))
    seen, later, rewards, _ = one._rewarded(batch())
    assert not any(part.requires_grad for part in (seen, later, rewards))


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("bottleneck", BOTTLENECKS)
def test_acting_and_paying_leave_no_trace_in_the_representation(bottleneck, objective):
    made = module(bottleneck, objective)
    made.training_step(batch(1), 0)
    parts = made.encoder, made.bottleneck, made.objective, made.agent
    before, modes = copied(*parts), [part.training for part in made.modules()]
    generator = torch.get_rng_state()
    shown = {"pixels": batch(2).observations["pixels"][:, 0].numpy()}
    acted = made.act(shown, np.ones((BATCH, ACTIONS), np.float32))
    assert torch.equal(torch.get_rng_state(), generator)
    made._rewarded(batch(3))
    assert not any(moved(part, kept) for part, kept in zip(parts, before, strict=True))
    assert [part.training for part in made.modules()] == modes and made.encoder.training
    again = made.act(shown, np.ones((BATCH, ACTIONS), np.float32))
    np.testing.assert_array_equal(acted, again)


def still(made, pictures):
    """Encoder and bottleneck in evaluation mode."""
    frozen = [copy.deepcopy(part).eval() for part in (made.encoder, made.bottleneck)]
    with torch.no_grad():
        features = frozen[0]({"pixels": pictures})
        return features, frozen[1](features)


def test_acting_is_the_policy_on_what_a_frozen_encoder_sees():
    made = module()
    pictures = batch().observations["pixels"][:, 0]
    _, output = still(made, pictures)
    noise = np.random.default_rng(0).normal(size=(BATCH, ACTIONS)).astype(np.float32)
    for given in (None, noise):
        found = made.act({"pixels": pictures.numpy()}, given)
        wanted = made.agent.act(output.latent, None if given is None else torch.from_numpy(given))
        np.testing.assert_array_equal(found, wanted.numpy())
        assert found.dtype == np.float32 and found.shape == (BATCH, ACTIONS) and np.abs(found).max() <= 1


def slow_rewards(made, batch, on, objective, queue):
    """What is paid for the later observations, by parts of their own."""
    features, output = still(made, batch.observations["pixels"][:, 1])
    codes = output.codes
    if on == "codes":
        compared = torch.zeros(BATCH, queue.width) if codes is None else codes.float()
    else:
        latents = output.latent if on == "latent" else features
        compared = torch.nn.functional.normalize(latents, dim=1)
        if objective is not InverseDynamics:
            with torch.no_grad():
                compared = made.objective.embed(latents)
    entering = torch.arange(BATCH)
    if objective is not InverseDynamics:
        with torch.no_grad():
            entering = made.objective.candidates(made.objective.embed(output.latent) if on == "codes" else compared)
    return queue(compared, entering, codes if on == "latent" else None)


@pytest.mark.parametrize("objective", OBJECTIVES)
@pytest.mark.parametrize("bottleneck", [spread, late])
@pytest.mark.parametrize("on", ["latent", "features", "codes"])
@pytest.mark.parametrize("duplicates", ["keep", "distinct", "count"])
def test_what_is_paid_is_that_of_parts_put_together_by_hand(on, bottleneck, objective, duplicates):
    made = module(bottleneck, objective, reward_on=on, neighbours=2, duplicates=duplicates)
    width = 2 if on == "codes" else (WIDTH if objective is InverseDynamics else 5)
    queue = NearestNeighbourReward(
        width,
        queue=40,
        neighbours=2,
        duplicates=duplicates,
        distance="hamming" if on == "codes" else "euclidean",
        groups=2 if on == "latent" else 0,
    )
    for seed in range(4):
        made.training_step(batch(seed), seed)
    queue.load_state_dict(made.reward.state_dict())
    paid = False
    for seed in range(5):
        given = batch(10 + seed % 3)  # some come again
        torch.manual_seed(seed)
        wanted = slow_rewards(made, given, on, objective, queue)
        torch.manual_seed(seed)
        seen, later, found, told = made._rewarded(given)
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
        for place, latents in enumerate((seen, later)):
            torch.testing.assert_close(latents, still(made, given.observations["pixels"][:, place])[1].latent)
        assert told["intrinsic_reward"] == found.mean() and 0 <= told["duplicates"] <= 1
        paid |= bool(found.any())
    assert paid == (on != "codes" or bottleneck is spread)


def test_what_comes_again_is_worth_less_and_told():
    found = {}
    for duplicates in ("keep", "distinct", "count"):
        made = module(Identity, neighbours=1, duplicates=duplicates, objective=InverseDynamics)
        paid = [made._rewarded(batch())[2:] for _ in range(2)]
        found[duplicates] = [float(rewards.mean()) for rewards, _ in paid]
        assert [float(told["duplicates"]) for _, told in paid] == [0.0, 1.0]
    assert found == {name: [0.0, 0.0] for name in found}  # each is nearest to itself
    made = module(Identity, neighbours=2, objective=InverseDynamics)
    first, second = (made._rewarded(batch())[2] for _ in range(2))
    torch.testing.assert_close(second, first / 2**0.5)


def test_the_task_s_rewards_are_not_used_and_the_discounts_are():
    found = []
    for change in ({}, {"returns": 100 * torch.ones(BATCH)}, {"discounts": torch.zeros(BATCH)}):
        made = module()
        torch.manual_seed(1)
        for number in range(3):  # Adam's first step of the actor does not know how steep its loss is
            made.training_step(replace(batch(number), **change), number)
        found.append(copied(made)[0])
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])
    differs = {name.split(".")[1] for name in found[0] if not torch.equal(found[0][name], found[2][name])}
    assert differs == {"critic", "target", "actor"}


def test_all_parts_of_a_step_see_the_same_shifted_pictures():
    made, seen = module(shift=4), {"online": [], "target": []}
    made.encoder.register_forward_pre_hook(lambda _, inputs: seen["online"].append(inputs[0]["pixels"].clone()))
    made.target.encoder.register_forward_pre_hook(lambda _, inputs: seen["target"].append(inputs[0]["pixels"].clone()))
    given = batch()
    made.training_step(given, 0)
    (of_objective, of_agent), (of_target,) = seen["online"], seen["target"]
    assert torch.equal(of_agent[::2], of_objective) and torch.equal(of_agent[1::2], of_target)
    assert not torch.equal(of_objective, given.observations["pixels"][:, 0])
    alone = module(shift=0)
    alone.encoder.register_forward_pre_hook(lambda _, inputs: seen["online"].append(inputs[0]["pixels"].clone()))
    alone.training_step(given, 0)
    assert torch.equal(seen["online"][-1], given.observations["pixels"].flatten(0, 1))


@pytest.mark.parametrize("bottleneck", [repdib, Identity])
def test_the_representation_learns_as_it_does_without_an_agent(bottleneck):
    made = module(bottleneck, shift=0, loss_weights={"prototypes": 0.5})
    torch.manual_seed(0)
    plain = RepresentationModule(encoder, bottleneck, prototypes, shift=0, loss_weights={"prototypes": 0.5})
    plain.build(SPEC)
    plain.log = lambda *_, **__: None
    plain.train()
    optimizer = plain.configure_optimizers()
    for seed in range(3):
        torch.manual_seed(seed)
        wanted = plain.training_step(batch(seed), seed)
        optimizer.zero_grad()
        wanted["loss"].backward()
        optimizer.step()
        plain.follow_target()
        torch.manual_seed(seed)
        found = made.training_step(batch(seed), seed)
        assert torch.equal(found["loss"], wanted["loss"]) and found["terms"] == wanted["terms"]
        assert not found["loss"].requires_grad
    for name in ("encoder", "bottleneck", "objective", "target"):
        assert not moved(getattr(made, name), copied(getattr(plain, name))[0]), name


def spoil(made, how):
    parameter = made.agent.critic.first[4].bias
    parameter.data.fill_({"nan": np.nan, "infinite": np.inf, "huge": 3e4, "hugely negative": -3e4}[how])
    if "huge" in how:
        made.agent.critic.second[4].bias.data.copy_(parameter.data)


@pytest.mark.parametrize("how", ["nan", "infinite", "huge", "hugely negative"])
def test_a_broken_critic_stops_the_run_before_the_agent_moves(how):
    made = module()
    made.training_step(batch(), 0)
    spoil(made, how)
    before = copied(made.agent)[0]
    said = "not finite" if "huge" not in how else "above model.value_limit 10000; a lower model.agent_learning_rate"
    with pytest.raises(BrokenExploration, match=said) as caught:
        made.training_step(batch(1), 1)
    assert "\n" not in str(caught.value) and isinstance(caught.value, UserError)
    after = made.agent.state_dict()
    assert all(torch.equal(after[name].nan_to_num(7.0), before[name].nan_to_num(7.0)) for name in before)


def test_an_actor_that_is_broken_is_noticed_before_the_critics_learn_from_it():
    made = module()
    made.agent.actor.network[4].bias.data.fill_(np.nan)
    before = copied(made.agent.critic, made.agent.target)
    with pytest.raises(BrokenExploration, match="not finite"):
        made.training_step(batch(), 0)
    assert not moved(made.agent.critic, before[0]) and not moved(made.agent.target, before[1])


def test_a_representation_that_is_broken_does_not_reach_the_agent():
    made = module(Identity)
    made.encoder.load_state_dict({name: value * np.nan for name, value in made.encoder.state_dict().items()})
    before = copied(made.agent)[0]
    with pytest.raises(UserError, match="not finite"):
        made.training_step(batch(), 0)
    assert not moved(made.agent, before)


def test_the_value_limit_is_the_user_s():
    module(value_limit=0.2).training_step(batch(), 0)
    with pytest.raises(BrokenExploration, match=r"above model\.value_limit 1e-06"):
        module(value_limit=1e-6).training_step(batch(), 0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"reward_on": "code"}, "model.reward_on is code: unknown, did you mean 'codes'?"),
        ({"hidden": 0}, "model.hidden must be above 0, is 0"),
        ({"agent_learning_rate": 0.0}, "model.agent_learning_rate must be above 0"),
        ({"tau": float("nan")}, "model.tau must be above 0, is nan"),
        ({"tau": 1.5}, "model.tau must be at most 1, is 1.5"),
        ({"noise": -0.1}, "model.noise must not be negative"),
        ({"noise_clip": -1.0}, "model.noise_clip must not be negative"),
        ({"value_limit": 0.0}, "model.value_limit must be above 0"),
        ({"queue": 0}, "queue must be at least 1, is 0"),
        ({"neighbours": 41}, "neighbours must be in 1..40"),
        ({"duplicates": "cuont"}, "unknown duplicates 'cuont', did you mean 'count'?"),
        ({"reward_on": "codes", "bottleneck": Identity}, "model.reward_on is codes: this bottleneck has none"),
        ({"reward_on": "codes", "bottleneck": Variational}, "choose latent or features"),
    ],
)
def test_options_out_of_range_are_one_line(options, said):
    with pytest.raises(UserError) as caught:
        module(**options)
    assert said in str(caught.value) and "\n" not in str(caught.value)
