import numpy as np
import pytest
from clip_stores import write_clips
from evaluation_fakes import LENGTH, write_store

from repdib_lightning.data.episodes import EpisodeStore
from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.splits import episode_folds, split_evaluation


def test_halves_are_disjoint_interleaved_and_only_of_evaluation_episodes(tmp_path):
    store = write_store(tmp_path / "a.h5", episodes=10, evaluation=7)
    split = split_evaluation(store)
    assert split.fit.tolist() == [3, 5, 7, 9] and split.score.tolist() == [4, 6, 8]
    assert not set(split.fit_rows) & set(split.score_rows)
    assert set(store.row_episodes[split.rows]) == set(store.episodes("evaluation"))
    assert len(split.rows) == 7 * LENGTH and (np.diff(split.rows) == 1).all()


def test_fewer_than_two_evaluation_episodes_is_a_user_error_that_names_the_file(tmp_path):
    store = write_store(tmp_path / "one.h5", episodes=3, evaluation=1)
    with pytest.raises(UserError, match=r"one\.h5.*at least 2 evaluation episodes.*has 1 of 3"):
        split_evaluation(store)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_few_clips_are_a_user_error_or_can_be_probed(tmp_path, count):
    path = write_clips(tmp_path / "clips.h5", clips=12, subjects=12, activities=1)
    store = EpisodeStore(path, {"subject": list(range(1, count + 1))})
    if count == 2:
        with pytest.raises(UserError, match=r"at least 2 rows to fit, has 1 .*; name more values in held_out$"):
            split_evaluation(store)
        return
    split = split_evaluation(store)
    folds = episode_folds(store.row_recordings[split.fit_rows])
    assert len(folds) == 2 and all(0 < fold.sum() < len(fold) for fold in folds)


def test_recordings_are_dealt_and_not_their_clips(tmp_path):
    store = EpisodeStore(
        write_clips(tmp_path / "clips.h5", clips=60, per_recording=4)
    )  # of 15, 4, 9 and 14 are held out
    split = split_evaluation(store)
    fit, score = (set(store.recordings[half].tolist()) for half in (split.fit, split.score))
    assert fit | score == {4, 9, 14} and not fit & score and len(fit) == 2
    assert len(split.fit) == 8 and len(split.score) == 4
    folds = episode_folds(store.row_recordings[split.fit_rows])
    assert [np.unique(store.recordings[split.fit][fold]).tolist() for fold in folds] == [[n] for n in sorted(fit)]


def test_one_recording_of_several_clips_cannot_be_halved(tmp_path):
    path = write_clips(tmp_path / "clips.h5", clips=12, subjects=3, activities=1, per_recording=4)
    with pytest.raises(
        UserError, match=r"at least 2 evaluation recordings .*, has 1 of 3; name more values in held_out"
    ):
        split_evaluation(EpisodeStore(path, {"subject": [1]}))


def test_folds_hold_out_whole_episodes_and_every_row_once():
    episodes = np.repeat([2, 5, 7, 8, 11], [3, 10, 4, 6, 2])
    folds = episode_folds(episodes)
    assert np.sum(folds, axis=0).tolist() == [1] * len(episodes)
    for held_out in folds:
        assert not set(episodes[held_out]) & set(episodes[~held_out])
        assert 0 < held_out.sum() < len(episodes)


def test_a_single_episode_is_cut_into_contiguous_blocks():
    folds = episode_folds(np.zeros(42, int))
    assert np.sum(folds, axis=0).tolist() == [1] * 42
    assert all(np.abs(np.diff(held_out.astype(int))).sum() <= 2 for held_out in folds)


def test_both_halves_see_every_activity_where_activities_take_turns(tmp_path):
    store = EpisodeStore(write_clips(tmp_path / "clips.h5", clips=96, activities=6), held_out={"subject": ["1", "2"]})
    activity, split = store.array("factors/activity"), split_evaluation(store)
    assert set(activity[split.fit_rows]) == set(activity[split.score_rows]) == set(range(6))
    assert abs(len(split.fit_rows) - len(split.score_rows)) <= 1
