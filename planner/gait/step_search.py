"""Choosing a step: candidate footfalls around the gait's nominal one, in the order of their cost, until one can be walked.

Fused terrain, footfall scores and belief -> `StepPlan | NoStep`. A candidate must be allowed by the footfall map, within
reach on the ground and above it with the chassis sagged as it will be, keep the stability rule, stay clear of the other
wheels, and have a collision-free way there. Refusals are counted by the check that made them. Another leg may be in the air
meanwhile: then the chassis does not shift afterwards.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError, PlanningError
from athlete_twin.geometry.arrays import Joints, PerLegFlag, Points2, Points3, Vec2, Vec3, Wheels
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.leg_timing import leg_timing
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS
from athlete_twin.model.statics import torque_fractions
from planner.belief import Belief
from planner.decisions import NoStep
from planner.footfall import FootfallMap
from planner.gait.body_sway import BodySwayConfig
from planner.gait.shift import NextLift, ShiftLimits, plan_shift
from planner.gait.skeleton import GaitConfig, nominal_footfall, stride
from planner.gait.step_plan import BodyShift, StepPlan
from planner.motion.collision import CollisionConfig, LegCollision
from planner.motion.swing import SwingConfig, SwingPath, plan_swing
from planner.sag.compensate import SagConfig, SagPrediction, predict_sag, stand_on
from planner.sag.docked import Docks
from planner.sag.leg_compliance import HeldResponse, held_response, patch_compliance
from planner.sag.sag_model import AIRBORNE, FootSprings
from planner.stability.margin import cps_margin, support_margin
from planner.stability.stability_map import REASONS, StabilityConfig, stability_map
from planner.stability.stance_torque import peak_torques

UP = np.array([0.0, 0.0, 1.0])
TOUCHDOWNS = ("guarded", "planned")


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Which footfalls are tried, and how they are weighed against each other."""

    radius_fraction: float = 0.6
    """of the stride: candidates lie this near to the nominal footfall"""
    wide_radius_fraction: float = 1.0
    """the same where nothing nearer will do: a rock lies where the foot would go, or hides it"""
    weight_distance: float = 1.0
    """of the distance from the nominal footfall over the search radius"""
    weight_terrain: float = 0.6
    """of the footfall cost over its typical value on walkable ground"""
    typical_terrain: float = 0.0015
    """free volume under SDM-B's wheel on ground with 2 cm of roughness [m3]; a variant has that of its footfall method"""
    weight_future: float = 2.0
    """added where the leg could not carry the chassis one stride further from that footfall"""
    wheel_spacing: float = 0.20
    """between the hulls of two wheels, seen from above [m]"""
    tried: int = 10
    """candidates for which a path is planned before the leg gives up"""
    max_torque_fraction: float = 0.95
    """believed, with the leg in the air"""
    footfall_torque_fraction: float = np.inf
    """of the static torques of all joints with the wheel on the footfall, and in the air there, by loads without interaction
    ([SunSpiral2012] s7.1: reachable, stable, and beyond a joint's limit); by default no footfall is refused for it"""
    max_height_step: float = 0.45
    """a footfall higher or lower than this against the wheel's present contact is not tried [m]"""

    def __post_init__(self) -> None:
        if not (0.0 < self.radius_fraction <= self.wide_radius_fraction < np.inf and self.typical_terrain > 0.0 and self.tried >= 1):
            raise ConfigError(f"step search needs a positive radius, a wide one no smaller, terrain scale and tries, got {self}")
        if not self.footfall_torque_fraction > 0.0:
            given = self.footfall_torque_fraction
            raise ConfigError(f"footfall_torque_fraction is {given}, must be positive; 1.0 is the joints' limit, inf refuses nothing")


@dataclass(frozen=True, kw_only=True)
class TouchdownConfig:
    """Lifting off and coming down."""

    method: str = "guarded"
    """"guarded": down until the wheel carries its share; it feels the ground by the leg's torques. "planned": down to where the
    sag method, asked for the place that it leaves, says that it carries its share, felt or not: open loop, as the robots were
    commanded until 2010 ([SunSpiral2012] s5.1.4; s7.1 wants motions that end at a contact force for the future)"""
    lift_clearance: float = 0.5
    """of the wheel above its old place before it swings, over its radius: covers what the springs do not know of sag"""
    approach_clearance: float = 0.4
    """of the wheel above the footfall where the descent begins, over its radius; the map may be wrong by half of it"""
    search_depth: float = 0.12
    """how far below the expected ground the descent goes on, compensation apart [m]"""
    load_fraction: float = 0.92
    """of the load the springs promise the wheel, at which the descent ends"""

    def __post_init__(self) -> None:
        if self.method not in TOUCHDOWNS:
            raise ConfigError(f"touchdown {self.method!r} is not one of {', '.join(TOUCHDOWNS)}")
        if not 0.1 <= self.load_fraction <= 1.0:
            raise ConfigError(f"load_fraction is {self.load_fraction}, must be within 0.1 to 1")


