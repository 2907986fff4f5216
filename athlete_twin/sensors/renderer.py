"""Pictures of the true ground and the robot on it, by ray casting: sunlit, hard-shadowed, textured, with truth beside them.

Open3D's ray caster (Embree) finds what each pixel sees and whether the sun sees it too; shading is Lambert's law under a
sun and a sky, with the grain of `texture.py`. The terrain's tree is built once, the robot's once a capture, for all eyes.

Radiance is relative: 1.0 is a white surface square to the sun. No lens blur, no distortion: images are rectified.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, no_type_check, runtime_checkable

import cv2
import numba
import numpy as np

from athlete_twin.errors import CameraError
from athlete_twin.geometry.arrays import DepthMap, Image, Vec3
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import leg_of
from athlete_twin.model.camera import Pinhole
from athlete_twin.sensors.backdrop import ground_mesh
from athlete_twin.sensors.shading import Surface, shade, surface_fields
from athlete_twin.sensors.sun_cover import SunCover
from athlete_twin.sensors.texture import ROBOT, SKY
from athlete_twin.world.terrain import Terrain

NEAR = 0.03
"""closer than this a camera sees nothing: its own housing [m]"""
SHADOW_LIFT = 0.004
"""shadow rays start so far above the surface [m]"""
SUN_RADIUS = 0.0015
"""of the sun's disc where views are refined; the real 0.0047 would reach beyond the refined pixels and be cut there [rad]"""
HAZE_LENGTH = 900.0
"""in which a view from outside fades into the sky by 63 % [m]"""
FILM_EXPOSURE = 1.25
GLOSS, GLOSS_EXPONENT = 0.10, 28
"""highlight of the robot's paint in views from outside"""
EDGE_STEP = 0.06
"""neighbouring pixels of a view that differ more are refined (screen values, 0 to 1)"""
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@runtime_checkable
class Part(Protocol):
    """One coloured piece of a link, as `model.appearance.VisualPart`."""

    @property
    def link(self) -> str:
        """Its link's URDF name."""

    @property
    def link_from_part(self) -> SE3:
        """Where it sits."""

    @property
    def vertices(self) -> np.ndarray:
        """Shape (n, 3) [m]."""

    @property
    def triangles(self) -> np.ndarray:
        """Shape (m, 3)."""

    @property
    def colour(self) -> np.ndarray:
        """Linear red, green, blue, shape (3,)."""

    @property
    def albedo(self) -> float:
        """Share of the light reflected."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RenderResult:
    """What one eye sees, and the truth of it for scoring and films."""

    image: np.ndarray
    """radiance, shape (h, w), float32"""
    depth: DepthMap
    """along the boresight, NaN for sky [m]"""
    label: Image
    """0 sky, 1 ground, 2 rock, 3 robot"""
    leg: np.ndarray
    """index 0 to 5 of the leg that a pixel shows, -1 elsewhere, shape (h, w), int8"""


@dataclass(frozen=True, eq=False, kw_only=True)
class PlacedRobot:
    """The robot's surface in one posture, ready for rays."""

    scene: Any
    """Open3D's ray caster, None without parts"""
    part_of_triangle: np.ndarray
    """index into the renderer's parts, shape (m,)"""
    link_from_world: np.ndarray
    """rotation and shift of each part's link, shape (parts, 3, 4)"""


