"""Splits by values of factors: who is held out, that nobody else is, and what bad input says."""

import pickle

import h5py
import numpy as np
import pytest
from clip_stores import write_clips

from repdib_lightning.data.datamodule import EpisodeDataModule
from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.data.fingerprint import recompute_fingerprint
from repdib_lightning.errors import UserError


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    return write_clips(tmp_path_factory.mktemp("clips") / "clips.h5", clips=60, evaluation=("1",), per_recording=2)


def value(store, factor):
    return store.array(f"factors/{factor}")[store.starts]


@pytest.mark.parametrize("named", [["2", "4"], [2, "4"], [4, 2, 2]])
def test_the_episodes_that_have_a_value_are_held_out_and_no_others(clips, named):
    store = EpisodeStore(clips, {"subject": named})
    held_out = np.isin(value(store, "subject"), [1, 3])
    assert 0 < held_out.sum() < 60
    assert np.array_equal(store.episodes("evaluation"), np.flatnonzero(held_out))
    assert np.array_equal(store.episodes("train"), np.flatnonzero(~held_out))


def test_any_of_several_factors_holds_out(clips):
    store = EpisodeStore(clips, {"subject": ["1"], "session": ["2"]})
    held_out = (value(store, "subject") == 0) | (value(store, "session") == 1)
    assert np.array_equal(store.episodes("evaluation"), np.flatnonzero(held_out))
    assert len(store.episodes("train")) > 0


def test_what_the_file_marks_stays_what_it_marks(clips):
    plain, split = EpisodeStore(clips), EpisodeStore(clips, {"subject": ["3"]})
    assert np.array_equal(split.evaluation, plain.evaluation) and plain.evaluation.any()
    assert plain.held_out is None and split.held_out == {"subject": ["3"]}
    assert not np.array_equal(plain.episodes("train"), split.episodes("train"))
    assert recompute_fingerprint(split) == split.fingerprint
    assert EpisodeStore(clips, {}).held_out is None


def test_a_copy_in_another_process_is_split_alike(clips):
    store = EpisodeStore(clips, {"session": [2]})
    store.array("factors/session")
    copy = pickle.loads(pickle.dumps(store))
    for split in ("train", "evaluation"):
        assert np.array_equal(copy.episodes(split), store.episodes(split))
    assert copy.held_out == store.held_out == {"session": ["2"]}


def test_values_without_names_are_their_numbers(make_store, tmp_path):
    path = make_store(tmp_path / "a.h5", lengths=(1,) * 12, kind=None)
    with h5py.File(path, "r+") as file:
        file["factors/cell"][:] = np.arange(12) % 4
    assert EpisodeStore(path, {"cell": [3]}).episodes("evaluation").tolist() == [3, 7, 11]


@pytest.mark.parametrize(
    ("held_out", "message"),
    [
        (
            {"subject": ["21"]},
            r"clips\.h5: held_out: subject has no '21', did you mean '[12]'\? \(choices: 1, 2, 3, 4\)",
        ),
        ({"activity": ["wavin"]}, r"activity has no 'wavin', did you mean 'waving'"),
        ({"sujbect": ["1"]}, r"has no factor 'sujbect', did you mean 'subject'\?"),
        ({"subject": [1, 2, 3, 4]}, r"each of 60 episodes has subject 1, 2, 3, 4, none is left.*subject is 1, 2, 3, 4"),
        ({"subject": []}, r"held_out: subject is \[\]; name the values to hold out"),
        ({"subject": "1"}, r"held_out: subject is '1'; name the values"),
    ],
)
def test_bad_splits_are_one_line(clips, held_out, message):
    with pytest.raises(UserError, match=message) as error:
        EpisodeStore(clips, held_out)
    assert "\n" not in str(error.value)


def test_a_split_with_no_test_subject_tells_who_is_there(tmp_path):
    path = write_clips(tmp_path / "few.h5", clips=6)  # subjects 1 and 2 of four
    with pytest.raises(UserError, match=r"few\.h5: held_out: none of 6 episodes has subject 3, 4; subject is 1, 2$"):
        EpisodeDataModule(str(path), 2, futures=0, held_out={"subject": [3, 4]}).setup()
    EpisodeStore(path, {"subject": [2, 3]})


def test_factors_that_cannot_split(make_store, tmp_path):
    path = make_store(tmp_path / "a.h5")
    with pytest.raises(UserError, match=r"factor 'light' is continuous, choices: cell"):
        EpisodeStore(path, {"light": [1]})
    with pytest.raises(UserError, match=r"factor 'cell' changes within episode 0; episodes are held out whole"):
        EpisodeStore(path, {"cell": [1]})


def test_a_configuration_may_write_numbers(clips):
    from jsonargparse import ArgumentParser

    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(EpisodeDataModule, "data")
    parsed = parser.parse_string(
        f"data: {{path: {clips}, futures: 0, target: activity, held_out: {{subject: [3, 4]}}}}"
    )
    data = parser.instantiate(parsed).data
    data.setup()
    assert data.held_out == {"subject": ["3", "4"]}
    assert set(value(data.store, "subject")[data.store.episodes("evaluation")]) == {2, 3}
