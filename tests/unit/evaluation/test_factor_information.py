from itertools import permutations, product
from math import log2

import numpy as np
import pytest
from sklearn.metrics import adjusted_mutual_info_score, normalized_mutual_info_score

from repdib_lightning.evaluation.factor_information import (
    adjusted_information,
    enough_permutations,
    expected_information,
    holm,
)

ROWS = 400


def drawn(seed, codes, groups, classes, rows=ROWS):
    """Codes and factors that know nothing of each other."""
    generator = np.random.default_rng(seed)
    factors = {f"f{k}": generator.integers(c, size=rows) for k, c in enumerate(classes)}
    return generator.integers(codes, size=(rows, groups)), factors


def slow_information(first, second):
    """Sum over the joint table, cell by cell, in bits."""
    n, total = len(first), 0.0
    for a, b in product(set(first.tolist()), set(second.tolist())):
        both = sum(1 for x, y in zip(first, second, strict=True) if x == a and y == b)
        if both:
            apart = int((first == a).sum()) * int((second == b).sum())
            total += both / n * log2(n * both / apart)
    return total


def test_bits_are_the_slow_sum_less_the_mean_over_all_shuffles():
    first, second = np.array([0, 0, 1, 1, 2, 2]), np.array([7, 7, 7, 7, 3, 3])
    shuffles = [slow_information(first, second[list(order)]) for order in permutations(range(6))]
    counts = np.unique(first, return_counts=True)[1], np.unique(second, return_counts=True)[1]
    assert expected_information(*counts) == pytest.approx(np.mean(shuffles), abs=1e-12)
    assert expected_information(*counts[::-1]) == pytest.approx(np.mean(shuffles), abs=1e-12)
    measured = adjusted_information(first[:, None], {"f": second}, 0)
    assert measured.bits[0, 0] == pytest.approx(slow_information(first, second) - np.mean(shuffles), abs=1e-12)
    exact = np.mean(np.array(shuffles) >= slow_information(first, second) - 1e-12)
    assert measured.p[0, 0] == pytest.approx(exact, abs=0.06), "6 equal rows: many shuffles tie with the data"


def test_plain_information_agrees_with_the_slow_sum_on_uneven_classes():
    generator = np.random.default_rng(0)
    codes, factor = generator.geometric(0.1, size=(ROWS, 1)), generator.geometric(0.3, size=ROWS)
    measured = adjusted_information(codes, {"f": factor}, 0)
    own, other = slow_information(codes[:, 0], codes[:, 0]), slow_information(factor, factor)
    expected = slow_information(codes[:, 0], factor) / ((own + other) / 2)
    assert measured.normalised[0, 0] == pytest.approx(expected, abs=1e-10)
    assert measured.entropy[0] == pytest.approx(other, abs=1e-10)


