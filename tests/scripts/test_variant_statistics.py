"""Statistics of comparisons against published worked examples, and against labels that mean nothing."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from athlete_twin.errors import ConfigError

PATH = Path(__file__).parents[2] / "scripts" / "variant_statistics.py"
spec = importlib.util.spec_from_file_location("variant_statistics", PATH)
statistics = importlib.util.module_from_spec(spec)
sys.modules["variant_statistics"] = statistics
spec.loader.exec_module(statistics)

SLEEP = (
    [0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0],
    [1.9, 0.8, 1.1, 0.1, -0.1, 4.4, 5.5, 1.6, 4.6, 3.4],
)
"""hours of sleep gained under two drugs by the same ten patients, Student (1908)"""


def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_intervals_of_rates_are_those_of_newcombes_table(k, n, low, high):
    found = statistics.rate([True] * k + [False] * (n - k))
    assert (found.low, found.high) == (pytest.approx(low, abs=1e-4), pytest.approx(high, abs=1e-4))
    assert found.share == pytest.approx(k / n)


def test_no_trials_say_nothing():
    found = statistics.rate([])
    assert (found.low, found.high) == (0.0, 1.0) and np.isnan(found.share)


def test_students_sleep_data():
    found = statistics.paired_difference(*SLEEP, rng=rng())
    assert found.mean == pytest.approx(1.58) and found.pairs == 10 and found.missing == 0
    assert found.effect == pytest.approx(1.285, abs=1e-3)  # t = 4.0621 over the root of 10
    # Nine of ten differ, all the same way: of 2^10 signs, those of the nine and the zero's either.
    assert found.p == pytest.approx(2 * 2 / 2**10)
    # Student's own interval is 0.70 to 2.46; the bootstrap's leans to the long tail.
    assert found.low == pytest.approx(0.95, abs=0.15) and found.high == pytest.approx(2.5, abs=0.25)


def test_success_flags_give_mcnemars_exact_test():
    first, second = [1.0] * 3 + [0.0] * 12 + [1.0] * 20, [0.0] * 3 + [1.0] * 12 + [1.0] * 20
    found = statistics.paired_difference(first, second, rng=rng())
    assert found.p == pytest.approx(stats.binomtest(3, 15).pvalue, abs=0.012)


def test_holms_adjusted_values():
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert len(statistics.holm([])) == 0
    with pytest.raises(ConfigError, match="within 0 to 1"):
        statistics.holm([0.2, 1.2])


@pytest.mark.parametrize(("effect", "needed"), [(0.2, 199), (0.5, 34), (0.8, 15), (-0.5, 34)])
def test_seeds_needed_are_those_of_power_tables(effect, needed):
    assert statistics.seeds_needed(effect) == needed


def test_effects_that_nothing_shows_need_no_number():
    assert statistics.seeds_needed(0.0) is None and statistics.seeds_needed(float("nan")) is None
    assert statistics.seeds_needed(1e-4) is None


def test_more_pairs_are_never_needed_for_a_larger_effect():
    found = [statistics.seeds_needed(effect) for effect in np.geomspace(0.1, 20.0, 400)]
    assert found == sorted(found, reverse=True) and (found[0], found[-1]) == (787, 6)
    assert statistics.seeds_needed(float("inf")) == statistics.seeds_needed(1e9) == 6


def test_fewest_pairs_are_those_whose_sign_flips_can_be_significant():
    fewest = statistics.FEWEST_PAIRS
    p = [statistics.paired_difference([0.0] * n, np.linspace(1.0, 2.0, n).tolist(), rng=rng()).p for n in (fewest - 1, fewest)]
    assert p == pytest.approx([2 / 2 ** (fewest - 1), 2 / 2**fewest]) and p[1] <= 0.05 < p[0]


def test_numbers_up_to_a_hundred_thousand_are_found():
    # n = ((z of 97.5 % + z of 80 %) / d)^2, Cohen's rule for many pairs
    many = ((stats.norm.ppf(0.975) + stats.norm.ppf(0.8)) / 0.009) ** 2
    assert 65_536 < many < 100_000 and statistics.seeds_needed(0.009) == pytest.approx(many, rel=1e-3)


def test_missing_figures_are_left_out_and_alike_ones_have_no_interval():
    found = statistics.paired_difference([1.0, None, float("nan"), 2.0], [2.0, 1.0, 1.0, 3.0], rng=rng())
    assert (found.pairs, found.missing, found.mean) == (2, 2, 1.0)
    assert np.isnan(found.low) and np.isnan(found.effect) and found.seeds_needed == 6
    same = statistics.paired_difference([1.0] * 8, [1.0] * 8, rng=rng())
    assert same.mean == 0.0 and same.seeds_needed is None
    none = statistics.paired_difference([None], [1.0], rng=rng())
    assert none.pairs == 0 and none.p == 1.0
    single = statistics.paired_difference([1.0], [3.0], rng=rng())
    assert (single.pairs, single.mean, single.p, single.seeds_needed) == (1, 2.0, 1.0, 6)
    with pytest.raises(ConfigError, match="2 and 1 trials make no pairs"):
        statistics.paired_difference([1.0, 2.0], [1.0], rng=rng())


@settings(max_examples=20)
@given(st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=8, unique=True))
def test_the_other_way_round_is_the_negative(values):
    zeros = [0.0] * len(values)
    there, back = statistics.paired_difference(zeros, values, rng=rng()), statistics.paired_difference(values, zeros, rng=rng())
    assert there.mean == pytest.approx(-back.mean) and there.p == pytest.approx(back.p)


@pytest.mark.slow
@pytest.mark.ci
def test_labels_swapped_at_random_within_pairs_flag_one_in_twenty():
    draws = np.random.default_rng(1)
    first = draws.gamma(2.0, 300.0, size=40)
    second = 0.8 * first + draws.normal(0.0, 60.0, size=40)
    assert statistics.paired_difference(first.tolist(), second.tolist(), rng=rng()).p < 0.001
    flagged = 0
    for _ in range(200):
        swap = draws.random(40) < 0.5
        a, b = np.where(swap, second, first), np.where(swap, first, second)
        flagged += statistics._sign_flips(b - a, rng()) < 0.05
    assert 4 <= flagged <= 18
