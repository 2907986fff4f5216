"""A step of two opposite legs at once: both leave the ground, swing and come down while the other four wheels carry.

Place in the flow: fused terrain and belief -> `StepPlan` with a companion, or `NoStep`; the agent then steps one leg at a time.
[SunSpiral2012] s7.1 and figure 16: with two diametrically opposed legs in the air the weight lies evenly on the four others, so that
the largest joint torque can be lower than with one. Commands run one after the other, so the first leg leaves and lands alone.

Each leg's step is searched as any other, on the belief as it will be with the other leg in the air: its loads, its sunk chassis, its
posture. The second leg swings past the first where that hangs above its footfall, and comes down on a robot that stands on five.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from athlete_twin.geometry.arrays import LegJoints, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.statics import patches_in_hex
from planner.belief import Belief
from planner.decisions import NoStep
from planner.gait.shift import plan_shift
from planner.gait.step_plan import StepPlan
from planner.gait.step_search import (
    UP,
    Ground,
    StepConfig,
    StepRequest,
    foreseen_sag,
    lifted_leg,
    lifting_torque,
    next_lift,
    search_step,
    sideways_response,
)
from planner.sag.compensate import SagPrediction, stand_on
from planner.sag.docked import Docks
from planner.sag.sag_model import FootSprings
from planner.stability.margin import cps_margin, cps_tip_over_energy, support_margin


def search_pair(
    kin: Kinematics,
    springs: FootSprings,
    belief: Belief,
    ground: Ground,
    first: StepRequest,
    second: StepRequest,
    *,
    config: StepConfig,
    payload_kg: float,
    rng: np.random.Generator,
) -> StepPlan | NoStep:
    """A step of two legs that passes every check of either, or which check refused it.

    Args:
        kin: of the drawings.
        springs: believed, of the feet.
        belief: all wheels on the ground.
        ground: the terrain.
        first: of the leg that lifts and lands first; its `next_leg` is the one after both.
        second: of the leg across.
        config: settings.
        payload_kg: [kg]
        rng: for the sampling planner alone.
    """
    a, b = first.leg, second.leg
    who = f"legs {a + 1} and {b + 1} together"
    alone = {r.leg: foreseen_sag(kin, springs, belief, r.leg, r, config, payload_kg) for r in (first, second)}
    failed = next((sag for sag in alone.values() if sag.status != "converged"), None)
    if failed is not None:
        return NoStep(reason=f"{who}: leg {failed.leg + 1} cannot be lifted: the springs say {failed.status}", refused={failed.status: 1})
    up_first = lifted_leg(kin, belief, a, alone[a], airborne=False)
    if up_first is None:
        return NoStep(reason=f"{who}: leg {a + 1} cannot lift high enough", refused={"lift_reach": 1})
    raised = _one_up(kin, belief, alone[a], up_first[2])
    sag = foreseen_sag(kin, springs, raised, b, second, config, payload_kg)
    if sag.status != "converged":
        return NoStep(reason=f"{who} cannot be lifted: the springs say {sag.status}", refused={sag.status: 1})
    up_second = lifted_leg(kin, raised, b, sag, airborne=False)
    if up_second is None:
        return NoStep(reason=f"{who}: leg {b + 1} cannot lift high enough", refused={"lift_reach": 1})

    other_up = _one_up(kin, belief, alone[b], up_second[2])
    # The first leg breaks contact while the second still stands, which may take more than both in the air ask for.
    both = foreseen_sag(kin, springs, other_up, a, first, config, payload_kg)
    extra = max(0.0, alone[a].commanded_lift - both.commanded_lift) if both.status == "converged" else 0.0
    one = search_step(
        kin, springs, other_up, ground, replace(first, next_leg=None, extra_lift=first.extra_lift + extra), config=config,
        payload_kg=payload_kg, rng=rng,
    )  # fmt: skip
    if isinstance(one, NoStep):
        return replace(one, reason=f"{who}: {one.reason}")
    over = _one_up(kin, belief, alone[a], one.swing[-1], footfall=one.footfall_in_world)
    two = search_step(kin, springs, over, ground, replace(second, next_leg=None), config=config, payload_kg=payload_kg, rng=rng)
    if isinstance(two, NoStep):
        return replace(two, reason=f"{who}: {two.reason}")
    one = replace(one, lift_clearance=one.lift_clearance - extra)
    joined = _joined(kin, springs, belief, ground, first, one, two, config, payload_kg)
    if isinstance(joined, str):
        return NoStep(reason=f"{who}: {joined}", refused=Counter({joined: 1}))
    leaving = _alone_up(kin, belief, alone[a])
    if leaving > config.search.max_torque_fraction:
        return NoStep(reason=f"{who}: lifting leg {a + 1} asks {100 * leaving:.0f} % of a joint's torque", refused={"torque": 1})
    return replace(joined, peak_torque_fraction=max(leaving, joined.peak_torque_fraction))


def _alone_up(kin: Kinematics, belief: Belief, sag: SagPrediction) -> float:
    """Largest joint torque over its limit while one leg of the pair is in the air and the other stands."""
    contacts = patches_in_hex(kin, belief.joints, belief.gravity_in_hex())
    return lifting_torque(kin, belief, sag, sideways_response(kin, belief, sag, contacts), contacts)


def _one_up(
    kin: Kinematics, belief: Belief, sag: SagPrediction, leg_joints: LegJoints, *, footfall: Vec3 | None = None
) -> Belief:
    """The robot as it will be with one leg in the air at these angles [rad], its next contact there [m] if it is known."""
    leg = sag.leg
    contacts = patches_in_hex(kin, belief.joints, belief.gravity_in_hex())
    aside = sideways_response(kin, belief, sag, contacts)
    joints, motors, places = belief.joints.copy(), belief.motors.copy(), belief.contacts_in_world.copy()
    joints[leg] = motors[leg] = leg_joints
    planted, forces = belief.planted.copy(), belief.forces + aside.forces
    planted[leg] = False
    up = -belief.gravity_in_hex() / GRAVITY
    # Of what the springs foresee the loads alone: what goes sideways with them is the response's.
    forces = forces + np.outer((sag.forces_swinging - sag.forces_standing) @ up, up)
    forces[leg] = 0.0
    if footfall is not None:
        places[leg] = footfall
    pose = belief.world_from_hex.compose(aside.hex_from_moved).compose(sag.standing_from_swinging)
    return replace(
        belief, joints=joints, motors=motors, world_from_hex=pose, contacts_in_world=places, planted=planted, forces=forces,
        loads=np.maximum(forces @ up, 0.0), interaction=np.zeros_like(belief.interaction),
    )  # fmt: skip


def _joined(
    kin: Kinematics,
    springs: FootSprings,
    belief: Belief,
    ground: Ground,
    request: StepRequest,
    one: StepPlan,
    two: StepPlan,
    config: StepConfig,
    payload_kg: float,
) -> StepPlan | str:
    """Both steps as one plan, with the second leg's descent onto a robot that stands on five, and the shift after it; else why not."""
    spec, pose = kin.spec, belief.world_from_hex
    hex_from_world = pose.inverse()
    joints, motors, places = belief.joints.copy(), belief.motors.copy(), belief.contacts_in_world.copy()
    interaction = belief.interaction.copy()
    for part in (one, two):
        axle = part.footfall_in_world + spec.wheel.radius * UP
        q, stands = leg_ik(spec, part.leg, hex_from_world.apply(axle[None]), last_link_in_hex=hex_from_world.rotate(-UP))
        if not stands[0]:
            return "descent_reach"
        joints[part.leg] = motors[part.leg] = q[0]
        places[part.leg], interaction[part.leg] = part.footfall_in_world, 0.0
    landed = replace(belief, joints=joints, motors=motors, contacts_in_world=places, interaction=interaction)
    sag = foreseen_sag(kin, springs, landed, two.leg, replace(request, extra_lift=0.0), config, payload_kg)
    if sag.status != "converged":
        return sag.status
    down = _descent(kin, landed, two, sag, config)
    if isinstance(down, str):
        return down
    landing = _alone_up(kin, landed, sag)
    if landing > config.search.max_torque_fraction:
        return "torque"
    weight, gravity = (spec.mass + payload_kg) * GRAVITY, belief.gravity_in_hex()
    com = kin.com_in_hex(joints, payload_kg)
    standing = stand_on(
        kin.wheels_in_hex(joints), com, weight, springs, np.zeros(6), gravity, Docks.of(kin, joints) if config.sag.docks else None
    )
    share = float(standing.forces[two.leg] @ -gravity / GRAVITY)
    if not standing.converged or share <= 0.0:
        return "landed_load"
    if refusal := _landed_refusal(pose.apply(com), places, config):
        return refusal
    shift = plan_shift(
        kin, landed, leg=two.leg, upcoming=next_lift(kin, springs, landed, joints, request, config, payload_kg),
        landed_joints=joints, contacts_in_world=places, heading=request.heading,
        remaining=request.remaining, behind=request.behind, yaw=request.yaw, swayed=request.swayed,
        sway=config.sway, filled=ground.filled, gait=config.gait, stability=config.stability, limits=config.shift,
        collision=config.collision, payload_kg=payload_kg, legs=2,
    )  # fmt: skip
    both = belief.joints.copy()
    both[[one.leg, two.leg]] = one.swing[-1], two.swing[-1]
    carrying = np.delete(belief.contacts_in_world, [one.leg, two.leg], axis=0)
    over = support_margin(two.world_from_hex_swing.apply(kin.com_in_hex(both, payload_kg)), carrying)
    return replace(
        one,
        shift=shift,
        companion=replace(two, descent_in_hex=down, contact_load=config.touchdown.load_fraction * share),
        landed_margin=float(cps_margin(pose.apply(com), places)),
        swing_margin=min(one.swing_margin, two.swing_margin, float(over)),
        sag=_drop(belief, two.world_from_hex_swing, spec.hips_in_hex[[one.leg, two.leg]]),
        peak_torque_fraction=max(one.peak_torque_fraction, two.peak_torque_fraction, landing),
        swing_time=one.swing_time + two.swing_time,
        planner_checks=one.planner_checks + two.planner_checks,
        preview_joints=np.concatenate([belief.joints[None], one.preview_joints, two.preview_joints, joints[None]]),
        preview_world_from_hex=(pose, *one.preview_world_from_hex, *two.preview_world_from_hex, pose),
    )


