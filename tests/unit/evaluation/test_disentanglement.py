import json
from dataclasses import replace

import numpy as np
import pytest

from repdib_lightning.evaluation import group_predictors
from repdib_lightning.evaluation.disentanglement import (
    compactness,
    importance_scores,
    measure_disentanglement,
    modularity,
    mutual_information_gap,
)
from repdib_lightning.evaluation.factor_information import adjusted_information
from repdib_lightning.evaluation.group_predictors import explicitness, group_importance, latent_features, task_of

ROWS = 800
NAMES = ("style", "species")
WIDTH = 16
"""Of the vectors that stand for codes."""


def drawn(seed=0, rows=ROWS, classes=(6, 10)):
    """Two factors that know nothing of each other, and the rows to fit and to score."""
    generator = np.random.default_rng(seed)
    factors = {name: generator.integers(c, size=rows) for name, c in zip(NAMES, classes, strict=True)}
    fit = generator.permutation(rows) < rows // 2
    return generator, factors, {"fit": fit, "score": ~fit}


def vectors(codes, width=WIDTH):
    """(n, G) codes as (n, G, D): a random vector for each code of each group, as in a codebook."""
    books = np.random.default_rng(9).normal(size=(codes.shape[1], codes.max() + 1, width))
    return np.stack([book[column] for book, column in zip(books, codes.T, strict=True)], axis=1)


def one_hot(codes):
    """(n, G) codes as (n, G, K), a dimension for each of K codes that are used."""
    _, used = np.unique(codes, return_inverse=True)
    return np.eye(used.max() + 1)[used.reshape(codes.shape)]


def measure(codes, factors, halves, seed=0, embed=vectors, **options):
    """Of (n, G) codes at one position, and of the latents that stand for them."""
    return measure_disentanglement(codes[:, None], embed(codes), factors, **halves, seed=seed, **options)


@pytest.fixture(params=[vectors, one_hot])
def embed(request):
    return request.param


def perfect(codes_per_class, embed):
    """Group g is factor g, each class under several codes with random names."""
    generator, factors, halves = drawn()
    columns = [v * codes_per_class + generator.integers(codes_per_class, size=ROWS) for v in factors.values()]
    return measure(generator.permutation(512)[np.stack(columns, axis=1)], factors, halves, embed=embed)


def random_codes(**options):
    generator, factors, halves = drawn(3)
    return measure(generator.integers(512, size=(ROWS, 2)), factors, halves, **options)


@pytest.fixture(scope="module")
def random():
    return random_codes()


def test_factorised_codes_reach_one_in_every_score(embed):
    factorised = perfect(1, embed)
    scores = ("modularity", "compactness", "mig", "explicitness", "disentanglement", "completeness", "informativeness")
    low = {name: getattr(factorised, name) for name in scores if not 0.93 < getattr(factorised, name) <= 1.0}
    assert not low
    assert factorised.holds == ["style", "species"]
    assert factorised.adjusted["style"][0] == pytest.approx(1.0)
    assert factorised.explicitness_by_group["style"][0] > 0.95 and factorised.explicitness_by_group["style"][1] < 0.02
    assert factorised.importance["species"][1] > 0.95


def test_several_codes_a_class_cost_nothing(embed):
    measured = perfect(4, embed)
    assert min(measured.modularity, measured.compactness, measured.mig) > 0.95
    assert min(measured.explicitness, measured.informativeness, measured.disentanglement) > 0.8
    assert measured.holds == ["style", "species"]


def test_groups_that_each_hold_every_factor_score_near_zero(embed):
    generator, factors, halves = drawn(classes=(6, 6))
    every = factors["style"] * 6 + factors["species"]
    codes = np.stack([generator.permutation(36)[every] for _ in range(2)], axis=1)
    measured = measure(codes, factors, halves, embed=embed)
    near_zero = ("modularity", "compactness", "mig", "disentanglement", "completeness")
    assert not {name: getattr(measured, name) for name in near_zero if abs(getattr(measured, name)) > 0.05}
    assert measured.explicitness > 0.9 and measured.informativeness > 0.9
    assert None not in measured.holds