class Renderer:
    """Renders one trial's terrain with the robot in any posture."""

    def __init__(self, terrain: Terrain, visual_parts: Sequence[Part], sun_in_world: Vec3 | None = None) -> None:
        """Builds the terrain's tree.

        Args:
            terrain: true ground.
            visual_parts: the robot's surface; none for a picture of the ground alone.
            sun_in_world: direction towards the sun; the scenario's by default.
        """
        sun = terrain.scenario.sun_in_world() if sun_in_world is None else np.asarray(sun_in_world, dtype=float)
        self.terrain = terrain
        self._parts = tuple(visual_parts)
        self._sun = sun / np.linalg.norm(sun)
        vertices, triangles, self._first_far_rock = ground_mesh(terrain)
        self._ground = _scene_of(vertices, triangles)
        self._fields = surface_fields(terrain)
        nx, ny = terrain.grid.shape
        self._cover = SunCover(terrain.grid, vertices[triangles[2 * (nx - 1) * (ny - 1) :]], self._sun)
        self._part_leg = np.array([*(leg_of(p.link) for p in self._parts), -1], dtype=np.int8)
        self._part_colour = np.array([p.colour for p in self._parts], dtype=float).reshape(-1, 3)
        self._part_albedo = np.array([p.albedo for p in self._parts], dtype=float)

    def place(self, link_poses: Mapping[str, SE3]) -> PlacedRobot:
        """The robot in one posture, from `world_from_link` by link name; a part of a link not named is left out."""
        vertices, triangles, owner, count = [], [], [], 0
        link_from_world = np.zeros((max(len(self._parts), 1), 3, 4))
        inverse = {name: pose.inverse().matrix()[:3] for name, pose in link_poses.items()}
        for i, part in enumerate(self._parts):
            if part.link not in link_poses:
                continue
            link_from_world[i] = inverse[part.link]
            vertices.append(link_poses[part.link].compose(part.link_from_part).apply(part.vertices))
            triangles.append(np.asarray(part.triangles) + count)
            owner.append(np.full(len(part.triangles), i))
            count += len(part.vertices)
        if not vertices:
            return PlacedRobot(
                scene=None, part_of_triangle=np.zeros(1, dtype=np.int64), link_from_world=link_from_world
            )
        scene = _scene_of(np.concatenate(vertices), np.concatenate(triangles))
        return PlacedRobot(scene=scene, part_of_triangle=np.concatenate(owner), link_from_world=link_from_world)

    def render(self, world_from_camera: SE3, eye: Pinhole, robot: PlacedRobot) -> RenderResult:
        """One eye's radiance in black and white, its depth and labels."""
        directions = _directions(world_from_camera, eye.rays().reshape(-1, 3))
        s = self._trace(world_from_camera, directions, eye.focal_px, robot, self._sun[None])
        image = s.albedo * (s.ambient + s.toward * self._lit(s, robot, self._sun[None]))
        sky = s.label == SKY
        image[sky] = _sky_brightness(directions[sky])
        shape = (eye.height_px, eye.width_px)
        return RenderResult(
            image=image.reshape(shape), depth=s.depth.reshape(shape).astype(float), label=s.label.reshape(shape),
            leg=self._part_leg[s.part].reshape(shape),
        )  # fmt: skip

    def render_view(
        self, world_from_camera: SE3, eye: Pinhole, link_poses: Mapping[str, SE3], *, supersampling: int = 2
    ) -> np.ndarray:
        """A colour picture from outside for a film: blue, green, red, 8 bit, shape (h, w, 3).

        Args:
            world_from_camera: pose of the onlooker.
            eye: his camera.
            link_poses: `world_from_link` of every link.
            supersampling: 2 refines edges and shadows by four rays a pixel, 1 does not.
        """
        if supersampling not in (1, 2):
            raise CameraError(f"supersampling is {supersampling}, must be 1 or 2")
        robot = self.place(link_poses)
        rays = eye.rays().reshape(-1, 3)
        picture = self._colour(world_from_camera, rays, eye.focal_px, robot, self._sun[None])
        if supersampling > 1:
            edges = _edges(picture.reshape(eye.height_px, eye.width_px, 3)).ravel()
            offsets = np.array([[0.125, 0.375], [0.375, -0.125], [-0.125, -0.375], [-0.375, 0.125]])
            fine = np.repeat(rays[edges], 4, axis=0)
            fine[:, :2] += np.tile(offsets, (int(edges.sum()), 1)) / eye.focal_px
            sun = np.tile(self._sun_disc(2.0 * offsets), (int(edges.sum()), 1))
            refined = self._colour(world_from_camera, fine, 2.0 * eye.focal_px, robot, sun)
            picture[edges] = refined.reshape(-1, 4, 3).mean(axis=1)
        screen = np.clip(np.rint(255.0 * picture[:, ::-1]), 0, 255).astype(np.uint8)
        return screen.reshape(eye.height_px, eye.width_px, 3)

    def _trace(
        self, world_from_camera: SE3, directions: np.ndarray, focal: float, robot: PlacedRobot, sun: np.ndarray
    ) -> Surface:
        """What the rays meet; their directions have length 1 along the boresight, so that a ray's parameter is depth."""
        tensor = open3d().core.Tensor(_rays(world_from_camera.translation, directions, np.float32(NEAR)))
        return shade(
            self._ground.cast_rays(tensor),
            None if robot.scene is None else robot.scene.cast_rays(tensor),
            origin=world_from_camera.translation,
            directions=directions,
            near=NEAR,
            focal=focal,
            terrain=self.terrain,
            fields=self._fields,
            first_far_rock=self._first_far_rock,
            part_of_triangle=robot.part_of_triangle,
            link_from_world=robot.link_from_world,
            part_albedo=self._part_albedo,
            sun=sun,
        )

    def _lit(self, s: Surface, robot: PlacedRobot, sun: np.ndarray) -> np.ndarray:
        """1 where the sun sees the point, 0 elsewhere; asked only where the surface faces it."""
        asked = np.flatnonzero(s.toward > 0.0)
        lit = np.zeros(len(s.toward), dtype=np.float32)
        if len(asked) == 0:
            return lit
        rays = _shadow_rays(asked, s.points, s.facets, np.float32(SHADOW_LIFT), np.ascontiguousarray(sun))
        free = np.ones(len(rays), dtype=bool)
        may = self._cover.may_shade(rays)
        free[may] = ~self._ground.test_occlusions(open3d().core.Tensor(rays[may])).numpy()
        if robot.scene is not None:
            free &= ~robot.scene.test_occlusions(open3d().core.Tensor(rays)).numpy()
        lit[asked] = free
        return lit

    def _colour(
        self, world_from_camera: SE3, rays: np.ndarray, focal: float, robot: PlacedRobot, sun: np.ndarray
    ) -> np.ndarray:
        """Screen values of rays in the camera frame: red, green, blue, 0 to 1, shape (n, 3), float32."""
        directions = _directions(world_from_camera, rays)
        s = self._trace(world_from_camera, directions, focal, robot, sun)
        direct = s.toward * self._lit(s, robot, sun)
        warm, cool = np.array([1.05, 1.0, 0.90], dtype=np.float32), np.array([0.92, 0.99, 1.14], dtype=np.float32)
        light = direct[:, None] * warm + s.ambient[:, None] * cool
        colour = self._hues(s) * s.albedo[:, None] * light
        unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        shiny = (s.label == ROBOT) & (direct > 0.0)
        half = (sun if len(sun) == 1 else sun[shiny]) - unit[shiny]
        half = half / np.linalg.norm(half, axis=1, keepdims=True)
        gloss = np.clip(np.sum(s.normals[shiny] * half, axis=1), 0.0, 1.0) ** GLOSS_EXPONENT
        colour[shiny] += (GLOSS * gloss)[:, None].astype(np.float32)
        sky = s.label == SKY
        level = unit.copy()
        level[:, 2] = 0.0
        haze = (1.0 - np.exp(-np.nan_to_num(s.depth) / HAZE_LENGTH))[:, None]
        colour += haze * (_sky_colour(level, self._sun) - colour)
        colour[sky] = _sky_colour(unit[sky], self._sun)
        return _film_curve(colour)

    def _hues(self, s: Surface) -> np.ndarray:
        """Linear red, green, blue of luminance 1, shape (n, 3), float32."""
        materials = (self.terrain.soil, self.terrain.rock_material)
        soil, rock = (np.array(m.colour) / (np.array(m.colour) @ _LUMINANCE) for m in materials)
        out: np.ndarray = (soil + s.rocky[:, None] * (rock - soil)).astype(np.float32)
        on_robot = s.label == ROBOT
        colour = self._part_colour[s.part[on_robot]]
        out[on_robot] = colour / np.maximum(colour @ _LUMINANCE, 1e-3)[:, None]
        return out

    def _sun_disc(self, places: np.ndarray) -> np.ndarray:
        """Directions to places on the sun's disc, given in units of its radius, shape (n, 3)."""
        side = np.cross(self._sun, [0.0, 0.0, 1.0] if abs(self._sun[2]) < 0.99 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        other = np.cross(self._sun, side)
        return np.asarray(self._sun + SUN_RADIUS * places @ np.vstack([side, other]))


def _scene_of(vertices: np.ndarray, triangles: np.ndarray) -> Any:
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(vertices, dtype=np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(triangles, dtype=np.uint32)),
    )
    return scene


