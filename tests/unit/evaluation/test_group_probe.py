"""The probe of groups on a model whose first group is one factor and whose second is another."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scene_fakes import LENGTH, AllSeeing, SceneEncoder, scene_model, write_scenes

from repdib_lightning.bottlenecks import RepDIB
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.schema import FactorSpec
from repdib_lightning.data.writer import EpisodeWriter
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation import group_drawing, group_probe, probes
from repdib_lightning.evaluation.group_probe import classes_of, measure_groups
from repdib_lightning.evaluation.probe import (
    check_options,
    encode_evaluation,
    probe_encoded,
    probe_groups,
)
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.evaluation.tables import comparison_table, report_table
from repdib_lightning.experiments.measures import _probed
from repdib_lightning.experiments.suite_measures import GROUP_FACTOR_SCORES, GROUP_PROBE, GROUP_SCORES
from repdib_lightning.export.frozen import FrozenEncoder
from repdib_lightning.records import ArraySpec


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_scenes(tmp_path_factory.mktemp("groups") / "scenes.h5")


@pytest.fixture(autouse=True)
def judge(monkeypatch):
    monkeypatch.setattr(group_drawing, "judge_of", lambda store, view, factors, **_: AllSeeing(factors))


def measured(store, drawn=False, groups=None, seed=0, **options):
    encoder, decoder = scene_model(**options)
    return measure_groups(encoder, decoder if drawn else None, store, groups=groups, seed=seed, progress=False)


@pytest.fixture(scope="module")
def report(store):
    """Everything that the probes ``linear`` and ``groups`` say of the model that takes scenes apart."""
    encoder, decoder = scene_model()
    encoded = encode_evaluation(encoder, store, progress=False)
    report, _ = probe_encoded(encoded, store, name="ours", probes=("linear", "groups"), progress=False)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(group_drawing, "judge_of", lambda store, view, factors, **_: AllSeeing(factors))
        return replace(report, grouped=measure_groups(encoder, decoder, store, progress=False))


@pytest.fixture
def only_codes(monkeypatch):
    """Leave out what takes longest, where only the codes matter."""
    monkeypatch.setattr(group_probe, "measure_disentanglement", lambda codes, *_, **__: codes)


def test_clips_of_one_recording_belong_together(tmp_path, monkeypatch):
    told = {}
    monkeypatch.setattr(group_probe, "measure_disentanglement", lambda codes, *_, **given: told.update(given))
    store = write_scenes(tmp_path / "scenes.h5")
    store.recordings = np.arange(len(store.starts)) // 2
    measured(store)
    rows = np.concatenate([rows_of(store, store.episodes(split)) for split in ("train", "evaluation")])
    assert sorted(told["origins"]) == sorted(store.recordings[store.row_episodes[rows]])


@pytest.mark.parametrize(("quantised", "kind"), [(True, "own"), (False, "k-means 15")])
def test_each_group_holds_its_factor_and_nobody_the_coin(store, quantised, kind):
    report = measured(store, quantised=quantised, groups=None if quantised else 2)
    found = report.disentanglement
    assert (report.positions, report.groups, report.codes, report.drawing) == (1, 2, kind, None)
    assert found.holds == ["brightness", "place"]
    assert found.share["brightness"][0] == pytest.approx(1.0) and found.share["brightness"][1] < 0.05
    assert found.share["place"][1] == pytest.approx(1.0) and found.share["place"][0] < 0.05
    assert max(found.share["coin"]) < 0.05
    assert found.explicitness_by_factor["place"] > 0.9 and found.explicitness_by_factor["coin"] < 0.1
    assert (found.fit_rows, found.score_rows) == (10 * LENGTH, 8 * LENGTH)


def test_the_figures_rank_the_groups(report):
    scores, found = report.grouped.figures(), report.grouped.disentanglement
    assert scores["held"] == 2.0 and scores["modularity"] == found.modularity > 0.9
    for name in ("brightness", "coin", "place"):
        assert scores[f"{name}/share"] == max(found.share[name])
        assert scores[f"{name}/share_gap"] == pytest.approx(abs(found.share[name][0] - found.share[name][1]))
        assert scores[f"{name}/explicitness"] == found.explicitness_by_factor[name]
    assert scores["place/moved"] == scores["brightness/moved"] == scores["place/moved_gap"] == 1.0
    assert scores["psnr"] == 100.0 == report.grouped.drawing.psnr


@pytest.mark.parametrize("quantised", [True, False])
def test_a_group_of_a_grid_is_made_of_all_its_positions(store, quantised):
    """Each position of the second group tells one of two ways: half of the bits of place, all of them together."""
    report = measured(store, grid=True, quantised=quantised, groups=None if quantised else 2)
    assert (report.positions, report.groups) == (2, 2)
    found = report.disentanglement
    assert found.holds == ["brightness", "place"]
    assert found.share["place"][1] == pytest.approx(0.5, abs=0.03)
    assert found.share["brightness"][0] == pytest.approx(1.0)
    assert found.explicitness_by_group["place"][1] > 0.9 > 0.2 > found.explicitness_by_group["place"][0]


def test_centres_come_from_training_pictures_alone(store, tmp_path, monkeypatch, only_codes):
    seen = []

    def spied(points, clusters):
        centres = kmeans(points, clusters)
        seen.append((points, centres[0]))
        return centres

    kmeans = group_probe.kmeans
    monkeypatch.setattr(group_probe, "kmeans", spied)
    other = write_scenes(tmp_path / "other.h5", held_out_seed=9)
    held_out = [s.gather("factors/place", rows_of(s, s.episodes("evaluation"))) for s in (store, other)]
    assert not np.array_equal(*held_out)
    for each in (store, other):
        measured(each, quantised=False, groups=2)
    (points, centres), (again, same) = seen
    assert torch.equal(points, again) and torch.equal(centres, same)
    training = store.gather("observations/pixels", rows_of(store, store.episodes("train")))
    latents = scene_model(quantised=False)[0].encode({"pixels": training})
    assert torch.equal(points, latents.reshape(-1, 2, 2).transpose(0, 1))


def test_few_or_many_rows_give_two_to_512_clusters(tmp_path, store, monkeypatch, only_codes):
    few = write_scenes(tmp_path / "few.h5", train=1)
    assert measured(few, quantised=False, groups=2).codes == "k-means 2"
    monkeypatch.setattr(group_probe, "CLUSTERS", 5)
    assert measured(store, quantised=False, groups=2).codes == "k-means 5"
    # The rows of all positions of a grid make one book.
    monkeypatch.setattr(group_probe, "CLUSTERS", 512)
    assert measured(store, quantised=False, groups=2, grid=True).codes == "k-means 30"


def test_so_many_rows_are_read_and_no_more(store, monkeypatch):
    monkeypatch.setattr(group_probe, "FIT_ROWS", 50)
    monkeypatch.setattr(group_probe, "SCORE_ROWS", 40)
    found = measured(store, seed=3).disentanglement
    assert (found.fit_rows, found.score_rows) == (50, 40)
    assert found.entropy != measured(store, seed=4).disentanglement.entropy  # other rows


@pytest.mark.parametrize("quantised", [True, False])
def test_the_same_seed_gives_the_same_report_and_moves_no_random_state(store, quantised):
    options = {"quantised": quantised, "groups": None if quantised else 2, "drawn": True}
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    first = measured(store, seed=5, **options).to_dict()
    assert torch.equal(torch.get_rng_state(), before)
    assert np.array_equal(np.random.get_state()[1], numpy_before)  # noqa: NPY002
    torch.rand(3)
    assert measured(store, seed=5, **options).to_dict() == first


def test_no_generator_of_a_gpu_is_seeded(store, monkeypatch, only_codes):
    monkeypatch.setattr(torch, "manual_seed", lambda seed: pytest.fail("seeds every device"))
    measured(store, quantised=False, groups=2)


def test_measuring_changes_no_buffer_and_no_weight(store):
    encoder = SceneEncoder()
    bottleneck = RepDIB(4, groups=2, codes=5, start="random", start_step=0)
    frozen = FrozenEncoder(encoder, bottleneck, {})
    decoder = scene_model()[1].train()
    before = {name: value.clone() for name, value in frozen.state_dict().items()}
    assert len(before) > 3
    measure_groups(frozen, decoder, store, progress=False)
    after = frozen.state_dict()
    assert before.keys() == after.keys() and all(torch.equal(before[name], after[name]) for name in before)
    assert not frozen.training


def dull(split, factors):
    """One factor that never varies, one that varies among training pictures only."""
    return {"coin": np.zeros(LENGTH, int), "place": factors["place"] * (split == "train")}


@pytest.mark.parametrize("groups", [None, 1, 2, 4])
def test_what_cannot_be_told_is_null_and_never_nan(tmp_path, groups):
    store = write_scenes(tmp_path / "dull.h5", change=dull)
    report = measured(store, drawn=True, quantised=groups is None, groups=groups)
    read = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert read["disentanglement"]["share"]["coin"] == [None] * (groups or 2)
    assert read["figures"]["place/explicitness"] is None and read["figures"]["coin/explicitness"] is None
    assert set(read["drawing"]["verdicts"]) == {"brightness"}
    assert all(value is None or math.isfinite(value) for value in read["figures"].values())
    if groups == 1:
        assert read["figures"]["brightness/share_gap"] is None and read["figures"]["mig"] is None


def test_a_suite_accepts_the_names_of_all_figures_and_no_other(report):
    names = {tuple(name.rpartition("/")[::2]) for name in report.grouped.figures()}
    assert {last for factor, last in names if not factor} == set(GROUP_SCORES)
    assert {last for factor, last in names if factor} == set(GROUP_FACTOR_SCORES)


def test_a_suite_knows_the_figures_by_the_same_names(store, report):
    """What stands in probe.json under ``figures`` is what a suite calls ``groups/...``; unknowns are left out."""
    told = {key: value for key, value in _probed(report.to_dict()).items() if key.startswith("groups/")}
    figures = report.grouped.figures()
    assert told == {f"groups/{name}": value for name, value in figures.items() if value is not None}
    assert {"groups/modularity", "groups/place/share_gap", "groups/psnr_gain", "groups/place/moved_gap"} < set(told)
    assert GROUP_PROBE == probes.GROUPS
    single = measured(store, quantised=False, groups=1).to_dict()
    assert single["figures"]["mig"] is None
    names = _probed({**report.to_dict(), "grouped": single})
    assert "groups/mig" not in names and "groups/explicitness" in names


def test_the_report_is_json_without_nan_and_says_what_each_group_holds(report):
    assert json.loads(json.dumps(report.to_dict(), allow_nan=False))["grouped"]["codes"] == "own"
    text = report.table()
    assert "ours: what each of 2 groups holds most: group 0 brightness, group 1 place (codes: own; counted on " in text
    assert "counted on 216 rows, learned on 120 training rows" in text


def cells(line, header):
    """Column name -> text of a line in a table of fixed widths, numbers standing to the right."""
    ends = [header.index(name) + len(name) for name in ("chance", "linear", "linear kept")]
    return [line[start:end].strip() for start, end in pairwise(ends)]


def test_figures_stand_in_the_column_of_the_first_probe(report):
    header, *lines = report_table(report).splitlines()
    line = next(line for line in lines if line.startswith("groups: psnr "))
    assert cells(line, header) == ["100.000", ""]


def test_a_comparison_shows_what_only_a_later_run_has(report):
    reports = {"blind": replace(report, grouped=replace(report.grouped, drawing=None)), "drawing": report}
    table = comparison_table(reports)
    rows = {row[0]: row for row in table.rows}
    assert {len(row) for row in table.rows} == {len(table.header)}
    columns = [table.header.index(f"{name}: linear") for name in reports]
    assert [rows["groups: psnr"][column] for column in columns] == ["-", "100.000"]
    assert [rows["groups: held"][column] for column in columns] == ["2.000", "2.000"]


@pytest.mark.parametrize(("train", "held_out"), [(0, 4), (4, 0)])
def test_pictures_of_both_splits_are_needed(tmp_path, monkeypatch, train, held_out):
    store = write_scenes(tmp_path / "half.h5", train=train, held_out=held_out)
    if not held_out:
        store.evaluation[:] = False
        monkeypatch.setattr(store, "episodes", lambda split: np.arange(4) if split == "train" else np.arange(0))
    wanted = f"half.h5: groups need at least 2 training and 2 held-out rows, has {12 * train} and {12 * held_out}; see"
    with pytest.raises(UserError, match=re.escape(wanted)) as error:
        measured(store)
    assert "\n" not in str(error.value)


def test_groups_without_the_probe_are_refused():
    with pytest.raises(UserError, match="--groups is of the probe 'groups': add it to --probes"):
        check_options("linear", 0, 2)
    assert check_options("linear,groups", 0, 2) == ("linear", "groups")


def test_a_bundle_without_a_decoder_is_measured_but_not_drawn(store, tmp_path, only_codes):
    encoder, _ = scene_model()
    assert probe_groups(encoder, tmp_path, store, groups=None, seed=0, progress=False).drawing is None


def test_numbers_become_bins_and_vectors_are_taken_apart(tmp_path):
    random = np.random.default_rng(0)
    factors = {
        "kind": FactorSpec("endogenous", "categorical", 3),
        "wind": FactorSpec("exogenous", "continuous", 0, 2),
        "year": FactorSpec("exogenous", "continuous"),
    }
    values = {
        "kind": random.integers(3, size=400),
        "wind": random.normal(size=(400, 2)).astype(np.float32),
        "year": random.choice([1990.0, 1991.0, 2005.0], size=400),
    }
    with EpisodeWriter(
        tmp_path / "mixed.h5",
        rows=400,
        episodes=1,
        observations={"sensor": ArraySpec((1,), "float32")},
        actions=None,
        factors=factors,
    ) as writer:
        writer.add_episode(observations={"sensor": np.zeros((400, 1), np.float32)}, factors=values)
    store = EpisodeStore(tmp_path / "mixed.h5")
    rows = random.permutation(400)[:300]
    found = classes_of(store, rows)
    assert list(found) == ["kind", "wind_0", "wind_1", "year"]
    np.testing.assert_array_equal(found["kind"], values["kind"][rows])
    np.testing.assert_array_equal(found["year"], np.unique(values["year"][rows], return_inverse=True)[1])
    for part in (0, 1):
        ordered = found[f"wind_{part}"][np.argsort(values["wind"][rows, part])]
        assert (np.diff(ordered) >= 0).all() and np.bincount(ordered).tolist() == pytest.approx([30] * 10, abs=2)
    assert all(labels.dtype == np.int64 and labels.shape == (300,) for labels in found.values())


@pytest.mark.parametrize(("clusters", "kind"), [(4, "k-means 4"), (None, "k-means 15"), (1000, "k-means 15")])
def test_so_many_clusters_as_asked_for_but_no_more_than_the_rows_allow(store, only_codes, monkeypatch, clusters, kind):
    kinds = []
    monkeypatch.setattr(group_probe, "GroupReport", lambda positions, groups, kind, found, drawing: kinds.append(kind))
    encoder, _ = scene_model(quantised=False)
    measure_groups(encoder, None, store, groups=2, clusters=clusters, progress=False)
    assert kinds == [kind]


def test_clusters_without_the_probe_or_too_few_are_refused():
    with pytest.raises(UserError, match="--clusters is of the probe 'groups'"):
        check_options("linear", 0, None, 8)
    with pytest.raises(UserError, match="--clusters must be at least 2, is 1"):
        check_options("linear,groups", 0, None, 1)