def test_one_group_with_all_is_neither_modular_nor_a_reason_for_compactness(embed):
    generator, factors, halves = drawn()
    codes = np.stack([factors["style"] * 10 + factors["species"], generator.integers(60, size=ROWS)], axis=1)
    measured = measure(codes, factors, halves, embed=embed)
    assert measured.modularity < 0.1 and measured.compactness is None
    assert measured.mig > 0.9 and measured.completeness > 0.8 and measured.disentanglement < 0.1
    assert measured.holds[1] is None


def test_random_codes_hold_nothing(random):
    assert min(random.normalised["species"]) > 0.3  # what the plain measure makes of nothing
    assert random.holds == [None, None]
    assert random.modularity is None and random.compactness is None
    assert max(abs(v) for name in NAMES for v in random.adjusted[name]) < 0.05
    assert random.mig < 0.1 and max(random.disentanglement, random.completeness) < 0.05
    assert abs(random.explicitness) < 0.05 and abs(random.informativeness) < 0.1


def test_information_is_of_both_halves_and_of_no_other_row():
    generator, factors, halves = drawn()
    codes = generator.integers(8, size=(ROWS, 2))
    fit, score = halves["fit"] & (np.arange(ROWS) % 3 > 0), halves["score"] & (np.arange(ROWS) % 3 > 0)
    inside = fit | score
    codes[~inside, 0] = factors["style"][~inside]
    codes[inside, 1] = factors["species"][inside]
    measured = measure(codes, factors, {"fit": fit, "score": score})
    assert measured.holds == [None, "species"]
    direct = adjusted_information(codes[inside], {name: values[inside] for name, values in factors.items()}, 0)
    assert [measured.bits[name] for name in NAMES] == direct.bits.T.tolist()


def test_learning_by_heart_is_not_explicit():
    generator, factors, halves = drawn()
    codes = np.arange(ROWS)[:, None] % 400
    codes[halves["score"], 0] = generator.permutation(400)
    task = task_of(factors["style"], **halves)
    assert abs(explicitness(latent_features(vectors(codes), halves["fit"])[0], task, 0)) < 0.02