@dataclass(frozen=True, eq=False, kw_only=True)
class Ground:
    """The terrain as one plan sees it."""

    heights: HeightGrid
    """believed heights, NaN where unknown"""
    filled: HeightGrid
    """the same without NaN: unknown ground as the nearest known"""
    cautious: HeightGrid
    """the same, unknown ground higher than the highest beside it, vague ground by its doubt: what a swing keeps clear of while it
    can"""
    footfalls: FootfallMap


@dataclass(frozen=True, kw_only=True)
class StepConfig:
    """All settings of one step's planning."""

    gait: GaitConfig
    search: SearchConfig
    touchdown: TouchdownConfig
    sag: SagConfig
    stability: StabilityConfig
    collision: CollisionConfig
    swing: SwingConfig
    leg_planner: str
    shift: ShiftLimits
    sway: BodySwayConfig | None = None
    """how shifts leave the straight path for the next swing; None keeps to it"""


@dataclass(frozen=True, eq=False, kw_only=True)
class StepRequest:
    """What step is wanted."""

    leg: int
    """index 0 to 5"""
    heading: Vec2
    """direction of travel in world"""
    remaining: float
    """distance of the chassis from its goal [m]"""
    behind: float = 0.0
    """what earlier chassis shifts were cut short by [m]"""
    yaw: float = 0.0
    """that the chassis shall have in world [rad]"""
    swayed: Vec3 | None = None
    """by which the chassis is off its straight path, in world; the gait's footfalls lie about the path; None on it [m]"""
    footfall_xy: Vec2 | None = None
    """the operator's own choice; the gait's when None [m]"""
    wide: bool = False
    """whether footfalls farther from the gait's are tried too"""
    on_the_spot: bool = False
    """whether the wheel shall come down where it stands, whatever the map says of the place: lifted for the sake of a look"""
    refused_xy: Points2 | None = None
    """places that were refused or failed: not tried again"""
    refused_radius: float = 0.12
    """[m]"""
    extra_lift: float = 0.0
    """after a lift that did not break contact [m]"""
    next_leg: int | None = None
    """that will step after this one, as far as anybody knows; the shift makes it ready to be lifted"""
    cautious: bool = True
    """whether the swing keeps clear of ground that nobody saw; if not, the executive's guard on it must do"""

    def __post_init__(self) -> None:
        length = float(np.linalg.norm(self.heading))
        if not (np.isfinite(length) and abs(length - 1.0) < 1e-6):
            raise PlanningError(f"heading {self.heading} has length {length:g}, must be 1; of a way `unit` makes one")
        if not (np.isfinite(self.remaining) and self.remaining >= 0.0):
            raise PlanningError(f"remaining way is {self.remaining} m, must be finite and not negative")


