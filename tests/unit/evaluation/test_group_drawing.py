"""Drawings of a model whose first group decides brightness and whose second decides place, judged by one who knows."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scene_fakes import LENGTH, AllSeeing, SceneDecoder, scene_model, write_scenes

from repdib_lightning.evaluation import group_drawing, redrawing
from repdib_lightning.evaluation.group_drawing import DrawingReport, Verdict, measure_drawing
from repdib_lightning.evaluation.redrawing import psnr, redraw
from repdib_lightning.evaluation.splits import rows_of

TRAINED_DARK = {"brightness": np.zeros(LENGTH, int)}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Training pictures are all dark, so that their mean is not that of the held-out ones."""
    place = tmp_path_factory.mktemp("drawing") / "scenes.h5"
    return write_scenes(place, change=lambda split, factors: TRAINED_DARK if split == "train" else {})


@pytest.fixture(autouse=True)
def judge(monkeypatch):
    monkeypatch.setattr(group_drawing, "judge_of", lambda store, view, factors, **_: AllSeeing(factors))


def held_out(store):
    return rows_of(store, store.episodes("evaluation"))


def measured(store, seed=0, decoder=None, rows=None, **options):
    encoder, own = scene_model(**options)
    rows = held_out(store) if rows is None else rows
    groups = None if encoder.groups else 2
    return measure_drawing(redraw(encoder, decoder or own, store, rows, groups), store, rows, seed)


def slow_psnr(drawn, pictures):
    total = sum((int(a) - int(b)) ** 2 for a, b in zip(drawn.ravel(), pictures.ravel(), strict=True))
    return 10 * math.log10(255.0**2 * drawn.size / total)


@pytest.mark.parametrize("quantised", [True, False])
def test_a_swap_moves_the_factor_of_its_group_and_no_other(store, quantised):
    verdicts = measured(store, quantised=quantised).verdicts
    assert verdicts["brightness"].donor == [1.0, 0.0] and verdicts["brightness"].own == [0.0, 1.0]
    assert verdicts["place"].donor == [0.0, 1.0] and verdicts["place"].own == [1.0, 0.0]
    for name in ("brightness", "place"):
        assert verdicts[name].drawn == verdicts[name].held_out == 1.0 and verdicts[name].unswapped == 0.0


def test_chance_is_the_share_of_the_most_frequent_held_out_class(store):
    verdicts = measured(store).verdicts
    for name, verdict in verdicts.items():
        values = store.gather(f"factors/{name}", held_out(store)).tolist()
        assert verdict.chance == max(map(values.count, values)) / len(values)


class AlwaysTheSame(SceneDecoder):
    def forward(self, latents):
        return super().forward(torch.tensor([[2.0, 1.0, 1.0, 1.0]]).expand(len(latents), -1))


def test_a_decoder_that_ignores_the_latent_moves_no_more_than_without_a_swap(store):
    report = measured(store, decoder=AlwaysTheSame(scene_model()[0].spec))
    for verdict in report.verdicts.values():
        assert verdict.donor == [verdict.unswapped] * 2
    assert report.verdicts["place"].unswapped > 0.1  # by luck
    scores = report.figures()
    assert scores["place/moved"] == scores["place/moved_unswapped"] and scores["place/moved_gap"] == 0.0
    assert scores["psnr_lost_most"] == 0.0


def test_only_pairs_that_differ_in_the_factor_count(store, monkeypatch):
    """Against a loop over the pairs, with a judge who confuses two places."""

    class Confused(AllSeeing):
        def tell(self, pictures):
            told = super().tell(pictures)
            return told | {"place": np.where(told["place"] == 3, 0, told["place"])}

    monkeypatch.setattr(group_drawing, "judge_of", lambda store, view, factors, **_: Confused(factors))
    rows = held_out(store)
    verdict = measured(store, seed=4).verdicts["place"]
    place = store.gather("factors/place", rows)
    pairs = np.random.default_rng(4).integers(len(rows), size=(2, group_drawing.PAIRS)).T
    hits = [0 if place[b] == 3 else int(place[b]) for a, b in pairs if place[a] != place[b]]
    donors = [int(place[b]) for a, b in pairs if place[a] != place[b]]
    assert verdict.donor[1] == np.mean(np.equal(hits, donors)) < 1.0
    assert verdict.drawn == np.mean(place != 3)


def test_psnr_is_that_of_a_loop_over_the_pixels():
    random = np.random.default_rng(0)
    drawn, pictures = random.integers(0, 256, (2, 70, 3, 4, 5)).astype(np.uint8)
    assert psnr(drawn, pictures) == pytest.approx(slow_psnr(drawn, pictures), abs=1e-4)
    assert psnr(pictures, pictures) == 100.0
    assert psnr(np.broadcast_to(pictures[0], pictures.shape), pictures) == pytest.approx(
        slow_psnr(np.repeat(pictures[:1], 70, 0), pictures), abs=1e-4
    )


