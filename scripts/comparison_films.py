"""Films and reports of a comparison's telling trials, and which recordings stay: each of the other trials is a row."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from envs.suite_trial import RECORDING, TRIAL

Row = dict[str, Any]
SCRIPTS = Path(__file__).resolve().parent
FRAMES = 100
"""of a film: 20 s of processor time to draw, 8 s to watch"""
FILMS = (("film.webm", ("trial_film.py", "--most-frames", str(FRAMES))), ("report.html", ("trial_report.py",)))
"""what is made, and by which script beside this one"""


def film(out: Path, rows: Sequence[Row], *, workers: int | None) -> list[Row]:
    """Writes film and report of each robot's and variant's best, median and worst trial; the rows of those.

    One that cannot be filmed is told on standard error: the comparison does not fail for it.
    """
    from trial_crews import local_cores

    chosen = telling(rows)
    todo = [(out / row["folder"], script) for row in chosen for made, script in FILMS if not _is_made(out / row["folder"], made)]
    pool = ThreadPoolExecutor(workers or local_cores())
    try:
        for told in pool.map(_made_by, todo):
            sys.stderr.write(told)
    finally:
        pool.shutdown(cancel_futures=True)
    return chosen


def telling(rows: Sequence[Row]) -> list[Row]:
    """The trials that the report shows, each once."""
    if importlib.util.find_spec("variant_rows") is None:
        return []
    picked = importlib.import_module("variant_rows").picked_trials(list(rows))
    chosen = {row["folder"]: row for trials in picked.values() for row in trials.values()}
    return list(chosen.values())


def drop_recordings(out: Path, rows: Sequence[Row], *, keep: str, filmed: Sequence[Row]) -> None:
    """Deletes the recordings that shall not stay.

    Args:
        out: folder of the comparison.
        rows: of its trials.
        keep: "all", "filmed" or "none".
        filmed: rows of what was filmed.
    """
    stay = {"all": rows, "filmed": filmed, "none": ()}[keep]
    kept = {row["folder"] for row in stay}
    for row in rows:
        if row["folder"] not in kept:
            (out / row["folder"] / RECORDING).unlink(missing_ok=True)


def _is_made(folder: Path, name: str) -> bool:
    path, recording = folder / name, folder / RECORDING
    if not recording.is_file():
        return True
    return path.is_file() and path.stat().st_mtime >= (folder / TRIAL).stat().st_mtime


def _made_by(job: tuple[Path, Sequence[str]]) -> str:
    """What went wrong, as a line; nothing when all went well."""
    folder, script = job
    done = subprocess.run([sys.executable, str(SCRIPTS / script[0]), str(folder), *script[1:]], capture_output=True, text=True)
    if done.returncode == 0:
        return ""
    lines = done.stderr.strip().splitlines()
    return f"benchmark_variants: {script[0]} {folder}: {lines[-1] if lines else f'exit status {done.returncode}'}\n"
