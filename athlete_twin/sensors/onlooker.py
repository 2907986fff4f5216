"""Someone who watches a robot on its true terrain: where he stands, and pictures that are drawn anew only where something moved.

The onlooker stands still. His picture plane is wider than a film frame, and frames are windows that slide over it (a
lens that shifts instead of a camera that turns): so the ground is drawn once, and a moving leg costs its own
neighbourhood with its shadow, not the whole frame.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping

import cv2
import numpy as np

from athlete_twin.assets import robot_dir
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.camera import Pinhole
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import RobotSpec
from athlete_twin.sensors.renderer import SHADOW_LIFT, PlacedRobot, Renderer
from athlete_twin.sensors.shading import Surface
from athlete_twin.world.terrain import Terrain

BESIDE_SUN = np.deg2rad(-72.0)
"""azimuth of the onlooker from the sun's: light from the side shows rocks and makes long shadows"""
ELEVATION = np.deg2rad(23.0)
"""of the onlooker above what he looks at"""
DISTANCE = 4.9
"""from what he looks at, in foot radii of the robot"""
FIELD_OF_VIEW = np.deg2rad(44.0)
"""of one frame"""
STILL = 0.002
"""a link whose corners moved by less since it was drawn is not drawn again [m]: under half a pixel"""
MARGIN_PX = 6
"""round what moved"""
FINER = np.array([[0.125, 0.375], [0.375, -0.125], [-0.125, -0.375], [-0.375, 0.125]], dtype=np.float32)
"""places in a pixel on the robot's rim that get rays of their own"""


