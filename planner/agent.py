"""The ground: what comes down goes in, a proposal or an image request comes out. Reads like the papers' architecture.

stereo pairs -> depth -> depth without the robot's own legs -> fused terrain -> footfall scores -> stability map ->
chosen step -> collision-free path -> smoothed path -> sag-compensated sequence -> the operator's decision -> link

The agent holds no clock and no link: messages come in by `observe`, actions go out by `next`, and computing time is
charged by a fixed table, so that results do not depend on the machine.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import PerLeg, Vec2, Vec3
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import (
    Command,
    CommandSequence,
    Fault,
    ImageRequest,
    JointMove,
    LegMove,
    Message,
    Telemetry,
)
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.leg_timing import leg_timing
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.belief import Belief, BeliefFilter
from planner.config import PlannerConfig
from planner.decisions import Action, Arrived, Decision, Landing, NoStep, Proposal, Uplink, Waiting, check_cameras
from planner.eyes import Eyes, StageTimer, untimed
from planner.footfall import FootfallMap, score_footfalls, unknown_share
from planner.gait.aside import AsidePlan, Asides, NoAside, plan_aside
from planner.gait.lift_and_look import raised_path
from planner.gait.pair_search import search_pair
from planner.gait.single_steps import by_lag, lags
from planner.gait.skeleton import opposite, regular_places, reverse_wave, stride
from planner.gait.step_plan import BodyShift, StepPlan
from planner.gait.step_search import Ground, StepRequest, on_path, search_step
from planner.gait.survey import seeing, survey_commands
from planner.motion.collision import LegCollision
from planner.motion.cornering import free_corner_tolerance
from planner.preview.foresee import foresee, known_ground
from planner.preview.preview import Preview
from planner.recovery import LOWERINGS, Recovery
from planner.route.drive import DrivePlan, plan_drive
from planner.route.guide import Guide, Way, refusals
from planner.sequence import as_sequence, lower_commands, step_commands, straighten_commands
from planner.terrain.ground_level import SIGMA as LEVEL_SIGMA
from planner.terrain.spikes import without_spikes
from planner.underway import SILENCE, Inbox, Underway

SECONDS_PER_PLAN = 2.0
"""charged for planning one step [s]"""
SECONDS_PER_PAIR = 1.0
"""charged for one stereo pair [s]"""
STANDING_LOAD = 150.0
"""after a fault, a wheel whose torques speak of more than this stands [N]"""
FLAT_RADIUS = 8.0
"""of the flat map of a variant without pictures [m]"""
MAX_TORQUE_FRACTION = 1.0
PLAN_STREAM = 7001
"""of the sampling planners' generators, beside the seed"""


