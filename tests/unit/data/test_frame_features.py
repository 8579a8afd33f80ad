"""Videos as features of frames: what a row becomes, what stays, and which weights are taken."""

import hashlib
import json

import h5py
import numpy as np
import pytest
import torch
import torchvision
from clip_stores import SENSORS, VIEWS, write_clips
from safetensors.torch import save_file

from repdib_lightning.__main__ import main
from repdib_lightning.data import frame_network
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.frame_features import store_features
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.records import ArraySpec


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "clips.h5"
    told = {"environment": "people", "channels": {"gyroscope": ["x"]}}
    return write_clips(path, clips=20, size=8, per_recording=2, evaluation=("2",), attributes=told)


@pytest.fixture(scope="module")
def state():
    torch.manual_seed(3)
    return torchvision.models.resnet18(weights=None).state_dict()


def made(data, output, **options):
    return EpisodeStore(store_features(data, output, **{"device": "cpu", "progress": False} | options))


@pytest.fixture(scope="module")
def features(data, tmp_path_factory):
    return made(data, tmp_path_factory.mktemp("made") / "features.h5")


def test_every_frame_is_encoded_and_what_is_missing_stays_missing(data, features):
    store = EpisodeStore(data)
    for view in VIEWS:
        frames, found = store.array(f"observations/{view}"), features.array(f"observations/{view}")
        assert features.observations[view] == ArraySpec((4, 512), "float32") and features.observations[view].is_sequence
        seen = frames.any(axis=(2, 3, 4))
        assert 0 < seen.sum() < seen.size
        assert np.isfinite(found[seen]).all() and np.isnan(found[~seen]).all()
        assert found[seen].std(0).max() > 1e-3


def test_all_else_stays(data, features):
    store = EpisodeStore(data)
    for name in (*(f"observations/{sensor}" for sensor in SENSORS), "factors/activity", "factors/subject"):
        np.testing.assert_array_equal(features.array(name), store.array(name))
    assert features.factors == store.factors and features.class_names == store.class_names
    for name in ("evaluation", "recordings", "lengths"):
        assert np.array_equal(getattr(features, name), getattr(store, name)), name
    assert features.attributes["channels"] == store.attributes["channels"]
    assert features.attributes["environment"] == "people" and store.evaluation.any()
    assert recompute_fingerprint(features) == features.fingerprint


def test_features_do_not_depend_on_the_batch_or_the_row(data, features, tmp_path):
    other = made(data, tmp_path / "b.h5", batch=3)
    for view in VIEWS:
        np.testing.assert_allclose(
            other.array(f"observations/{view}"), features.array(f"observations/{view}"), atol=1e-5
        )


def test_features_are_those_of_torchvision(data, state, tmp_path):
    torch.save(state, tmp_path / "resnet.pth")
    found = made(data, tmp_path / "b.h5", weights=tmp_path / "resnet.pth", views="cam2")
    network = torchvision.models.resnet18(weights=None)
    network.load_state_dict(state)
    network.fc = torch.nn.Identity()
    row = 5
    frames = torch.from_numpy(EpisodeStore(data).array("observations/cam2")[row][:2].copy())
    mean, std = np.array(frame_network.MEAN), np.array(frame_network.STD)
    normal = torchvision.transforms.functional.normalize(frames / 255, mean.tolist(), std.tolist())
    with torch.inference_mode():
        expected = network.eval()(normal).numpy()
    np.testing.assert_allclose(found.array("observations/cam2")[row][:2], expected, atol=1e-4, rtol=1e-4)
    assert np.array_equal(found.array("observations/cam1"), EpisodeStore(data).array("observations/cam1"))
    told = json.loads(found.attributes["frame_features"])
    assert told["sha256"] == hashlib.sha256((tmp_path / "resnet.pth").read_bytes()).hexdigest()
    assert told["architecture"] == "resnet18" and told["views"] == "cam2" and told["weights"] == "resnet.pth"
    assert told["fingerprint"] == EpisodeStore(data).fingerprint


