"""One trial: a robot walks to a goal it is told of, around rocks it knows from its own pictures, over a delayed link.

    python scripts/rock_field_trial.py --robot sdm_b --scenario rock_field --delay 5 --out results/rock_field

Writes `trial.json`, `trial.mcap`, `report.html` and, with `--film`, `film.webm` into the output folder. Exit status 0 when
the trial ran to an outcome, whatever it was; 2 and one line for bad usage. Ctrl-C ends the trial with the outcome
`operator_abort` and leaves readable files.
"""

from __future__ import annotations

import importlib
import importlib.util
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from athlete_twin.errors import AthleteError

if TYPE_CHECKING:
    from envs.trial import Trial, TrialResult, TrialState
    from planner.decisions import Operator

TIME_LIMIT_HELP = "mission time after which the trial ends [s]; the scenario's own when not given"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Runs one trial and writes what happened."""

    robot: str = "sdm_b"
    """sdm_b or t12"""
    scenario: str = "rock_field"
    """name of a scenario, or a path ending in .toml"""
    variant: str = "integrated"
    """name of a planner variant, or a path ending in .toml"""
    seed: int = 0
    """of terrain, robot and noise"""
    delay: float = 5.0
    """one way, on each link [s]"""
    operator: str = "approve_all"
    """approve_all; cautious (rejects what comes near a limit); slow; distracted (late and sometimes wrong); human (asks here)"""
    cycles: int | None = None
    """the trial ends after so many gait cycles; the scenario's own when not given"""
    time_limit: Annotated[float | None, tyro.conf.arg(help=TIME_LIMIT_HELP)] = None
    payload_kg: float = 0.0
    """on the deck [kg]"""
    out: Path = Path("results/trial")
    """folder for the results"""
    film: bool = False
    """also film the walk from outside"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        trial = prepared(options)
        result = run(trial)
        reports(options)
    except AthleteError as e:
        sys.stderr.write(f"rock_field_trial: {' '.join(str(e).split())}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("rock_field_trial: interrupted\n")
        return 130
    _show(result, options.out)
    return 0


def prepared(options: Options) -> Trial:
    """The trial that the options name; everything that can be refused is refused here."""
    from athlete_twin.link import downlink, uplink
    from envs.prepare import Wanted
    from envs.prepare import prepared as put_together

    wanted = Wanted(
        robot=options.robot,
        scenario=options.scenario,
        variant=options.variant,
        seed=options.seed,
        operator=options.operator,
        up=uplink(options.delay),
        down=downlink(options.delay),
        cycles=options.cycles,
        time_limit=options.time_limit,
        payload_kg=options.payload_kg,
    )
    return put_together(wanted, options.out, operator=_person(options))


def run(trial: Trial) -> TrialResult:
    """Runs the trial with its progress on the terminal. SIGTERM and Ctrl-C end it, its files whole; asked twice, at once."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        # An exception may come out of compiled code as another one: only where a person is awaited, or for the second time.
        if trial.interrupted or trial.setup.operator == "human":
            raise KeyboardInterrupt
        trial.interrupted = True

    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    for number, handler in before.items():
        # What starts a job in the background has it ignore Ctrl-C; that stays so.
        if handler is not signal.SIG_IGN:
            signal.signal(number, interrupt)
    try:
        # A line that renews itself would write over what a person types.
        with _progress(renewed=trial.setup.operator != "human") as trial.progress:
            return trial.run()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        trial.robot.close()


def reports(options: Options) -> None:
    """Report and film, by the scripts beside this one."""
    wanted = [("trial_report", "write_report")] + ([("trial_film", "write_film")] if options.film else [])
    for module, function in wanted:
        if importlib.util.find_spec(module) is not None:
            getattr(importlib.import_module(module), function)(options.out)


def _person(options: Options) -> Operator | None:
    """Who is asked in the terminal; None where a script answers."""
    if options.operator != "human":
        return None
    from terminal_operator import TerminalOperator

    return TerminalOperator(robot=options.robot, out=options.out)


@contextmanager
def _progress(*, renewed: bool) -> Iterator[Any]:
    """Distance, steps, mission time and what is awaited: a line a step, and one that renews itself if wanted."""
    from rich.console import Console

    console = Console(stderr=True)
    shown = {"steps": -1}
    with console.status("starting") if renewed else nullcontext() as status:

        def report(state: TrialState) -> None:
            mission, scorer = state.mission, state.scorer
            line = (
                f"{scorer.goal_distance(state.truth):5.2f} m to go  {scorer.steps_taken:3d} steps  "
                f"{mission.t:7.0f} s  {mission.counts.faults} faults  awaits: {_awaited(state)}"
            )
            if status is not None:
                status.update(line)
            if scorer.steps_taken != shown["steps"]:
                shown["steps"] = scorer.steps_taken
                console.print(line, soft_wrap=True, highlight=False)

        yield report


def _awaited(state: TrialState) -> str:
    if state.mission.wants_answer:
        return "the operator"
    return "the robot moves" if state.mission.robot.busy else state.mission.waiting_for or "the link"


def _show(result: TrialResult, out: Path) -> None:
    from rich.console import Console

    Console().print(
        f"[bold]{result.outcome}[/bold]: {result.reason}\n"
        f"progress {result.progress_m:.2f} m, {result.goal_distance_m:.2f} m from the goal, {result.steps_taken} steps, "
        f"{result.collisions} collisions, {result.faults} faults\n"
        f"mission {result.mission_time_s:.0f} s = motion {result.motion_s:.0f} + link {result.link_s:.0f} + operator "
        f"{result.operator_s:.0f} + ground {result.ground_s:.0f}; {result.wall_time_s:.0f} s of wall time\n"
        f"written to {out}"
    )


if __name__ == "__main__":
    sys.exit(main())
