"""What a wheel feels in free swings of the twin: joint moves as the executive makes them, and pieces at constant speed beside them.

A leg is lifted, led forth and back through way-points in the air as in a step over something, and nothing is in its way: the
executive's guard against strikes should feel nothing. What it feels, low-passed as the guard does, is inertia, sway and encoders.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from bench_table import Row, refusal, row
from gait_figures import Gaits
from sag_yard import SagYard, StanceRefusedError
from swing_peers import constant_speed

from athlete_twin.executive import CONTROL_PERIOD, SWING_FORCE, Executive
from athlete_twin.geometry.arrays import Joints
from athlete_twin.messages import Command, JointMove
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.reach import leg_ik
from athlete_twin.moves import Move, Sensed, Steps, copyable

LEG_NUMBERS = (0, 1)
"""a corner leg and a side leg of T12; all alike on SDM-B"""
LIFT, SIDE = 0.75, 0.3
"""wheel radii to lift before the swing; to either side [m]"""
RAISED = 0.25
"""higher on the way [m]"""
JUMPS = "constant speed, with jumps"


class FeelingExecutive(Executive):
    """The executive, which also notes what its guard feels in joint moves; with `jumps` it makes them as it once did."""

    felt: list[float]
    ticks: int
    jumps: bool

    def _guard_swing(self, run: object, sensed: Sensed) -> None:
        super()._guard_swing(run, sensed)  # type: ignore[arg-type]
        command = run.sequence.commands[run.index] if run.index < len(run.sequence.commands) else None  # type: ignore[attr-defined]
        if isinstance(command, JointMove) and self._swing_force is not None:
            self.felt.append(float(np.linalg.norm(self._swing_force)))
            self.ticks += 1

    def _begin(self, command: Command) -> Move:
        move = super()._begin(command)
        if not (self.jumps and isinstance(command, JointMove)):
            return move
        return _jumping(self.kin.spec.speed_unloaded, command, self.setpoint)


@copyable
def _jumping(speed: float, command: JointMove, start: Joints) -> Steps:
    """One leg through way-points at constant speed, as joint moves went before they were timed."""
    ways = np.concatenate([start[command.leg][None], command.waypoints])
    for q in constant_speed(ways, speed, CONTROL_PERIOD):
        joints = start.copy()
        joints[command.leg] = q
        yield joints


def swing_rows(gaits: Gaits, seed: int) -> list[Row]:
    """Force felt and time taken, ours and with jumps, on one individual."""
    name, weight = gaits.spec.name, gaits.spec.mass * GRAVITY
    try:
        ours, theirs = (_swung(name, seed, jumps=jumps) for jumps in (False, True))
    except StanceRefusedError as e:
        return [refusal(f"{name}: free swings in the twin", str(e))]
    what = f"{name}: twin, free swings of legs {' and '.join(str(n + 1) for n in LEG_NUMBERS)}"
    return [
        row(f"{what}: force felt at the wheel, largest; the guard stops at {100 * SWING_FORCE:g}", 100 * max(ours[0]) / weight,
            "% of the weight", peer_name=JUMPS, peer=100 * max(theirs[0]) / weight),
        row(f"{what}: force felt at the wheel, rms", 100 * _rms(ours[0]) / weight, "% of the weight", peer_name=JUMPS,
            peer=100 * _rms(theirs[0]) / weight),
        row(f"{what}: duration", ours[1], "s", peer_name=JUMPS, peer=theirs[1]),
    ]  # fmt: skip


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _swung(robot: str, seed: int, *, jumps: bool) -> tuple[list[float], float]:
    """Forces felt at each control tick of the swings [N], and how long they took [s]."""
    yard = SagYard(robot, seed)
    try:
        executive = FeelingExecutive(kin=yard.robot.kin, setpoint=yard.robot.executive.setpoint)
        executive.felt, executive.ticks, executive.jumps = [], 0, jumps
        yard.robot.executive = executive
        for leg in LEG_NUMBERS:
            yard.raise_leg(leg, LIFT * yard.spec.wheel.radius)
            yard.run([JointMove(leg=leg, waypoints=_there_and_back(yard, leg))])
            yard.put_down(leg)
    finally:
        yard.close()
    return executive.felt, CONTROL_PERIOD * executive.ticks


def _there_and_back(yard: SagYard, leg: int) -> np.ndarray:
    """Way-points of a raised step to one side, to the other, and back to where the leg hangs, shape (k, dof) [rad]."""
    spec, hung = yard.spec, yard.axles[leg]
    azimuth = spec.hip_azimuths[leg]
    side, up = SIDE * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]), np.array([0.0, 0.0, RAISED])
    places = hung + np.array([up, side + up, side, side + up, -side + up, -side, -side + up, up, np.zeros(3)])
    q, reached = leg_ik(spec, leg, places)
    if not reached.all():
        raise StanceRefusedError(f"leg {leg + 1} does not reach {np.round(places[int(np.argmin(reached))], 2)} in hex")
    return np.asarray(q)
