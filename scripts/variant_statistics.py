"""What a comparison of planner variants may claim: rates with their intervals, paired differences, and how sure they are.

Trials are paired by seed: the same ground, the same noise, another way of planning. A difference is the mean over pairs; its interval is
the bias-corrected and accelerated bootstrap's, its p-value that of flipping signs within pairs at random, which asks nothing of how the
differences are distributed. Pairs in which one figure is missing are left out, and counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from athlete_twin.errors import ConfigError

CONFIDENCE = 0.95
RESAMPLES = 9999
"""of bootstrap and sign flips, where these are not all tried"""
POWER = 0.8
FEWEST_PAIRS = 6
"""with which sign flips can be significant at 5 % at all: n pairs that all point one way have p = 2 / 2^n"""
MOST_SEEDS = 100_000
LARGE_EFFECT = 5.0
"""d_z from which the fewest pairs are enough by far, and up to which SciPy's non-central t is sound"""


@dataclass(frozen=True, kw_only=True)
class Rate:
    """A share of trials with Wilson's 95 % interval."""

    successes: int
    trials: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """0 to 1; NaN of no trials."""
        return self.successes / self.trials if self.trials else float("nan")


@dataclass(frozen=True, kw_only=True)
class PairedDifference:
    """Second variant less the first, over pairs of trials."""

    mean: float
    low: float
    """of the 95 % interval; NaN where there are too few pairs, or all differ alike"""
    high: float
    p: float
    """of no difference, two-sided"""
    effect: float
    """mean over standard deviation of the differences (d_z); NaN where these are all alike"""
    pairs: int
    missing: int
    """pairs left out, in which a figure was not measured"""
    seeds_needed: int | None
    """pairs that show such an effect at 5 % in 80 of 100 repetitions, `FEWEST_PAIRS` at the least; None where the mean is zero or
    100,000 pairs are too few"""


def rate(flags: Sequence[bool]) -> Rate:
    """Share of trials for which a flag is true."""
    n, k = len(flags), int(np.sum(np.asarray(flags, dtype=bool)))
    if n == 0:
        return Rate(successes=0, trials=0, low=0.0, high=1.0)
    interval = stats.binomtest(k, n).proportion_ci(confidence_level=CONFIDENCE, method="wilson")
    return Rate(successes=k, trials=n, low=float(interval.low), high=float(interval.high))


def paired_difference(first: Sequence[float | None], second: Sequence[float | None], *, rng: np.random.Generator) -> PairedDifference:
    """How much more the second has than the first; entries of one place belong to one seed.

    Args:
        first: a figure of each trial, None or NaN where it was not measured.
        second: the other variant's, of the same seeds.
        rng: of bootstrap and sign flips.
    """
    if len(first) != len(second):
        raise ConfigError(f"{len(first)} and {len(second)} trials make no pairs, need as many of each variant")
    a, b = (np.array([np.nan if v is None else float(v) for v in side], dtype=float) for side in (first, second))
    measured = np.isfinite(a) & np.isfinite(b)
    d = (b - a)[measured]
    missing = int(np.sum(~measured))
    nan = float("nan")
    if len(d) == 0:
        return PairedDifference(mean=nan, low=nan, high=nan, p=1.0, effect=nan, pairs=0, missing=missing, seeds_needed=None)
    mean, alike = float(d.mean()), len(d) < 2 or float(np.ptp(d)) == 0.0
    low, high = (nan, nan) if alike else _bootstrap(d, rng)
    effect = nan if alike else mean / float(d.std(ddof=1))
    return PairedDifference(
        mean=mean, low=low, high=high, p=_sign_flips(d, rng), effect=effect, pairs=len(d), missing=missing,
        seeds_needed=seeds_needed(np.copysign(np.inf, mean) if alike and mean else effect),
    )  # fmt: skip


def holm(p_values: Sequence[float]) -> np.ndarray:
    """P-values that hold for all of a family of tests at once (Holm 1979), in the order given."""
    p = np.asarray(p_values, dtype=float)
    if len(p) and not ((p >= 0.0) & (p <= 1.0)).all():
        raise ConfigError(f"p-values are {p.tolist()}, must be within 0 to 1")
    order = np.argsort(p)
    adjusted = np.maximum.accumulate((len(p) - np.arange(len(p))) * p[order]) if len(p) else p
    out = np.empty(len(p))
    out[order] = np.minimum(adjusted, 1.0)
    return out


def seeds_needed(effect: float, *, significance: float = 0.05, power: float = POWER) -> int | None:
    """Pairs with which a two-sided paired t-test finds an effect d_z with a power, and sign flips can; None where too many are.

    Args:
        effect: mean over standard deviation of the differences; infinite where all are alike, NaN where there is none.
        significance: at which sign flips need `FEWEST_PAIRS` or fewer.
        power: share of repetitions that find it.
    """
    if np.isnan(effect) or effect == 0.0:
        return None
    size = min(abs(effect), LARGE_EFFECT)

    def reached(n: int) -> bool:
        limit, shift = stats.t.ppf(1.0 - 0.5 * significance, n - 1), size * np.sqrt(n)
        near, far = stats.nct.sf(limit, n - 1, shift), stats.nct.cdf(-limit, n - 1, shift)
        return bool(near + np.nan_to_num(far) >= power)  # SciPy's far tail is NaN here and there where it is next to nothing

    low, high = FEWEST_PAIRS - 1, FEWEST_PAIRS
    while not reached(high):
        if high == MOST_SEEDS:
            return None
        low, high = high, min(2 * high, MOST_SEEDS)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def _bootstrap(d: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    found = stats.bootstrap((d,), np.mean, n_resamples=RESAMPLES, confidence_level=CONFIDENCE, method="BCa", rng=rng)
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def _sign_flips(d: np.ndarray, rng: np.random.Generator) -> float:
    """Chance that signs at random make a mean as far from zero; exact where all of them can be tried."""
    if len(d) < 2 or not d.any():  # of one pair either sign is as far
        return 1.0
    found = stats.permutation_test(
        (d,), np.mean, permutation_type="samples", vectorized=True, n_resamples=RESAMPLES, alternative="two-sided", rng=rng
    )
    return float(min(found.pvalue, 1.0))
