"""The answer of a comparison in words: who succeeds how often, what differs for sure, what may be chance, and how many pairs would tell."""

from __future__ import annotations

from collections.abc import Sequence

from variant_export import p_value, share, title_of
from variant_metrics import Row
from variant_tables import Comparison, Place, Success, fewest_pairs, successes


def place_title(place: Place) -> str:
    """A robot at a delay, for a heading."""
    where = f" in {place.scenario}" if place.scenario else ""
    return f"{title_of(place.robot)}{where}, {place.delay_s:g} s of delay each way"


def answer(rows: list[Row], place: Place, variants: Sequence[str], compared: Sequence[Comparison]) -> list[str]:
    """Sentences about one place, plain text: success, then all that is significant, and whether success is not."""
    run = [s for s in successes(rows, place, variants) if s.rate.trials]
    sentences = ["Success: " + "; ".join(_often(s) for s in run) + "."]
    if len(run) < 2 or run[0].variant != variants[0]:
        why = "one variant only" if len(run) < 2 else f"{variants[0]} was not run"
        return [*sentences, f"Nothing to hold against each other here: {why}."]
    for s in run[1:]:
        sentences += _against(s.variant, variants[0], _of(compared, place, s.variant))
    return sentences


def undecided(rows: list[Row], place: Place, variants: Sequence[str], compared: Sequence[Comparison]) -> list[str]:
    """Sentences about the figures but success that are not significant at one place, with the pairs each would need."""
    out = []
    for variant in (s.variant for s in successes(rows, place, variants) if s.variant != variants[0]):
        mine, pair = _of(compared, place, variant), f"{variant} against {variants[0]}"
        rest = [c for c in mine if c.difference.pairs and not c.significant and c.metric.name != "success"]
        if rest:
            listed = ", ".join(f"{c.metric.title} ({needed(c) if c.difference.mean else 'alike'})" for c in rest)
            out.append(f"{pair}, in brackets what would show the difference seen: {listed}.")
        untested = [c.metric.title for c in mine if not c.difference.pairs]
        if untested:
            out.append(f"{pair}, nothing to compare: {', '.join(untested)}.")
    return out


def interval(c: Comparison) -> str:
    """The difference with its interval and how many pairs it rests on."""
    d, m = c.difference, c.metric
    unit = " points" if m.name == "success" else f" {m.unit}" if m.unit else ""
    between = f", {m.number(d.low, sign=True)} to {m.number(d.high, sign=True)}" if d.low == d.low else ""
    return f"{m.number(d.mean, sign=True)}{unit}{between}"


def needed(c: Comparison) -> str:
    """Pairs with which the difference would show."""
    n = c.difference.seeds_needed
    if n is None:
        return "no number of pairs below 100,000"
    return f"{n} pairs"


def _often(found: Success) -> str:
    r = found.rate
    return f"{found.variant} {r.successes} of {r.trials} ({100 * r.share:.0f} %, interval {share(r)})"


def _against(variant: str, baseline: str, mine: list[Comparison]) -> list[str]:
    if not mine:
        return [f"{variant} and {baseline} share no case: nothing is compared."]
    tested = [c for c in mine if c.difference.pairs]
    significant = [c for c in tested if c.significant]
    listed = "; ".join(
        f"{c.metric.title} {'better' if c.better else 'worse'} ({interval(c)}; p = {p_value(c.p_holm)}, {c.difference.pairs} pairs)"
        for c in significant
    )
    out = [f"{variant} differs significantly from {baseline}: {listed or 'in nothing'}."]
    out += [_open(c) for c in tested if c.metric.name == "success" and not c.significant]
    most, least = max((c.difference.pairs for c in tested), default=0), fewest_pairs(max(len(tested), 1))
    if most < least:
        out.append(f"With {most} pairs nothing can be significant among {len(tested)} metrics; that takes {least} pairs or more.")
    if mine[0].unpaired:
        out.append(f"{mine[0].unpaired} trials of {variant} or {baseline} have no partner and are left out of the differences.")
    return out


def _open(c: Comparison) -> str:
    """What is to be said of a success that is not significantly another."""
    if c.difference.mean == 0.0:
        return f"{c.variant} succeeds as often as {c.baseline} in {c.difference.pairs} pairs."
    return (
        f"{c.variant} against {c.baseline}, success: not significant ({interval(c)}; p = {p_value(c.p_holm)}, "
        f"{c.difference.pairs} pairs); showing this difference would take {needed(c)}."
    )


def _of(compared: Sequence[Comparison], place: Place, variant: str) -> list[Comparison]:
    return [c for c in compared if c.place == place and c.variant == variant]
