"""Runs a recorded trial once more and says whether everything in the recording comes again, or what differs first.

Compared are the bytes of every message on every topic with the times beside them. A recording that a kill or an interruption
ended is compared as far as it goes.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from athlete_twin.errors import RecordingError
from envs.origin import Origin
from envs.prepare import again
from envs.recording import Recorded, read_recording, recorded_metadata
from envs.replay import decision_of
from envs.schemas import Json
from envs.trial import INTERRUPTED, LOOK, Trial
from planner.decisions import Decision, Operator, Proposal
from planner.operators import SCRIPTED_OPERATORS

SAME_MOMENT = 1e-6
"""mission times that differ by less are one: the file keeps whole nanoseconds [s]"""


@dataclass(frozen=True, kw_only=True)
class Ending:
    """How a recording ends."""

    t: float
    """mission time up to which it goes [s]"""
    outcome: str
    """ "" where the process was killed"""
    reason: str

    @property
    def natural(self) -> bool:
        """Whether the trial itself came to an end, so that the same must happen again."""
        return bool(self.outcome) and self.reason != INTERRUPTED


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The first message that does not come again as it was."""

    topic: str
    t: float
    """log time, mission [s]"""
    text: str
    """what was and what is"""


@dataclass(frozen=True, kw_only=True)
class Rerun:
    """What came of running a recording again."""

    messages: int
    """in the recording, compared"""
    ending: Ending
    difference: Difference | None
    """None: everything came again"""
    then: Json
    """hashes `trajectory_sha256` and `link_sha256` of the recording; empty where it was cut"""
    now: Json
    """the same of the rerun"""

    @property
    def equal(self) -> bool:
        """Whether there was something, and all of it came again."""
        hashes = ("trajectory_sha256", "link_sha256")
        return self.messages > 0 and self.difference is None and not (
            self.ending.natural and any(self.then.get(k) != self.now.get(k) for k in hashes)
        )


class RecordedOperator:
    """Gives the answers of a recording in their order, after the same seconds; then nobody is there any more."""

    def __init__(self, path: Path) -> None:
        self._answers = iter([r.content for r in read_recording(path) if r.topic == "/operator/decision"])

    def decide(self, proposal: Proposal, _t: float) -> tuple[Decision, float]:
        """The next answer; `KeyboardInterrupt`, as if one left the terminal, when there is none or it is to something else."""
        content = next(self._answers, None)
        if content is None or content["proposal"] != proposal.index:
            raise KeyboardInterrupt
        return decision_of(content), float(content["seconds"])


def rerun(path: Path, origin: Origin, out: Path, *, progress: Callable[[float], None] = lambda _t: None) -> Rerun:
    """Run a recording's trial again into the folder `out` and compare.

    Args:
        path: the recording.
        origin: where it comes from.
        out: folder for `trial.json` and `trial.mcap` of the rerun.
        progress: told the mission time reached [s].
    """
    _check_apart(path, out)
    scripted = origin.setup.operator in SCRIPTED_OPERATORS
    operator: Operator | None = None if scripted else RecordedOperator(path)
    trial = again(origin, out, operator=operator)
    try:
        return compared(path, trial, progress=progress)
    finally:
        trial.robot.close()


def compared(path: Path, trial: Trial, *, progress: Callable[[float], None] = lambda _t: None) -> Rerun:
    """Run a trial that should be the recorded one, as far as the recording goes, and compare."""
    _check_apart(path, trial.out)
    ending = ending_of(path)
    # A recording that was cut in the middle of what the runner looks at in one go is covered by one look more.
    last = np.inf if ending.natural else ending.t + (0.0 if ending.outcome else LOOK)

    def report(state: Any) -> None:
        progress(state.mission.t)
        trial.interrupted |= bool(state.mission.t >= last - SAME_MOMENT)

    trial.progress = report
    trial.run()
    new = trial.out / "trial.mcap"
    count, difference = first_difference(path, new, whole=ending.natural)
    return Rerun(
        messages=count,
        ending=ending,
        difference=difference,
        then=recorded_metadata(path, "result"),
        now=recorded_metadata(new, "result"),
    )


def ending_of(path: Path) -> Ending:
    """How a recording ends."""
    reached = 0.0
    for line in read_recording(path):
        if line.topic == "/ground/action" and line.content.get("kind") == "outcome":
            return Ending(t=line.t, outcome=str(line.content.get("outcome")), reason=str(line.content.get("text")))
        # An answer is logged for the moment in which it will have been given.
        if line.topic != "/operator/decision":
            reached = max(reached, line.t)
    return Ending(t=reached, outcome="", reason="")


def first_difference(before: Path, after: Path, *, whole: bool) -> tuple[int, Difference | None]:
    """How many messages of a recording were compared with another's, and the first that differs.

    Args:
        before: the recording.
        after: what should be the same.
        whole: both must end together; otherwise `after` may go on, and what closes `before` does not count.
    """
    new: dict[str, list[bytes]] = defaultdict(list)
    for line in read_recording(after):
        new[line.topic].append(_digest(line))
    places: dict[str, int] = defaultdict(int)
    count = 0
    for line in read_recording(before):
        if not whole and line.topic == "/ground/action" and line.content.get("kind") == "outcome":
            return count, None
        place = places[line.topic]
        places[line.topic] = place + 1
        count += 1
        if place >= len(new[line.topic]):
            return count, Difference(topic=line.topic, t=line.t, text=f"message {place} does not come again")
        if new[line.topic][place] != _digest(line):
            other = _message(after, line.topic, place)
            return count, Difference(topic=line.topic, t=line.t, text=what_differs(line, other))
    if whole:
        for topic in sorted(new):
            if len(new[topic]) > places[topic]:
                more = _message(after, topic, places[topic])
                return count, Difference(topic=topic, t=more.t, text=f"message {places[topic]} is new")
    return count, None


def what_differs(before: Recorded, after: Recorded) -> str:
    """In words, the first entry that differs between two messages of a topic."""
    if (before.t, before.made) != (after.t, after.made):
        return f"its time was {before.t:.9f} s (made {before.made:.9f} s), is {after.t:.9f} s (made {after.made:.9f} s)"
    for name, was, now in _entries(before.content, after.content, ""):
        return f"{name} was {_short(was)}, is {_short(now)}"
    return "its bytes differ"


def _check_apart(path: Path, out: Path) -> None:
    if out.resolve() == path.parent.resolve():
        raise RecordingError(f"{path}: running it again into {out} would write over it; another folder would have worked")


def _digest(line: Recorded) -> bytes:
    return hashlib.sha256(f"{line.t!r} {line.made!r} ".encode() + line.data).digest()


def _message(path: Path, topic: str, place: int) -> Recorded:
    lines = (line for line in read_recording(path) if line.topic == topic)
    return next(line for k, line in enumerate(lines) if k == place)


def _entries(was: Any, now: Any, name: str) -> Iterator[tuple[str, Any, Any]]:
    if isinstance(was, dict) and isinstance(now, dict):
        for key in (*was, *(k for k in now if k not in was)):
            yield from _entries(was.get(key), now.get(key), f"{name}.{key}" if name else str(key))
    elif isinstance(was, list) and isinstance(now, list) and len(was) == len(now):
        for k, (a, b) in enumerate(zip(was, now, strict=True)):
            yield from _entries(a, b, f"{name}[{k}]")
    elif was != now:
        yield name, was, now


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
