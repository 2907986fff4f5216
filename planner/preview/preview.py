"""What a command sequence will do, as the operator sees it before it is sent: the robot over time, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Joints, Wheels
from athlete_twin.geometry.se3 import SE3

FAULTS: Mapping[str, str] = {
    "wrong_robot": "the sequence is for another robot",
    "bad_command": "no robot of this kind does that",
    "joint_limit": "a joint beyond its range, or a wheel beyond reach",
    "self_collision": "two parts of the robot nearer than they may be",
    "terrain_collision": "a part, or a wheel on its way through the air, in the ground",
    "tip_over": "the centre of mass beside the wheels that stand",
    "tilt": "the chassis more inclined than the sequence allows",
    "torque": "a joint asked for more torque than the sequence allows",
    "dragging": "a leg led as if it were free whose wheel stands",
    "contact_not_broken": "a lift-off that leaves the wheel on the ground",
    "no_contact": "a guarded descent that meets no ground",
}
"""codes of what a preview finds, and what they mean"""


@dataclass(frozen=True, kw_only=True)
class PreviewFault:
    """Something that will go wrong, with the figure and its limit."""

    code: str
    """one of `FAULTS`"""
    command_index: int
    """of the command in which it happens, -1 where it concerns the whole sequence"""
    t: float
    """after the sequence begins [s]"""
    leg: int
    """index 0 to 5, -1 where it concerns no leg"""
    text: str
    """one line: what, how much, and how much is allowed"""


@dataclass(frozen=True, eq=False, kw_only=True)
class PreviewMoment:
    """The robot at one time of a preview."""

    t: float
    joints: Joints
    """behind the wind-up, shape (6, dof) [rad]"""
    world_from_hex: SE3
    wheels_in_world: Wheels
    """axles, shape (6, 3) [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Preview:
    """The robot over the time of a sequence, from the last known state, as believed."""

    times: Float[np.ndarray, " n"]
    """after the sequence begins, rising, from 0 [s]"""
    joints: Float[np.ndarray, "n 6 dof"]
    """behind the wind-up [rad]"""
    world_from_hex: tuple[SE3, ...]
    wheels_in_world: Float[np.ndarray, "n 6 3"]
    """axles [m]"""
    margins: Float[np.ndarray, " n"]
    """of the centre of mass to the border of the wheels that stand [m]"""
    torque_fractions: Float[np.ndarray, " n"]
    """largest joint torque over its limit"""
    begins: tuple[float, ...]
    """when each command begins, as far as the sequence runs [s]"""
    faults: tuple[PreviewFault, ...]
    """in the order in which they happen"""

    def __post_init__(self) -> None:
        n = len(self.times)
        rows = ("joints", "world_from_hex", "wheels_in_world", "margins", "torque_fractions")
        lengths = {name: len(getattr(self, name)) for name in rows}
        if n == 0 or any(length != n for length in lengths.values()):
            raise PlanningError(f"a preview of {n} times has {lengths}")

    @property
    def duration(self) -> float:
        """Until the sequence is completed, or would stop [s]."""
        return float(self.times[-1])

    def at(self, t: float) -> PreviewMoment:
        """The robot at a time, held at both ends; between samples it moves evenly [s]."""
        if not np.isfinite(t):
            raise PlanningError(f"time of a preview is {t} s, must be finite; it runs from 0 to {self.duration:.1f} s")
        t = float(np.clip(t, 0.0, self.duration))
        k = int(np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 1))
        if k == len(self.times) - 1 or self.times[k + 1] <= self.times[k]:
            return PreviewMoment(
                t=t, joints=self.joints[k].copy(), world_from_hex=self.world_from_hex[k], wheels_in_world=self.wheels_in_world[k].copy()
            )
        share = float((t - self.times[k]) / (self.times[k + 1] - self.times[k]))
        return PreviewMoment(
            t=t,
            joints=(1.0 - share) * self.joints[k] + share * self.joints[k + 1],
            world_from_hex=between(self.world_from_hex[k], self.world_from_hex[k + 1], share),
            wheels_in_world=(1.0 - share) * self.wheels_in_world[k] + share * self.wheels_in_world[k + 1],
        )


def between(first: SE3, second: SE3, share: float) -> SE3:
    """The pose so much of the way from one to another, 0 to 1."""
    if share <= 0.0:
        return first
    if share >= 1.0:
        return second
    turn = Slerp([0.0, 1.0], Rotation.from_matrix([first.rotation, second.rotation]))
    return SE3(turn(share).as_matrix(), (1.0 - share) * first.translation + share * second.translation)
