"""A stretch of the route on wheels: how far the robot may roll along its first piece, and what it then believes.

`Route`, `Belief`, `Ground` -> `DrivePlan | NoDrive`. The posture is kept and all wheels go along one line, so every check
is asked at steps along it: each wheel's track seen and smooth, each wheel carrying enough of its share by the contact
springs, the stability rule, and every part of the robot clear of the ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Joints, PerLeg, Vec2, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import Drive
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS
from planner.belief import Belief
from planner.gait.step_search import Ground, StepConfig
from planner.motion.collision import BodyCollision
from planner.route.places import RouteConfig, drivable
from planner.route.search import NoRoute, Route
from planner.sag.sag_model import FootSprings, solve_sag
from planner.stability.margin import cps_margin


@dataclass(frozen=True, kw_only=True)
class DriveConfig:
    """How far at a time, and how much of its load each wheel keeps."""

    shortest: float = 0.5
    """a shorter stretch is walked [m]"""
    longest: float = 3.0
    """at a time: then pictures say where the robot is [m]"""
    step: float = 0.1
    """between checked poses [m]"""
    least_load: float = 0.25
    """of a wheel, over a sixth of the weight"""

    def __post_init__(self) -> None:
        lengths = (self.step, self.shortest, self.longest)
        if not (np.isfinite(lengths).all() and 0.0 < self.step <= self.shortest <= self.longest):
            raise ConfigError(f"step, shortest and longest of a drive are {lengths} m: must be finite, above 0 and rise")
        if not 0.0 <= self.least_load < 1.0:
            raise ConfigError(f"least_load is {self.least_load}, must be at least 0 and below 1")


@dataclass(frozen=True, eq=False, kw_only=True)
class DrivePlan:
    """One drive along a straight line."""

    command: Drive
    way: Vec2
    """of the chassis in world [m]"""
    contacts_in_world: Wheels
    """believed at its end, shape (6, 3) [m]"""
    world_from_hex: tuple[SE3, ...]
    """chassis along the way, the present pose first"""
    margin: float
    """least CPS margin along the way [m]"""
    uneven: float
    """by which a wheel's ground leaves the plane of all at most [m]"""
    cut_by: str
    """what forbade to go on; empty when the route's piece or the longest drive ended it"""


@dataclass(frozen=True, kw_only=True)
class NoDrive:
    """The route's next stretch is not driven."""

    reason: str


def plan_drive(
    kin: Kinematics,
    springs: FootSprings,
    belief: Belief,
    ground: Ground,
    route: Route | NoRoute | None,
    *,
    route_config: RouteConfig,
    config: DriveConfig,
    step: StepConfig,
    payload_kg: float,
) -> DrivePlan | NoDrive:
    """The longest drive along the route's first piece that passes every check, or what refused it."""
    if not isinstance(route, Route) or route.modes[0] != "drive":
        return NoDrive(reason="the route begins on foot")
    if not belief.planted.all():
        return NoDrive(reason="a leg is in the air")
    piece = route.points[1] - route.points[0]
    length = min(float(np.linalg.norm(piece)), config.longest)
    way = piece / np.linalg.norm(piece)
    if not _steers(kin, belief, way):
        return NoDrive(reason="a wheel cannot be steered along the way")
    rolls = drivable(kin.spec, ground.heights, ground.footfalls, route_config)
    body = BodyCollision(kin.spec, ground.filled, step.collision)
    body.come_no_nearer(belief.joints)
    poses, contacts, margins, uneven, cut = [belief.world_from_hex], belief.contacts_in_world, [np.inf], 0.0, ""
    reached = 0.0
    for distance in np.linspace(0.0, length, 1 + max(1, int(np.ceil(length / config.step))))[1:]:
        there, pose, off = _standing(belief, ground, distance * way)
        margin = float(cps_margin(pose.apply(kin.com_in_hex(belief.joints, payload_kg)), there))
        cut = _refused_track(ground, rolls, there) or _refused_load(kin, springs, belief, pose, off, config, payload_kg)
        cut = cut or ("CPS margin" if margin < step.stability.min_margin else "")
        cut = cut or body.first_collision(belief.joints, pose) or ""
        if cut:
            break
        reached, contacts = float(distance), there
        poses.append(pose)
        margins.append(margin)
        uneven = max(uneven, float(np.abs(off).max()))
    if reached < config.shortest:
        return NoDrive(reason=f"after {reached:.1f} m: {cut}" if cut else f"{reached:.1f} m are too short to drive")
    in_hex = (belief.world_from_hex.rotation.T @ np.append(way, 0.0))[:2]
    command = Drive(
        translation_in_hex=reached * in_hex / np.linalg.norm(in_hex),
        speed=route_config.drive_speed_fraction * kin.spec.drive_speed,
    )
    return DrivePlan(
        command=command, way=reached * way, contacts_in_world=contacts, world_from_hex=tuple(poses), margin=min(margins),
        uneven=uneven, cut_by=cut,
    )  # fmt: skip


