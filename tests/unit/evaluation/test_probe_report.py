import json

import h5py
import numpy as np
import pytest
import torch
from evaluation_fakes import (
    LENGTH,
    cell_and_video_codes,
    cell_encoder,
    random_encoder,
    time_encoder,
    write_store,
)

from repdib_lightning.bottlenecks import Identity
from repdib_lightning.encoders import ConvolutionalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation import probe as probe_module
from repdib_lightning.evaluation.probe import (
    encode_evaluation,
    open_for_probing,
    probe_bundle,
    probe_encoded,
)
from repdib_lightning.export import save_bundle
from repdib_lightning.records import ActionSpec, ArraySpec, DataSpec


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("probe") / "arm.h5")


def probed(encoder, store, **options):
    encoded = encode_evaluation(encoder, store, progress=False)
    return probe_encoded(encoded, store, name="fake", progress=False, **options)[0]


def kept(report, probe):
    return {name: factor.probes[probe].kept for name, factor in report.factors.items()}


def test_an_encoder_of_the_cell_keeps_the_cell_and_no_noise(store):
    report = probed(cell_encoder(), store)
    for probe in ("linear", "mlp"):
        assert kept(report, probe)["cell"] == 1.0
        assert report.mean_kept("endogenous", probe) == 1.0
        assert report.mean_kept("exogenous", probe) < 0.05


def test_an_encoder_of_the_time_step_keeps_it_and_nothing_else(store):
    report = probed(time_encoder(), store)
    time_step = report.factors["time_step"]
    assert time_step.metric == "R2" and time_step.probes["linear"].score > 0.999
    assert time_step.probes["mlp"].score > 0.98
    assert kept(report, "linear")["cell"] < 0.1 and kept(report, "linear")["video"] < 0.1


def test_random_latents_keep_nothing(store):
    report = probed(random_encoder(), store)
    for probe in ("linear", "mlp"):
        assert max(kept(report, probe).values()) < 0.12


def test_the_same_seed_gives_the_same_report(store):
    first, again = (probed(random_encoder(), store, seed=5).to_dict() for _ in range(2))
    assert first == again
    # The seed also draws the permutations behind the bits.
    one, other = (probed(cell_and_video_codes(), store, probes=("linear",), seed=seed) for seed in (5, 6))
    assert one.to_dict()["factors"] != other.to_dict()["factors"]


def test_codes_are_reported_by_group(store):
    report = probed(cell_and_video_codes(), store, probes=("linear",))
    bits = {name: np.array(factor.bits.bits) for name, factor in report.factors.items()}
    assert bits["cell"].argmax() == 0 and bits["cell"][0] > 1.9
    assert bits["video"].argmax() == 1 and bits["video"][1] > 1.5
    assert max(b[2] for b in bits.values()) == 0.0
    assert bits["time_step"].max() < 0.1
    assert report.codebook.used == [4, 3, 1]
    assert report.factors["cell"].best_bits == bits["cell"][0]
    assert probed(cell_encoder(), store, probes=("linear",)).factors["cell"].bits is None


def test_the_halves_that_are_reported_are_the_ones_that_were_used(store):
    report = probed(cell_encoder(), store, probes=("linear",))
    assert report.fit_episodes == [2, 4, 6, 8] and report.score_episodes == [3, 5, 7, 9]
    assert report.fit_rows == report.score_rows == 4 * LENGTH
    assert (report.data, report.fingerprint) == ("arm.h5", store.fingerprint)
    assert list(report.factors) == ["cell", "lamp", "time_step", "video"]


def test_the_table_shows_every_factor_and_the_means(store):
    text = probed(cell_and_video_codes(), store, probes=("linear",)).table()
    lines = {line.split()[0]: line for line in text.splitlines() if line}
    assert lines["cell"].split()[1:3] == ["state", "accuracy"] and "(group 0)" in lines["cell"]
    assert lines["time_step"].split()[1:4] == ["noise", "R2", "0.000"]
    assert "mean state" in text and "mean noise" in text
    assert "2.7 of 8 codes used per group" in text and "mlp" not in text


def test_a_constant_factor_and_an_unseen_class_are_told(tmp_path):
    make = {"video": lambda e: np.full(LENGTH, 1), "cell": lambda e: np.arange(LENGTH) % (3 if e % 2 else 2)}
    store = write_store(tmp_path / "odd.h5", episodes=8, evaluation=4, factors=make)
    report = probed(cell_encoder(), store, probes=("linear",))
    assert report.factors["video"].probes["linear"].kept is None
    assert report.factors["cell"].unseen == pytest.approx(1 / 3)
    assert report.factors["cell"].probes["linear"].score == pytest.approx(2 / 3)
    assert "video: does not vary in the scored episodes" in report.table()
    assert "cell: 33.3% of scored rows have a class that the fit episodes lack" in report.table()
    assert (
        json.loads(json.dumps(report.to_dict(), allow_nan=False))["factors"]["video"]["probes"]["linear"]["kept"]
        is None
    )


