"""The figures by which planner variants are compared: what each is called, how it is read from a trial's row, which way is better.

A row is a trial's `trial.json` with `delay_s`, `case` and `folder`, as `results.jsonl` of a comparison holds them. A metric's name is the
path of its figure in the row, `sag_error_m.mean` for instance; `success` alone is made from the outcome.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from variant_grounds import ground_of

from athlete_twin.errors import ConfigError, RecordingError

Row = dict[str, Any]



@dataclass(frozen=True, kw_only=True)
class Metric:
    """A figure of a trial."""

    name: str
    """dotted path in the row"""
    title: str
    better: Literal["more", "less"]
    unit: str = ""
    """in which people read it; what is counted has none"""
    scale: float = 1.0
    """from the row's SI unit to `unit`"""
    digits: int = 2
    """behind the point, in `unit`"""
    reached_only: bool = False
    """compared only over pairs in which both trials succeeded: it grows with the way walked, or is the extreme of it, so that who
    falls early or never starts has little of it"""
    timing: bool = False
    """measured on the machine at hand: corrected apart, so that another load of it changes nothing of what else is significant"""

    def read(self, row: Row) -> float | None:
        """Its value in SI units; None where it was not measured."""
        if self.name == "success":
            return float(succeeded(row))
        value: Any = row
        for key in self.name.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        if value is None:
            return None
        if not isinstance(value, int | float):
            raise RecordingError(f"{self.name} of {row['folder']} is {value!r}, must be a number or null")
        return float(value) if math.isfinite(value) else None

    def shown(self, value: float | None, *, sign: bool = False) -> str:
        """The value for people, with its unit; a dash where there is none."""
        if value is None or not math.isfinite(value):
            return "–"
        number = self.number(value, sign=sign)
        return f"{number} {self.unit}" if self.unit else number

    def number(self, value: float, *, sign: bool = False) -> str:
        """The value for people, without its unit."""
        text = f"{self.scale * value:{'+' if sign else ''}.{self.digits}f}"
        if float(text) == 0.0:
            return text.lstrip("+-")
        return text.replace("-", "−")  # a minus as wide as the plus


METRICS = (
    Metric(name="success", title="success", better="more", unit="%", scale=100.0, digits=0),
    Metric(name="progress_m", title="progress", better="more", unit="m"),
    Metric(name="mission_time_s", title="mission time", better="less", unit="min", scale=1 / 60, digits=1, reached_only=True),
    Metric(name="command_cycles", title="command cycles", better="less", digits=1, reached_only=True),
    Metric(name="collisions", title="collisions", better="less", digits=1, reached_only=True),
    Metric(name="faults", title="faults", better="less", digits=1, reached_only=True),
    Metric(name="sag_error_m.mean", title="sag error", better="less", unit="mm", scale=1000.0, digits=1),
    Metric(name="touchdown_error_m.mean", title="touch-down error", better="less", unit="mm", scale=1000.0, digits=1),
    Metric(name="map_error_m.median", title="map error", better="less", unit="mm", scale=1000.0, digits=1, reached_only=True),
    Metric(
        name="localisation_error_m.mean", title="localisation error", better="less", unit="mm", scale=1000.0, digits=1, reached_only=True
    ),
    Metric(name="peak_torque_fraction", title="peak torque", better="less", unit="%", scale=100.0, digits=1, reached_only=True),
    Metric(name="min_support_margin_m", title="least support margin", better="more", unit="m", reached_only=True),
    Metric(name="min_cps_margin_m", title="least CPS margin", better="more", unit="m", reached_only=True),
    Metric(name="min_tip_over_energy_m", title="least tip-over energy", better="more", unit="m", digits=3, reached_only=True),
    Metric(name="stage_times_s.plan.median", title="planning time (median)", better="less", unit="s", timing=True),
    Metric(name="stage_times_s.plan.p95", title="planning time (95 %)", better="less", unit="s", timing=True),
    Metric(name="wall_time_s", title="computing time", better="less", unit="min", scale=1 / 60, digits=1, reached_only=True, timing=True),
)
"""what is compared unless told otherwise, the most important first"""
BY_NAME = {m.name: m for m in METRICS}
SUCCESS = BY_NAME["success"]


def succeeded(row: Row) -> bool:
    """Whether the trial reached its goal, or walked all the gait cycles to which its case caps the way.

    A trial that could not be run (outcome `error`) did not succeed: a variant that breaks its program reaches no goal either.
    """
    return bool(row["outcome"] == "goal_reached") or cut_short(row)


def cut_short(row: Row) -> bool:
    """Whether the trial walked all the gait cycles to which its case caps the way, so that nobody knows where it would have come.

    Who ends with `cycles_done` after as many as the scenario allows at all was not capped and did not arrive. The row says which it
    was; of a row that does not, the scenario as this machine has it.
    """
    if row["outcome"] != "cycles_done":
        return False
    if row.get("capped") is not None:
        return bool(row["capped"])
    walked, allowed = limit_of(row), ground_of(row["scenario"]).cycles
    return walked is None or allowed is None or walked < allowed


def limit_of(row: Row) -> int | None:
    """Gait cycles to which a trial that ended with `cycles_done` was limited; None where the row does not say."""
    cycles: int | None = row["gait_cycles"] if row.get("cycles") is None else row["cycles"]
    return cycles


def metrics_named(names: Sequence[str] | None) -> tuple[Metric, ...]:
    """The metrics of these names, each once; all of them for None."""
    if names is None:
        return METRICS
    if not names:
        raise ConfigError(f"no metric is named; known are {', '.join(BY_NAME)}")
    for name in names:
        if name not in BY_NAME:
            near = difflib.get_close_matches(name, BY_NAME, n=1)
            meant = f"did you mean {near[0]!r}? " if near else ""
            raise ConfigError(f"metric {name!r} is unknown; {meant}known are {', '.join(BY_NAME)}")
    return tuple(BY_NAME[name] for name in dict.fromkeys(names))