def _directions(world_from_camera: SE3, rays: np.ndarray) -> np.ndarray:
    turned: np.ndarray = _turned(np.ascontiguousarray(world_from_camera.rotation, dtype=np.float32), rays.astype(np.float32))
    return turned


# Written out: a threaded matrix product costs more than it saves on three columns, and numpy makes a copy a step.
@no_type_check
@numba.njit(nogil=True, cache=True)
def _turned(rotation, rays):  # type: ignore[no-untyped-def]
    out = np.empty_like(rays)
    for i in range(rays.shape[0]):
        for k in range(3):
            out[i, k] = rays[i, 0] * rotation[k, 0] + rays[i, 1] * rotation[k, 1] + rays[i, 2] * rotation[k, 2]
    return out


@no_type_check
@numba.njit(nogil=True, cache=True)
def _rays(origin, directions, near):  # type: ignore[no-untyped-def]
    """Rays that start `near` before the eye, (n, 6): place in world, direction."""
    out = np.empty((directions.shape[0], 6), dtype=np.float32)
    for i in range(directions.shape[0]):
        for k in range(3):
            out[i, k] = origin[k] + near * directions[i, k]
            out[i, 3 + k] = directions[i, k]
    return out


@no_type_check
@numba.njit(nogil=True, cache=True)
def _shadow_rays(asked, points, facets, lift, sun):  # type: ignore[no-untyped-def]
    """Rays towards the sun from just above the asked points, (m, 6); `sun` has one row for all, or one a point."""
    out = np.empty((len(asked), 6), dtype=np.float32)
    for j in range(len(asked)):
        i = asked[j]
        s = i if sun.shape[0] > 1 else 0
        for k in range(3):
            out[j, k] = points[i, k] + lift * facets[i, k]
            out[j, 3 + k] = sun[s, k]
    return out


