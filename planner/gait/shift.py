"""The chassis shift after a step: towards the goal, back to its height, level, and no further than everything allows.

The chassis moves rigidly with all wheels planted, so the loads on them change only by where the centre of mass goes. A
shift is shortened until every leg reaches, the stability rule holds at its end, for standing and for lifting any leg,
and no part comes near terrain or robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from athlete_twin.geometry.arrays import Joints, PerLeg, Vec2, Vec3, Wheels
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.reach import all_legs_ik, leg_ik
from athlete_twin.model.spec import LEGS
from athlete_twin.model.statics import peak_torque_fraction
from planner.belief import Belief
from planner.gait.body_sway import BodySwayConfig, NextSwing, best_sway
from planner.gait.relax import RelaxConfig, relaxing_offsets
from planner.gait.skeleton import GaitConfig, nominal_footfall, shift_per_step
from planner.gait.step_plan import BodyShift
from planner.motion.collision import BodyCollision, CollisionConfig
from planner.stability.margin import cps_margin, support_margin
from planner.stability.stability_map import StabilityConfig

DOWN = np.array([0.0, 0.0, -1.0])
TORQUE_SLACK = 0.02
FRACTIONS = (1.0, 0.75, 0.5, 0.25, 0.0)
SHARES = (1.0, 0.75, 0.5, 0.25)
"""of an offset, tried until the leg reaches"""
LIFT_SPARE = 0.03
"""of the next lift's height: when it comes it is planned from where the chassis then is believed, some millimetres off [m]"""
LIFT_SPACING = 0.01
"""between heights up to the lift's at which the leg must reach [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class NextLift:
    """What is known beforehand of the lift that will follow a step."""

    leg: int
    """index 0 to 5"""
    load_change: PerLeg
    """of the wheels, shape (6,) [N]; zeros where nobody knows"""
    height: float
    """by which its axle must rise above where it stands; 0 where nobody knows [m]"""


@dataclass(frozen=True, kw_only=True)
class ShiftLimits:
    """How much of height and attitude one shift mends."""

    max_height: float = 0.06
    """[m]"""
    max_tilt: float = 0.04
    """[rad]"""
    max_yaw: float = 0.03
    """[rad]"""
    max_torque_fraction: float = 0.8
    """of any joint, whichever leg is lifted at the end of the shift, by rigid statics: compliance takes its share"""
    level_deck_deg: float = 0.0
    """tilt that is left alone [deg]"""
    relax: RelaxConfig = field(default_factory=RelaxConfig)


def plan_shift(
    kin: Kinematics,
    belief: Belief,
    *,
    leg: int,
    upcoming: NextLift | None,
    landed_joints: Joints,
    contacts_in_world: Wheels,
    heading: Vec2,
    remaining: float,
    behind: float,
    yaw: float = 0.0,
    swayed: Vec3 | None = None,
    sway: BodySwayConfig | None = None,
    filled: HeightGrid,
    gait: GaitConfig,
    stability: StabilityConfig,
    limits: ShiftLimits,
    collision: CollisionConfig,
    payload_kg: float,
    legs: int = 1,
) -> BodyShift:
    """The shift after a step; its fraction is 0 where only height and attitude can be mended, or not even these.

    Args:
        kin: of the drawings.
        belief: before the step.
        leg: index 0 to 5 of the leg that steps.
        upcoming: the lift that will follow, None when nobody knows which.
        landed_joints: of all legs with the wheel down, shape (6, dof) [rad].
        contacts_in_world: with the wheel down, shape (6, 3) [m].
        heading: direction of travel in world.
        remaining: distance to the goal [m].
        behind: what earlier shifts were cut short by [m].
        yaw: that the chassis shall have in world [rad].
        swayed: by which the chassis is off its straight path, in world; None where it is on it [m].
        sway: how it may leave it for the next swing; None keeps to it.
        filled: terrain without NaN.
        gait: its stride.
        stability: the rule.
        limits: of what is mended and relaxed.
        collision: clearances.
        payload_kg: [kg]
        legs: that stepped together.
    """
    pose = belief.world_from_hex
    off = np.zeros(3) if swayed is None else swayed
    wanted = shift_per_step(kin.spec, gait, remaining=remaining, behind=behind, legs=legs)
    body = BodyCollision(kin.spec, filled, collision)
    wheels_in_world = pose.apply(kin.wheels_in_hex(landed_joints))
    standing, ok = _stance_at(kin, pose, wheels_in_world)
    if ok.all():
        body.come_no_nearer(standing)
    next_leg = None if upcoming is None else upcoming.leg
    offsets = relaxing_offsets(
        kin, belief, landed_joints, leg=leg, next_leg=next_leg,
        next_change=np.zeros(LEGS) if upcoming is None else upcoming.load_change, config=limits.relax,
    )  # fmt: skip
    rise, turn = _mending(kin, belief, limits, yaw, float(off[2]))
    allowed = allowed_torques(kin, pose, wheels_in_world, limits, payload_kg)
    least = 0.0 if upcoming is None else _room(kin, pose, wheels_in_world[upcoming.leg], upcoming)

    def without_room(end: SE3) -> str:
        """What is said of a chassis that leaves the next leg less room to be lifted than it needs, and than it has now."""
        if upcoming is None or _room(kin, end, wheels_in_world[upcoming.leg], upcoming) >= least:
            return ""
        return f"lift of leg {upcoming.leg + 1}"

    refused = ""
    for fraction in FRACTIONS:
        for mend in (1.0, 0.0):
            move = np.append(fraction * wanted * heading, mend * rise)
            end = SE3(SE3.from_rotvec(mend * turn).rotation @ pose.rotation, pose.translation - off + move)
            refusal = stance_refusal(
                kin, end, wheels_in_world, contacts_in_world, stability, allowed, body, payload_kg
            ) or without_room(end)  # fmt: skip
            if not refusal:
                change = np.zeros(3)
                left = max(0.0, remaining - fraction * wanted)
                if sway is not None and next_leg is not None and left > gait.arrival_distance:
                    place = nominal_footfall(kin.spec, gait, leg=next_leg, world_from_hex=end, heading=heading, remaining=left)
                    height = float(filled.sample(place[None])[0]) + kin.spec.wheel.radius
                    swing = NextSwing(axles_in_world=wheels_in_world, leg=next_leg, goal_in_world=np.append(place, height))
                    wish = best_sway(
                        kin.spec, end, swing, present=off, config=sway, min_margin=stability.min_margin, payload_kg=payload_kg
                    )
                    end = _displaced(
                        end, wish, pose,
                        lambda at: stance_refusal(kin, at, wheels_in_world, contacts_in_world, stability, allowed, body, payload_kg),
                        without_room,
                    )  # fmt: skip
                    change = end.translation - (pose.translation + move)
                elif swayed is not None:
                    change = -off
                return BodyShift(
                    translation_in_hex=pose.rotation.T @ (end.translation - pose.translation if change.any() else move),
                    rotvec_in_hex=pose.rotation.T @ (mend * turn),
                    wheel_offsets_in_hex=_in_reach(kin, belief, landed_joints, leg, end, offsets),
                    fraction=fraction,
                    cut_by=refused,
                    sway_in_hex=pose.rotation.T @ change,
                )
            refused = refused or refusal
    return BodyShift(
        translation_in_hex=np.zeros(3),
        rotvec_in_hex=np.zeros(3),
        wheel_offsets_in_hex=np.zeros((LEGS, 3)),
        fraction=0.0,
        cut_by=refused,
    )


def _displaced(path: SE3, wish: Vec3, start: SE3, refusal: Callable[[SE3], str], at_end: Callable[[SE3], str]) -> SE3:
    """The chassis as far off its path as wished, or as much of that as nothing forbids half-way there and at its end."""
    for share in SHARES:
        end = SE3(path.rotation, path.translation + share * wish)
        half = SE3(path.rotation, 0.5 * (start.translation + end.translation))
        if not refusal(end) and not at_end(end) and not refusal(half):
            return end
    return path


def allowed_torques(kin: Kinematics, world_from_hex: SE3, wheels_in_world: Wheels, limits: ShiftLimits, payload_kg: float) -> PerLeg:
    """Peak torque fraction that a shift may end with, by lifted leg, shape (6,).

    Where the stance itself asks for more torque than the limit, a shift may go on asking for as much.
    """
    standing = _worst_torques(kin, world_from_hex, wheels_in_world, payload_kg)
    if standing is None:
        return np.full(LEGS, limits.max_torque_fraction)
    return np.asarray(np.maximum(limits.max_torque_fraction, standing + TORQUE_SLACK))


def stance_refusal(
    kin: Kinematics,
    end: SE3,
    wheels_in_world: Wheels,
    contacts_in_world: Wheels,
    stability: StabilityConfig,
    allowed: PerLeg,
    body: BodyCollision,
    payload_kg: float,
) -> str:
    """What forbids the chassis to stand there; empty when nothing does. `allowed` are torque fractions by lifted leg."""
    joints, ok = _stance_at(kin, end, wheels_in_world)
    if not ok.all():
        return f"reach of leg {int(np.argmin(ok)) + 1}"
    com = end.apply(kin.com_in_hex(joints, payload_kg))
    if cps_margin(com, contacts_in_world) < stability.min_margin:
        return "CPS margin"
    for leg in range(LEGS):
        if support_margin(com, np.delete(contacts_in_world, leg, axis=0)) < stability.min_margin:
            return f"margin with leg {leg + 1} lifted"
    torques = _worst_torques(kin, end, wheels_in_world, payload_kg)
    if torques is not None and (torques > allowed).any():
        return f"torque with leg {int(np.argmax(torques - allowed)) + 1} lifted"
    return body.first_collision(joints, end) or ""


def _in_reach(kin: Kinematics, belief: Belief, landed_joints: Joints, leg: int, end: SE3, offsets: Wheels) -> Wheels:
    """The offsets, each as much of it as its leg can reach."""
    commanded = belief.motors.copy()
    commanded[leg] = landed_joints[leg]
    wheels = belief.world_from_hex.apply(kin.wheels_in_hex(commanded))
    hex_from_world = end.inverse()
    share = np.zeros(LEGS)
    for tried in SHARES:
        targets = hex_from_world.apply(wheels) + tried * offsets
        _, ok = all_legs_ik(kin.spec, targets, last_link_in_hex=hex_from_world.rotate(DOWN))
        share = np.where(ok, np.maximum(share, tried), share)
    return np.asarray(share[:, None] * offsets)


def _mending(kin: Kinematics, belief: Belief, limits: ShiftLimits, wanted_yaw: float, raised: float) -> tuple[float, np.ndarray]:
    """Height to rise by [m] and rotation vector in world [rad] that bring the chassis back to its regular height and attitude."""
    pose = belief.world_from_hex
    unsagged = pose.rotate(kin.wheels_in_hex(belief.motors))[:, 2]
    # Height of the hex origin over the contacts if no spring gave way: what commands speak of.
    height = float(np.mean((kin.spec.wheel.radius - unsagged)[belief.planted]))
    rise = float(np.clip(kin.spec.chassis_height - (height - raised), -limits.max_height, limits.max_height))
    up = pose.rotation[:, 2]
    tilt = np.array([up[1], -up[0], 0.0])
    excess = max(0.0, float(np.linalg.norm(tilt)) - np.deg2rad(limits.level_deck_deg))
    level = tilt * (min(excess, limits.max_tilt) / max(float(np.linalg.norm(tilt)), 1e-12))
    yaw = float(np.arctan2(pose.rotation[1, 0], pose.rotation[0, 0]))
    level[2] = float(np.clip(-(yaw - wanted_yaw), -limits.max_yaw, limits.max_yaw))
    return rise, level


def _stance_at(kin: Kinematics, world_from_hex: SE3, wheels: Wheels) -> tuple[Joints, np.ndarray]:
    hex_from_world = world_from_hex.inverse()
    return all_legs_ik(kin.spec, hex_from_world.apply(wheels), last_link_in_hex=hex_from_world.rotate(DOWN))


def _room(kin: Kinematics, world_from_hex: SE3, axle_in_world: Vec3, lift: NextLift) -> float:
    """How high the leg can raise its wheel straight up, folded as far as it goes, and no higher than it will have to [m]."""
    if lift.height <= 0.0:
        return 0.0
    most = lift.height + LIFT_SPARE
    heights = np.linspace(0.0, most, 1 + int(np.ceil(most / LIFT_SPACING)))
    hex_from_world = world_from_hex.inverse()
    axles = hex_from_world.apply(axle_in_world - heights[:, None] * DOWN)
    _, ok = leg_ik(kin.spec, lift.leg, axles, last_link_in_hex=hex_from_world.rotate(DOWN))
    return most if ok.all() else float(heights[max(int(np.argmin(ok)) - 1, 0)])


def _worst_torques(kin: Kinematics, world_from_hex: SE3, wheels: Wheels, payload: float) -> PerLeg | None:
    """Peak torque fraction with each leg in turn lifted, by rigid statics, shape (6,); None where a leg does not reach."""
    joints, ok = _stance_at(kin, world_from_hex, wheels)
    if not ok.all():
        return None
    gravity = GRAVITY * world_from_hex.inverse().rotate(DOWN)
    legs = np.arange(LEGS)
    return np.array(
        [
            peak_torque_fraction(kin, joints, supporting=legs != leg, gravity_in_hex=gravity, payload_kg=payload)
            for leg in legs
        ]
    )
