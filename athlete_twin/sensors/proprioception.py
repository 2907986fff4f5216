"""What the robot feels of itself: encoders on both sides of each joint's spring, inertial attitude, rates, acceleration.

Torque is not measured but read from the spring: motor angle less joint angle, times the stiffness, which the robot was
calibrated for: exactly, since no source says how well it was. So an encoder's zero error is an error of angle and, where
its two encoders disagree, of torque.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Joints, LegJoints, Vec3
from athlete_twin.geometry.se3 import SE3

SECONDS_AN_HOUR = 3600.0


@dataclass(frozen=True, kw_only=True)
class ProprioceptionNoise:
    """One sigma of each kind of noise. Defaults are the estimates of `truth.toml`."""

    encoder_bits: int = 16
    """steps a turn are two to this power"""
    attitude: float = float(np.deg2rad(0.05))
    """roll and pitch, a reading [rad]"""
    yaw_drift: float = float(np.deg2rad(0.5))
    """random walk [rad/sqrt(h)]"""
    rate: float = 0.0005
    """[rad/s]"""
    acceleration: float = 0.01
    """[m/s2]"""

    def __post_init__(self) -> None:
        if not 8 <= self.encoder_bits <= 32:
            raise ConfigError(f"encoder_bits is {self.encoder_bits}, must be 8 to 32")
        for name in ("attitude", "yaw_drift", "rate", "acceleration"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise ConfigError(f"noise {name} is {value}, must be 0 or more")


@dataclass(frozen=True, eq=False, kw_only=True)
class Measurement:
    """The measured fields of a `Telemetry`, under the same names."""

    joints: Joints
    """[rad]"""
    motors: Joints
    """[rad]"""
    torques: Joints
    """[N m]"""
    attitude_rpy: Vec3
    """[rad]"""
    rates: Vec3
    """[rad/s]"""
    acceleration: Vec3
    """[m/s2]"""

    def fields(self) -> dict[str, np.ndarray]:
        """The same as keyword arguments of a `Telemetry`."""
        return {k: getattr(self, k) for k in ("joints", "motors", "torques", "attitude_rpy", "rates", "acceleration")}


class Proprioception:
    """The sensors of one robot in one trial. Holds the yaw drift, which grows from reading to reading."""

    def __init__(self, *, seed: int, encoder_zero: Joints, noise: ProprioceptionNoise | None = None) -> None:
        """Calibrates nothing: the zero errors stay for the whole trial.

        Args:
            seed: of the trial, keys the noise.
            encoder_zero: what the joint encoders read too much, shape (6, dof) [rad].
            noise: levels; the defaults' by default.
        """
        self._seed = seed
        self._zero = np.array(encoder_zero, dtype=float)
        self._noise = ProprioceptionNoise() if noise is None else noise
        self.encoder_bias = np.zeros_like(self._zero)
        """what the encoders after the spring read too much besides, by a fault, shape (6, dof) [rad]"""
        self.torque_offset = np.zeros_like(self._zero)
        """what the torque readings are off by, by a fault [N m]"""
        self._yaw_error = 0.0
        self._drifted_until = 0.0

    def measure(
        self,
        joints: Joints,
        motors: Joints,
        *,
        stiffness: LegJoints,
        world_from_hex: SE3,
        rates_in_hex: Vec3,
        acceleration_in_hex: Vec3,
        t: float,
        index: int,
    ) -> Measurement:
        """One reading.

        Args:
            joints: true angles after the wind-up, shape (6, dof) [rad].
            motors: true angles before it [rad].
            stiffness: of one leg's joint springs [N m/rad].
            world_from_hex: true pose; its yaw at the start is taken as zero by the inertial unit.
            rates_in_hex: true angular velocity [rad/s].
            acceleration_in_hex: true specific force, about (0, 0, 9.81) at rest [m/s2].
            t: mission time; readings come in its order [s].
            index: counts the readings of a trial; keys the noise.
        """
        rng = np.random.default_rng([self._seed, zlib.crc32(b"proprioception"), index])
        measured_joints = self._encode(joints + self._zero + self.encoder_bias)
        # The relative encoder is zeroed against the absolute one at rest, so both carry the same error.
        measured_motors = self._encode(motors + self._zero)
        n = self._noise
        torques = (measured_motors - measured_joints) * stiffness + self.torque_offset
        rng.standard_normal(joints.shape)  # of no use, but what is drawn next stays what recorded trials had
        roll, pitch, yaw = world_from_hex.rpy()
        self._drift(t)
        tilt = n.attitude * rng.standard_normal(2)
        return Measurement(
            joints=measured_joints,
            motors=measured_motors,
            torques=torques,
            attitude_rpy=np.array([roll + tilt[0], pitch + tilt[1], yaw + self._yaw_error]),
            rates=rates_in_hex + n.rate * rng.standard_normal(3),
            acceleration=acceleration_in_hex + n.acceleration * rng.standard_normal(3),
        )

    def _encode(self, angles: Joints) -> Joints:
        step = 2.0 * np.pi / 2**self._noise.encoder_bits
        return np.asarray(np.rint(angles / step) * step)

    def _drift(self, t: float) -> None:
        """Let the yaw error walk to time `t`, a step a whole second, so that reading more often changes nothing."""
        for second in range(int(self._drifted_until), int(t)):
            step = np.random.default_rng([self._seed, zlib.crc32(b"yaw_drift"), second]).standard_normal()
            self._yaw_error += self._noise.yaw_drift / np.sqrt(SECONDS_AN_HOUR) * float(step)
        self._drifted_until = max(self._drifted_until, float(int(t)))
