"""Statistics over seeds: against numbers worked out by hand, scipy's U, and a bootstrap written as a loop."""

import warnings

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from repdib_lightning.experiments import statistics

ALL = ("mean", "iqm", "difference", "ratio", "improvement")


def estimate(name, ours, baseline):
    ours, baseline = np.asarray(ours, float), np.asarray(baseline, float)
    if name in ("mean", "iqm"):
        return getattr(statistics, name)(ours)
    pairs = {
        "difference": statistics.paired_difference,
        "ratio": statistics.paired_ratio,
        "improvement": statistics.probability_of_improvement,
    }
    return pairs[name](ours, baseline)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([9, 1, 2, 3, 100], (9 + 2 + 3) / 3),  # a quarter of 5 is one at each end
        ([9, 1, 2, 100], (9 + 2) / 2),
        ([1, 2, 30], 11.0),  # a quarter of 3 is none
        ([0, 1, 2, 3, 4, 5, 6, 70, 80, 90], (2 + 3 + 4 + 5 + 6 + 70) / 6),  # two at each end
    ],
)
def test_mean_and_interquartile_mean_by_hand(values, expected):
    assert statistics.iqm(np.array(values)).value == pytest.approx(expected)
    assert statistics.mean(np.array(values)).value == pytest.approx(sum(values) / len(values))


@pytest.mark.parametrize(
    ("ours", "baseline"),
    [([3, 4, 5], [0, 1]), ([1, 2, 2, 5, 7], [2, 2, 3, 0, 9]), ([1, 1, 1], [1, 1]), ([0, 1], [5, 6, 7])],
)
def test_probability_of_improvement_is_mann_whitney(ours, baseline):
    u = mannwhitneyu(ours, baseline, method="asymptotic").statistic
    found = statistics.probability_of_improvement(np.array(ours), np.array(baseline))
    assert found.value == pytest.approx(u / (len(ours) * len(baseline)))
    opposite = statistics.probability_of_improvement(np.array(baseline), np.array(ours))
    assert found.value + opposite.value == pytest.approx(1.0)


@pytest.mark.parametrize("name", ALL)
def test_the_interval_holds_the_value_has_a_width_and_is_the_same_twice(name):
    generator = np.random.default_rng(3)
    for seeds in (3, 5, 10):
        ours, baseline = generator.normal(3.0, 0.5, seeds), generator.normal(2.5, 0.5, seeds)
        found = estimate(name, ours, baseline)
        assert found.low < found.high
        assert found.low <= found.value <= found.high
        assert estimate(name, ours, baseline) == found


@pytest.mark.parametrize("name", ALL)
def test_one_seed_has_a_value_and_no_interval(name):
    found = estimate(name, [3.0], [2.0])
    values = {"mean": 3.0, "iqm": 3.0, "difference": 1.0, "ratio": 1.5, "improvement": 1.0}
    assert found == statistics.Estimate(values[name], None, None)


def test_one_seed_of_the_baseline_alone_gives_no_interval_either():
    found = statistics.probability_of_improvement(np.array([1.0, 3.0, 4.0]), np.array([2.0]))
    assert found == statistics.Estimate(pytest.approx(2 / 3), None, None)


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("seeds", [2, 5, 12])
def test_seeds_that_agree_have_an_interval_without_width_and_no_warning(name, seeds):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = estimate(name, np.full(seeds, 0.3), np.full(seeds, 0.7))
    assert found.low == found.high == pytest.approx(found.value)


def test_seeds_are_resampled_in_pairs_for_a_difference_and_a_ratio():
    """Seeds differ much, but ours is always the same step above the baseline: pairing removes all of the spread."""
    baseline = np.array([1.0, 7.0, 3.0, 20.0, 11.0])
    shifted = statistics.paired_difference(baseline + 0.5, baseline)
    assert (shifted.low, shifted.value, shifted.high) == pytest.approx((0.5, 0.5, 0.5))
    scaled = statistics.paired_ratio(1.5 * baseline, baseline)
    assert (scaled.low, scaled.value, scaled.high) == pytest.approx((1.5, 1.5, 1.5))
    # The order of the seeds is what pairs them.
    crossed = statistics.paired_difference(baseline[::-1] + 0.5, baseline)
    assert crossed.value == pytest.approx(0.5) and crossed.high - crossed.low > 5.0


