"""A small analytic ray-caster: textured plane and upright cylinders, so that true depth is known in closed form."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy import ndimage

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import StereoPair, Telemetry
from athlete_twin.model.camera import Pinhole, StereoCamera


@dataclass
class Cylinder:
    x: float
    y: float
    radius: float
    low: float
    high: float


@dataclass
class Scene:
    """A plane z = 0 in the world, with upright cylinders on or above it."""

    cylinders: list[Cylinder] = field(default_factory=list)
    seed: int = 0

    def trace(self, world_from_eye: SE3, eye: Pinhole):
        """True depth, grey image and index of what was hit (0 plane, 1.. cylinders)."""
        rays = world_from_eye.rotate(eye.rays())
        origin = world_from_eye.translation
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(rays[..., 2] < -1e-6, -origin[2] / rays[..., 2], np.inf)
        what = np.zeros(depth.shape, dtype=int)
        for k, c in enumerate(self.cylinders, start=1):
            rel = origin[:2] - np.array([c.x, c.y])
            a = np.sum(rays[..., :2] ** 2, axis=-1)
            b = np.sum(rays[..., :2] * rel, axis=-1)
            disc = b**2 - a * (rel @ rel - c.radius**2)
            t = (-b - np.sqrt(np.maximum(disc, 0.0))) / a
            z = origin[2] + t * rays[..., 2]
            hit = (disc > 0) & (t > 0) & (z > c.low) & (z < c.high) & (t < depth)
            depth, what = np.where(hit, t, depth), np.where(hit, k, what)
            top = (c.high - origin[2]) / rays[..., 2]
            at = origin[:2] + top[..., None] * rays[..., :2]
            hit = (np.hypot(at[..., 0] - c.x, at[..., 1] - c.y) < c.radius) & (top > 0) & (top < depth)
            depth, what = np.where(hit, top, depth), np.where(hit, k, what)
        points = origin + np.where(np.isfinite(depth), depth, 0.0)[..., None] * rays
        return np.where(np.isfinite(depth), depth, np.nan), self._grey(points, what), what

    def _grey(self, points, what):
        noise = np.random.default_rng(self.seed).normal(size=(96, 96, 96))
        grey = np.full(points.shape[:-1], 110.0)
        for size, amplitude in ((0.03, 22.0), (0.08, 18.0)):
            at = np.moveaxis(points / size + 7.3 * what[..., None], -1, 0)
            grey += amplitude * ndimage.map_coordinates(noise, at, order=1, mode="grid-wrap")
        return np.clip(grey, 0, 255)

    def pair(self, camera: StereoCamera, world_from_hex: SE3, *, binning=1, noise=1.5, seed=1) -> StereoPair:
        eye = camera.eye.binned(binning) if binning > 1 else camera.eye
        rng = np.random.default_rng(seed)
        images = []
        for hex_from_eye in (camera.hex_from_camera, camera.hex_from_right()):
            grey = self.trace(world_from_hex.compose(hex_from_eye), eye)[1]
            images.append(np.clip(np.rint(grey + rng.normal(0.0, noise, grey.shape)), 0, 255).astype(np.uint8))
        return StereoPair(
            seq=0, robot_id="test", t=5.0, camera=camera.name, binning=binning,
            left=images[0], right=images[1], exposure=0.01, state=telemetry(),
        )  # fmt: skip


def telemetry() -> Telemetry:
    zero = np.zeros((6, 6))
    return Telemetry(
        seq=0, robot_id="test", t=5.0, joints=zero, motors=zero, torques=zero, attitude_rpy=np.zeros(3),
        rates=np.zeros(3), acceleration=np.array([0.0, 0.0, 9.81]), executive_state="idle", sequence_id=-1,
        command_index=0,
    )  # fmt: skip


def looking(height, pitch_deg, *, baseline=0.15, width=512, rows=384, hfov_deg=70.0, group="hazcam") -> StereoCamera:
    """A camera `height` above the hex origin's plane z = 0, looking along +x and down."""
    p = np.deg2rad(pitch_deg)
    forward = np.array([np.cos(p), 0.0, -np.sin(p)])
    right = np.array([0.0, -1.0, 0.0])
    rotation = np.column_stack([right, np.cross(forward, right), forward])
    return StereoCamera(
        name=f"{group}_1", group=group, baseline=baseline, eye=Pinhole.from_fov(width, rows, np.deg2rad(hfov_deg)),
        link_from_camera=SE3(rotation, np.array([0.0, 0.0, height])),
    )  # fmt: skip


@pytest.fixture
def synth():
    """The names above as one namespace: conftest files cannot be imported under importlib mode."""
    from types import SimpleNamespace

    return SimpleNamespace(Cylinder=Cylinder, Scene=Scene, looking=looking, telemetry=telemetry)
