"""What the ground believes of the robot itself: its pose, where its wheels stand, what they carry. From telemetry alone.

A planted wheel is an anchor. Its contact point is remembered in the world; its axle stands a wheel's radius above it,
less what the tyre gives way under the load it is believed to carry: the joints are read behind their wind-up, so the
tyre's own constant counts here, not the leg's. All anchors and the measured roll and pitch fix
the chassis (`localise.fit_wheels`); a wheel that comes down gets its anchor from the pose that the others fix. The start
defines the world: hex above its origin, heading along x, z zero at the mean height of the first six contacts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.geometry.arrays import Joints, LegJoints, PerLeg, PerLegFlag, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import Telemetry
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS
from athlete_twin.model.statics import stance_loads
from planner.perception.localise import WheelFitConfig, fit_wheels
from planner.sag.leg_compliance import series_stiffness
from planner.sag.sag_model import AIRBORNE, FootSprings, SagSolution, solve_sag


@dataclass(frozen=True, eq=False, kw_only=True)
class Belief:
    """The robot as believed at one time."""

    t: float
    joints: Joints
    """after the wind-up, shape (6, dof) [rad]"""
    motors: Joints
    """what was commanded, shape (6, dof) [rad]"""
    world_from_hex: SE3
    contacts_in_world: Wheels
    """of the planted wheels, shape (6, 3); of a wheel in the air its last one [m]"""
    planted: PerLegFlag
    loads: PerLeg
    """vertical, from the contact springs, shape (6,) [N]"""
    interaction: Wheels
    """forces of the ground on the wheels beyond the zero-interaction ones: legs that work against each other, from the
    measured torques, in hex, shape (6, 3) [N]; zero unless all wheels stand"""
    forces: Wheels
    """of the ground on the wheels by the measured torques, in hex, shape (6, 3) [N]"""
    joint_stiffness: LegJoints
    """of the joints of a leg, from torques and wind-up, shape (dof,); infinite where none shows [N m/rad]"""
    fit_rmse: float
    """how well wheels and pose agree [m]"""

    def gravity_in_hex(self) -> Vec3:
        """Gravity as the chassis stands [m/s2]."""
        return np.asarray(self.world_from_hex.rotation.T @ np.array([0.0, 0.0, -GRAVITY]))


class BeliefFilter:
    """Keeps the anchors; turns each telemetry into a `Belief`."""

    def __init__(self, kinematics: Kinematics, springs: FootSprings, *, payload_kg: float, config: WheelFitConfig) -> None:
        self._kin, self._springs, self._payload, self._config = kinematics, springs, payload_kg, config
        self._weight = (kinematics.spec.mass + payload_kg) * GRAVITY
        self._contacts: Wheels | None = None
        self._planted = np.ones(LEGS, dtype=bool)
        self._unanchored = np.zeros(LEGS, dtype=bool)
        """wheels that came down since the last telemetry: where is not known yet, and their contact is still the one before"""
        self._sink, self._sink_variance = config.sink, config.sink_sigma**2

    @property
    def planted(self) -> PerLegFlag:
        """Wheels believed on the ground, shape (6,)."""
        return self._planted.copy()

    def lift(self, leg: int) -> None:
        """A leg was lifted: its wheel no longer anchors the robot."""
        self._planted[leg] = self._unanchored[leg] = False

    def land(self, leg: int) -> None:
        """A leg came down: the next telemetry gives its wheel an anchor."""
        if not self._planted[leg]:
            self._planted[leg] = self._unanchored[leg] = True

    def rolled(self, contacts_in_world: Wheels) -> None:
        """The robot drove, its posture kept: every wheel stands elsewhere, as commanded [m]."""
        self._contacts = np.array(contacts_in_world, dtype=float)

    def settle(self, by: float, *, sigma: float) -> float:
        """Pictures say that the wheels stand so much deeper than believed; by how much they now are believed to [m].

        What a tyre gives way more than believed, and what soil does, cannot be felt; the ground beside the wheels shows it
        (`terrain.ground_level`). Axles, and with them the chassis, are lower by what comes back; contacts stay what they
        are: the ground's surface under the wheels.

        Args:
            by: seen [m].
            sigma: of what was seen [m].
        """
        gain = self._sink_variance / (self._sink_variance + sigma**2)
        self._sink += gain * by
        self._sink_variance *= 1.0 - gain
        return gain * by

    def shift_world(self, correction: SE3) -> None:
        """The map says that robot and anchors are elsewhere: `world_from_believed`."""
        if self._contacts is not None:
            self._contacts = correction.apply(self._contacts)

    def update(self, telemetry: Telemetry) -> Belief:
        """The robot as it was when the telemetry was taken."""
        wheels = self._kin.wheels_in_hex(telemetry.joints)
        tilt = SE3.from_rpy(float(telemetry.attitude_rpy[0]), float(telemetry.attitude_rpy[1]), 0.0)
        gravity = tilt.rotation.T @ np.array([0.0, 0.0, -GRAVITY])
        standing = self._planted & ~self._unanchored
        loads = self._loads(telemetry.joints, gravity, self._planted)
        drop = self._kin.spec.wheel.radius - loads / self._kin.spec.believed_tyre_stiffness - self._sink
        if self._contacts is None:
            level = tilt.apply(wheels)
            height = -float(np.mean(level[:, 2] - drop))
            world_from_hex = SE3(tilt.rotation, np.array([0.0, 0.0, height]))
            self._contacts = world_from_hex.apply(wheels) - drop[:, None] * np.array([0.0, 0.0, 1.0])
            rmse = 0.0
        else:
            anchors = self._contacts + drop[:, None] * np.array([0.0, 0.0, 1.0])
            fit = fit_wheels(
                wheels, anchors, planted=standing, attitude_rpy=telemetry.attitude_rpy, config=self._config
            )
            world_from_hex, rmse = fit.world_from_hex, fit.rmse
            for leg in np.flatnonzero(self._planted & ~standing):
                self._contacts[leg] = world_from_hex.apply(wheels[leg]) - np.array([0.0, 0.0, drop[leg]])
        self._unanchored[:] = False
        forces = np.array(
            [self._kin.ground_force(leg, telemetry.joints, telemetry.torques[leg], gravity) for leg in range(LEGS)]
        )
        return Belief(
            t=telemetry.t,
            joints=telemetry.joints.copy(),
            motors=telemetry.motors.copy(),
            world_from_hex=world_from_hex,
            contacts_in_world=self._contacts.copy(),
            planted=self._planted.copy(),
            loads=loads,
            interaction=self._interaction(telemetry, forces, gravity),
            forces=forces,
            joint_stiffness=series_stiffness(telemetry.torques, telemetry.motors - telemetry.joints),
            fit_rmse=rmse,
        )

    def _interaction(self, telemetry: Telemetry, forces: Wheels, gravity: Vec3) -> Wheels:
        if not self._planted.all():
            return np.zeros((LEGS, 3))
        ideal, _ = stance_loads(
            self._kin, telemetry.joints, supporting=self._planted, gravity_in_hex=gravity, payload_kg=self._payload
        )
        return np.asarray(forces - ideal)

    def _loads(self, joints: Joints, gravity: Vec3, planted: PerLegFlag) -> PerLeg:
        """By the contact springs; by rigid balance where these hold no such stance, as when a wheel is believed down too early."""
        solution = self.stance(joints, gravity, planted)
        up = -gravity / GRAVITY
        if solution.converged:
            return np.asarray(np.maximum(solution.forces @ up, 0.0))
        rigid, _ = stance_loads(self._kin, joints, supporting=planted, gravity_in_hex=gravity, payload_kg=self._payload)
        return np.asarray(np.maximum(rigid @ up, 0.0))

    def stance(self, joints: Joints, gravity: Vec3, planted: PerLegFlag) -> SagSolution:
        """The contact-spring solution of a stance whose planted wheels all just touch when unsagged."""
        return solve_sag(
            self._kin.wheels_in_hex(joints),
            self._kin.com_in_hex(joints, self._payload),
            self._weight,
            stiffness_z=self._springs.stiffness_z,
            lateral_ratio=self._springs.lateral_ratio,
            lifts=np.where(planted, 0.0, AIRBORNE),
            gravity_in_hex=gravity,
        )
