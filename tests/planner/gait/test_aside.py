"""Moves of the chassis out of the way: rubble that leaves a leg no footfall, and the least move that gives it one."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from athlete_twin.athlete import Athlete
from athlete_twin.errors import ConfigError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.polygon import conservative_distance
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, CommandSequence, Fault, Receipt, Telemetry
from athlete_twin.mock import MockAthlete
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.world.scenario import load_scenario
from planner.agent import GroundAgent
from planner.belief import Belief, BeliefFilter
from planner.decisions import Decision, NoStep, Proposal
from planner.gait.aside import ALONG, AsideConfig, AsidePlan, Asides, NoAside, moves, plan_aside
from planner.gait.skeleton import nominal_footfall
from planner.gait.step_plan import StepPlan
from planner.gait.step_search import Ground, StepRequest, search_step

AHEAD = np.array([1.0, 0.0])
CENTIMETRE = 0.01
HALF_DEGREE = float(np.deg2rad(0.5))
APPROVE = Decision(kind="approve")


def rubble(robot, field, *, leg: int, towards_deg: float, beyond: float) -> HeightGrid:
    """Bumps of 12 cm on the whole side of a leg's gait footfall away from `towards_deg`, up to a stride and `beyond` past it.

    That is all within which footfalls are sought. The patches that the wheels stand on are cleared, though not ahead of them.
    """
    grid = field()
    x, y = (part[..., None] if axis == 0 else part[None] for axis, part in enumerate(grid.centres()))
    place = nominal_footfall(
        robot.spec, robot.config.step.gait, leg=leg, world_from_hex=robot.belief.world_from_hex, heading=AHEAD, remaining=10.0
    )
    towards = np.array([np.cos(np.deg2rad(towards_deg)), np.sin(np.deg2rad(towards_deg))])
    side = (x - place[0]) * towards[0] + (y - place[1]) * towards[1] < robot.spec.stride + beyond
    wheels = robot.belief.contacts_in_world
    radius = robot.spec.wheel.radius
    cleared = np.any([(np.hypot(x - w[0], y - w[1]) < 1.3 * radius) & (x < w[0] + 0.3 * radius) for w in wheels], axis=0)
    bumps = 0.12 * ((np.round(x / grid.cell) % 3 == 0) & (np.round(y / grid.cell) % 3 == 0))
    return replace(grid, heights=np.where(side & ~cleared, bumps, 0.0))


def search(robot, ground: Ground, leg: int, belief: Belief, turn: float = 0.0) -> StepPlan | NoStep:
    request = StepRequest(leg=leg, heading=AHEAD, remaining=10.0, wide=True, yaw=turn)
    return search_step(
        robot.kin, robot.springs, belief, ground, request, config=robot.config.step, payload_kg=0.0, rng=np.random.default_rng(0)
    )


def aside(robot, ground: Ground, leg: int, *, config: AsideConfig | None = None) -> AsidePlan | NoAside:
    def step_from(belief: Belief, turn: float) -> StepPlan | None:
        found = search(robot, ground, leg, belief, turn)
        return found if isinstance(found, StepPlan) else None

    return plan_aside(
        robot.kin, robot.belief, ground, AHEAD, step_from, config=config or AsideConfig(), step=robot.config.step, payload_kg=0.0
    )


def move_to(robot, ground: Ground, across: float, turn_deg: float) -> AsidePlan | NoAside:
    """The plan of one move, whatever it is good for."""
    turn = float(np.deg2rad(turn_deg))
    any_step = SimpleNamespace(leg=0)

    def step_from(belief: Belief, turned: float):
        start = robot.belief.world_from_hex.translation
        there = (belief.world_from_hex.translation - start)[1] == pytest.approx(across) and turned == pytest.approx(turn)
        return any_step if there else None

    config = AsideConfig(across=(abs(across),) if across else (), turn_deg=(abs(turn_deg),) if turn_deg else ())
    return plan_aside(robot.kin, robot.belief, ground, AHEAD, step_from, config=config, step=robot.config.step, payload_kg=0.0)


def carried_out(plan: AsidePlan, vehicle) -> tuple[SE3, Telemetry]:
    """What the vehicle's chassis did, seen from its start, and the last it told."""
    before, told = vehicle.truth().world_from_hex, []
    number = vehicle.executive.newest_seq + 1
    vehicle.receive(
        CommandSequence(seq=number, robot_id=vehicle.robot_id, t=vehicle.t, sequence_id=number, commands=(plan.command,))
    )
    while vehicle.busy:
        told += vehicle.advance(vehicle.t + 1.0)
    assert not any(isinstance(message, Fault) for message in told)
    return before.inverse().compose(vehicle.truth().world_from_hex), [m for m in told if isinstance(m, Telemetry)][-1]