def _steers(kin: Kinematics, belief: Belief, way: Vec2) -> bool:
    """Whether every ankle can roll its wheel into the way, forwards or backwards."""
    in_hex = belief.world_from_hex.rotation.T @ np.append(way, 0.0)
    for leg in range(LEGS):
        axle = kin.leg_wheel(leg, belief.motors[leg]).rotation[:, 1]
        turn = (np.arctan2(axle[1], axle[0]) - np.arctan2(in_hex[0], -in_hex[1]) + 0.5 * np.pi) % np.pi - 0.5 * np.pi
        if not kin.spec.lower[-1] <= belief.motors[leg, -1] + turn <= kin.spec.upper[-1]:
            return False
    return True


def _standing(belief: Belief, ground: Ground, way: Vec2) -> tuple[Wheels, SE3, PerLeg]:
    """Contacts and chassis after so much of the way, and how far each wheel's ground lies off the plane of all.

    Of the map only the rise from here to there is taken: errors that all its cells share drop out.
    """
    here = belief.contacts_in_world
    rise = np.asarray(ground.filled.sample(here[:, :2] + way) - ground.filled.sample(here[:, :2]))
    design = np.column_stack([here[:, :2] - belief.world_from_hex.translation[:2], np.ones(LEGS)])
    fit = np.linalg.lstsq(design, rise, rcond=None)[0]
    tilt = SE3.from_rotvec(np.array([fit[1], -fit[0], 0.0])).rotation
    move = np.array([way[0], way[1], fit[2]])
    pose = SE3(tilt @ belief.world_from_hex.rotation, belief.world_from_hex.translation + move)
    there = here + np.column_stack([np.tile(way, (LEGS, 1)), rise])
    return there, pose, np.asarray(rise - design @ fit)


def _refused_track(ground: Ground, rolls: np.ndarray, contacts: Wheels) -> str:
    ix, iy, inside = ground.heights.index(contacts[:, :2])
    ok = inside & rolls[ix, iy]
    if ok.all():
        return ""
    leg = int(np.argmin(ok))
    why = ground.footfalls.reason_at(contacts[leg, :2])
    return f"the ground under wheel {leg + 1} is {'not smooth enough' if why == 'ok' else why}"


def _refused_load(
    kin: Kinematics, springs: FootSprings, belief: Belief, pose: SE3, off: PerLeg, config: DriveConfig, payload_kg: float
) -> str:
    joints: Joints = belief.joints
    weight = (kin.spec.mass + payload_kg) * GRAVITY
    gravity = pose.rotation.T @ np.array([0.0, 0.0, -GRAVITY])
    solved = solve_sag(
        kin.wheels_in_hex(joints), kin.com_in_hex(joints, payload_kg), weight, stiffness_z=springs.stiffness_z,
        lateral_ratio=springs.lateral_ratio, lifts=-off, gravity_in_hex=gravity,
    )  # fmt: skip
    if not solved.converged:
        return f"the springs say {solved.status}"
    loads, least = solved.forces @ -gravity / GRAVITY, config.least_load * weight / LEGS
    if loads.min() < least:
        return f"wheel {int(np.argmin(loads)) + 1} would carry {loads.min():.0f} N, less than {least:.0f} N"
    return ""
