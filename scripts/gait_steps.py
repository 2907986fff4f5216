"""The rows of `bench_gait.py` about stepping onto and over: ledges, ditches and walls, planned and executed by the twin."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from bench_table import Row, row
from gait_figures import Gaits
from sag_yard import StanceRefusedError
from step_yard import StepYard, WalkedCrossing

from planner.gait.ground_profile import Profile, ditch, ledge, wall
from planner.gait.stepping import Crossing, Largest, SteppingConfig, cross, largest_crossing

PLANS = {
    "sdm_b": (
        SteppingConfig(heading_deg=30.0, stride=0.6, foot_scale=1.1, behind=0.0, lift=0.25, clear=0.12),
        SteppingConfig(heading_deg=30.0, stride=0.4, foot_scale=1.1, behind=0.2, lift=0.25, clear=0.12),
    ),
    "t12": (
        SteppingConfig(heading_deg=0.0, stride=1.2, foot_scale=1.0, behind=0.1, lift=0.45, clear=0.25),
        SteppingConfig(heading_deg=0.0, stride=0.9, foot_scale=1.0, behind=0.1, lift=0.45, clear=0.25),
    ),
}
"""ways to go, tried in their order"""
OBSTACLES: dict[str, tuple[Callable[[float], Profile], float, float, float]] = {
    "ledge": (ledge, 0.1, 1.7, 0.1), "ditch": (ditch, 0.1, 1.7, 0.1), "wall": (wall, 0.1, 1.3, 0.1),
}  # fmt: skip
"""maker, smallest and largest size tried, and how closely the limit is found [m]"""
CLAIM = 1.7
"""vertical step of SDM-B, [SunSpiral2012] s1 [m]"""
LOWER = 0.75
"""of a size that the twin did not finish, the next one tried"""
TRIES = 3


def largest(gaits: Gaits, kind: str) -> Largest:
    """The largest obstacle of a kind that is planned for, found when first asked for."""
    if kind not in gaits.largest_crossings:
        make, low, high, digit = OBSTACLES[kind]
        plans = PLANS[gaits.spec.name]
        gaits.largest_crossings[kind] = largest_crossing(gaits.spec, make, plans, low=low, high=high, digit=digit)
    return gaits.largest_crossings[kind]


def step_rows(gaits: Gaits, seed: int) -> Iterator[Row]:
    """The largest of each kind, planned; the seed does not matter."""
    del seed
    name = gaits.spec.name
    for kind in gaits.obstacles or OBSTACLES:
        found = largest(gaits, kind)
        claim = {"peer_name": "claimed", "peer": CLAIM} if kind == "ledge" and name == "sdm_b" else {}
        what = f"{name}: largest {kind}, planned; {'ended by: ' + found.ended_by if found.ended_by else 'nothing up to there'}"
        yield row(what, found.size, "m", **claim)  # type: ignore[arg-type]
        if found.crossing is not None:
            told = f"{name}: on that {kind}, {len(found.crossing.steps)} steps"
            yield row(f"{told}, peak torque planned", 100.0 * found.crossing.peak, "%")
            yield row(f"{told}, largest pitch of the deck planned", float(np.rad2deg(found.crossing.largest_pitch)), "deg")


def step_twin_rows(gaits: Gaits, seed: int) -> Iterator[Row]:
    """The largest ledge, ditch and wall of a few that the twin crosses, beginning with the planned ones."""
    for kind in gaits.obstacles or OBSTACLES:
        make, low, _, digit = OBSTACLES[kind]
        planned = largest(gaits, kind)
        size, crossing = planned.size, planned.crossing
        best: float | None = None
        for _ in range(TRIES):
            if crossing is not None:
                walked = walk_crossing(gaits, kind, crossing, seed)
                yield from _told(gaits, kind, size, crossing, walked)
                if crossed(walked):
                    best = size
                    break
            if size <= low + 1e-9:
                break
            size = max(low, float(np.floor(LOWER * size / digit + 1e-9) * digit))
            crossing = planned_crossing(gaits, make(size))
        name = f"{gaits.spec.name}: twin, largest {kind} crossed of those tried"
        yield row(name, best, "m", peer_name="planned", peer=planned.size if np.isfinite(planned.size) else None)


def planned_crossing(gaits: Gaits, profile: Profile) -> Crossing | None:
    """The first plan that crosses an obstacle."""
    for config in PLANS[gaits.spec.name]:
        found = cross(gaits.spec, profile, replace(config))
        if isinstance(found, Crossing):
            return found
    return None


def walk_crossing(gaits: Gaits, kind: str, crossing: Crossing, seed: int) -> WalkedCrossing:
    """The twin's execution, kept for the pictures."""
    try:
        yard = StepYard(crossing, seed)
    except StanceRefusedError as e:
        return WalkedCrossing(steps=0, torques=np.array([np.nan]), slip=0.0, struck=(), ended_by=str(e), poses=(), joints=np.zeros(0))
    try:
        walked = yard.cross()
    finally:
        yard.close()
    gaits.crossed[kind] = (crossing, walked)
    return walked


def crossed(walked: WalkedCrossing) -> bool:
    """Whether all steps were finished without a strike and within every joint's torque, as on slopes."""
    return not walked.ended_by and not walked.struck and float(np.nanmax(walked.torques)) <= 1.0


def _told(gaits: Gaits, kind: str, size: float, crossing: Crossing, walked: WalkedCrossing) -> list[Row]:
    """The first row says by its verdict whether it counts as crossed."""
    ended = f", ended in {walked.ended_by}" if walked.ended_by else ""
    struck = f", struck {', '.join(walked.struck)}" if walked.struck else ""
    what = f"{gaits.spec.name}: twin, {kind} of {size:.2f} m"
    done = row(f"{what}, steps finished{ended}{struck}", float(walked.steps), "1", peer_name="planned", peer=float(len(crossing.steps)),
               target=f">= {len(crossing.steps)}")  # fmt: skip
    done["met"] = crossed(walked)
    peak = float(np.nanmax(walked.torques)) if np.isfinite(walked.torques).any() else None
    return [
        done,
        row(f"{what}, peak torque", None if peak is None else 100.0 * peak, "%", peer_name="planned", peer=100.0 * crossing.peak),
        row(f"{what}, longest slip of a standing wheel", walked.slip, "m"),
    ]