def _edges(picture: np.ndarray) -> np.ndarray:
    """Pixels beside a step in brightness, shape (h, w)."""
    grey = picture @ _LUMINANCE.astype(np.float32)
    step = np.zeros(grey.shape, dtype=np.uint8)
    step[:, 1:] |= np.abs(np.diff(grey, axis=1)) > EDGE_STEP
    step[1:] |= np.abs(np.diff(grey, axis=0)) > EDGE_STEP
    return np.asarray(cv2.dilate(step, np.ones((3, 3), dtype=np.uint8)) > 0)


def _sky_brightness(directions: np.ndarray) -> np.ndarray:
    up = np.clip(directions[:, 2] / np.linalg.norm(directions, axis=1), 0.0, 1.0)
    return np.asarray(0.34 - 0.20 * up**0.6)


def _sky_colour(unit: np.ndarray, sun: np.ndarray) -> np.ndarray:
    """Linear colour of the sky, paler towards the horizon and the sun, shape (n, 3), float32."""
    up = np.clip(unit[:, 2:3], 0.0, 1.0) ** 0.5
    horizon, zenith = np.array([0.50, 0.58, 0.68]), np.array([0.10, 0.22, 0.48])
    glow = np.clip(unit @ sun, 0.0, 1.0)[:, None] ** 12
    return np.asarray(horizon + up * (zenith - horizon) + 0.2 * glow * np.array([1.0, 0.9, 0.7]), dtype=np.float32)


def _film_curve(colour: np.ndarray) -> np.ndarray:
    """Linear light to screen values with a soft shoulder, so that bright sand keeps its grain."""
    x = np.maximum(colour, 0.0) * np.float32(FILM_EXPOSURE)
    mapped = (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14)
    return np.asarray(np.clip(mapped, 0.0, 1.0) ** (1.0 / 2.2), dtype=np.float32)