def assert_as_planned(plan: AsidePlan, start_from_end: SE3) -> None:
    wanted = plan.world_from_hex[0].inverse().compose(plan.world_from_hex[-1])
    off = wanted.inverse().compose(start_from_end)
    assert np.linalg.norm(off.translation) < CENTIMETRE
    assert np.linalg.norm(off.rotvec()) < HALF_DEGREE


SIDEWAYS = {"sdm_b": (5, 90.0, -0.10), "t12": (0, 90.0, -0.20)}
"""leg that is due, which way it is open, and how far the rubble goes beyond the search [m]"""


@pytest.mark.slow
def test_rubble_under_all_of_a_legs_footfalls_is_passed_by_the_least_move_that_gives_a_step(robot, on, field):
    leg, towards, beyond = SIDEWAYS[robot.spec.name]
    ground = on(robot, rubble(robot, field, leg=leg, towards_deg=towards, beyond=beyond))
    stuck = search(robot, ground, leg, robot.belief)
    assert isinstance(stuck, NoStep) and "no allowed footfall" in stuck.reason
    plan = aside(robot, ground, leg)
    assert isinstance(plan, AsidePlan) and plan.leg == leg
    assert plan.across > 0.0 and plan.turn == 0.0
    told = f"the chassis goes {100 * plan.across:.0f} cm to the left over its wheels, then leg {leg + 1} has one"
    assert plan.text == f"no leg finds a step: {told}"
    # Whatever comes before it in the list gives no step.
    for across, turn in moves(AsideConfig(), robot.spec.foot_radius):
        if (across, turn) == (plan.across, plan.turn):
            break
        before = move_to(robot, ground, across, float(np.rad2deg(turn)))
        if isinstance(before, AsidePlan):
            end = replace(robot.belief, world_from_hex=before.world_from_hex[-1], joints=before.preview_joints[-1])
            assert isinstance(search(robot, ground, leg, replace(end, motors=before.preview_joints[-1]), turn), NoStep)
    # Done for real, the robot believes itself where the plan said, and finds the step.
    belief_filter = BeliefFilter(robot.kin, robot.springs, payload_kg=0.0, config=robot.config.wheel_fit)
    mock = MockAthlete(robot.spec)
    (hello,) = mock.advance(1.0)
    belief_filter.update(hello)
    moved, telemetry = carried_out(plan, mock)
    assert_as_planned(plan, moved)
    after = belief_filter.update(telemetry)
    assert_as_planned(plan, robot.belief.world_from_hex.inverse().compose(after.world_from_hex))
    assert isinstance(search(robot, ground, leg, after), StepPlan)


TURNED = {"sdm_b": (3, -90.0, -0.10), "t12": (0, 122.0, -0.10)}
"""the open side lies where a turn takes the leg's footfalls"""


@pytest.mark.slow
@pytest.mark.ci
def test_where_only_turns_are_allowed_the_chassis_turns_until_the_leg_has_a_step(robot, on, field):
    leg, towards, beyond = TURNED[robot.spec.name]
    ground = on(robot, rubble(robot, field, leg=leg, towards_deg=towards, beyond=beyond))
    assert isinstance(search(robot, ground, leg, robot.belief), NoStep)
    plan = aside(robot, ground, leg, config=AsideConfig(across=()))
    assert isinstance(plan, AsidePlan) and plan.leg == leg
    assert plan.turn != 0.0 and plan.across == 0.0 and "turns" in plan.text
    moved, _ = carried_out(plan, MockAthlete(robot.spec))
    assert_as_planned(plan, moved)


@pytest.mark.slow
@pytest.mark.ci
def test_a_turn_is_kept_by_the_shift_of_the_step_that_follows(robot, on, field):
    turn = float(np.deg2rad(5.0))
    plan = move_to(robot, on(robot, field()), 0.0, 5.0)
    there = replace(
        robot.belief, world_from_hex=plan.world_from_hex[-1], joints=plan.preview_joints[-1], motors=plan.preview_joints[-1]
    )
    for wanted, left in ((turn, turn), (0.0, turn - robot.config.step.shift.max_yaw)):
        step = search(robot, on(robot, field()), 0, there, wanted)
        assert isinstance(step, StepPlan)
        end = there.world_from_hex.compose(SE3.from_rotvec(step.shift.rotvec_in_hex, step.shift.translation_in_hex))
        assert end.rpy()[2] == pytest.approx(left, abs=2e-3)