def search_step(
    kin: Kinematics,
    springs: FootSprings,
    belief: Belief,
    ground: Ground,
    request: StepRequest,
    *,
    config: StepConfig,
    payload_kg: float,
    rng: np.random.Generator,
) -> StepPlan | NoStep:
    """A step of one leg that passes every check, or which check refused how many candidates."""
    leg, refused = request.leg, Counter[str]()
    sag = foreseen_sag(kin, springs, belief, leg, request, config, payload_kg)
    if sag.status != "converged":
        return NoStep(reason=f"leg {leg + 1} cannot be lifted: the springs say {sag.status}", refused={sag.status: 1})
    airborne = not belief.planted[leg]
    contacts = kin.wheels_in_hex(belief.joints) + kin.spec.wheel.radius * belief.gravity_in_hex() / GRAVITY
    aside = sideways_response(kin, belief, sag, contacts)
    swing_pose = belief.world_from_hex
    if not airborne:
        swing_pose = swing_pose.compose(aside.hex_from_moved).compose(sag.standing_from_swinging)
    leg_pose = swing_pose.compose(sag.swinging_from_leg)
    torque = lifting_torque(kin, belief, sag, aside, contacts)
    if torque > config.search.max_torque_fraction and not airborne:
        return NoStep(reason=f"lifting leg {leg + 1} asks {100 * torque:.0f} % of a joint's torque", refused={"torque": 1})

    places = _candidates(kin, belief, ground, request, config, refused)
    if len(places) == 0:
        return NoStep(reason=f"no allowed footfall for leg {leg + 1} near the gait's", refused=dict(refused))
    judged = stability_map(
        kin,
        belief.joints,
        leg=leg,
        footfalls_in_world=places,
        world_from_hex=swing_pose,
        config=config.stability,
        lift=config.touchdown.approach_clearance * kin.spec.wheel.radius + sag.terrain_raise,
        payload_kg=payload_kg,
        world_from_leg=leg_pose,
        standing=belief.planted,
    )
    refused.update({REASONS[code]: int(n) for code, n in enumerate(np.bincount(judged.reason)) if code and n})
    places, landed, lifted = places[judged.ok], judged.joints[judged.ok], judged.lifted[judged.ok]
    if len(places) == 0:
        return NoStep(reason=f"no stable, reachable footfall for leg {leg + 1}", refused=dict(refused))
    if np.isfinite(config.search.footfall_torque_fraction):
        carries = peak_torques(
            kin, belief.joints, leg, landed, lifted=lifted, places=places, world_from_hex=swing_pose, payload_kg=payload_kg
        ) <= config.search.footfall_torque_fraction
        refused["footfall_torque"] += int(np.sum(~carries))
        places = places[carries]
        if len(places) == 0:
            return NoStep(reason=f"leg {leg + 1} reaches no footfall that all joints can carry", refused=dict(refused))
    order = np.argsort(_cost(kin, belief, ground, request, config, places), kind="stable")

    start = lifted_leg(kin, belief, leg, sag, airborne=airborne)
    if start is None:
        return NoStep(reason=f"leg {leg + 1} cannot lift high enough", refused={"lift_reach": 1})
    lift_in_hex, q_break, q_lift = start
    terrain = ground.cautious if request.cautious else ground.filled
    collision = LegCollision(
        kin.spec, _raised(terrain, sag.terrain_raise), leg_pose, belief.joints, leg, config.collision
    )
    for place in places[order[: config.search.tried]]:
        plan = _try(
            kin, springs, belief, ground, request, place,
            sag=sag, swing_pose=swing_pose, leg_pose=leg_pose, lift_in_hex=lift_in_hex, q_break=q_break, q_lift=q_lift,
            collision=collision, torque=torque, config=config, payload_kg=payload_kg, rng=rng, refused=refused,
        )  # fmt: skip
        if plan is not None:
            return plan
    return NoStep(reason=f"no collision-free path for leg {leg + 1}", refused=dict(refused))


def foreseen_sag(
    kin: Kinematics, springs: FootSprings, belief: Belief, leg: int, request: StepRequest, config: StepConfig, payload: float
) -> SagPrediction:
    """What lifting the leg does to the robot, the other legs in the air or on the ground as they are believed."""
    com = kin.com_in_hex(belief.joints, payload)
    return predict_sag(
        kin.wheels_in_hex(belief.motors),
        leg,
        com_planted=com,
        com_airborne=com,
        weight=(kin.spec.mass + payload) * GRAVITY,
        clearance=config.touchdown.lift_clearance * kin.spec.wheel.radius + request.extra_lift,
        springs=springs,
        config=config.sag,
        lifts=np.where(_aloft(belief, leg), AIRBORNE, 0.0),
        gravity_in_hex=belief.gravity_in_hex(),
        docks=Docks.of(kin, belief.joints) if config.sag.docks else None,
    )


def _aloft(belief: Belief, leg: int) -> PerLegFlag:
    """Which legs besides this one are in the air, shape (6,)."""
    return np.asarray(~belief.planted & (np.arange(LEGS) != leg))


def sideways_response(kin: Kinematics, belief: Belief, sag: SagPrediction, contacts: Wheels) -> HeldResponse:
    """What lifting the leg does sideways: nothing where the sag method knows no forces, or where the leg is in the air already."""
    standing = belief.planted & (np.arange(LEGS) != sag.leg)
    if not (sag.forces_swinging.any() and belief.planted[sag.leg]):
        return HeldResponse(forces=np.zeros((LEGS, 3)), hex_from_moved=SE3.identity())
    gravity = belief.gravity_in_hex()
    change = (sag.forces_swinging - belief.forces) @ -gravity / GRAVITY
    compliance = patch_compliance(kin, belief.joints, belief.joint_stiffness, gravity)
    return held_response(
        compliance, np.where(standing, change, 0.0), contacts, standing, gravity,
        released=np.where(standing[:, None], 0.0, belief.forces),
    )  # fmt: skip


