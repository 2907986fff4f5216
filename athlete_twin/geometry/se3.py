"""Rigid transforms and the frames of this project.

Frames (a transform is named `world_from_hex`: it takes what is expressed in `hex` to `world`):

- `world`: z up, origin on the ground below the place where the trial starts, x towards the goal.
- `hex`: the chassis; x forward, y left, z up. Origin in the centre of SDM-B's ring top plane; on T12 in the centre of
  the hip-yaw plane.
- `leg1`..`leg6`: on the hip-yaw axis, x outward along the leg's azimuth, z up.
- `wheel1`..`wheel6`: centre of the axle, y along the axle, x along the last link (towards the ground when it hangs).
- `contact1`..: the tyre's patch, z along the ground's normal.
- `camera_*`: x right, y down, z forward along the boresight; the left eye of a pair.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.arrays import AnyPoints3, Mat3, Mat4, Vec3

ORTHONORMAL_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class SE3:
    """A rigid transform: `p_out = rotation @ p_in + translation`."""

    rotation: Mat3
    """Orthonormal, right-handed."""
    translation: Vec3
    """[m]"""

    def __post_init__(self) -> None:
        r = np.array(self.rotation, dtype=float)
        t = np.array(self.translation, dtype=float)
        if r.shape != (3, 3) or t.shape != (3,):
            raise KinematicsError(f"a transform needs shapes (3, 3) and (3,), got {r.shape} and {t.shape}")
        a, b, c, d, e, f, g, h, i = r.ravel().tolist()
        if not math.isfinite(a + b + c + d + e + f + g + h + i + sum(t.tolist())):
            raise KinematicsError("a transform must be finite")
        # Written out: a transform is made in some microseconds, at every control tick.
        squares = (a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i)
        products = (a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i)
        if max(abs(max(squares) - 1.0), abs(min(squares) - 1.0), *map(abs, products)) > ORTHONORMAL_TOLERANCE:
            raise KinematicsError("the rotation of a transform must be orthonormal within 1e-6")
        r.setflags(write=False)
        t.setflags(write=False)
        object.__setattr__(self, "rotation", r)
        object.__setattr__(self, "translation", t)

    @staticmethod
    def identity() -> SE3:
        """The transform that changes nothing."""
        return SE3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_translation(translation: Vec3) -> SE3:
        """A pure shift [m]."""
        return SE3(np.eye(3), translation)

    @staticmethod
    def from_rpy(roll: float, pitch: float, yaw: float, translation: Vec3 | None = None) -> SE3:
        """URDF's roll, pitch, yaw about the fixed x, y, z axes [rad], then a shift [m]."""
        rotation = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
        return SE3(rotation, np.zeros(3) if translation is None else translation)

    @staticmethod
    def from_rotvec(rotvec: Vec3, translation: Vec3 | None = None) -> SE3:
        """Rotation by `|rotvec|` [rad] about `rotvec`, then a shift [m]."""
        return SE3(Rotation.from_rotvec(rotvec).as_matrix(), np.zeros(3) if translation is None else translation)

    @staticmethod
    def from_quaternion(xyzw: Sequence[float] | np.ndarray, translation: Sequence[float] | Vec3) -> SE3:
        """From Bullet's and SciPy's quaternion order; sequences will do, Bullet hands out tuples."""
        return SE3(Rotation.from_quat(np.asarray(xyzw, dtype=float)).as_matrix(), np.asarray(translation, dtype=float))

    @staticmethod
    def from_matrix(matrix: Mat4) -> SE3:
        """From a homogeneous 4x4 matrix."""
        m = np.asarray(matrix, dtype=float)
        return SE3(m[:3, :3], m[:3, 3])

    def matrix(self) -> Mat4:
        """Homogeneous 4x4 matrix."""
        m = np.eye(4)
        m[:3, :3] = self.rotation
        m[:3, 3] = self.translation
        return m

    def quaternion_xyzw(self) -> np.ndarray:
        """Unit quaternion in Bullet's and SciPy's order."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_quat())

    def rpy(self) -> Vec3:
        """Roll, pitch, yaw about the fixed axes [rad]. Written out: an inertial unit reads it at every control tick."""
        r = self.rotation
        return np.array([np.arctan2(r[2, 1], r[2, 2]), np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0])), np.arctan2(r[1, 0], r[0, 0])])

    def rotvec(self) -> Vec3:
        """Rotation vector [rad]."""
        return np.asarray(Rotation.from_matrix(self.rotation).as_rotvec())

    def inverse(self) -> SE3:
        """The transform back."""
        return SE3(self.rotation.T, -self.rotation.T @ self.translation)

    def compose(self, other: SE3) -> SE3:
        """`a_from_b.compose(b_from_c)` is `a_from_c`."""
        return SE3(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    def apply(self, points: AnyPoints3) -> AnyPoints3:
        """Points, any leading shape, taken to the outer frame [m]."""
        return np.asarray(np.asarray(points) @ self.rotation.T + self.translation)

    def rotate(self, vectors: AnyPoints3) -> AnyPoints3:
        """Directions or forces taken to the outer frame, without the shift."""
        return np.asarray(np.asarray(vectors) @ self.rotation.T)