class GroundAgent:
    """Plans from the downlink alone, one step at a time."""

    def __init__(
        self,
        spec: RobotSpec,
        config: PlannerConfig,
        *,
        goal_in_world: Vec2,
        seed: int,
        payload_kg: float = 0.0,
        timer: StageTimer = untimed,
    ) -> None:
        self.spec, self.config = spec, config
        self.goal = np.asarray(goal_in_world, dtype=float)
        if self.goal.shape != (2,) or not np.isfinite(self.goal).all():
            raise PlanningError(f"goal is {goal_in_world} m, must be two finite numbers")
        self.kin = Kinematics(spec)
        self.springs = config.step.sag.springs(spec)
        self.eyes = Eyes(self.kin, config, timer=timer)
        self.steps_taken = 0
        self.stepped: Counter[int] = Counter()
        """how often each leg has stepped"""
        self.unusable_pairs: list[str] = []
        """why pictures were left out so far, one line each"""
        self.last_plan: StepPlan | None = None
        self._filter = BeliefFilter(self.kin, self.springs, payload_kg=payload_kg, config=config.wheel_fit)
        self._payload, self._timer = payload_kg, timer
        self._seed = seed
        self._belief: Belief | None = None
        self._telemetry: Telemetry | None = None
        self._sent: Underway | None = None
        self._inbox = Inbox()
        self._proposal: Proposal | None = None
        self._plan: StepPlan | None = None
        self._lift: StepPlan | None = None
        self._drive: DrivePlan | None = None
        self._aside: AsidePlan | None = None
        self._asides = Asides(config.aside)
        self._walks = not config.driving
        """until the next step is done: the operator refused to drive"""
        self._attempts: dict[int, StepPlan] = {}
        """what was sent up last for each leg"""
        self._faulty: int | None = None
        """leg whose command met the last fault"""
        self._asked_at = 0.0
        """when the robot was asked for its state last, mission time [s]"""
        self._ground_s = 0.0
        self._sequence_id = 0
        self._proposals = 0
        self._recovery = Recovery()
        self.guide = Guide(
            spec, self.goal, method=config.route_method, driving=config.driving, config=config.route,
            headings=config.headings, typical_terrain=config.step.search.typical_terrain,
        )  # fmt: skip
        """which way the gait goes, and the route it follows"""
        self._behind = 0.0
        self._swayed: Vec3 | None = None if config.step.sway is None else np.zeros(3)
        """by which the chassis is off its straight path, in world [m]"""
        self._surveyed = config.fusion_method == "flat"
        self._levelled = False
        self._looked: dict[int, Vec2] = {}
        """where a leg stood when it was lifted to see what it hid"""
        self._forced_leg: int | None = None
        self._forced_xy: Vec2 | None = None
        self._stopped = ""

    # --- what the environments call -------------------------------------------------------------------------------

    @property
    def ground_s(self) -> float:
        """Computing time charged so far, from the fixed table [s]."""
        return self._ground_s

    @property
    def belief(self) -> Belief | None:
        """The robot as last believed; None before the first telemetry."""
        return self._belief

    @property
    def gait_cycles(self) -> int:
        """How often every leg has stepped."""
        return min((self.stepped[leg] for leg in range(LEGS)), default=0)

    def observe(self, message: Message, t: float) -> None:
        """Take one message that came down and arrived at mission time `t` [s]."""
        if not self._inbox.admits(message):
            return
        if isinstance(message, Telemetry):
            self._telemetry = message
            if self._sent is None or self._belief is None:
                self._belief = self._filter.update(message)
        if self._sent is not None:
            for index in self._sent.take(message, t):
                self._completed(self._sent, index)

    def next(self, t: float) -> Action:
        """What to do now, at mission time `t` [s]."""
        if self._stopped:
            return NoStep(reason=self._stopped)
        if self._belief is None or self._telemetry is None:
            # The robot tells once by itself, and a link may lose that; it answers whatever it is sent, if nothing is in it.
            if t - self._asked_at > SILENCE:
                self._asked_at = t
                return Uplink(sequence=self._as_sequence([], t))
            return Waiting(reason="first telemetry")
        if self._sent is not None:
            sent = self._sent
            settled = self._telemetry.executive_state != "executing" and self._telemetry.t >= max(sent.sequence.t, sent.ended_at)
            if not sent.outcome or not settled:
                if sent.silent(t):
                    sent.sent(t)
                    return Uplink(sequence=sent.sequence)
                return Waiting(reason="telemetry: the robot moves" if not sent.outcome else "telemetry after the motion")
            if sent.fault is None and len(sent.pairs) < sent.pairs_awaited and not sent.silent(t):
                return Waiting(reason=f"pictures: {len(sent.pairs)} of {sent.pairs_awaited}")
            self._digest(sent)
            if self._stopped:
                return NoStep(reason=self._stopped)
        if self._proposal is not None:
            return self._proposal
        return self._propose(t)

    def preview(self, sequence: CommandSequence, belief: Belief, terrain: HeightGrid) -> Preview:
        """What a sequence would do from a state of the robot, on believed heights that may be unknown (NaN) in places."""
        with self._timer("preview"):
            return foresee(
                self.kin, belief, sequence, terrain=known_ground(terrain, belief), springs=self.springs, payload_kg=self._payload,
                docks=self.config.step.sag.docks,
            )  # fmt: skip

    def decide(self, decision: Decision, t: float) -> CommandSequence | None:
        """Apply the operator's answer to the standing proposal; the sequence to send, or None when nothing goes up."""
        check_cameras(decision, self.spec)
        proposal, plan = self._proposal, self._plan
        if proposal is None:
            return None
        if decision.kind == "wait":
            return None
        lift, self._lift = self._lift, None
        drive, self._drive = self._drive, None
        aside, self._aside = self._aside, None
        self._proposal, self._plan = None, None
        if decision.kind == "approve":
            return self._send(replace(proposal.sequence, t=t), plan, lift=lift, drive=drive, aside=aside)
        if decision.kind == "reject":
            refused = plan or lift
            if drive is not None:
                self._walks = True
            elif aside is not None:
                self._asides.give_up()
            elif refused is None:
                self._surveyed, self._recovery.retreat = True, None
            else:
                self._recovery.reject(refused)
        elif decision.kind == "edit_footfall" and decision.footfall_in_world is not None:
            if plan is None:  # a look around, a lift-off, a move aside or a way back has no footfall: the proposal comes again
                self._proposal, self._lift, self._drive, self._aside = proposal, lift, drive, aside
                return None
            wanted = np.asarray(decision.footfall_in_world[:2], dtype=float)
            # Of two legs that step together the one whose footfall it is nearest to, which then steps alone.
            nearest = min(plan.parts, key=lambda part: float(np.linalg.norm(part.footfall_in_world[:2] - wanted)))
            self._forced_xy, self._forced_leg = wanted, nearest.leg
        elif decision.kind == "choose_leg":
            self._forced_leg = decision.leg
        elif decision.kind == "choose_cameras":
            look: list[Command] = [ImageRequest(cameras=decision.cameras, binning=self.config.survey.binning)]
            return self._send(self._as_sequence(look, t), None)
        elif decision.kind == "stop":
            self._stopped = "stopped by the operator"
        return None

    # --- what came down -------------------------------------------------------------------------------------------

    def _completed(self, sent: Underway, index: int) -> None:
        """Keep track of which wheel stands while the receipts come in."""
        plan, commands, drive = sent.plan or sent.lift, sent.sequence.commands, sent.drive
        if drive is not None and commands[index] is drive.command:
            self._filter.rolled(drive.contacts_in_world)
            self.eyes.filter.drove(float(np.linalg.norm(drive.way)))
        if plan is None:
            return
        command = commands[index]
        if isinstance(command, LegMove) and command.guard == "break_contact":
            self._filter.lift(command.leg)
        elif isinstance(command, LegMove) and command.lands:
            self._filter.land(command.leg)
            sent.landed.add(command.leg)

    def _digest(self, sent: Underway) -> None:
        """A sequence has ended: update the belief, fuse its pictures, take note of a fault."""
        self._sent = None
        if self._telemetry is None:
            return
        if sent.fault is not None:
            self._faulted(sent, sent.fault)
        elif sent.outcome != "completed":
            pass  # refused: nothing has moved
        elif sent.aside is not None:
            self._asides.took(sent.aside.turn)
        elif sent.plan is not None:
            for part in sent.plan.parts:
                self.steps_taken += 1
                self.stepped[part.leg] += 1
            self.last_plan = sent.plan
            self._walks = not self.config.driving
            regular = len(sent.plan.parts) * stride(self.spec, self.config.step.gait) / LEGS
            shift = sent.plan.shift
            advance = float(np.linalg.norm((shift.translation_in_hex - shift.sway_in_hex)[:2]))
            if self._swayed is not None:
                self._swayed = self._swayed + sent.plan.preview_world_from_hex[0].rotate(shift.sway_in_hex)
            self._behind = max(0.0, self._behind + regular - advance)
            self._forced_leg = None
            # While another leg hangs, what was learned of it is still needed.
            if self._filter.planted.all():
                self._recovery.reset()
            self._asides.stepped()
        self._belief = self._filter.update(self._telemetry)
        if sent.fault is not None and sent.plan is not None and self._swayed is not None:
            self._swayed = self._swayed + _swayed_so_far(sent.plan.shift, sent.plan.preview_world_from_hex[0], self._belief)
        fresh = self.config.fusion_method
        if sent.pairs and (fresh == "single_view" or (fresh == "lift_and_image" and sent.lift is not None)):
            self.eyes.forget(self._belief)
        for t in sorted({p.t for p in sent.pairs}):
            pairs = [p for p in sent.pairs if p.t == t]
            then = self._filter.update(pairs[0].state)
            correction = self.eyes.take(pairs, then)
            self.unusable_pairs += [verdict.reason for verdict in self.eyes.unusable]
            self._ground_s += SECONDS_PER_PAIR * len(pairs)
            self._filter.shift_world(correction)
        if sent.pairs:
            self._belief = self._filter.update(self._telemetry)
            if not self._levelled:
                self._level(self._belief, self._telemetry)
        if self.config.fusion_method != "flat":
            self.eyes.touch(self._belief.contacts_in_world[self._belief.planted], t=self._belief.t)

    def _level(self, belief: Belief, telemetry: Telemetry) -> None:
        """The first pictures show how deep the wheels stand: chassis and map are lower by that."""
        over = self.eyes.level(belief)
        if over is None:  # the next pictures may say
            return
        self._levelled = True
        self.eyes.map.lower(self._filter.settle(over, sigma=LEVEL_SIGMA))
        self._belief = self._filter.update(telemetry)

    def _faulted(self, sent: Underway, fault: Fault) -> None:
        if sent.drive is not None and fault.command_index == 0:  # -1 never began: cancelled in the queue
            # Telemetry holds no wheel angles: how far it rolled nobody knows.
            self._stopped = f"a drive broke off, where the robot stands is not known: {fault.text}"
            return
        plan = sent.plan or sent.lift
        if plan is None or self._telemetry is None:
            self._surveyed = True
            if sent.aside is not None:
                self._asides.give_up()
            self._recovery.attempts += 1
            return
        together = plan.companion is not None
        if together:
            for leg in sorted(sent.landed):
                self.steps_taken += 1
                self.stepped[leg] += 1
        # Of two legs that step together the fault is one's: that of the command in execution, whoever's joint it names.
        commands = sent.sequence.commands
        command = commands[fault.command_index] if 0 <= fault.command_index < len(commands) else None
        plan = plan.of_leg(command.leg if isinstance(command, LegMove | JointMove) else plan.leg)
        self._faulty = plan.leg
        if together and plan.leg in sent.landed:  # both stand: it met the shift or the pictures
            self._recovery.attempts += 1
            return
        self._recovery.fault(fault, plan, self._telemetry.motors[plan.leg])
        if self._recovery.exhausted:
            self._stopped = f"{self._recovery.attempts} faults at one step, the last: {fault.text}"
        if fault.code == "swing_contact":
            self._filter.lift(plan.leg)
        else:
            self._feel(plan.leg, self._telemetry)
        self._forced_leg = plan.leg

    def _feel(self, leg: int, telemetry: Telemetry) -> None:
        """After a fault nobody knows whether the wheel stands: its torques do."""
        roll, pitch = float(telemetry.attitude_rpy[0]), float(telemetry.attitude_rpy[1])
        gravity = GRAVITY * np.array([np.sin(pitch), -np.sin(roll) * np.cos(pitch), -np.cos(roll) * np.cos(pitch)])
        force = self.kin.ground_force(leg, telemetry.joints, telemetry.torques[leg], gravity)
        if float(-force @ gravity / GRAVITY) > STANDING_LOAD:
            self._filter.land(leg)
        else:
            self._filter.lift(leg)

    # --- what goes up ---------------------------------------------------------------------------------------------

    def _propose(self, t: float) -> Action:
        if self._belief is None:
            return Waiting(reason="first telemetry")
        belief = self._belief
        offset = self.goal - belief.world_from_hex.translation[:2]
        remaining = float(np.linalg.norm(offset))
        in_air = np.flatnonzero(~belief.planted)
        if not self._surveyed:
            return self._survey(belief, offset / max(remaining, 1e-9), t)
        if remaining <= self.config.step.gait.arrival_distance and len(in_air) == 0:
            return Arrived(text=f"believed {remaining:.2f} m from the goal")
        with self._timer("footfall"):
            ground = self._ground(belief)
        attempt = None if self._faulty is None else self._attempts.get(self._faulty)
        if self._recovery.retreat is not None and attempt is not None:
            return self._retreat(belief, ground, attempt, self._recovery.retreat, t)
        if attempt is not None and attempt.leg in in_air and self._recovery.lowers:
            return self._lower(belief, ground, attempt, t)
        with self._timer("route"):
            ways = self.guide.ways(replace(belief, world_from_hex=on_path(belief, self._swayed)), ground)
        forced_xy, self._forced_xy = self._forced_xy, None
        if not self._walks and self._forced_leg is None:
            drive = plan_drive(
                self.kin, self.springs, belief, ground, self.guide.route, route_config=self.config.route,
                config=self.config.drive, step=self.config.step, payload_kg=self._payload,
            )  # fmt: skip
            if isinstance(drive, DrivePlan):
                return self._roll(drive, belief, ground, t)
        failed: list[tuple[Way, str, Counter[str]]] = []
        together = self._search_pairs(belief, ground, ways[0], in_air)
        if isinstance(together, StepPlan):
            self.guide.took(ways[0])
            return self._as_proposal(together, belief, ground, t)
        failed += [(ways[0], no.reason, Counter(no.refused)) for no in together]
        hidden: Counter[int] = Counter()
        looked = len(in_air) > 0
        unmoved: NoAside | None = None
        for way, leg, cautious, wide, due in self._tries(belief, ways[: 1 if forced_xy is not None else None], in_air, ground):
            if not due and not looked:
                looked = True
                look = self._look_beneath(belief, ground, ways[0], hidden, t)
                if look is not None:
                    return look
            if way is not ways[0] and unmoved is None:
                aside = self._go_aside(belief, ground, ways[0], t)
                if isinstance(aside, Proposal):
                    return aside
                unmoved = aside
            request = self._request(belief, way, leg, cautious=cautious, wide=wide, footfall_xy=forced_xy)
            found = self._search(belief, ground, request)
            if isinstance(found, StepPlan):
                self._forced_leg = None
                self.guide.took(way)
                if self.config.fusion_method == "lift_and_image" and found.lift_in_hex is not None:
                    return self._lift_first(found, belief, ground, t)
                return self._as_proposal(found, belief, ground, t)
            hidden[leg] += found.refused.get("unknown", 0) if self.config.fusion_method != "flat" else 0
            failed.append((way, found.reason, Counter(found.refused)))
        reason, refused = refusals(failed)
        if forced_xy is not None:
            # The operator's place does not work: say so beside the gait's own step.
            self._forced_leg = None
            again = self._propose(t)
            if isinstance(again, Proposal):
                text = f"{again.text} (not at ({forced_xy[0]:.2f}, {forced_xy[1]:.2f}) m: {reason})"
                again = self._proposal = replace(again, text=text)
            return again
        hanging = self._attempts.get(int(in_air[0])) if len(in_air) else None
        if hanging is not None and self._recovery.lowerings <= LOWERINGS:
            self._recovery.lowerings += 1
            return self._lower(belief, ground, hanging, t)
        look = None if looked else self._look_beneath(belief, ground, ways[0], hidden, t)
        if look is not None:
            return look
        aside = self._go_aside(belief, ground, ways[0], t) if unmoved is None else unmoved
        if isinstance(aside, Proposal):
            return aside
        return NoStep(reason=" | ".join(filter(None, (reason, aside.reason))), refused=dict(refused + aside.refused))

    def _request(
        self, belief: Belief, way: Way, leg: int, *, cautious: bool = True, wide: bool = True, footfall_xy: Vec2 | None = None
    ) -> StepRequest:
        return StepRequest(
            leg=leg,
            heading=way.heading,
            remaining=way.remaining,
            behind=self._behind,
            yaw=self._asides.yaw,
            swayed=self._swayed,
            footfall_xy=footfall_xy,
            refused_xy=self._recovery.refused_xy,
            extra_lift=self._recovery.extra_lift,
            next_leg=self._upcoming(belief, way.heading, (leg,))[0],
            cautious=cautious,
            wide=wide,
        )

    def _search(self, belief: Belief, ground: Ground, request: StepRequest) -> StepPlan | NoStep:
        self._ground_s += SECONDS_PER_PLAN
        with self._timer("plan"):
            return search_step(
                self.kin, self.springs, belief, ground, request, config=self.config.step, payload_kg=self._payload,
                rng=self._plan_rng(request.leg),
            )  # fmt: skip

    def _plan_rng(self, leg: int) -> np.random.Generator:
        """Of one plan: an operator's question or a refused search changes nothing about those that follow."""
        return np.random.default_rng([self._seed, PLAN_STREAM, self.steps_taken, leg])

    def _search_pairs(self, belief: Belief, ground: Ground, way: Way, in_air: np.ndarray) -> StepPlan | list[NoStep]:
        """A step of two opposite legs whose turn it is, of a gait that has such, or why none of them may."""
        if self.config.step.gait.method != "opposite_pairs" or len(in_air) or self._forced_leg is not None:
            return []
        due = self._order(belief, way.heading, in_air)[0]
        pairs = [(leg, opposite(self.spec, leg)) for n, leg in enumerate(due) if opposite(self.spec, leg) in due[n + 1 :]]
        refused = []
        for cautious in (True, False) if ground.cautious is not ground.filled else (False,):
            for pair in pairs:
                upcoming = self._upcoming(belief, way.heading, pair)[0]
                one, two = (replace(self._request(belief, way, leg, cautious=cautious, wide=False), next_leg=upcoming) for leg in pair)
                self._ground_s += SECONDS_PER_PLAN * len(pair)
                with self._timer("plan"):
                    found = search_pair(
                        self.kin, self.springs, belief, ground, one, two, config=self.config.step, payload_kg=self._payload,
                        rng=self._plan_rng(one.leg),
                    )  # fmt: skip
                if isinstance(found, StepPlan):
                    return found
                refused.append(found)
        return refused

    def _go_aside(self, belief: Belief, ground: Ground, way: Way, t: float) -> Proposal | NoAside:
        """No leg finds a step the way the gait goes: the chassis out of the way, wheels down, if that gives one that is due a step."""
        standing = bool(belief.planted.all())
        if self._asides.barred or not standing:
            return NoAside(reason=self._asides.barred if standing else "", refused=Counter())

        def step_from(there: Belief, turn: float) -> StepPlan | None:
            onward = self.guide.way_from(replace(there, world_from_hex=on_path(there, self._swayed)), ground, way.aside)
            for leg in self._order(there, onward.heading, np.empty(0))[0]:
                request = replace(self._request(there, onward, leg), yaw=self._asides.yaw + turn)
                found = self._search(there, ground, request)
                if isinstance(found, StepPlan):
                    return found
            return None

        aside = plan_aside(
            self.kin, belief, ground, way.heading, step_from, config=self.config.aside, step=self.config.step,
            payload_kg=self._payload,
        )  # fmt: skip
        if isinstance(aside, NoAside):
            return aside
        self._aside = aside
        sequence = self._as_sequence([aside.command], t, cameras=self._cameras((), belief))
        self._proposal = Proposal(
            index=self._next_proposal(), t=t, kind="shift", leg=-1,
            footfall_in_world=aside.world_from_hex[-1].translation.copy(),
            sequence=sequence, preview=self.preview(sequence, belief, ground.filled),
            terrain=ground.heights, footfall_ok=ground.footfalls.allowed,
            cost=np.where(ground.footfalls.allowed, ground.footfalls.cost, np.nan),
            world_from_hex=belief.world_from_hex, predicted_margin=aside.margin, predicted_sag=0.0, text=aside.text,
        )  # fmt: skip
        return self._proposal

    def _look_beneath(self, belief: Belief, ground: Ground, way: Way, hidden: Counter[int], t: float) -> Action | None:
        """No leg that is due finds a step, some for want of seen ground, which a standing leg may hide: it is lifted for pictures.

        Each leg once where it stands: what it does not show then, no lift shows.
        """
        for leg, cells in hidden.most_common():
            if cells == 0:
                return None
            place = belief.contacts_in_world[leg, :2]
            looked = self._looked.get(leg)
            if looked is not None and np.linalg.norm(place - looked) < self.config.step.gait.min_step:
                continue
            request = StepRequest(leg=leg, heading=way.heading, remaining=way.remaining, on_the_spot=True)
            found = self._search(belief, ground, request)
            if isinstance(found, StepPlan) and found.lift_in_hex is not None:
                self._looked[leg] = place.copy()
                return self._lift_first(found, belief, ground, t)
        return None

    def _tries(
        self, belief: Belief, ways: list[Way], in_air: np.ndarray, ground: Ground
    ) -> list[tuple[Way, int, bool, bool, bool]]:
        """What to try in turn: the way, the leg, whether to keep clear of ground that nobody saw, to look farther; whether it is due.

        On the first way, of the legs whose turn it is all are tried with caution, then farther from the gait's place, then both
        without caution, and only then others. Aside from it the legs whose turn it is are tried, near the gait's place.
        """
        both = (True, False) if ground.cautious is not ground.filled else (False,)
        first, aside = ways[0], ways[1:]
        return [
            *(
                (first, leg, cautious, wide, n == 0)
                for n, group in enumerate(self._order(belief, first.heading, in_air))
                for cautious in both
                for wide in (False, True)
                for leg in group
            ),
            *(
                (way, leg, cautious, False, False)
                for way in aside
                for cautious in both
                for leg in self._order(belief, way.heading, in_air)[0]
            ),
        ]

    def _order(self, belief: Belief, heading: Vec2, in_air: np.ndarray) -> list[list[int]]:
        # A leg in the air must come down before any other moves.
        if len(in_air):
            return [[int(in_air[0])]]
        if self._forced_leg is not None:
            others = [leg for leg in range(LEGS) if leg != self._forced_leg and self._forced_xy is None]
            return [[self._forced_leg], others]
        if self.config.step.gait.method == "single_steps":
            lag, order = self._by_lag(belief, heading)
            behind = [leg for leg in order if lag[leg] >= self.config.step.gait.min_step]
            # A wheel that is where it would step goes farther only when no other can.
            return [behind, [leg for leg in order if leg not in behind]]
        heading_in_hex = (belief.world_from_hex.rotation.T @ np.append(heading, 0.0))[:2]
        wave = reverse_wave(self.spec, heading_in_hex / np.linalg.norm(heading_in_hex))
        fewest = min(self.stepped[leg] for leg in range(LEGS))
        due = [leg for leg in wave if self.stepped[leg] == fewest]
        # A leg ahead of its turn may step once, to let the chassis go on; twice would only run away from the others.
        return [due, [leg for leg in wave if self.stepped[leg] == fewest + 1]]

    def _by_lag(self, belief: Belief, heading: Vec2) -> tuple[PerLeg, list[int]]:
        """How far each wheel is behind [m], and the legs in the order of that: what single steps go by."""
        chassis = on_path(belief, self._swayed)
        lag = lags(
            self.spec, self.config.step.gait, world_from_hex=chassis, contacts_in_world=belief.contacts_in_world, heading=heading,
            remaining=float(np.linalg.norm(self.goal - chassis.translation[:2])),
        )  # fmt: skip
        heading_in_hex = (belief.world_from_hex.rotation.T @ np.append(heading, 0.0))[:2]
        return lag, by_lag(self.spec, lag, heading_in_hex / np.linalg.norm(heading_in_hex))

    def _survey(self, belief: Belief, heading: Vec2, t: float) -> Action:
        self._surveyed = True
        heading_in_hex = (belief.world_from_hex.rotation.T @ np.append(heading, 0.0))[:2]
        commands = survey_commands(self.kin, belief, heading_in_hex, self.config.survey)
        sequence = self._as_sequence(commands, t)
        flat = HeightGrid(origin_x=-1.0, origin_y=-1.0, cell=1.0, heights=np.full((3, 3), np.nan))
        self._plan = None
        self._proposal = Proposal(
            index=self._next_proposal(), t=t, kind="shift", leg=-1, footfall_in_world=belief.world_from_hex.translation.copy(),
            sequence=sequence, preview=self.preview(sequence, belief, flat),
            terrain=flat, footfall_ok=np.zeros((3, 3), dtype=bool), cost=np.full((3, 3), np.nan),
            world_from_hex=belief.world_from_hex, predicted_margin=float("nan"), predicted_sag=0.0,
            text="look around: pictures from all cameras, nodding and turning on planted wheels",
        )  # fmt: skip
        return self._proposal

    def _retreat(self, belief: Belief, ground: Ground, plan: StepPlan, waypoints: np.ndarray, t: float) -> Action:
        """The wheel struck something in the air: back the way it came, and a look at what was there."""
        wheel_in_hex = self.kin.leg_wheel(plan.leg, belief.joints[plan.leg]).translation
        look = () if self.config.fusion_method == "flat" else seeing(self.spec, wheel_in_hex, most=self.config.survey.each_step)
        # The same corners, cut as they were on the way there.
        back = JointMove(leg=plan.leg, waypoints=waypoints, corner_tolerance=plan.swing_corner_tolerance)
        sequence = self._as_sequence([back], t, cameras=look)
        self._plan = None
        self._proposal = Proposal(
            index=self._next_proposal(), t=t, kind="shift", leg=plan.leg,
            footfall_in_world=belief.world_from_hex.apply(wheel_in_hex) - self.spec.wheel.radius * np.array([0.0, 0.0, 1.0]),
            sequence=sequence, preview=self.preview(sequence, belief, ground.filled),
            terrain=ground.heights, footfall_ok=ground.footfalls.allowed,
            cost=np.where(ground.footfalls.allowed, ground.footfalls.cost, np.nan),
            world_from_hex=belief.world_from_hex, predicted_margin=plan.swing_margin, predicted_sag=plan.sag,
            text=f"leg {plan.leg + 1} struck something: back the way it came, and a look",
        )  # fmt: skip
        return self._proposal

    def _lift_first(self, plan: StepPlan, belief: Belief, ground: Ground, t: float) -> Action:
        """The leg's lift-off alone, and pictures of what it hid: the step is planned on them, from where the leg then is.

        The lift-off is that of a step which passed every check on the map as it was, [SunSpiral2012] s5.2.1; the wheel goes
        on straight up, out of the view. A step that is not found then brings the leg down where it stood.
        """
        if plan.lift_in_hex is None:
            return self._as_proposal(plan, belief, ground, t)
        everything = tuple(c.name for c in self.spec.cameras if c.on_chassis)
        step = self.config.step
        carried = plan.world_from_leg_swing
        collision = LegCollision(self.spec, ground.filled, carried, belief.joints, plan.leg, step.collision)
        up = raised_path(self.kin, plan, belief, collision, config=self.config.look, payload_kg=self._payload)
        commands: list[Command] = [LegMove(leg=plan.leg, wheel_in_hex=plan.lift_in_hex, guard="break_contact")]
        tolerance = free_corner_tolerance(
            up, [collision.is_free_near_ground] * (len(up) - 1), most=step.swing.corner_tolerance,
            spacing=step.swing.smoothing.fine_resolution,
        )  # fmt: skip
        if len(up) > 1:
            commands.append(JointMove(leg=plan.leg, waypoints=up[1:], corner_tolerance=tolerance))
        # Its swing is the way up: that is what leads back, should the leg strike something on it.
        raised_in = leg_timing(self.spec, up, corner_tolerance=tolerance).duration
        self._plan, self._lift = None, replace(plan, swing=up, swing_corner_tolerance=tolerance, swing_time=raised_in)
        sequence = self._as_sequence(commands, t, cameras=everything)
        self._proposal = Proposal(
            index=self._next_proposal(), t=t, kind="shift", leg=plan.leg,
            footfall_in_world=belief.contacts_in_world[plan.leg].copy(),
            sequence=sequence, preview=self.preview(sequence, belief, ground.filled),
            terrain=ground.heights, footfall_ok=ground.footfalls.allowed,
            cost=np.where(ground.footfalls.allowed, ground.footfalls.cost, np.nan),
            world_from_hex=belief.world_from_hex, predicted_margin=plan.swing_margin, predicted_sag=plan.sag,
            predicted_torque_fraction=plan.peak_torque_fraction, predicted_clearance=plan.lift_clearance,
            text=f"leg {plan.leg + 1} lifts off, and pictures of what it hid",
        )  # fmt: skip
        return self._proposal

    def _roll(self, drive: DrivePlan, belief: Belief, ground: Ground, t: float) -> Action:
        """A stretch on wheels, and pictures all round at its end: they say where it led."""
        self._ground_s += SECONDS_PER_PLAN
        everything = () if self.config.fusion_method == "flat" else tuple(c.name for c in self.spec.cameras if c.on_chassis)
        x, y = belief.world_from_hex.translation[:2] + drive.way
        cut = f" (cut: {drive.cut_by})" if drive.cut_by else ""
        self._drive = drive
        sequence = self._as_sequence([drive.command], t, cameras=everything)
        self._proposal = Proposal(
            index=self._next_proposal(), t=t, kind="shift", leg=-1,
            footfall_in_world=drive.world_from_hex[-1].translation.copy(),
            sequence=sequence, preview=self.preview(sequence, belief, ground.filled),
            terrain=ground.heights, footfall_ok=ground.footfalls.allowed,
            cost=np.where(ground.footfalls.allowed, ground.footfalls.cost, np.nan),
            world_from_hex=belief.world_from_hex, predicted_margin=drive.margin, predicted_sag=drive.uneven,
            text=f"drives {float(np.linalg.norm(drive.way)):.1f} m to ({x:.2f}, {y:.2f}) m on its wheels, then pictures{cut}",
        )  # fmt: skip
        return self._proposal

    def _lower(self, belief: Belief, ground: Ground, plan: StepPlan, t: float) -> Action:
        """The wheel found no ground where the map had some: further down at the same place."""
        axle = self.kin.leg_wheel(plan.leg, belief.motors[plan.leg]).translation
        down = belief.gravity_in_hex() / GRAVITY
        # From a raised place it is farther: all the way to the ground as the map has it, and then as far again as ever.
        under = belief.world_from_hex.apply(axle) - self.spec.wheel.radius * np.array([0.0, 0.0, 1.0])
        height = max(0.0, float(under[2] - ground.filled.sample(under[None, :2])[0]))
        touch = self.config.step.touchdown
        depth = height + (touch.search_depth if touch.method == "guarded" else plan.reload)
        target = axle + depth * down
        straight = straighten_commands(
            self.kin, plan.leg, belief.motors[plan.leg], down, tolerance=self.config.step.swing.branch_tolerance
        )
        commands = [*straight, *lower_commands(plan, target)]
        contact = belief.world_from_hex.apply(target) - self.spec.wheel.radius * np.array([0.0, 0.0, 1.0])
        lowered = replace(
            plan, lift_in_hex=None, descent_in_hex=target, shift=BodyShift.none(), footfall_in_world=contact,
            preview_joints=belief.joints[None].copy(), preview_world_from_hex=(belief.world_from_hex,),
        )  # fmt: skip
        most = "at most " if touch.method == "guarded" else ""
        text = f"leg {plan.leg + 1} goes further down where it is, {most}{100 * depth:.0f} cm"
        proposal = self._as_proposal(lowered, belief, ground, t, commands=commands, text=text)
        if np.linalg.norm((contact - belief.contacts_in_world[plan.leg])[:2]) < self.config.step.gait.min_step:
            # Back to where it stood, after a look at what it hid: that is no step, and makes no gait cycle.
            proposal = self._proposal = replace(proposal, kind="shift")
        return proposal

    def _ground(self, belief: Belief) -> Ground:
        """The terrain for one plan: heights with unknown cells, heights without, and the footfalls on it."""
        config = self.config
        if config.fusion_method == "flat":
            grid, variance = self._plane(belief)
            filled = cautious = grid
        else:
            fused, collision = without_spikes(self.eyes.map.fused(), config=config.spikes), config.step.collision
            if config.unknown_terrain == "flat":
                grid = filled = cautious = fused.filled("nearest").grid
            else:
                # What nobody saw may hide a rock as high as the highest beside it, and a little more.
                guessed = fused.filled("highest", margin=collision.unknown_rise)
                grid = fused.grid
                filled = guessed.grid if config.unknown_terrain == "obstacle" else fused.filled("nearest").grid
                # Where the map is vague a swing keeps farther off, so far that its clearance is of the vaguest height allowed for.
                cautious = guessed.raised(collision.map_deviations, over=collision.map_error_covered).grid
            # A cell that is believed to be as high as its neighbours is believed to be sure; any other of which nobody knows is not.
            believed = fused.unknown & (config.unknown_terrain == "flat")
            variance = np.where(believed, 0.0, fused.variance)
        footfalls = score_footfalls(grid, variance, wheel_radius=self.spec.wheel.radius, config=config.footfall)
        return Ground(heights=grid, filled=filled, cautious=cautious, footfalls=footfalls)

    def _plane(self, belief: Belief) -> tuple[HeightGrid, np.ndarray]:
        """A flat map: the plane through the wheels' contacts."""
        contacts = belief.contacts_in_world[belief.planted]
        design = np.column_stack([contacts[:, :2], np.ones(len(contacts))])
        slope_x, slope_y, height = np.linalg.lstsq(design, contacts[:, 2], rcond=None)[0]
        cell = self.config.fusion.cell
        n = int(2 * FLAT_RADIUS / cell) + 1
        x = belief.world_from_hex.translation[0] - FLAT_RADIUS + cell * np.arange(n)
        y = belief.world_from_hex.translation[1] - FLAT_RADIUS + cell * np.arange(n)
        heights = slope_x * x[:, None] + slope_y * y[None, :] + height
        return HeightGrid(origin_x=float(x[0]), origin_y=float(y[0]), cell=cell, heights=heights), np.zeros((n, n))

    def _as_proposal(
        self,
        plan: StepPlan,
        belief: Belief,
        ground: Ground,
        t: float,
        *,
        commands: list[Command] | None = None,
        text: str = "",
    ) -> Proposal:
        cameras = self._cameras(tuple(part.leg for part in plan.parts), belief)
        sequence = self._as_sequence(step_commands(plan) if commands is None else commands, t, cameras=cameras)
        footfalls: FootfallMap = ground.footfalls
        shift = 100 * float(np.linalg.norm(plan.shift.translation_in_hex[:2]))
        cut = f" (cut: {plan.shift.cut_by})" if plan.shift.cut_by else ""
        self._plan = plan
        self._proposal = Proposal(
            index=self._next_proposal(),
            t=t,
            kind="step",
            leg=plan.leg,
            footfall_in_world=plan.footfall_in_world.copy(),
            sequence=sequence,
            preview=self.preview(sequence, belief, ground.filled),
            terrain=ground.heights,
            footfall_ok=footfalls.allowed,
            cost=np.where(footfalls.allowed, footfalls.cost, np.nan),
            world_from_hex=belief.world_from_hex,
            predicted_margin=min(plan.swing_margin, plan.landed_margin),
            predicted_sag=plan.sag,
            predicted_torque_fraction=plan.peak_torque_fraction,
            predicted_clearance=float("nan") if plan.lift_in_hex is None else min(part.lift_clearance for part in plan.parts),
            unknown_share=max(
                unknown_share(ground.heights, part.footfall_in_world, radius=self.spec.wheel.radius) for part in plan.parts
            ),
            text=text or f"{_told(plan)}, {plan.swing_time:.0f} s through the air, then the chassis shifts by {shift:.0f} cm{cut}",
            together=tuple(Landing(leg=part.leg, footfall_in_world=part.footfall_in_world.copy()) for part in plan.parts[1:]),
        )
        return self._proposal

    def _cameras(self, legs: tuple[int, ...], belief: Belief) -> tuple[str, ...]:
        """Which cameras look at the places where the next legs will step, once `legs` have."""
        if self.config.fusion_method == "flat":
            return ()
        offset = self.goal - belief.world_from_hex.translation[:2]
        heading = offset / max(float(np.linalg.norm(offset)), 1e-9) if self.guide.heading is None else self.guide.heading
        upcoming = self._upcoming(belief, heading, legs)[:3]
        places = regular_places(self.spec, belief.world_from_hex) + 0.5 * stride(self.spec, self.config.step.gait) * heading
        names: dict[str, None] = {}
        hex_from_world = belief.world_from_hex.inverse()
        floor = float(np.mean(belief.contacts_in_world[:, 2]))
        for coming in upcoming:
            for ahead in (0.0, stride(self.spec, self.config.step.gait)):
                point: Vec3 = np.append(places[coming] + ahead * heading, floor)
                for name in seeing(self.spec, hex_from_world.apply(point), most=2):
                    names[name] = None
        return tuple(names)[: self.config.survey.each_step]

    def _upcoming(self, belief: Belief, heading: Vec2, legs: tuple[int, ...]) -> list[int]:
        """All legs in the order in which their turns come, once `legs` have stepped."""
        if self.config.step.gait.method == "single_steps":
            return sorted(self._by_lag(belief, heading)[1], key=lambda other: other in legs)
        later = Counter(self.stepped) + Counter(legs)
        wave = reverse_wave(self.spec, (belief.world_from_hex.rotation.T @ np.append(heading, 0.0))[:2])
        return sorted(wave, key=lambda other: later[other])

    def _as_sequence(self, commands: list[Command], t: float, *, cameras: tuple[str, ...] = ()) -> CommandSequence:
        sequence = as_sequence(
            commands, robot_id=self.spec.name, sequence_id=self._sequence_id, t=t, cameras=cameras,
            binning=self.config.survey.binning, max_torque_fraction=MAX_TORQUE_FRACTION,
        )  # fmt: skip
        self._sequence_id += 1
        return sequence

    def _send(
        self, sequence: CommandSequence, plan: StepPlan | None, *, lift: StepPlan | None = None, drive: DrivePlan | None = None,
        aside: AsidePlan | None = None,
    ) -> CommandSequence:  # fmt: skip
        awaited = sum(len(c.cameras) * len(c.brackets) for c in sequence.commands if isinstance(c, ImageRequest))
        self._sent = Underway(sequence=sequence, plan=plan, pairs_awaited=awaited, lift=lift, drive=drive, aside=aside)
        attempt = plan or lift
        if attempt is not None:
            self._attempts |= {part.leg: attempt.of_leg(part.leg) for part in attempt.parts}
        if any(isinstance(c, JointMove) for c in sequence.commands):
            self._recovery.retreat = None
        return sequence

    def _next_proposal(self) -> int:
        self._proposals += 1
        return self._proposals - 1


def _told(plan: StepPlan) -> str:
    """Which leg goes where."""
    steps = [f"leg {part.leg + 1} steps to ({part.footfall_in_world[0]:.2f}, {part.footfall_in_world[1]:.2f}) m" for part in plan.parts]
    return " and ".join(steps) + (" together" if plan.companion is not None else "")


def _swayed_so_far(shift: BodyShift, before: SE3, belief: Belief) -> Vec3:
    """What a shift that broke off has displaced the chassis from its path by, in world [m]: as much as it went of its way."""
    way = before.rotate(shift.translation_in_hex)[:2]
    gone = (belief.world_from_hex.translation - before.translation)[:2]
    share = float(np.clip(gone @ way / max(way @ way, 1e-9), 0.0, 1.0)) if way @ way > 1e-4 else 0.0
    return np.asarray(share * before.rotate(shift.sway_in_hex))


__all__ = ["GroundAgent", "Uplink"]
