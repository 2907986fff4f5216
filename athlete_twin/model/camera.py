"""Pinhole stereo cameras as drawn: where they sit, on the chassis or on a leg, what they see.

Rectified, so one focal length a pair.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from athlete_twin.errors import CameraError
from athlete_twin.geometry.arrays import Vec3
from athlete_twin.geometry.se3 import SE3

CHASSIS = "hex"


@dataclass(frozen=True, kw_only=True)
class Pinhole:
    """Intrinsics of one rectified eye. Pixel centres lie at whole coordinates."""

    width_px: int
    height_px: int
    focal_px: float
    """same along x and y"""
    cx_px: float
    cy_px: float

    def __post_init__(self) -> None:
        if self.width_px < 8 or self.height_px < 8 or not (np.isfinite(self.focal_px) and self.focal_px > 0.0):
            raise CameraError(
                f"camera of {self.width_px}x{self.height_px} px, focal {self.focal_px} px is not usable; "
                f"needs 8x8 px or more and a positive focal length"
            )
        if not (np.isfinite(self.cx_px) and np.isfinite(self.cy_px)):
            raise CameraError(f"principal point ({self.cx_px}, {self.cy_px}) px is not finite")

    @staticmethod
    def from_fov(width_px: int, height_px: int, hfov: float) -> Pinhole:
        """Centred camera with a horizontal field of view `hfov` [rad]."""
        focal = 0.5 * width_px / np.tan(0.5 * hfov)
        return Pinhole(
            width_px=width_px,
            height_px=height_px,
            focal_px=float(focal),
            cx_px=0.5 * (width_px - 1),
            cy_px=0.5 * (height_px - 1),
        )

    def binned(self, factor: int) -> Pinhole:
        """The camera after `factor` x `factor` pixels were averaged into one."""
        if factor not in (1, 2, 4, 8):
            raise CameraError(f"binning {factor} is not one of 1, 2, 4, 8")
        return Pinhole(
            width_px=self.width_px // factor,
            height_px=self.height_px // factor,
            focal_px=self.focal_px / factor,
            cx_px=(self.cx_px + 0.5) / factor - 0.5,
            cy_px=(self.cy_px + 0.5) / factor - 0.5,
        )

    def rays(self) -> np.ndarray:
        """Directions through all pixels in the camera frame, z = 1, shape (h, w, 3)."""
        u = (np.arange(self.width_px) - self.cx_px) / self.focal_px
        v = (np.arange(self.height_px) - self.cy_px) / self.focal_px
        out = np.empty((self.height_px, self.width_px, 3))
        out[..., 0] = u[None, :]
        out[..., 1] = v[:, None]
        out[..., 2] = 1.0
        return out

    def project(self, points_in_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel coordinates (..., 2) and depth (...) [m] of points (..., 3); only depth > 0 is in front."""
        p = np.asarray(points_in_camera, dtype=float)
        depth = p[..., 2]
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        u = self.focal_px * p[..., 0] / safe + self.cx_px
        v = self.focal_px * p[..., 1] / safe + self.cy_px
        return np.stack([u, v], axis=-1), depth


@dataclass(frozen=True, kw_only=True)
class StereoCamera:
    """One rectified pair as drawn. The right eye is shifted by `baseline` along the left eye's x."""

    name: str
    """such as "hazcam_2": group and number from 1, in the order of the drawings"""
    group: str
    """"navcam", "hazcam" or "toolcam" """
    link_from_camera: SE3
    """pose of the left eye on its link"""
    baseline: float
    """[m]"""
    eye: Pinhole
    link: str = CHASSIS
    """URDF name of the link that carries it"""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.baseline) and self.baseline > 0.0):
            raise CameraError(
                f"baseline of camera {self.name} is {self.baseline} m, must be positive: the right eye sits along the left eye's x"
            )

    @property
    def on_chassis(self) -> bool:
        """Whether it looks from the chassis, not from a leg."""
        return self.link == CHASSIS

    @property
    def hex_from_camera(self) -> SE3:
        """Pose of the left eye on the chassis; a camera that rides on a leg has one only `riding` on it."""
        if self.link != CHASSIS:
            raise CameraError(f"camera {self.name} rides on {self.link}: its place in hex needs the leg's joints")
        return self.link_from_camera

    def riding(self, hex_from_link: Mapping[str, SE3]) -> StereoCamera:
        """This camera as one on the chassis, while the links are where they are."""
        if self.link == CHASSIS:
            return self
        if self.link not in hex_from_link:
            raise CameraError(f"camera {self.name} rides on {self.link}, which is not among the given links")
        return replace(self, link=CHASSIS, link_from_camera=hex_from_link[self.link].compose(self.link_from_camera))

    def hex_from_right(self) -> SE3:
        """Pose of the right eye."""
        return self.hex_from_camera.compose(SE3.from_translation(np.array([self.baseline, 0.0, 0.0])))


def mounted_beside(place: Vec3, tilt: float, baseline: float) -> SE3:
    """`link_from_camera` of the left eye of a pair beside a leg's last link, whose x axis points to the axle.

    Args:
        place: of the pair's centre in the link's frame [m].
        tilt: of the boresight from the link's x axis towards its y axis, to the side where the tool is [rad].
        baseline: distance between the eyes along the link's z axis [m].
    """
    forward = np.array([np.cos(tilt), np.sin(tilt), 0.0])
    right = np.array([0.0, 0.0, 1.0])
    rotation = np.column_stack([right, np.cross(forward, right), forward])
    return SE3(rotation, np.asarray(place, dtype=float) - 0.5 * baseline * right)


def mounted(azimuth: float, radius: float, height: float, look: str, pitch_down: float, baseline: float) -> SE3:
    """`hex_from_camera` of the left eye of a pair centred at a place on the chassis.

    Args:
        azimuth: where the pair's centre sits, about the hex's z axis [rad].
        radius: distance of the centre from the hex's z axis [m].
        height: z of the centre in hex [m].
        look: "outward", away from the chassis' axis, or "inward", across it.
        pitch_down: angle of the boresight below the chassis' plane [rad].
        baseline: distance between the eyes [m]; the left eye sits half of it to the left.
    """
    if look not in ("outward", "inward"):
        raise CameraError(f"look is {look!r}, must be 'outward' or 'inward'")
    heading = azimuth if look == "outward" else azimuth + np.pi
    forward = np.array([np.cos(heading) * np.cos(pitch_down), np.sin(heading) * np.cos(pitch_down), -np.sin(pitch_down)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    down = np.cross(forward, right)
    rotation = np.column_stack([right, down, forward])
    centre = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    return SE3(rotation, centre - 0.5 * baseline * right)
