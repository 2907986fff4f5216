"""Recorded trials run once more, and walked through by the robot's clock or the operator's.

    python scripts/replay_trial.py results/trial/trial.mcap                     # runs it again: does everything come again?
    python scripts/replay_trial.py a.mcap b.mcap c.mcap                         # and several: 3 of 3 equal
    python scripts/replay_trial.py trial.mcap --no-rerun --walk --clock operator --begin 60 --end 120
    python scripts/replay_trial.py trial.mcap --no-rerun --table walk.parquet --figures pictures --film film.webm

A rerun compares every message of the recording, bytes and times, and the hashes of the true motion and of what crossed the link.
A recording that was cut by a kill is compared as far as it goes. By the robot's clock (--clock robot) a row stands where it was
true; by the operator's, where it was known: what lies between is the delay. Exit status 0: all equal, or nothing was run; 1:
something differs, and the first difference is told with topic and time, or a recording holds no message to compare; 2 and one
line: bad usage, no such file, a damaged one, or one whose libraries, drawings or meshes are not those of today (--anyway runs it
nevertheless).
"""

from __future__ import annotations

import csv
import importlib
import importlib.util
import json
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from athlete_twin.errors import AthleteError, ConfigError, RecordingError

if TYPE_CHECKING:
    from envs.events import Clock, Event
    from envs.origin import Origin
    from envs.rerun import Rerun

