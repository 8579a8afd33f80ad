"""Segments, windows, networks of frames, augmentation and modality dropout."""

from __future__ import annotations

import pytest
import torch
import torchvision
from safetensors.torch import save_file
from small_clips import SPEC, clips

from repdib_lightning.encoders import MultimodalEncoder
from repdib_lightning.encoders.clip_steps import observed_frames, observed_readings
from repdib_lightning.encoders.frame_networks import SmallFrames
from repdib_lightning.encoders.modality_dropout import drop_modalities
from repdib_lightning.encoders.segments import segment_frames
from repdib_lightning.encoders.sensor_augmentation import SensorAugmentation, at_speed, rotation_matrices
from repdib_lightning.encoders.sensor_sequences import SensorSequence, channel_statistics
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec, DataSpec

SENSORS = ["acceleration", "gyroscope", "orientation"]
OF_SENSORS = DataSpec({name: SPEC.observations[name] for name in SENSORS})
OFF = {"reflection": 0.0, "rotation": 0.0, "rotated": None, "scaling": 0.0, "jitter": 0.0, "time_warp": 0.0}


def numbered(count, stored):
    return torch.arange(stored).repeat(count, 1)


@pytest.mark.parametrize(("stored", "segments", "middles"), [
    (8, 4, [0, 2, 4, 6]), (9, 3, [1, 4, 7]), (10, 3, [1, 4, 7]), (16, 5, [1, 4, 7, 10, 13]), (5, 1, [2]),
])  # fmt: skip
def test_evaluation_takes_the_middle_of_each_segment(stored, segments, middles):
    assert segment_frames(numbered(2, stored), segments, training=False).tolist() == [middles] * 2


@pytest.mark.parametrize("segments", [0, 6, 7])
def test_all_frames_where_there_are_no_more(segments):
    clip = numbered(2, 6)
    assert segment_frames(clip, segments, training=True) is clip


def test_training_takes_any_frame_of_each_segment_and_each_clip_its_own():
    torch.manual_seed(0)
    taken = segment_frames(numbered(400, 10), 4, training=True)
    parts = [{0, 1}, {2, 3, 4}, {5, 6}, {7, 8, 9}]
    assert [set(column.tolist()) for column in taken.T] == parts
    assert len({tuple(row.tolist()) for row in taken}) == 2 * 3 * 2 * 3
    assert torch.bincount(taken[:, 1])[2:].min() > 100  # 400 / 3


def test_which_steps_were_observed():
    video = torch.zeros(1, 3, 2, 4, 4, dtype=torch.uint8)
    video[0, 1, 1, 3, 3] = 1
    assert observed_frames(video).tolist() == [[False, True, False]]
    readings = torch.tensor([[[torch.nan, torch.nan], [0.0, torch.nan], [torch.inf, torch.nan]]])
    assert observed_readings(readings).tolist() == [[False, True, False]]


def test_a_window_counts_if_half_of_it_was_observed():
    torch.manual_seed(0)
    sensor = SensorSequence("x", ArraySpec((12, 2), "float32"), 4, network="convolution",
                            window=4, stride=4, channels=5, layers=1, dropout=0.0, angles=False)  # fmt: skip
    readings = torch.randn(1, 12, 2)
    readings[0, 1:4], readings[0, 6:8] = torch.nan, torch.nan
    steps, observed = sensor(readings)
    assert observed.tolist() == [[False, True, True]]
    assert (steps[0, 0] == 0).all() and (steps[0, 1:] != 0).any()
    readings[0, 0] = 100.0  # of a window that does not count
    assert torch.equal(sensor(readings)[0], steps)


def test_overlapping_windows_and_constant_channels():
    array = ArraySpec((12, 2), "float32", (3.0, 5.0), (2.0, 0.0))
    sensor = SensorSequence(
        "x", array, 4, network="convolution", window=4, stride=2, channels=5, layers=0, dropout=0.0, angles=False
    )
    readings = torch.full((1, 12, 2), 5.0)
    assert sensor(readings)[0].shape == (1, 5, 4) and sensor(readings)[0].isfinite().all()
    assert channel_statistics(array)[1].tolist() == [2.0, 1.0]


