import numpy as np
import pytest
import torch

from repdib_lightning.errors import UserError
from repdib_lightning.evaluation.mlp import build_mlp
from repdib_lightning.evaluation.probes import (
    PROBES,
    Half,
    Standardiser,
    chance,
    check_probes,
    explained,
    measure,
    rate,
)


def halves(features, target, episodes):
    fit = episodes % 2 == 0
    return tuple(Half(features[part], target[part], episodes[part]) for part in (fit, ~fit))


def embedded_episodes(seed, features=12, episodes=200, length=4):
    """Features that are the same within an episode and unique across; a balanced label that episodes draw at random."""
    generator = np.random.default_rng(seed)
    label = np.empty(episodes, int)
    for half in (0, 1):
        label[half::2] = generator.permutation(np.arange(episodes // 2) % 2)
    group = np.repeat(np.arange(episodes), length)
    return generator.normal(size=(episodes, features))[group], label[group], group


def test_features_that_only_name_the_episode_say_nothing_of_a_factor_constant_in_it():
    kept = []
    for seed in range(4):
        fit, score = halves(*embedded_episodes(seed))
        kept.append([measure(probe, fit, score, 0).raw_kept for probe in PROBES])
    assert np.abs(np.mean(kept, axis=0)).max() < 0.15


def test_the_same_features_would_read_the_factor_perfectly_if_rows_were_split_instead_of_episodes():
    features, label, _ = embedded_episodes(0, features=250)
    rows = np.arange(len(label))
    fit, score = (Half(features[p], label[p], rows[p]) for p in (rows % 2 == 0, rows % 2 == 1))
    assert measure("linear", fit, score, 0).score > 0.95


def test_a_one_hot_of_the_episode_gives_exactly_chance():
    _, label, episodes = embedded_episodes(1)
    fit, score = halves(np.eye(200)[episodes], label, episodes)
    fit, score = _standardised(fit, score)
    assert {measure(probe, fit, score, 0).kept for probe in PROBES} == {0.0}


def _standardised(fit, score):
    scale = Standardiser(fit.features)
    return (Half(scale(half.features), half.target, half.episodes) for half in (fit, score))


def test_the_mlp_reads_what_no_linear_probe_can():
    generator = np.random.default_rng(0)
    features = generator.normal(size=(800, 2))
    episodes = np.repeat(np.arange(8), 100)
    xor = (features[:, 0] > 0) ^ (features[:, 1] > 0)
    fit, score = halves(features, xor.astype(int), episodes)
    assert measure("linear", fit, score, 0).kept < 0.25
    assert measure("mlp", fit, score, 0).kept > 0.85
    fit, score = halves(features, (features[:, :1] * features[:, 1:]), episodes)
    assert measure("linear", fit, score, 0).kept < 0.1
    assert measure("mlp", fit, score, 0).kept > 0.8


def test_the_mlp_reads_the_size_of_a_value_whose_sign_alone_is_linear():
    features = np.random.default_rng(1).normal(size=(800, 4))
    target = np.stack([np.abs(features[:, 0]), features[:, 1]], axis=1)
    fit, score = halves(features, target, np.repeat(np.arange(8), 100))
    assert measure("linear", fit, score, 0).kept < 0.6
    assert measure("mlp", fit, score, 0).kept > 0.93


def drifting_episodes(seed, episodes=8, length=60, features=32):
    """Few episodes of near copies: slow paths of eight sources, mixed linearly, plus an offset of each episode."""
    generator = np.random.default_rng(seed)
    group = np.repeat(np.arange(episodes), length)
    sources = np.concatenate([_slow(generator.normal(size=(length, 8))) for _ in range(episodes)])
    offsets = generator.normal(size=(episodes, features))[group]
    mixed = sources @ generator.normal(size=(8, features)) / np.sqrt(8.0)
    seen = mixed + 0.6 * offsets + 0.1 * generator.normal(size=mixed.shape)
    return seen, sources, group


def _slow(steps):
    path = np.cumsum(steps, axis=0)
    return (path - path.mean(0)) / path.std(0)


@pytest.mark.parametrize("seed", range(2))
def test_the_mlp_reads_no_less_than_the_linear_probe_where_few_episodes_drift(seed):
    features, sources, episodes = drifting_episodes(seed)
    for target in (sources[:, :2], np.digitize(sources[:, 0], [-0.8, 0.0, 0.8])):
        fit, score = _standardised(*halves(features, target, episodes))
        linear, mlp = (measure(probe, fit, score, 0).score for probe in PROBES)
        assert linear > 0.5
        assert mlp > linear - 0.03


def test_class_numbers_need_not_be_dense_and_unseen_classes_count_as_wrong():
    generator = np.random.default_rng(0)
    label = generator.choice([3, 70], size=400)
    episodes = np.repeat(np.arange(8), 50)
    features = np.eye(2)[(label == 70).astype(int)]
    label = np.where((episodes % 2 == 1) & (generator.uniform(size=400) < 0.5), 12, label)
    fit, score = halves(features, label, episodes)
    expected = np.mean(score.target != 12)
    for probe in PROBES:
        assert measure(probe, fit, score, 0).score == pytest.approx(expected)


def test_a_single_class_in_the_fit_half_predicts_that_class():
    episodes = np.repeat(np.arange(4), 10)
    label = np.where(episodes == 1, 1, 0)
    fit, score = halves(np.random.default_rng(0).normal(size=(40, 3)), label, episodes)
    for probe in PROBES:
        assert measure(probe, fit, score, 0).score == 0.5
        assert measure(probe, fit, score, 0).kept == 0.0


def test_chance_is_the_fit_halfs_majority_scored_on_the_score_half():
    fit = Half(np.zeros((5, 1)), np.array([2, 2, 2, 0, 1]), np.zeros(5))
    score = Half(np.zeros((4, 1)), np.array([0, 0, 0, 2]), np.ones(4))
    assert chance(fit, score) == 0.25
    assert chance(Half(fit.features, np.zeros((5, 1)), fit.episodes), score) == 0.0


@pytest.mark.parametrize(
    ("score", "by_chance", "raw", "kept"),
    [(0.75, 0.5, 0.5, 0.5), (1.0, 0.2, 1.0, 1.0), (-3.0, 0.0, -3.0, 0.0), (0.1, 0.2, -0.125, 0.0)],
)
def test_kept_is_the_way_from_chance_to_perfect(score, by_chance, raw, kept):
    rated = rate(score, by_chance, {})
    assert (rated.raw_kept, rated.kept) == (pytest.approx(raw), pytest.approx(kept))


def test_nothing_is_said_of_a_factor_that_does_not_vary():
    assert rate(1.0, 1.0, {}).kept is None
    assert explained(np.zeros((4, 1)), np.full((4, 1), 3.0)) is None
    half_dead = np.stack([np.full(4, 3.0), np.arange(4.0)], axis=1)
    assert explained(half_dead, half_dead) == 1.0


def test_r2_is_the_mean_over_dimensions_and_zero_for_the_mean():
    target = np.random.default_rng(0).normal(size=(50, 2)) * [1.0, 1000.0]
    mean = np.broadcast_to(target.mean(0), target.shape)
    assert explained(mean, target) == pytest.approx(0.0)
    assert explained(np.stack([target[:, 0], mean[:, 1]], axis=1), target) == pytest.approx(0.5)


def test_the_standardiser_uses_the_fit_half_only_and_silences_dimensions_that_do_not_vary_there():
    fit = np.array([[0.0, 5.0, 1e6], [2.0, 5.0, 1e6 + 1e-3]], np.float64)
    scale = Standardiser(fit)
    assert scale(fit)[:, 0].tolist() == [-1.0, 1.0]
    assert np.abs(scale(np.array([[4.0, 7.0, 2e6]]))).tolist() == [[3.0, 0.0, 0.0]]


def test_a_probe_neither_reads_nor_moves_the_global_random_state():
    features, label, episodes = embedded_episodes(0)
    fit, score = halves(features, label, episodes)
    torch.manual_seed(1)
    first = measure("mlp", fit, score, 3)
    torch.manual_seed(2)
    before = torch.get_rng_state()
    assert measure("mlp", fit, score, 3) == first
    assert torch.equal(torch.get_rng_state(), before)


def test_the_seed_moves_the_score_where_a_correction_is_learned():
    features = np.random.default_rng(0).normal(size=(400, 2))
    fit, score = halves(features, np.abs(features[:, :1]), np.repeat(np.arange(8), 50))
    first, again, other = (measure("mlp", fit, score, seed) for seed in (0, 0, 1))
    assert first == again and first.choice["epochs"] > 0
    assert other.score != first.score


def test_seeds_change_the_network_and_early_stopping_ends_before_it_learns_noise_by_heart():
    first, same, other = (build_mlp(3, 2, torch.Generator().manual_seed(seed))[0].weight.detach() for seed in (0, 0, 1))
    assert torch.equal(first, same) and not torch.equal(first, other)
    generator = np.random.default_rng(0)
    fit, score = halves(generator.normal(size=(600, 20)), generator.integers(2, size=600), np.repeat(np.arange(8), 75))
    assert measure("mlp", fit, score, 0).choice["epochs"] <= 5


def test_an_unknown_probe_names_the_nearest():
    with pytest.raises(UserError, match="unknown probe 'liner', did you mean 'linear'"):
        check_probes(("liner",))
    with pytest.raises(UserError, match="at least one"):
        check_probes(())