def lifting_torque(kin: Kinematics, belief: Belief, sag: SagPrediction, aside: HeldResponse, contacts: Wheels) -> float:
    """Largest joint torque over its limit with the leg in the air; 0 where the sag method knows no forces.

    Loads change as the springs foresee; what comes with them sideways is what the legs' own compliance drives, on top of what the
    torques tell of the stance as it is.
    """
    if not sag.forces_swinging.any():
        return 0.0
    gravity = belief.gravity_in_hex()
    up = -gravity / GRAVITY
    sideways = belief.forces - np.outer(belief.forces @ up, up) + aside.forces
    forces = np.outer(sag.forces_swinging @ up, up) + sideways
    forces[~belief.planted | (np.arange(LEGS) == sag.leg)] = 0.0
    fractions = torque_fractions(kin, belief.joints, wheel_forces_in_hex=forces, contact_in_hex=contacts, gravity_in_hex=gravity)
    return float(np.abs(fractions).max())


def _candidates(
    kin: Kinematics, belief: Belief, ground: Ground, request: StepRequest, config: StepConfig, refused: Counter[str]
) -> Points3:
    """Allowed cells near the nominal footfall, shape (n, 3)."""
    if request.on_the_spot:
        return belief.contacts_in_world[request.leg : request.leg + 1].copy()
    spec, grid = kin.spec, ground.footfalls.grid
    if request.footfall_xy is not None:
        target, radius = request.footfall_xy, 1.5 * grid.cell
    else:
        target = nominal_footfall(
            spec, config.gait, leg=request.leg, world_from_hex=on_path(belief, request.swayed), heading=request.heading,
            remaining=request.remaining,
        )  # fmt: skip
        search = config.search
        radius = (search.wide_radius_fraction if request.wide else search.radius_fraction) * stride(spec, config.gait)
    xs, ys = grid.centres()
    near = np.hypot(xs[:, None] - target[0], ys[None, :] - target[1]) <= radius
    ix, iy = np.nonzero(near)
    veto = ground.footfalls.veto[ix, iy]
    for code in np.unique(veto[veto != 0]):
        refused[ground.footfalls.reasons[int(code)]] += int(np.sum(veto == code))
    ix, iy = ix[veto == 0], iy[veto == 0]
    places = np.column_stack([xs[ix], ys[iy], ground.footfalls.contact_height[ix, iy]])

    others = np.delete(belief.contacts_in_world[:, :2], request.leg, axis=0)
    distance = np.linalg.norm(places[:, None, :2] - others[None], axis=-1).min(axis=1)
    apart = distance >= 2 * spec.wheel.radius + config.search.wheel_spacing
    refused["near_another_wheel"] += int(np.sum(~apart))
    present = belief.contacts_in_world[request.leg]
    climb = np.abs(places[:, 2] - present[2]) <= config.search.max_height_step
    refused["height_step"] += int(np.sum(apart & ~climb))
    keep = apart & climb
    if belief.planted[request.leg] and request.footfall_xy is None:
        moves = (places[:, :2] - present[:2]) @ request.heading >= min(config.gait.min_step, request.remaining)
        refused["no_progress"] += int(np.sum(keep & ~moves))
        keep &= moves
    if request.refused_xy is not None and len(request.refused_xy):
        again = np.linalg.norm(places[:, None, :2] - request.refused_xy[None], axis=-1).min(axis=1)
        keep &= again > request.refused_radius
    return np.asarray(places[keep])


def _cost(
    kin: Kinematics, belief: Belief, ground: Ground, request: StepRequest, config: StepConfig, places: Points3
) -> np.ndarray:
    spec, search = kin.spec, config.search
    path = on_path(belief, request.swayed)
    target = nominal_footfall(
        spec, config.gait, leg=request.leg, world_from_hex=path, heading=request.heading,
        remaining=request.remaining,
    )  # fmt: skip
    if request.footfall_xy is not None:
        target = request.footfall_xy
    span = stride(spec, config.gait)
    ix, iy, _ = ground.footfalls.grid.index(places[:, :2])
    distance = np.linalg.norm(places[:, :2] - target, axis=1) / (search.radius_fraction * span)
    terrain = np.minimum(ground.footfalls.cost[ix, iy] / search.typical_terrain, 3.0)
    ahead = min(span, request.remaining)
    later = SE3(path.rotation, path.translation + np.append(ahead * request.heading, 0.0))
    hex_from_world = later.inverse()
    _, holds = leg_ik(
        spec, request.leg, hex_from_world.apply(places + spec.wheel.radius * UP), last_link_in_hex=hex_from_world.rotate(-UP)
    )
    return np.asarray(
        search.weight_distance * distance + search.weight_terrain * terrain + search.weight_future * ~holds
    )