@pytest.mark.parametrize("shape", [(3, 64, 64), (1, 16, 16), (3, 97, 42), (3, 4, 7)])
def test_small_frames_measure_the_picture(shape):
    network = SmallFrames(shape)
    pictures = torch.randint(0, 256, (2, *shape), dtype=torch.uint8)
    assert network(pictures).shape == (2, network.width)
    if shape == (3, 64, 64):
        assert network.width == 64 * 4 * 4


def test_frames_too_small_for_the_first_convolution():
    with pytest.raises(UserError, match="frames of 3x9 pixels are too small"):
        SmallFrames((3, 3, 9))


VIDEO = DataSpec({"cam1": ArraySpec((2, 3, 32, 32))})


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_resnet_starts_from_weights_and_a_bundle_does_without_the_file(tmp_path, suffix):
    torch.manual_seed(0)
    peer = torchvision.models.resnet18(weights=None)
    for name, value in peer.named_buffers():
        if name.endswith("var"):
            value.uniform_(0.5, 1.0)
        elif name.endswith("mean"):
            value.normal_(std=0.1)
    file = tmp_path / f"resnet18{suffix}"
    (torch.save if suffix == ".pth" else lambda tensors, path: save_file(tensors, path))(peer.state_dict(), file)
    options = {"network": "resnet18", "width": 8, "features": 4}
    encoder = MultimodalEncoder(VIDEO, norm="frozen", weights=str(file), **options)
    pictures = clips(2, spec=VIDEO)["cam1"]
    frames = encoder.unimodal["cam1"].sequence.network
    normalise = torchvision.transforms.Normalize((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    peer.fc = torch.nn.Identity()
    expected = peer.eval()(normalise(pictures[:, 0] / 255.0))
    assert expected.std() > 0.1
    torch.testing.assert_close(frames(pictures[:, 0]), expected, atol=1e-4, rtol=1e-3)
    file.unlink()
    rebuilt = MultimodalEncoder(VIDEO, **encoder.arguments)
    rebuilt.load_state_dict(encoder.state_dict())
    assert torch.equal(rebuilt.eval()({"cam1": pictures}), encoder.eval()({"cam1": pictures}))


def test_weights_that_do_not_fit_give_one_line(tmp_path):
    def refuse(words, **options):
        with pytest.raises(UserError, match=words) as caught:
            MultimodalEncoder(VIDEO, **{"network": "resnet18", "norm": "frozen", "width": 8, **options})
        assert "\n" not in str(caught.value)

    refuse("no such file", weights=str(tmp_path / "none.pth"))
    refuse("set norm: frozen", weights="any.pth", norm="group")
    broken = tmp_path / "broken.pth"
    broken.write_bytes(b"no pickle")
    refuse("not a readable state dict", weights=str(broken))
    state = torchvision.models.resnet18(weights=None).state_dict()
    file = tmp_path / "some.pth"
    torch.save({name: value for name, value in state.items() if name != "layer1.0.conv1.weight"}, file)
    refuse(r"'layer1.0.conv1.weight' is missing", weights=str(file))
    torch.save({**state, "head": torch.zeros(1)}, file)
    refuse("'head' is left over", weights=str(file))
    torch.save({**state, "conv1.weight": torch.zeros(64, 1, 7, 7)}, file)
    refuse(r"'conv1.weight' is \(64, 1, 7, 7\), the network has \(64, 3, 7, 7\)", weights=str(file))


def test_group_norm_by_default_and_any_channels():
    spec = DataSpec({"cam": ArraySpec((1, 2, 32, 32))})
    encoder = MultimodalEncoder(spec, network="resnet18", width=8, features=4)
    assert not any("running_mean" in name for name in encoder.state_dict())
    encoder(clips(2, spec=spec)).sum().backward()
    assert all(parameter.grad is not None for parameter in encoder.parameters())


def augmentation(**options):
    return SensorAugmentation(OF_SENSORS, ["orientation"], **{**OFF, **options})


def test_rotation_keeps_norms_and_is_shared_by_the_sensors_of_a_device():
    torch.manual_seed(0)
    batch = clips(6)
    batch["acceleration"][1, 3:5], batch["acceleration"][2, :, 3:] = torch.nan, torch.nan
    batch["acceleration"][0, 0, 1] = torch.nan  # a single axis
    turned = augmentation(rotation=30.0)(batch)
    assert turned["orientation"] is batch["orientation"] and turned["cam1"] is batch["cam1"]
    before, after = (one["acceleration"].unflatten(-1, (2, 3)) for one in (batch, turned))
    assert torch.equal(before.isnan(), after.isnan())
    torch.testing.assert_close(after.norm(dim=-1), before.norm(dim=-1), equal_nan=True)
    assert not torch.allclose(after, before, equal_nan=True)
    # The angle between a device's acceleration and rotation stays, which it does only if both turn alike.
    products = [(one["acceleration"][..., :3] * one["gyroscope"]).sum(-1) for one in (batch, turned)]
    torch.testing.assert_close(products[1], products[0], equal_nan=True, atol=1e-4, rtol=1e-4)
    crossed = [(one["acceleration"][..., 3:] * one["gyroscope"]).sum(-1) for one in (batch, turned)]
    assert not torch.allclose(crossed[0], crossed[1], equal_nan=True, atol=0.1), "devices turn by themselves"


def test_rotations_are_rotations_of_the_asked_size():
    vectors = torch.tensor([[0.0, 0.0, torch.pi / 2], [0.0, 0.0, 0.0], [0.3, -0.2, 0.9]])
    turns = rotation_matrices(vectors)
    torch.testing.assert_close(turns[0] @ torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0]))
    torch.testing.assert_close(turns[1], torch.eye(3))
    torch.testing.assert_close(turns @ turns.mT, torch.eye(3).repeat(3, 1, 1))
    torch.testing.assert_close(turns[2] @ vectors[2], vectors[2])


