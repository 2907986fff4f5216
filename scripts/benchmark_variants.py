"""Compares variants of the planner: each walks the same fields, with the same noise, and every trial is a row.

    python scripts/benchmark_variants.py --variants integrated blind --suite small --out results/small
    python scripts/benchmark_variants.py --variants mine.toml integrated --robots sdm_b --scenarios rock_field --seeds 0:20 --delays 0 5 \
        --out results/mine

Writes `results.jsonl` (one trial a line), a folder for each trial below `trials/`, and `report.html`. Killed at any moment or
stopped by Ctrl-C, the same command goes on where it was. A trial that cannot be run is a row too, with its reason. Cases are run in
an order in which any first part is a fair sample of the whole: `--hours 2` runs as many as that leaves time for, and the same command
later goes on from there. Exit status 0 when every trial has its row, or every case that was begun when time was up; 2 and one line for bad
usage, 130 when it was interrupted.
"""

from __future__ import annotations

import importlib
import importlib.util
import math
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal

import tyro

from athlete_twin.errors import AthleteError, ConfigError

DELAYS = (5.0,)
SUITE_HELP = "small, full, or a path ending in .toml; in place of scenarios, seeds and delays"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Runs every variant on every case, and reports."""

    variants: tuple[str, ...]
    """names, paths ending in .toml, or planners of your own as module:factory"""
    suite: Annotated[str | None, tyro.conf.arg(help=SUITE_HELP)] = None
    robots: tuple[str, ...] = ()
    """sdm_b, t12; both when not given, or those of the suite"""
    scenarios: tuple[str, ...] = ()
    """names, or paths ending in .toml"""
    seeds: str | None = None
    """such as 0:20 (0 to 19) or 3,5,8"""
    delays: tuple[float, ...] = ()
    """one way [s]; 5 when not given"""
    cycles: int | None = None
    """a trial ends after so many gait cycles; the scenario's own when not given"""
    time_limit: float | None = None
    """mission time [s]; the scenario's own when not given"""
    hours: float | None = None
    """after which no other case is begun; those that were are walked by all variants, and reported; all cases when not given"""
    workers: int | None = None
    """trials at once; as many as there are cores when not given"""
    ray: str | None = None
    """run on the Ray cluster at this address; "auto" for the one this machine is of, "local" to start one here"""
    out: Path
    """folder for the results"""
    metrics: tuple[str, ...] = ()
    """figures that the report compares; its own choice when not given"""
    baseline: str | None = None
    """variant that the report holds all others against; the one that this folder was first asked for when not given"""
    films: bool = True
    """film the best, median and worst trial of each robot with each variant"""
    keep: Literal["all", "filmed", "none"] = "all"
    """whose recordings (trial.mcap) stay, 15 MB a gait cycle of SDM-B and 27 of T12; a trial without one cannot be replayed or filmed"""
    retry_errors: bool = False
    """run again what could not be run before"""
    dry_run: bool = False
    """only list the cases and guess how long they take"""
    body: Literal["twin", "mock"] = "twin"
    """mock: no physics and flat ground, to try the machinery in seconds"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        with _stopped_by_sigterm():
            _compare(options)
    except AthleteError as e:
        sys.stderr.write(f"benchmark_variants: {' '.join(str(e).split())}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write(f"benchmark_variants: interrupted; what is done stays in {options.out}, the same command goes on from there\n")
        return 130
    return 0


def _compare(options: Options) -> None:
    from rich.console import Console
    from run_progress import Bar
    from variant_runs import asked_for, run_all

    from envs.suite_trial import RECORDING

    suite = chosen_suite(options)
    cases = suite.of_robots(options.robots)
    check_variants(options.variants)
    check_caps(options.variants, suite.name, cases)
    _check_metrics(options.metrics)
    check_baseline(options.baseline, options.variants, options.out)
    check_workers(options.workers, cluster=options.ray is not None)
    check_hours(options.hours)
    asked = asked_for(suite, cases, options.variants, body=options.body)
    if options.dry_run:
        _show_plan(suite, asked, workers=options.workers, hours=options.hours)
        return
    # Where none is filmed, no recording need stay till the end.
    unwanted = (RECORDING,) if options.keep == "none" and not options.films else ()
    seconds = math.inf if options.hours is None else 3600.0 * options.hours
    if not unwanted:
        check_room(asked if options.hours is None else _fitting(asked, seconds, options.workers), options.out)
    with Bar(Console(stderr=True), seconds=seconds) as bar:
        rows = run_all(
            asked, options.out, crew=_crew(options), onlooker=bar, retry_errors=options.retry_errors, unwanted=unwanted,
            seconds=seconds,
        )  # fmt: skip
    _after(options, rows, wanted=len(asked))


def chosen_suite(options: Options) -> Any:
    """The suite that was named, or that the options make up."""
    from athlete_twin.assets import robot_names
    from envs.suite import load_suite, seeds_of, suite_of

    own: dict[str, object] = {"scenarios": options.scenarios, "seeds": options.seeds, "delays": options.delays}
    own |= {"cycles": options.cycles, "time_limit": options.time_limit}
    given = [f"--{name.replace('_', '-')}" for name, value in own.items() if value not in (None, ())]
    if options.suite is not None:
        if given:
            raise ConfigError(f"suite {options.suite} says itself what {', '.join(given)} would; leave out one or the other")
        return load_suite(options.suite)
    if not options.scenarios or options.seeds is None:
        raise ConfigError("nothing to run on: name --suite small or --suite full, or --scenarios and --seeds")
    return suite_of(
        robots=options.robots or robot_names(), scenarios=options.scenarios, seeds=seeds_of(options.seeds),
        delays=options.delays or DELAYS, cycles=options.cycles, time_limit=options.time_limit,
    )  # fmt: skip


def check_variants(variants: Sequence[str]) -> None:
    """Refuses what is no variant, or stands there twice."""
    from envs.build import check_variant

    twice = [name for name, n in Counter(variants).items() if n > 1]
    if twice:
        raise ConfigError(f"variant {', '.join(twice)} is there twice; name each once")
    for variant in variants:
        check_variant(variant)


def check_caps(variants: Sequence[str], suite: str, cases: Sequence[Any]) -> None:
    """Refuses variants that a limit of gait cycles would not stop where it stops others: they would be compared as pairs all the same."""
    from envs.variants import OutsidePlanner, variant_named

    capped = next((case for case in cases if case.capped), None)
    if capped is None:
        return
    for name in variants:
        found = variant_named(name)
        if isinstance(found, OutsidePlanner):
            why = "a planner from outside need propose no steps"
        else:
            why = "a planner that drives takes no steps meanwhile" if found.content.get("driving") == "on" else ""
        if why:
            raise ConfigError(
                f"variant {name} cannot be compared where trials end after {capped.cycles} gait cycles ({capped.id} of suite {suite}): "
                f"{why}; take --suite full, or --scenarios and --seeds without --cycles"
            )


def check_workers(workers: int | None, *, cluster: bool) -> None:
    """Refuses a number of workers that cannot be."""
    from trial_crews import local_cores

    most = local_cores()
    if workers is not None and (workers < 1 or (workers > most and not cluster)):
        limit = "1 or more" if cluster else f"1 to {most}, as this machine has {most} cores; --ray takes it to others"
        raise ConfigError(f"workers is {workers}, must be {limit}")


def check_hours(hours: float | None) -> None:
    """Refuses a time in which nothing can be run."""
    if hours is not None and not 0.0 < hours < math.inf:
        raise ConfigError(f"hours is {hours:g}, must be positive and finite; leave it out to run every case")


def check_room(asked: Sequence[Any], out: Path) -> None:
    """Refuses a disk that the recordings would fill: every trial after that would be one that could not be run."""
    from run_progress import megabytes
    from variant_runs import TRIALS

    from envs.suite_trial import TRIAL

    needed = sum(megabytes(one) for one in asked if not (out / TRIALS / one.folder / TRIAL).is_file()) / 1000
    disk = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
    free = shutil.disk_usage(disk).free / 1e9
    if needed > free:
        raise ConfigError(
            f"the recordings would take roughly {needed:.0f} GB, and {out} has {free:.0f} GB left; another --out, or without "
            "recordings by --keep none --no-films"
        )


def check_baseline(baseline: str | None, variants: Sequence[str], out: Path) -> None:
    """Refuses a baseline that is neither run now nor was run into the folder before."""
    from variant_runs import RESULTS, read_rows

    there = dict.fromkeys([*variants, *(row["variant"] for row in read_rows(out / RESULTS)[0])])
    if baseline is not None and baseline not in there:
        raise ConfigError(f"baseline {baseline!r} is not among the variants: {', '.join(there)}")


def _check_metrics(metrics: Sequence[str]) -> None:
    if not metrics:
        return
    if importlib.util.find_spec("variant_metrics") is None:
        raise ConfigError("--metrics needs scripts/variant_metrics.py beside this script")
    importlib.import_module("variant_metrics").metrics_named(metrics)


def _crew(options: Options) -> Any:
    from trial_crews import LocalCrew, RayCrew, local_cores

    return LocalCrew(options.workers or local_cores()) if options.ray is None else RayCrew(options.ray, options.workers)


def _fitting(asked: Sequence[Any], seconds: float, workers: int | None) -> Sequence[Any]:
    from run_progress import fitting
    from trial_crews import local_cores

    return asked[: fitting(asked, seconds, workers=workers or local_cores())]


def _show_plan(suite: Any, asked: Sequence[Any], *, workers: int | None, hours: float | None) -> None:
    from run_progress import TimeLeft, duration, megabytes
    from trial_crews import local_cores

    cases = list(dict.fromkeys(one.case.id for one in asked))
    variants = list(dict.fromkeys(one.variant for one in asked))
    n = workers or local_cores()
    left = TimeLeft(workers=n).left(asked, [])
    lines = [f"suite {suite.name}, sha256 {suite.sha256}", *([suite.description] if suite.description else []), *cases]
    lines.append(f"{len(cases)} cases x {len(variants)} variants ({', '.join(variants)}) = {len(asked)} trials")
    lines.append(f"roughly {duration(left)} with {n} workers; {sum(map(megabytes, asked)) / 1000:.1f} GB of recordings with --keep all")
    if hours is not None:
        fit = _fitting(asked, 3600.0 * hours, workers)
        lines.append(f"in {hours:g} h roughly the first {len(fit)} of them, {sum(map(megabytes, fit)) / 1000:.1f} GB")
    sys.stdout.write("\n".join(lines) + "\n")


def _after(options: Options, rows: Sequence[dict[str, Any]], *, wanted: int) -> None:
    from comparison_films import drop_recordings, film

    filmed = film(options.out, rows, workers=options.workers) if options.films else []
    drop_recordings(options.out, rows, keep=options.keep, filmed=filmed)
    errors = [row for row in rows if row["outcome"] == "error"]
    sys.stdout.write(f"{len(rows)} trials, {len(errors)} of which could not be run, in {options.out / 'results.jsonl'}\n")
    if len(rows) < wanted:
        sys.stdout.write(f"time was up: {wanted - len(rows)} of {wanted} trials were not begun; the same command goes on with them\n")
    for row in errors[:5]:
        sys.stdout.write(f"  {row['case']} {row['variant']}: {row['reason']}\n")
    if importlib.util.find_spec("variant_report") is not None:
        write_report = importlib.import_module("variant_report").write_report
        path = write_report(options.out, metrics=options.metrics or None, baseline=options.baseline)
        sys.stdout.write(f"report: {path}\n")


@contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """SIGTERM is Ctrl-C meanwhile."""

    def interrupt(_signal: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


if __name__ == "__main__":
    sys.exit(main())
