"""A comparison for other programs: all rows flat as CSV and Parquet, and the table of results as Markdown."""

from __future__ import annotations

import csv
import importlib
import importlib.util
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from variant_metrics import BY_NAME, SUCCESS, Metric, Row, succeeded
from variant_statistics import Rate
from variant_tables import Comparison, Place, successes

TITLES = {"sdm_b": "SDM-B", "t12": "T12"}
HEAD = (
    "robot", "delay [s]", "variant", "trials", "succeeded", "95 % interval", "difference", "from", "p (Holm)", "tipped over", "collisions",
    "faults", "other outcomes", "median progress [m]", "median mission time [min]*", "median command cycles*",
)  # fmt: skip


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """One line a trial, nested figures under dotted names; what was not measured is empty."""
    flat, columns = flattened(rows)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(flat)


def write_parquet(path: Path, rows: Sequence[Row]) -> bool:
    """The same as Parquet; False, and no file, where pyarrow is not installed."""
    if importlib.util.find_spec("pyarrow") is None:
        path.unlink(missing_ok=True)  # of an earlier run
        return False
    pyarrow, parquet = (importlib.import_module(name) for name in ("pyarrow", "pyarrow.parquet"))
    flat, columns = flattened(rows)
    parquet.write_table(pyarrow.table({c: _alike([row[c] for row in flat]) for c in columns}), path)
    return True


def flattened(rows: Sequence[Row]) -> tuple[list[Row], list[str]]:
    """The rows without nesting, with `success`, and the names of all columns, those that identify a trial first."""
    flat = [{"success": succeeded(row)} | dict(_leaves(row, "")) for row in rows]
    named = dict.fromkeys(column for row in flat for column in row)
    first = [c for c in ("case", "robot", "scenario", "seed", "delay_s", "variant", "outcome", "success", "reason") if c in named]
    # A summary that some trials lack as a whole is a null there, not a column of its own.
    hollow = {c for c in named if any(other.startswith(f"{c}.") for other in named)}
    columns = [*first, *(c for c in named if c not in first and c not in hollow)]
    return [{c: row.get(c) for c in columns} for row in flat], columns


def markdown(
    rows: list[Row], places: Sequence[Place], variants: Sequence[str], compared: Sequence[Comparison], part: str = ""
) -> str:
    """Rates of success and their differences, a row for each robot, delay and variant; `part` says what is missing."""
    lines = ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    for place in places:
        tested = {c.variant: c for c in compared if c.place == place and c.metric is SUCCESS}
        for found in successes(rows, place, variants):
            mine = [r for r in rows if place.has(r) and r["variant"] == found.variant]
            if mine:
                cells = _cells(place, found.variant, found.rate, mine, tested.get(found.variant))
                lines.append("| " + " | ".join(cells) + " |")
    notes = f"Baseline: {cell(variants[0])}. Medians and totals say of how many trials they are; \\* of those that succeeded."
    notes += f" {part}" if part else ""
    return "\n".join([*lines, "", notes]) + "\n"


def share(found: Rate) -> str:
    """A rate's interval in per cent."""
    return f"{100 * found.low:.0f} to {100 * found.high:.0f} %"


def p_value(p: float) -> str:
    """A p-value for people."""
    if p != p:
        return "–"
    return "< 0.001" if p < 0.001 else f"{p:.3f}"


def p_text(p: float) -> str:
    """A p-value with its name."""
    shown = p_value(p)
    return f"p {shown}" if shown.startswith("<") else f"p = {shown}"


def counted(n: int, thing: str) -> str:
    """So many things."""
    return f"{n} {thing}" if n == 1 else f"{n} {thing}s"


def title_of(robot: str) -> str:
    """A robot's name for people."""
    return TITLES.get(robot, robot)


def median_of(rows: Iterable[Row], metric: Metric) -> float | None:
    """Median of a metric as measured; None of nothing."""
    values = measured_of(rows, metric)
    return median(values) if values else None


def measured_of(rows: Iterable[Row], metric: Metric) -> list[float]:
    """A metric of the trials in which it was measured."""
    return [v for v in (metric.read(row) for row in rows) if v is not None]


def median_cell(rows: Sequence[Row], metric: Metric, *, unit: bool = True) -> str:
    """Median of a metric with the number of trials it is of; a dash of none."""
    value, n = median_of(rows, metric), len(measured_of(rows, metric))
    return f"{metric.shown(value) if unit else metric.number(value)} of {counted(n, 'trial')}" if value is not None else "–"


def total_cell(rows: Sequence[Row], metric: Metric) -> str:
    """Sum of what is counted with the number of trials it is of; a dash of none."""
    values = measured_of(rows, metric)
    return f"{sum(values):.0f} in {counted(len(values), 'trial')}" if values else "–"


def cell(text: str) -> str:
    """Text that cannot break a Markdown table."""
    return " ".join(text.split()).replace("\\", "\\\\").replace("|", "\\|").replace("<", "&lt;")


def _cells(place: Place, variant: str, found: Rate, mine: list[Row], tested: Comparison | None) -> list[str]:
    well = [r for r in mine if succeeded(r)]
    others = Counter(r["outcome"] for r in mine if not succeeded(r) and r["outcome"] != "tip_over")

    def middle(rows: list[Row], name: str) -> str:
        return median_cell(rows, BY_NAME[name], unit=False)

    difference = partner = p = "–"
    if tested is not None:
        d = tested.difference
        interval = f" ({SUCCESS.number(d.low, sign=True)} to {SUCCESS.number(d.high, sign=True)})" if d.low == d.low else ""
        partner = cell(tested.baseline)
        difference, p = f"{SUCCESS.number(d.mean, sign=True)} points{interval}", p_value(tested.p_holm)
    return [
        cell(place.robot), f"{place.delay_s:g}", cell(variant), str(found.trials), str(found.successes), share(found),
        difference, partner, p, str(sum(r["outcome"] == "tip_over" for r in mine)),
        *(total_cell(mine, BY_NAME[name]) for name in ("collisions", "faults")),
        ", ".join(f"{n} {cell(name)}" for name, n in sorted(others.items())) or "none",
        middle(mine, "progress_m"), middle(well, "mission_time_s"), middle(well, "command_cycles"),
    ]  # fmt: skip


def _leaves(value: Any, name: str) -> Iterable[tuple[str, Any]]:
    if isinstance(value, dict) and (value or not name):
        for key, inner in value.items():
            yield from _leaves(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, dict | list):
        yield name, json.dumps(value) if value else None
    else:
        yield name, value


def _alike(values: list[Any]) -> list[Any]:
    """The values of a column, as text where they are of several kinds: a column of Parquet has one type."""
    kinds = {bool if isinstance(v, bool) else float if isinstance(v, int | float) else type(v) for v in values if v is not None}
    if len(kinds) > 1:
        return [None if v is None else str(v) for v in values]
    if any(isinstance(v, float) for v in values):
        return [None if v is None else float(v) for v in values]
    return values


