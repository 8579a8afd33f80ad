"""The smartwatch recordings of seglearn: windows, recordings, splits, what is refused, and a baseline.

Logistic regression on 30 statistics of each window tells the exercises of two unseen people with a macro F1 of 0.876.
"""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from repdib_lightning.__main__ import main
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.data.importers.smartwatch import import_smartwatch
from repdib_lightning.environments import collect_smartwatch as collecting
from repdib_lightning.environments.collect_smartwatch import collect_smartwatch
from repdib_lightning.errors import UserError

ACTIVITIES = ["PEN", "ABD", "FEL", "IR", "ER", "TRAP", "ROW"]


@pytest.fixture(scope="module")
def source() -> Path:
    """The published file."""
    spec = find_spec("seglearn")
    assert spec is not None and spec.origin is not None
    return Path(spec.origin).parent / "data" / "watch_dataset.npy"


@pytest.fixture(scope="module")
def published(source: Path) -> dict[str, Any]:
    stored: dict[str, Any] = np.load(source, allow_pickle=True).item()
    return stored


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> EpisodeStore:
    path = tmp_path_factory.mktemp("watch") / "watch.h5"
    return EpisodeStore(collect_smartwatch(path, progress=False))


def recordings(lengths: tuple[int, ...] = (260, 200, 90)) -> dict[str, Any]:
    """A dictionary of the published layout: recording n is of subject 20 + n, its reading t is t + channel / 10."""
    return {
        "X": [np.arange(length)[:, None] + np.arange(6) / 10 for length in lengths],
        "y": np.arange(len(lengths)) % 2,
        "subject": 20 + np.arange(len(lengths)),
        "side": np.zeros(len(lengths)),
        "y_labels": ["up", "down"],
        "X_labels": [],
    }


def write(path: Path, content: Any) -> Path:
    np.save(path, np.array(content, dtype=object), allow_pickle=True)
    return path


def test_windows_are_those_of_a_slow_loop(store: EpisodeStore, published: dict[str, Any]) -> None:
    assert store.rows == 2229 and store.lengths.tolist() == [1] * 2229 and store.actions_spec is None
    arrays = {name: store.array(f"observations/{name}") for name in ("acceleration", "gyroscope")}
    factors = {name: store.array(f"factors/{name}") for name in ("activity", "subject", "side")}
    row = 0
    for number, readings in enumerate(published["X"]):
        start = 0
        while start + 200 <= len(readings):
            window = np.concatenate([array[row] for array in arrays.values()], axis=1)
            assert np.array_equal(window, readings[start : start + 200].astype(np.float32))
            levels = [int(published[key][number]) for key in ("y", "subject", "side")]
            assert [int(values[row]) for values in factors.values()] == [levels[0], levels[1] - 1, levels[2]]
            assert store.recordings[row] == number
            row, start = row + 1, start + 100
    assert row == 2229 and set(store.recordings.tolist()) == set(range(140))


def test_factors_names_and_origin(store: EpisodeStore) -> None:
    kinds = {name: (f.kind, f.scale, f.classes) for name, f in store.factors.items()}
    assert kinds == {
        "activity": ("endogenous", "categorical", 7),
        "subject": ("exogenous", "categorical", 10),
        "side": ("exogenous", "categorical", 2),
    }
    stated = {key: json.loads(store.attributes[key]) for key in ("classes", "channels", "rate")}
    people = [str(number) for number in range(1, 11)]
    assert stated["classes"] == {"activity": ACTIVITIES, "subject": people, "side": ["left", "right"]}
    assert stated["channels"]["gyroscope"] == ["wx", "wy", "wz"] and stated["rate"]["acceleration"] == 50
    assert store.attributes["licence"].startswith("BSD") and "1802.01489" in store.attributes["source"]
    assert recompute_fingerprint(store) == store.fingerprint


def test_subjects_nine_and_ten_are_for_evaluation_and_other_splits_are_asked_for(store: EpisodeStore) -> None:
    subjects = np.asarray(store.array("factors/subject"))
    assert np.array_equal(np.flatnonzero(subjects >= 8), store.episodes("evaluation"))
    left = EpisodeStore(store.path, held_out={"side": ["left"]})
    sides = np.asarray(store.array("factors/side"))
    assert np.array_equal(left.episodes("evaluation"), np.flatnonzero(sides == 0))
    others = EpisodeStore(store.path, held_out={"subject": ["1", "2"]})
    assert set(subjects[others.episodes("evaluation")]) == {0, 1}
    for split in (store, left, others):
        apart = [set(split.recordings[split.episodes(part)].tolist()) for part in ("train", "evaluation")]
        assert not apart[0] & apart[1] and len(apart[0] | apart[1]) == 140