WATCH = DataSpec({name: ArraySpec((12, 3), "float32") for name in ("acceleration", "gyroscope")})


def test_reflection_is_what_a_mirrored_movement_measures():
    torch.manual_seed(0)
    mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
    poses = rotation_matrices(torch.randn(12, 3, dtype=torch.float64).cumsum(0) * 0.2)  # of the device in the world
    forces = torch.randn(12, 3, 1, dtype=torch.float64)

    def measured(poses, forces):
        turns = poses[:-1].mT @ poses[1:]
        turning = torch.stack([turns[:, 2, 1] - turns[:, 1, 2], turns[:, 0, 2] - turns[:, 2, 0],
                               turns[:, 1, 0] - turns[:, 0, 1]], dim=-1)  # fmt: skip
        turning = torch.cat([turning, turning[-1:]])
        return {"acceleration": (poses.mT @ forces).mT, "gyroscope": turning[None]}

    clip = {name: readings.reshape(1, 12, 3) for name, readings in measured(poses, forces).items()}
    expected = measured(mirror @ poses @ mirror, mirror @ forces)
    seen = SensorAugmentation(WATCH, [], **{**OFF, "reflection": 1.0})(clip)
    for name, readings in expected.items():
        torch.testing.assert_close(seen[name], readings.reshape(1, 12, 3))


def test_reflection_takes_whole_clips_by_chance_and_keeps_what_is_missing():
    torch.manual_seed(0)
    batch = {name: torch.randn(400, 12, 3) + 3 for name in WATCH.observations}
    batch["acceleration"][5, 2:4] = torch.nan
    seen = SensorAugmentation(WATCH, [], **{**OFF, "reflection": 0.25})(batch)
    turned = {name: (seen[name] != batch[name]) & batch[name].isfinite() for name in batch}
    mirrored = turned["gyroscope"][:, 0, 1]
    assert 0.18 < mirrored.float().mean() < 0.32
    assert torch.equal(turned["gyroscope"][:, :, 1], mirrored[:, None].expand(-1, 12))
    assert torch.equal(turned["acceleration"][:, 0, 0], mirrored), "both sensors of a clip alike"
    assert torch.equal(seen["acceleration"].isnan(), batch["acceleration"].isnan())
    assert not turned["acceleration"][..., 1:].any() and not turned["gyroscope"][..., 0].any()


