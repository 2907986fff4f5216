"""Figures of a comparison's figures: paired differences with their intervals, how trials spread, and what planning takes."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np
from report_style import INK, LIMIT, MUTED, png, subplots
from variant_figures import WIDTH, Look, present, short
from variant_metrics import BY_NAME, Metric, Row
from variant_tables import Comparison, Place

SPREAD = (
    "progress_m", "sag_error_m.mean", "touchdown_error_m.mean", "map_error_m.median", "localisation_error_m.mean", "peak_torque_fraction",
    "min_support_margin_m", "min_tip_over_energy_m",
)  # fmt: skip
STAGES = ("plan", "footfall", "stereo", "self_mask", "localise", "bundle", "fuse", "route", "preview")
"""of the ground, in data-flow order after the whole plan"""


def difference_figure(compared: Sequence[Comparison], looks: dict[str, Look]) -> bytes | None:
    """A panel a metric, a dot a variant: its difference with the 95 % interval; None of no differences.

    Args:
        compared: all against one baseline.
        looks: of the variants.
    """
    metrics = list({c.metric.name: c.metric for c in compared if c.difference.pairs}.values())
    if not metrics:
        return None
    variants = [v for v in looks if any(c.variant == v for c in compared)]
    # What differs in one stage is named by that alone.
    names = [v.removeprefix(f"{compared[0].baseline}_") for v in variants]
    columns = 2
    lines = -(-len(metrics) // columns)
    figure, axes = subplots(lines, columns, figsize=(WIDTH, 0.5 + lines * (0.86 + 0.2 * len(variants))), sharey=True, squeeze=False)
    for ax, metric in zip(axes.flat, metrics, strict=False):
        for y, variant in enumerate(variants):
            for c in (c for c in compared if c.variant == variant and c.metric is metric):
                _difference(ax, y, c, looks[variant])
        ax.axvline(0.0, color=MUTED, lw=0.9)
        ax.set_title(_titled(metric), fontsize=8.5)
        ax.set_title("→" if metric.better == "more" else "←", loc="right", fontsize=9, fontweight="normal", color=MUTED)
        _panel(ax, names)
        far = _farthest([c for c in compared if c.metric is metric])
        ax.set_xlim(-far, far)  # zero in the middle, so that panels read alike
    for ax in axes.flat[len(metrics) :]:
        ax.set_visible(False)
    return png(figure)


def spread_figure(rows: Sequence[Row], place: Place, looks: dict[str, Look], *, draws: np.random.Generator) -> bytes | None:
    """Every trial as a dot behind its variant's quartiles; None where nothing was measured."""
    variants = present(rows, place, looks)
    measured = {name: _measured(rows, place, variants, BY_NAME[name]) for name in SPREAD}
    names = [name for name in SPREAD if any(measured[name].values())]
    if not names:
        return None
    columns = 2
    lines = -(-len(names) // columns)
    figure, axes = subplots(lines, columns, figsize=(WIDTH, 0.4 + lines * (0.7 + 0.29 * len(variants))), sharey=True, squeeze=False)
    for ax, name in zip(axes.flat, names, strict=False):
        metric = BY_NAME[name]
        for y, variant in enumerate(variants):
            values = metric.scale * np.array(measured[name][variant])
            if not len(values):
                continue
            ax.text(1.01, y, str(len(values)), transform=ax.get_yaxis_transform(), va="center", fontsize=7, color=MUTED)
            colour = looks[variant].colour
            ax.plot(values, y + draws.uniform(-0.24, 0.24, len(values)), "o", color=colour, alpha=0.4, ms=3.2, mew=0)
            if len(values) > 1:
                ax.boxplot(
                    values, positions=[y], orientation="horizontal", widths=0.62, whis=(5, 95), showfliers=False, manage_ticks=False,
                    boxprops={"color": colour, "lw": 1.1}, whiskerprops={"color": colour}, capprops={"color": colour},
                    medianprops={"color": INK, "lw": 1.6},
                )  # fmt: skip
        if name == "peak_torque_fraction":
            ax.axvline(100.0, color=LIMIT, lw=1.0)
        ax.set_title(f"{metric.title} [{metric.unit}]", fontsize=8.5)
        _panel(ax, variants)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    return png(figure)


def stage_seconds(rows: Sequence[Row], place: Place, variants: Sequence[str]) -> dict[str, dict[str, tuple[float, float, int]]]:
    """By stage and variant: median over trials of their medians, and of their 95th percentiles [s], and how many trials."""
    found: dict[str, dict[str, tuple[float, float, int]]] = {}
    for stage in STAGES:
        for variant in variants:
            times = [
                t
                for r in rows
                if place.has(r) and r["variant"] == variant and isinstance(t := (r["stage_times_s"] or {}).get(stage), dict)
                if t.get("median") is not None and t.get("p95") is not None
            ]
            if times:
                middle, late = (median(float(t[key]) for t in times) for key in ("median", "p95"))
                found.setdefault(stage, {})[variant] = (middle, late, len(times))
    return found


def stage_figure(rows: Sequence[Row], place: Place, looks: dict[str, Look]) -> bytes | None:
    """Measured seconds of the ground's stages, a line from the median to the 95th percentile; None where nothing was timed."""
    variants = present(rows, place, looks)
    seconds = stage_seconds(rows, place, variants)
    if not seconds:
        return None
    figure, axes = subplots(figsize=(WIDTH, 0.9 + len(seconds) * (0.3 + 0.15 * len(variants))))
    step = 0.8 / max(len(variants), 1)
    named = set()
    for y, by_variant in enumerate(seconds.values()):
        for i, variant in enumerate(variants):
            if variant not in by_variant:
                continue
            middle, late, _ = by_variant[variant]
            look, at = looks[variant], y + (i - 0.5 * (len(variants) - 1)) * step
            axes.plot([middle, late], [at, at], color=look.colour, lw=1.4)
            axes.plot(late, at, "|", color=look.colour, ms=7, mew=1.6)
            axes.plot(middle, at, look.marker, color=look.colour, ms=5, label=None if variant in named else short(variant))
            named.add(variant)
    axes.set_yticks(range(len(seconds)), [s.replace("_", " ") for s in seconds])
    axes.set_ylim(len(seconds) - 0.45, -0.55)
    if all(low > 0.0 for by_variant in seconds.values() for low, _, _ in by_variant.values()):
        axes.set_xscale("log")
    axes.set_xlabel("measured seconds a call: mark median, dash 95 %")
    axes.grid(True, axis="x")
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    figure.legend(loc="outside upper center", ncols=3)
    return png(figure)


def _difference(axes: Any, y: int, c: Comparison, look: Look) -> None:
    d, scale = c.difference, c.metric.scale
    if not d.pairs:
        axes.text(0.0, y, " no pair", fontsize=7, color=MUTED, va="center")
        return
    if np.isfinite(d.low):
        axes.plot([scale * d.low, scale * d.high], [y, y], color=look.colour, lw=1.8)
    fill = look.colour if c.significant else "white"
    axes.plot(scale * d.mean, y, look.marker, color=look.colour, mfc=fill, mew=1.3, ms=5.5)


def _panel(axes: Any, variants: Sequence[str]) -> None:
    """A line a variant, and no more numbers below than a narrow panel holds."""
    axes.set_yticks(range(len(variants)), [short(v, 18) for v in variants])
    axes.set_ylim(len(variants) - 0.4, -0.6)
    axes.tick_params(axis="both", length=0, labelsize=8)
    axes.tick_params(axis="y", labelcolor=INK)
    axes.locator_params(axis="x", nbins=4)
    axes.spines["left"].set_visible(False)
    axes.grid(True, axis="x")


def _titled(metric: Metric) -> str:
    unit = "points" if metric.name == "success" else metric.unit
    return f"{metric.title}{f' [{unit}]' if unit else ''}{' *' if metric.reached_only else ''}"


def _farthest(compared: Sequence[Comparison]) -> float:
    """Half the width of a panel, in the metric's unit: what is to be seen and some air."""
    values = [c.metric.scale * v for c in compared for v in (c.difference.mean, c.difference.low, c.difference.high) if np.isfinite(v)]
    return 1.15 * max((abs(v) for v in values), default=0.0) or 1.0


def _measured(rows: Sequence[Row], place: Place, variants: Sequence[str], metric: Metric) -> dict[str, list[float]]:
    return {
        v: [x for r in rows if place.has(r) and r["variant"] == v and (x := metric.read(r)) is not None] for v in variants
    }  # fmt: skip
