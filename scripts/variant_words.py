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
    """Sentences about one place, plain text, the most important first."""
    here = [c for c in compared if c.place == place]
    run = [s for s in successes(rows, place, variants) if s.rate.trials]
    sentences = ["Success: " + "; ".join(_often(s) for s in run) + "."]
    others = [s.variant for s in run if s.variant != variants[0]]
    if not others or run[0].variant != variants[0]:
        return [*sentences, "Nothing to hold against each other here: " + _alone(run, variants[0])]
    for variant in others:
        mine = [c for c in here if c.variant == variant]
        sentences += _against(variant, variants[0], mine)
    return sentences


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


def _alone(run: Sequence[Success], baseline: str) -> str:
    if len(run) < 2:
        return "one variant only."
    return f"{baseline} was not run."


def _against(variant: str, baseline: str, mine: list[Comparison]) -> list[str]:
    if not mine:
        return [f"{variant} and {baseline} share no case: nothing is compared."]
    tested = [c for c in mine if c.difference.pairs]
    significant, rest = [c for c in tested if c.significant], [c for c in tested if not c.significant]
    out = []
    if significant:
        listed = "; ".join(
            f"{c.metric.title} {'better' if c.better else 'worse'} ({interval(c)}; p = {p_value(c.p_holm)}, {c.difference.pairs} pairs)"
            for c in significant
        )
        out.append(f"{variant} differs significantly from {baseline}: {listed}.")
    else:
        out.append(f"{variant} differs significantly from {baseline} in nothing.")
    for c in rest:
        if c.metric.name == "success":
            out.append(
                f"{variant} against {baseline}, success: not significant ({interval(c)}; p = {p_value(c.p_holm)}, "
                f"{c.difference.pairs} pairs); "
                + ("no difference was seen." if c.difference.mean == 0.0 else f"showing this difference would take {needed(c)}.")
            )
    other = [c for c in rest if c.metric.name != "success"]
    if other:
        listed = ", ".join(
            f"{c.metric.title} ({'alike' if c.difference.mean == 0.0 else c.difference.seeds_needed or 'over 100,000'})" for c in other
        )
        out.append(f"{variant} against {baseline}, not significant, with the pairs that would be needed for the difference seen: {listed}.")
    most, least = max((c.difference.pairs for c in tested), default=0), fewest_pairs(max(len(tested), 1))
    if most < least:
        out.append(f"With {most} pairs nothing can be significant among {len(tested)} metrics; that takes {least} pairs or more.")
    untested = [c.metric.title for c in mine if not c.difference.pairs]
    if untested:
        out.append(f"{variant} against {baseline}, nothing to compare: {', '.join(untested)}.")
    if mine[0].unpaired:
        out.append(f"{mine[0].unpaired} trials of {variant} or {baseline} have no partner and are left out of the differences.")
    return out
