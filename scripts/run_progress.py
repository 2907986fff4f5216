"""How far a comparison is and how long it still takes, from what its trials took so far."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from statistics import mean
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from athlete_twin.world.scenario import load_scenario
from envs.suite_trial import Asked

SECONDS_A_CYCLE = {"sdm_b": 40.0, "t12": 60.0}
"""of processor time in `suite_k015`, for a guess before anything was measured"""
MEGABYTES_A_CYCLE = {"sdm_b": 15.0, "t12": 27.0}
"""of recording, in the same trials"""
METRES_A_CYCLE = {"sdm_b": 0.6, "t12": 1.4}
"""walked, in the same trials"""
START = 8.0
"""of a process, its libraries and its first pictures [s]"""

LINES_APART = 60.0
"""least time between two plain lines, and before the first [s]"""


class TimeLeft:
    """Seconds that trials take, learnt from those that ended: of the same robot and variant if there are any, else of the robot."""

    def __init__(self, *, workers: int) -> None:
        self.workers = workers
        self._took: dict[tuple[str, str], list[float]] = {}
        self._means: dict[tuple[str, str], float | None] = {}
        """of what was learnt, until another trial ends: asked for every trial of a suite, several times a second"""

    def took(self, asked: Asked, seconds: float | None) -> None:
        """A trial ended after so long; None where that was not measured."""
        if seconds is not None:
            self._took.setdefault((asked.case.robot, asked.variant), []).append(seconds)
            self._means.clear()

    def of_trial(self, asked: Asked) -> float:
        """How long a trial takes [s]."""
        key = (asked.case.robot, asked.variant)
        if key not in self._means:
            same_robot = [s for (robot, _), seconds in self._took.items() for s in seconds if robot == asked.case.robot]
            learnt = self._took.get(key) or same_robot
            self._means[key] = mean(learnt) if learnt else None
        seconds = self._means[key]
        return guess(asked) if seconds is None else seconds

    def left(self, todo: Iterable[Asked], running: Iterable[tuple[Asked, float]]) -> float:
        """How long all of it still takes, with the trials that have run for so long [s]."""
        rest = [self.of_trial(asked) for asked in todo]
        rest += [max(self.of_trial(asked) - seconds, 0.0) for asked, seconds in running]
        # No less than the longest of them, and no less than an even share.
        return max(max(rest, default=0.0), sum(rest) / self.workers)


def fitting(asked: Sequence[Asked], seconds: float, *, workers: int) -> int:
    """How many of the trials, in their order and whole cases only, are begun in so much time, by the guess."""
    spent = 0.0
    for i, one in enumerate(asked):
        if spent >= workers * seconds and one.case.id != asked[i - 1].case.id:
            return i
        spent += guess(one)
    return len(asked)


def guess(asked: Asked) -> float:
    """How long a trial takes before any was measured, roughly [s]."""
    if asked.body == "mock":
        return START
    return START + _cycles(asked) * _of_robot(SECONDS_A_CYCLE, asked)


def megabytes(asked: Asked) -> float:
    """Size of a trial's recording, roughly [MB]."""
    return 1.0 if asked.body == "mock" else _cycles(asked) * _of_robot(MEGABYTES_A_CYCLE, asked)


class Bar:
    """Trials done, trials that could not be run and time left: a bar on a terminal; elsewhere a plain line, a minute or more apart."""

    def __init__(self, console: Console, *, seconds: float = math.inf, clock: Callable[[], float] = time.monotonic) -> None:
        """On a console; after so many seconds no other case is begun."""
        self._clock, self._until = clock, clock() + seconds
        self._shown = Progress(
            TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[errors]} errors"), TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"), console=console, disable=not console.is_terminal, transient=True,
        )  # fmt: skip
        self._console = console
        self._told = clock()
        self._task = self._shown.add_task("trials", total=None, errors=0, left="")
        self._errors = 0

    def __enter__(self) -> Bar:
        self._shown.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self._shown.stop()

    def begins(self, asked: Sequence[Asked], rows: Sequence[dict[str, Any]], *, workers: int) -> None:
        """All that was asked, and the rows that are there already."""
        self.time_left = TimeLeft(workers=workers)
        self._todo = {a.key: a for a in asked}
        self._since: dict[tuple[str, str], tuple[Asked, float]] = {}
        for row in rows:
            self._counted(self._todo.pop((row["case"], row["variant"])), row)
        self._total = len(asked)
        self._shown.update(self._task, total=self._total, completed=len(rows))
        self.waits()

    def started(self, asked: Asked) -> None:
        """A trial began."""
        del self._todo[asked.key]
        self._since[asked.key] = (asked, self._clock())

    def row(self, asked: Asked, row: dict[str, Any]) -> None:
        """A trial ended."""
        del self._since[asked.key]
        self._counted(asked, row)
        self._shown.advance(self._task)
        self.waits()
        now = self._clock()
        if not self._console.is_terminal and now - self._told >= LINES_APART:
            self._told = now
            done = self._total - len(self._todo) - len(self._since)
            self._console.file.write(f"{done} of {self._total} trials done, {self._errors} errors, {self._left()}\n")
            self._console.file.flush()

    def waits(self) -> None:
        """Brings the time left up to date."""
        self._shown.update(self._task, errors=self._errors, left=self._left())

    def _left(self) -> str:
        now = self._clock()
        left = self.time_left.left(self._todo.values(), [(asked, now - since) for asked, since in self._since.values()])
        given = self._until - now
        if left <= max(given, 0.0):
            return f"about {duration(left)} left"
        return f"{duration(given)} left to begin cases in" if given > 0.0 else "time is up, cases that were begun are ended"

    def _counted(self, asked: Asked, row: dict[str, Any]) -> None:
        self._errors += row["outcome"] == "error"
        self.time_left.took(asked, row["wall_time_s"])


def duration(seconds: float) -> str:
    """For people: "40 s", "12 min", "3 h 20 min"."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


def _cycles(asked: Asked) -> float:
    return min(asked.case.cycles, _goal_distance(asked.case.scenario) / _of_robot(METRES_A_CYCLE, asked))


@lru_cache(maxsize=256)
def _goal_distance(scenario: str) -> float:
    return load_scenario(scenario).goal_distance


def _of_robot(figures: Mapping[str, float], asked: Asked) -> float:
    """A robot's figure; the largest for one of which nothing is known."""
    return figures.get(asked.case.robot, max(figures.values()))
