"""Scores of a classifier on held-out clips, with everything there and with modalities missing."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from clip_stores import ACTIVITIES, MODALITIES, SENSORS, VIEWS, write_clips
from recognition_fakes import Reader, Votes, told_by_sensor
from sklearn.metrics import accuracy_score, confusion_matrix, f1_score

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.recognition import measure_recognition, report_of
from repdib_lightning.evaluation.recognition_pass import Recognised, recognise
from repdib_lightning.evaluation.recognition_tables import recognition_comparison, recognition_text
from repdib_lightning.evaluation.recognition_without import modalities_of, others, taken_away, ways_to_miss
from repdib_lightning.evaluation.splits import rows_of
from repdib_lightning.records import ArraySpec, DataSpec

THREE = ACTIVITIES[:3]
HELD_OUT = {"subject": ["2", "4"]}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "clips.h5"
    write_clips(path, clips=144, frames=2, size=12, steps=10, missing=False)
    return EpisodeStore(path, held_out=HELD_OUT)


def measured(store, looks_at, classifier=None):
    return measure_recognition(Reader(store, looks_at), classifier or Votes(THREE), store, progress=False)


def told(predicted, labels, classes):
    names = tuple(f"class {number}" for number in range(classes))
    whole = Recognised(np.arange(len(labels)), [], np.empty((len(labels), classes)), {(): predicted}, {}, {})
    return report_of(whole, labels, Votes(names, order=[]))


@pytest.mark.parametrize("seed", range(4))
def test_scores_are_those_of_scikit_learn_also_where_classes_do_not_occur(seed):
    random = np.random.default_rng(seed)
    labels = random.choice([0, 1, 4, 5], 90)
    predicted = np.where(random.random(90) < 0.6, labels, random.choice([0, 2, 4], 90))
    report = told(predicted, labels, 7)
    for average in ("macro", "micro", "weighted"):
        expected = f1_score(labels, predicted, average=average, zero_division=0)
        assert getattr(report.scores, f"f1_{average}") == pytest.approx(expected, abs=1e-6)
    assert report.scores.accuracy == pytest.approx(accuracy_score(labels, predicted)) == report.scores.f1_micro
    assert report.confusion == confusion_matrix(labels, predicted, labels=range(7)).tolist()
    each = f1_score(labels, predicted, average=None, labels=range(7), zero_division=0)
    assert [f1 for f1 in report.f1.values() if f1 is not None] == pytest.approx(np.delete(each, [3, 6]), abs=1e-6)
    assert report.f1["class 3"] is report.f1["class 6"] is None, "they neither occur nor are predicted"
    most = np.full(90, np.bincount(labels).argmax())
    assert report.chance == pytest.approx(f1_score(labels, most, average="macro", zero_division=0))


def test_all_held_out_clips_are_scored_and_no_other(store):
    looks = Reader(store, ["acceleration"])

    class Shifted(Votes):
        """Takes every class for the next one where the first reading is negative."""

        def forward(self, latents):
            return latents.roll(1, 1) if self.roll else latents

    shifted = Shifted(THREE)
    shifted.roll = False
    report = measure_recognition(looks, shifted, store, progress=False)
    rows = rows_of(store, store.episodes("evaluation"))
    assert report.clips == len(rows) == 72 == np.sum(report.confusion), "more than a batch"
    seen = torch.cat([batch["acceleration"] for batch in looks.batches if present_everywhere(batch)])
    np.testing.assert_array_equal(seen.numpy(), store.gather("observations/acceleration", rows))
    predicted = told_by_sensor(seen, 0.1).clamp(0, 2).numpy()
    labels = store.gather("factors/activity", rows)
    assert report.confusion == confusion_matrix(labels, predicted, labels=range(3)).tolist()
    shifted.roll = True
    wrong = measure_recognition(looks, shifted, store, progress=False)
    assert wrong.confusion == np.roll(report.confusion, 1, axis=1).tolist(), "rows are true classes"


def present_everywhere(batch):
    return all(array.any() if array.dtype == torch.uint8 else array.isfinite().any() for array in batch.values())


def test_a_classifier_of_one_modality_drops_to_chance_without_it_and_needs_no_other(store):
    report = measured(store, ["cam2"])
    assert report.scores.f1_macro == 1.0 and report.only["cam2"] == 1.0
    assert report.without["cam2"].f1_macro == pytest.approx(report.chance, abs=1e-6)
    assert report.without["cam2"].accuracy == pytest.approx(1 / 3)
    for name in set(MODALITIES) - {"cam2"}:
        assert report.without[name].f1_macro == 1.0
        assert report.only[name] == pytest.approx(report.chance, abs=1e-6)


def test_two_that_can_stand_in_for_each_other_are_not_missed(store):
    report = measured(store, ["cam1", "gyroscope"])
    assert all(scores.f1_macro > 0.95 for scores in report.without.values())
    assert report.only["cam1"] == 1.0 and report.only["gyroscope"] > 0.95
    assert report.only["orientation"] == pytest.approx(report.chance, abs=1e-6)


def test_what_is_taken_away_is_stored_as_missing_and_all_else_stays(store):
    looks = Reader(store, ["cam1"])
    recognise(looks, Votes(THREE), store, np.arange(5), progress=False)
    missing = [
        {name for name, array in batch.items() if not array.any() or not array.isfinite().any()}
        for batch in looks.batches
    ]
    names = modalities_of(looks.spec)
    assert sorted(map(sorted, missing)) == sorted(map(sorted, ways_to_miss(names)))
    assert len(missing) == 1 + 2 * len(MODALITIES)
    batch = looks.batches[0]
    less = taken_away(batch, ["cam1", "gyroscope"])
    assert not less["cam1"].any() and less["cam1"].dtype == torch.uint8 and less["gyroscope"].isnan().all()
    assert less["cam2"] is batch["cam2"] and batch["cam1"].any() and batch["gyroscope"].isfinite().all()


def test_of_two_modalities_one_missing_is_the_other_alone_and_of_one_nothing_is_taken():
    assert ways_to_miss(["a", "b"]) == [(), ("a",), ("b",)]
    assert ways_to_miss(["a"]) == ways_to_miss([]) == [()]
    assert others(["a", "b", "c"], "b") == ("a", "c")
    spec = DataSpec(
        {"still": ArraySpec((3, 8, 8)), "state": ArraySpec((4,), "float32"), "t": ArraySpec((9, 4), "float32")}
    )
    assert modalities_of(spec) == ["t"]


def test_weights_are_means_over_clips_and_codes_of_what_is_missing_do_not_count(tmp_path):
    write_clips(tmp_path / "some.h5", clips=30, frames=4, size=12, evaluation=("1", "2", "3", "4"))
    store = EpisodeStore(tmp_path / "some.h5")
    report = measured(store, [*VIEWS, *SENSORS])
    assert sum(report.attention.values()) == pytest.approx(1.0)
    whole = [1 / 5] * 24 + [1 / 4] * 6
    lacking = sum(not store.gather("observations/cam1", np.array([row])).any() for row in range(30))
    assert lacking == 2 and report.attention["cam1"] == pytest.approx((sum(whole) - 2 / 4) / 30)
    assert report.perplexity == dict.fromkeys(report.perplexity, 1.0) and set(report.perplexity) == set(MODALITIES)


def test_the_order_of_classes_is_the_classifiers_own(store):
    mixed = ("sitting", "waving", "walking")
    straight, turned = measured(store, ["cam1"]), measured(store, ["cam1"], Votes(mixed))
    assert straight.scores.f1_macro == turned.scores.f1_macro == 1.0
    assert turned.classes == list(mixed) and turned.confusion == straight.confusion
    # Nothing speaks for walking, which is told as the first class.
    broken = Votes(mixed, order=[2, 0, 0])
    report = measured(store, ["cam1"], broken)
    assert report.f1["waving"] == 1.0 and report.f1["walking"] == 0.0 and report.confusion[2] == [24, 0, 0]


def test_the_record_is_plain(store):
    plain = measured(store, ["cam1"]).to_dict()
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain
    assert {"f1_macro", "f1_micro", "f1_weighted", "accuracy"} == set(plain["without"]["cam1"]) < set(plain)
    assert set(plain["f1"]) == set(THREE) and plain["clips"] == 72 and plain["target"] == "activity"
    assert {"only", "attention", "perplexity", "confusion", "classes"} < set(plain) and "scores" not in plain


def test_tables_name_what_is_missing_and_the_worst_classes(store):
    report = measured(store, ["cam1"])
    lines = {line.split("  ")[0]: line.split() for line in recognition_text(report).splitlines()}
    assert lines["with everything there"][-4:] != lines["without cam1"][-4:]
    assert lines["with everything there"][3] == "1.000" and lines["without cam1"][2] == f"{report.chance:.3f}"
    assert "F1 of waving" in lines and "cam1 alone" in lines
    table = recognition_comparison({"a": report, "b": measured(store, ["cam2"])})
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["macro F1 without cam1"] == [f"{report.chance:.3f}", "1.000"]
    assert {len(row) for row in table.rows} == {3}
    many = told(np.arange(9), np.arange(9) // 2 * 2, 9)
    text = recognition_text(many)
    assert text.count("F1 of class") == 6 and "without" not in text


class Broken(Votes):
    def forward(self, latents):
        return super().forward(latents) * torch.nan


@pytest.mark.parametrize(
    ("classifier", "message"),
    [
        (Votes(THREE, target="activty"), "no factor 'activty', which the bundle recognises, did you mean 'activity'"),
        (Votes(("waving", "walking", "seating"), order=[0]), "has the class 'sitting', which the bundle does not know"),
        (Votes((*THREE, "flying"), order=[0]), "'activity' has no class 'flying', which the bundle recognises"),
        (Votes(("waving", "walking")), "has the class 'sitting', which the bundle does not know"),
        (Broken(THREE), "the classifier returns NaN or infinite values at row"),
    ],
)
def test_what_does_not_fit_is_one_line(store, classifier, message):
    with pytest.raises(UserError, match=message) as raised:
        measured(store, ["cam1"], classifier)
    assert "clips.h5: " in str(raised.value) and "\n" not in str(raised.value)


def test_a_store_without_held_out_clips_is_refused(tmp_path):
    write_clips(tmp_path / "few.h5", clips=3, frames=2, size=12, steps=6)
    with pytest.raises(UserError, match=r"few\.h5: has no clips to recognise; mark some in 'episodes/evaluation'"):
        measured(EpisodeStore(tmp_path / "few.h5"), ["cam1"])
