"""A data set encoded once: latents and codes in place of pictures, all else as it was."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from repdib_lightning.__main__ import main
from repdib_lightning.bottlenecks import Identity, VectorQuantiser
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.encoded_store import encode_store
from repdib_lightning.evaluation.features import encode_rows
from repdib_lightning.export import load_encoder, save_bundle
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec


def bundle(folder: Path, quantised: bool, stack: int = 2, **data) -> Path:
    torch.manual_seed(0)
    spec = DataSpec({"front": ArraySpec((3 * stack, 24, 24))}, None, stack)
    encoder = ConvolutionalEncoder(spec, features=8, channels=4, strides=[3, 2])
    bottleneck = Identity(8)
    if quantised:
        bottleneck = VectorQuantiser(8, groups=2, codes=5, start_step=0)
        bottleneck(torch.randn(64, 8))
    return save_bundle(folder / "bundle", encoder.eval(), bottleneck.eval(), training={}, data=data)


@pytest.mark.parametrize("quantised", [True, False])
def test_vectors_are_those_of_the_encoder_and_the_rest_stays(tmp_path, make_store, quantised):
    data = make_store(tmp_path / "a.h5", kind="continuous")
    folder = bundle(tmp_path, quantised)
    encoded = EpisodeStore(encode_store(folder, data, tmp_path / "b.h5", device="cpu", progress=False))
    store, encoder = EpisodeStore(data), load_encoder(folder)
    latents, codes = encode_rows(encoder, store, np.arange(store.rows), progress=False)
    np.testing.assert_allclose(encoded.array("observations/latent"), latents, atol=1e-6)
    assert list(encoded.observations) == (["codes", "latent"] if quantised else ["latent"])
    if quantised:
        assert np.array_equal(encoded.array("observations/codes"), codes)
    for name in ("actions", "factors/cell", "factors/light"):
        assert np.array_equal(encoded.array(name), store.array(name)), name
    assert encoded.factors == store.factors and np.array_equal(encoded.evaluation, store.evaluation)
    assert np.array_equal(encoded.lengths, store.lengths) and "rewards" not in encoded
    told = json.loads(encoded.attributes["encoded"])
    assert told["fingerprint"] == store.fingerprint and told["encoder"]["features"] == 8


def test_rewards_and_ends_stay(tmp_path):
    random = np.random.default_rng(0)
    writer = EpisodeWriter(tmp_path / "a.h5", rows=12, episodes=2, observations={"front": ArraySpec((3, 24, 24))},
                           actions=ActionSpec("continuous", 2), rewards=True)  # fmt: skip
    with writer:
        for _ in range(2):
            pictures = random.integers(256, size=(6, 3, 24, 24), dtype=np.uint8)
            ends = {"terminations": np.arange(5) == 4, "truncations": np.zeros(5, bool)}
            writer.add_episode(observations={"front": pictures}, actions=np.zeros((5, 2), np.float32),
                               rewards=random.random(5).astype(np.float32), **ends)  # fmt: skip
    made = encode_store(bundle(tmp_path, False), tmp_path / "a.h5", tmp_path / "b.h5", progress=False)
    before, after = EpisodeStore(tmp_path / "a.h5"), EpisodeStore(made)
    for name in ("rewards", "terminations", "truncations"):
        assert np.array_equal(before.array(name), after.array(name)), name


def test_recordings_names_and_attributes_stay_and_those_of_lost_observations_go(tmp_path):
    told = {"rate": {"front": 30}, "channels": {"front": ["r"]}, "source": "people", "seed": 3}
    told["classes"] = {"who": ["Ann", "Bob"]}
    writer = EpisodeWriter(tmp_path / "a.h5", rows=8, episodes=8, observations={"front": ArraySpec((3, 24, 24))},
                           actions=None, factors={"who": FactorSpec("exogenous", "categorical", 2)}, attributes=told,
                           recordings=True)  # fmt: skip
    pictures = np.random.default_rng(0).integers(256, size=(8, 1, 3, 24, 24), dtype=np.uint8)
    with writer:
        for clip in range(8):
            writer.add_episode(observations={"front": pictures[clip]}, factors={"who": np.array([clip // 4])},
                               evaluation=clip > 5, recording=clip // 2)  # fmt: skip
    made = EpisodeStore(encode_store(bundle(tmp_path, False, 1), tmp_path / "a.h5", tmp_path / "b.h5", progress=False))
    store = EpisodeStore(tmp_path / "a.h5")
    assert np.array_equal(made.recordings, store.recordings) and made.recordings.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert made.class_names == store.class_names == {"who": ["Ann", "Bob"]} and made.factors == store.factors
    assert np.array_equal(made.evaluation, store.evaluation) and store.evaluation.any()
    assert made.attributes["source"] == "people" and made.attributes["seed"] == 3
    assert not {"rate", "channels"} & set(made.attributes)
    held_out = bundle(tmp_path / "other", False, 1, held_out={"who": ["Ann"]})
    other = EpisodeStore(encode_store(held_out, tmp_path / "a.h5", tmp_path / "c.h5", progress=False))
    assert other.evaluation.tolist() == [True] * 4 + [False] * 4, "who the encoder never saw"


def test_bad_input_is_one_line_and_nothing_is_written(tmp_path, make_store, capsys):
    data = make_store(tmp_path / "a.h5")
    folder = bundle(tmp_path, True)
    with pytest.raises(UserError, match="OUTPUT would replace"):
        encode_store(folder, data, data)
    with pytest.raises(UserError, match=r"must end in \.h5"):
        encode_store(folder, data, tmp_path / "b.hdf")
    other = make_store(tmp_path / "c.h5", size=16)
    assert main(["encode", str(folder), str(other), str(tmp_path / "b.h5")]) == 2
    assert "error:" in capsys.readouterr().err and not list(tmp_path.glob("*b.h5*"))
