"""Looking around before the first step: the chassis nods and turns on its planted wheels to see what its cameras miss.

On SDM-B the NavCams see only beyond the legs' reach, the HazCams only within it, and not between their views
([SunSpiral2012] s4.2, fig. 7): a ring of ground is seen by neither. A chassis that pitches forward lowers the NavCams'
view onto the ring; one that yaws turns the HazCams' gaps onto their views. Every pose is checked for reach, and smaller
ones are taken where the legs do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.geometry.arrays import Points2, Vec2, Vec3
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, Command, ImageRequest
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import RobotSpec
from planner.belief import Belief

SHRINK = (1.0, 0.8, 0.6, 0.4)


@dataclass(frozen=True, kw_only=True)
class SurveyConfig:
    """What is looked at, and when."""

    nod_deg: float = 11.0
    """pitch towards the heading [deg]"""
    nod_drop: float = 0.12
    """by which the chassis sinks while it nods, for the rear legs' reach [m]"""
    turn_deg: float = 16.0
    """yaw to both sides [deg]"""
    binning: int = 2
    """of all pictures"""
    each_step: int = 3
    """pairs taken after each step"""


def survey_commands(kin: Kinematics, belief: Belief, heading: Vec2, config: SurveyConfig) -> list[Command]:
    """Pictures all round, then from nodding and turned poses, and back again."""
    spec = kin.spec
    everything = tuple(c.name for c in spec.cameras if c.on_chassis)
    commands: list[Command] = [ImageRequest(cameras=everything, binning=config.binning)]
    across = np.array([-heading[1], heading[0], 0.0])
    nod = (np.deg2rad(config.nod_deg) * across, np.array([0.0, 0.0, -config.nod_drop]))
    left = (np.array([0.0, 0.0, np.deg2rad(config.turn_deg)]), np.zeros(3))
    ahead = facing(spec, heading, group=None, most=len(everything) // 2 + 1)
    for rotvec, drop in (nod, left, (-left[0], left[1])):
        for scale in SHRINK:
            if _reaches(kin, belief, scale * rotvec, scale * drop):
                commands += _there_and_back(scale * rotvec, scale * drop, ImageRequest(cameras=ahead, binning=config.binning))
                break
    return commands


def facing(spec: RobotSpec, heading_in_hex: Vec2, *, group: str | None, most: int) -> tuple[str, ...]:
    """Cameras on the chassis whose boresight points most nearly along a heading, best first."""
    cameras = [c for c in spec.cameras if c.on_chassis and (group is None or c.group == group)]
    along = [float(c.hex_from_camera.rotation[:2, 2] @ heading_in_hex) for c in cameras]
    best = sorted(range(len(cameras)), key=lambda i: -along[i] / np.linalg.norm(cameras[i].hex_from_camera.rotation[:2, 2]))
    return tuple(cameras[i].name for i in best[:most])


def seeing(spec: RobotSpec, point_in_hex: Vec3, *, most: int) -> tuple[str, ...]:
    """Cameras on the chassis in whose picture a point lies, the most central first."""
    found = []
    for camera in (c for c in spec.cameras if c.on_chassis):
        pixel, depth = camera.eye.project(camera.hex_from_camera.inverse().apply(point_in_hex))
        u = (pixel[0] - camera.eye.cx_px) / camera.eye.width_px
        v = (pixel[1] - camera.eye.cy_px) / camera.eye.height_px
        if depth > 0.0 and max(abs(u), abs(v)) < 0.5:
            found.append((float(np.hypot(u, v)), camera.name))
    return tuple(name for _, name in sorted(found)[:most])


def seeing_steps(
    spec: RobotSpec, belief: Belief, *, places: Points2, legs: list[int], stride_in_world: Vec2, most: int
) -> tuple[str, ...]:
    """Cameras in whose pictures legs will step, those of the first leg first.

    Args:
        spec: the drawings.
        belief: of the robot.
        places: of the gait in world, one for each leg of the robot, shape (6, 2) [m].
        legs: which step, in order.
        stride_in_world: by which the places move on from one cycle to the next [m].
        most: cameras.
    """
    names: dict[str, None] = {}
    hex_from_world = belief.world_from_hex.inverse()
    floor = float(np.mean(belief.contacts_in_world[:, 2]))
    for leg in legs:
        for ahead in (0.0, 1.0):
            point: Vec3 = np.append(places[leg] + ahead * stride_in_world, floor)
            for name in seeing(spec, hex_from_world.apply(point), most=2):
                names[name] = None
    return tuple(names)[:most]


def _there_and_back(rotvec: np.ndarray, drop: np.ndarray, look: ImageRequest) -> list[Command]:
    # The second move is given in the turned hex frame: the same vectors, turned and negated.
    back = SE3.from_rotvec(rotvec, drop).inverse()
    return [
        BodyMove(translation_in_hex=drop, rotvec_in_hex=rotvec),
        look,
        BodyMove(translation_in_hex=back.translation, rotvec_in_hex=back.rotvec()),
    ]


def _reaches(kin: Kinematics, belief: Belief, rotvec: np.ndarray, drop: np.ndarray) -> bool:
    poses = [kin.leg_wheel(leg, belief.motors[leg]) for leg in range(6)]
    wheels = np.array([p.translation for p in poses])
    for fraction in (0.5, 1.0):
        hex_from_start = SE3.from_rotvec(fraction * rotvec, fraction * drop).inverse()
        _, ok = all_legs_ik(
            kin.spec, hex_from_start.apply(wheels), last_link_in_hex=hex_from_start.rotate(np.array([0.0, 0.0, -1.0]))
        )
        if not ok.all():
            return False
    return True