def on_path(belief: Belief, swayed: Vec3 | None) -> SE3:
    """The chassis where its straight path has it."""
    pose = belief.world_from_hex
    return pose if swayed is None else SE3(pose.rotation, pose.translation - swayed)


def lifted_leg(
    kin: Kinematics, belief: Belief, leg: int, sag: SagPrediction, *, airborne: bool
) -> tuple[Vec3 | None, np.ndarray, np.ndarray] | None:
    """Axle after lift-off, motor angles where the wheel leaves the ground, and motor angles after lift-off.

    Until contact breaks the wheel stays where it is while the chassis sinks, so only the way above is checked.
    """
    if airborne:
        return None, belief.motors[leg], belief.motors[leg]
    pose = kin.leg_wheel(leg, belief.motors[leg])
    up = -belief.gravity_in_hex() / GRAVITY
    target = pose.translation + sag.commanded_lift * up
    heights = np.array([0.5 * sag.lift_to_break, sag.lift_to_break, sag.commanded_lift])
    steps = pose.translation + heights[:, None] * up
    q, ok = leg_ik(kin.spec, leg, steps, last_link_in_hex=pose.rotation[:, 0])
    return (target, q[1], q[2]) if ok.all() else None


def _try(
    kin: Kinematics,
    springs: FootSprings,
    belief: Belief,
    ground: Ground,
    request: StepRequest,
    place: Vec3,
    *,
    sag: SagPrediction,
    swing_pose: SE3,
    leg_pose: SE3,
    lift_in_hex: Vec3 | None,
    q_break: np.ndarray,
    q_lift: np.ndarray,
    collision: LegCollision,
    torque: float,
    config: StepConfig,
    payload_kg: float,
    rng: np.random.Generator,
    refused: Counter[str],
) -> StepPlan | None:
    spec, leg, touch = kin.spec, request.leg, config.touchdown
    hex_from_world = leg_pose.inverse()
    axle = place + spec.wheel.radius * UP
    # On a lifted map the way through the air ends on the ground as lifted: what is left is for the chassis to come back up.
    approach = touch.approach_clearance * spec.wheel.radius + sag.terrain_raise
    above, down = hex_from_world.apply(axle + approach * UP), hex_from_world.rotate(-UP)
    depth = sag.reload + (touch.search_depth if touch.method == "guarded" else 0.0)
    mapped = hex_from_world.apply(axle + sag.terrain_raise * UP)
    ends = np.array([above, mapped, hex_from_world.apply(axle - depth * UP)])
    q, ok = leg_ik(spec, leg, ends, last_link_in_hex=down)
    # With its load back on the wheel the chassis is back up, and the leg's deck no longer twisted.
    hex_from_landed = belief.world_from_hex.inverse()
    standing_q, stands = leg_ik(spec, leg, hex_from_landed.apply(axle[None]), last_link_in_hex=hex_from_landed.rotate(-UP))
    if not (ok.all() and stands.all()):
        refused["descent_reach"] += 1
        return None
    waypoints, tolerance, checks = q_lift[None], config.swing.corner_tolerance, 0
    if not request.on_the_spot:  # straight down again, where it came from: no way to plan
        path = plan_swing(
            collision, spec, q_break, q[1],
            lift_waypoint_q=q_lift, touchdown_waypoint_q=q[0], planner=config.leg_planner, rng=rng, config=config.swing,
        )  # fmt: skip
        if not isinstance(path, SwingPath):
            refused[f"path_{path.reason}"] += 1
            return None
        waypoints, tolerance, checks = path.waypoints, path.corner_tolerance, path.checks

    landed = belief.joints.copy()
    landed[leg] = standing_q[0]
    contacts = belief.contacts_in_world.copy()
    contacts[leg] = place
    com_swing = swing_pose.apply(kin.com_in_hex(belief.joints, payload_kg))
    com_landed = belief.world_from_hex.apply(kin.com_in_hex(landed, payload_kg))
    standing = stand_on(
        kin.wheels_in_hex(landed),
        kin.com_in_hex(landed, payload_kg),
        (spec.mass + payload_kg) * GRAVITY,
        springs,
        np.where(belief.planted | (np.arange(6) == leg), 0.0, AIRBORNE),
        belief.gravity_in_hex(),
        Docks.of(kin, landed) if config.sag.docks else None,
    )
    share = float(standing.forces[leg] @ -belief.gravity_in_hex() / GRAVITY)
    if not standing.converged or share <= 0.0:
        refused["landed_load"] += 1
        return None
    aloft = _aloft(belief, leg)
    shift = BodyShift.none() if aloft.any() else plan_shift(
        kin, belief, leg=leg, upcoming=next_lift(kin, springs, belief, landed, request, config, payload_kg),
        landed_joints=landed, contacts_in_world=contacts, heading=request.heading,
        remaining=request.remaining, behind=request.behind, yaw=request.yaw, swayed=request.swayed,
        sway=config.sway, filled=ground.filled, gait=config.gait, stability=config.stability, limits=config.shift,
        collision=config.collision, payload_kg=payload_kg,
    )  # fmt: skip
    poses, joints = [belief.world_from_hex], [belief.joints]
    for waypoint in (q_lift, *waypoints, q[0]):
        row = belief.joints.copy()
        row[leg] = waypoint
        joints.append(row)
        poses.append(swing_pose)
    joints.append(landed)
    poses.append(belief.world_from_hex)
    drop = swing_pose.translation[2] - belief.world_from_hex.translation[2]
    return StepPlan(
        leg=leg,
        footfall_in_world=np.asarray(place),
        lift_in_hex=lift_in_hex,
        swing=waypoints,
        swing_corner_tolerance=tolerance,
        swing_time=leg_timing(spec, np.concatenate([q_lift[None], waypoints]), corner_tolerance=tolerance).duration,
        descent_in_hex=ends[2],
        descent_guard="contact" if touch.method == "guarded" else "place",
        reload=sag.reload,
        contact_load=touch.load_fraction * share,
        shift=shift,
        world_from_hex_swing=swing_pose,
        world_from_leg_swing=leg_pose,
        preview_joints=np.array(joints),
        preview_world_from_hex=tuple(poses),
        lift_clearance=touch.lift_clearance * spec.wheel.radius + request.extra_lift,
        swing_margin=float(support_margin(com_swing, contacts[~aloft & (np.arange(LEGS) != leg)])),
        landed_margin=float(support_margin(com_landed, contacts[~aloft]) if aloft.any() else cps_margin(com_landed, contacts)),
        sag=float(max(abs(drop), sag.tilt * np.linalg.norm(spec.hips_in_hex[leg]))),
        peak_torque_fraction=torque,
        planner_checks=checks,
    )