def looking(eye: np.ndarray, target: np.ndarray) -> SE3:
    """`world_from_camera` of an upright camera at `eye` that looks at `target` [m]."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return SE3(np.column_stack([right, np.cross(forward, right), forward]), eye)


def stand_point(
    terrain: Terrain, spec: RobotSpec, target: np.ndarray, *, distance: float = DISTANCE, elevation: float = ELEVATION
) -> np.ndarray:
    """Where the onlooker stands to see a robot at `target` [m]: beside the sun, above the ground."""
    azimuth = terrain.scenario.sun_azimuth + BESIDE_SUN
    reach = distance * spec.foot_radius
    flat = reach * np.cos(elevation)
    away = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), reach * np.sin(elevation)])
    return np.asarray(target + away)


class Posture:
    """Where every link is, docks included: the drawn kinematics lock those at zero."""

    def __init__(self, spec: RobotSpec) -> None:
        self._kin = Kinematics(spec)
        root = ElementTree.parse(robot_dir(spec.name) / "robot.urdf").getroot()
        joints = {j.get("name", ""): j for j in root.findall("joint")}
        self._docks = [(n, _origin(j), _vector(j.find("axis"), "xyz")) for n, j in joints.items() if n.startswith("dock")]
        parent_of = {_name(j, "child"): _name(j, "parent") for j in joints.values()}
        self._side_of = {link: _side(link, parent_of) for link in parent_of}

    def link_poses(self, world_from_hex: SE3, joints: np.ndarray, docks: np.ndarray) -> dict[str, SE3]:
        """`world_from_link` of every link.

        Args:
            world_from_hex: the chassis.
            joints: shape (6, dof) [rad].
            docks: angles in the order of the URDF, empty for a robot without or for docks as drawn [rad].
        """
        hex_from_link = self._kin.link_poses(joints)
        out = {}
        moved = self._moved(docks) if len(docks) else {}
        for link, pose in hex_from_link.items():
            side = self._side_of.get(link, "")
            out[link] = world_from_hex.compose(moved[side].compose(pose) if side in moved else pose)
        return out

    def _moved(self, docks: np.ndarray) -> dict[str, SE3]:
        """Per side what the angles of its two docks do to all that hangs on it: `hex_from_drawn_hex`."""
        out = {}
        for side in ("left", "right"):
            bent = drawn = SE3.identity()
            for (name, origin, axis), angle in zip(self._docks, docks, strict=True):
                if name.startswith(f"dock_{side}"):
                    bent = bent.compose(origin).compose(SE3.from_rotvec(float(angle) * axis))
                    drawn = drawn.compose(origin)
            out[side] = bent.compose(drawn.inverse())
        return out


class Painter(Renderer):
    """The renderer, asked for single rays, and for the ground as it looks where no sun falls on it."""

    dark = False
    """whether the sun is hidden"""

    def colours(self, world_from_camera: SE3, rays: np.ndarray, focal: float, robot: PlacedRobot) -> np.ndarray:
        """Screen values of rays in the camera frame: blue, green, red, 0 to 255, shape (n, 3)."""
        return 255.0 * self._colour(world_from_camera, rays, focal, robot, self._sun[None])[:, ::-1]

    def surface(self, world_from_camera: SE3, rays: np.ndarray, focal: float) -> Surface:
        """What the rays meet when no robot is there."""
        return self._trace(world_from_camera, rays_in_world(world_from_camera, rays), focal, self.place({}), self._sun[None])

    def _lit(self, s: Surface, robot: PlacedRobot, sun: np.ndarray) -> np.ndarray:
        return np.zeros(len(s.toward), dtype=np.float32) if self.dark else super()._lit(s, robot, sun)


class Canvas:
    """The onlooker's whole picture plane, kept up to date where something moved.

    The ground is drawn twice at the start, in the sun and without it. For a frame the robot's rays say where it covers
    the ground and where its shadow falls; only what shows the robot itself is shaded anew.
    """

    def __init__(
        self, terrain: Terrain, spec: RobotSpec, world_from_camera: SE3, eye: Pinhole, *, painter: Painter | None = None
    ) -> None:
        """Draws the ground.

        Args:
            terrain: the true ground.
            spec: of the robot that will be drawn on it.
            world_from_camera: pose of the onlooker.
            eye: his whole picture plane.
            painter: of this robot on this ground, from a canvas before; a new one by default.
        """
        parts = visual_parts(spec)
        self.painter = Painter(terrain, parts) if painter is None else painter
        self._sun = terrain.scenario.sun_in_world()
        self._world_from_camera, self._eye = world_from_camera, eye
        self._floor = terrain.grid
        self._corners: dict[str, np.ndarray] = {}
        for link in {p.link for p in parts}:
            points = np.concatenate([p.link_from_part.apply(p.vertices) for p in parts if p.link == link])
            ends = np.array([points.min(axis=0), points.max(axis=0)])
            self._corners[link] = np.array([[ends[i, 0], ends[j, 1], ends[k, 2]] for i, j, k in np.ndindex(2, 2, 2)])
        self._drawn: dict[str, np.ndarray] = {}
        self._sunny = self.painter.render_view(world_from_camera, eye, {}).astype(np.float32)
        self.painter.dark = True
        self._shady = self.painter.render_view(world_from_camera, eye, {}, supersampling=1).astype(np.float32)
        self.painter.dark = False
        self._rays = eye.rays().astype(np.float32)
        self._outward = np.empty((*self._rays.shape[:2], 6), dtype=np.float32)
        self._outward[..., :3] = world_from_camera.translation
        self._outward[..., 3:] = rays_in_world(world_from_camera, self._rays.reshape(-1, 3)).reshape(self._rays.shape)
        ground = self.painter.surface(world_from_camera, self._rays.reshape(-1, 3), eye.focal_px)
        shape = (eye.height_px, eye.width_px)
        self._faces_sun = ((ground.toward > 0.0) & (ground.label > 0)).reshape(shape)
        self._shadow_rays = np.empty((*shape, 6), dtype=np.float32)
        self._shadow_rays[..., :3] = (ground.points + np.float32(SHADOW_LIFT) * ground.facets).reshape(*shape, 3)
        self._shadow_rays[..., 3:] = self._sun
        self.picture = np.clip(np.rint(self._sunny), 0, 255).astype(np.uint8)
        """blue, green, red, 8 bit"""

    def show(self, link_poses: Mapping[str, SE3]) -> None:
        """Draw the robot where it is now."""
        now = {link: link_poses[link].apply(corners) for link, corners in self._corners.items() if link in link_poses}
        moved = [n for n, c in now.items() if n not in self._drawn or np.abs(c - self._drawn[n]).max() > STILL]
        if not moved:
            return
        places = [self._reach(now[n]) for n in moved] + [self._reach(self._drawn[n]) for n in moved if n in self._drawn]
        self._drawn.update({n: now[n] for n in moved})
        low = np.floor(np.min([p[0] for p in places], axis=0)) - MARGIN_PX
        high = np.ceil(np.max([p[1] for p in places], axis=0)) + MARGIN_PX
        bounds = np.array([self._eye.width_px, self._eye.height_px])
        (u0, v0), (u1, v1) = np.clip(low, 0, bounds).astype(int), np.clip(high, 0, bounds).astype(int)
        if u1 > u0 and v1 > v0:
            self._draw(np.s_[v0:v1, u0:u1], link_poses)

    def _draw(self, part: tuple[slice, slice], link_poses: Mapping[str, SE3]) -> None:
        """Draw a rectangle of the picture plane anew."""
        robot = self.painter.place(link_poses)
        rays = self._rays[part]
        shape = rays.shape[:2]
        covered = _hits(robot, self._outward[part].reshape(-1, 6)).reshape(shape)
        asked = self._faces_sun[part] & ~covered
        shadow = np.zeros(shape, dtype=np.float32)
        shadow[asked] = _hits(robot, self._shadow_rays[part][asked])
        # A blur of one pixel stands for finer rays at the shadow's edge.
        shade = cv2.blur(shadow, (3, 3))[..., None]
        picture = self._sunny[part] + shade * (self._shady[part] - self._sunny[part])
        focal = self._eye.focal_px
        rim = cv2.morphologyEx(covered.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), dtype=np.uint8)) > 0
        fine = np.repeat(rays[rim], len(FINER), axis=0)
        fine[:, :2] += np.tile(FINER, (int(rim.sum()), 1)) / focal
        inside = covered & ~rim
        # One call for both: each casts its rays at the whole terrain anew.
        rays_of_robot = np.concatenate([rays[inside], fine])
        colours = self.painter.colours(self._world_from_camera, rays_of_robot, focal, robot)
        count = int(inside.sum())
        picture[inside] = colours[:count]
        picture[rim] = colours[count:].reshape(-1, len(FINER), 3).mean(axis=1)
        self.picture[part] = np.clip(np.rint(picture), 0, 255).astype(np.uint8)

    def _reach(self, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels that a link and its shadow can touch: least and greatest u, v."""
        ground = float(self._floor.sample(corners[:, :2]).min()) - 0.5
        shadow = corners - ((corners[:, 2] - ground) / self._sun[2])[:, None] * self._sun
        pixels, _ = self._eye.project(self._world_from_camera.inverse().apply(np.concatenate([corners, shadow])))
        return pixels.min(axis=0), pixels.max(axis=0)


