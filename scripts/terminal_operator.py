"""An operator who is a person at a terminal: reads the proposal, looks at its picture, types the answer."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from athlete_twin.errors import ConfigError
from athlete_twin.model.spec import load_spec
from planner.decisions import Decision, Proposal, check_cameras

HELP = (
    "a approve   r WHY reject   e X Y edit the footfall (m, world)   l N choose leg 1-6   "
    "c NAME ... take pictures   w S wait (s)   s stop"
)


@dataclass(kw_only=True)
class TerminalOperator:
    """Asks until it gets a usable answer. The seconds it takes are charged to the mission."""

    robot: str
    out: Path
    """where the pictures of the previews go"""
    console: Console = field(default_factory=Console)

    def decide(self, proposal: Proposal, t: float) -> tuple[Decision, float]:
        """The person's answer and how long it took [s]."""
        from preview_picture import save_preview

        picture = self.out / f"proposal_{proposal.index:03d}.png"
        save_preview(proposal, self.robot, picture)
        begun = time.perf_counter()
        self.console.print(f"\n[bold]{t:.0f} s, proposal {proposal.index}[/bold]: {proposal.text}")
        self.console.print(
            f"least margin {proposal.predicted_margin:.2f} m, sag {proposal.predicted_sag:.3f} m, "
            f"torque {_percent(proposal.predicted_torque_fraction)} of the limit, "
            f"{_percent(proposal.unknown_share)} of the ground under the wheel unseen; {picture}"
        )
        for fault in proposal.preview.faults:
            self.console.print(f"{fault.code} after {fault.t:.0f} s: {fault.text}", style="bold red", markup=False)
        while True:
            try:
                typed = self.console.input(f"{HELP}\n> ", markup=False)
            except EOFError:
                # Nobody is there any more: a robot without an operator stops.
                return Decision(kind="stop"), time.perf_counter() - begun
            try:
                decision = parsed(typed)
                check_cameras(decision, load_spec(self.robot))
                return decision, time.perf_counter() - begun
            except ConfigError as e:
                self.console.print(str(e), style="red", markup=False)


def parsed(typed: str) -> Decision:
    """The decision that a typed line means."""
    words = typed.split()
    try:
        match words:
            case ["a"]:
                return Decision(kind="approve")
            case ["r", *why]:
                return Decision(kind="reject", reason=" ".join(why))
            case ["e", x, y]:
                return Decision(kind="edit_footfall", footfall_in_world=np.array([float(x), float(y), 0.0]))
            case ["l", leg]:
                return Decision(kind="choose_leg", leg=int(leg) - 1)
            case ["c", *cameras] if cameras:
                return Decision(kind="choose_cameras", cameras=tuple(cameras))
            case ["w", seconds]:
                return Decision(kind="wait", duration=float(seconds))
            case ["s"]:
                return Decision(kind="stop")
    except ValueError as e:
        raise ConfigError(f"{typed!r} is not understood: {e}") from e
    raise ConfigError(f"{typed!r} is not one of the answers below")


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if np.isfinite(share) else "an unforeseen part"
