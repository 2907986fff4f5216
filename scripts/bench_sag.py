"""How well the ground foresees sag: constants found from measured corner heights, held against stances not measured before.

    python scripts/bench_sag.py [--robots sdm_b t12] [--individuals 4] [--stances 15] [--parts sag pose speed] [--out DIR] [--json]

Each individual of a robot has its own tyres, masses and encoder zeros. It stands on level concrete, is commanded over a link
of 2 s into ten known stances and some random ones, and its chassis corners and axles are read with a distance meter of 3 mm
(one sigma). From the known stances come the constants; the random ones judge them. Beside it each leg is lifted slowly from
the regular stance, to see what three ways of sag compensation foresee of it. `pose` lifts each leg with and without pose
optimisation; `speed` times the solver beside scipy's. What a robot refuses is a row that says "no" and why. Measuring costs about
4 s a stance for SDM-B and 6 s for T12, on each of two processes: a quarter of an hour in all.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import sag_figures
import sag_pictures
import sag_pose
import sag_speed
import tyro
from bench_table import Row, refusal, show
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from sag_stances import Unmeasured, measure

from athlete_twin.errors import AthleteError, SagError
from athlete_twin.model.spec import load_spec

PARTS = ("sag", "pose", "speed")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures and prints the rows of each part, and draws predicted against measured heights."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    individuals: int = 4
    """seeds from `first_seed` on, of each robot"""
    stances: int = 15
    """random ones of each individual"""
    first_seed: int = 0
    parts: tuple[str, ...] = PARTS
    """any of sag, pose and speed"""
    out: Path | None = None
    """folder for pictures; none are drawn without it"""
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    unknown = [p for p in options.parts if p not in PARTS]
    wrong = ""
    if unknown:
        wrong = f"part {unknown[0]!r} is not one of {', '.join(PARTS)}"
    elif min(options.individuals, options.stances) < 1 or options.first_seed < 0:
        wrong = "--individuals and --stances must be at least 1, --first-seed at least 0"
    if wrong:
        sys.stderr.write(f"bench_sag: {wrong}\n")
        return 2
    try:
        for robot in options.robots:
            load_spec(robot)
    except AthleteError as e:
        sys.stderr.write(f"bench_sag: {' '.join(str(e).split())}\n")
        return 2
    rows: list[Row] = []
    if "sag" in options.parts:
        rows += _sag(options)
    if "pose" in options.parts:
        with _progress() as progress:
            task = progress.add_task("pose before a lift", total=len(options.robots))
            for robot in options.robots:
                rows += sag_pose.rows(robots=(robot,), seed=options.first_seed)
                progress.advance(task)
    if "speed" in options.parts:
        rows += sag_speed.rows(robots=options.robots)
    show(rows, as_json=options.json)
    return 0


def _sag(options: Options) -> list[Row]:
    """Rows of all individuals that could be calibrated, and one that says why of each that could not."""
    seeds = range(options.first_seed, options.first_seed + options.individuals)
    jobs = [(robot, seed, options.stances) for robot in options.robots for seed in seeds]
    found, refused = [], []
    with _progress() as progress:
        task = progress.add_task("individuals measured", total=len(jobs))
        for individual in measure(jobs):
            name = f"{individual.robot}, individual {individual.seed}"
            if isinstance(individual, Unmeasured):
                refused.append(refusal(f"{name}: calibrated", individual.reason))
            else:
                refused += [refusal(f"{name}: lifted slowly", why) for why in individual.unlifted]
                try:
                    found.append(sag_figures.calibrated(individual))
                except SagError as e:
                    refused.append(refusal(f"{name}: springs found", str(e)))
                else:
                    if options.out is not None and individual.seed == options.first_seed:
                        sag_pictures.draw(found[-1], options.out / f"sag_{individual.robot}.png")
            progress.advance(task)
    return sag_figures.rows(found) + refused


def _progress() -> Progress:
    columns = (TextColumn("{task.description:28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, console=Console(stderr=True), transient=True)


if __name__ == "__main__":
    sys.exit(main())
