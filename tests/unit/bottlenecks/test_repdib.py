import inspect
import json
import subprocess
import sys

import pytest
import torch
from safetensors.torch import load, save

from repdib_lightning.bottlenecks import BOTTLENECKS, Identity, RepDIB, Variational, VectorQuantiser
from repdib_lightning.errors import UserError

M, G, L = 12, 3, 5
PAPER = {"codebook": "gradient", "start": "random", "start_step": 0, "revive_after": 0, "kl_reduction": "sum"}


def build(**options):
    torch.manual_seed(0)
    return RepDIB(M, **({"groups": G, "codes": L, "start": "random", "start_step": 0} | options))


def test_options_are_those_of_the_two_parts_with_their_defaults():
    def options(kind):
        return {name: p.default for name, p in inspect.signature(kind).parameters.items() if name != "width"}

    own = options(RepDIB)
    assert own.pop("noise") == "before"
    assert own == options(Variational) | options(VectorQuantiser)


def test_every_option_reaches_its_part():
    given = {"kl_reduction": "sum", "head": "split", "log_variance_start": -3.0, "shared": True, "decay": 0.5}
    given |= {"log_variance_low": -9.0, "log_variance_high": 1.0, "codebook": "ema", "start": "random"}
    given |= {"groups": 4, "codes": 7, "start_step": 0, "revive_after": 3, "bypass": 0.25, "group_dropout": 0.125}
    whole = RepDIB(M, **given)
    parts = whole.variational.arguments | whole.quantiser.arguments
    assert parts == given


def test_quantises_the_sample_in_training_and_the_mean_in_evaluation():
    bottleneck = build(log_variance_start=1.0)
    latent = torch.randn(200, M)
    assert not torch.equal(bottleneck(latent).codes, bottleneck(latent).codes)
    bottleneck.eval()
    output = bottleneck(latent)
    assert torch.equal(output.codes, bottleneck.quantiser(latent).codes)
    assert torch.equal(bottleneck.decode(output.codes), output.latent)


def test_noise_after_the_choice_leaves_the_codes_alone():
    bottleneck = build(noise="after", log_variance_start=1.0, codebook="gradient", revive_after=0)
    latent = torch.randn(4000, M, requires_grad=True)
    output = bottleneck(latent)
    assert torch.equal(output.codes, bottleneck(latent).codes)
    added = output.latent - bottleneck.decode(output.codes)
    assert added.std().item() == pytest.approx(1.6487, rel=0.03)
    assert added.mean().abs() < 0.05
    output.latent.square().sum().backward()
    assert bottleneck.variational.head.layer.bias.grad[M:].abs().min() > 0
    evaluated = bottleneck.eval()(latent)
    assert torch.equal(evaluated.latent, bottleneck.decode(evaluated.codes))


def test_before_the_start_it_is_the_variational_bottleneck():
    torch.manual_seed(0)
    whole = RepDIB(M, groups=G, codes=L)
    alone = Variational(M)
    latent = torch.randn(20, M)
    for noise in ("before", "after"):
        whole.noise = noise
        torch.manual_seed(1)
        expected = alone(latent)
        torch.manual_seed(1)
        output = whole(latent)
        torch.testing.assert_close(output.latent, expected.latent)
        assert torch.equal(output.losses["kl"], expected.losses["kl"])
        assert output.codes is None
    with pytest.raises(UserError, match="not started"):
        whole.require_ready()


