"""The answer of a comparison in words: who succeeds how often, what differs for sure, what may be chance, and how many pairs would tell."""

from __future__ import annotations

from collections.abc import Sequence

from variant_export import counted, p_text, share, title_of
from variant_metrics import Row
from variant_statistics import FEWEST_PAIRS
from variant_tables import Comparison, Place, Success, fewest_pairs, successes


def place_title(place: Place) -> str:
    """A robot at a delay, for a heading."""
    return f"{title_of(place.robot)}, {place.delay_s:g} s of delay each way"


def answer(rows: list[Row], place: Place, partners: dict[str, str], compared: Sequence[Comparison]) -> list[str]:
    """Sentences about one place, plain text: who succeeds how often, then each variant against its partner.

    Args:
        rows: of the comparison.
        place: about which.
        partners: what each variant is held against.
        compared: all differences.
    """
    run = {s.variant for s in successes(rows, place, [*partners.values(), *partners]) if s.rate.trials}
    out = []
    # Those that differ in one stage come after the variants that are ways of planning of their own.
    for variant, partner in sorted(partners.items(), key=lambda pair: list(partners.values()).index(pair[1])):
        if variant in run:
            mine = [c for c in compared if c.place == place and c.variant == variant]
            out += _against(variant, partner, mine, met=partner in run)
    return out


def rates(rows: list[Row], place: Place, variants: Sequence[str]) -> str:
    """One sentence: who succeeds how often."""
    return "Success: " + "; ".join(_often(s) for s in successes(rows, place, variants) if s.rate.trials) + "."


def undecided(place: Place, partners: dict[str, str], compared: Sequence[Comparison]) -> list[str]:
    """Sentences about the figures but success that are not significant at one place, with the pairs each would need."""
    out = []
    for variant, partner in partners.items():
        mine, pair = [c for c in compared if c.place == place and c.variant == variant], f"{variant} against {partner}"
        rest = [c for c in mine if c.difference.pairs and not c.significant and c.metric.name != "success"]
        if rest:
            listed = ", ".join(f"{c.metric.title} ({needed(c) if c.difference.mean else 'alike'})" for c in rest)
            out.append(f"{pair}, in brackets what would show the difference seen, by itself: {listed}.")
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
    return f"at least {n} pairs" if n == FEWEST_PAIRS else f"{n} pairs"


def _often(found: Success) -> str:
    r = found.rate
    return f"{found.variant} {r.successes} of {r.trials} ({100 * r.share:.0f} %, interval {share(r)})"


def _against(variant: str, partner: str, mine: list[Comparison], *, met: bool) -> list[str]:
    if not mine:
        return [f"{variant} and {partner} share no case: nothing is compared." if met else f"{variant}: {partner} was not run here."]
    measured = [c for c in mine if c.difference.pairs]
    tested = [c for c in measured if not c.metric.timing]
    said = [_success(c) for c in tested if c.metric.name == "success"]
    significant = [c for c in tested if c.significant and c.metric.name != "success"]
    timed = [c for c in measured if c.significant and c.metric.timing]
    if significant:
        said.append(f"significant: {_listed(significant)}")
    elif any(c.metric.name != "success" for c in tested):
        said.append("no other figure differs significantly")
    if timed:
        said.append(f"significant among computing times, as measured here: {_listed(timed)}")
    most, least = max((c.difference.pairs for c in tested), default=0), fewest_pairs(max(len(tested), 1))
    if tested and most < least:
        pairs, metrics = counted(most, "pair"), counted(len(tested), "metric")
        said.append(f"with {pairs} nothing can be significant among {metrics}, that takes {least} pairs or more")
    if mine[0].unpaired:
        said.append(f"{counted(mine[0].unpaired, 'trial')} of either without a partner, left out of the differences")
    return [f"{variant} against {partner}: " + ". ".join(s[0].upper() + s[1:] if i else s for i, s in enumerate(said)) + "."]


def _success(c: Comparison) -> str:
    """Whether one succeeds more often than the other."""
    if c.significant:
        return f"succeeds significantly {'more' if c.better else 'less'} often ({_evidence(c)})"
    if c.difference.mean == 0.0:
        return f"succeeds as often in {counted(c.difference.pairs, 'pair')}"
    return f"success not significantly {_side(c)} ({_evidence(c)}; showing this difference by itself would take {needed(c)})"


def _listed(compared: Sequence[Comparison]) -> str:
    return "; ".join(f"{c.metric.title} {_side(c)} ({_evidence(c)})" for c in compared)


def _side(c: Comparison) -> str:
    return "better" if c.better else "worse"


def _evidence(c: Comparison) -> str:
    return f"{interval(c)}; {p_text(c.p_holm)}, {counted(c.difference.pairs, 'pair')}"