@pytest.mark.parametrize(("codes", "classes"), [(3, 2), (40, 7), (512, 82)])
def test_adjusted_and_normalised_agree_with_scikit_learn(codes, classes):
    indices, factors = drawn(0, codes, 2, (classes, 3))
    indices[: ROWS // 2, 0] = factors["f0"][: ROWS // 2]
    measured = adjusted_information(indices, factors, 0, permutations=1)
    for g, (f, values) in product(range(2), enumerate(factors.values())):
        expected = adjusted_mutual_info_score(values, indices[:, g])
        assert measured.adjusted[g, f] == pytest.approx(expected, abs=1e-9)
        assert measured.normalised[g, f] == pytest.approx(normalized_mutual_info_score(values, indices[:, g]))


def test_random_codes_look_informative_by_the_plain_measure_only():
    codes, factors = drawn(0, 512, 2, (7, 82))
    measured = adjusted_information(codes, factors, 0)
    assert measured.normalised.min() > 0.4
    assert np.abs(measured.adjusted).max() < 0.03
    assert measured.share.max() < 0.08 and measured.bits.max() < 0.08
    assert measured.holds == [None, None] and not measured.beyond_chance.any()


def test_p_values_are_uniform_where_codes_know_nothing():
    draws = [adjusted_information(*drawn(seed, 512, 2, (7, 40)), seed).p for seed in range(40)]
    p = np.array(draws)
    assert 0.01 <= np.mean(p < 0.05) <= 0.1
    assert 0.4 <= np.mean(p < 0.5) <= 0.6
    assert p.min() >= 1 / 201 and p.max() <= 1.0


def test_a_group_that_is_a_factor_holds_it_under_any_names_and_with_several_codes_a_class():
    generator = np.random.default_rng(1)
    factors = {"style": generator.integers(7, size=ROWS), "species": generator.integers(20, size=ROWS)}
    renamed = np.stack([generator.permutation(512)[factors["style"]], 500 - factors["species"]], axis=1)
    measured = adjusted_information(renamed, factors, 0)
    assert np.diag(measured.adjusted) == pytest.approx(1.0) and np.diag(measured.share) == pytest.approx(1.0)
    assert measured.holds == ["style", "species"]
    several = np.stack([factors[name] * 4 + generator.integers(4, size=ROWS) for name in factors], axis=1)
    measured = adjusted_information(several, factors, 0)
    assert np.diag(measured.share) == pytest.approx(1.0)
    assert np.diag(measured.adjusted).max() < 0.9, "the adjusted measure charges for codes beyond the classes"
    assert measured.holds == ["style", "species"]


def test_names_of_codes_and_classes_change_nothing():
    codes, factors = drawn(0, 30, 2, (5, 6))
    codes[:150, 0] = factors["f1"][:150]
    generator = np.random.default_rng(5)
    other = generator.permutation(30)[codes] * 1000 - 7
    renamed = {name: generator.permutation(6)[values] for name, values in factors.items()}
    before, after = adjusted_information(codes, factors, 3), adjusted_information(other, renamed, 3)
    assert np.array_equal(before.p, after.p) and before.holds == after.holds
    for table in ("bits", "adjusted", "normalised", "share"):
        assert getattr(after, table) == pytest.approx(getattr(before, table), abs=1e-12)


def test_reordered_groups_and_factors_reorder_the_tables():
    codes, factors = drawn(0, 30, 3, (5, 6))
    codes[:150, 0] = factors["f1"][:150]
    before = adjusted_information(codes, factors, 3)
    after = adjusted_information(codes[:, [2, 0, 1]], {"f1": factors["f1"], "f0": factors["f0"]}, 3)
    for table in ("bits", "adjusted", "normalised", "share", "p"):
        assert np.array_equal(getattr(after, table), getattr(before, table)[[2, 0, 1]][:, ::-1])
    assert after.holds == [before.holds[g] for g in (2, 0, 1)] == [None, "f1", None]


def test_positions_are_averaged_and_shuffled_together():
    generator = np.random.default_rng(0)
    factor = generator.integers(4, size=ROWS)
    tells, silent = generator.permutation(4)[factor], generator.integers(4, size=ROWS)
    single = adjusted_information(np.stack([tells, silent], axis=1), {"f": factor}, 0)
    grid = adjusted_information(np.stack([tells, silent], axis=1)[:, :, None], {"f": factor}, 0)
    assert grid.bits.shape == (1, 1)
    assert grid.adjusted[0, 0] == pytest.approx(single.adjusted[:, 0].mean())
    assert grid.bits[0, 0] == pytest.approx(single.bits[:, 0].mean(), abs=0.01) and grid.holds == ["f"]
    same = np.repeat(silent[:, None, None], 9, axis=1)
    once, often = (adjusted_information(codes, {"f": factor}, 0).p for codes in (silent[:, None], same))
    assert np.array_equal(once, often), "nine copies of one code are no more evidence than one"


def test_what_does_not_vary_says_nothing_and_gives_no_nan():
    codes, factors = drawn(0, 8, 2, (5,))
    codes[:, 1] = 3
    measured = adjusted_information(codes, {**factors, "still": np.full(ROWS, 2)}, 0)
    assert measured.alive.tolist() == [True, False] and measured.varies.tolist() == [True, False]
    for table in ("bits", "adjusted", "normalised", "share"):
        values = getattr(measured, table)
        assert np.isfinite(values).all() and not values[1].any() and not values[:, 1].any()
    assert measured.p[1].tolist() == [1.0, 1.0] and measured.p[:, 1].tolist() == [1.0, 1.0]


def test_a_code_for_every_row_is_no_knowledge():
    factor = np.random.default_rng(0).integers(4, size=ROWS)
    measured = adjusted_information(np.arange(ROWS)[:, None], {"f": factor}, 0)
    assert measured.bits[0, 0] == 0.0 and measured.share[0, 0] == 0.0 and measured.p[0, 0] == 1.0


def test_holm_steps_down():
    assert holm(np.array([0.01, 0.04, 0.03, 0.005])).tolist() == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm(np.array([0.9, 0.6])).tolist() == [1.0, 1.0]


@pytest.mark.parametrize(("groups", "factors"), [(2, 2), (4, 6)])
def test_enough_permutations_let_a_single_cell_pass(groups, factors):
    codes, values = drawn(0, 8, groups, (5,) * factors)
    codes[:, 1] = values["f0"]
    cells = groups * factors
    holds = adjusted_information(codes, values, 0, permutations=enough_permutations(cells)).holds
    assert holds == [None, "f0", *[None] * (groups - 2)]
    assert cells / (1 + 200) < 0.05 or adjusted_information(codes, values, 0).holds == [None] * groups


def test_a_leak_into_a_second_factor_needs_several_rows_for_each_combination():
    """Each code names a style and a fifth of the species; one picture of each combination cannot show the latter."""

    def share(copies):
        style, species = np.repeat(np.divmod(np.arange(7 * 80), 80), copies, axis=1)
        factors = {"style": style, "species": species}
        return adjusted_information((style * 5 + species % 5)[:, None], factors, 0).share[0]

    assert share(1) == pytest.approx([1.0, 0.0], abs=0.05)
    assert share(16) == pytest.approx([1.0, np.log2(5) / np.log2(80)], abs=0.05)


STYLES, SPECIES, VARIANTS = 6, 30, 8


@pytest.fixture(scope="module")
def drawings():
    """Every species in every style, each drawing shown several times: (blocks, factors)."""
    blocks = np.repeat(np.arange(STYLES * SPECIES), VARIANTS)
    random = np.random.default_rng(0)
    factors = {"style": blocks // SPECIES, "species": blocks % SPECIES, "ground": random.integers(4, size=len(blocks))}
    return blocks, factors


def test_a_code_that_recognises_drawings_and_nothing_else_holds_nothing(drawings):
    """An arbitrary number for each drawing; without the blocks every factor of the drawings seems to be known."""
    blocks, factors = drawings
    arbitrary = np.random.default_rng(1).integers(60, size=(STYLES * SPECIES, 2))[blocks]
    measured = adjusted_information(arbitrary, factors, 0, blocks=blocks)
    assert measured.holds == [None, None] and measured.share.max() < 0.15
    fooled = adjusted_information(arbitrary, factors, 0)
    assert None not in fooled.holds and fooled.share[:, 1].min() > 0.3


def test_codes_that_are_the_factors_of_drawings_are_told_in_full(drawings):
    blocks, factors = drawings
    codes = np.stack([factors["species"], factors["style"], factors["ground"]], 1)
    measured = adjusted_information(codes, factors, 0, blocks=blocks)
    assert measured.holds == ["species", "style", "ground"]
    np.testing.assert_allclose(np.diag(measured.share[:, [1, 0, 2]]), 1.0, atol=1e-9)
    assert np.sort(measured.share, axis=1)[:, :-1].max() < 0.02


def test_shuffled_blocks_have_the_chance_that_shuffled_rows_have_where_every_row_is_its_own_block(drawings):
    _, factors = drawings
    codes = np.random.default_rng(2).integers(9, size=(len(factors["style"]), 2))
    by_rows = adjusted_information(codes, factors, 0)
    by_blocks = adjusted_information(codes, factors, 0, blocks=np.arange(len(codes)))
    for name in ("bits", "adjusted", "share", "p"):
        np.testing.assert_array_equal(getattr(by_rows, name), getattr(by_blocks, name))


def test_only_blocks_of_equal_size_change_places():
    """Two blocks of different sizes, which cannot be exchanged: nothing is beyond the one shuffle there is."""
    blocks = np.repeat([0, 1], [3, 5])
    measured = adjusted_information(blocks[:, None], {"origin": blocks}, 0, blocks=blocks)
    assert measured.p.item() == 1.0 and measured.holds == [None]
