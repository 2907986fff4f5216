"""Joints of the truth: a motor behind a stiff gear, a spring between gear and link, limits of rate and torque.

The motor follows its command at the rate limit and is not driven back by the load (worm-like gears, brakes). Between
motor and link a series spring winds up: torque = k (motor - link) - c link_rate, which is also how the robot reads its
torque. At the torque limit the motor gives way, so the limit is never passed for longer than a tick.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.arrays import Joints
from athlete_twin.physics.truth import Truth


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
        self._slack = self.limits / self.stiffness

    def step(self, links: Joints, link_rates: Joints, commands: Joints, rate_limits: Joints, dt: float) -> Joints:
        """Torques on the links [N m]; moves the motors towards their commands by at most `rate_limits * dt`."""
        step = rate_limits * dt
        self.motors += np.clip(commands - self.motors, -step, step)
        np.clip(self.motors, links - self._slack, links + self._slack, out=self.motors)
        torques = self.stiffness * (self.motors - links) - self.damping * link_rates
        return np.asarray(np.clip(torques, -self.limits, self.limits))

    def state(self) -> dict[str, np.ndarray]:
        """Copies of all that changes from tick to tick, for `set_state`."""
        return {
            "motors": self.motors.copy(),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Back to what `state` gave."""
        self.motors = state["motors"].copy()

    def torques(self, links: Joints) -> Joints:
        """Torque carried by the springs [N m]."""
        return np.asarray(self.stiffness * (self.motors - links))
