"""Puts the results of many trials into one table, failures included.

    python scripts/results_table.py out/results/*

Reads the `trial.json` of each folder and prints Markdown, a row for each robot, scenario and variant: how many trials reached
their goal or finished their cycles, how they ended otherwise, what they hit, and medians.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import tyro

from athlete_twin.errors import AthleteError, RecordingError

ENDED_WELL = ("goal_reached", "cycles_done")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Prints one row a group of trials."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """each with a trial.json"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        trials = [read_trial(folder) for folder in options.folders]
        sys.stdout.write(table(trials))
    except AthleteError as e:
        sys.stderr.write(f"results_table: {e}\n")
        return 2
    return 0


def read_trial(folder: Path) -> dict[str, Any]:
    """Content of a trial's result."""
    path = folder / "trial.json"
    try:
        content: dict[str, Any] = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError) as e:
        raise RecordingError(f"{path}: no readable trial ({e}); name folders written by rock_field_trial.py") from e
    return content


def table(trials: list[dict[str, Any]]) -> str:
    """Markdown of all trials, grouped by robot, scenario and variant."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for trial in trials:
        groups.setdefault((trial["robot"], trial["scenario"], trial["variant"]), []).append(trial)
    head = (
        "robot", "scenario", "variant", "trials", "goal or cycle", "of these 1.2 m or more", "without collision", "tipped over",
        "collisions", "other outcomes", "median progress [m]", "median mission [s]", "median wall [s]", "peak torque [%]",
    )  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(_row(key, groups[key])) + " |" for key in groups]
    return "\n".join(lines) + "\n"


def _row(key: tuple[str, str, str], trials: list[dict[str, Any]]) -> list[str]:
    well = [t for t in trials if t["outcome"] in ENDED_WELL]
    others = Counter(t["outcome"] for t in trials if t["outcome"] not in ENDED_WELL)
    return [
        *key,
        str(len(trials)),
        str(len(well)),
        str(sum(t["progress_m"] >= 1.2 for t in well)),
        str(sum(t["collisions"] == 0 for t in well)),
        str(sum(t["outcome"] == "tip_over" for t in trials)),
        str(sum(t["collisions"] for t in trials)),
        ", ".join(f"{n} {name}" for name, n in others.items()) or "none",
        f"{median(t['progress_m'] for t in trials):.2f}",
        f"{median(t['mission_time_s'] for t in trials):.0f}",
        f"{median(t['wall_time_s'] for t in trials):.0f}",
        f"{100 * max(t['peak_torque_fraction'] or 0.0 for t in trials):.0f}",
    ]


if __name__ == "__main__":
    sys.exit(main())
