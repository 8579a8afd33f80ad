"""``probe``, ``compare`` and ``figures recognition`` on a bundle that was trained on clips with subjects held out."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from clip_stores import ACTIVITIES, MODALITIES, write_clips
from PIL import Image

from repdib_lightning.__main__ import main
from repdib_lightning.bottlenecks import Identity, RepDIB
from repdib_lightning.classifiers import LinearClassifier
from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.encoders import MultimodalEncoder
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation import probe as probe_module
from repdib_lightning.evaluation import recognition_figures
from repdib_lightning.evaluation.bundle_data import open_held_out
from repdib_lightning.evaluation.probe import probe_bundle
from repdib_lightning.evaluation.probes import ProbeScore
from repdib_lightning.evaluation.recognition_choice import chosen_clips
from repdib_lightning.evaluation.recognition_clips import ShownClip, clip_figure
from repdib_lightning.export import save_bundle

HELD_OUT = {"subject": ["2", "4"]}
SMALL = {
    "features": 8,
    "width": 16,
    "segments": 2,
    "channels": 4,
    "layers": 0,
    "dropout": 0.0,
    "modalities": list(MODALITIES),
}


def write_small(path, **options):
    return write_clips(path, **{"clips": 60, "frames": 2, "size": 12, "steps": 10, **options})


def save(folder, data, held_out=HELD_OUT, classifier=True, steps=0, quantised=False):
    torch.manual_seed(0)
    module = EpisodeDataModule(data, target="activity", held_out=held_out, futures=0, batch_size=30)
    module.setup()
    encoder = MultimodalEncoder(module.spec, **SMALL)
    bottleneck = RepDIB(8, groups=2, codes=4, start="random", start_step=0) if quantised else Identity(8)
    head = LinearClassifier(module.spec, 8)
    optimizer = torch.optim.Adam([*encoder.parameters(), *head.parameters()], 0.003)
    for _ in range(steps):
        for batch in module.train_dataloader():
            latent = encoder({name: array[:, 0] for name, array in batch.observations.items()})
            optimizer.zero_grad()
            torch.nn.functional.cross_entropy(head(latent), batch.targets).backward()
            optimizer.step()
    facts = {"held_out": module.held_out}
    parts = {"classifier": head.eval()} if classifier else {}
    save_bundle(Path(folder), encoder.eval(), bottleneck.eval(), training={}, data=facts, **parts)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A trained bundle a, one that quantises b, one without classifier c, one that holds out another subject d."""
    place = tmp_path_factory.mktemp("recognition")
    data = write_small(place / "clips.h5", attributes={"rate": {"gyroscope": 5.0}})
    save(place / "a/bundle", data, steps=50)
    save(place / "b/bundle", data, quantised=True)
    save(place / "c/bundle", data, classifier=False)
    save(place / "d/bundle", data, held_out={"subject": ["1"]})
    return place


@pytest.fixture
def here(place, monkeypatch):
    monkeypatch.chdir(place)
    return place


def test_a_bundle_is_probed_on_what_it_held_out(here, capsys, tmp_path):
    output = tmp_path / "probe.json"
    assert main(["probe", "a", "clips.h5", "--probes", "linear,recognition", "--output", str(output)]) == 0
    told = capsys.readouterr().out
    written = json.loads(output.read_text())
    found = written["recognition"]
    store = EpisodeStore("clips.h5", held_out=HELD_OUT)
    assert found["clips"] == np.sum(found["confusion"]) == len(store.episodes("evaluation")) == 30
    assert {*written["fit_episodes"], *written["score_episodes"]} == set(store.episodes("evaluation").tolist())
    assert found["f1_macro"] > 0.7 and f"{found['f1_macro']:.3f}" in told
    assert set(found["without"]) == set(found["only"]) == set(found["attention"]) == set(MODALITIES)
    assert sum(found["attention"].values()) == pytest.approx(1.0, abs=1e-5)
    assert "without cam1" in told and "Scored on all 30 held-out clips" in told
    assert set(written["factors"]) == {"activity", "session", "subject"} and found["perplexity"] == {}