def test_a_ratio_has_no_unit_and_is_of_means():
    ours, baseline = np.array([2.0, 4.0, 9.0, 3.0, 5.0]), np.array([1.0, 3.0, 3.0, 2.0, 8.0])
    found = statistics.paired_ratio(ours, baseline)
    assert found.value == pytest.approx(ours.mean() / baseline.mean())
    other_unit = statistics.paired_ratio(1000 * ours, 1000 * baseline)
    assert (other_unit.low, other_unit.high) == pytest.approx((found.low, found.high))
    larger = statistics.paired_ratio(3 * ours, baseline)
    assert (larger.low, larger.value, larger.high) == pytest.approx((3 * found.low, 3 * found.value, 3 * found.high))


def test_a_ratio_to_nothing_is_none_and_one_that_may_divide_by_nothing_has_no_interval():
    ours = np.array([1.0, 2.0, 3.0])
    assert statistics.paired_ratio(ours, np.zeros(3)) is None
    assert statistics.paired_ratio(ours, np.array([-1.0, 0.0, 1.0])) is None
    assert statistics.paired_ratio(ours, np.array([0.0, 0.0, 6.0])) == statistics.Estimate(1.0, None, None)
    below = statistics.paired_ratio(ours, np.array([-1.0, -2.0, -4.0]))
    assert below.low <= below.value <= below.high < 0.0


def slow_interval(statistic, samples, paired, resamples=2000):
    """Percentile bootstrap, one resample at a time."""
    generator = np.random.default_rng(11)
    values = []
    for _ in range(resamples):
        draws = [generator.integers(len(sample), size=len(sample)) for sample in samples]
        if paired:
            draws = [draws[0]] * len(samples)
        values.append(statistic(*(sample[draw] for sample, draw in zip(samples, draws, strict=True))))
    return np.percentile(values, [2.5, 97.5]), np.std(values)


def middle(values):
    drop = len(values) // 4
    return np.mean(np.sort(values)[drop : len(values) - drop])


def above(ours, baseline):
    return np.mean([1.0 if a > b else 0.5 if a == b else 0.0 for a in ours for b in baseline])


@pytest.mark.parametrize(
    ("name", "statistic", "paired"),
    [
        ("mean", lambda x, y: np.mean(x), True),
        ("iqm", lambda x, y: middle(x), True),
        ("difference", lambda x, y: np.mean(x) - np.mean(y), True),
        ("ratio", lambda x, y: np.mean(x) / np.mean(y), True),
        ("improvement", above, False),
    ],
)
def test_intervals_agree_with_a_bootstrap_written_as_a_loop(name, statistic, paired):
    generator = np.random.default_rng(8)
    ours = generator.normal(3.0, 1.0, 9)
    baseline = ours + generator.normal(-0.4, 0.5, 9)  # the seeds go together, so that pairing matters
    found = estimate(name, ours, baseline)
    (low, high), spread = slow_interval(statistic, (ours, baseline), paired)
    # An end of the interval is known to about 0.06 spreads from 2000 resamples.
    assert abs(found.low - low) < 0.2 * spread and abs(found.high - high) < 0.2 * spread


@pytest.mark.parametrize(("seeds", "expected"), [(5, 0.85), (30, 0.94)])
def test_coverage_is_what_the_module_says(monkeypatch, seeds, expected):
    monkeypatch.setattr(statistics, "RESAMPLES", 500)
    generator = np.random.default_rng(0)
    trials = 800
    found = [statistics.mean(generator.normal(size=seeds)) for _ in range(trials)]
    covered = np.mean([e.low <= 0.0 <= e.high for e in found])
    assert abs(covered - expected) < 0.035  # three deviations of 800 trials