@pytest.mark.parametrize("options", [{}, PAPER, {"noise": "after"}, {"head": "split"}])
def test_gradients_reach_every_parameter_and_the_input(options):
    bottleneck = build(**options)
    latent = torch.randn(32, M, requires_grad=True)
    output = bottleneck(latent)
    (output.latent.square().mean() + sum(output.losses.values())).backward()
    for name, parameter in bottleneck.named_parameters():
        assert parameter.grad.abs().sum() > 0, name
    # Half of what a split head takes steers the log-variance only, by a scale that starts at 0.
    assert (latent.grad[:, : M // 2 if options.get("head") == "split" else M] != 0).all()


def test_names_of_losses_and_metrics():
    assert set(build()(torch.randn(8, M)).losses) == {"kl", "commitment"}
    output = build(**PAPER)(torch.randn(8, M))
    assert set(output.losses) == {"kl", "commitment", "codebook"}
    expected = {"kl_nats", "sigma", "mean_rms", "perplexity", "perplexity_min", "used_codes"}
    assert set(output.metrics) == expected
    assert not any(value.requires_grad for value in output.metrics.values())


@pytest.mark.parametrize("options", [{}, PAPER, {"noise": "after", "bypass": 0.5}])
def test_evaluation_changes_nothing(options):
    bottleneck = build(**options)
    bottleneck(torch.randn(30, M))
    before = {name: value.clone() for name, value in bottleneck.state_dict().items()}
    bottleneck.eval()
    latent = torch.randn(30, M)
    assert torch.equal(bottleneck(latent).latent, bottleneck(latent).latent)
    assert all(torch.equal(value, before[name]) for name, value in bottleneck.state_dict().items())


def test_autocast_computes_both_stages_in_single_precision():
    bottleneck = build().eval()
    latent = torch.randn(300, M)
    plain = bottleneck(latent)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = bottleneck(latent)
        assert bottleneck(latent.bfloat16()).latent.dtype == torch.bfloat16
    assert torch.equal(cast.codes, plain.codes)
    assert torch.equal(cast.latent, plain.latent)


@pytest.mark.parametrize("kind", list(BOTTLENECKS.values()))
def test_rebuilt_from_its_plain_arguments_and_tensors(kind):
    options = {"start": "random", "start_step": 0, "groups": G} if kind in (RepDIB, VectorQuantiser) else {}
    bottleneck = kind(M, **options)
    bottleneck(torch.randn(16, M))
    arguments = json.loads(json.dumps(bottleneck.arguments))
    rebuilt = BOTTLENECKS[kind.__name__](M, **arguments)
    rebuilt.load_state_dict(load(save(bottleneck.state_dict())) if bottleneck.state_dict() else {})
    latent = torch.randn(16, M)
    assert torch.equal(rebuilt.eval()(latent).latent, bottleneck.eval()(latent).latent)
    assert (rebuilt.width, rebuilt.groups, rebuilt.codes) == (bottleneck.width, bottleneck.groups, bottleneck.codes)


def test_started_state_survives_a_bundle():
    bottleneck = RepDIB(M, groups=G, codes=L, start_step=1)
    for _ in range(2):
        bottleneck(torch.randn(16, M))
    rebuilt = RepDIB(M, **bottleneck.arguments).eval()
    rebuilt.load_state_dict(load(save(bottleneck.state_dict())))
    assert rebuilt.ready
    latent = torch.randn(16, M)
    assert torch.equal(rebuilt(latent).codes, bottleneck.eval()(latent).codes)


def test_compiles_in_evaluation():
    bottleneck = build().eval()
    compiled = torch.compile(bottleneck, fullgraph=True, backend="aot_eager")
    latent = torch.randn(16, M)
    torch.testing.assert_close(compiled(latent).latent, bottleneck(latent).latent)


def test_identity_returns_its_input_and_has_no_codes():
    latent = torch.randn(4, M)
    identity = Identity(M)
    assert identity(latent).latent is latent
    assert identity.ready
    with pytest.raises(UserError, match="no codes"):
        identity.decode(torch.zeros(4, 1, dtype=torch.int64))


def test_mistakes_are_named():
    with pytest.raises(UserError, match="RepDIB: unknown noise 'befor', did you mean 'before'"):
        build(noise="befor")
    with pytest.raises(UserError, match="groups 5 does not divide"):
        build(groups=5)


def test_import_needs_no_lightning():
    code = "import sys, repdib_lightning.bottlenecks; print('lightning' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


def test_noise_after_the_quantiser_and_dropped_groups_exclude_each_other():
    with pytest.raises(UserError, match="fills the groups that group_dropout empties"):
        RepDIB(8, groups=2, noise="after", group_dropout=0.5)
