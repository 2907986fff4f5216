"""Kalman filter of where the chassis is: leg kinematics predict, inertial attitude and the map correct (filterpy).

State: the error of the believed chassis pose, turn (3) [rad] and shift (3) [m] in world, about the chassis. The nominal
pose is the wheel fit's (`localise.fit_wheels`), so after each correction the state is zero again and only its covariance
lives on. Between two sets of pictures the planted wheels carry the pose: the error grows by the covariance of that
fit over wheels whose believed place under sag is only so sure, and by what a newly planted wheel adds. Two measurements:
inertial roll and pitch, and the alignment of new depth to the map, whose information says which directions the ground's
shape shows; cameras that are mounted askew bound what it can be worth.

A slip shows as an alignment that the covariance calls impossible while the fit's own gates hold: the error is then opened
to the slip's size and the map decides. Two that disagree in a row are no slip but a bad map, and are let through the same
way: the filter cannot lock itself out.

Measured on the same looks as in `icp.py`: mean error 0.7 cm (SDM-B) and 1.0 cm (T12), at most 0.9 and 1.9 cm; the alignment
taken as it is, 0.9 and 1.0 cm, at most 1.2 and 2.3 cm; wheels alone, 1.4 and 2.4 cm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from filterpy.kalman import KalmanFilter
from scipy.stats import chi2

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import PerLegFlag, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from planner.perception.localise import Alignment


@dataclass(frozen=True, kw_only=True)
class PoseFilterConfig:
    """What each source is worth."""

    wheel_sigma: float = 0.012
    """of a planted wheel's place against its anchor, from one set of pictures to the next: sag, wind-up, creep [m]"""
    tilt_sigma: float = 0.004
    """of measured roll and pitch, bias included [rad]"""
    mount_shift: float = 0.002
    """of an alignment, from mountings that stay unknown [m]"""
    mount_turn: float = 0.0007
    """[rad]"""
    slip_shift: float = 0.10
    """one sigma after a slip [m]"""
    slip_turn: float = 0.02
    """[rad]"""
    drive_shift: float = 0.03
    """one sigma after a metre on wheels, which roll and creep other than commanded; the twin's: see README [m]"""
    drive_turn: float = 0.005
    """of its yaw [rad]"""
    gate: float = 0.999
    """share of honest alignments that pass the gate"""

    def __post_init__(self) -> None:
        for name in ("wheel_sigma", "tilt_sigma", "mount_shift", "mount_turn", "slip_shift", "slip_turn", "drive_shift", "drive_turn"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be positive")
        if not 0.5 <= self.gate < 1.0:
            raise ConfigError(f"gate is {self.gate}, must be within 0.5 to 1")


class PoseFilter:
    """The error of the believed chassis pose, from one set of pictures to the next."""

    def __init__(self, *, config: PoseFilterConfig) -> None:
        self._config = config
        self._filter = KalmanFilter(dim_x=6, dim_z=6)
        # The first pose defines the world: only its tilt is a measurement.
        self._filter.P = np.diag([config.tilt_sigma**2] * 2 + [1e-10] + [1e-10] * 3)
        self.slips = 0
        """alignments that the covariance called impossible"""

    @property
    def covariance(self) -> np.ndarray:
        """Of turn and shift of the chassis in world, shape (6, 6)."""
        return np.array(self._filter.P)

    def moved(self, contacts_in_world: Wheels, hex_in_world: Vec3, *, planted: PerLegFlag, fit_rmse: float) -> None:
        """The robot moved since the last pictures; its wheels carried the pose.

        Args:
            contacts_in_world: of the wheels, shape (6, 3) [m].
            hex_in_world: the chassis' origin [m].
            planted: which wheels stand.
            fit_rmse: of the wheel fit: wheels that disagree are worth less [m].
        """
        sigma = max(self._config.wheel_sigma, fit_rmse)
        information = np.diag([1.0 / self._config.tilt_sigma**2] * 2 + [0.0] * 4)
        for arm in contacts_in_world[planted] - hex_in_world:
            # A turn about the chassis moves a wheel by turn x arm.
            jacobian = np.hstack([-_skew(arm), np.eye(3)])
            information += jacobian.T @ jacobian / sigma**2
        self._filter.x = np.zeros((6, 1))
        self._filter.predict(F=np.eye(6), Q=np.linalg.inv(information + 1e-9 * np.eye(6)))

    def drove(self, length: float) -> None:
        """The robot drove so far [m]: place and yaw are as sure as its wheels roll."""
        c = self._config
        self._filter.P = self._filter.P + np.diag([0.0, 0.0, (length * c.drive_turn) ** 2] + [(length * c.drive_shift) ** 2] * 3)

    def attitude(self, believed: SE3, measured_rpy: Vec3) -> None:
        """Take in the measured roll and pitch; the yaw drifts and is ignored [rad]."""
        up_in_hex = SE3.from_rpy(float(measured_rpy[0]), float(measured_rpy[1]), 0.0).rotation[2]
        up = believed.rotation @ up_in_hex
        # The turn that brings the measured up back to the world's: up x z.
        z = np.array([[up[1]], [-up[0]]])
        h = np.eye(2, 6)
        self._filter.update(z, R=self._config.tilt_sigma**2 * np.eye(2), H=h)

    def aligned(self, alignment: Alignment, hex_in_world: Vec3) -> SE3:
        """The correction `world_from_believed` after an alignment; what wheels and attitude say when it was refused."""
        if alignment.accepted:
            z, r = self._measurement(alignment, hex_in_world)
            innovation = z - self._filter.x
            spread = self._filter.P + r
            surprise = float((innovation.T @ np.linalg.solve(spread, innovation))[0, 0])
            if surprise > chi2.ppf(self._config.gate, 6):
                self.slips += 1
                slip = [self._config.slip_turn**2] * 3 + [self._config.slip_shift**2] * 3
                self._filter.P = self._filter.P + np.diag(slip)
            self._filter.update(z, R=r, H=np.eye(6))
        return self.correction(hex_in_world)

    def correction(self, hex_in_world: Vec3) -> SE3:
        """`world_from_believed` as now estimated; the state is zero afterwards, the caller applies it."""
        turn, shift = self._filter.x[:3, 0].copy(), self._filter.x[3:, 0].copy()
        self._filter.x = np.zeros((6, 1))
        about = SE3.from_rotvec(turn)
        return SE3(about.rotation, hex_in_world + shift - about.rotation @ hex_in_world)

    def _measurement(self, alignment: Alignment, hex_in_world: Vec3) -> tuple[np.ndarray, np.ndarray]:
        """Turn and shift of the chassis that the map asks for (6, 1), and their covariance (6, 6)."""
        moved = alignment.correction.apply(hex_in_world) - hex_in_world
        z = np.concatenate([alignment.correction.rotvec(), moved])[:, None]
        # Directions without information keep a variance of metres: they are no measurement.
        about_middle = np.linalg.inv(alignment.information + np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]))
        carry = np.eye(6)
        carry[3:, :3] = -_skew(hex_in_world - alignment.middle)
        floor = np.diag([self._config.mount_turn**2] * 3 + [self._config.mount_shift**2] * 3)
        return z, carry @ about_middle @ carry.T + floor


def _skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