class Levels(SceneDecoder):
    """Every pixel is the first number of the latent."""

    def forward(self, latents):
        return latents[:, 0, None, None, None].expand(-1, 3, 16, 16)


@pytest.mark.parametrize("part", [64, 3])
def test_a_drawing_is_cut_off_at_black_and_white_and_rounded(store, monkeypatch, part):
    monkeypatch.setattr(redrawing, "_ROWS", part)
    encoder, _ = scene_model()
    drawn = redraw(encoder, Levels(encoder.spec), store, held_out(store)[:4])
    shares = np.array([-0.7, 0.0, 100.4 / 255, 100.6 / 255, 1.0, 1.3, 2.0], np.float32)
    pictures = drawn.draw(np.repeat(shares[:, None], 4, 1))
    assert pictures.shape == (7, 3, 16, 16) and pictures.dtype == np.uint8
    assert pictures[:, 0, 0, 0].tolist() == [0, 0, 100, 101, 255, 255, 255]
    assert drawn.draw().shape == (4, 3, 16, 16)


def test_the_mean_picture_is_that_of_the_training_pictures(store, monkeypatch):
    monkeypatch.setattr(group_drawing, "_ROWS", 7)
    report = measured(store)
    training = store.gather("observations/pixels", rows_of(store, store.episodes("train"))).astype(float)
    pictures = store.gather("observations/pixels", held_out(store))
    mean = np.repeat(np.round(training.mean(0)).astype(np.uint8)[None], len(pictures), 0)
    assert report.psnr_mean == pytest.approx(slow_psnr(mean, pictures), abs=1e-4)
    assert report.psnr == 100.0
    assert report.figures()["psnr_gain"] == pytest.approx(100.0 - report.psnr_mean)


def test_without_brightness_nothing_is_drawn_and_without_place_the_wrong_quarter(store):
    report = measured(store)
    pictures = store.gather("observations/pixels", held_out(store))
    first_quarter = np.zeros_like(pictures)
    first_quarter[:, :, :8, :8] = pictures.max((1, 2, 3))[:, None, None, None]
    assert report.psnr_zeroed[0] == pytest.approx(slow_psnr(np.zeros_like(pictures), pictures), abs=1e-4)
    assert report.psnr_zeroed[1] == pytest.approx(slow_psnr(first_quarter, pictures), abs=1e-4)
    figures = report.figures()
    assert figures["psnr_lost_most"] == pytest.approx(100.0 - min(report.psnr_zeroed))
    assert figures["psnr_lost_least"] == pytest.approx(100.0 - max(report.psnr_zeroed))


def test_frames_of_a_stack_are_drawn_and_compared_but_not_judged(store):
    report = measured(store, frame_stack=2)
    assert report.verdicts == {}
    rows = held_out(store)
    before = np.maximum(rows - 1, rows // LENGTH * LENGTH)
    pictures = np.concatenate([store.gather("observations/pixels", part) for part in (before, rows)], 1)
    assert report.psnr == pytest.approx(slow_psnr(np.tile(pictures[:, 3:], (1, 2, 1, 1)), pictures), abs=1e-4)
    training = store.gather("observations/pixels", rows_of(store, store.episodes("train")))
    mean = np.repeat(np.tile(np.round(training.mean(0)).astype(np.uint8), (2, 1, 1))[None], len(rows), 0)
    assert report.psnr_mean == pytest.approx(slow_psnr(mean, pictures), abs=1e-4)


def test_a_factor_of_which_one_class_is_held_out_has_no_verdict(tmp_path):
    still = {"place": np.ones(LENGTH, int)}
    store = write_scenes(tmp_path / "still.h5", change=lambda split, factors: still if split == "evaluation" else {})
    assert set(measured(store).verdicts) == {"brightness", "coin"}


def test_the_same_seed_draws_the_same_pairs(store):
    first, again, other = (measured(store, seed=seed).to_dict() for seed in (3, 3, 4))
    assert first == again and first != other


def test_what_moves_a_factor_is_the_group_with_the_largest_share():
    verdict = Verdict(held_out=0.9, drawn=0.8, chance=0.3, donor=[0.2, 0.7, 0.5], own=[0.6] * 3, unswapped=0.1)
    scores = DrawingReport(20.0, 12.0, [15.0, 19.0, 8.0], {"style": verdict}).figures()
    assert scores["style/moved"] == 0.7 and scores["style/moved_gap"] == pytest.approx(0.2)
    assert scores["style/moved_unswapped"] == 0.1 and scores["style/drawn"] == 0.8
    assert (scores["psnr_gain"], scores["psnr_lost_most"], scores["psnr_lost_least"]) == (8.0, 12.0, 1.0)
    single = DrawingReport(20.0, 12.0, [15.0], {"style": Verdict(1.0, 1.0, 0.5, [0.4], [0.6], 0.0)}).figures()
    assert single["style/moved"] == 0.4 and "style/moved_gap" not in single
