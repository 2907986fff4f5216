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
        self._slack = self.limits / self.stiffness
        self._holding = truth.joint_holding * self._slack
        self._ratchets = truth.joint_ratchet > 0.0
        self._ratchet = truth.joint_ratchet * self.limits
        self._tooth = truth.joint_tooth
        self._friction = truth.joint_friction * self.limits
        self._rubbed = np.zeros(start.shape)

    def step(self, links: Joints, link_rates: Joints, commands: Joints, rate_limits: Joints, dt: float) -> Joints:
        """Torques on the links [N m]; moves the motors towards their commands by at most `rate_limits * dt`."""
        step = rate_limits * dt
        step[self.stuck] = 0.0
        unloaded = links + self.slipped
        wanted = self.motors + np.clip(commands - self.motors, -step, step)
        # At the limit the motor stalls: it goes no farther into the load, nor is it driven back.
        self.motors = np.clip(
            wanted, np.minimum(self.motors, unloaded - self._slack), np.maximum(self.motors, unloaded + self._slack)
        )
        if self._ratchets:
            self._skip(links)
        else:
            np.clip(self.motors, unloaded - self._holding, unloaded + self._holding, out=self.motors)
        self._rubbed = np.clip(self._rubbed + link_rates * dt, -RUBBING_STROKE, RUBBING_STROKE)
        friction = self._friction * (self._rubbed / RUBBING_STROKE)
        return np.asarray(self.torques(links) - self.damping * link_rates - friction)

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

    def _skip(self, links: Joints) -> None:
        torques = self.torques(links)
        teeth = np.ceil((np.abs(torques) - self._ratchet) / (self.stiffness * self._tooth))
        self.slipped += np.sign(torques) * np.maximum(teeth, 0.0) * self._tooth
