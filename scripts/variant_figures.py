"""Figures of a comparison: success, how trials ended, where the mission time went, and both over the delay."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
from report_style import BIN_COLOURS, INK, MUTED, png, subplots
from variant_export import counted, median_of
from variant_fields import PARTS
from variant_metrics import BY_NAME, Row, succeeded
from variant_tables import Place, grounds_of, places_of, successes

COLOURS = (
    "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#24292f", "#8a8d91", "#882255", "#999933", "#332288", "#44aa99",
    "#aa4499", "#ddcc77", "#661100", "#6699cc",
)  # fmt: skip
"""of variants in their order: Okabe and Ito's, then of Tol's muted ones; colour-blind people tell them apart, with the markers' help"""
MARKERS = "osD^vPX"
OUTCOMES = {
    "goal_reached": ("goal reached", "#009e73"),
    "cycles_done": ("gait cycles done", "#7fd0b5"),
    "time_limit": ("time limit", "#f0e442"),
    "operator_abort": ("stopped by the operator", "#b9bcc1"),
    "no_step": ("no step found", "#e69f00"),
    "fault": ("fault", "#d55e00"),
    "tip_over": ("tipped over", "#24292f"),
    "error": ("could not be run", "#cc79a7"),
}
WIDTH = 5.4
"""of a figure of one robot [inch]: two stand side by side on a desk, one fills a phone"""
ROW = 0.27
"""height of a variant's line [inch]"""


@dataclass(frozen=True, kw_only=True)
class Look:
    """How a variant is drawn, in every figure."""

    colour: str
    marker: str


def looks_of(variants: Sequence[str]) -> dict[str, Look]:
    """A look for each variant; from the seventeenth on colours come again with another marker."""
    return {
        v: Look(colour=COLOURS[i % len(COLOURS)], marker=MARKERS[i % len(MARKERS)]) for i, v in enumerate(variants)
    }


def success_figure(rows: Sequence[Row], place: Place, looks: dict[str, Look]) -> bytes:
    """Rates of success with Wilson's intervals, on all grounds together and by density of rocks."""
    parts = grounds_of(rows, place)
    blocks = [("all grounds", place), *((p.ground, p) for p in parts)] if len(parts) > 1 else [(parts[0].ground, place)]
    variants = present(rows, place, looks)
    figure, axes = subplots(figsize=(WIDTH, 0.9 + (ROW * len(variants) + 0.32) * len(blocks)))
    ticks, y = [], 0.0
    for title, part in blocks:
        axes.text(0.0, y, short(title, 40), fontsize=9, fontweight="bold", va="center")
        y += 1.0
        for found in successes(rows, part, variants):
            r, look = found.rate, looks[found.variant]
            ticks.append((y, found.variant))
            if r.trials:
                axes.plot([100 * r.low, 100 * r.high], [y, y], color=look.colour, lw=2.2, solid_capstyle="butt", clip_on=False)
                axes.plot(100 * r.share, y, look.marker, color=look.colour, ms=7, clip_on=False)
            axes.text(103.5, y, f"{r.successes}/{r.trials}", va="center", fontsize=8, color=MUTED)
            y += 1.0
        y += 0.3
    axes.set_yticks([t for t, _ in ticks], [short(v) for _, v in ticks])
    axes.set(xlim=(-1, 101), ylim=(y - 0.6, -0.7), xlabel="success, 95 % interval [%]")
    _open(axes)
    return png(figure)


def outcome_figure(rows: Sequence[Row], place: Place, looks: dict[str, Look]) -> bytes:
    """How the trials of each variant ended, as shares."""
    variants = present(rows, place, looks)
    known = {r["outcome"] for r in rows if place.has(r)}
    kinds = [*(o for o in OUTCOMES if o in known), *sorted(known - OUTCOMES.keys())]
    figure, axes = subplots(figsize=(WIDTH, 1.25 + 0.36 * len(variants)))
    for y, variant in enumerate(variants):
        mine = [r["outcome"] for r in rows if place.has(r) and r["variant"] == variant]
        left = 0.0
        for kind in kinds:
            n = mine.count(kind)
            if n:
                width = 100 * n / len(mine)
                colour = outcome_look(kind)[1]
                axes.barh(y, width, left=left, height=0.72, color=colour, edgecolor="white", lw=0.8)
                axes.text(left + 0.5 * width, y, str(n), ha="center", va="center", fontsize=8, color=_readable(colour))
                left += width
    _variants_below(axes, variants)
    axes.set(xlim=(0, 100), xlabel="trials [%]; numbers count them")
    _key(axes, [outcome_look(k) for k in kinds])
    return png(figure)