def test_explicitness_is_the_share_of_entropy_predicted(embed):
    """A code that tells one half of the classes from the other says log 2 of log 4."""
    factor = np.arange(4000) % 4
    halves = {"fit": np.arange(4000) < 2000, "score": np.arange(4000) >= 2000}
    task = task_of(factor, **halves)
    features = latent_features(embed((factor // 2)[:, None]), halves["fit"])[0]
    assert explicitness(features, task, 0) == pytest.approx(0.5, abs=0.01)


def test_explicitness_of_all_groups_adds_what_each_knows(embed):
    generator, factors, halves = drawn(classes=(6, 4))
    codes = np.stack([factors["species"] // 2, factors["species"] % 2, generator.integers(9, size=ROWS)], axis=1)
    measured = measure(codes, {"species": factors["species"]}, halves, embed=embed)
    alone = measured.explicitness_by_group["species"]
    assert alone == pytest.approx([0.5, 0.5, 0.0], abs=0.03)
    assert measured.explicitness_by_factor["species"] > 0.95
    assert measured.modularity is None and measured.disentanglement is None, "one factor"
    assert measured.compactness == pytest.approx(0.0, abs=0.05)


def test_codes_at_several_positions_are_read_together():
    _, factors, halves = drawn(classes=(6, 4))
    grid = np.stack([factors["species"] // 2, factors["species"] % 2], axis=1)[:, :, None]
    still = np.zeros((ROWS, 2, 1), np.int64)
    latents = np.stack([vectors(part[..., 0]).reshape(ROWS, -1) for part in (grid, still)], axis=1)
    codes = np.concatenate([grid, still], axis=2)
    measured = measure_disentanglement(codes, latents, factors, **halves, seed=0)
    assert measured.groups == 2 and measured.holds == ["species", None]
    assert measured.explicitness_by_group["species"][0] > 0.95
    assert measured.share["species"][0] == pytest.approx(0.5, abs=0.02), "mean over positions"
    assert measured.importance["species"] == pytest.approx([1.0, 0.0])


def test_names_of_codes_change_nothing():
    generator, factors, halves = drawn()
    codes = generator.integers(30, size=(ROWS, 2))
    codes[:500, 0], codes[300:, 1] = factors["style"][:500], factors["species"][300:]
    latents = vectors(codes)
    before = measure(codes, factors, halves, seed=1)
    after = measure(512 - generator.permutation(30)[codes], factors, halves, seed=1, embed=lambda _: latents)
    for name in ("modularity", "compactness", "mig"):
        assert getattr(after, name) == pytest.approx(getattr(before, name), abs=1e-9)
    for name in ("explicitness", "disentanglement", "completeness", "informativeness", "holds", "importance"):
        assert getattr(after, name) == getattr(before, name)


def test_ratio_scores_of_a_table_done_by_hand():
    _, factors, _ = drawn()
    codes = np.stack(list(factors.values()), axis=1)
    table = replace(
        adjusted_information(codes, factors, 0), share=np.array([[0.6, 0.2], [0.1, 0.5]]), p=np.zeros((2, 2))
    )
    assert modularity(table) == pytest.approx(2 * ((0.6 / 0.8 + 0.5 / 0.6) / 2) - 1)
    assert compactness(table) == pytest.approx(2 * ((0.6 / 0.7 + 0.5 / 0.7) / 2) - 1)
    assert mutual_information_gap(table) == pytest.approx((0.5 + 0.3) / 2)
    pruned = replace(table, p=np.array([[0.0, 0.0], [1.0, 1.0]]))
    assert modularity(pruned) == pytest.approx(2 * 0.75 - 1) and compactness(pruned) is None


def test_importance_scores_done_by_hand():
    assert importance_scores(np.eye(3)) == pytest.approx((1.0, 1.0))
    assert importance_scores(np.ones((2, 3))) == pytest.approx((0.0, 0.0))
    entropy = -(0.75 * np.log2(0.75) + 0.25 * np.log2(0.25))
    disentanglement, completeness = importance_scores(np.array([[0.75, 0.25], [0.0, 1.0]]))
    assert disentanglement == pytest.approx((1.0 * (1 - entropy) + 1.0 * 1.0) / 2)
    assert completeness == pytest.approx((1.0 + 1.0 - -(0.2 * np.log2(0.2) + 0.8 * np.log2(0.8))) / 2)
    assert importance_scores(np.zeros((2, 2))) == (None, None)
    assert importance_scores(np.array([[1.0], [0.5]]))[0] is None
    assert importance_scores(np.array([[1.0, 0.5]]))[1] is None


def test_importance_goes_to_the_group_that_knows_though_the_other_has_more_codes(embed):
    generator, factors, halves = drawn()
    codes = np.stack([generator.integers(512, size=ROWS), factors["style"]], axis=1)
    blocks = latent_features(embed(codes), halves["fit"])
    shares, gain = group_importance(blocks, task_of(factors["style"], **halves), 0)
    assert shares.sum() == pytest.approx(1.0) and shares[1] > 0.95 and gain > 0.95


def test_undefined_is_none_and_never_nan():
    _, factors, halves = drawn()
    dead = np.zeros((ROWS, 2), np.int64)
    alone = measure(factors["style"][:, None], factors, halves)
    still = measure(dead, {**factors, "still": dead[:, 0]}, halves)
    assert alone.completeness is None and alone.mig is None and alone.compactness is None
    assert alone.modularity > 0.95 and alone.holds == ["style"]
    assert still.disentanglement is None and still.informativeness is None and still.modularity is None
    assert still.holds == [None, None] and still.mig == 0.0 and still.explicitness == pytest.approx(0.0, abs=0.01)
    assert still.bits["style"] == [0.0, 0.0] and still.p["style"] == [1.0, 1.0]
    assert still.bits["still"] == still.p["still"] == still.explicitness_by_group["still"] == [None, None]
    assert still.explicitness_by_factor["still"] is None
    for measured in (alone, still):
        assert json.loads(json.dumps(measured.to_dict(), allow_nan=False)) == measured.to_dict()


def test_classes_without_fit_rows_are_left_out():
    _, factors, halves = drawn()
    unseen = np.where(halves["score"] & (factors["style"] == 0), 99, factors["style"])
    task = task_of(unseen, **halves)
    assert len(task.truth) == np.sum(halves["score"] & (unseen != 99))
    assert task_of(np.where(halves["score"], 99, unseen), **halves) is None
    codes = np.stack([unseen, factors["species"]], axis=1)
    assert measure(codes, {"f": unseen}, halves).explicitness > 0.95


def test_information_is_counted_of_codes_and_what_is_learned_read_from_latents():
    generator, factors, halves = drawn()
    told = np.eye(6)[factors["style"]] + 0.1 * generator.normal(size=(ROWS, 6))
    latents = np.stack([generator.normal(size=(ROWS, 6)), 1e3 * told], axis=1)
    codes = np.stack([factors["style"], generator.integers(6, size=ROWS)], axis=1)
    measured = measure(codes, factors, halves, embed=lambda _: latents)
    assert measured.explicitness_by_group["style"][1] > 0.95 and abs(measured.explicitness_by_group["style"][0]) < 0.05
    assert measured.importance["style"][1] > 0.9
    assert measured.holds == ["style", None] and measured.share["style"] == pytest.approx([1.0, 0.0], abs=0.02)
    cut = measure_disentanglement(codes[:, :, None], latents.reshape(ROWS, 1, 12), factors, **halves, seed=0)
    assert cut.groups == 1 and cut.explicitness == pytest.approx(measured.explicitness, abs=1e-3)


def test_units_of_latents_change_nothing():
    generator, factors, halves = drawn()
    codes = np.stack([factors["style"], generator.integers(9, size=ROWS)], axis=1)
    plain = measure(codes, factors, halves)
    scaled = measure(codes, factors, halves, embed=lambda codes: 300.0 * vectors(codes) * [[[1.0], [2.0]]] - 70.0)
    for name in ("explicitness", "disentanglement", "completeness", "informativeness"):
        assert getattr(scaled, name) == pytest.approx(getattr(plain, name), abs=1e-3)
    assert scaled.holds == plain.holds == ["style", None]


@pytest.mark.parametrize(
    ("codes", "latents"),
    [((ROWS, 2), (ROWS, 2, 3)), ((ROWS, 1, 2), (ROWS, 6)), ((ROWS, 1, 2), (ROWS, 3, 2)), ((ROWS, 1, 2), (99, 2, 3))],
)
def test_other_shapes_are_refused(codes, latents):
    _, factors, halves = drawn()
    with pytest.raises(AssertionError, match=r"codes|groups"):
        measure_disentanglement(np.zeros(codes, np.int64), np.zeros(latents), factors, **halves, seed=0)


def test_the_same_seed_gives_the_same_figures(random):
    assert random_codes() == random


def test_perfect_groups_are_modular_though_what_is_held_out_is_no_factorial():
    """Each of 20 species is held out in one of 6 styles, where the species names the style."""
    random = np.random.default_rng(0)
    origins = np.repeat(np.arange(120), 6)
    factors = {"style": origins // 20, "species": origins % 20}
    score = factors["style"] == random.integers(6, size=20)[factors["species"]]
    codes = np.stack(list(factors.values()), 1)
    found = measure(codes, factors, {"fit": ~score, "score": score}, origins=origins)
    assert found.modularity > 0.99 and found.compactness > 0.99 and found.mig > 0.99


def test_rows_of_one_origin_are_not_split_over_the_inner_folds(monkeypatch):
    seen = []
    real = group_predictors.task_of

    def spy(labels, fit, score, origins=None):
        seen.append((fit, score))
        return real(labels, fit, score, origins)

    monkeypatch.setattr(group_predictors, "task_of", spy)
    origins = np.repeat(np.arange(40), 5)
    labels, fit = origins % 4, np.arange(200) < 150
    task = real(labels, fit, ~fit, origins)
    explicitness(np.random.default_rng(0).standard_normal((200, 3)), task, 0)
    inside = origins[fit]
    assert seen and all(not set(inside[a]) & set(inside[b]) for a, b in seen)
