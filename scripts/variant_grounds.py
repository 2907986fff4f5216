"""What the scenarios of a comparison say of themselves: how densely rocks lie, and how many gait cycles are allowed."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Of a scenario; None what it does not say, or where it is not here."""

    density: float | None
    """cumulative area fraction k of rocks, 0 to 1"""
    cycles: int | None
    """gait cycles after which a trial ends at the latest"""


@cache
def ground_of(scenario: str) -> Ground:
    """A scenario by its name or path, as far as this machine has it: rows may come from another."""
    try:
        content: dict[str, Any] = read_toml(named_toml("scenarios", scenario))
    except ConfigError:
        return Ground(density=None, cycles=None)
    k, cycles = content.get("rocks", {}).get("k"), content.get("cycles")
    return Ground(
        density=float(k) if isinstance(k, int | float) else None, cycles=cycles if isinstance(cycles, int) else None
    )  # fmt: skip
