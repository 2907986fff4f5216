"""What every benchmark prints: rows of one shape, as a table or as one JSON object.

A row: our figure, a peer's measured in the same run (null where there is none), their ratio, a target such as "<= 1.0",
"> 2" or "0.85 - 0.95", and whether it is met. The target is for the ratio where the row is made `of="ratio"`, for our
figure otherwise. A figure that was not measured is null, and so is its verdict. A question whose answer is no, such as the
torque of a stance that nothing holds, has no figure either, but a verdict: not met, with the reason in the row's name.
"""

from __future__ import annotations

import json
import math
import operator
import sys
from collections.abc import Sequence
from typing import Any, Literal

from envs.provenance import provenance

Row = dict[str, Any]
COMPARE = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt}
VERDICT = {True: "yes", False: "no", None: "-"}


def row(
    name: str,
    ours: float | None,
    unit: str,
    *,
    target: str = "",
    of: Literal["ours", "ratio"] = "ours",
    peer_name: str | None = None,
    peer: float | None = None,
    no: str = "",
) -> Row:
    """One line of a benchmark.

    Args:
        name: what was measured, and on what.
        ours: our figure; None or NaN where it was not measured; infinite is null too, and judged.
        unit: of both figures.
        target: such as ">= 5.0" or "0.85 - 0.95"; empty where none was set.
        of: whether the target is for our figure or for ours over the peer's.
        peer_name: who was measured beside us in the same run.
        peer: its figure.
        no: why there is no figure and the target, if any, is missed.
    """
    measured = None if ours is None or math.isnan(ours) else float(ours)
    own = measured if measured is not None and math.isfinite(measured) and not no else None
    ratio = own / peer if own is not None and peer else None
    judged = ratio if of == "ratio" else measured
    met = None if judged is None or not target else meets(judged, target)
    return {
        "name": f"{name}: no, {no}" if no else name, "ours": own, "unit": unit, "peer_name": peer_name, "peer": peer, "ratio": ratio,
        "target": target, "met": False if no else met,
    }  # fmt: skip


def refusal(what: str, reason: str) -> Row:
    """A row that says "no": what was to be measured could not be, and why, so that the rest is told nevertheless."""
    return row(f"{what}: no, {' '.join(reason.split())}", 0.0, "1", target=">= 1")


def meets(value: float, target: str) -> bool:
    """Whether a figure is what a target such as "<= 1.0" or "0.85 - 0.95" asks for."""
    sign, _, limit = target.partition(" ")
    if sign in COMPARE:
        return bool(COMPARE[sign](value, float(limit)))
    low, dash, high = target.partition(" - ")
    if not dash:
        raise ValueError(f"target {target!r} is neither a comparison such as '<= 1.0' nor a range such as '0.85 - 0.95'")
    return float(low) <= value <= float(high)


def show(rows: Sequence[Row], *, as_json: bool) -> None:
    """The rows on standard output, as one JSON object with what made them, or as a table."""
    if as_json:
        sys.stdout.write(json.dumps({"rows": list(rows), "provenance": provenance()}) + "\n")
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("what", "ours", "peer", "ratio", "target", "met")
    for r in rows:
        peer = figure(r["peer"])
        named = peer if r["peer_name"] is None else f"{peer} ({r['peer_name']})"
        what = f"{r['name']} [{r['unit']}]".replace("[", "\\[")
        table.add_row(what, figure(r["ours"]), named, figure(r["ratio"]), r["target"] or "-", VERDICT[r["met"]])
    console = Console() if sys.stdout.isatty() else Console(width=150)
    console.print(table)


def figure(value: float | None) -> str:
    """A figure for people, three digits long; a dash where there is none."""
    return "-" if value is None else f"{value:.3g}"
