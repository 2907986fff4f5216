"""Runs the trials of a comparison into a folder, each once, whatever happens in between.

A row of `results.jsonl` is written when a trial's folder is complete, by this process alone, and is on the disk before the next
begins. So a run that is killed at any moment goes on where it was: rows stay, a torn last line goes, a trial that was complete
but had no row gets it, and one that was half done is done anew.
"""

from __future__ import annotations

import fcntl
import json
import math
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal, Protocol

from athlete_twin.errors import ConfigError, RecordingError
from envs.suite import Case, Suite
from envs.suite_trial import (
    ASKED,
    CHANGED,
    LOG,
    Asked,
    code_now,
    reason_of,
    result_in,
    row_of,
    this_code,
    variant_sha256,
)
from envs.trial import usable_folder

Row = dict[str, Any]
RESULTS, TRIALS, LOCK, VARIANTS, ASKED_FOR = "results.jsonl", "trials", ".lock", "variants.txt", "asked.txt"
PATIENCE = 5.0
"""for which a lock is awaited: the trials of a runner that was killed end a moment after it [s]"""


class Crew(Protocol):
    """Who runs trials, several at once."""

    size: int
    """trials that run at once"""

    def start(self, asked: Asked, folder: Path, *, lock: int) -> None:
        """Begin a trial in an empty folder; the open file `lock` is held as long as anyone may write there."""

    def ended(self) -> list[tuple[Asked, int]]:
        """Trials that ended since, with their exit status, their folders complete; waits a moment for one."""

    def stop(self) -> None:
        """End what runs, at once."""


class Onlooker(Protocol):
    """Who is shown how far it is."""

    def begins(self, asked: Sequence[Asked], rows: Sequence[Row], *, workers: int) -> None:
        """What is to be run, and the rows that are there already."""

    def started(self, asked: Asked) -> None:
        """A trial began."""

    def row(self, asked: Asked, row: Row) -> None:
        """A trial ended."""

    def waits(self) -> None:
        """Nothing ended lately."""


def asked_for(suite: Suite, cases: Sequence[Case], variants: Sequence[str], *, body: str) -> list[Asked]:
    """The trials of a comparison; all variants of a case before the next case, so that what is there early are pairs."""
    sha256, code = suite.sha256, this_code()
    files = {variant: variant_sha256(variant) for variant in variants}
    return [
        Asked(
            case=case,
            variant=v,
            body=body,
            suite_sha256=sha256,
            code_sha256=code,
            variant_sha256=files[v],
            scenario_sha256=suite.scenarios[Path(case.scenario).stem],
        )
        for case in cases
        for v in variants
    ]


def run_all(
    asked: Sequence[Asked],
    out: Path,
    *,
    crew: Crew,
    onlooker: Onlooker,
    retry_errors: bool = False,
    unwanted: Sequence[str] = (),
    seconds: float = math.inf,
    clock: Callable[[], float] = time.monotonic,
) -> list[Row]:
    """Runs what has no row yet; the rows of what was asked, in that order: of all of it, unless time was up.

    Args:
        asked: the trials.
        out: folder that holds them, made if need be.
        crew: who runs them; it is stopped when this returns or raises.
        onlooker: is told how far it is.
        retry_errors: also run again what could not be run before.
        unwanted: names of files in a trial's folder that are deleted once its row is written.
        seconds: after which no case is begun but the first; one that was begun is walked by every variant, so that there are pairs alone.
        clock: tells the time [s].
    """
    until = clock() + seconds
    try:
        with results_of(out) as results:
            results.unwanted = unwanted
            results.check(asked)
            results.note_variants(asked)
            results.note_asked(asked)
            for one in asked:
                results.adopt(one)
            # A row of an error stays until its trial has another: what is not run again is still what could not be run.
            done = {key for key, row in results.rows.items() if not (retry_errors and row["outcome"] == "error")}
            todo = deque(one for one in asked if one.key not in done)
            onlooker.begins(asked, [results.rows[a.key] for a in asked if a.key in done], workers=crew.size)
            _run(todo, results, crew, onlooker, time_is_up=lambda: clock() >= until)
            results.sort(asked)
            return [results.rows[one.key] for one in asked if one.key in results.rows]
    finally:
        crew.stop()