FIRST_COLUMNS = ("t_s", "topic", "at_robot_s", "at_operator_s", "age_s", "text")
"""of a table, before the figures"""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Runs recorded trials again, walks through one, exports it."""

    files: tyro.conf.Positional[tuple[Path, ...]]
    """recordings, such as results/trial/trial.mcap"""
    rerun: bool = True
    """run the trial again and compare"""
    anyway: bool = False
    """run it even where libraries, drawings or meshes have changed since"""
    keep: Path | None = None
    """folder that keeps the files of the rerun; forgotten when not given"""
    clock: Literal["robot", "operator"] = "robot"
    """by which walk, table and figures are told: when it was true, or when it was known"""
    walk: bool = False
    """print what happened, a line an event"""
    begin: float = 0.0
    """of walk and table, by the clock [s]"""
    end: float = float("inf")
    """of walk and table, by the clock [s]"""
    table: Path | None = None
    """write the events as a table: .csv, or .parquet where pyarrow is installed"""
    figures: Path | None = None
    """folder for PNG pictures: what was true against what was known, and what crossed the link"""
    film: Path | None = None
    """write the walk as seen from outside, by the robot's clock: .webm"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        _check(options)
        equal = [_again(path, options) for path in options.files] if options.rerun else []
        for path in options.files:
            exported(path, options)
    except AthleteError as e:
        sys.stderr.write(f"replay_trial: {' '.join(str(e).split())}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("replay_trial: interrupted\n")
        return 130
    if options.rerun:
        sys.stdout.write(f"{sum(equal)} of {len(equal)} equal\n")
    return 0 if all(equal) else 1


def exported(path: Path, options: Options) -> None:
    """What is to be made of a recording without running it."""
    from envs.events import by_clock, events

    if options.walk or options.table or options.figures:
        every = events(path)
        placed = by_clock(every, options.clock, begin=options.begin, end=options.end)
        if options.walk:
            sys.stdout.writelines(f"{line}\n" for line in walked(placed, options.clock))
        if options.table is not None:
            write_table(options.table, placed, options.clock)
            sys.stdout.write(f"written: {options.table}, {len(placed)} rows\n")
        if options.figures is not None:
            _figures(path, every, options)
    if options.film is not None:
        _film(path, options.film)
        sys.stdout.write(f"written: {options.film}\n")


def walked(placed: list[Event], clock: Clock) -> Iterator[str]:
    """A line an event: when, how old it is, where, what."""
    for event in placed:
        # Motion is sampled twice a second, and joints say nothing in a line.
        if event.topic == "/truth/joints":
            continue
        # News is old where it arrives, and yet to be known where it leaves.
        arrives = event.topic.startswith("/downlink/") == (clock == "operator")
        age = f"{event.age:.2f} s {'old' if arrives else 'before'}" if event.age == event.age else ""
        yield f"{event.t(clock):10.3f} s  {age:>14}  {event.topic:26}  {event.text}"


def write_table(path: Path, placed: list[Event], clock: Clock) -> None:
    """Events as rows, with a column for every figure that any of them has; empty where one has none."""
    columns = list(FIRST_COLUMNS) + sorted({name for event in placed for name in event.figures})
    rows: list[dict[str, Any]] = [
        {
            "t_s": event.t(clock),
            "topic": event.topic,
            "at_robot_s": _there(event.at_robot),
            "at_operator_s": _there(event.at_operator),
            "age_s": _there(event.age),
            "text": event.text,
        }
        | {name: _there(value) for name, value in event.figures.items()}
        for event in placed
    ]
    try:
        if path.suffix == ".csv":
            with path.open("w", newline="") as file:
                writer = csv.DictWriter(file, columns, restval="")
                writer.writeheader()
                writer.writerows(rows)
        else:
            pyarrow, parquet = (importlib.import_module(name) for name in ("pyarrow", "pyarrow.parquet"))
            parquet.write_table(pyarrow.table({c: [row.get(c) for row in rows] for c in columns}), path)
    except OSError as e:
        raise ConfigError(f"{path}: cannot be written: {e.strerror}; a folder you may write to would have worked") from e


def _there(value: float | str) -> float | str | None:
    """None for a figure that is not there."""
    return None if value != value else value


def _check(options: Options) -> None:
    if not options.files:
        raise ConfigError("no recording is named; a path such as results/trial/trial.mcap would have worked")
    for path in options.files:
        if not path.is_file():
            raise ConfigError(f"{path}: no such recording")
    one = {"--table": options.table, "--figures": options.figures, "--film": options.film, "--keep": options.keep}
    given = [name for name, value in one.items() if value is not None]
    if given and len(options.files) > 1:
        raise ConfigError(f"{given[0]} takes one recording, not {len(options.files)}")
    if options.table is not None and options.table.suffix not in (".csv", ".parquet"):
        raise ConfigError(f"--table {options.table}: .csv or .parquet would have worked")
    if options.table is not None and options.table.suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise ConfigError(f"--table {options.table} needs pyarrow: `pip install -e .[tables]`; a path ending in .csv needs nothing")
    if options.film is not None and options.film.suffix != ".webm":
        raise ConfigError(f"--film {options.film}: a path ending in .webm would have worked")
    if not options.begin <= options.end:
        raise ConfigError(f"--begin {options.begin} s is after --end {options.end} s")


def _again(path: Path, options: Options) -> bool:
    """Run one recording again and tell what came of it; whether everything came again."""
    from rich.console import Console

    from envs.origin import changed_since, recorded_origin
    from envs.prepare import scenario_again
    from envs.rerun import rerun

    origin = recorded_origin(path)
    firm, loose = changed_since(origin, map_file=scenario_again(origin).file)
    if firm and not options.anyway:
        raise RecordingError(f"{path}: not as it was: {'; '.join(firm)}; --anyway runs it nevertheless")
    for line in (*firm, *loose):
        sys.stderr.write(f"replay_trial: {path}: {line}\n")
    with _folder(options.keep) as out, Console(stderr=True).status("running it again") as status:
        done = rerun(path, origin, out, progress=lambda t: status.update(f"{path}: {t:.0f} s of mission time"))
    sys.stdout.write(f"{_told(path, origin, done)}\n")
    return done.equal


def _told(path: Path, origin: Origin, done: Rerun) -> str:
    name = f"{path}: {origin.setup.robot}, {origin.setup.scenario}, {origin.setup.variant}, seed {origin.setup.seed}"
    if done.difference is not None:
        d = done.difference
        return f"{name}: DIFFERENT, first at {d.t:.3f} s on {d.topic}: {d.text}"
    if not done.messages:
        return f"{name}: NOTHING COMPARED: the recording was cut before its first message"
    if not done.equal:
        return f"{name}: DIFFERENT: the messages are the same, the hashes are not: {done.then}, now {done.now}"
    if not done.ending.natural:
        cut = "interrupted" if done.ending.outcome else "cut off"
        return f"{name}: equal as far as it goes, {cut} at {done.ending.t:.1f} s: {done.messages} messages"
    hashes = f"trajectory {done.now['trajectory_sha256'][:12]}, link {done.now['link_sha256'][:12]}"
    return f"{name}: equal: {done.messages} messages, {done.ending.outcome}, {hashes}"


@contextmanager
def _folder(keep: Path | None) -> Iterator[Path]:
    if keep is not None:
        yield keep
        return
    with tempfile.TemporaryDirectory(prefix="replay_trial_") as name:
        yield Path(name)


def _figures(path: Path, every: list[Event], options: Options) -> None:
    from replay_figures import clock_figure, link_figure, report_figures

    from envs.trial import usable_folder

    if options.figures is None:
        return
    folder = usable_folder(options.figures)
    pictures = {f"{options.clock}_clock.png": clock_figure(every, options.clock), "link.png": link_figure(every)}
    if path.name == "trial.mcap" and (path.parent / "trial.json").is_file():
        pictures |= report_figures(path.parent)
    for name, picture in pictures.items():
        (folder / name).write_bytes(picture)
        sys.stdout.write(f"written: {folder / name}\n")


def _film(path: Path, film: Path) -> None:
    from trial_film import write_film
    from trial_recording import load_figures

    with tempfile.TemporaryDirectory(prefix="replay_trial_") as name:
        folder = Path(name)
        (folder / "trial.mcap").symlink_to(path.resolve())
        beside = (path.parent / "trial.json").is_file()
        figures = load_figures(path.parent) if beside else _figures_of_cut(path)
        (folder / "trial.json").write_text(json.dumps(figures))
        made = write_film(folder)
        try:
            shutil.copyfile(made, film)
        except OSError as e:
            raise ConfigError(f"{film}: cannot be written: {e.strerror}; a folder you may write to would have worked") from e


def _figures_of_cut(path: Path) -> dict[str, Any]:
    """What a film says of a trial that left no trial.json: it was killed."""
    from envs.events import events
    from envs.origin import recorded_origin
    from envs.rerun import ending_of

    setup = recorded_origin(path).setup
    distances = [float(e.figures["goal_distance_m"]) for e in events(path) if "goal_distance_m" in e.figures]
    return {
        "robot": setup.robot,
        "scenario": setup.scenario,
        "variant": setup.variant,
        "seed": setup.seed,
        "link": {"delay_s": setup.down.delay},
        "outcome": ending_of(path).outcome or "cut_off",
        "progress_m": distances[0] - distances[-1] if distances else 0.0,
        "steps_taken": 0,
    }


if __name__ == "__main__":
    sys.exit(main())
