"""The tables at the foot of a comparison's page: all differences, reasons, films, every trial, and where it all comes from."""

from __future__ import annotations

import html
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

from variant_export import counted, p_value, title_of
from variant_figures import outcome_look
from variant_metrics import BY_NAME, Row, succeeded
from variant_rows import picked_trials
from variant_spreads import STAGES, stage_seconds
from variant_tables import Comparison, Place
from variant_words import interval, needed

SHOWN = ("progress_m", "mission_time_s", "command_cycles", "collisions", "faults", "peak_torque_fraction", "min_support_margin_m")
"""figures of a trial's line"""
MOST_REASONS = 12
"""kinds of failure listed for a robot and delay"""


def compared_table(compared: Sequence[Comparison]) -> str:
    """All differences of a place, folded away."""
    if not compared:
        return ""
    lines = "".join(
        f"<tr{' class=strong' if c.significant else ''}><td>{html.escape(c.variant)}</td><td>{html.escape(c.metric.title)}</td>"
        + "".join(f'<td class="n">{html.escape(v)}</td>' for v in _figures(c))
        + "</tr>"
        for c in compared
    )
    titles = ("difference, 95 % interval", "effect", "p", "p (Holm)", "pairs", "left out", "would take")
    head = "".join(f'<th class="n">{t}</th>' for t in titles)
    return (
        '<details><summary>All differences</summary><div class="scroll"><table>'
        f"<tr><th>variant</th><th>metric</th>{head}</tr>{lines}</table></div></details>"
    )


def reasons_table(rows: Sequence[Row], place: Place, variants: Sequence[str]) -> str:
    """Why trials failed, numbers left out so that like reasons count together, folded away."""
    failed = [r for r in rows if place.has(r) and not succeeded(r)]
    if not failed:
        return ""
    counts = Counter((r["outcome"], _kind_of(r), r["variant"]) for r in failed)
    kinds = Counter((r["outcome"], _kind_of(r)) for r in failed)
    lines = "".join(
        f"<tr><td>{html.escape(outcome_look(outcome)[0])}</td><td>{html.escape(why)}</td>"
        + "".join(f'<td class="n">{counts[outcome, why, v] or ""}</td>' for v in variants)
        + "</tr>"
        for (outcome, why), _ in sorted(kinds.items(), key=lambda item: (-item[1], item[0]))[:MOST_REASONS]
    )
    head = "".join(f'<th class="n">{html.escape(v)}</th>' for v in variants)
    rest = f'<p class="small">And {len(kinds) - MOST_REASONS} rarer ones.</p>' if len(kinds) > MOST_REASONS else ""
    return (
        f'<details><summary>Reasons of {counted(len(failed), "failure")}</summary><div class="scroll"><table>'
        f"<tr><th>outcome</th><th>reason</th>{head}</tr>{lines}</table></div>{rest}</details>"
    )


def stage_table(rows: Sequence[Row], place: Place, variants: Sequence[str]) -> str:
    """Seconds of the ground's stages in numbers, folded away."""
    seconds = stage_seconds(rows, place, variants)
    lines = "".join(
        f"<tr><td>{html.escape(stage.replace('_', ' '))}</td>"
        + "".join(f'<td class="n">{_two(seconds[stage].get(v))}</td>' for v in variants)
        + "</tr>"
        for stage in STAGES
        if stage in seconds
    )
    head = "".join(f'<th class="n">{html.escape(v)}</th>' for v in variants)
    return (
        '<details><summary>Median and 95th percentile in seconds</summary><div class="scroll"><table>'
        f"<tr><th>stage</th>{head}</tr>{lines}</table></div></details>"
    )


def films_section(folder: Path, rows: list[Row]) -> str:
    """The best, the median and the worst trial of each robot and variant, with links to what there is of them."""
    lines = []
    for (robot, variant), picked in picked_trials(rows).items():
        cells = "".join(f"<td>{_linked(folder, picked[kind])}</td>" for kind in ("best", "median", "worst"))
        lines.append(f"<tr><td class='name'>{html.escape(title_of(robot))}</td><td>{html.escape(variant)}</td>{cells}</tr>")
    if not lines:
        return ""
    return (
        "<section><h2>Best, median and worst trials</h2><p>By success, then progress, then the shorter mission time, over all "
        'cases of a robot and variant.</p><div class="scroll"><table>'
        '<tr><th>robot</th><th>variant</th><th>best</th><th>median</th><th>worst</th></tr>'
        f"{''.join(lines)}</table></div></section>"
    )