def test_a_baseline_recognises_unseen_people(store: EpisodeStore) -> None:
    from sklearn.linear_model import LogisticRegression
    from sklearn.metrics import accuracy_score, f1_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    windows = np.concatenate([store.array(f"observations/{name}") for name in ("acceleration", "gyroscope")], axis=2)
    change = np.abs(np.diff(windows, axis=1)).mean(1)
    statistics = np.concatenate(
        [windows.mean(1), windows.std(1), windows.min(1), windows.max(1), change], axis=1, dtype=np.float64
    )
    activity = np.asarray(store.array("factors/activity"))
    train, test = store.episodes("train"), store.episodes("evaluation")
    classifier = make_pipeline(StandardScaler(), LogisticRegression(max_iter=2000)).fit(
        statistics[train], activity[train]
    )
    told = classifier.predict(statistics[test])
    assert statistics.shape == (2229, 30)
    assert f1_score(activity[test], told, average="macro") == pytest.approx(0.876, abs=0.02)
    assert accuracy_score(activity[test], told) == pytest.approx(0.858, abs=0.02)


class Harmful:
    """Unpickling it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_an_unknown_pickle_is_not_opened_unless_trusted(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    file = write(tmp_path / "watch_dataset.npy", Harmful(mark))
    with pytest.raises(UserError, match=r"watch_dataset\.npy: not the published .* pass --trust [^\n]*$"):
        import_smartwatch(file, tmp_path / "s.h5", progress=False)
    assert not mark.exists()
    with pytest.raises(UserError, match="expected a dictionary of X, y, "):
        import_smartwatch(file, tmp_path / "s.h5", trust=True, progress=False)
    assert mark.exists() and not (tmp_path / "s.h5").exists()


def test_the_verb_opens_a_trusted_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = write(tmp_path / "mine.npy", recordings()), tmp_path / "s.h5"
    words = ["import", "smartwatch", str(file), str(out), "--window", "2", "--hop", "0.5"]
    assert main(words) == 2 and not out.exists()
    assert main([*words, "--trust"]) == 0
    said = capsys.readouterr()
    assert said.out == f"wrote {out}\n"
    assert said.err.endswith("shorter than a window, not imported: 1 of 3 recordings\n")
    store = EpisodeStore(out)
    starts = store.array("observations/acceleration")[:, 0, 0]
    assert starts.tolist() == [0, 25, 50, 75, 100, 125, 150, 0, 25, 50, 75, 100]
    assert store.array("observations/gyroscope")[3, 4].tolist() == pytest.approx([79.3, 79.4, 79.5])
    assert store.recordings.tolist() == [0] * 7 + [1] * 5
    assert json.loads(store.attributes["classes"])["subject"] == ["20", "21", "22"]
    assert main([*words, "--trust"]) == 2
    assert main([*words, "--trust", "--overwrite"]) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"X": [np.zeros((300, 5))] * 3}, r"X\[0\] has shape \(300, 5\); expected \(n, 6\)"),
        ({"X": [np.zeros((300, 6))] * 2}, r"have \[2, 3, 3, 3\] entries"),
        ({"X": [np.zeros((99, 6))] * 3}, r"no recording is as long as window=4\.0 s"),
        ({"y": [0, 1, 2]}, "recording 2 has activity 2, which has no name"),
        ({"side": [0, -1, 0]}, "recording 1 has side -1"),
        ({"subject": ["a", "b", "c"]}, "not recordings"),
    ],
)
def test_other_layouts_are_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    file = write(tmp_path / "x.npy", {**recordings(), **change})
    with pytest.raises(UserError, match=rf"x\.npy: [^\n]*{words}[^\n]*$"):
        import_smartwatch(file, tmp_path / "s.h5", trust=True, progress=False)
    assert not (tmp_path / "s.h5").exists()


def test_what_is_no_pickled_dictionary_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "x.npy"
    with pytest.raises(UserError, match=r"x\.npy: cannot be read \(No such file"):
        import_smartwatch(file, tmp_path / "s.h5", progress=False)
    file.write_bytes(b"no array\n")
    with pytest.raises(UserError, match=r"x\.npy: no pickled dictionary in a \.npy file \([^\n]*$"):
        import_smartwatch(file, tmp_path / "s.h5", trust=True, progress=False)
    incomplete = recordings()
    del incomplete["side"]
    with pytest.raises(UserError, match="key 'side' is missing"):
        import_smartwatch(write(file, incomplete), tmp_path / "s.h5", trust=True, progress=False)


@pytest.mark.parametrize(
    "options",
    [{"window": 0.02}, {"window": 1.01}, {"window": float("nan")}, {"hop": 0.0}, {"hop": -2.0}, {"hop": 0.005}],
)
def test_windows_are_whole_numbers_of_readings(tmp_path: Path, source: Path, options: dict[str, float]) -> None:
    with pytest.raises(
        UserError, match=rf"^{next(iter(options))}=[^\n]*: must be a multiple of 0\.02 s, at least 0\.0"
    ):
        import_smartwatch(source, tmp_path / "s.h5", progress=False, **options)
    assert not list(tmp_path.iterdir())


def test_collecting_without_the_package_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collecting, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"^[^\n]*not installed; run: pip install 'repdib_lightning\[activities\]'$"):
        collect_smartwatch(tmp_path / "s.h5")


def test_collecting_does_not_import_the_package(tmp_path: Path, store: EpisodeStore) -> None:
    out = tmp_path / "s.h5"
    code = (
        "import sys; from repdib_lightning.__main__ import main; "
        f"assert main(['collect', 'smartwatch', {str(out)!r}]) == 0; assert 'seglearn' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    assert out.read_bytes() == store.path.read_bytes()
