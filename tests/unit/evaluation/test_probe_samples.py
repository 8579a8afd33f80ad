"""The file of latents, factors and drawings that figures are made from, and what ``probe`` puts into it."""

import json

import numpy as np
import pytest
import torch
from evaluation_fakes import LENGTH, write_store

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation import probe as probe_module
from repdib_lightning.evaluation.decoder import Drawings
from repdib_lightning.evaluation.probe import probe_bundle
from repdib_lightning.evaluation.samples import ProbeSamples, read_samples
from repdib_lightning.export import save_bundle
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec


def make(drawings=True):
    generator = np.random.default_rng(0)
    views = {view: generator.integers(0, 256, (2, 3, 4, 4), dtype=np.uint8) for view in ("front", "top/left")}
    drawn = {view: 255 - pixels for view, pixels in views.items()}
    return ProbeSamples(
        rows=np.arange(5) * 7,
        latents=generator.normal(size=(5, 3)).astype(np.float32),
        factors={"cell": np.arange(5), "lamp": generator.uniform(size=(5, 2)), "drawn/odd": np.zeros(5)},
        drawings=Drawings(np.array([3, 4]), views, drawn) if drawings else None,
    )


def assert_equal(found, expected):
    if isinstance(expected, dict):
        assert list(found) == list(expected)
        for name in expected:
            assert_equal(found[name], expected[name])
    else:
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)


def test_what_is_read_is_what_was_written(tmp_path):
    samples = make()
    samples.write(tmp_path / "new" / "probe.npz")
    found = read_samples(tmp_path / "new" / "probe.npz")
    for name in ("rows", "latents", "factors"):
        assert_equal(getattr(found, name), getattr(samples, name))
    for name in ("rows", "frames", "drawn"):
        assert_equal(getattr(found.drawings, name), getattr(samples.drawings, name))
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["probe.npz"]


def test_drawings_may_be_absent(tmp_path):
    make(drawings=False).write(tmp_path / "probe.npz")
    found = read_samples(tmp_path / "probe.npz")
    assert found.drawings is None and list(found.factors) == ["cell", "lamp", "drawn/odd"]


def test_nothing_is_pickled_and_a_refused_file_leaves_none(tmp_path):
    samples = make()
    samples.factors["cell"] = np.array([{"a": 1}] * 5, dtype=object)
    with pytest.raises(ValueError, match=r"(?i)object arrays"):
        samples.write(tmp_path / "probe.npz")
    assert list(tmp_path.iterdir()) == []


