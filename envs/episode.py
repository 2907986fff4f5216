"""A moment of an episode, to come back to: a branch for look-ahead, or the same episode in another process.

Kept twice: as copies of robot, links and observation, which only the environment can restore that saved them and only
until its next reset; and as seed and inputs, which say the same to any environment made alike, by running again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from athlete_twin.errors import ConfigError
from athlete_twin.moment import Moment


@dataclass(frozen=True, eq=False, kw_only=True)
class EpisodeState:
    """What `save_state` gives. It can be pickled; then it restores by running again."""

    made_with: dict[str, Any]
    """what the environment was made with"""
    seed: int
    """of the trial"""
    inputs: tuple[Any, ...]
    """messages or decisions since the reset, one a step, None for none"""
    t: float
    """mission time [s]"""
    rng: Any
    """generator of the seeds of coming resets"""
    moment: Moment | None
    """copies, with the robot that they are of; None where there are none, as while a hull touches something"""

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"moment": None}

    def check(self, made_with: dict[str, Any]) -> None:
        """Refuses an environment that was made otherwise."""
        for name, value in made_with.items():
            if self.made_with.get(name) != value:
                here, there = value, self.made_with.get(name)
                raise ConfigError(f"the state was saved with {name} {there!r}, this environment has {here!r}: make it alike")