def test_scaling_is_one_factor_for_each_clip_and_sensor_and_leaves_angles():
    torch.manual_seed(0)
    batch = clips(200)
    scaled = augmentation(scaling=0.1)(batch)
    assert scaled["orientation"] is batch["orientation"]
    factors = {name: (scaled[name] / batch[name]).flatten(1) for name in ("acceleration", "gyroscope")}
    for factor in factors.values():
        torch.testing.assert_close(factor, factor[:, :1].expand_as(factor))
        assert 0.08 < factor[:, 0].std() < 0.12 and abs(factor[:, 0].mean() - 1) < 0.03
    assert not torch.allclose(factors["acceleration"][:, 0], factors["gyroscope"][:, 0])


def test_jitter_is_measured_in_deviations_of_the_channel():
    torch.manual_seed(0)
    batch = clips(100)
    batch["gyroscope"][3] = torch.nan
    noise = augmentation(jitter=0.25)(batch)["acceleration"] - batch["acceleration"]
    assert abs(noise.std() - 0.5) < 0.02  # the channels' deviation is 2
    assert augmentation(jitter=0.25)(batch)["gyroscope"][3].isnan().all()


def test_time_warp_plays_faster_or_slower():
    clip = torch.arange(8.0).view(1, 8, 1).repeat(3, 1, 2)
    played = at_speed(clip, torch.tensor([[1.0], [2.0], [0.5]]))[..., 0]
    assert torch.equal(played[0], clip[0, :, 0])
    assert played[1, :4].tolist() == [0, 2, 4, 6] and played[1, 4:].isnan().all()
    assert played[2].tolist() == [0, 0, 1, 2, 2, 2, 3, 4]  # halves go to the even
    torch.manual_seed(0)
    batch = {name: torch.arange(20.0).view(1, 20, 1).repeat(4, 1, SPEC.observations[name].shape[1]) for name in SENSORS}
    warped = augmentation(time_warp=0.2)(batch)
    firsts = [warped[name][..., 0] for name in SENSORS]
    assert all(torch.equal(first.nan_to_num(-1), firsts[0].nan_to_num(-1)) for first in firsts)
    assert not torch.equal(firsts[0][0].nan_to_num(-1), firsts[0][1].nan_to_num(-1))


def test_evaluation_is_not_augmented():
    batch = clips()
    module = augmentation(rotation=30.0, scaling=0.1, jitter=0.1, time_warp=0.1)
    assert module.eval()(batch) is batch
    before = {name: array.clone() for name, array in batch.items()}
    module.train()(batch)
    assert all(torch.equal(array, before[name]) for name, array in batch.items()), "the batch itself stays"


def test_rotation_needs_triples_of_axes():
    spec = DataSpec({"acceleration": ArraySpec((20, 4), "float32")})
    with pytest.raises(UserError, match="'acceleration', whose 4 channels are no triples"):
        SensorAugmentation(spec, [], **{**OFF, "rotation": 5.0})
    with pytest.raises(UserError, match="reflection of 'acceleration', whose 4 channels are no triples"):
        SensorAugmentation(spec, [], **{**OFF, "reflection": 0.5})


def test_modality_dropout_never_drops_the_last_nor_brings_one_back():
    torch.manual_seed(0)
    present = torch.rand(5000, 4) < 0.6
    present[:100] = False
    kept = drop_modalities(present, 0.7)
    assert not (kept & ~present).any()
    assert torch.equal(kept.any(1), present.any(1))
    several = present.sum(1) == 4
    assert (kept[several].sum(1) < 4).any() and several.sum() > 400
    shares = kept[several].float().mean(0)
    # Kept with 0.3, or as the one that was spared of four: 0.3 + 0.7 ** 4 / 4.
    assert ((shares - 0.36).abs() < 0.09).all()
    assert drop_modalities(present, 0.0) is present
