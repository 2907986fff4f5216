"""What the rows of a comparison say: how often each variant succeeds, and how much it differs from the one it is held against.

Robots are never pooled, nor are delays. Within a robot and a delay, trials of one case are a pair: the same ground, the same noise. A
difference is the variant's figure less the baseline's. Holm's correction runs over the metrics of one variant on one robot at one delay,
as far as they were measured at all; computing times are a family of their own.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from variant_grounds import ground_of
from variant_metrics import METRICS, SUCCESS, Metric, Row, succeeded
from variant_rows import partners_of, variants_of
from variant_statistics import PairedDifference, Rate, holm, paired_difference, rate

SIGNIFICANCE = 0.05
DECIMALS = 9
"""of SI units in which figures are compared: what differs below is the last bits of a sum, not a way of planning"""


@dataclass(frozen=True, kw_only=True)
class Place:
    """Trials that may be held against each other."""

    robot: str
    delay_s: float
    scenarios: tuple[str, ...] | None = None
    """None for all of the suite together"""
    ground: str = ""
    """what these scenarios have in common"""

    def has(self, row: Row) -> bool:
        """Whether a trial belongs here."""
        known = self.scenarios is None or row["scenario"] in self.scenarios
        return bool(row["robot"] == self.robot and float(row["delay_s"]) == self.delay_s and known)


@dataclass(frozen=True, kw_only=True)
class Success:
    """How often a variant succeeds."""

    place: Place
    variant: str
    rate: Rate


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One metric of a variant held against the baseline's."""

    place: Place
    variant: str
    baseline: str
    metric: Metric
    difference: PairedDifference
    unpaired: int
    """trials of either variant whose partner was not run"""
    p_holm: float = float("nan")
    """of no difference, corrected for the other metrics of its family; NaN where there was no pair"""

    @property
    def significant(self) -> bool:
        """Whether the difference holds at 5 % after the correction."""
        return self.p_holm < SIGNIFICANCE

    @property
    def better(self) -> bool:
        """Whether the variant is on the better side of the baseline, significant or not."""
        return self.difference.mean > 0.0 if self.metric.better == "more" else self.difference.mean < 0.0


def places_of(rows: Sequence[Row]) -> list[Place]:
    """Every robot at every delay, in order."""
    return [Place(robot=robot, delay_s=delay) for robot, delay in sorted({(r["robot"], float(r["delay_s"])) for r in rows})]


def grounds_of(rows: Sequence[Row], place: Place) -> list[Place]:
    """The place by density of its rocks, and scenarios without a density each by itself; densities first, ascending."""
    groups: dict[tuple[float, str], list[str]] = {}
    for name in sorted({r["scenario"] for r in rows if place.has(r)}):
        k = ground_of(name).density
        groups.setdefault((math.inf, name) if k is None else (k, ""), []).append(name)
    found = []
    for (k, name), names in sorted(groups.items()):
        ground = name or (f"k = {k:.2f}" if len(names) > 1 else f"{names[0]}, k = {k:.2f}")
        found.append(replace(place, scenarios=tuple(names), ground=ground))
    return found


def successes(rows: Sequence[Row], place: Place, variants: Sequence[str]) -> list[Success]:
    """Rates of success, one for each variant, also for one without trials here."""
    return [
        Success(place=place, variant=v, rate=rate([succeeded(r) for r in rows if place.has(r) and r["variant"] == v])) for v in variants
    ]


def comparisons(
    rows: list[Row], place: Place, *, metrics: Sequence[Metric] = METRICS, baseline: str | None = None
) -> list[Comparison]:
    """Every variant against its partner, in every metric; variants without a pair here are left out.

    Args:
        rows: of a comparison.
        place: whose trials are taken.
        metrics: over which Holm's correction runs, computing times and the others each by themselves.
        baseline: against which all are held; None for what `partners_of` says.
    """
    found = []
    for variant, partner in partners_of(variants_of(rows, baseline), all_against_first=baseline is not None).items():
        base, mine = ({r["case"]: r for r in rows if place.has(r) and r["variant"] == v} for v in (partner, variant))
        cases = sorted(base.keys() & mine.keys())
        if not cases:
            continue
        unpaired = len(base.keys() ^ mine.keys())
        pairs = [(base[case], mine[case]) for case in cases]
        compared = [
            Comparison(
                place=place, variant=variant, baseline=partner, metric=metric, unpaired=unpaired,
                difference=_difference(pairs, metric, seed=f"{place}|{partner}|{variant}|{metric.name}"),
            )
            for metric in metrics
        ]  # fmt: skip
        found += _corrected(compared)
    return found


def effects_by_ground(rows: list[Row], place: Place, *, baseline: str | None = None) -> list[Comparison]:
    """Success of every variant at each density of rocks by itself; Holm's correction runs over the densities."""
    found = [c for part in grounds_of(rows, place) for c in comparisons(rows, part, metrics=(SUCCESS,), baseline=baseline)]
    corrected = []
    for variant in dict.fromkeys(c.variant for c in found):
        corrected += _corrected([c for c in found if c.variant == variant])
    return corrected


def fewest_pairs(tests: int) -> int:
    """Pairs below which not even differences that all point one way are significant among so many tests."""
    return int(np.ceil(np.log2(2.0 * tests / SIGNIFICANCE)))


def _difference(pairs: list[tuple[Row, Row]], metric: Metric, *, seed: str) -> PairedDifference:
    """The metric's difference; pairs that it may not be compared over count as missing."""
    sides: tuple[list[float | None], list[float | None]] = ([], [])
    for pair in pairs:
        usable = not metric.reached_only or all(succeeded(r) for r in pair)
        for side, row in zip(sides, pair, strict=True):
            value = metric.read(row) if usable else None
            side.append(None if value is None else round(value, DECIMALS))
    # Keyed by what is compared, so that no figure depends on which others are asked for.
    return paired_difference(*sides, rng=np.random.default_rng(zlib.crc32(seed.encode())))


def _corrected(compared: list[Comparison]) -> list[Comparison]:
    adjusted: dict[int, float] = {}
    for timing in (False, True):
        tested = [c for c in compared if c.difference.pairs and c.metric.timing == timing]
        adjusted |= zip(map(id, tested), holm([c.difference.p for c in tested]).tolist(), strict=True)
    return [replace(c, p_holm=adjusted.get(id(c), float("nan"))) for c in compared]
