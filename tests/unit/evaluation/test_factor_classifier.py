"""The frozen judge of pictures: trained once for a data set, kept beside it, not trusted where it does not fit."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from scene_fakes import paint, write_scenes

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation import factor_classifier
from repdib_lightning.evaluation.factor_classifier import SUFFIX, Judge, judge_of
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.records import ArraySpec, DataSpec

FACTORS = ["brightness", "place"]


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(factor_classifier, "CHANNELS", 4)
    monkeypatch.setattr(factor_classifier, "WIDTH", 16)


@pytest.fixture
def store(tmp_path):
    return write_scenes(tmp_path / "scenes.h5", train=4, held_out=3)


@pytest.fixture
def trainings(monkeypatch):
    """Counts the trainings, and makes each of them short."""
    counted = []

    def train(network, store, view, factors, steps, progress):
        counted.append(steps)
        torch.nn.init.normal_(network.heads["of_place"].bias)

    monkeypatch.setattr(factor_classifier, "_train", train)
    return counted


def judged(store, steps=3, factors=FACTORS):
    return judge_of(store, "pixels", list(factors), steps=steps, progress=False)


def beside(store):
    return store.path.with_suffix(SUFFIX)


def weights(judge):
    return judge.network.state_dict()


def same(first, second):
    return all(torch.equal(value, weights(second)[name]) for name, value in weights(first).items())


def held_out(store):
    return rows_of(store, store.episodes("evaluation"))


def test_it_learns_what_pictures_show_in_few_steps(tmp_path, monkeypatch):
    monkeypatch.setattr(factor_classifier, "CHANNELS", 8)
    monkeypatch.setattr(factor_classifier, "RATE", 1e-2)
    store = write_scenes(tmp_path / "scenes.h5")
    judge = judged(store, steps=150, factors=["brightness", "coin", "place"])
    assert judge.accuracy["brightness"] > 0.95 and judge.accuracy["place"] > 0.95
    assert judge.accuracy["coin"] < 0.75  # which nothing shows
    told = judge.tell(paint([0, 2, 1], [3, 0, 2]))
    assert told["brightness"].tolist() == [0, 2, 1] and told["place"].tolist() == [3, 0, 2]


def test_accuracy_is_the_share_of_held_out_pictures_told_right(store, monkeypatch):
    judge = judged(store)
    for parts in (512, 7):
        monkeypatch.setattr(factor_classifier, "_ROWS", parts)
        assert factor_classifier._accuracy(judge, store, "pixels", FACTORS) == judge.accuracy
    for name in FACTORS:
        right = 0
        for row in held_out(store):
            with torch.no_grad():
                logits = judge.network(torch.from_numpy(store.gather("observations/pixels", np.array([row]))))
            right += int(logits[name].argmax()) == int(store.gather(f"factors/{name}", np.array([row]))[0])
        assert judge.accuracy[name] == right / len(held_out(store))


def test_it_is_frozen_and_tells_one_class_a_picture(store):
    judge = judged(store)
    assert not judge.network.training and not any(p.requires_grad for p in judge.network.parameters())
    pictures = np.random.default_rng(0).integers(0, 256, (130, 3, 16, 16), np.uint8)
    told = judge.tell(pictures)
    assert set(told) == set(FACTORS) and all(classes.shape == (130,) for classes in told.values())
    alone = [judge.tell(pictures[[i]])["place"][0] for i in (0, 64, 129)]
    assert alone == told["place"][[0, 64, 129]].tolist()


def test_it_is_trained_once_and_read_back_from_beside_the_store(store, monkeypatch):
    first = judged(store)
    assert beside(store).name == "scenes.judge.safetensors" and beside(store).is_file()
    monkeypatch.setattr(factor_classifier, "_train", lambda *_: pytest.fail("trained a second time"))
    again = judged(EpisodeStore(store.path))
    assert same(first, again) and again.accuracy == first.accuracy
    assert not again.network.training and not any(p.requires_grad for p in again.network.parameters())
    pictures = store.gather("observations/pixels", held_out(store))
    for name, told in first.tell(pictures).items():
        np.testing.assert_array_equal(again.tell(pictures)[name], told)


def test_other_pictures_another_recipe_or_other_factors_train_again(store, trainings):
    judged(store)
    judged(store)
    assert trainings == [3]
    judged(store, steps=4)
    judged(store, steps=4)
    assert trainings == [3, 4]
    judged(store, steps=4, factors=["place"])
    assert len(trainings) == 3
    other = write_scenes(store.path, train=4, held_out=3, seed=7)
    assert other.fingerprint != store.fingerprint
    judged(other, steps=4, factors=["place"])
    judged(other, steps=4, factors=["place"])
    assert len(trainings) == 4


def test_a_change_of_the_recipe_trains_again(store, trainings, monkeypatch):
    judged(store)
    monkeypatch.setattr(factor_classifier, "DECAY", 0.5)
    judged(store)
    assert len(trainings) == 2


def test_files_of_other_programs_are_known_by_their_content(store, trainings):
    """They have no fingerprint, and one is like the other only if all rows are."""
    with h5py.File(store.path, "r+") as file:
        del file.attrs["fingerprint"]
    for _ in range(2):
        judged(EpisodeStore(store.path))
    assert len(trainings) == 1
    with h5py.File(store.path, "r+") as file:
        file["observations/pixels"][5] = 77
    judged(EpisodeStore(store.path))
    assert len(trainings) == 2


def with_accuracy(path, text):
    with safe_open(path, "pt") as file:
        about, tensors = file.metadata(), {name: file.get_tensor(name) for name in list(file.keys())}
    save_file(tensors, path, {**about, "accuracy": text})


def cut(path):
    path.write_bytes(path.read_bytes()[:-100])


def without_a_tensor(path):
    with safe_open(path, "pt") as file:
        about, tensors = file.metadata(), {name: file.get_tensor(name) for name in list(file.keys())[1:]}
    save_file(tensors, path, about)


@pytest.mark.parametrize(
    "damage",
    [
        cut,
        without_a_tensor,
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(b"no tensors here"),
        lambda path: with_accuracy(path, "{"),
        lambda path: with_accuracy(path, "[0.5]"),
        lambda path: with_accuracy(path, json.dumps({"place": 0.5})),
        lambda path: with_accuracy(path, '{"place": NaN, "brightness": 0.5}'),
        lambda path: with_accuracy(path, json.dumps({"place": None, "brightness": 0.5})),
    ],
)
def test_a_damaged_file_is_replaced(store, trainings, damage, capsys):
    first = judged(store)
    damage(beside(store))
    again = judged(store)
    assert len(trainings) == 2 and same(first, again) and again.accuracy == first.accuracy
    judged(store)
    assert len(trainings) == 2 and capsys.readouterr().err == ""


def test_a_whole_file_is_read_whatever_it_says_of_accuracy(store, trainings):
    """The file is the only source of the accuracy: the damage above is what made it train again."""
    judged(store)
    with_accuracy(beside(store), json.dumps({"place": 0.25, "brightness": 0.75}))
    assert judged(store).accuracy == {"brightness": 0.75, "place": 0.25} and len(trainings) == 1


def test_torchs_random_state_is_left_as_it_was_and_decides_nothing(store, monkeypatch):
    monkeypatch.setattr(torch, "manual_seed", lambda seed: pytest.fail("seeds the generators of every device"))
    judges = []
    for seed, kept in ((1, False), (2, False), (3, True)):
        if not kept:
            beside(store).unlink(missing_ok=True)
        torch.random.default_generator.manual_seed(seed)
        before = torch.get_rng_state()
        judges.append(judged(store))
        assert torch.equal(torch.get_rng_state(), before), f"kept: {kept}"
    assert same(judges[0], judges[1]) and same(judges[0], judges[2])


def test_it_learns_from_training_pictures_alone(tmp_path):
    judges = [judged(write_scenes(tmp_path / f"{seed}.h5", train=4, held_out=3, held_out_seed=seed)) for seed in (1, 2)]
    assert same(*judges) and judges[0].accuracy != judges[1].accuracy
    flipped = write_scenes(
        tmp_path / "flipped.h5",
        train=4,
        held_out=3,
        change=lambda split, factors: {"place": 3 - factors["place"]} if split == "train" else {},
    )
    assert not same(judges[0], judged(flipped))


@pytest.mark.parametrize("target", ["whole_file", "save_file"])
@pytest.mark.parametrize("kind", [UserError, OSError])
def test_where_it_cannot_be_kept_it_judges_all_the_same_and_says_so_once(store, monkeypatch, capsys, target, kind):
    wanted = judged(store)
    beside(store).unlink()

    def refuse(*_, **__):
        raise kind("scenes.judge.safetensors: cannot be written (Read-only file system)")

    monkeypatch.setattr(factor_classifier, target, refuse)
    judge = judged(store)
    assert isinstance(judge, Judge) and same(judge, wanted) and judge.accuracy == wanted.accuracy
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "cannot be written (Read-only file system)" in lines[0] and "again each time" in lines[0]
    assert [path.name for path in store.path.parent.iterdir()] == ["scenes.h5"]


def test_a_blur_keeps_what_is_even_and_the_type(monkeypatch):
    even = torch.full((2, 3, 15, 16), 77, dtype=torch.uint8)
    edge = even.clone()
    edge[..., :7] = 255
    sharpness = []
    for level in (0, 1, 2):
        monkeypatch.setattr(torch, "randint", lambda high, size, level=level: torch.tensor(level))
        assert torch.equal(factor_classifier._blurred(even), even)
        blurred = factor_classifier._blurred(edge)
        assert blurred.dtype == torch.uint8 and blurred.shape == edge.shape
        sharpness.append(int(blurred.int().diff(dim=-1).abs().max()))
    assert sharpness[0] == 178 > sharpness[1] > sharpness[2]


@pytest.mark.parametrize("size", [8, 9, 64])
def test_any_picture_that_can_be_trained_on_can_be_judged(size):
    spec = DataSpec({"pixels": ArraySpec((1, size, size + 3))})
    network = factor_classifier.FactorClassifier(spec, {"style": 3, "kind": 1})
    logits = network(torch.zeros(2, 1, size, size + 3, dtype=torch.uint8))
    assert {name: tuple(part.shape) for name, part in logits.items()} == {"style": (2, 3), "kind": (2, 1)}
