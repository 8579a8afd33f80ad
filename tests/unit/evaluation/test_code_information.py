import numpy as np
import pytest

from repdib_lightning.evaluation.codes import (
    codebook_use,
    entropy,
    factor_bits,
    mutual_information,
    quantile_bins,
)


def from_table(table):
    """Label pairs with the given joint counts."""
    pairs = [(i, j) for (i, j), count in np.ndenumerate(np.array(table)) for _ in range(count)]
    return tuple(np.array(pairs).T)


@pytest.mark.parametrize(
    ("table", "bits"),
    [
        ([[8, 0], [0, 8]], 1.0),
        ([[4, 4], [4, 4]], 0.0),
        (np.eye(8, dtype=int).tolist(), 3.0),
        ([[2, 0, 0], [0, 1, 1]], 1.0),
        ([[3, 1], [1, 3]], 1.0 + 0.75 * np.log2(0.75) + 0.25 * np.log2(0.25)),
    ],
)
def test_mutual_information_of_known_tables(table, bits):
    first, second = from_table(table)
    assert mutual_information(first, second) == pytest.approx(bits, abs=1e-12)
    assert mutual_information(second, first) == pytest.approx(bits, abs=1e-12)


def test_sparse_labels_give_the_same_as_dense_ones():
    first, second = from_table([[3, 1], [1, 3]])
    assert mutual_information(first * 10**6, second) == pytest.approx(mutual_information(first, second))


def test_the_null_removes_the_bias_of_many_codes_and_few_rows():
    generator = np.random.default_rng(0)
    codes, factor = generator.integers(64, size=(400, 1)), generator.integers(9, size=400)
    assert mutual_information(codes[:, 0], factor) > 0.5
    assert factor_bits(codes, factor, seed=0).bits[0] < 0.06


def test_bits_find_the_group_that_knows_and_the_entropy_bounds_them():
    generator = np.random.default_rng(0)
    factor = generator.integers(4, size=2000)
    codes = np.stack([factor, generator.integers(4, size=2000), np.zeros(2000, int)], axis=1)
    measured = factor_bits(codes, factor, seed=0)
    assert measured.bits[0] == pytest.approx(2.0, abs=0.02) and measured.bits[0] <= measured.entropy
    assert max(measured.bits[1:]) < 0.01
    assert factor_bits(codes, factor, seed=0) == measured


def test_continuous_factors_are_cut_into_bins_of_equal_counts():
    values = np.random.default_rng(0).exponential(size=1000)
    assert np.bincount(quantile_bins(values)).tolist() == [100] * 10
    assert quantile_bins(np.array([5.0, -1.0, 5.0, 2.0])).tolist() == [2, 0, 2, 1]
    codes = (np.arange(1000) // 100)[:, None]
    drifting = np.arange(1000.0)[:, None] ** 3
    measured = factor_bits(codes, drifting, seed=0)
    assert measured.entropy == pytest.approx(np.log2(10))
    assert measured.bits[0] == pytest.approx(np.log2(10), abs=0.08)


def test_a_vector_gives_the_mean_over_its_dimensions():
    generator = np.random.default_rng(0)
    codes = generator.integers(2, size=(4000, 1))
    vector = np.stack([codes[:, 0].astype(float), generator.uniform(size=4000)], axis=1)
    assert factor_bits(codes, vector, seed=0).bits[0] == pytest.approx(0.5, abs=0.01)


def test_perplexity_counts_evenly_used_codes():
    codes = np.stack([np.arange(80) % 8, np.zeros(80, int), np.repeat([0, 5], 40)], axis=1)
    use = codebook_use(codes, 16)
    assert use.used == [8, 1, 2] and use.codes_per_group == 16
    assert use.perplexity == pytest.approx([8.0, 1.0, 2.0])
    assert entropy(codes[:, 1]) == 0.0
