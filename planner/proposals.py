"""Plans to proposals: the sequence that goes up, its preview, and the line that tells the operator what will happen.

Place in the flow: what the searches found -> `Offer`, which stands until the operator's decision. One method for each kind of motion:
a step, a lift-off to look, a leg further down, a leg back the way it came, a drive, a look around, the chassis aside. Which of
them it shall be decides `agent`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from athlete_twin.geometry.arrays import LegPath, Vec2, Vec3
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import Command, CommandSequence, JointMove
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.leg_timing import leg_timing
from planner.belief import Belief
from planner.config import PlannerConfig
from planner.decisions import Landing, Proposal, StageTimer
from planner.footfall import unknown_share
from planner.gait.aside import AsidePlan
from planner.gait.lift_and_look import raised_path
from planner.gait.step_plan import BodyShift, StepPlan
from planner.gait.step_search import Ground
from planner.gait.survey import seeing, survey_commands
from planner.motion.collision import LegCollision
from planner.motion.cornering import free_corner_tolerance
from planner.preview.foresee import foresee, known_ground
from planner.preview.preview import Preview
from planner.route.drive import DrivePlan
from planner.sag.sag_model import FootSprings
from planner.sequence import as_sequence, lower_commands, step_commands, straighten_commands

MAX_TORQUE_FRACTION = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Offer:
    """A proposal with the plan behind it, which at most one field holds."""

    proposal: Proposal
    plan: StepPlan | None = None
    """of a step, or of what is left of one"""
    lift: StepPlan | None = None
    """the step of which only the lift-off is proposed, its swing being the way up"""
    drive: DrivePlan | None = None
    aside: AsidePlan | None = None


class Proposer:
    """Makes proposals, and numbers them and the sequences."""

    def __init__(
        self, kin: Kinematics, config: PlannerConfig, *, springs: FootSprings, payload_kg: float, timer: StageTimer
    ) -> None:
        self._kin, self._spec, self._config = kin, kin.spec, config
        self._springs, self._payload, self._timer = springs, payload_kg, timer
        self._sequences = self._proposals = 0
        self._blind = config.fusion_method == "flat"
        self._everything = tuple(c.name for c in self._spec.cameras if c.on_chassis)

    def sequence(self, commands: list[Command], t: float, *, cameras: tuple[str, ...] = ()) -> CommandSequence:
        """The next sequence in number, with pictures at its end."""
        sequence = as_sequence(
            commands, robot_id=self._spec.name, sequence_id=self._sequences, t=t, cameras=cameras,
            binning=self._config.survey.binning, max_torque_fraction=MAX_TORQUE_FRACTION,
        )  # fmt: skip
        self._sequences += 1
        return sequence

    def preview(self, sequence: CommandSequence, belief: Belief, terrain: HeightGrid) -> Preview:
        """What a sequence would do from a state of the robot, on believed heights that may be unknown (NaN) in places."""
        with self._timer("preview"):
            return foresee(
                self._kin, belief, sequence, terrain=known_ground(terrain, belief), springs=self._springs, payload_kg=self._payload,
                docks=self._config.step.sag.docks,
            )  # fmt: skip

    def step(
        self,
        plan: StepPlan,
        belief: Belief,
        ground: Ground,
        t: float,
        *,
        cameras: tuple[str, ...],
        commands: list[Command] | None = None,
        text: str = "",
    ) -> Offer:
        """A whole step of one leg or two, then pictures; `commands` and `text` where they are not those of the plan."""
        sequence = self.sequence(step_commands(plan) if commands is None else commands, t, cameras=cameras)
        shift = 100 * float(np.linalg.norm(plan.shift.translation_in_hex[:2]))
        cut = f" (cut: {plan.shift.cut_by})" if plan.shift.cut_by else ""
        proposal = Proposal(
            index=self._next_index(),
            t=t,
            kind="step",
            leg=plan.leg,
            footfall_in_world=plan.footfall_in_world.copy(),
            sequence=sequence,
            preview=self.preview(sequence, belief, ground.filled),
            terrain=ground.heights,
            footfall_ok=ground.footfalls.allowed,
            cost=_costs(ground),
            world_from_hex=belief.world_from_hex,
            predicted_margin=min(plan.swing_margin, plan.landed_margin),
            predicted_sag=plan.sag,
            predicted_torque_fraction=plan.peak_torque_fraction,
            predicted_clearance=float("nan") if plan.lift_in_hex is None else min(part.lift_clearance for part in plan.parts),
            unknown_share=max(
                unknown_share(ground.heights, part.footfall_in_world, radius=self._spec.wheel.radius) for part in plan.parts
            ),
            text=text or f"{_told(plan)}, {plan.swing_time:.0f} s through the air, then the chassis shifts by {shift:.0f} cm{cut}",
            together=tuple(Landing(leg=part.leg, footfall_in_world=part.footfall_in_world.copy()) for part in plan.parts[1:]),
        )
        return Offer(proposal=proposal, plan=plan)

    def lift_first(self, plan: StepPlan, belief: Belief, ground: Ground, t: float) -> Offer:
        """The lift-off alone of a step that has one, and pictures of what its leg hid: the step is planned on them.

        The lift-off is that of a step which passed every check on the map as it was, [SunSpiral2012] s5.2.1; the wheel goes
        on straight up, out of the view. A step that is not found then brings the leg down where it stood.
        """
        step = self._config.step
        collision = LegCollision(self._spec, ground.filled, plan.world_from_leg_swing, belief.joints, plan.leg, step.collision)
        up = raised_path(self._kin, plan, belief, collision, config=self._config.look, payload_kg=self._payload)
        commands = step_commands(plan)[:1]
        tolerance = free_corner_tolerance(
            up, [collision.is_free_near_ground] * (len(up) - 1), most=step.swing.corner_tolerance,
            spacing=step.swing.smoothing.fine_resolution,
        )  # fmt: skip
        if len(up) > 1:
            commands.append(JointMove(leg=plan.leg, waypoints=up[1:], corner_tolerance=tolerance))
        # Its swing is the way up: that is what leads back, should the leg strike something on it.
        raised_in = leg_timing(self._spec, up, corner_tolerance=tolerance).duration
        proposal = self._shift(
            commands, belief, ground, t, cameras=self._everything, leg=plan.leg,
            place_in_world=belief.contacts_in_world[plan.leg].copy(), margin=plan.swing_margin, sag=plan.sag,
            text=f"leg {plan.leg + 1} lifts off, and pictures of what it hid",
        )  # fmt: skip
        return Offer(
            proposal=replace(
                proposal, predicted_torque_fraction=plan.peak_torque_fraction, predicted_clearance=plan.lift_clearance
            ),
            lift=replace(plan, swing=up, swing_corner_tolerance=tolerance, swing_time=raised_in),
        )

    def lower(self, plan: StepPlan, belief: Belief, ground: Ground, t: float, *, cameras: tuple[str, ...]) -> Offer:
        """The wheel found no ground where the map had some: further down at the same place."""
        axle = self._kin.leg_wheel(plan.leg, belief.motors[plan.leg]).translation
        down = belief.gravity_in_hex() / GRAVITY
        # From a raised place it is farther: all the way to the ground as the map has it, and then as far again as ever.
        under = self._under_axle(axle, belief)
        height = max(0.0, float(under[2] - ground.filled.sample(under[None, :2])[0]))
        step = self._config.step
        depth = height + (step.touchdown.search_depth if step.touchdown.method == "guarded" else plan.reload)
        target = axle + depth * down
        straight = straighten_commands(self._kin, plan.leg, belief.motors[plan.leg], down, tolerance=step.swing.branch_tolerance)
        commands = [*straight, *lower_commands(plan, target)]
        contact = self._under_axle(target, belief)
        lowered = replace(
            plan, lift_in_hex=None, descent_in_hex=target, shift=BodyShift.none(), footfall_in_world=contact,
            preview_joints=belief.joints[None].copy(), preview_world_from_hex=(belief.world_from_hex,),
        )  # fmt: skip
        most = "at most " if step.touchdown.method == "guarded" else ""
        text = f"leg {plan.leg + 1} goes further down where it is, {most}{100 * depth:.0f} cm"
        offer = self.step(lowered, belief, ground, t, cameras=cameras, commands=commands, text=text)
        if np.linalg.norm((contact - belief.contacts_in_world[plan.leg])[:2]) < step.gait.min_step:
            # Back to where it stood, after a look at what it hid: that is no step, and makes no gait cycle.
            offer = replace(offer, proposal=replace(offer.proposal, kind="shift"))
        return offer

    def retreat(self, plan: StepPlan, waypoints: LegPath, belief: Belief, ground: Ground, t: float) -> Offer:
        """The wheel struck something in the air: back the way it came, and a look at what was there."""
        wheel_in_hex = self._kin.leg_wheel(plan.leg, belief.joints[plan.leg]).translation
        look = () if self._blind else seeing(self._spec, wheel_in_hex, most=self._config.survey.each_step)
        # The same corners, cut as they were on the way there.
        back = JointMove(leg=plan.leg, waypoints=waypoints, corner_tolerance=plan.swing_corner_tolerance)
        proposal = self._shift(
            [back], belief, ground, t, cameras=look, leg=plan.leg, place_in_world=self._under_axle(wheel_in_hex, belief),
            margin=plan.swing_margin, sag=plan.sag, text=f"leg {plan.leg + 1} struck something: back the way it came, and a look",
        )  # fmt: skip
        return Offer(proposal=proposal)

    def roll(self, drive: DrivePlan, belief: Belief, ground: Ground, t: float) -> Offer:
        """A stretch on wheels, and pictures all round at its end: they say where it led."""
        x, y = belief.world_from_hex.translation[:2] + drive.way
        cut = f" (cut: {drive.cut_by})" if drive.cut_by else ""
        proposal = self._shift(
            [drive.command], belief, ground, t, cameras=() if self._blind else self._everything, leg=-1,
            place_in_world=drive.world_from_hex[-1].translation.copy(), margin=drive.margin, sag=drive.uneven,
            text=f"drives {float(np.linalg.norm(drive.way)):.1f} m to ({x:.2f}, {y:.2f}) m on its wheels, then pictures{cut}",
        )  # fmt: skip
        return Offer(proposal=proposal, drive=drive)

    def go_aside(self, aside: AsidePlan, belief: Belief, ground: Ground, t: float, *, cameras: tuple[str, ...]) -> Offer:
        """The chassis out of the way over its planted wheels."""
        proposal = self._shift(
            [aside.command], belief, ground, t, cameras=cameras, leg=-1, place_in_world=aside.world_from_hex[-1].translation.copy(),
            margin=aside.margin, sag=0.0, text=aside.text,
        )  # fmt: skip
        return Offer(proposal=proposal, aside=aside)

    def survey(self, belief: Belief, heading: Vec2, t: float) -> Offer:
        """A look around before the first step, towards a heading in world: no ground is known yet."""
        heading_in_hex = (belief.world_from_hex.rotation.T @ np.append(heading, 0.0))[:2]
        sequence = self.sequence(survey_commands(self._kin, belief, heading_in_hex, self._config.survey), t)
        flat = HeightGrid(origin_x=-1.0, origin_y=-1.0, cell=1.0, heights=np.full((3, 3), np.nan))
        proposal = Proposal(
            index=self._next_index(), t=t, kind="shift", leg=-1, footfall_in_world=belief.world_from_hex.translation.copy(),
            sequence=sequence, preview=self.preview(sequence, belief, flat),
            terrain=flat, footfall_ok=np.zeros((3, 3), dtype=bool), cost=np.full((3, 3), np.nan),
            world_from_hex=belief.world_from_hex, predicted_margin=float("nan"), predicted_sag=0.0,
            text="look around: pictures from all cameras, nodding and turning on planted wheels",
        )  # fmt: skip
        return Offer(proposal=proposal)

    def _shift(
        self, commands: list[Command], belief: Belief, ground: Ground, t: float, *, cameras: tuple[str, ...], leg: int,
        place_in_world: Vec3, margin: float, sag: float, text: str,
    ) -> Proposal:  # fmt: skip
        """Of anything that is no step."""
        sequence = self.sequence(commands, t, cameras=cameras)
        return Proposal(
            index=self._next_index(), t=t, kind="shift", leg=leg, footfall_in_world=place_in_world,
            sequence=sequence, preview=self.preview(sequence, belief, ground.filled),
            terrain=ground.heights, footfall_ok=ground.footfalls.allowed, cost=_costs(ground),
            world_from_hex=belief.world_from_hex, predicted_margin=margin, predicted_sag=sag, text=text,
        )  # fmt: skip

    def _under_axle(self, axle_in_hex: Vec3, belief: Belief) -> Vec3:
        """The point of a wheel below its axle, in world [m]."""
        return belief.world_from_hex.apply(axle_in_hex) - self._spec.wheel.radius * np.array([0.0, 0.0, 1.0])

    def _next_index(self) -> int:
        self._proposals += 1
        return self._proposals - 1


def _costs(ground: Ground) -> np.ndarray:
    return np.where(ground.footfalls.allowed, ground.footfalls.cost, np.nan)


def _told(plan: StepPlan) -> str:
    """Which leg goes where."""
    steps = [f"leg {part.leg + 1} steps to ({part.footfall_in_world[0]:.2f}, {part.footfall_in_world[1]:.2f}) m" for part in plan.parts]
    return " and ".join(steps) + (" together" if plan.companion is not None else "")