def rays_in_world(world_from_camera: SE3, rays: np.ndarray) -> np.ndarray:
    """Directions in world of rays in the camera frame, shape (n, 3), float32."""
    return np.asarray(rays.astype(np.float32) @ world_from_camera.rotation.T.astype(np.float32))


def _hits(robot: PlacedRobot, rays: np.ndarray) -> np.ndarray:
    """Whether each ray (origin, direction) meets the robot, shape (n,)."""
    if len(rays) == 0:
        return np.zeros(0, dtype=bool)
    tensor = open3d().core.Tensor(np.ascontiguousarray(rays))
    return np.asarray(robot.scene.test_occlusions(tensor).numpy())


def _side(link: str, parent_of: Mapping[str, str]) -> str:
    """Which docked deck a link hangs on: "left", "right" or none."""
    while link:
        if link.startswith("deck_"):
            return link.removeprefix("deck_")
        link = parent_of.get(link, "")
    return ""


def _origin(joint: ElementTree.Element) -> SE3:
    origin = joint.find("origin")
    roll, pitch, yaw = (float(angle) for angle in _vector(origin, "rpy"))
    return SE3.from_rpy(roll, pitch, yaw, _vector(origin, "xyz"))


def _vector(element: ElementTree.Element | None, key: str) -> np.ndarray:
    text = "" if element is None else element.get(key, "")
    return np.array([float(v) for v in text.split()]) if text.strip() else np.zeros(3)


def _name(joint: ElementTree.Element, role: str) -> str:
    element = joint.find(role)
    return "" if element is None else element.get("link", "")