def test_other_probes_say_nothing_of_recognition(here, capsys, tmp_path):
    output = tmp_path / "probe.json"
    assert main(["probe", "a", "clips.h5", "--probes", "linear", "--output", str(output)]) == 0
    assert "recognition" not in json.loads(output.read_text()) and "recognition" not in capsys.readouterr().out


def test_codes_of_the_latent_are_counted(here, tmp_path):
    report = probe_bundle(
        Path("b"), Path("clips.h5"), probes="linear,recognition", output=tmp_path / "b.json", progress=False
    )
    assert report.recognition.perplexity["fused"] == pytest.approx(np.mean(report.codebook.perplexity))


def test_the_probes_read_the_latent_of_windows_of_whole_recordings(tmp_path):
    """Each recording is cut into four clips; none is fitted on and scored at once."""
    data = write_small(tmp_path / "cut.h5", clips=240, per_recording=4, missing=False)
    save(tmp_path / "run", data, steps=15)
    report = probe_bundle(tmp_path / "run", data, probes="linear,mlp,recognition", progress=False)
    recordings = EpisodeStore(data).recordings
    assert not set(recordings[report.fit_episodes]) & set(recordings[report.score_episodes])
    assert report.recognition.scores.f1_macro > 0.8
    assert report.factors["activity"].probes["linear"].kept > 0.8
    assert set(report.factors) == {"activity", "session", "subject"}
    assert report.table().count("recognition of activity") == 1


def test_inner_folds_of_the_probes_hold_out_whole_recordings(tmp_path, monkeypatch):
    data = write_small(tmp_path / "cut.h5", per_recording=3)
    save(tmp_path / "run", data)
    halves = []
    monkeypatch.setattr(
        probe_module, "measure", lambda probe, fit, score, seed: halves.append(fit) or ProbeScore(0.5, 0.5, 0.5)
    )
    report = probe_bundle(tmp_path / "run", data, probes="linear", progress=False)
    assert halves[0].episodes.tolist() == EpisodeStore(data).recordings[report.fit_episodes].tolist()
    assert len(np.unique(halves[0].episodes)) < len(report.fit_episodes)


def test_a_page_compares_classifiers(here, capsys, tmp_path):
    page = tmp_path / "page.html"
    assert main(["compare", "clips.h5", str(page), "a", "b", "--probes", "linear,recognition"]) == 0
    told = capsys.readouterr().out
    line = next(line for line in told.splitlines() if line.startswith("macro F1 "))
    numbers = json.loads(page.with_suffix(".json").read_text())
    assert line.split()[2:] == [f"{numbers[name]['recognition']['f1_macro']:.3f}" for name in "ab"]
    text = page.read_text()
    assert (
        "<h2>What is recognised</h2>" in text and "confusion matrix: a row" in text and "macro F1 without cam1" in text
    )


def draw(*options, bundle="a", data="clips.h5"):
    return main(["figures", "recognition", bundle, data, *options])


def opened(path):
    with Image.open(path) as picture:
        picture.load()
        return np.asarray(picture.convert("L")), picture.size


def test_three_pictures_are_written_the_same_each_time(here, capsys, tmp_path):
    assert draw("--clips", "2", "--output", str(tmp_path / "one")) == 0
    told = capsys.readouterr().out
    assert "wrote confusion.png, modalities.png, clips.png" in told and "on 30 held-out clips" in told
    content = {file.name: file.read_bytes() for file in (tmp_path / "one").iterdir()}
    assert set(content) == {"confusion.png", "modalities.png", "clips.png"}
    for name in content:
        pixels, size = opened(tmp_path / "one" / name)
        assert min(size) > 250 and pixels.std() > 10, "not blank"
    assert draw("--clips", "2", "--output", str(tmp_path / "two"), bundle="a/bundle") == 0
    assert {file.name: file.read_bytes() for file in (tmp_path / "two").iterdir()} == content
    assert draw("--split", "train", "--clips", "1", "--output", str(tmp_path / "three")) == 0
    assert "on 30 training clips" in capsys.readouterr().out
    assert opened(tmp_path / "three/clips.png")[1][0] < opened(tmp_path / "one/clips.png")[1][0]


