"""What an encoder of clips promises, whatever it is made of.

1. Every parameter gets a gradient in every step, also where modalities are missing.
2. Evaluation is deterministic, changes no buffer, and sees each clip alone.
3. Nothing that stands in missing or padded places is read.
4. A clip that misses everything has finite features; modality dropout leaves at least one modality.
5. What a bundle needs: plain arguments, weights that can be loaded, only the observations that are used.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from jsonargparse import ArgumentParser
from small_clips import FRAMES, READINGS, REPDIB, SMALL, SPEC, clips, missing

from repdib_lightning.encoders import Encoder, MultimodalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec, DataSpec

KINDS = {
    "hamlet": {},
    "hamlet concat": {"join": "concat", "layers": 2},
    "keyless": {"pooling": "keyless", "fusion": "keyless", "layers": 0},
    "statistics": {"sensor_network": "statistics", "layers": 0},
    "weighting": {"pooling": "keyless", "fusion": "weighting", "join": "concat"},
    "both levels": {"fusion": "weighting", **REPDIB},
    "gradient codes": {
        "bottleneck": "VectorQuantiser",
        "bottleneck_options": {"groups": 2, "codes": 4, "codebook": "gradient", "start_step": 2},
    },
}
AUGMENTED = {"rotation": 20.0, "scaling": 0.1, "jitter": 0.1, "time_warp": 0.1, "modality_dropout": 0.3}


def build(kind="hamlet", **options):
    torch.manual_seed(0)
    return MultimodalEncoder(SPEC, **{**SMALL, **KINDS[kind], **options})


def trained(kind, **options):
    """An encoder in evaluation whose bottlenecks have started."""
    encoder = build(kind, **options)
    for seed in range(4):
        encoder(clips(seed=seed))
    return encoder.eval()


def total(output):
    return output.features.square().sum() + sum(output.losses.values())


@pytest.mark.parametrize("kind", KINDS)
def test_contract(kind):
    encoder = build(kind, **AUGMENTED)
    for seed in range(3):  # until the codebooks start
        output = encoder.detailed(clips(seed=seed))
    assert output.features.shape == (5, encoder.features) == (5, 12)
    assert list(output.attention) == [*SPEC.observations, "modalities"]
    assert output.attention["modalities"].shape == (5, 6) and output.attention["cam1"].shape == (5, 3)
    assert output.attention["acceleration"].shape == (5, 4)
    for weights in output.attention.values():
        assert not weights.requires_grad and (weights >= 0).all()
        torch.testing.assert_close(weights.sum(1), torch.ones(5))
    total(output).backward()
    for name, parameter in encoder.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("absent", ["cam2", "orientation", "all"])
def test_every_parameter_gets_a_gradient_where_a_batch_misses_a_modality(kind, absent):
    encoder, batch = build(kind), clips()
    for name in SPEC.observations if absent == "all" else [absent]:
        batch[name] = missing(batch[name])
    for _ in range(4):  # before and after the codebooks start
        encoder.zero_grad()
        output = encoder.detailed(batch)
        assert output.features.isfinite().all()
        total(output).backward()
        for name, parameter in encoder.named_parameters():
            assert parameter.grad is not None and parameter.grad.isfinite().all(), name


@pytest.mark.parametrize("kind", KINDS)
def test_evaluation_is_deterministic_changes_no_buffer_and_sees_each_clip_alone(kind):
    encoder = trained(kind, **AUGMENTED)
    before = {key: value.clone() for key, value in encoder.state_dict().items()}
    batch = clips(7, seed=9)
    batch["cam1"][2], batch["gyroscope"][3], batch["acceleration"][4, 9:] = 0, torch.nan, torch.nan
    state = torch.get_rng_state()
    output = encoder.detailed(batch)
    assert torch.equal(state, torch.get_rng_state())
    alone = [encoder.detailed({name: array[row : row + 1] for name, array in batch.items()}) for row in range(7)]
    torch.testing.assert_close(output.features, torch.cat([one.features for one in alone]), atol=1e-5, rtol=1e-4)
    for name, weights in output.attention.items():
        torch.testing.assert_close(weights, torch.cat([one.attention[name] for one in alone]), atol=1e-5, rtol=1e-4)
    for name, codes in output.codes.items():
        assert torch.equal(codes, torch.cat([one.codes[name] for one in alone]))
    assert torch.equal(encoder(batch), output.features)
    assert all(torch.equal(value, before[key]) for key, value in encoder.state_dict().items())


@pytest.mark.parametrize("kind", KINDS)
def test_padding_is_not_read(kind):
    """A clip of 4 of 6 frames and 10 of 20 readings is the same in a store of clips of just that length."""
    frames, readings = 4, 10
    short = replace(SPEC, observations={
        name: replace(array, shape=(readings if array.shape[0] == READINGS else frames, *array.shape[1:]))
        for name, array in SPEC.observations.items()
    })  # fmt: skip
    torch.manual_seed(0)
    long_one = MultimodalEncoder(SPEC, **{**SMALL, **KINDS[kind], "segments": 0}).eval()
    short_one = MultimodalEncoder(short, **{**SMALL, **KINDS[kind], "segments": 0}).eval()
    short_one.load_state_dict(long_one.state_dict())
    batch = clips()
    cut = {name: array[:, : short.observations[name].shape[0]] for name, array in batch.items()}
    for name, array in batch.items():
        array[:, short.observations[name].shape[0] :] = 0 if array.dtype == torch.uint8 else torch.nan
    torch.testing.assert_close(long_one(batch), short_one(cut), atol=1e-6, rtol=1e-5)


def test_missing_steps_and_modalities_weigh_nothing():
    encoder, batch = trained("hamlet"), clips()
    batch["cam1"][0] = 0
    batch["acceleration"][0, 10:] = torch.nan
    batch["acceleration"][1, :, 3:] = torch.nan  # one of two devices
    attention = encoder.detailed(batch).attention
    order = encoder.modalities
    assert attention["modalities"][0, order.index("cam1")] == 0 and attention["cam1"][0].sum() == 0
    assert attention["acceleration"][0, 2:].sum() == 0 and (attention["acceleration"][1] > 0).all()
    assert (attention["modalities"][1:] > 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_modality_is_the_same_to_its_neighbours_whatever_the_weights_make_of_zeros(kind):
    """The vector of a missing modality is not looked at: changing all of its weights changes nothing."""
    encoder, batch = trained(kind), clips()
    batch["cam2"] = missing(batch["cam2"])
    before = encoder(batch)
    with torch.no_grad():
        for parameter in encoder.unimodal["cam2"].parameters():
            parameter.add_(torch.randn_like(parameter))
    assert torch.equal(encoder(batch), before)


@pytest.mark.parametrize("kind", KINDS)
def test_a_clip_that_misses_everything_is_finite(kind):
    encoder = trained(kind)
    output = encoder.detailed({name: missing(array) for name, array in clips().items()})
    assert output.features.isfinite().all()
    assert all(weights.sum() == 0 for weights in output.attention.values())
    assert all((codes == -1).all() for codes in output.codes.values())
    assert all(loss == 0 for loss in output.losses.values())


def test_losses_and_metrics_are_means_over_modalities():
    encoder, batch = trained("both levels"), clips()
    output = encoder.detailed(batch)
    assert set(output.losses) == {"unimodal_kl", "unimodal_commitment"}
    assert {"unimodal_kl_nats", "unimodal_perplexity", "unimodal_used_codes"} <= set(output.metrics)
    assert set(output.codes) == set(SPEC.observations)
    losses = []
    for name in encoder.modalities:
        vector = encoder.unimodal[name](batch[name])[0]
        losses.append(encoder.bottlenecks.each[name](vector).losses["kl"])
    torch.testing.assert_close(output.losses["unimodal_kl"], torch.stack(losses).mean())
    assert not any(metric.requires_grad for metric in output.metrics.values())


def test_bottlenecks_of_modalities_are_asked_before_an_export():
    encoder = build("both levels")
    with pytest.raises(UserError, match=r"bottleneck of 'cam1': VectorQuantiser: the quantiser has not started"):
        encoder.require_ready()
    trained("both levels").require_ready()
    build("hamlet").require_ready()


@pytest.mark.parametrize("kind", KINDS)
def test_plain_arguments_and_weights_rebuild_it(kind):
    encoder = trained(kind)
    arguments = json.loads(json.dumps(encoder.arguments))
    assert "weights" not in arguments
    rebuilt = MultimodalEncoder(DataSpec.from_dict(encoder.spec.to_dict()), **arguments).eval()
    rebuilt.load_state_dict(encoder.state_dict())
    assert torch.equal(rebuilt(clips()), encoder(clips()))


def test_only_what_is_used_is_asked_for():
    encoder = MultimodalEncoder(SPEC, modalities=["gyroscope", "cam2"], width=8, features=4)
    assert list(encoder.spec.observations) == encoder.modalities == ["gyroscope", "cam2"]
    assert (encoder.spec.target, encoder.spec.classes) == ("activity", ("sit", "run"))
    assert encoder({name: array for name, array in clips().items() if name in encoder.modalities}).shape == (5, 4)


def test_training_differs_from_evaluation_only_by_what_is_asked_for():
    plain = build(dropout=0.0, segments=0)
    assert torch.equal(plain(clips()), plain.eval()(clips()))
    for options in ({"dropout": 0.3}, {"segments": 3}, *({name: value} for name, value in AUGMENTED.items())):
        encoder = build(**{"dropout": 0.0, "segments": 0, **options})
        assert not torch.equal(encoder(clips()), encoder.eval()(clips())), options


def test_sensors_are_normalised_by_the_statistics_of_the_spec():
    array = SPEC.observations["gyroscope"]
    scaled = replace(array, mean=(13.0,) * 3, std=(20.0,) * 3)
    encoders = []
    for spec in (array, scaled):
        torch.manual_seed(0)
        encoders.append(MultimodalEncoder(DataSpec({"gyroscope": spec}), width=8, features=4).eval())
    readings = clips()["gyroscope"]
    torch.testing.assert_close(encoders[0]({"gyroscope": readings}), encoders[1]({"gyroscope": 10 * readings + 3}))


def test_angles_have_no_jump():
    encoder = build().eval()
    batch = clips()
    turned = batch | {"orientation": batch["orientation"] + 360.0}
    torch.testing.assert_close(encoder(batch), encoder(turned), atol=1e-5, rtol=1e-4)


def test_half_precision_under_autocast():
    encoder = trained("both levels")
    with torch.autocast("cpu", torch.bfloat16):
        assert encoder(clips()).isfinite().all()


def test_it_can_be_traced_with_a_free_batch():
    spec = DataSpec({"acceleration": ArraySpec((10, 3), "float32")})
    options = {"groups": 2, "codes": 4, "start": "random", "start_step": 0}
    encoder = MultimodalEncoder(spec, width=8, features=8, bottleneck="RepDIB", bottleneck_options=options).eval()
    batch = clips(6, spec=spec)
    batch["acceleration"][2], batch["acceleration"][3, 5:] = torch.nan, torch.nan
    free = torch.export.Dim("batch", min=1, max=64)
    shapes = {"observations": {name: {0: free} for name in batch}}
    with torch.no_grad():
        program = torch.export.export(encoder, (clips(2, spec=spec),), dynamic_shapes=shapes)
        torch.testing.assert_close(program.module()(batch), encoder(batch), atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"modalities": ["cam3"]}, r"modalities has 'cam3'.*did you mean"),
        ({"modalities": ["cam1", "cam1"]}, "'cam1' twice"),
        ({"modalities": []}, "needs at least one video"),
        ({"angles": ["orientatoin"]}, r"angles has 'orientatoin'.*did you mean 'orientation'"),
        ({"angles": ["orientation"], "modalities": ["cam1"]}, r"angles has 'orientation'.*there is none"),
        ({"frame_features": ["cam1"]}, "frame_features has 'cam1', which is none of the sequences"),
        ({"rotated": ["accelaration"], "rotation": 5.0}, r"rotated has 'accelaration'.*did you mean 'acceleration'"),
        ({"rotated": ["features"], "frame_features": ["features"]}, r"rotated has 'features'"),
        ({"angles": ["features"], "frame_features": ["features"]}, r"angles has 'features'"),
        ({"rotated": ["features"], "rotation": 5.0}, "whose 10 channels are no triples"),
        ({"pooling": "attn"}, r"unknown pooling 'attn', did you mean 'attention'"),
        ({"fusion": "keylss"}, r"unknown fusion 'keylss', did you mean 'keyless'"),
        ({"join": "cat"}, r"unknown join 'cat', did you mean 'concat'"),
        ({"heads": 3}, "heads 3 must divide the width 8"),
        ({"sensor_network": "statistic"}, r"unknown sensor_network 'statistic', did you mean 'statistics'"),
        ({"network": "resnet19"}, r"unknown network 'resnet19', did you mean 'resnet18'"),
        ({"norm": "gruop"}, r"unknown norm 'gruop', did you mean 'group'"),
        ({"weights": "w.pth"}, "weights are of a ResNet"),
        ({"window": 21}, "window 21 is longer than the 20 readings of 'acceleration'"),
        ({"stride": 0}, "stride must be at least 1, is 0"),
        ({"layers": -1}, "layers must be at least 0, is -1"),
        ({"features": 0}, "features must be at least 1"),
        ({"dropout": 1.0}, r"dropout must be in \[0, 1\), is 1.0"),
        ({"modality_dropout": -0.1}, r"modality_dropout must be in"),
        ({"reflection": 1.5}, r"reflection must be in \[0, 1\], is 1.5"),
        ({"reflection": 0.5}, "mirror images of acceleration and gyroscope, not of 'orientation'"),
        ({"scaling": -1.0}, "scaling must not be negative"),
        ({"bottleneck": "RepDBI"}, r"unknown bottleneck 'RepDBI', did you mean 'RepDIB'"),
        ({"bottleneck": "RepDIB", "bottleneck_options": {"code": 3}}, r"has 'code', unknown to RepDIB, did you mean"),
        ({"bottleneck": "RepDIB", "bottleneck_options": {"groups": 3}}, "groups 3 does not divide the width 8"),
        ({"bottleneck": "RepDIB", "bottleneck_options": {"groups": "many"}}, "do not build a RepDIB"),
        ({"bottleneck_options": {"groups": 3}}, "bottleneck_options are given, but no bottleneck"),
    ],
)
def test_mistakes_give_one_line(options, words):
    with pytest.raises(UserError, match=words) as caught:
        MultimodalEncoder(SPEC, **{**SMALL, "angles": None, "frame_features": None, **options})
    assert "\n" not in str(caught.value)


def test_data_without_clips_is_refused():
    with pytest.raises(UserError, match="needs at least one video"):
        MultimodalEncoder(DataSpec({"eye": ArraySpec((3, 16, 16)), "joints": ArraySpec((7,), "float32")}))


def test_its_options_come_through_yaml_and_the_command_line(tmp_path):
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--config", action="config")
    parser.add_argument("--encoder", type=Callable[[DataSpec], Encoder])
    file = tmp_path / "run.yaml"
    file.write_text("""
encoder:
  class_path: MultimodalEncoder
  init_args:
    width: 8
    angles: [orientation]
    frame_features: [features]
    bottleneck: RepDIB
    bottleneck_options: {groups: 2, codes: 4, shared: true, decay: 0.5}
""")
    given = ["--config", str(file), "--encoder.bottleneck_options.codes=9", "--encoder.fusion=keyless"]
    for _ in range(2):  # and through what a run keeps of it
        config = parser.parse_args(given)
        encoder = parser.instantiate(config).encoder(SPEC)
        options = {"groups": 2, "codes": 9, "shared": True, "decay": 0.5}
        assert encoder.arguments["bottleneck_options"] == options and encoder.arguments["fusion"] == "keyless"
        assert encoder.bottlenecks.each["cam1"].codes == 9
        file.write_text(parser.dump(config))
        given = ["--config", str(file)]
    none = parser.parse_args([*given, "--encoder.bottleneck=null", "--encoder.bottleneck_options=null"])
    assert not parser.instantiate(none).encoder(SPEC).bottlenecks.each


def test_all_frames_where_there_are_no_more_than_segments():
    encoder = build(segments=FRAMES + 1)
    assert encoder.detailed(clips()).attention["cam1"].shape == (5, FRAMES)