def test_file_forms_agree_and_the_last_layer_is_passed_over(data, state, tmp_path):
    torch.save(state, tmp_path / "a.pth")
    without = {name: tensor for name, tensor in state.items() if "fc." not in name and "tracked" not in name}
    save_file(without, tmp_path / "b.safetensors")
    odd = {**state, "fc.weight": torch.zeros(7, 512), "fc.bias": torch.full((7,), torch.nan)}
    torch.save(odd, tmp_path / "c.pth")
    found = [
        made(data, tmp_path / f"{name}.h5", weights=tmp_path / name).array("observations/cam1")
        for name in ("a.pth", "b.safetensors", "c.pth")
    ]
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


def test_random_weights_are_of_their_seed_and_said_to_be_random(data, features, tmp_path, capsys):
    before = torch.random.get_rng_state()
    again, other = made(data, tmp_path / "b.h5"), made(data, tmp_path / "c.h5", seed=1)
    assert "no --weights, those of the resnet18 are random (seed 0)" in capsys.readouterr().err
    assert torch.equal(before, torch.random.get_rng_state())
    assert again.fingerprint == features.fingerprint != other.fingerprint
    told = [json.loads(store.attributes["frame_features"])["sha256"] for store in (features, again, other)]
    assert told[0] == told[1] != told[2]


@pytest.mark.parametrize("stop", [0, 1, 7, 19])
def test_the_same_bytes_after_an_interruption(data, features, tmp_path, monkeypatch, stop):
    add, done = EpisodeWriter.add_episode, []

    def interrupted(self, **arguments):
        if len(done) == stop:
            raise KeyboardInterrupt
        done.append(add(self, **arguments))

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(EpisodeWriter, "add_episode", interrupted)
        made(data, tmp_path / "b.h5")
    assert not (tmp_path / "b.h5").exists()
    made(data, tmp_path / "b.h5")
    assert (tmp_path / "b.h5").read_bytes() == features.path.read_bytes()


def test_episodes_are_encoded_in_the_same_company_after_an_interruption(data, tmp_path, monkeypatch):
    def told_of_company(network, frames, batch):
        return np.full((len(frames), network.width), frames.mean(), np.float32)

    monkeypatch.setattr(frame_network.FrameNetwork, "features_of", told_of_company)
    whole = made(data, tmp_path / "a.h5", batch=12)  # three clips at a time
    add = EpisodeWriter.add_episode
    for stop in (4, 5, 6, 8):

        def interrupted(self, *, stop=stop, **arguments):
            if self.episodes_done == stop:
                raise KeyboardInterrupt
            add(self, **arguments)

        with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
            patched.setattr(EpisodeWriter, "add_episode", interrupted)
            made(data, tmp_path / "b.h5", batch=12)
    assert made(data, tmp_path / "b.h5", batch=12).fingerprint == whole.fingerprint


def test_wide_networks_and_grey_frames(tmp_path):
    specs = {"grey": ArraySpec((2, 1, 8, 8)), "colour": ArraySpec((2, 3, 8, 8)), "still": ArraySpec((3, 8, 8))}
    grey = np.random.default_rng(0).integers(1, 256, (3, 2, 1, 8, 8), dtype=np.uint8)
    still = np.ones((3, 3, 8, 8), np.uint8)
    with EpisodeWriter(
        tmp_path / "a.h5", rows=3, episodes=1, observations=specs, actions=None, masks={"still": (8, 8)}
    ) as writer:
        shown = {"grey": grey, "colour": grey.repeat(3, axis=2), "still": still}
        writer.add_episode(observations=shown, masks={"still": still[:, 0] > 0})
    found = made(tmp_path / "a.h5", tmp_path / "b.h5", architecture="resnet50")
    assert found.observations["grey"].shape == (2, 2048)
    np.testing.assert_array_equal(found.array("observations/grey"), found.array("observations/colour"))
    np.testing.assert_array_equal(found.array("observations/still"), still)
    assert found.mask("still", np.arange(3)).all()


