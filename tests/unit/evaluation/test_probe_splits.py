import numpy as np
import pytest
from evaluation_fakes import LENGTH, write_store

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
