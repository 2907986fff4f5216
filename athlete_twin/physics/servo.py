"""Joints of the truth: a motor behind a stiff gear, a spring between gear and link, friction, brakes, limits.

The motor follows its command at the rate limit. Its gear cannot be driven back: at the torque limit the motor stalls,
and when it stands its brake holds. Between motor and link a series spring winds up, k (motor - slipped - link), which is
also how the robot reads its torque: from encoders before and after the spring. Bearings and gear rub with a Dahl
friction, which the spring does not show: what is measured under load differs by it from what the load asks.

What gives way above the limit differs. SDM-B's gear ratchets ([SunSpiral2012] s7.1): a tooth slips, the link jumps by it
and the encoders disagree from then on, so that the measured torque is off by k times a tooth. T12's does not: its brake
slips, and both encoders follow.
"""

from __future__ import annotations

import math
from typing import no_type_check

import numba
import numpy as np

from athlete_twin.geometry.arrays import Joints
from athlete_twin.physics.truth import Truth

RUBBING_STROKE = 2e-3
"""over which the friction builds up when the direction turns [rad]"""


class Servos:
    """All leg joints of one robot. Arrays are (6, dof)."""

    def __init__(self, truth: Truth, torque_limits: np.ndarray, inertias: Joints, start: Joints) -> None:
        self.stiffness = np.broadcast_to(truth.joint_stiffness, start.shape).copy()
        """[N m/rad]"""
        self.damping = 2.0 * truth.joint_damping_ratio * np.sqrt(self.stiffness * inertias)
        """[N m s/rad]"""
        self.limits = np.broadcast_to(torque_limits, start.shape).copy()
        """[N m]"""
        self.motors = start.copy()
        """motor angles, referred to the joint [rad]"""
        self.slipped = np.zeros(start.shape)
        """by ratcheting, motor less gear [rad]"""
        self.stuck = np.zeros(start.shape, dtype=bool)
        """joints whose motor does not turn any more"""
        self._holding = truth.joint_holding
        self._ratchet = truth.joint_ratchet
        self._tooth = truth.joint_tooth
        self._friction = truth.joint_friction * self.limits
        self._rubbed = np.zeros(start.shape)

    def step(self, links: Joints, link_rates: Joints, commands: Joints, rate_limits: Joints, dt: float) -> Joints:
        """Torques on the links [N m]; moves the motors towards their commands by at most `rate_limits * dt`."""
        torques: Joints = _servo_kernel(
            links, link_rates, commands, rate_limits, dt, self.motors, self.slipped, self._rubbed, self.stuck, self.stiffness,
            self.damping, self.limits, self._friction, self._holding, self._ratchet, self._tooth,
        )  # fmt: skip
        return torques

    def state(self) -> dict[str, np.ndarray]:
        """Copies of all that changes from tick to tick, for `set_state`."""
        names = ("motors", "slipped", "stuck", "_rubbed")
        return {name: getattr(self, name).copy() for name in names}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Back to what `state` gave."""
        for name, value in state.items():
            setattr(self, name, value.copy())

    def torques(self, links: Joints) -> Joints:
        """Torque carried by the springs [N m]."""
        return np.asarray(self.stiffness * (self.motors - self.slipped - links))


@no_type_check
@numba.njit(cache=True)
def _servo_kernel(  # type: ignore[no-untyped-def]
    links, link_rates, commands, rate_limits, dt, motors, slipped, rubbed, stuck, stiffness, damping, limits, friction,
    holding, ratchet, tooth,
):  # fmt: skip
    """One tick of all joints, each by itself: changes `motors`, `slipped` and `rubbed`; the torques on the links [N m]."""
    torques = np.empty(links.shape)
    for i in np.ndindex(links.shape):
        slack = limits[i] / stiffness[i]
        unloaded = links[i] + slipped[i]
        step = 0.0 if stuck[i] else rate_limits[i] * dt
        wanted = motors[i] + min(max(commands[i] - motors[i], -step), step)
        # At the limit the motor stalls: it goes no farther into the load, nor is it driven back.
        motor = min(max(wanted, min(motors[i], unloaded - slack)), max(motors[i], unloaded + slack))
        if ratchet > 0.0:
            torque = stiffness[i] * (motor - unloaded)
            teeth = math.ceil((abs(torque) - ratchet * limits[i]) / (stiffness[i] * tooth))
            slipped[i] += math.copysign(max(teeth, 0) * tooth, torque)
        else:
            motor = min(max(motor, unloaded - holding * slack), unloaded + holding * slack)
        motors[i] = motor
        rubbed[i] = min(max(rubbed[i] + link_rates[i] * dt, -RUBBING_STROKE), RUBBING_STROKE)
        spring = stiffness[i] * (motor - slipped[i] - links[i])
        torques[i] = spring - damping[i] * link_rates[i] - friction[i] * (rubbed[i] / RUBBING_STROKE)
    return torques
