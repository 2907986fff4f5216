"""Rendered scenes whose depth is known: what the perception benchmarks measure on.

The robot stands in its regular stance on a seeded rock field; the renderer gives the radiance of both eyes, the true
depth and the labels, from which pairs of any exposure and bit depth are developed. Camera mountings are as drawn: an
error of the pose is not an error of the depth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import StereoPair, Telemetry
from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.camera import Pinhole, StereoCamera
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import RobotSpec, load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from athlete_twin.sensors.renderer import PlacedRobot, Renderer, RenderResult
from athlete_twin.sensors.stereo_camera import READ_ELECTRONS, RESPONSE, WHITE_ELECTRONS, metered_exposure
from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import build_terrain

OUTLINE_PX = 3
"""pixels this near to a depth edge show two surfaces and are left out"""
EDGE_SHARE = 0.04
"""a step of the true depth between neighbouring pixels by more than this share is an edge"""
GROUND, ROCK, ROBOT = 1, 2, 3
"""labels of the renderer"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """What one pair truly sees, before any exposure."""

    robot: str
    camera: StereoCamera
    eye: Pinhole
    """binned as the radiance is"""
    binning: int
    sun_deg: float
    seed: int
    left: RenderResult
    right: RenderResult
    shadow: np.ndarray
    """pixels of the left image that the sun does not see, shape (h, w)"""
    right_shadow: np.ndarray
    world_from_hex: SE3
    telemetry: Telemetry

    def judged(self) -> np.ndarray:
        """Pixels of the left image on ground or rock, away from every outline, seen by both eyes; shape (h, w)."""
        terrain = (self.left.label == GROUND) | (self.left.label == ROCK)
        depth = np.nan_to_num(self.left.depth, nan=1e3).astype(np.float32)
        kernel = np.ones((2 * OUTLINE_PX + 1,) * 2, dtype=np.uint8)
        label = np.where(terrain, 0, self.left.label).astype(np.uint8)
        steps = np.zeros(depth.shape, dtype=np.uint8)
        for axis in (0, 1):
            step = np.abs(np.diff(depth, axis=axis)) > EDGE_SHARE * np.minimum(
                *(np.take(depth, np.arange(depth.shape[axis] - 1) + k, axis=axis) for k in (0, 1))
            )
            at = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
            steps[at] |= step
        edge = cv2.dilate(steps, kernel) > 0
        edge |= cv2.dilate(label, kernel) != cv2.erode(label, kernel)
        return np.asarray(terrain & ~edge)

    def metered(self) -> float:
        """The exposure the camera would choose [s]."""
        return metered_exposure(self.left.image)

    def pair(self, *, exposure: float | None = None, bits: int = 8, bracket: int = 0) -> StereoPair:
        """The pair as a camera takes it: photon and read noise, cut off at white, `bits` deep.

        Args:
            exposure: [s]; the metered one by default.
            bits: 8 or 12.
            bracket: which exposure of a bracket; keys the noise.
        """
        seconds = self.metered() if exposure is None else exposure
        images = []
        for side, seen in enumerate((self.left, self.right)):
            rng = np.random.default_rng([self.seed, 77, round(self.sun_deg), side, bracket, bits])
            images.append(developed(seen.image, seconds, binning=self.binning, bits=bits, rng=rng))
        return StereoPair(
            seq=bracket, robot_id=self.robot, t=0.0, camera=self.camera.name, binning=self.binning, left=images[0],
            right=images[1], exposure=seconds, state=self.telemetry, bits=bits, bracket=bracket,
        )  # fmt: skip

    def under_darker_sky(self, share: float) -> Scene:
        """The same scene where the sky gives only `share` of its light, as far as shadows tell: towards an airless world's."""
        def dimmed(seen: RenderResult, shadow: np.ndarray) -> RenderResult:
            return replace(seen, image=np.where(shadow, share * seen.image, seen.image).astype(np.float32))

        return replace(
            self, left=dimmed(self.left, self.shadow), right=dimmed(self.right, self.right_shadow)
        )

    def points_in_world(self) -> np.ndarray:
        """True place of every pixel, shape (h, w, 3), NaN for sky [m]."""
        pose = self.world_from_hex.compose(self.camera.hex_from_camera)
        return np.asarray(pose.apply(self.eye.rays() * self.left.depth[..., None]))


