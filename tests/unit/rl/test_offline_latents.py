"""What offline agents see: latents that are encoded once, their statistics, and pictures."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch
from offline_stores import VIEW, make_bundle, write_offline

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.sampling import gather_stacks
from repdib_lightning.errors import UserError
from repdib_lightning.export import load_encoder
from repdib_lightning.records import ArraySpec, DataSpec
from repdib_lightning.rl.networks import ShiftedPictures, StandardisedLatents
from repdib_lightning.rl.row_sources import Latents, Pictures

TRAINING = [0, 1, 3, 4, 5]


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return EpisodeStore(write_offline(tmp_path_factory.mktemp("latents") / "data.h5"))


@pytest.fixture(scope="module", params=["identity, stack of 3", "repdib"])
def encoder(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp("bundles")
    quantised = request.param == "repdib"
    return load_encoder(make_bundle(folder / "b", stack=1 if quantised else 3, quantised=quantised))


def training_rows(store):
    return np.flatnonzero(np.isin(store.row_episodes, TRAINING))


def encoded(store, encoder, rows):
    """The same, one row after the other."""
    stacks = gather_stacks(store, VIEW, rows, encoder.spec.frame_stack)
    return torch.stack([encoder.encode({VIEW: stack}) for stack in stacks])


def random():
    return np.random.default_rng(0)


def test_latents_are_those_of_the_encoder(store, encoder):
    latents = Latents(store, encoder, progress=False)
    rows = random().permutation(training_rows(store))
    found = latents.rows(rows, random())
    assert found.dtype == torch.float32 and found.shape == (len(rows), encoder.features)
    torch.testing.assert_close(found, encoded(store, encoder, rows), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("copies", [1, 3])
def test_every_frame_is_encoded_once_a_copy(store, encoder, monkeypatch, copies):
    seen = []
    for name in ("encode", "encode_with_codes"):
        encode = getattr(type(encoder), name)

        def counted(self, observations, encode=encode):
            seen.append(len(observations[VIEW]))
            return encode(self, observations)

        monkeypatch.setattr(type(encoder), name, counted)
    latents = Latents(store, encoder, copies=copies, progress=False)
    assert sum(seen) == copies * len(training_rows(store))
    for _ in range(3):
        latents.rows(training_rows(store), random())
    assert sum(seen) == copies * len(training_rows(store))


def test_further_copies_are_shifted(store, encoder):
    one, four = (Latents(store, encoder, copies=n, shift=2, progress=False).copies for n in (1, 4))
    np.testing.assert_array_equal(four[0], one[0])
    differs = (np.abs(four[1:] - four[:1]) > 1e-3).any(axis=-1)
    assert (differs.mean(axis=1) > 0.6).all()  # one picture in 25 is moved by nothing, and codes may stay
    assert (np.abs(four[1] - four[2]) > 1e-3).any() and (np.abs(four[2] - four[3]) > 1e-3).any()
    still = Latents(store, encoder, copies=2, shift=0, progress=False).copies
    np.testing.assert_array_equal(still[1], one[0])


def test_a_seed_decides_the_shifts(store, encoder):
    def copies(seed):
        return Latents(store, encoder, copies=2, seed=seed, progress=False).copies[1]

    np.testing.assert_array_equal(copies(1), copies(1))
    assert (copies(1) != copies(2)).any()


def test_a_batch_draws_each_copy_as_often(store, encoder):
    latents = Latents(store, encoder, copies=4, progress=False)
    latents.copies = np.broadcast_to(np.arange(4.0)[:, None, None], latents.copies.shape)  # tells the copy
    rows = np.repeat(training_rows(store), 200)
    found = latents.rows(rows, random())[:, 0].numpy().reshape(-1, 200)
    for drawn in found:
        counts = np.bincount(drawn.astype(int), minlength=4)
        assert np.abs(counts - 50).max() < 5 * np.sqrt(200 * 3 / 16)


def test_statistics_are_those_of_the_training_rows(store, encoder):
    for copies in (1, 2):
        latents = Latents(store, encoder, copies=copies, progress=False)
        assert latents.copies.shape == (copies, len(training_rows(store)), encoder.features)
        every = latents.copies.reshape(-1, encoder.features).astype(np.float64)
        np.testing.assert_allclose(latents.mean, every.mean(0), atol=1e-6)
        np.testing.assert_allclose(latents.deviation, every.std(0), atol=1e-6)


def test_held_out_episodes_are_not_looked_at(store, encoder, tmp_path):
    path = write_offline(tmp_path / "b.h5")
    with h5py.File(path, "a") as file:
        file[f"observations/{VIEW}"][11:17] = 255
    ours, other = (Latents(s, encoder, progress=False) for s in (store, EpisodeStore(path)))
    assert torch.equal(ours.mean, other.mean) and torch.equal(ours.deviation, other.deviation)
    with pytest.raises(AssertionError):
        ours.rows(np.array([0, 12]), random())


def test_an_encoder_that_returns_nan_is_refused(store, encoder, monkeypatch):
    bad = type(encoder)._run

    def spoilt(self, observations):
        latent, codes = bad(self, observations)
        latent[3] = float("nan")
        return latent, codes

    monkeypatch.setattr(type(encoder), "_run", spoilt)
    with pytest.raises(UserError, match=r"returns NaN or infinite values at row 3$"):
        Latents(store, encoder, progress=False)


def test_standardised_latents_have_mean_0_and_deviation_1():
    raw = torch.randn(500, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.1, 1.0, 20.0]) + 5.0
    module = StandardisedLatents(raw.mean(0), raw.std(0, correction=0))
    found = module(raw)
    torch.testing.assert_close(found.mean(0), torch.zeros(3), rtol=0, atol=1e-5)
    torch.testing.assert_close(found.std(0, correction=0), torch.ones(3), rtol=1e-5, atol=0)
    assert not list(module.parameters()) and set(module.state_dict()) == {"mean", "scale"}


def test_constant_dimensions_say_nothing():
    raw = torch.randn(500, 4, generator=torch.Generator().manual_seed(0))
    raw[:, 1], raw[:, 2] = 0.3, 0.7 + 1e-6 * raw[:, 2]  # constant, and constant but for rounding
    module = StandardisedLatents(raw.mean(0), raw.std(0, correction=0))
    found = module(raw + torch.tensor([0.0, 50.0, 50.0, 0.0]))
    assert not found[:, 1:3].any() and found.isfinite().all()
    torch.testing.assert_close(found[:, [0, 3]].std(0, correction=0), torch.ones(2))
    nothing = StandardisedLatents(torch.ones(4), torch.zeros(4))
    assert not nothing(torch.full((2, 4), 3.0)).any()


def test_a_constant_dimension_stays_constant_over_many_rows(store, encoder, monkeypatch):
    """Sums of float32 in order of rows would move it by more than other dimensions vary."""
    many = np.full((400_000, encoder.features), 0.1, np.float32)
    many[:, 0] = np.random.default_rng(0).normal(size=len(many)) * 1e-2
    monkeypatch.setattr("repdib_lightning.rl.row_sources.encode_rows", lambda *_, **__: (many, None))
    latents = Latents(store, encoder, progress=False)
    assert latents.mean[1] == np.float32(0.1) and latents.deviation[1] == 0.0
    assert latents.deviation[0] == pytest.approx(1e-2, rel=1e-2)


def test_pictures_are_stacked_within_their_episode(store):
    spec = DataSpec({VIEW: ArraySpec((9, 8, 8))}, frame_stack=3)
    frames = store.array(f"observations/{VIEW}")
    found = Pictures(store, spec).rows(np.array([9, 10, 20, 0]), random())[VIEW]  # an episode begins at row 9
    for stack, rows in zip(found, [[9, 9, 9], [9, 9, 10], [18, 19, 20], [0, 0, 0]], strict=True):
        np.testing.assert_array_equal(stack, np.concatenate([frames[row] for row in rows]))
    assert found.dtype == torch.uint8 and found.shape == (4, 9, 8, 8)


def test_pictures_are_shifted_while_an_encoder_is_trained(store):
    spec = DataSpec({VIEW: ArraySpec((3, 8, 8))})
    seen = []

    class Looks(torch.nn.Module):
        def forward(self, observations):
            seen.append(observations[VIEW])
            return observations[VIEW].flatten(1)

    module = ShiftedPictures(Looks(), 2)
    given = Pictures(store, spec).rows(np.arange(20), random())
    torch.manual_seed(0)
    module.train()(given)
    module.train()(given)
    module.eval()(given)
    moved = [(one != given[VIEW]).flatten(1).any(1).float().mean() for one in seen]
    assert moved[0] > 0.7 and moved[1] > 0.7 and moved[2] == 0.0 and not torch.equal(seen[0], seen[1])
    inner = slice(2, 6)
    for before, after in zip(given[VIEW], seen[0], strict=True):
        windows = before.unfold(1, 4, 1).unfold(2, 4, 1)  # (3, 5, 5, 4, 4): every shift by up to 2
        assert (windows == after[:, None, None, inner, inner]).all(-1).all(-1).all(0).any()
