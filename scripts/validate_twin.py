"""Holds the twin's physics against the published figures: one line a target, and the figures beside it.

    python scripts/validate_twin.py [--robots sdm_b t12] [--sets 100] [--out out/validate] [--json]

Every number comes from the physics at rest: wheel loads and torques with none, one and two opposite legs lifted, each
followed by its spread over seeded sets of tyres; corner heights against the planner's foot springs; the lift that breaks
contact; slides on slopes. A target that is missed is printed as missed. Exit status 0 when it ran, whatever it found.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from validate_figures import draw
from validate_rows import ALL, LIFT, LIFTED, ONE, STEEP, TUNED_LEGEND, TWO, Measured, Row, elsewhere, rows_of
from validate_runs import Rest, lift_that_breaks_contact, stand, stand_on_drawn_tyres, step_on_slope, straight_sizes

from athlete_twin.errors import AthleteError
from athlete_twin.model.spec import load_spec
from envs.provenance import provenance

SLOPES = (7, 14, *STEEP)
"""[deg]"""
PAYLOAD = 300.0
"""[kg]"""
WIDTH = 170
"""of the table where no terminal says how wide it is"""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures, prints the table and draws the figures."""

    robots: Annotated[tuple[str, ...], tyro.conf.arg(aliases=["--robot"])] = ("sdm_b", "t12")
    sets: int = 100
    """seeded sets of tyres; 0 for none"""
    workers: int = 2
    """processes that work on the sets"""
    out: Path = Path("out/validate")
    """folder of the figures"""
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    if options.sets < 0 or options.workers < 1:
        sys.stderr.write("validate_twin: --sets must not be negative, --workers at least 1\n")
        return 2
    try:
        measured = _measure_all(options)
    except AthleteError as e:
        sys.stderr.write(f"validate_twin: {' '.join(str(e).split())}\n")
        return 2
    rows = [row for m in measured for row in rows_of(m)] + elsewhere()
    figures = draw(options.out, measured)
    if options.json:
        sys.stdout.write(json.dumps({"rows": [row.as_json() for row in rows], "provenance": provenance()}) + "\n")
        return 0
    console = Console() if sys.stdout.isatty() else Console(width=WIDTH)
    console.print(_table(rows))
    failed = sum(row.met is False for row in rows)
    console.print(f"{sum(row.met is True for row in rows)} targets met, {failed} missed; W: weight, R: foot radius")
    console.print(TUNED_LEGEND)
    console.print("figures: " + ", ".join(str(path) for path in figures))
    return 0


def _measure_all(options: Options) -> list[Measured]:
    columns = (TextColumn("{task.description:28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        return [_measure(robot, options, progress) for robot in options.robots]


def _measure(robot: str, options: Options, progress: Progress) -> Measured:
    spec, slopes = load_spec(robot), SLOPES if robot == "sdm_b" else ()
    task = progress.add_task(robot, total=len(LIFTED) + 3 + len(slopes) + options.sets)

    def done(what: str) -> None:
        progress.update(task, description=f"{robot}: {what}", advance=1)

    stances = {}
    for lifted in LIFTED:
        stances[lifted] = stand(robot, lifted)
        done("stances")
    lifts = {}
    # T12's own payload is another one, and no figure is known for it.
    loads = {"empty": (0.0, LIFT), "loaded": (PAYLOAD, LIFT), "raised": (PAYLOAD, LIFT)}
    if robot == "sdm_b":
        loads["loaded"] = (PAYLOAD, 0.20)
    for name, (payload, highest) in loads.items():
        if name == "empty" or robot == "sdm_b":
            lifts[name] = lift_that_breaks_contact(robot, 0, payload_kg=payload, highest=highest)
        done("lifts")
    slides = {}
    for angle in slopes:
        slides[angle] = step_on_slope(robot, float(np.deg2rad(angle)))
        done("slopes")
    nominal = tuple(stances[lifted] for lifted in (ALL, ONE, TWO))
    reference = {rest.lifted: rest for rest in stand_on_drawn_tyres(robot, None, nominal)}
    sets = []
    for rests in _sets(robot, options, nominal):
        sets.append({rest.lifted: rest for rest in rests})
        done("sets of tyres")
    return Measured(
        spec=spec, sizes=straight_sizes(robot), stances=stances, sets=tuple(sets), reference=reference, lifts=lifts,
        slides=slides,
    )  # fmt: skip


def _sets(robot: str, options: Options, nominal: tuple[Rest, ...]) -> Iterator[tuple[Rest, ...]]:
    """The stances on every set of tyres. A set depends on its seed alone, however the processes share them."""
    run = partial(stand_on_drawn_tyres, robot, nominal=nominal)
    if options.workers == 1:
        yield from map(run, range(options.sets))
        return
    with ProcessPoolExecutor(max_workers=options.workers) as pool:
        yield from pool.map(run, range(options.sets))


def _table(rows: list[Row]) -> Table:
    table = Table("item", "what", "published", "ours", "target", "result", "note")
    for row in rows:
        colour = {True: "green", False: "red", None: "dim"}[row.met]
        verdict = {True: "pass", False: "FAIL", None: "-"}[row.met]
        published = "" if row.published is None else f"{_number(row.published, row.unit)} ({row.source})"
        table.add_row(
            row.item, f"{row.name} [{row.unit}]".replace("[", "\\["), published, _ours(row), row.target,
            f"[{colour}]{verdict}[/{colour}]", row.note,
        )  # fmt: skip
    return table


def _ours(row: Row) -> str:
    if row.ours is None:
        return ""
    if row.low is None or row.high is None:
        return _number(row.ours, row.unit)
    return f"{_number(row.ours, row.unit)} ({_number(row.low, row.unit)} - {_number(row.high, row.unit)})"


def _number(value: float, unit: str) -> str:
    places = {"of W": 4, "R": 3}.get(unit, 2)
    return f"{round(value, places) + 0.0:.{places}f}"


if __name__ == "__main__":
    sys.exit(main())