def test_of_one_modality_there_is_nothing_to_take_away(tmp_path, monkeypatch, capsys):
    data = write_small(tmp_path / "clips.h5")
    monkeypatch.setitem(SMALL, "modalities", ["gyroscope"])
    save(tmp_path / "run/bundle", data)
    assert draw("--clips", "1", bundle=str(tmp_path / "run"), data=str(data)) == 0
    assert {file.name for file in (tmp_path / "run/recognition").iterdir()} == {"confusion.png", "clips.png"}
    report = probe_bundle(tmp_path / "run", data, probes="linear,recognition", progress=False).recognition
    assert report.without == report.only == {}


def test_clips_are_spread_over_the_classes_and_one_is_mistaken():
    labels = np.array([0, 0, 1, 1, 2, 2, 3, 3, 4, 4])
    right = labels.copy()
    assert chosen_clips(labels, right, 3) == [0, 4, 8]
    assert chosen_clips(labels, right, 5) == [0, 2, 4, 6, 8]
    assert chosen_clips(labels, right, 7) == [0, 2, 4, 6, 8, 1, 3]
    assert sorted(chosen_clips(labels, right, 99)) == list(range(10))
    first_wrong = np.array([1, 0, 1, 1, 2, 2, 3, 0, 4, 4])
    assert chosen_clips(labels, first_wrong, 3) == [1, 4, 0], "recognised ones first, then the first that is mistaken"
    never = np.array([1, 1, 1, 1, 2, 2, 3, 3, 4, 4])
    assert chosen_clips(labels, never, 3) == [0, 4, 8], "a mistaken one is among them"


def titles(monkeypatch, figure=recognition_figures):
    said = []
    monkeypatch.setattr(figure, "clip_figure", lambda store, clips, classes, title: said.append((clips, title)) or b"x")
    return said


def test_the_title_says_how_clips_were_chosen(here, monkeypatch, tmp_path):
    said = titles(monkeypatch)
    for bundle in "ab":
        assert draw("--clips", "3", "--output", str(tmp_path / bundle), bundle=bundle) == 0
    for clips, title in said:
        wrong = [int(clip.probabilities.argmax()) != clip.label for clip in clips]
        assert wrong[-1] == ("last, one that is mistaken" in title) or all(wrong)
        assert "spread over the list" in title and len(clips) == 3