def read_rows(path: Path) -> tuple[list[Row], int]:
    """The whole rows of a results file, and the bytes they take: what follows was torn off while it was written."""
    if not path.is_file():
        return [], 0
    raw = path.read_bytes()
    whole = raw.rfind(b"\n") + 1
    rows = []
    for i, line in enumerate(raw[:whole].splitlines()):
        try:
            row = json.loads(line)
            row["case"], row["variant"], row["suite_sha256"], row["provenance"]["code_sha256"]
        except (ValueError, KeyError, TypeError) as e:
            raise ConfigError(f"{path}: line {i + 1} is no row of a comparison; delete that line to have its trial run again") from e
        rows.append(row)
    return rows, whole


@contextmanager
def results_of(out: Path) -> Iterator[Results]:
    """The results in a folder, for this process alone to write."""
    usable_folder(out)
    path = out / LOCK
    with path.open("a+") as lock:
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    holder = path.read_text().strip() or "unknown"
                    raise ConfigError(
                        f"{out} is being written by another run (process {holder}); wait for it, end it, or name another --out"
                    ) from None
                time.sleep(0.1)
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        rows, whole = read_rows(out / RESULTS)
        if (out / RESULTS).is_file() and whole < (out / RESULTS).stat().st_size:
            os.truncate(out / RESULTS, whole)
        yield Results(out=out, lock=lock.fileno(), rows={(r["case"], r["variant"]): r for r in rows})


@dataclass(kw_only=True)
class Results:
    """Rows on the disk and in memory, by case and variant. All bear the commit that the first was run at."""

    out: Path
    lock: int
    """open file whose lock this process holds"""
    rows: dict[tuple[str, str], Row]
    unwanted: Sequence[str] = ()
    """files of a trial that go when its row is there"""
    variants: Sequence[str] = ()
    """in the order in which this folder was first asked for them"""

    def folder(self, asked: Asked) -> Path:
        """Where a trial's files are."""
        return self.out / TRIALS / asked.folder

    def check(self, asked: Sequence[Asked]) -> None:
        """Refuses a folder whose rows do not compare with what is asked."""
        if not self.rows or not asked:
            return
        first, rows = asked[0], list(self.rows.values())
        way_out = "name another --out, or delete that folder"
        foreign = [r for r in rows if r["suite_sha256"] != first.suite_sha256]
        if foreign:
            was, now = str(foreign[0]["suite_sha256"])[:12], first.suite_sha256[:12]
            raise ConfigError(f"{self.out}: {len(foreign)} of its trials are of another suite ({was}, this one is {now}); {way_out}")
        foreign = [r for r in rows if r["provenance"]["code_sha256"] != first.code_sha256]
        if foreign:
            was = f"version {foreign[0]['provenance'].get('version')}, commit {str(foreign[0]['provenance'].get('git_sha'))[:12]}"
            raise ConfigError(
                f"{self.out}: {len(foreign)} of its trials were run by another version of the code, the drawings or the libraries "
                f"({was}); {way_out}"
            )
        if any(r["provenance"].get("body") != first.body for r in rows):
            raise ConfigError(f"{self.out}: its trials were run with another body than {first.body!r}; {way_out}")
        files = {a.variant: a.variant_sha256 for a in asked}
        for row in rows:
            variant = row["variant"]
            if variant in files and row["provenance"].get("variant_sha256") != files[variant]:
                raise ConfigError(f"{self.out}: variant {variant} has changed since its trials were run; {way_out}")

    def note_variants(self, asked: Sequence[Asked]) -> None:
        """Notes the variants in the order in which this folder was first asked for them: what joins later is not the baseline."""
        path = self.out / VARIANTS
        known = path.read_text(encoding="utf-8").splitlines() if path.is_file() and self.rows else []
        self.variants = list(dict.fromkeys([*known, *(variant for _, variant in self.rows), *(a.variant for a in asked)]))
        _replace(path, [f"{variant}\n".encode() for variant in self.variants])

    def note_asked(self, asked: Sequence[Asked]) -> None:
        """Notes all trials that this folder was ever asked for, once it has rows: the report says how many have not been run."""
        path = self.out / ASKED_FOR
        known = path.read_text(encoding="utf-8").splitlines() if path.is_file() and self.rows else []
        _replace(path, [f"{one}\n".encode() for one in dict.fromkeys([*known, *(f"{a.case.id} {a.variant}" for a in asked)])])

    def adopt(self, asked: Asked) -> None:
        """Gives a trial its row that was complete when its runner was killed."""
        folder = self.folder(asked)
        if asked.key in self.rows or result_in(folder) is None or not (folder / ASKED).is_file():
            return
        if (folder / ASKED).read_bytes() == asked.text().encode():
            self.add(asked, row_of(asked, folder, status=0))

    def emptied(self, asked: Asked) -> Path:
        """The trial's folder without what an earlier run left there."""
        folder = self.folder(asked)
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
        return folder

    def add(self, asked: Asked, row: Row) -> Row:
        """The row as it was written; it is on the disk when this returns."""
        # Its code is the same to the byte, whatever has been committed beside it since.
        began_at = next(iter(self.rows.values()), row)["provenance"].get("git_sha")
        row = row | {"folder": f"{TRIALS}/{asked.folder}", "provenance": row["provenance"] | {"git_sha": began_at}}
        line = _line(row)
        with _on_disk(self.out / RESULTS, "ab") as file:
            file.write(line)
        row = json.loads(line)
        self.rows[asked.key] = row
        for name in self.unwanted:
            (self.folder(asked) / name).unlink(missing_ok=True)
        return row

    def sort(self, asked: Sequence[Asked]) -> None:
        """Puts the rows into an order: variants as noted, of each the cases as asked, others behind.

        Two runs then agree line by line but for timings.
        """
        variants = {variant: i for i, variant in enumerate(self.variants)}
        cases = {case: i for i, case in enumerate(dict.fromkeys(a.case.id for a in asked))}
        self.rows = dict(sorted(self.rows.items(), key=lambda item: (variants[item[0][1]], cases.get(item[0][0], len(cases)), item[0])))
        self._rewrite()

    def _rewrite(self) -> None:
        _replace(self.out / RESULTS, [_line(row) for row in self.rows.values()])