def _descent(kin: Kinematics, landed: Belief, two: StepPlan, sag: SagPrediction, config: StepConfig) -> Vec3 | str:
    """Lowest axle of the second leg's descent in hex, the first leg standing again [m]; else why it cannot be.

    As the first leg loads its wheel, the chassis sinks towards the second, whose wheel must still hang clear of what the map errs by.
    """
    touch, radius = config.touchdown, kin.spec.wheel.radius
    carried: SE3 = landed.world_from_hex.compose(sag.standing_from_swinging).compose(sag.swinging_from_leg)
    hanging = carried.apply(kin.leg_wheel(two.leg, two.swing[-1]).translation)[2] - radius - two.footfall_in_world[2]
    if hanging < 0.5 * touch.approach_clearance * radius:
        return "hangs_low"
    depth = sag.reload + (touch.search_depth if touch.method == "guarded" else 0.0)
    axle = carried.inverse().apply(two.footfall_in_world + (radius - depth) * UP)
    last_link = kin.leg_wheel(two.leg, two.swing[-1]).rotation[:, 0]
    _, reached = leg_ik(kin.spec, two.leg, axle[None], last_link_in_hex=last_link)
    return np.asarray(axle) if reached[0] else "descent_reach"


def _landed_refusal(com_in_world: Vec3, contacts_in_world: Wheels, config: StepConfig) -> str:
    """What the rule for all wheels down says of the stance that both steps make; empty when nothing."""
    rule = config.stability
    stands = {
        "cps": lambda: cps_margin(com_in_world, contacts_in_world) >= rule.min_margin,
        "support": lambda: support_margin(com_in_world, contacts_in_world) >= rule.min_margin,
        "energy": lambda: cps_tip_over_energy(com_in_world, contacts_in_world) >= rule.min_energy,
    }[rule.all_down]()
    return "" if stands else "landed_margin"


def _drop(belief: Belief, world_from_hex: SE3, hips_in_hex: np.ndarray) -> float:
    """By which the chassis drops at its origin or turns at the legs' hips, the larger [m]."""
    moved = belief.world_from_hex.inverse().compose(world_from_hex)
    turned = float(np.linalg.norm(moved.rotvec())) * float(np.linalg.norm(hips_in_hex, axis=1).max())
    return max(abs(float(world_from_hex.translation[2] - belief.world_from_hex.translation[2])), turned)
