"""The network against a slow one, token by token; what sees what; where gradients go; dropout."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from small_choices import ACTIONS, FEATURES, network, windows_of

from repdib_lightning.rl.decision_transformer.attention import attend_in_parts
from repdib_lightning.rl.decision_transformer.dropout import Dropout, dropped
from repdib_lightning.rl.decision_transformer.network import DecisionTransformer, Sizes
from repdib_lightning.rl.decision_transformer.states import CodeStates, EncodedStates, LatentStates


def slow_logits(net, states, returns, actions, first):
    """One window, (T, A): each token looks at those before it, one head at a time."""
    sizes, width = net.sizes, net.sizes.width // net.sizes.heads
    tokens = []
    for t in range(len(returns)):
        tokens.append(torch.tanh(net.returns.weight[:, 0] * returns[t] / sizes.return_scale + net.returns.bias))
        tokens.append(torch.tanh(net.states.linear(states[t])))
        tokens.append(torch.tanh(net.actions.weight[actions[t]]))
    began = net.beginnings.weight[min(int(first) // sizes.stride, sizes.beginnings - 1)]
    hidden = [token + net.positions[i] + began for i, token in enumerate(tokens)]
    for block in net.blocks:
        normed = [block.norm_attention(token) for token in hidden]
        queries, keys, values = zip(*[block.attention.inputs(token).chunk(3) for token in normed], strict=True)
        attended = []
        for i, query in enumerate(queries):
            heads = []
            for head in range(sizes.heads):
                part = slice(head * width, (head + 1) * width)
                scores = torch.stack([query[part] @ keys[j][part] / math.sqrt(width) for j in range(i + 1)])
                heads.append(sum(w * values[j][part] for j, w in enumerate(scores.softmax(0))))
            attended.append(block.attention.outputs(torch.cat(heads)))
        hidden = [token + added for token, added in zip(hidden, attended, strict=True)]
        up, down = block.perceptron[0], block.perceptron[2]
        hidden = [token + down(F.gelu(up(block.norm_perceptron(token)))) for token in hidden]
    return torch.stack([net.head(net.norm(token)) for token in hidden[1::3]])


@pytest.mark.parametrize(("steps", "stride"), [(1, 1), (3, 1), (5, 1), (5, 4)])
def test_it_is_the_published_network(steps, stride):
    net = network(stride=stride)
    given = windows_of(net.sizes, steps=steps)
    logits = net(**given)
    assert logits.shape == (4, steps, ACTIONS) and logits.std() > 0.1
    for number, found in enumerate(logits):
        torch.testing.assert_close(found, slow_logits(net, *(part[number] for part in given.values())))


def test_no_logit_hangs_on_what_comes_later():
    net = network()
    given = windows_of(net.sizes)
    before = net(**given)
    for step in range(5):
        other = {name: part.clone() for name, part in given.items()}
        other["actions"][:, step:] = (other["actions"][:, step:] + 1) % ACTIONS  # the action of a step is read off it
        other["states"][:, step + 1 :] += 1.0
        other["returns"][:, step + 1 :] -= 1.0
        after = net(**other)
        assert torch.equal(after[:, : step + 1], before[:, : step + 1])
        assert step == 4 or (after[:, step + 1 :] - before[:, step + 1 :]).abs().amin(-1).min() > 1e-4


@pytest.mark.parametrize("changed", ["states", "returns"])
def test_each_logit_hangs_on_all_that_came_before(changed):
    net = network()
    given = windows_of(net.sizes)
    for step in range(5):
        other = {**given, changed: given[changed].clone()}
        other[changed][:, step] += 1.0
        assert ((net(**other) - net(**given))[:, step:].abs().amax(-1) > 1e-5).all()
    other = {**given, "first": (given["first"] + 1) % net.sizes.beginnings}
    assert ((net(**other) - net(**given)).abs().amax(-1) > 1e-5).all()


def test_a_window_that_begins_where_none_did_in_training_counts_as_the_last_that_did():
    net = network(stride=3, beginnings=4)
    given = windows_of(net.sizes, count=40)
    began = torch.arange(40)
    trained = (began // 3 * 3).clamp(max=9)  # 0, 3, 6, 9
    assert torch.equal(net(**{**given, "first": began}), net(**{**given, "first": trained}))
    same = {name: part[:1].expand(4, *part.shape[1:]) for name, part in given.items()}
    four = net(**{**same, "first": torch.tensor([0, 3, 6, 9])})
    assert all((four[i] - four[j]).abs().max() > 1e-4 for i in range(4) for j in range(i))


@pytest.mark.parametrize("dropout", [0.0, 0.2])
def test_gradients_reach_every_parameter(dropout):
    net = network(dropout=dropout).train()
    given = windows_of(net.sizes, count=40)
    given["first"] = torch.arange(40) % net.sizes.beginnings
    F.cross_entropy(net(**given).flatten(0, 1), given["actions"].flatten()).backward()
    for name, weight in net.named_parameters():
        assert weight.grad is not None, name
        rows = weight.grad.abs().flatten(1).amax(1) if weight.ndim > 1 else weight.grad.abs()
        assert rows[: -1 if name == "positions" else None].count_nonzero() >= 0.9 * (len(rows) - 1), name
    assert not net.positions.grad[-1].any()  # nobody looks back at the last action


def test_a_part_of_the_tokens_is_what_it_is_among_all():
    net = network()
    tokens, first = torch.randn(3, 9, 8), torch.tensor([0, 4, 19])
    every = net.read(tokens, first, slice(None))
    for wanted in (slice(1, None, 3), slice(-1, None), slice(2, 7)):
        torch.testing.assert_close(net.read(tokens, first, wanted), every[:, wanted])


def test_the_start_is_gpts():
    sizes = Sizes(9, 30, 1, 50, 2, 4, 64, 0.1, 1.0)
    torch.manual_seed(0)
    net = DecisionTransformer(sizes, LatentStates(torch.zeros(256), torch.ones(256), 64))
    for name, weight in net.named_parameters():
        if "norm" in name:
            assert (weight == float(name.endswith("weight"))).all(), name
        elif name in ("positions", "beginnings.weight") or name.endswith("bias"):
            assert not weight.any(), name
        else:
            assert weight.std().item() == pytest.approx(0.02, rel=0.25), name
    encoder = torch.nn.Linear(5, 64)
    before = encoder.weight.clone()
    DecisionTransformer(sizes, encoder)
    assert torch.equal(encoder.weight, before)


def test_latents_are_standardised():
    states = LatentStates(torch.full((FEATURES,), 100.0), torch.full((FEATURES,), 50.0), 8)
    plain = LatentStates(torch.zeros(FEATURES), torch.ones(FEATURES), 8)
    plain.linear = states.linear
    latents = torch.randn(2, 3, FEATURES)
    torch.testing.assert_close(states(100.0 + 50.0 * latents), plain(latents), rtol=1e-4, atol=1e-5)


def test_each_group_of_codes_has_embeddings_of_its_own():
    torch.manual_seed(0)
    states = CodeStates(3, 4, 8)
    codes = torch.randint(4, (2, 5, 3))
    table = states.codes.weight.view(3, 4, 8)
    wanted = sum(table[group, codes[..., group]] for group in range(3))
    torch.testing.assert_close(states(codes), torch.tanh(wanted))
    assert "offsets" not in states.state_dict() and EncodedStates()(codes) is codes


def test_attention_in_parts_is_attention():
    drawn = torch.Generator().manual_seed(0)
    queries, keys, values = (torch.randn(2, 3, 70, 4, generator=drawn) for _ in range(3))
    wanted = F.scaled_dot_product_attention(queries, keys, values, is_causal=True)
    torch.testing.assert_close(attend_in_parts(queries, keys, values, torch.arange(70), 0.0), wanted)
    some = torch.arange(1, 70, 3)
    torch.testing.assert_close(attend_in_parts(queries[:, :, some], keys, values, some, 0.0), wanted[:, :, some])


def test_dropout_drops_its_share_and_keeps_the_mean():
    torch.manual_seed(0)
    ones = torch.ones(400, 1001)
    out = dropped(ones, 0.3)
    assert (out == 0).float().mean() == pytest.approx(0.3, abs=0.005) and out.mean() == pytest.approx(1.0, abs=0.005)
    assert out.unique().numel() == 2
    along = (out[:, 1:] == 0).double() @ torch.ones(1000, dtype=torch.double) / 1000  # rows do not go together
    assert along.std() == pytest.approx(math.sqrt(0.3 * 0.7 / 1000), rel=0.2)
    neighbours = ((out[:, 1:] == 0) & (out[:, :-1] == 0)).double().mean()
    assert neighbours == pytest.approx(0.09, abs=0.003)


def test_dropout_is_that_of_the_generator_and_has_its_gradient():
    values = torch.ones(7, 3, requires_grad=True)
    torch.manual_seed(3)
    first = dropped(values, 0.5)
    first.sum().backward()
    torch.manual_seed(3)
    assert torch.equal(dropped(values, 0.5), first) and torch.equal(values.grad, first)
    assert not torch.equal(dropped(values, 0.5), first)
    layer = Dropout(0.5)
    assert layer.eval()(values) is values and (layer.train()(values) == 0).any() and dropped(values, 0.0) is values
    assert dropped(values, 1 - 1e-9).isfinite().all()


def test_dropout_is_in_training_alone():
    net, given = network(dropout=0.3), windows_of(network().sizes)
    assert torch.equal(net(**given), network()(**given)) and torch.equal(net(**given), net(**given))
    net.train()
    assert not torch.equal(net(**given), net(**given))