def _run(todo: deque[Asked], results: Results, crew: Crew, onlooker: Onlooker, *, time_is_up: Callable[[], bool]) -> None:
    running = 0
    begun: set[str] = set()
    while todo or running:
        if begun and todo and time_is_up():
            todo = deque(one for one in todo if one.case.id in begun)
        while todo and running < crew.size:
            begun.add(todo[0].case.id)
            crew.start(todo[0], results.emptied(todo[0]), lock=results.lock)
            onlooker.started(todo.popleft())
            running += 1
        ended = crew.ended() if running else []
        for asked, status in ended:
            running -= 1
            folder = results.folder(asked)
            _check_unchanged(asked, folder, status=status)
            onlooker.row(asked, results.add(asked, row_of(asked, folder, status=status)))
        if not ended:
            onlooker.waits()


def _check_unchanged(asked: Asked, folder: Path, *, status: int) -> None:
    """Stops at a trial without a result while files change under the run: it and all that follow would be rows of errors."""
    if result_in(folder) is not None:
        return
    changed = reason_of(status, folder / LOG) if status == CHANGED else ""
    if not changed and code_now() != this_code():  # it may have broken off at a file that was being written
        changed = "the code, the drawings or the libraries"
    if changed:
        raise ConfigError(
            f"stopped before {asked.case.id} {asked.variant}, which has no row: where it was to run, {changed} changed under the run; "
            "restore that, or name another --out; the same command goes on from there"
        )


@contextmanager
def _on_disk(path: Path, mode: Literal["ab", "wb"]) -> Iterator[BinaryIO]:
    """A file to write whose content is on the disk in the end."""
    try:
        with path.open(mode) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
    except OSError as e:
        raise RecordingError(f"{path} cannot be written: {e.strerror}; make room, the same command then goes on from there") from e


def _replace(path: Path, lines: Sequence[bytes]) -> None:
    """Writes a file anew, whole or not at all."""
    part = path.with_name(f"{path.name}.part")
    with _on_disk(part, "wb") as file:
        file.writelines(lines)
    part.replace(path)


def _line(row: Row) -> bytes:
    return json.dumps(row, allow_nan=False).encode() + b"\n"
