"""Every leg planner on the frozen set of leg problems: success, time, length before and after smoothing, torque.

    python scripts/bench_motion.py [--planners sbl rrtconnect bkpiece lbkpiece bitstar] [--robots sdm_b t12] [--problems N]
                                   [--no-torque] [--log FILE] [--json]

500 problems in `assets/leg_problems.npz`, whose hash is checked first: both robots, from free ground to a rock beside the leg,
each solved by OMPL's RRTConnect when the set was made. All planners have the same budget of state checks and check edges to
0.01 rad; finished paths are looked at again every 0.002 rad, with their corners cut as the executive cuts them. SBL's paths are
timed too, beside pieces at constant speed (velocities jump) and toppra on the same path.

`--problems` takes so many of each robot, evenly from the set. `--log` writes OMPL's benchmark log too, for
`ompl_benchmark_statistics`. All of it takes about half an hour on one core.
"""

from __future__ import annotations

import platform
import sys
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import motion_figures
import tyro
from bench_table import show
from leg_problems import ROBOTS, load_problems
from ompl_log import write_ompl_log
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from athlete_twin.errors import AthleteError
from planner.motion.planners import METHODS

COMPARED = ("sbl", "rrtconnect", "bkpiece", "lbkpiece", "bitstar")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Runs the planners and prints their rows."""

    planners: tuple[str, ...] = COMPARED
    robots: tuple[str, ...] = ROBOTS
    problems: int = 250
    """of each robot"""
    torque: bool = True
    """relieve SBL's paths of joint torque too, which takes longest of all"""
    seed: int = 0
    log: Path | None = None
    """OMPL's benchmark log; none is written without it"""
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        wrong = _wrong(options)
        if wrong:
            raise AthleteError(wrong)
        chosen = []
        for robot in options.robots:
            own = [p for p in load_problems() if p.robot == robot]
            count = min(options.problems, len(own))
            chosen += [own[k * len(own) // count] for k in range(count)]
    except AthleteError as e:
        sys.stderr.write(f"bench_motion: {' '.join(str(e).split())}\n")
        return 2
    when, start = datetime.now(UTC), time.perf_counter()
    columns = (TextColumn("{task.description:12}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=len(chosen) * len(options.planners))

        def told(method: str) -> None:
            progress.update(task, advance=1, description=method)

        runs = motion_figures.measure(chosen, options.planners, seed=options.seed, torque=options.torque, told=told)
    if options.log is not None:
        write_ompl_log(
            options.log, runs, experiment="leg_problems", setup=f"{len(chosen)} problems of {', '.join(options.robots)}",
            host=platform.machine(), seed=options.seed, seconds=time.perf_counter() - start, when=when,
        )  # fmt: skip
    show(motion_figures.rows(runs, chosen), as_json=options.json)
    return 0


def _wrong(options: Options) -> str:
    for what, given, known in (("planner", options.planners, METHODS), ("robot", options.robots, ROBOTS)):
        for name in given:
            if name not in known:
                return f"{what} {name!r} is not known; known: {', '.join(known)}"
        if not given:
            return f"no {what} is named; known: {', '.join(known)}"
    if options.problems < 1 or options.seed < 0:
        return f"--problems {options.problems}, --seed {options.seed}: need 1 or more, and 0 or more"
    return ""


if __name__ == "__main__":
    sys.exit(main())