def next_lift(
    kin: Kinematics, springs: FootSprings, belief: Belief, landed: Joints, request: StepRequest, config: StepConfig, payload: float
) -> NextLift | None:
    """What the next leg's lift will ask of the legs standing at `landed`; None where nobody knows which leg that is."""
    if request.next_leg is None:
        return None
    com = kin.com_in_hex(landed, payload)
    sag = predict_sag(
        kin.wheels_in_hex(landed), request.next_leg, com_planted=com, com_airborne=com, weight=(kin.spec.mass + payload) * GRAVITY,
        clearance=0.0, springs=springs, config=config.sag, gravity_in_hex=belief.gravity_in_hex(),
        docks=Docks.of(kin, landed) if config.sag.docks else None,
    )  # fmt: skip
    if sag.status != "converged":
        return NextLift(leg=request.next_leg, load_change=np.zeros(LEGS), height=0.0)
    change = np.asarray((sag.forces_swinging - sag.forces_standing) @ -belief.gravity_in_hex() / GRAVITY)
    height = sag.commanded_lift + config.touchdown.lift_clearance * kin.spec.wheel.radius
    return NextLift(leg=request.next_leg, load_change=change, height=height)


def _raised(heights: HeightGrid, by: float) -> HeightGrid:
    """The terrain lifted, the heuristic of 2008 ([SunSpiral2012] s4.1)."""
    if by == 0.0:
        return heights
    return HeightGrid(
        origin_x=heights.origin_x, origin_y=heights.origin_y, cell=heights.cell, heights=heights.heights + by
    )