def test_a_factor_with_nan_is_a_user_error(tmp_path):
    write_store(tmp_path / "nan.h5")
    with h5py.File(tmp_path / "nan.h5", "r+") as file:
        values = file["factors/time_step"][:]
        values[3::LENGTH] = np.nan
        file["factors/time_step"][...] = values
    with pytest.raises(UserError, match=r"nan\.h5: 'factors/time_step' is NaN or infinite at row 3; 10 such rows"):
        open_for_probing(tmp_path / "nan.h5")


def test_few_fit_episodes_are_told(tmp_path, store):
    few = write_store(tmp_path / "few.h5", episodes=4, evaluation=4)
    assert "Only 2 fit episode(s)" in probed(cell_encoder(), few, probes=("linear",)).table()
    assert "fit episode(s)" not in probed(cell_encoder(), store, probes=("linear",)).table()


def test_threads_are_given_back(store):
    before = torch.get_num_threads()
    probed(cell_encoder(), store, probes=("linear",))
    assert torch.get_num_threads() == before


def export(folder, size=16):
    torch.manual_seed(0)
    spec = DataSpec({"front": ArraySpec((3, size, size))}, ActionSpec("discrete", 5))
    encoder = ConvolutionalEncoder(spec, features=8, channels=4, strides=[2, 2])
    return save_bundle(folder, encoder, Identity(8), training={}, data={})


def test_a_bundle_is_probed_and_the_json_lies_in_it(tmp_path, store):
    bundle = export(tmp_path / "bundle")
    report = probe_bundle(bundle, store.path, probes=("linear",), device="cpu", progress=False)
    written = json.loads((bundle / "probe.json").read_text())
    assert written == json.loads(json.dumps(report.to_dict()))
    assert written["name"] == tmp_path.name and written["features"] == 8
    assert written["summary"]["endogenous"]["linear"] == report.factors["cell"].probes["linear"].kept
    assert report.factors["cell"].probes["linear"].kept > 0.9
    probe_bundle(bundle, store.path, output=tmp_path / "x" / "y.json", probes=("linear",), progress=False)
    assert json.loads((tmp_path / "x" / "y.json").read_text()) == written


def test_a_bundle_for_another_size_is_refused_and_nothing_is_written(tmp_path, store):
    bundle = export(tmp_path / "large", size=32)
    with pytest.raises(UserError, match=r"arm\.h5: observation 'front' is 3x16x16 uint8, .*large was trained on 3x32x"):
        probe_bundle(bundle, store.path, device="cpu", progress=False)
    assert not (bundle / "probe.json").exists()


def test_a_run_stands_for_its_bundle_and_gives_the_report_its_name(tmp_path, store):
    run = tmp_path / "runs" / "arm"
    export(run / "bundle")
    report = probe_bundle(run, store.path, probes="linear", device="cpu", progress=False)
    assert report.name == "arm" and report.probes == ["linear"]
    assert (run / "bundle" / "probe.json").is_file() and not (run / "probe.json").exists()


@pytest.fixture
def no_work(monkeypatch):
    """Bad input must be found before anything is encoded."""
    monkeypatch.setattr(probe_module, "encode_rows", lambda *_, **__: pytest.fail("encoded before the checks"))


def test_bad_options_are_found_before_the_work_and_replace_nothing(tmp_path, store, no_work):
    bundle = export(tmp_path / "a" / "bundle")
    (tmp_path / "a" / "bundle.json").write_text("{}")
    (tmp_path / "folder.json").mkdir()
    (tmp_path / "file").touch()
    config = (bundle / "config.json").read_bytes()
    for options, words in (
        ({"output": store.path}, r"--output must end in \.json, is '.*arm\.h5'"),
        ({"output": bundle / "config.json"}, r"--output would replace .*config\.json"),
        ({"output": tmp_path / "a" / "x" / ".." / "bundle.json"}, r"--output would replace .*bundle\.json"),
        ({"output": tmp_path / "folder.json"}, r"--output .*folder\.json: cannot be written"),
        ({"output": tmp_path / "file" / "x.json"}, r"--output .*x\.json: cannot be written"),
        ({"seed": -1}, "seed must be at least 0.*is -1"),
        ({"seed": 2**70}, "seed must be at least 0"),
        ({"probes": "linaer"}, "unknown probe 'linaer'.*did you mean 'linear'"),
        ({"probes": ""}, "probes: expected a word"),
        ({"probes": [3]}, "probes: expected a word"),
        ({"device": "gpu"}, "device 'gpu' cannot be used"),
    ):
        with pytest.raises(UserError, match=words):
            probe_bundle(bundle, store.path, progress=False, **options)
    assert (bundle / "config.json").read_bytes() == config and not (bundle / "probe.json").exists()


def test_a_run_that_was_not_exported_says_what_to_do(tmp_path, store, no_work):
    (tmp_path / "a" / "checkpoints").mkdir(parents=True)
    with pytest.raises(UserError, match=r"a: is a run: export it"):
        probe_bundle(tmp_path / "a", store.path, progress=False)


@pytest.mark.parametrize("probes", ["linear,mlp", "linear, mlp", "[linear, mlp]", ["linear", "mlp"], "linear,mlp,mlp"])
def test_probes_are_named_in_any_usual_form(probes):
    assert probe_module.check_options(probes, 0) == ("linear", "mlp")
