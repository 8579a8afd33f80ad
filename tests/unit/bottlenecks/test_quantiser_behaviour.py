import copy

import pytest
import torch
from torch import nn

from repdib_lightning.bottlenecks import VectorQuantiser
from repdib_lightning.errors import UserError

BOTH_RULES = pytest.mark.parametrize("rule", ["ema", "gradient"])
M, G, L = 12, 3, 5


def started(**options):
    return VectorQuantiser(M, **({"groups": G, "codes": L, "start": "random", "start_step": 0} | options))


def buffers(module):
    return {name: value.clone() for name, value in module.state_dict().items()}


def same(first, second):
    return first.keys() == second.keys() and all(torch.equal(value, second[name]) for name, value in first.items())


def clustered(rows=64, seed=0):
    centres = 5 * torch.randn(4, M, generator=torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(seed)
    member = torch.randint(4, (rows,), generator=generator)
    return centres[member] + 0.1 * torch.randn(rows, M, generator=generator)


# The start


@BOTH_RULES
def test_passes_through_until_the_start_step_then_quantises(rule):
    quantiser = VectorQuantiser(M, groups=G, codes=L, codebook=rule, start_step=3)
    for _ in range(3):
        latent = clustered().requires_grad_()
        output = quantiser(latent)
        assert output.latent is latent
        assert output.codes is None
        assert all(loss.item() == 0 for loss in output.losses.values())
        assert not quantiser.ready
    output = quantiser(clustered())
    assert quantiser.ready
    assert output.codes.shape == (64, G)
    assert output.losses["commitment"] > 0


@BOTH_RULES
def test_loss_names_are_the_same_before_and_after_the_start(rule):
    quantiser = VectorQuantiser(M, groups=G, codes=L, codebook=rule, start_step=1)
    assert quantiser(clustered()).losses.keys() == quantiser(clustered()).losses.keys()


def test_every_parameter_is_in_the_graph_before_the_start():
    quantiser = VectorQuantiser(M, groups=G, codes=L, codebook="gradient")
    sum(quantiser(clustered()).losses.values()).backward()
    assert all(parameter.grad is not None for parameter in quantiser.parameters())


def test_kmeans_start_sees_training_latents_only():
    def run(evaluated):
        torch.manual_seed(3)
        quantiser = VectorQuantiser(M, groups=G, codes=L, start_step=2)
        for step in range(3):
            quantiser.eval()(evaluated)
            quantiser.train()(clustered(seed=step))
        return quantiser.codebook

    assert torch.equal(run(torch.zeros(50, M)), run(1e6 * torch.ones(20, M)))


def test_kmeans_start_uses_the_latest_latents():
    quantiser = VectorQuantiser(M, groups=G, codes=L, start_step=20, decay=0.0)
    for _ in range(20):
        quantiser(100 + clustered(rows=40))
    quantiser(clustered(rows=200))
    assert quantiser.codebook.abs().max() < 30


def test_start_step_zero_starts_on_the_first_batch():
    torch.manual_seed(0)
    quantiser = VectorQuantiser(M, groups=G, codes=L, start_step=0)
    output = quantiser(clustered())
    assert output.losses["commitment"] < 0.05


def test_random_start_is_a_draw_from_the_prior():
    torch.manual_seed(0)
    codebook = VectorQuantiser(64, groups=2, codes=200, start="random", start_step=0).codebook
    assert codebook.mean().abs() < 0.05
    assert codebook.std().item() == pytest.approx(1.0, abs=0.05)


def test_memory_of_the_gathered_latents_is_freed():
    quantiser = VectorQuantiser(M, groups=G, codes=L, start_step=1)
    assert quantiser.state_dict()["reservoir.rows"].numel() == 40 * L * M
    quantiser(clustered())
    quantiser(clustered())
    assert quantiser.state_dict()["reservoir.rows"].untyped_storage().nbytes() == 0


def test_unstarted_quantiser_explains_itself():
    quantiser = VectorQuantiser(M, groups=G, codes=L, start_step=7)
    quantiser(clustered())
    for call in (quantiser.require_ready, lambda: quantiser.decode(torch.zeros(2, G, dtype=torch.int64))):
        with pytest.raises(UserError, match="not started: 1 of 7 training steps done"):
            call()


# Evaluation


@BOTH_RULES
@pytest.mark.parametrize("start_step", [0, 100])
def test_evaluation_changes_nothing_and_repeats(rule, start_step):
    quantiser = VectorQuantiser(M, groups=G, codes=L, codebook=rule, start_step=start_step, revive_after=1, bypass=0.5)
    quantiser(clustered())
    before, random_state = buffers(quantiser), torch.get_rng_state()
    quantiser.eval()
    latent = clustered(seed=1)
    first = quantiser(latent)
    second = quantiser(latent)
    assert torch.equal(first.latent, second.latent)
    assert same(before, buffers(quantiser))
    assert torch.equal(torch.get_rng_state(), random_state)
    assert quantiser.ready == (start_step == 0)


@BOTH_RULES
@pytest.mark.parametrize("shared", [False, True])
def test_decode_inverts_the_codes(rule, shared):
    quantiser = started(codebook=rule, shared=shared).eval()
    output = quantiser(torch.randn(30, M))
    assert torch.equal(quantiser.decode(output.codes), output.latent)
    assert torch.equal(quantiser(output.latent).codes, output.codes)


def test_shared_and_own_books_agree_when_the_books_are_equal():
    shared, own = started(shared=True).eval(), started().eval()
    assert shared.codebook.shape == (1, L, M // G)
    assert own.codebook.shape == (G, L, M // G)
    own.book.vectors.copy_(shared.codebook.expand(G, -1, -1))
    latent = torch.randn(30, M)
    assert torch.equal(shared(latent).codes, own(latent).codes)
    assert torch.equal(shared(latent).latent, own(latent).latent)


# Learning


def test_gradient_codebook_follows_its_loss():
    torch.manual_seed(0)
    quantiser = started(codebook="gradient", revive_after=5)
    optimiser = torch.optim.Adam(quantiser.parameters(), lr=0.1)
    first = quantiser(clustered()).losses["codebook"].item()
    for step in range(60):
        optimiser.zero_grad()
        quantiser(clustered(seed=step % 5)).losses["codebook"].backward()
        optimiser.step()
    assert quantiser.book.vectors.grad.abs().sum() > 0
    assert quantiser(clustered()).losses["codebook"].item() < first / 3


def test_running_averages_follow_a_moving_input():
    torch.manual_seed(0)
    quantiser = VectorQuantiser(M, groups=G, codes=4, start_step=0, decay=0.9)
    for step in range(60):
        output = quantiser(clustered() + 0.04 * step)
    # An average with decay 0.9 lags a steady drift by 0.9 / 0.1 = 9 steps (and sees each batch after choosing).
    assert output.losses["commitment"].item() == pytest.approx((10 * 0.04) ** 2 + 0.1**2, rel=0.15)


@pytest.mark.parametrize("shared", [False, True])
@BOTH_RULES
def test_dead_codes_come_alive(rule, shared):
    torch.manual_seed(0)
    quantiser = started(codebook=rule, shared=shared, revive_after=3)
    with torch.no_grad():
        quantiser.book.vectors[:, 1:] = 1e3
        if rule == "ema":
            quantiser.book.sums.copy_(quantiser.book.vectors)
    latent = torch.randn(64, M)
    assert quantiser(latent).metrics["used_codes"] == 1
    for _ in range(3):
        output = quantiser(latent)
    assert output.metrics["used_codes"] == L
    assert quantiser.codebook.abs().max() < 10


@BOTH_RULES
def test_nothing_is_revived_at_zero(rule):
    quantiser = started(codebook=rule, revive_after=0)
    with torch.no_grad():
        quantiser.book.vectors[:, 1:] = 1e3
        if rule == "ema":
            quantiser.book.sums.copy_(quantiser.book.vectors)
    for _ in range(20):
        output = quantiser(torch.randn(64, M))
    assert output.metrics["used_codes"] == 1


@BOTH_RULES
def test_revived_code_is_a_row_and_the_following_update_keeps_it(rule):
    torch.manual_seed(0)
    quantiser = started(codebook=rule, revive_after=1)
    with torch.no_grad():
        quantiser.book.vectors[:, -1] = 1e3
        if rule == "ema":
            quantiser.book.sums.copy_(quantiser.book.vectors)
    latent = torch.randn(64, M)
    quantiser(latent)
    segments = latent.view(64, G, M // G)
    revived = quantiser.codebook[:, -1].detach().clone()
    for group in range(G):
        assert (segments[:, group] == revived[group]).all(-1).any()
    quantiser.book.revive_after = 0
    quantiser(1e4 + torch.zeros(1, M))
    torch.testing.assert_close(quantiser.codebook[:, -1].detach(), revived, atol=1e-3, rtol=1e-3)


@BOTH_RULES
def test_revived_code_that_stays_unused_waits_its_full_time_again(rule):
    quantiser = started(groups=1, codes=2, codebook=rule, revive_after=3)
    with torch.no_grad():
        quantiser.book.vectors.copy_(torch.stack([torch.zeros(1, M), torch.full((1, M), 1e3)], dim=1))
        if rule == "ema":
            quantiser.book.sums.copy_(quantiser.book.vectors)
    revived_at = []
    for step in range(9):
        before = quantiser.codebook[0, 1].detach().clone()
        quantiser(torch.zeros(4, M))  # All rows tie at code 0 once code 1 has come to them.
        if (quantiser.codebook[0, 1] - before).abs().max() > 100:
            revived_at.append(step)
            with torch.no_grad():
                quantiser.book.vectors[0, 1] = 1e3
                if rule == "ema":
                    quantiser.book.sums[0, 1] = 1e3
    assert revived_at == [2, 5, 8]


def test_used_codes_are_left_alone_by_revival():
    latent = torch.randn(64, M)
    with_revival, without = started(revive_after=1), started(revive_after=0)
    without.load_state_dict(with_revival.state_dict())
    codes = with_revival(latent).codes
    without(latent)
    for group in range(G):
        used = codes[:, group].unique()
        assert torch.equal(with_revival.codebook[group, used], without.codebook[group, used])


def test_bypass_shows_the_objective_some_rows_unquantised():
    torch.manual_seed(0)
    quantiser = started(bypass=0.3)
    latent = torch.randn(2000, M, requires_grad=True)
    output = quantiser(latent)
    untouched = (output.latent == latent).all(-1)
    assert untouched.float().mean().item() == pytest.approx(0.3, abs=0.04)
    assert output.codes.shape == (2000, G)
    output.latent.sum().backward()
    assert torch.equal(latent.grad, torch.ones_like(latent))
    assert not (quantiser.eval()(latent).latent == latent).all(-1).any()


def test_dropped_groups_are_zeros_that_learn_nothing():
    torch.manual_seed(0)
    quantiser = started(group_dropout=0.25)
    latent = torch.randn(3000, M, requires_grad=True)
    output = quantiser(latent)
    dropped = (output.latent.reshape(3000, G, -1) == 0).all(-1)
    assert dropped.float().mean(0).tolist() == pytest.approx([0.25] * G, abs=0.04)
    both = (dropped[:, 0] & dropped[:, 1]).float().mean().item()
    assert both == pytest.approx(0.25**2, abs=0.02)  # each group on its own
    output.latent.sum().backward()
    assert torch.equal(latent.grad.reshape(3000, G, -1).eq(0).all(-1), dropped)
    assert not (quantiser.eval()(latent).latent.reshape(3000, G, -1) == 0).all(-1).any()


def test_metrics_count_the_codes_in_use():
    quantiser = started(groups=1, codes=4).eval()
    quantiser.book.vectors.copy_(torch.eye(4, M).unsqueeze(0))
    metrics = quantiser(torch.eye(4, M)[[0, 0, 2, 2]]).metrics
    assert metrics["used_codes"] == 2
    assert metrics["perplexity"].item() == pytest.approx(2.0)
    assert metrics["perplexity_min"].item() == pytest.approx(2.0)


# State


@BOTH_RULES
@pytest.mark.parametrize("steps", [2, 6])
def test_resumed_run_is_identical(rule, steps):
    def build():
        return VectorQuantiser(M, groups=G, codes=L, codebook=rule, start_step=4, revive_after=2)

    torch.manual_seed(0)
    whole = build()
    for step in range(steps):
        whole(clustered(seed=step))
    resumed = build()
    resumed.load_state_dict(copy.deepcopy(whole.state_dict()))
    for step in range(steps, 9):
        torch.manual_seed(step)
        expected = whole(clustered(seed=step))
        torch.manual_seed(step)
        output = resumed(clustered(seed=step))
        assert torch.equal(output.latent, expected.latent)
        assert same(buffers(whole), buffers(resumed))
        assert whole.ready == resumed.ready


def test_earlier_state_loads_into_a_later_module():
    quantiser = VectorQuantiser(M, groups=G, codes=L, start_step=1)
    early = buffers(quantiser)
    for step in range(3):
        quantiser(clustered(seed=step))
    quantiser.load_state_dict(early)
    assert not quantiser.ready
    assert quantiser(clustered()).codes is None
    assert quantiser(clustered()).codes is not None


@pytest.mark.parametrize(
    ("saved", "asked", "message"),
    [
        ({"codebook": "ema"}, {"codebook": "gradient"}, "saved one is 'ema', the configuration says 'gradient'"),
        ({"codebook": "gradient"}, {"codebook": "ema"}, "saved one is 'gradient', the configuration says 'ema'"),
        ({"shared": True}, {"shared": False}, "1 book of 5 codes, 4 wide, the configuration asks for 3 books of 5"),
        ({"codes": 6}, {"codes": 5}, "3 books of 6 codes"),
        ({"start": "kmeans", "start_step": 9}, {"start_step": 9}, "saved before it started"),
    ],
)
@pytest.mark.parametrize("strict", [True, False])
def test_state_of_another_kind_is_refused(saved, asked, message, strict):
    with pytest.raises(UserError, match=message):
        started(**asked).load_state_dict(started(**saved).state_dict(), strict=strict)


@BOTH_RULES
def test_half_precision_modules_keep_the_book_in_single(rule):
    quantiser = started(codebook=rule)
    expected = buffers(quantiser)
    quantiser.to(torch.bfloat16)
    assert same(expected, buffers(quantiser))
    latent = torch.randn(20, M).bfloat16()
    output = quantiser(latent)
    assert output.latent.dtype == torch.bfloat16
    assert output.losses["commitment"].dtype == torch.float32
    assert quantiser.codebook.dtype == torch.float32
    assert quantiser.double().codebook.dtype == torch.float64


def test_autocast_chooses_the_same_codes():
    torch.manual_seed(0)
    quantiser = VectorQuantiser(64, groups=4, codes=100, start="random", start_step=0).eval()
    latent = torch.randn(1000, 64)
    plain = quantiser(latent)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = quantiser(latent)
    assert torch.equal(plain.codes, cast.codes)
    assert torch.equal(plain.latent, cast.latent)
    assert cast.losses["commitment"].dtype == torch.float32


# Compilation and export


class LatentAndCodes(nn.Module):
    def __init__(self, bottleneck):
        super().__init__()
        self.bottleneck = bottleneck

    def forward(self, latent):
        output = self.bottleneck(latent)
        return output.latent, output.codes


@BOTH_RULES
@pytest.mark.parametrize("shared", [False, True])
def test_export_with_any_batch_size(rule, shared):
    quantiser = VectorQuantiser(M, groups=G, codes=L, codebook=rule, shared=shared, start_step=0)
    quantiser(clustered())
    model = LatentAndCodes(quantiser.eval())
    batch = torch.export.Dim("batch", min=1, max=4096)
    program = torch.export.export(model, (clustered(4),), dynamic_shapes={"latent": {0: batch}})
    for rows in (1, 4, 61):
        latent = clustered(rows, seed=rows)
        for found, expected in zip(program.module()(latent), model(latent), strict=True):
            assert torch.equal(found, expected)


@BOTH_RULES
@pytest.mark.parametrize(("training", "revive_after"), [(False, 0), (True, 0), (True, 1)])
def test_compiles_without_a_break_once_started(rule, training, revive_after):
    options = {"start_step": 0, "decay": 0.9, "revive_after": revive_after}
    quantiser = VectorQuantiser(M, groups=G, codes=L, codebook=rule, **options)
    quantiser(clustered())
    quantiser.train(training)
    twin = copy.deepcopy(quantiser)
    compiled = torch.compile(twin, fullgraph=True, backend="aot_eager")
    for step in range(3):
        latent, other = clustered(seed=step).requires_grad_(), clustered(seed=step).requires_grad_()
        with torch.random.fork_rng():
            expected = quantiser(latent)
        output = compiled(other)
        assert torch.equal(output.codes, expected.codes)
        torch.testing.assert_close(output.latent, expected.latent)
        (expected.latent.square().sum() + sum(expected.losses.values())).backward()
        (output.latent.square().sum() + sum(output.losses.values())).backward()
        torch.testing.assert_close(other.grad, latent.grad)
    torch.testing.assert_close(buffers(twin), buffers(quantiser))


# Edges and mistakes


@BOTH_RULES
@pytest.mark.parametrize("options", [{"groups": 1}, {"codes": 1}, {"groups": M}])
@pytest.mark.parametrize("start", ["kmeans", "random"])
def test_extreme_shapes_with_one_row(rule, options, start):
    quantiser = started(codebook=rule, start=start, revive_after=1, **options)
    for _ in range(3):
        output = quantiser(torch.randn(1, M))
        assert output.latent.shape == (1, M)
        assert output.codes.shape == (1, quantiser.groups)
        assert torch.isfinite(output.latent).all()
        assert torch.isfinite(quantiser.codebook).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"groups": 5}, "groups 5 does not divide the width 12 .nearest: 4 or 6"),
        ({"groups": 20}, "groups 20 does not divide the width 12 .nearest: 12"),
        ({"groups": 0}, "groups must be at least 1, is 0"),
        ({"codes": 0}, "codes must be at least 1, is 0"),
        ({"codebook": "emma"}, "unknown codebook 'emma', did you mean 'ema'"),
        ({"start": "kmean"}, "did you mean 'kmeans'"),
        ({"decay": 1.0}, r"decay must be in \[0, 1\), is 1.0"),
        ({"start_step": -1}, "start_step must be at least 0"),
        ({"revive_after": -1}, "revive_after must be at least 0"),
        ({"bypass": 1.5}, r"bypass must be in \[0, 1\], is 1.5"),
        ({"group_dropout": 1.0}, r"group_dropout must be in \[0, 1\), is 1.0"),
    ],
)
def test_mistakes_are_named(options, message):
    with pytest.raises(UserError, match=f"VectorQuantiser: .*{message}"):
        started(**options)


def test_wrong_shapes_are_named():
    with pytest.raises(UserError, match=r"takes \(N, 12\), was given \(3, 13\)"):
        started()(torch.zeros(3, 13))
    with pytest.raises(UserError, match=r"decode takes \(N, 3\)"):
        started().decode(torch.zeros(3, 4, dtype=torch.int64))