@pytest.mark.parametrize(
    ("content", "architecture", "message"),
    [
        (None, "resnet18", r"--weights .*w\.pth: no such file; leave the option out"),
        (b"text", "resnet18", r"w\.pth: not a readable file of weights \(IndexError"),
        ("nested", "resnet18", r"holds a dict of state_dict, epoch; save the state_dict\(\)"),
        ("list", "resnet18", r"holds list; save the state_dict"),
        ("whole", "resnet34", r"holds a resnet18, --architecture is resnet34"),
        ("whole", "resnet50", r"holds a resnet18, --architecture is resnet50"),
        (
            "short",
            "resnet18",
            r"is not torchvision's resnet18: 'conv1\.weight' is absent there, must be 64 x 3 x 7 x 7",
        ),
        ("long", "resnet18", r"is not torchvision's resnet18: 'head\.weight' is 2 there, must be absent"),
        ("nan", "resnet18", r"'conv1\.weight' holds NaN or infinite values"),
        (b"other.safetensors", "resnet18", r"not a readable file of weights \(SafetensorError"),
    ],
)
def test_wrong_weights_are_one_line(data, state, tmp_path, content, architecture, message):
    path = tmp_path / ("w.safetensors" if content == b"other.safetensors" else "w.pth")
    forms = {
        "nested": {"state_dict": state, "epoch": 3},
        "list": [1, 2],
        "whole": state,
        "short": {name: tensor for name, tensor in state.items() if name != "conv1.weight"},
        "long": {**state, "head.weight": torch.zeros(2)},
        "nan": {**state, "conv1.weight": torch.full((64, 3, 7, 7), torch.nan)},
    }
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        torch.save(forms[content], path)
    with pytest.raises(UserError, match=message) as error:
        made(data, tmp_path / "b.h5", architecture=architecture, weights=path)
    assert "\n" not in str(error.value) and not list(tmp_path.glob("*b.h5*"))


def test_a_file_that_would_run_code_is_not_run(data, tmp_path):
    class Harmful:
        def __reduce__(self):
            return (exec, (f"open({str(tmp_path / 'ran')!r}, 'w')",))

    torch.save({"conv1.weight": Harmful()}, tmp_path / "w.pth")
    with pytest.raises(UserError, match="not a readable file of weights"):
        made(data, tmp_path / "b.h5", weights=tmp_path / "w.pth")
    assert not (tmp_path / "ran").exists()


def test_the_verb_and_its_mistakes(data, store_file, tmp_path, capsys):
    output = str(tmp_path / "b.h5")
    assert main(["features", str(data), output, "--views", "cam1", "--device", "cpu", "--progress", "false"]) == 0
    assert EpisodeStore(output).observations["cam2"].is_video and "wrote" in capsys.readouterr().out
    for arguments, message in (
        ([str(data), output], "exists already"),
        ([str(data), str(data)], "OUTPUT would replace"),
        ([str(data), output, "--overwrite", "--views", "cam3"], "has no video 'cam3', did you mean 'cam"),
        ([str(store_file), str(tmp_path / "c.h5")], "has no video (observations: front, top)"),
        ([str(data), str(tmp_path / "c.h5"), "--batch", "0"], "--batch must be at least 1"),
        ([str(data), str(tmp_path / "c.h5"), "--architecture", "resnet19"], "resnet18"),
    ):
        assert main(["features", *arguments]) == 2
        told = capsys.readouterr().err
        assert message in told and told.count("\n") == 1, told


def test_chunked_stores_are_read_alike(data, features, tmp_path):
    with h5py.File(data) as source, h5py.File(tmp_path / "a.h5", "w") as copy:
        for key in source:
            source.copy(key, copy)
        copy.attrs.update(source.attrs)
        frames = copy["observations/cam1"][:]
        del copy["observations/cam1"]
        copy.create_dataset("observations/cam1", data=frames, chunks=(3, *frames.shape[1:]), compression="gzip")
    assert made(tmp_path / "a.h5", tmp_path / "b.h5").fingerprint == features.fingerprint