def trials_section(folder: Path, rows: Sequence[Row]) -> str:
    """Every trial, folded away."""
    head = "".join(f'<th class="n">{html.escape(BY_NAME[name].title)}</th>' for name in SHOWN)
    lines = "".join(
        f"<tr><td>{html.escape(r['case'])}</td><td>{html.escape(r['variant'])}</td>"
        f"<td>{_outcome(r)}</td>"
        + "".join(f'<td class="n">{html.escape(_figure(r, name))}</td>' for name in SHOWN)
        + f"<td>{html.escape(str(r['reason']))}</td><td>{_links(folder, r)}</td></tr>"
        for r in rows
    )
    return (
        f"<section><h2>Every trial</h2><details><summary>{counted(len(rows), 'trial')}</summary>"
        '<div class="scroll"><table>'
        f"<tr><th>case</th><th>variant</th><th>outcome</th>{head}<th>reason</th><th></th></tr>{lines}</table></div></details></section>"
    )


def provenance_footer(rows: Sequence[Row]) -> str:
    """Versions, commit, processors, seeds and suite, as the rows tell them."""
    origins = [r["provenance"] for r in rows if r["provenance"]]
    first: dict[str, Any] = origins[0] if origins else {}

    def all_of(key: str) -> str:
        return ", ".join(sorted({str(o[key]) for o in origins if o.get(key)})) or "unknown"

    operators = sorted({str(r.get("operator") or "unknown") for r in rows})
    packages = ", ".join(f"{name} {v}" for name, v in sorted((first.get("packages") or {}).items()))
    words = (
        f"athlete_twin {first.get('version') or 'unknown'}, commit {first.get('git_sha') or 'unknown'}. "
        f"Python {all_of('python')}; {all_of('platform')}; processor {all_of('cpu')}. {packages + '. ' if packages else ''}"
        f"Seeds {spans(sorted({int(r['seed']) for r in rows}))}. Operator {', '.join(operators)}. "
        f"Suite {rows[0]['suite_sha256'] or 'none: cases were named by hand'}. A dash is a figure that was not measured."
    )
    return f"<footer>{html.escape(words)}</footer>"


def spans(numbers: Sequence[int]) -> str:
    """Ascending numbers with their runs shortened."""
    runs: list[list[int]] = []
    for n in numbers:
        if runs and n == runs[-1][-1] + 1:
            runs[-1].append(n)
        else:
            runs.append([n])
    return ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 2 else ", ".join(map(str, run)) for run in runs)


def _figures(c: Comparison) -> tuple[str, ...]:
    d = c.difference
    if not d.pairs:
        return ("–", "–", "–", "–", "0", str(d.missing), "")
    effect = f"{d.effect:+.2f}".replace("-", "−") if d.effect == d.effect else "–"
    return (interval(c), effect, p_value(d.p), p_value(c.p_holm), str(d.pairs), str(d.missing), needed(c) if d.mean else "")


def _two(seconds: tuple[float, float, int] | None) -> str:
    return f"{seconds[0]:.2f}, {seconds[1]:.2f} of {counted(seconds[2], 'trial')}" if seconds else "–"


def _outcome(row: Row) -> str:
    words, colour = outcome_look(row["outcome"])
    return f'<span class="name"><i style="background:{colour}"></i>{html.escape(words)}</span>'


def _figure(row: Row, name: str) -> str:
    """A trial's own figure: what is counted is whole."""
    metric = BY_NAME[name]
    value = metric.read(row)
    return f"{value:.0f}" if value is not None and not metric.unit else metric.shown(value)


def _kind_of(row: Row) -> str:
    """The reason without its numbers and details; of a fault its code."""
    reason = " ".join(str(row["reason"]).split())
    head = reason.split(":", 1)[0] if row["outcome"] == "fault" else re.split(r"[(;]", reason, maxsplit=1)[0]
    return re.sub(r"-?\d+(\.\d+)?", "…", head).strip() or "no reason given"


def _linked(folder: Path, row: Row) -> str:
    figures = ", ".join(BY_NAME[name].shown(BY_NAME[name].read(row)) for name in ("progress_m", "mission_time_s"))
    text = f"{outcome_look(row['outcome'])[0]}, {figures}"
    return f"{html.escape(row['case'])}: {html.escape(text)} {_links(folder, row)}".rstrip()


def _links(folder: Path, row: Row) -> str:
    """To the trial's own report and film, as far as they exist within the folder."""
    place = PurePosixPath(row["folder"])
    if place.is_absolute() or ".." in place.parts:
        return ""
    found = [(name, word) for name, word in (("report.html", "report"), ("film.webm", "film")) if (folder / place / name).is_file()]
    return " ".join(f'<a href="{html.escape(quote(f"{place}/{name}"))}">{word}</a>' for name, word in found)