@pytest.mark.parametrize(("across", "turn_deg"), [(0.2, 0.0), (-0.2, 0.0), (0.0, 10.0), (0.0, -10.0), (0.1, -5.0)])
@pytest.mark.slow
@pytest.mark.ci
def test_moves_keep_the_rule_by_another_reckoning_and_the_mock_makes_them(robot, on, field, across, turn_deg):
    plan = move_to(robot, on(robot, field()), across, turn_deg)
    assert isinstance(plan, AsidePlan), plan
    margins = [
        conservative_distance(pose.apply(robot.kin.com_in_hex(joints))[:2], robot.belief.contacts_in_world[:, :2])
        for pose, joints in zip(plan.world_from_hex, plan.preview_joints, strict=True)
    ]
    assert plan.margin == pytest.approx(min(margins)) and plan.margin >= robot.config.step.stability.min_margin
    assert len(plan.world_from_hex) == 1 + len(ALONG)
    np.testing.assert_allclose(plan.world_from_hex[-1].translation - plan.world_from_hex[0].translation, [0.0, across, 0.0], atol=1e-9)
    assert_as_planned(plan, carried_out(plan, MockAthlete(robot.spec))[0])


@pytest.mark.slow
@pytest.mark.parametrize(("across", "turn_deg"), [(0.2, 0.0), (0.1, -10.0)])
def test_the_twin_makes_the_moves_to_a_centimetre_and_half_a_degree(robot, on, field, across, turn_deg):
    plan = move_to(robot, on(robot, field()), across, turn_deg)
    assert isinstance(plan, AsidePlan), plan
    twin = Athlete(robot.spec, load_scenario("calibration_yard"), 0, trial=nominal_truth(robot.spec))
    try:
        twin.advance(twin.t + 5.0)
        assert_as_planned(plan, carried_out(plan, twin)[0])
        assert not twin.collisions
    finally:
        twin.close()


@pytest.mark.slow
@pytest.mark.ci
def test_each_check_that_refuses_moves_is_counted_and_told(robot, on, field):
    ground, step = on(robot, field()), robot.config.step

    def refused(belief=None, **changed) -> NoAside:
        found = plan_aside(
            robot.kin, belief or robot.belief, ground, AHEAD, lambda *_: None, config=AsideConfig(),
            step=replace(step, **changed), payload_kg=0.0,
        )  # fmt: skip
        assert isinstance(found, NoAside)
        return found

    count = len(moves(AsideConfig(), robot.spec.foot_radius))
    plain = refused()
    assert plain.refused.total() == count == 24 and plain.refused["aside_no_step"] > 0
    assert "no step after it" in plain.reason
    strict = refused(stability=replace(step.stability, min_margin=5.0))
    assert strict.refused == Counter({"aside_margin": count}) and strict.reason.endswith("helps: margin (24)")
    weak = replace(step.shift, max_torque_fraction=0.01)
    assert "aside_torque" in refused(shift=weak).refused
    tight = replace(step.collision, near_ground_clearance=2.0)
    assert refused(collision=tight).refused.keys() == {"aside_collision"}
    lifted = robot.belief.planted.copy()
    lifted[3] = False
    assert refused(replace(robot.belief, planted=lifted)).reason == "a leg is in the air"
    none = plan_aside(
        robot.kin, robot.belief, ground, AHEAD, lambda *_: None, config=AsideConfig(across=(), turn_deg=()), step=step, payload_kg=0.0
    )
    assert isinstance(none, NoAside) and none.reason.endswith("none is to be tried")
    giant = plan_aside(
        robot.kin, robot.belief, ground, 400.0 * AHEAD, lambda *_: None, config=AsideConfig(turn_deg=()), step=step, payload_kg=0.0
    )
    assert isinstance(giant, NoAside) and giant.refused["aside_reach"] == 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"across": (0.1, -0.1)}, r"across is \(0.1, -0.1\), need values above 0 and at most 0.5, or none"),
        ({"turn_deg": (45.0,)}, r"turn_deg is \(45.0,\), need values above 0 and at most 30, or none"),
        ({"turn_deg": (1.0, 2.0, 3.0, 4.0, 5.0)}, "turn_deg has 5 values, at most 4"),
        ({"between_steps": -1}, "between_steps is -1 and steps_turned 6, need 0 and 1 or more"),
    ],
)
def test_settings_out_of_bounds_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        AsideConfig(**settings)


def test_moves_come_in_the_order_of_how_far_they_take_a_wheel(robot):
    every = moves(AsideConfig(), robot.spec.foot_radius)
    far = [abs(across) + robot.spec.foot_radius * abs(turn) for across, turn in every]
    assert np.all(np.diff(far) > -1e-8) and every[0] == (0.10, 0.0) and len(set(every)) == 24


