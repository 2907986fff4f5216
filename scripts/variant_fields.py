"""What the fields of a comparison's rows may hold, besides the metrics: whoever reads rows relies on it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from variant_metrics import Row

PARTS = ("motion_s", "link_s", "operator_s", "ground_s")


@dataclass(frozen=True, kw_only=True)
class Kind:
    """What a field may hold."""

    words: str
    fits: Callable[[Any], bool]
    nullable: bool = True

    def holds(self, value: Any) -> bool:
        """Whether a value is of this kind."""
        return self.nullable if value is None else self.fits(value)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


TEXT = Kind(words="text", fits=lambda v: isinstance(v, str), nullable=False)
OBJECT = Kind(words="an object or null", fits=lambda v: isinstance(v, dict))
FIGURE = Kind(words="a finite number or null", fits=_number)
COUNT = Kind(words="a whole number or null", fits=_whole)
KINDS = {
    **dict.fromkeys(("robot", "scenario", "variant", "case", "folder", "outcome", "reason"), TEXT),
    "seed": Kind(words="a whole number", fits=_whole, nullable=False),
    "delay_s": Kind(words="a number of seconds", fits=_number, nullable=False),
    "suite_sha256": Kind(words="text or null", fits=lambda v: isinstance(v, str)),
    "provenance": OBJECT, "stage_times_s": OBJECT, "gait_cycles": COUNT, **dict.fromkeys(PARTS, FIGURE),
    "cycles": COUNT, "time_limit_s": FIGURE, "capped": Kind(words="true, false or null", fits=lambda v: isinstance(v, bool)),
}  # fmt: skip
"""of a row; the last three need not be there"""


def misfit(row: Row) -> str | None:
    """The first field that does not hold what it must, in words; None where all do."""
    return next((f"{name} is {value!r}, must be {kind.words}" for name, value, kind in _fields(row) if not kind.holds(value)), None)


def _fields(row: Row) -> Iterator[tuple[str, Any, Kind]]:
    """Inner fields come after what holds them."""
    for key, kind in KINDS.items():
        if key in row:
            yield key, row[key], kind
    yield "provenance.packages", (row["provenance"] or {}).get("packages"), OBJECT
    for stage, times in (row["stage_times_s"] or {}).items():
        yield f"stage_times_s.{stage}", times, OBJECT
        for key in ("median", "p95"):
            yield f"stage_times_s.{stage}.{key}", (times or {}).get(key), FIGURE