class Trap:
    """Pickles to a call that leaves a file behind."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (open, (str(self.path), "w"))


def test_a_pickle_inside_the_file_is_not_run(tmp_path):
    rows = np.empty(1, dtype=object)
    rows[0] = Trap(tmp_path / "sprung")
    np.savez(tmp_path / "probe.npz", rows=rows, latents=np.zeros((1, 2)), allow_pickle=True)
    with pytest.raises(UserError, match=r"probe\.npz: not the samples of a probe"):
        read_samples(tmp_path / "probe.npz")
    assert not (tmp_path / "sprung").exists()


def damage(kind, path):
    whole = path.read_bytes()
    if kind == "cut":
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "text":
        path.write_text("not a picture\n")
    elif kind == "overwritten":  # inside the compressed data of an array
        path.write_bytes(whole[:60] + b"\xff" * 80 + whole[140:])
    elif kind == "one array":
        with open(path, "wb") as file:
            np.save(file, np.zeros(3))
    elif kind == "other arrays":
        np.savez(path, rows=np.zeros(3))
    elif kind == "folder":
        path.unlink()
        path.mkdir()
    else:
        path.unlink()


@pytest.mark.parametrize(
    "kind", ["cut", "empty", "text", "overwritten", "one array", "other arrays", "folder", "absent"]
)
def test_a_damaged_file_is_told_by_name_in_one_line(tmp_path, kind):
    path = tmp_path / "probe.npz"
    make().write(path)
    damage(kind, path)
    with pytest.raises(UserError, match=r"probe\.npz: not the samples of a probe .*; run the probe again") as error:
        read_samples(path)
    assert "\n" not in str(error.value)


def test_every_single_damaged_byte_is_read_as_written_or_refused(tmp_path):
    """Whatever zip, zlib and numpy may raise becomes a UserError."""
    path = tmp_path / "probe.npz"
    make(drawings=False).write(path)
    whole = path.read_bytes()
    refused = 0
    for place in range(0, len(whole), 3):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x5A]) + whole[place + 1 :])
        try:
            read_samples(path)
        except UserError:
            refused += 1
    assert refused > 100


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("samples") / "arm.h5")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    torch.manual_seed(0)
    spec = DataSpec({"front": ArraySpec((3, 16, 16))}, ActionSpec("discrete", 5))
    encoder = ConvolutionalEncoder(spec, features=8, channels=4, strides=[2, 2])
    return save_bundle(tmp_path_factory.mktemp("bundle") / "bundle", encoder, Identity(8), training={}, data={})


def test_a_bundle_is_probed_with_the_decoder_and_its_samples_kept(tmp_path, monkeypatch, store, bundle):
    monkeypatch.setattr(probe_module, "MOST", 100)
    report = probe_bundle(
        bundle,
        store.path,
        output=tmp_path / "probe.json",
        samples=tmp_path / "probe.npz",
        probes="linear,decoder",
        device="cpu",
        progress=False,
    )
    assert report.probes == ["linear"]  # of the factors
    assert list(report.pictures.regions) == ["picture"] and report.pictures.fit_rows == 4 * LENGTH
    # One corner of 16 of the picture shows the cell; its variance is nearly all that there is.
    assert report.pictures.regions["picture"].kept > 0.8
    written = json.loads((tmp_path / "probe.json").read_text())
    assert written["pictures"]["regions"]["picture"]["kept"] == report.pictures.regions["picture"].kept

    samples = read_samples(tmp_path / "probe.npz")
    assert samples.rows.shape == (100,) and samples.latents.shape == (100, 8)
    assert np.isin(store.row_episodes[samples.rows], report.fit_episodes + report.score_episodes).all()
    assert np.ptp(samples.rows) > 400  # over all episodes
    for name in store.factors:
        assert_equal(samples.factors[name], store.gather(f"factors/{name}", samples.rows))
    assert np.isin(store.row_episodes[samples.drawings.rows], report.score_episodes).all()
    assert_equal(samples.drawings.frames["front"], store.gather("observations/front", samples.drawings.rows))
    cells = np.array([0, 60, 120, 180])[store.gather("factors/cell", samples.drawings.rows)]
    np.testing.assert_allclose(samples.drawings.drawn["front"][:, :, :4, :4].mean((1, 2, 3)), cells, atol=40)


def test_latents_of_the_samples_belong_to_their_rows(tmp_path, store, bundle):
    probe_bundle(bundle, store.path, samples=tmp_path / "a.npz", probes="linear", device="cpu", progress=False)
    samples = read_samples(tmp_path / "a.npz")
    assert samples.drawings is None
    cells = samples.factors["cell"]
    spread = np.mean([samples.latents[cells == cell].std(0).mean() for cell in range(4)])
    assert spread < 0.5 * samples.latents.std(0).mean()  # the latent is mostly the cell


def test_bad_options_of_the_decoder_and_the_samples_are_found_before_the_work(tmp_path, monkeypatch, store, bundle):
    monkeypatch.setattr(probe_module, "encode_rows", lambda *_, **__: pytest.fail("encoded before the checks"))
    (tmp_path / "file").touch()
    for options, words in (
        ({"probes": "decoder"}, r"probes: at least one of the factors is needed, .*linear"),
        ({"probes": "linear,decodr"}, r"unknown probe 'decodr'.*did you mean 'decoder'"),
        ({"samples": tmp_path / "x.json"}, r"--samples must end in \.npz"),
        ({"samples": tmp_path / "file" / "x.npz"}, r"--samples .*x\.npz: cannot be written"),
    ):
        with pytest.raises(UserError, match=words) as error:
            probe_bundle(bundle, store.path, output=tmp_path / "y.json", progress=False, **options)
        assert "\n" not in str(error.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file"]


def test_the_decoder_refuses_a_store_without_pictures_before_the_work(tmp_path, monkeypatch, bundle):
    from repdib_lightning.data.schema import FactorSpec
    from repdib_lightning.data.writer import EpisodeWriter

    monkeypatch.setattr(probe_module, "encode_rows", lambda *_, **__: pytest.fail("encoded before the checks"))
    with EpisodeWriter(
        tmp_path / "numbers.h5",
        rows=20,
        episodes=4,
        observations={"front": ArraySpec((3,), "float32")},
        actions=None,
        factors={"cell": FactorSpec("endogenous", "categorical", 2)},
    ) as writer:
        for episode in range(4):
            numbers, cells = np.zeros((5, 3), np.float32), np.arange(5) % 2
            writer.add_episode(observations={"front": numbers}, factors={"cell": cells}, evaluation=episode > 1)
    with pytest.raises(UserError, match=r"numbers\.h5: has no pictures to draw again; leave 'decoder' out of probes"):
        probe_bundle(bundle, tmp_path / "numbers.h5", probes="linear,decoder", device="cpu", progress=False)
