"""The chassis pose from which a leg is lifted: as high as commanded and level while the leg is in the air, loads spread.

[SunSpiral2012] s5.1.1 extends the spring model to gradual unloading for this: "pose optimization to redistribute the
loads and mitigate the effects of sag". When a leg unloads, the springs under the others give way and the chassis sinks
and tilts towards it. Here that is taken off beforehand, by one `BodyMove` with all wheels planted: the chassis is
raised and tilted the other way by as much, may be shifted towards the middle of the wheels that will stand, and single
wheels are pressed down or drawn up a little so that their loads are as even as balance allows. Once the leg is in the
air, the chassis is where the command says, so that a wheel commanded to clear the ground by 0.3 m does.

Frames. `motors` say where the springs would hold the wheels without weight, in the hex frame before the move; gravity
and the wanted pose are given there too. The move makes a new unsagged hex frame. Forward model is `solve_sag` alone: an
iteration puts the sagged chassis on the wanted pose and the loads on the even ones, and its last solution is the
check that the result reports.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from athlete_twin.errors import SagError
from athlete_twin.geometry.arrays import Joints, Mat3, PerLeg, PerLegFlag, Points3, Vec2, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import LEGS
from planner.sag.lift_pose import LiftPose, NoPose, PoseConfig
from planner.sag.sag_model import AIRBORNE, DOWN, FootSprings, SagSolution, solve_sag
from planner.sag.spread import Spread, shift_towards_even, spread_loads
from planner.stability.margin import cps_margin, support_margin

FRACTIONS = (1.0, 0.75, 0.5, 0.25, 0.0)
"""of the shift that reach and margin may leave"""
HEIGHT_TOLERANCE, TURN_TOLERANCE = 1e-6, 1e-7
"""of the sagged chassis from the wanted pose, where the iteration ends [m], [rad]"""
MAX_ROUNDS = 25
NARROWEST = 0.05
"""standard deviation of the standing wheels from the line nearest to them, below which they are on it [m]"""
PROBE = 0.02
"""shift by which the movement of the CoM is measured [m]"""


def optimise_pose(
    kin: Kinematics,
    motors: Joints,
    leg: int,
    *,
    springs: FootSprings,
    clearance: float,
    config: PoseConfig,
    lifts: PerLeg | None = None,
    gravity_in_hex: Vec3 = DOWN,
    wanted_in_hex: SE3 | None = None,
    payload_kg: float = 0.0,
) -> LiftPose | NoPose:
    """The move before a lift that leaves the sagged chassis where it is wanted, with the most even loads.

    Args:
        kin: of the robot.
        motors: commanded angles with the wheels planted, shape (6, dof) [rad].
        leg: index 0 to 5 of the leg that will be lifted.
        springs: the believed springs.
        clearance: of the lifted wheel over its place, true once the robot has sagged [m].
        config: bounds.
        lifts: heights of the unsagged wheels over their contact points, shape (6,) [m]; zero by default, `AIRBORNE` for
            another leg in the air.
        gravity_in_hex: where gravity points in the unsagged hex frame.
        wanted_in_hex: pose of the sagged chassis in the unsagged hex frame, shift apart; by default level, its origin where
            the command has it.
        payload_kg: on the deck.
    """
    if not 0 <= leg < LEGS:
        raise SagError(f"leg index {leg} is outside 0 to 5")
    if not (np.isfinite(clearance) and clearance >= 0.0):
        raise SagError(f"clearance is {clearance} m, must not be negative")
    planted = np.zeros(LEGS) if lifts is None else np.array(lifts, dtype=float)
    if planted.shape != (LEGS,) or np.isnan(planted).any() or np.isneginf(planted).any():
        raise SagError(f"lifts are {planted}, need six heights [m], or AIRBORNE")
    size = float(np.linalg.norm(gravity_in_hex))
    if not (np.isfinite(size) and size > 0.0):
        raise SagError(f"gravity is {gravity_in_hex}, must be finite with a length")
    up = -np.asarray(gravity_in_hex, dtype=float) / size
    search = _Search(kin, motors, leg, springs, clearance, planted, up, wanted_in_hex or level_pose(gravity_in_hex), payload_kg, config)
    if search.stands.sum() < 3:
        return NoPose(reason=f"{search.stands.sum()} of 6 wheels stand once leg {leg + 1} is up, at least 3 carry a robot")
    if search.width < NARROWEST:
        return NoPose(reason=f"the standing wheels span {search.width:.3f} m across, a line, at least {NARROWEST} m carry a robot")
    shift = search.even_shift()
    cut = "" if shift is not None else f"no shift: reach within {PROBE} m of the stance"
    shift = np.zeros(2) if shift is None else shift
    found = search.at(shift)
    for fraction in FRACTIONS[1:] if shift.any() else ():
        if isinstance(found, LiftPose):
            break
        cut = cut or found.reason
        found = search.at(fraction * shift)
    if isinstance(found, LiftPose) and cut:
        return replace(found, limited_by=(cut, *found.limited_by))
    return found


def level_pose(gravity_in_hex: Vec3) -> SE3:
    """The chassis turned as little as sets its z axis against gravity, its origin where it was, in the hex frame before."""
    up = -np.asarray(gravity_in_hex, dtype=float) / np.linalg.norm(gravity_in_hex)
    axis = np.cross([0.0, 0.0, 1.0], up)
    sine = float(np.linalg.norm(axis))
    return SE3.from_rotvec(axis / max(sine, 1e-300) * np.arctan2(sine, up[2]))


@dataclass(frozen=True, eq=False)
class _Search:
    kin: Kinematics
    motors: Joints
    leg: int
    springs: FootSprings
    clearance: float
    lifts: PerLeg
    up: Vec3
    wanted: SE3
    payload_kg: float
    config: PoseConfig

    @cached_property
    def stands(self) -> np.ndarray:
        """Wheels on the ground once the leg is lifted, shape (6,)."""
        stands = np.asarray(np.isfinite(self.lifts))
        stands[self.leg] = False
        return stands

    @property
    def width(self) -> float:
        """Standard deviation of the standing wheels from the line nearest to them, seen from above [m]."""
        places = self.stood[0][self.stands] @ self.level_from_hex[:2].T
        return float(np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(places)))

    @property
    def weight(self) -> float:
        return (self.kin.spec.mass + self.payload_kg) * GRAVITY

    @cached_property
    def level_from_hex(self) -> Mat3:
        """Rotation from the hex frame before the move to one with z upright and x ahead."""
        ahead = self.wanted.rotation[:, 0]
        ahead = ahead - (ahead @ self.up) * self.up
        ahead /= np.linalg.norm(ahead)
        return np.array([ahead, np.cross(self.up, ahead), self.up])

    @cached_property
    def stood(self) -> tuple[Wheels, Wheels]:
        """Axles and directions of the last links before the move, in hex."""
        poses = [self.kin.leg_wheel(leg, self.motors[leg]) for leg in range(LEGS)]
        return np.array([p.translation for p in poses]), np.array([p.rotation[:, 0] for p in poses])

    def shifted(self, shift: Vec2) -> SE3:
        """The wanted pose, shifted horizontally."""
        return SE3(self.wanted.rotation, self.wanted.translation + shift @ self.level_from_hex[:2])

    def joints(self, start_from_hex: SE3, offsets: PerLeg, lifted: Vec3 | None) -> tuple[Joints, Wheels, np.ndarray]:
        """Angles, axles in the new hex frame and which legs reach, as the executive carries a `BodyMove` out."""
        stood, directions = self.stood
        hex_from_start = start_from_hex.inverse()
        axles = hex_from_start.apply(stood + offsets[:, None] * self.up)
        if lifted is not None:
            axles[self.leg] = lifted
        joints, reached = all_legs_ik(self.kin.spec, axles, last_link_in_hex=hex_from_start.rotate(directions))
        return joints, axles, reached

    def lifted_in(self, wanted: SE3) -> Vec3 | None:
        """Axle of the lifted leg in the hex frame of a chassis on the wanted pose; None when it was in the air before."""
        if not np.isfinite(self.lifts[self.leg]):
            return None
        return np.asarray(wanted.inverse().apply(self.stood[0][self.leg] + (self.clearance - self.lifts[self.leg]) * self.up))

    def even_shift(self) -> Vec2 | None:
        """The shift within its bound that brings the CoM where balance asks for the most even loads [m].

        None where a leg does not reach what the movement of the CoM is measured with.
        """
        if self.config.max_shift == 0.0:
            return np.zeros(2)
        level, stands = self.level_from_hex[:2], self.stands
        places = self.stood[0][stands] @ level.T

        def com(shift: Vec2) -> np.ndarray:
            wanted = self.shifted(shift)
            joints, _, reached = self.joints(wanted, np.zeros(LEGS), self.lifted_in(wanted))
            com_in_hex = self.kin.com_in_hex(joints, self.payload_kg) if reached.all() else np.full(3, np.nan)
            return np.asarray(level @ wanted.apply(com_in_hex))

        here, ahead, aside = com(np.zeros(2)), com(np.array([PROBE, 0.0])), com(np.array([0.0, PROBE]))
        by_shift = np.column_stack([ahead - here, aside - here]) / PROBE
        if not np.isfinite(by_shift).all():
            return None
        return shift_towards_even(here, places, by_shift, self.config.max_shift)

    def at(self, shift: Vec2) -> LiftPose | NoPose:
        """The pose with a given shift."""
        wanted, lifts, stands = self.shifted(shift), self.lifts.copy(), self.stands
        lifts[self.leg] = AIRBORNE
        lifted = self.lifted_in(wanted)
        begin, offsets = self._raised(wanted, lifted), np.zeros(LEGS)
        if isinstance(begin, NoPose):
            return begin
        start_from_hex = begin
        sag: SagSolution | None = None
        rounds = 0
        while True:
            rounds += 1
            joints, axles, reached = self.joints(start_from_hex, offsets, lifted)
            if not reached.all():
                return NoPose(reason=f"reach of leg {int(np.argmin(reached)) + 1}")
            sag = self._solve(start_from_hex, axles, joints, lifts + offsets, sag)
            if not sag.converged:
                margin = support_margin(*self._level(start_from_hex, axles, joints, sag, stands))
                return NoPose(reason=f"the springs say {sag.status} with leg {self.leg + 1} lifted, margin {margin:.3f} m")
            sagged_from_wanted = start_from_hex.compose(sag.unsagged_from_sagged).inverse().compose(wanted)
            off, turn = float(np.linalg.norm(sagged_from_wanted.translation)), float(np.linalg.norm(sagged_from_wanted.rotvec()))
            spread = self._spread(start_from_hex, axles, sag, lifts, offsets)
            change = np.zeros(LEGS)
            if spread is not None:
                change[stands] = spread.offsets - offsets[stands]
            if max(off, float(np.abs(change).max())) <= HEIGHT_TOLERANCE and turn <= TURN_TOLERANCE:
                break
            if rounds == MAX_ROUNDS:
                return NoPose(reason=f"after {rounds} rounds {1e3 * off:.2f} mm are left")
            start_from_hex = wanted.compose(sag.unsagged_from_sagged.inverse())
            offsets = offsets + change
        if spread is None:
            least = self.config.min_load_fraction * self.weight
            return NoPose(reason=f"no loads of at least {least:.0f} N a wheel within offsets of {self.config.max_offset} m")
        return self._judged(shift, start_from_hex, offsets, joints, axles, sag, sagged_from_wanted, rounds)

    def _raised(self, wanted: SE3, lifted: Vec3 | None) -> SE3 | NoPose:
        """The commanded chassis to begin with: over the wanted one by a plane through what even loads press the springs.

        From the wanted pose itself the sag alone might tip the robot.
        """
        stands, level = self.stands, self.level_from_hex
        joints, _, reached = self.joints(wanted, np.zeros(LEGS), lifted)
        if not reached.all():
            return wanted
        com = level @ wanted.apply(self.kin.com_in_hex(joints, self.payload_kg))
        feet = self.stood[0][stands] @ level.T
        margin = support_margin(com, feet)
        if margin < 0.0:
            return NoPose(reason=f"margin with leg {self.leg + 1} lifted is {margin:.3f} m on the wanted pose")
        plane = np.column_stack([np.ones(len(feet)), feet[:, :2]])
        loads = np.linalg.pinv(plane.T) @ np.array([1.0, com[0], com[1]]) * self.weight
        sunk = np.maximum(loads, 0.0) / self.springs.stiffness_z[stands] + self.lifts[stands]
        rise, ahead, aside = np.linalg.lstsq(plane, sunk, rcond=None)[0]
        turn, depth = np.array([aside, -ahead, 0.0]), float(feet[:, 2].mean())
        # The wheels keep their places, the chassis over them moves: turned about points at their height.
        shift = np.array([0.0, 0.0, rise]) - np.cross(turn, [0.0, 0.0, depth])
        return SE3.from_rotvec(level.T @ turn, level.T @ shift).compose(wanted)

    def _spread(
        self, start_from_hex: SE3, axles: Wheels, sag: SagSolution, lifts: PerLeg, offsets: PerLeg
    ) -> Spread | None:
        """The most even loads that balance as those of a solution do, and their offsets."""
        stands, up = self.stands, start_from_hex.rotation.T @ self.up
        return spread_loads(
            start_from_hex.apply(axles + sag.displacements)[stands] @ self.level_from_hex[:2].T,
            (sag.forces @ up)[stands],
            compressions=(-(sag.displacements @ up) - lifts - offsets)[stands],
            stiffness=self.springs.stiffness_z[stands],
            offsets=offsets[stands],
            max_offset=self.config.max_offset,
            min_load=self.config.min_load_fraction * self.weight,
        )

    def _solve(
        self, start_from_hex: SE3, axles: Wheels, joints: Joints, lifts: PerLeg, start: SagSolution | None
    ) -> SagSolution:
        return solve_sag(
            axles,
            self.kin.com_in_hex(joints, self.payload_kg),
            self.weight,
            stiffness_z=self.springs.stiffness_z,
            lateral_ratio=self.springs.lateral_ratio,
            lifts=lifts,
            gravity_in_hex=start_from_hex.rotation.T @ -self.up,
            start=start,
        )

    def _judged(
        self,
        shift: Vec2,
        start_from_hex: SE3,
        offsets: PerLeg,
        joints: Joints,
        axles: Wheels,
        airborne: SagSolution,
        sagged_from_wanted: SE3,
        rounds: int,
    ) -> LiftPose | NoPose:
        """The pose, unless a bound, the reach or a margin forbids it."""
        config, leg = self.config, self.leg
        against = self.shifted(shift).inverse().compose(start_from_hex)
        rise = float(self.up @ (start_from_hex.translation - self.shifted(shift).translation))
        tilt = float(np.linalg.norm(against.rotvec()))
        if abs(rise) > config.max_rise:
            return NoPose(reason=f"the chassis must be commanded {rise:.3f} m up, the bound is {config.max_rise} m")
        if tilt > config.max_tilt:
            return NoPose(reason=f"the chassis must be commanded {tilt:.3f} rad off, the bound is {config.max_tilt} rad")
        planted, planted_axles, reached = self.joints(start_from_hex, offsets, None)
        if not reached.all():
            return NoPose(reason=f"reach of leg {int(np.argmin(reached)) + 1}")
        standing = self._solve(start_from_hex, planted_axles, planted, self.lifts + offsets, None)
        if not standing.converged:
            return NoPose(reason=f"the springs say {standing.status} before the lift")
        least = self.kin.spec.min_support_margin if config.min_margin is None else config.min_margin
        stands, ground = self.stands, np.isfinite(self.lifts)
        margins = {f"margin with leg {leg + 1} lifted": support_margin(*self._level(start_from_hex, axles, joints, airborne, stands))}
        if ground.all():
            margins["CPS margin"] = cps_margin(*self._level(start_from_hex, planted_axles, planted, standing, ground))
        for name, margin in margins.items():
            if margin < least:
                return NoPose(reason=f"{name} is {margin:.3f} m, the least is {least} m")
        loads = airborne.forces @ (start_from_hex.rotation.T @ self.up)
        return LiftPose(
            leg=leg,
            move=BodyMove(
                translation_in_hex=start_from_hex.translation,
                rotvec_in_hex=start_from_hex.rotvec(),
                wheel_offsets_in_hex=offsets[:, None] * (start_from_hex.rotation.T @ self.up),
            ),
            lift_in_hex=axles[leg],
            motors=joints,
            standing=standing,
            airborne=airborne,
            sagged_from_wanted=sagged_from_wanted,
            peak_load=float(loads[stands].max()),
            limited_by=self._bounds_hit(shift, offsets, loads),
            rounds=rounds,
        )

    def _level(
        self, start_from_hex: SE3, axles: Wheels, joints: Joints, sag: SagSolution, on: PerLegFlag
    ) -> tuple[Vec3, Points3]:
        """Sagged CoM and wheels on the ground in a level frame."""
        level_from_hex = self.level_from_hex @ start_from_hex.rotation
        com = self.kin.com_in_hex(joints, self.payload_kg) + sag.com_displacement
        return level_from_hex @ com, (axles + sag.displacements)[on] @ level_from_hex.T

    def _bounds_hit(self, shift: Vec2, offsets: PerLeg, loads: PerLeg) -> tuple[str, ...]:
        config, hit = self.config, []
        if config.max_shift > 0.0 and np.linalg.norm(shift) >= (1.0 - 1e-6) * config.max_shift:
            hit.append(f"shift of {config.max_shift} m")
        for leg in np.flatnonzero(self.stands):
            if config.max_offset > 0.0 and abs(offsets[leg]) >= (1.0 - 1e-6) * config.max_offset:
                hit.append(f"offset of leg {leg + 1}: {config.max_offset} m")
            if loads[leg] <= (1.0 + 1e-6) * config.min_load_fraction * self.weight:
                hit.append(f"least load on leg {leg + 1}")
        return tuple(hit)