def test_a_turn_is_kept_for_a_cycle_and_moves_are_few_between_steps():
    asides = Asides(AsideConfig())
    assert not asides.barred and asides.yaw == 0.0
    asides.took(0.1)
    asides.took(0.1)
    assert asides.yaw == pytest.approx(0.2) and "2 moves of the chassis aside" in asides.barred
    for _ in range(5):
        asides.stepped()
        assert asides.yaw == pytest.approx(0.2) and not asides.barred
    asides.stepped()
    assert asides.yaw == 0.0
    asides.give_up()
    assert "refused or broke off" in asides.barred
    asides.stepped()
    assert not asides.barred


# --- the ground that uses them ----------------------------------------------------------------------------------------


@pytest.fixture
def blocked(robot, monkeypatch) -> tuple[GroundAgent, MockAthlete, list[float]]:
    """A ground for which no leg finds a step unless the chassis has moved 10 cm; the list says from where steps were sought."""
    mock = MockAthlete(robot.spec)
    agent = GroundAgent(robot.spec, robot.config, goal_in_world=np.array([6.0, 0.0]), seed=0)
    for message in mock.advance(1.0):
        agent.observe(message, 1.0)
    sought: list[float] = []

    def only_aside(kin, springs, belief, ground, request, **rest):
        sought.append(float(belief.world_from_hex.translation[1]))
        if sought[-1] < 0.09:
            return NoStep(reason=f"leg {request.leg + 1} is blocked", refused={"rough": 1})
        return search_step(kin, springs, belief, ground, request, **rest)

    monkeypatch.setattr("planner.agent.search_step", only_aside)
    return agent, mock, sought


@pytest.mark.slow
@pytest.mark.ci
def test_the_ground_proposes_the_move_as_a_shift_and_then_the_step(blocked):
    agent, mock, _ = blocked
    shown = agent.next(1.0)
    assert isinstance(shown, Proposal) and (shown.kind, shown.leg) == ("shift", -1)
    assert "the chassis goes 10 cm to the left over its wheels" in shown.text
    (command,) = shown.sequence.commands
    assert isinstance(command, BodyMove) and shown.predicted_margin >= agent.config.step.stability.min_margin
    # An edit of a footfall that it has not is no answer.
    assert agent.decide(Decision(kind="edit_footfall", footfall_in_world=np.zeros(3)), 1.0) is None
    assert agent.next(1.0) is shown
    mock.receive(agent.decide(APPROVE, 1.0))
    while mock.busy:
        for message in mock.advance(mock.t + 1.0):
            agent.observe(message, mock.t)
    assert np.linalg.norm(agent.next(mock.t).world_from_hex.translation - shown.footfall_in_world) < CENTIMETRE
    step = agent.next(mock.t)
    assert isinstance(step, Proposal) and step.kind == "step" and step.leg == 0
    # At no time was another heading needed.
    assert agent.guide.heading @ AHEAD > 0.99


def test_a_refused_move_is_not_proposed_again_and_other_headings_are_tried(blocked):
    agent, _, sought = blocked
    assert agent.next(1.0).kind == "shift"
    before = len(sought)
    agent.decide(Decision(kind="reject"), 1.0)
    action = agent.next(2.0)
    assert isinstance(action, NoStep) and len(sought) > before
    assert action.reason.endswith("a move of the chassis aside was refused or broke off")


def test_a_move_that_breaks_off_is_not_tried_again_before_the_next_step(blocked):
    agent, _, _ = blocked
    agent.next(1.0)
    sent = agent.decide(APPROVE, 1.0)
    told = replace(agent._telemetry, seq=9, t=5.0, executive_state="fault", sequence_id=sent.sequence_id)
    fault = Fault(seq=0, robot_id=sent.robot_id, t=5.0, code="torque", text="x", sequence_id=sent.sequence_id, command_index=0, leg=1)
    failed = Receipt(
        seq=0, robot_id=sent.robot_id, t=5.0, sequence_id=sent.sequence_id, command_index=-1, status="failed"
    )  # fmt: skip
    for message in (fault, failed, told):
        agent.observe(message, 5.0)
    action = agent.next(5.0)
    assert isinstance(action, NoStep) and "refused or broke off" in action.reason


def test_where_no_move_helps_each_heading_and_the_moves_are_told(robot, monkeypatch):
    agent = GroundAgent(robot.spec, robot.config, goal_in_world=np.array([6.0, 0.0]), seed=0)
    for message in MockAthlete(robot.spec).advance(1.0):
        agent.observe(message, 1.0)
    monkeypatch.setattr("planner.agent.search_step", lambda *_, **__: NoStep(reason="blocked", refused={"rough": 1}))
    action = agent.next(1.0)
    assert isinstance(action, NoStep)
    assert action.reason.startswith("blocked (the same on 7 headings) | no move of the chassis sideways or about helps: ")
    assert action.refused["aside_no_step"] > 0 and sum(n for k, n in action.refused.items() if k.startswith("aside_")) == 24