def developed(radiance: np.ndarray, exposure: float, *, binning: int, bits: int, rng: np.random.Generator) -> np.ndarray:
    """The `bits` deep image of a radiance by the camera's noise model; shape (h, w), uint8 or uint16."""
    white = 2**bits - 1
    electrons = np.minimum(np.maximum(radiance, 0.0) * (exposure * RESPONSE), 4.0) * WHITE_ELECTRONS
    sigma = np.sqrt(electrons + READ_ELECTRONS**2) / binning
    noisy = electrons + sigma * rng.standard_normal(radiance.shape, dtype=np.float32)
    grey = np.clip(np.rint(noisy * (white / WHITE_ELECTRONS)), 0.0, white)
    return np.asarray(grey.astype(np.uint8 if bits == 8 else np.uint16))


def scenes(
    robot: str,
    cameras: tuple[str, ...],
    *,
    seeds: range,
    suns_deg: tuple[float, ...] = (15.0, 35.0, 70.0),
    binnings: tuple[int, ...] = (1, 2),
    scenario: str = "rock_field",
) -> Iterator[Scene]:
    """The named cameras' views, seed by seed, then sun by sun.

    Args:
        robot: "sdm_b" or "t12".
        cameras: names of pairs.
        seeds: of the ground.
        suns_deg: elevations of the sun [deg].
        binnings: of the images.
        scenario: kind of ground.
    """
    spec = load_spec(robot)
    kin = Kinematics(spec)
    joints = regular_stance(spec)
    wheels = stance_wheels_in_hex(spec)
    links = kin.link_poses(joints)
    world = load_scenario(scenario)
    for seed in seeds:
        terrain = build_terrain(world, seed, clear_xy=wheels[:, :2], clear_radius=0.5)
        height = spec.chassis_height + float(np.mean(terrain.grid.sample(wheels[:, :2])))
        world_from_hex = SE3.from_translation(np.array([0.0, 0.0, height]))
        in_world = {name: world_from_hex.compose(pose) for name, pose in links.items()}
        for sun_deg in suns_deg:
            sun = replace(world, sun_elevation=float(np.deg2rad(sun_deg))).sun_in_world()
            renderer = Renderer(terrain, visual_parts(spec), sun)
            placed = renderer.place(in_world)
            for name in cameras:
                for binning in binnings:
                    yield _scene(spec, renderer, placed, world_from_hex, joints, name, binning, sun_deg, seed)


def _scene(
    spec: RobotSpec,
    renderer: Renderer,
    placed: PlacedRobot,
    world_from_hex: SE3,
    joints: np.ndarray,
    name: str,
    binning: int,
    sun_deg: float,
    seed: int,
) -> Scene:
    camera = spec.camera(name)
    eye = camera.eye.binned(binning)
    poses = [world_from_hex.compose(pose) for pose in (camera.hex_from_camera, camera.hex_from_right())]
    left, right = (renderer.render(pose, eye, placed) for pose in poses)
    shadows = [_shadow(renderer, placed, pose, eye) for pose in poses]
    return Scene(
        robot=spec.name, camera=camera, eye=eye, binning=binning, sun_deg=sun_deg, seed=seed, left=left, right=right,
        shadow=shadows[0], right_shadow=shadows[1], world_from_hex=world_from_hex, telemetry=_telemetry(spec.name, joints),
    )  # fmt: skip


def _shadow(renderer: Renderer, placed: PlacedRobot, world_from_left: SE3, eye: Pinhole) -> np.ndarray:
    """Pixels whose surface the sun does not see: behind something, or turned away."""
    directions = world_from_left.rotate(eye.rays()).reshape(-1, 3)
    sun = renderer._sun[None]
    surface = renderer._trace(world_from_left, directions, eye.focal_px, placed, sun)
    lit = renderer._lit(surface, placed, sun)
    return np.asarray((lit == 0.0).reshape(eye.height_px, eye.width_px))


def _telemetry(robot: str, joints: np.ndarray) -> Telemetry:
    zero = np.zeros_like(joints)
    return Telemetry(
        seq=0, robot_id=robot, t=0.0, joints=joints, motors=joints, torques=zero, attitude_rpy=np.zeros(3),
        rates=np.zeros(3), acceleration=np.array([0.0, 0.0, 9.81]), executive_state="idle", sequence_id=-1,
        command_index=0,
    )  # fmt: skip
