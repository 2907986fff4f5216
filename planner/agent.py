"""The ground: what comes down goes in, a proposal or an image request comes out. Reads like the papers' architecture.

stereo pairs -> depth -> depth without the robot's own legs -> fused terrain -> footfall scores -> stability map ->
chosen step -> collision-free path -> smoothed path -> sag-compensated sequence -> the operator's decision -> link

What of that is asked for when is decided here, and what came of it is kept: `eyes` make the map, `ground` is the terrain for one
plan, `turns` orders the legs, and `proposals` says what goes up.

The agent holds no clock and no link: messages come in by `observe`, actions go out by `next`, and computing time is
charged by a fixed table, so that results do not depend on the machine.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.arrays import Vec2, Vec3
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import Command, CommandSequence, Fault, ImageRequest, JointMove, LegMove, Message, Telemetry
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.belief import Belief, BeliefFilter
from planner.config import PlannerConfig
from planner.decisions import Action, Arrived, Decision, NoStep, Uplink, Waiting, check_cameras
from planner.eyes import Eyes, StageTimer, untimed
from planner.gait.aside import Asides, NoAside, plan_aside
from planner.gait.pair_search import search_pair
from planner.gait.skeleton import regular_places, stride
from planner.gait.step_plan import StepPlan
from planner.gait.step_search import Ground, StepRequest, on_path, search_step
from planner.gait.survey import seeing_steps
from planner.ground import flat_ground, mapped_ground
from planner.preview.preview import Preview
from planner.proposals import Offer, Proposer
from planner.recovery import LOWERINGS, Recovery, stands
from planner.route.drive import DrivePlan, plan_drive
from planner.route.guide import Guide, Way, refusals
from planner.terrain.ground_level import SIGMA as LEVEL_SIGMA
from planner.turns import Turns, cautions
from planner.underway import SILENCE, Inbox, Underway

SECONDS_PER_PLAN = 2.0
"""charged for planning one step [s]"""
SECONDS_PER_PAIR = 1.0
"""charged for one stereo pair [s]"""
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
        self._proposer = Proposer(self.kin, config, springs=self.springs, payload_kg=payload_kg, timer=timer)
        self._offer: Offer | None = None
        """what stands until the operator decides"""
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
                return Uplink(sequence=self._proposer.sequence([], t))
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
        if self._offer is None:
            made = self._propose(t, self._belief)
            if not isinstance(made, Offer):
                return made
            self._offer = made
        return self._offer.proposal

    def preview(self, sequence: CommandSequence, belief: Belief, terrain: HeightGrid) -> Preview:
        """What a sequence would do from a state of the robot, on believed heights that may be unknown (NaN) in places."""
        return self._proposer.preview(sequence, belief, terrain)

    def decide(self, decision: Decision, t: float) -> CommandSequence | None:
        """Apply the operator's answer to the standing proposal; the sequence to send, or None when nothing goes up."""
        check_cameras(decision, self.spec)
        offer = self._offer
        if offer is None or decision.kind == "wait":
            return None
        self._offer = None
        if decision.kind == "approve":
            return self._send(replace(offer.proposal.sequence, t=t), offer)
        if decision.kind == "reject":
            refused = offer.plan or offer.lift
            if offer.drive is not None:
                self._walks = True
            elif offer.aside is not None:
                self._asides.give_up()
            elif refused is None:
                self._surveyed, self._recovery.retreat = True, None
            else:
                self._recovery.reject(refused)
        elif decision.kind == "edit_footfall" and decision.footfall_in_world is not None:
            if offer.plan is None:  # a look around, a lift-off, a move aside or a way back has no footfall: the proposal comes again
                self._offer = offer
                return None
            wanted = np.asarray(decision.footfall_in_world[:2], dtype=float)
            # Of two legs that step together the one whose footfall it is nearest to, which then steps alone.
            nearest = min(offer.plan.parts, key=lambda part: float(np.linalg.norm(part.footfall_in_world[:2] - wanted)))
            self._forced_xy, self._forced_leg = wanted, nearest.leg
        elif decision.kind == "choose_leg":
            self._forced_leg = decision.leg
        elif decision.kind == "choose_cameras":
            look: list[Command] = [ImageRequest(cameras=decision.cameras, binning=self.config.survey.binning)]
            return self._send(self._proposer.sequence(look, t), None)
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
            before = sent.plan.preview_world_from_hex[0]
            self._swayed = self._swayed + sent.plan.shift.swayed_so_far(before, self._belief.world_from_hex)
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
        if fault.code != "swing_contact" and stands(self.kin, plan.leg, self._telemetry):
            self._filter.land(plan.leg)
        else:
            self._filter.lift(plan.leg)
        self._forced_leg = plan.leg

    # --- what goes up ---------------------------------------------------------------------------------------------

    def _propose(self, t: float, belief: Belief) -> Offer | Action:
        offset = self.goal - belief.world_from_hex.translation[:2]
        remaining = float(np.linalg.norm(offset))
        in_air = np.flatnonzero(~belief.planted)
        if not self._surveyed:
            self._surveyed = True
            return self._proposer.survey(belief, offset / max(remaining, 1e-9), t)
        if remaining <= self.config.step.gait.arrival_distance and len(in_air) == 0:
            return Arrived(text=f"believed {remaining:.2f} m from the goal")
        with self._timer("footfall"):
            ground = self._ground(belief)
        failure = None if self._faulty is None else self._attempts.get(self._faulty)
        if self._recovery.retreat is not None and failure is not None:
            return self._proposer.retreat(failure, self._recovery.retreat, belief, ground, t)
        # Unless the operator has a place elsewhere for it.
        if failure is not None and failure.leg in in_air and self._recovery.lowers and self._forced_xy is None:
            return self._lower(failure, belief, ground, t)
        with self._timer("route"):
            ways = self.guide.ways(replace(belief, world_from_hex=on_path(belief, self._swayed)), ground)
        forced_xy, self._forced_xy = self._forced_xy, None
        if not self._walks and self._forced_leg is None:
            drive = plan_drive(
                self.kin, self.springs, belief, ground, self.guide.route, route_config=self.config.route,
                config=self.config.drive, step=self.config.step, payload_kg=self._payload,
            )  # fmt: skip
            if isinstance(drive, DrivePlan):
                self._ground_s += SECONDS_PER_PLAN
                return self._proposer.roll(drive, belief, ground, t)
        failed: list[tuple[Way, str, Counter[str]]] = []
        together = self._search_pairs(belief, ground, ways[0], in_air)
        if isinstance(together, StepPlan):
            self.guide.took(ways[0])
            return self._step(together, belief, ground, t)
        failed += [(ways[0], no.reason, Counter(no.refused)) for no in together]
        hidden: Counter[int] = Counter()
        looked = len(in_air) > 0
        unmoved: NoAside | None = None
        tries = self._turns.tries(belief, ways, in_air, ground)
        if forced_xy is not None:  # the operator's place for one leg, on its way: no other's
            tries = [one for one in tries if one.leg == self._forced_leg and one.way is ways[0]]
        for attempt in tries:
            if not attempt.due and not looked:
                looked = True
                look = self._look_beneath(belief, ground, ways[0], hidden, t)
                if look is not None:
                    return look
            way, leg = attempt.way, attempt.leg
            if way is not ways[0] and unmoved is None:
                aside = self._go_aside(belief, ground, ways[0], t)
                if isinstance(aside, Offer):
                    return aside
                unmoved = aside
            request = self._request(belief, way, leg, cautious=attempt.cautious, wide=attempt.wide, footfall_xy=forced_xy)
            found = self._search(belief, ground, request)
            if isinstance(found, StepPlan):
                self._forced_leg = None
                self.guide.took(way)
                if self.config.fusion_method == "lift_and_image" and found.lift_in_hex is not None:
                    return self._proposer.lift_first(found, belief, ground, t)
                return self._step(found, belief, ground, t)
            hidden[leg] += found.refused.get("unknown", 0) if self.config.fusion_method != "flat" else 0
            failed.append((way, found.reason, Counter(found.refused)))
        reason, refused = refusals(failed)
        if forced_xy is not None:
            # The operator's place does not work: say so beside the gait's own step.
            self._forced_leg = None
            again = self._propose(t, belief)
            if isinstance(again, Offer):
                text = f"{again.proposal.text} (not at ({forced_xy[0]:.2f}, {forced_xy[1]:.2f}) m: {reason})"
                return replace(again, proposal=replace(again.proposal, text=text))
            return again
        hanging = self._attempts.get(int(in_air[0])) if len(in_air) else None
        if hanging is not None and self._recovery.lowerings <= LOWERINGS:
            self._recovery.lowerings += 1
            return self._lower(hanging, belief, ground, t)
        look = None if looked else self._look_beneath(belief, ground, ways[0], hidden, t)
        if look is not None:
            return look
        aside = self._go_aside(belief, ground, ways[0], t) if unmoved is None else unmoved
        if isinstance(aside, Offer):
            return aside
        return NoStep(reason=" | ".join(filter(None, (reason, aside.reason))), refused=dict(refused + aside.refused))

    def _request(
        self, belief: Belief, way: Way, leg: int, *, cautious: bool = True, wide: bool = True, footfall_xy: Vec2 | None = None
    ) -> StepRequest:
        return StepRequest(
            leg=leg, heading=way.heading, remaining=way.remaining, behind=self._behind, yaw=self._asides.yaw, swayed=self._swayed,
            footfall_xy=footfall_xy, refused_xy=self._recovery.refused_xy, extra_lift=self._recovery.extra_lift,
            next_leg=self._turns.upcoming(belief, way.heading, (leg,))[0], cautious=cautious, wide=wide,
        )  # fmt: skip

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
        pairs, refused = self._turns.pairs(belief, way.heading, in_air), []
        for cautious in cautions(ground):
            for pair in pairs:
                upcoming = self._turns.upcoming(belief, way.heading, pair)[0]
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

    def _go_aside(self, belief: Belief, ground: Ground, way: Way, t: float) -> Offer | NoAside:
        """No leg finds a step the way the gait goes: the chassis out of the way, wheels down, if that gives one that is due a step."""
        standing = bool(belief.planted.all())
        if self._asides.barred or not standing:
            return NoAside(reason=self._asides.barred if standing else "", refused=Counter())

        def step_from(there: Belief, turn: float) -> StepPlan | None:
            onward = self.guide.way_from(replace(there, world_from_hex=on_path(there, self._swayed)), ground, way.aside)
            for leg in self._turns.order(there, onward.heading, np.empty(0))[0]:
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
        return self._proposer.go_aside(aside, belief, ground, t, cameras=self._cameras((), belief))

    def _look_beneath(self, belief: Belief, ground: Ground, way: Way, hidden: Counter[int], t: float) -> Offer | None:
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
                return self._proposer.lift_first(found, belief, ground, t)
        return None

    def _step(self, plan: StepPlan, belief: Belief, ground: Ground, t: float) -> Offer:
        return self._proposer.step(plan, belief, ground, t, cameras=self._cameras(plan.legs, belief))

    def _lower(self, plan: StepPlan, belief: Belief, ground: Ground, t: float) -> Offer:
        return self._proposer.lower(plan, belief, ground, t, cameras=self._cameras(plan.legs, belief))

    def _cameras(self, legs: tuple[int, ...], belief: Belief) -> tuple[str, ...]:
        """Which cameras look at the places where the next legs will step, once `legs` have."""
        if self.config.fusion_method == "flat":
            return ()
        offset = self.goal - belief.world_from_hex.translation[:2]
        heading = offset / max(float(np.linalg.norm(offset)), 1e-9) if self.guide.heading is None else self.guide.heading
        span = stride(self.spec, self.config.step.gait)
        return seeing_steps(
            self.spec, belief, places=regular_places(self.spec, belief.world_from_hex) + 0.5 * span * heading,
            legs=self._turns.upcoming(belief, heading, legs)[:3], stride_in_world=span * heading, most=self.config.survey.each_step,
        )  # fmt: skip

    @property
    def _turns(self) -> Turns:
        """Whose turn it is now."""
        return Turns(
            spec=self.spec, gait=self.config.step.gait, goal=self.goal, stepped=self.stepped, swayed=self._swayed,
            forced_leg=self._forced_leg,
        )  # fmt: skip

    def _ground(self, belief: Belief) -> Ground:
        """The terrain for one plan."""
        radius = self.spec.wheel.radius
        if self.config.fusion_method == "flat":
            return flat_ground(belief, self.config, wheel_radius=radius)
        return mapped_ground(self.eyes.map.fused(), self.config, wheel_radius=radius)

    def _send(self, sequence: CommandSequence, offer: Offer | None) -> CommandSequence:
        """It goes up, and what of an offer it was is kept until it has ended."""
        awaited = sum(len(c.cameras) * len(c.brackets) for c in sequence.commands if isinstance(c, ImageRequest))
        self._sent = Underway(sequence=sequence, pairs_awaited=awaited)
        if offer is not None:
            self._sent.plan, self._sent.lift, self._sent.drive, self._sent.aside = offer.plan, offer.lift, offer.drive, offer.aside
        attempt = self._sent.plan or self._sent.lift
        if attempt is not None:
            self._attempts |= {part.leg: attempt.of_leg(part.leg) for part in attempt.parts}
        if any(isinstance(c, JointMove) for c in sequence.commands):
            self._recovery.retreat = None
        return sequence


__all__ = ["GroundAgent", "Uplink"]