def time_figure(rows: Sequence[Row], place: Place, looks: dict[str, Look]) -> bytes | None:
    """Mean mission time of the trials that succeeded, split as it is charged; None where none did."""
    variants = present(rows, place, looks)
    timed = [r for r in rows if place.has(r) and succeeded(r) and all(r[p] is not None for p in PARTS)]
    well = {v: [r for r in timed if r["variant"] == v] for v in variants}
    if not any(well.values()):
        return None
    figure, axes = subplots(figsize=(WIDTH, 1.25 + 0.36 * len(variants)))
    longest = 0.0
    for y, variant in enumerate(variants):
        left = 0.0
        for part in PARTS if well[variant] else ():
            minutes = fmean(float(r[part]) for r in well[variant]) / 60.0
            axes.barh(y, minutes, left=left, height=0.72, color=BIN_COLOURS[part.removesuffix("_s")], edgecolor="white", lw=0.8)
            left += minutes
        n = len(well[variant])
        axes.text(left, y, f"  {left:.0f} min, {counted(n, 'trial')}" if n else "  none succeeded", va="center", fontsize=8, color=MUTED)
        longest = max(longest, left)
    _variants_below(axes, variants)
    axes.set(xlim=(0, 1.35 * max(longest, 1e-3)), xlabel="mean mission time of trials that succeeded [min]")
    _key(axes, [(part.removesuffix("_s"), BIN_COLOURS[part.removesuffix("_s")]) for part in PARTS])
    return png(figure)


def delay_figure(rows: Sequence[Row], robot: str, looks: dict[str, Look]) -> bytes | None:
    """Success and mission time over the delay; None of a single delay."""
    places = [p for p in places_of(rows) if p.robot == robot]
    if len(places) < 2:
        return None
    figure, (share, minutes) = subplots(1, 2, figsize=(WIDTH, 3.6))
    span = places[-1].delay_s - places[0].delay_s
    metric = BY_NAME["mission_time_s"]
    for i, (variant, look) in enumerate(looks.items()):
        nudge = 0.012 * span * (i - 0.5 * (len(looks) - 1))  # else intervals hide each other
        rates = [(p.delay_s + nudge, s.rate) for p in places for s in successes(rows, p, [variant]) if s.rate.trials]
        if not rates:
            continue
        times = [p.delay_s for p in places]
        middle = [median_of((r for r in rows if p.has(r) and r["variant"] == variant and succeeded(r)), metric) for p in places]
        for x, r in rates:
            share.vlines(x, 100 * r.low, 100 * r.high, color=look.colour, alpha=0.45)
        share.plot([x for x, _ in rates], [100 * r.share for _, r in rates], marker=look.marker, color=look.colour, ms=5, lw=1.3)
        minutes.plot(
            times, [np.nan if m is None else m / 60 for m in middle], marker=look.marker, color=look.colour, ms=5, lw=1.3,
            label=short(variant),
        )  # fmt: skip
    share.set(title="Success [%]", xlabel="delay each way [s]", ylim=(-3, 103))
    minutes.set(title="Median mission time [min]", xlabel="delay each way [s]", ylim=(0, None))
    for ax in (share, minutes):
        ax.grid(True, axis="y")
        ax.set_xticks([p.delay_s for p in places])
    figure.legend(*minutes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return png(figure)


def present(rows: Sequence[Row], place: Place, looks: dict[str, Look]) -> list[str]:
    """Variants that have a trial here, in their order."""
    names = {r["variant"] for r in rows if place.has(r)}
    return [v for v in looks if v in names]


def outcome_look(kind: str) -> tuple[str, str]:
    """An outcome's words and colour."""
    return OUTCOMES.get(kind, (short(kind), "#b9bcc1"))


def short(text: str, most: int = 24) -> str:
    """A name that fits beside a bar, and that matplotlib takes for text and nothing else."""
    return textwrap.shorten(text.replace("$", r"\$"), most, placeholder="…") if " " in text else _cut(text, most)


def _cut(text: str, most: int) -> str:
    cut = text if len(text) <= most else text[: most // 2 - 1] + "…" + text[-(most - most // 2) :]
    return cut.replace("$", r"\$")


def _readable(colour: str) -> str:
    """Black or white, whichever shows on a colour."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return INK if 0.299 * red + 0.587 * green + 0.114 * blue > 140 else "white"


def _variants_below(axes: Any, variants: Sequence[str]) -> None:
    axes.set_yticks(range(len(variants)), [short(v) for v in variants])
    axes.set_ylim(len(variants) - 0.5, -0.5)
    _open(axes)


def _open(axes: Any) -> None:
    axes.grid(True, axis="x")
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.spines["left"].set_visible(False)


def _key(axes: Any, named: Sequence[tuple[str, str]]) -> None:
    from matplotlib.patches import Patch

    handles = [Patch(facecolor=colour, label=name) for name, colour in named]
    axes.figure.legend(handles=handles, loc="outside upper center", ncols=min(len(handles), 3), handlelength=1.0, columnspacing=1.2)
