"""Out of the way with all wheels down: where no leg finds a step, the chassis goes sideways, turns, or both, and then one does.

Place in the flow: belief, ground, and the steps that were sought in vain -> `AsidePlan | NoAside`, before other headings are tried.
The gait's footfalls lie about the chassis, so that they move with it, and so does what each leg reaches. Small moves come first.
A move must keep all legs in reach, the stability rule, the torques and every clearance all along its way (`gait.shift` says what
forbids a stance); of those that do, the first is taken from whose end, as believed beforehand, a leg that is due finds a step.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Joints, PerLeg, Vec2
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import LEGS
from planner.belief import Belief
from planner.gait.shift import allowed_torques, stance_refusal
from planner.gait.step_plan import StepPlan
from planner.gait.step_search import Ground, StepConfig
from planner.motion.collision import BodyCollision
from planner.stability.margin import cps_margin

ALONG = (0.25, 0.5, 0.75, 1.0)
"""of a move, where it is checked: 5 cm and 2.5 deg apart at most by default"""


@dataclass(frozen=True, kw_only=True)
class AsideConfig:
    """Which moves are tried, and how often."""

    across: tuple[float, ...] = (0.10, 0.20)
    """to both sides of the heading; none tries none [m]"""
    turn_deg: tuple[float, ...] = (5.0, 10.0)
    """to both sides, by itself and with each move across; none tries none [deg]"""
    between_steps: int = 2
    """moves without a step between; 0 tries none"""
    steps_turned: int = LEGS
    """a turn is kept for so many steps; then shifts turn the chassis back"""

    def __post_init__(self) -> None:
        for name, limit in (("across", 0.5), ("turn_deg", 30.0)):
            values = np.asarray(getattr(self, name), dtype=float)
            if not (np.isfinite(values).all() and (values > 0.0).all() and (values <= limit).all()):
                raise ConfigError(f"{name} is {getattr(self, name)}, need values above 0 and at most {limit:g}, or none")
            if len(values) > 4:
                raise ConfigError(f"{name} has {len(values)} values, at most 4: moves across and turns multiply")
        if self.between_steps < 0 or self.steps_turned < 1:
            raise ConfigError(f"between_steps is {self.between_steps} and steps_turned {self.steps_turned}, need 0 and 1 or more")


@dataclass(frozen=True, eq=False, kw_only=True)
class AsidePlan:
    """One move of the chassis over planted wheels."""

    command: BodyMove
    across: float
    """to the left of the heading [m]"""
    turn: float
    """to the left [rad]"""
    world_from_hex: tuple[SE3, ...]
    """believed chassis along the way, the present one first"""
    preview_joints: np.ndarray
    """believed, one for each of them, shape (k, 6, dof) [rad]"""
    margin: float
    """least CPS margin along the way [m]"""
    leg: int
    """that then finds a step, index 0 to 5"""

    @property
    def text(self) -> str:
        """One line for the operator."""
        parts = []
        for size, unit, verb in ((100 * self.across, "cm", "goes"), (np.rad2deg(self.turn), "deg", "turns")):
            if abs(size) > 1e-9:
                parts.append(f"{verb} {abs(size):.0f} {unit} to the {'left' if size > 0.0 else 'right'}")
        return f"no leg finds a step: the chassis {' and '.join(parts)} over its wheels, then leg {self.leg + 1} has one"


@dataclass(frozen=True, eq=False, kw_only=True)
class NoAside:
    """No move of the chassis helps."""

    reason: str
    refused: Counter[str]
    """how many moves each check refused"""


class Asides:
    """What was moved aside since the last step, and how the chassis shall stand because of it."""

    def __init__(self, config: AsideConfig) -> None:
        self._config, self._taken, self._steps_left = config, 0, 0
        self._yaw, self._refused = 0.0, False

    @property
    def barred(self) -> str:
        """Why no other move may be tried before the next step; empty when one may."""
        if self._refused:
            return "a move of the chassis aside was refused or broke off"
        if self._taken >= self._config.between_steps:
            return f"{self._taken} moves of the chassis aside since the last step are as many as may be"
        return ""

    @property
    def yaw(self) -> float:
        """That the chassis shall have in world [rad]."""
        return self._yaw if self._steps_left > 0 else 0.0

    def took(self, turn: float) -> None:
        """A move was made, turned to the left by so much [rad]."""
        self._taken += 1
        if turn != 0.0:
            self._yaw, self._steps_left = self.yaw + turn, self._config.steps_turned

    def give_up(self) -> None:
        """It was refused by the operator, or broke off: no other before the next step."""
        self._refused = True

    def stepped(self) -> None:
        """A step was made."""
        self._taken, self._refused, self._steps_left = 0, False, max(0, self._steps_left - 1)


def plan_aside(
    kin: Kinematics,
    belief: Belief,
    ground: Ground,
    heading: Vec2,
    step_from: Callable[[Belief, float], StepPlan | None],
    *,
    config: AsideConfig,
    step: StepConfig,
    payload_kg: float,
) -> AsidePlan | NoAside:
    """The least move after which a step is found, or what refused how many moves.

    Args:
        kin: of the drawings.
        belief: of the robot, all wheels down.
        ground: the terrain.
        heading: of travel in world; moves go across it.
        step_from: finds a step of a leg that is due from a belief, the chassis turned to the left by so much for it [rad].
        config: which moves.
        step: all settings of a step.
        payload_kg: [kg]
    """
    if not belief.planted.all():
        return NoAside(reason="a leg is in the air", refused=Counter())
    body = BodyCollision(kin.spec, ground.filled, step.collision)
    body.come_no_nearer(belief.joints)
    wheels = belief.world_from_hex.apply(kin.wheels_in_hex(belief.joints))
    allowed = allowed_torques(kin, belief.world_from_hex, wheels, step.shift, payload_kg)
    refused = Counter[str]()
    for across, turn in moves(config, kin.spec.foot_radius):
        way = [_moved(kin, belief, heading, share * across, share * turn) for share in ALONG]
        refusal = ""
        for there in way:
            refusal = refusal or ("aside_reach" if there is None else _refusal(kin, there, belief, step, allowed, body, payload_kg))
        if refusal:
            refused[refusal] += 1
            continue
        poses = [belief, *(there for there in way if there is not None)]
        found = step_from(poses[-1], turn)
        if found is not None:
            return _planned(kin, poses, across, turn, found.leg, payload_kg)
        refused["aside_no_step"] += 1
    return NoAside(reason=_told(refused), refused=refused)


def moves(config: AsideConfig, foot_radius: float) -> list[tuple[float, float]]:
    """All moves: to the left [m] and turned to the left [rad], the least first, left before right.

    A turn counts by how far it moves a wheel under the chassis.
    """
    sides = [0.0, *(s * a for a in config.across for s in (1.0, -1.0))]
    turns = [0.0, *(s * np.deg2rad(a) for a in config.turn_deg for s in (1.0, -1.0))]
    every = [(side, float(turn)) for side in sides for turn in turns if side != 0.0 or turn != 0.0]
    return sorted(every, key=lambda move: round(abs(move[0]) + foot_radius * abs(move[1]), 9))


def _moved(kin: Kinematics, belief: Belief, heading: Vec2, across: float, turn: float) -> Belief | None:
    """The robot as it will be believed, its motors as the executive will turn them; None beyond reach."""
    pose = belief.world_from_hex
    left = across * np.array([-heading[1], heading[0], 0.0])
    end = SE3(SE3.from_rotvec(np.array([0.0, 0.0, turn])).rotation @ pose.rotation, pose.translation + left)
    hex_from_start = end.inverse().compose(pose)
    axles = [kin.leg_wheel(leg, belief.motors[leg]) for leg in range(LEGS)]
    motors, ok = all_legs_ik(
        kin.spec, hex_from_start.apply(np.array([axle.translation for axle in axles])),
        last_link_in_hex=hex_from_start.rotate(np.array([axle.rotation[:, 0] for axle in axles])),
    )  # fmt: skip
    if not ok.all():
        return None
    # The wind-up is that of the same loads, near enough: the weight moves by a fraction of what the chassis does.
    joints: Joints = motors + (belief.joints - belief.motors)
    return replace(belief, world_from_hex=end, motors=motors, joints=joints)


def _refusal(
    kin: Kinematics, there: Belief, start: Belief, step: StepConfig, allowed: PerLeg, body: BodyCollision, payload_kg: float
) -> str:
    wheels = start.world_from_hex.apply(kin.wheels_in_hex(start.joints))
    why = stance_refusal(
        kin, there.world_from_hex, wheels, start.contacts_in_world, step.stability, allowed, body, payload_kg
    )
    for kind in ("reach", "torque", "margin"):
        if kind in why:
            return f"aside_{kind}"
    return "aside_collision" if why else ""


def _planned(
    kin: Kinematics, poses: list[Belief], across: float, turn: float, leg: int, payload_kg: float
) -> AsidePlan:
    start_from_end = poses[0].world_from_hex.inverse().compose(poses[-1].world_from_hex)
    margins = [
        cps_margin(there.world_from_hex.apply(kin.com_in_hex(there.joints, payload_kg)), there.contacts_in_world) for there in poses
    ]
    return AsidePlan(
        command=BodyMove(translation_in_hex=start_from_end.translation, rotvec_in_hex=start_from_end.rotvec()),
        across=across,
        turn=turn,
        world_from_hex=tuple(there.world_from_hex for there in poses),
        preview_joints=np.array([there.joints for there in poses]),
        margin=float(min(margins)),
        leg=leg,
    )


def _told(refused: Counter[str]) -> str:
    words = {"aside_no_step": "no step after it"}
    each = (f"{words.get(kind, kind.removeprefix('aside_'))} ({count})" for kind, count in refused.most_common())
    return "no move of the chassis sideways or about helps: " + (", ".join(each) or "none is to be tried")