def test_what_was_observed_is_drawn_up_to_its_end(tmp_path):
    video = np.zeros((8, 3, 6, 6), np.uint8)
    video[:6] = 200
    readings = np.full((20, 3), np.nan, np.float32)
    readings[:10] = 1.0
    nothing = np.full((20, 40), np.nan, np.float32)
    parts = {"cam1": video, "gyroscope": readings, "lost": nothing}
    clip = ShownClip(3, 1, np.array([0.5, 0.3, 0.15, 0.05]), parts, {"cam1": np.array([0.2, 0.8])}, {})
    assert clip.end == 0.75 and not clip.right
    write_small(tmp_path / "clips.h5")
    store = EpisodeStore(tmp_path / "clips.h5")
    features = np.random.default_rng(0).normal(size=(20, 40)).astype(np.float32)
    for shown in (parts, {**parts, "lost": features}, {"cam1": video[:, :1]}, {"lost": nothing}):
        content = clip_figure(store, [ShownClip(3, 3, clip.probabilities, shown, {}, {})], "abcd", "title")
        with Image.open(io.BytesIO(content)) as picture:
            assert np.asarray(picture.convert("L")).std() > 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["figures", "recognition", "c", "clips.h5"], "c/bundle/config.json: has no classifier"),
        (["probe", "c", "clips.h5", "--probes", "linear,recognition"], "c/bundle/config.json: has no classifier"),
        (["figures", "recognition", "a", "clips.h5", "--clips", "0"], "--clips must be from 1 to 12, is 0"),
        (
            ["figures", "recognition", "a", "clips.h5", "--split", "test"],
            "--split test: must be evaluation, train or all",
        ),
        (["figures", "recogniton", "a", "clips.h5"], "unknown kind 'recogniton', did you mean 'recognition'?"),
        (["figures", "recognition", "a", "other.h5"], "other.h5: 'activity' has the class 'jumping', which a/bundle"),
        (["figures", "recognition", "a", "plain.h5"], "plain.h5: has no factor 'activity', which a/bundle recognises"),
        (["figures", "recognition", "a", "alike.h5"], "alike.h5: held_out: .*; a/bundle was trained with subject 2, 4"),
        (["probe", "a", "alike.h5"], "alike.h5: held_out: .*; a/bundle was trained with subject 2, 4 held out"),
        (
            ["probe", "a", "clips.h5", "--probes", "linear,recogniton"],
            "unknown probe 'recogniton', did you mean 'recognition'",
        ),
        (
            ["compare", "clips.h5", "x.html", "a", "d"],
            "a/bundle was trained with subject 2, 4 held out, d/bundle with subj",
        ),
        (
            ["compare", "clips.h5", "x.html", "a", "c", "--probes", "linear,recognition"],
            "c/bundle/config.json: has no cl",
        ),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(here, capsys, arguments, message):
    if not Path("other.h5").exists():
        write_small(Path("other.h5"), activities=4)
        write_small(Path("alike.h5"), subjects=2)
        write_without_target(Path("plain.h5"))
    before = {path for path in here.rglob("*") if path.suffix in (".json", ".png", ".html")}
    assert main(arguments) == 2
    said = capsys.readouterr().err.strip()
    assert re.search(message, said) and "\n" not in said, said
    assert {path for path in here.rglob("*") if path.suffix in (".json", ".png", ".html")} == before


def write_without_target(path):
    import h5py

    write_small(path)
    with h5py.File(path, "r+") as file:
        del file["factors/activity"]


def test_a_store_in_which_classes_stand_in_another_order_gives_the_same_scores(here, tmp_path):
    import h5py

    order = [2, 0, 1]
    write_small(tmp_path / "turned.h5")
    with h5py.File(tmp_path / "turned.h5", "r+") as file:
        names = json.loads(file.attrs["classes"])
        names["activity"] = [ACTIVITIES[number] for number in order]
        file.attrs["classes"] = json.dumps(names)
        file["factors/activity"][...] = np.argsort(order)[file["factors/activity"][:]]
    found = [
        probe_bundle(Path("a"), data, probes="linear,recognition", output=tmp_path / "x.json", progress=False)
        for data in (Path("clips.h5"), tmp_path / "turned.h5")
    ]
    assert found[0].recognition == found[1].recognition


def test_without_a_factor_the_files_own_split_is_used(tmp_path):
    data = write_small(tmp_path / "clips.h5", evaluation=("3",))
    own = np.flatnonzero(EpisodeStore(data).evaluation)
    for description in ({}, {"data": {}}, {"data": {"held_out": None}}):
        np.testing.assert_array_equal(open_held_out(data, {"a": description}).episodes("evaluation"), own)
    with pytest.raises(
        UserError, match="a was trained with the data's own evaluation episodes held out, b with subject"
    ):
        open_held_out(data, {"a": {}, "b": {"data": {"held_out": {"subject": ["1"]}}}})
