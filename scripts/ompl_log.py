"""Results in the form of OMPL's benchmark log, which `ompl_benchmark_statistics` and Planner Arena read."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

from motion_figures import Run

from planner.motion.planners import OMPL_PLANNERS
from planner.motion.sbl import SblConfig

PROPERTIES = (
    ("time REAL", "seconds"),
    ("solved BOOLEAN", "solved"),
    ("state checks INTEGER", "checks"),
    ("solution length REAL", "raw"),
    ("simplification time REAL", "smoothing_seconds"),
    ("simplified solution length REAL", "smoothed"),
    ("peak torque fraction REAL", "peak"),
)
"""as the log names them, and as a run does"""


def write_ompl_log(
    path: Path, runs: Mapping[str, Sequence[Run]], *, experiment: str, setup: str, host: str, seed: int, seconds: float, when: datetime
) -> None:
    """Write one experiment.

    Args:
        path: of the log.
        runs: of each planner, by our names.
        experiment: its name.
        setup: what was planned, in words.
        host: where.
        seed: of all randomness.
        seconds: spent on all of it.
        when: it began.
    """
    count = max((len(its) for its in runs.values()), default=0)
    lines = [
        f"Experiment {experiment}",
        f"Running on {host}",
        f"Starting at {when.astimezone(UTC):%Y-%m-%d %H:%M:%S}",
        "<<<|",
        *setup.splitlines(),
        f"budget: {SblConfig().max_checks} state checks, no clock",
        "|>>>",
        f"{seed} is the random seed",
        "0 seconds per run",
        "0 MB per run",
        f"{count} runs per planner",
        f"{seconds:.6f} seconds spent to collect the data",
        "0 enum types",
        f"{len(runs)} planners",
    ]
    for method, its in runs.items():
        lines += [
            "geometric_SBL_ours" if method == "sbl" else f"geometric_{OMPL_PLANNERS[method]}",
            "0 common properties",
            f"{len(PROPERTIES)} properties for each run",
            *(name for name, _ in PROPERTIES),
            f"{len(its)} runs",
            *("; ".join(_value(getattr(one, field)) for _, field in PROPERTIES) + "; " for one in its),
            ".",
        ]
    path.write_text("\n".join(lines) + "\n")


def _value(value: float | int | bool) -> str:
    """Of a property; empty where there is none, as OMPL leaves it."""
    if isinstance(value, bool):
        return str(int(value))
    return "" if isinstance(value, float) and math.isnan(value) else f"{value:.9g}"
