"""A robot at rest: how little its sag depends on the tick, and how little the clock's freeze leaves out."""

import time
from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.athlete import Athlete
from athlete_twin.errors import PhysicsError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import BodyMove, Command, CommandSequence, Fault, LegMove
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.physics.body import Body, settled
from athlete_twin.world.scenario import load_scenario

ROBOTS = ("sdm_b", "t12")
SAG_TOLERANCE = 0.5e-3  # [m]
FINE_TICK = 1.0 / 2000.0  # [s]
LIFT = 0.30  # [m]
HELD = 20.0  # [s]
HELD_TOLERANCE = 0.1e-3  # [m]
EDGE = 0.12  # [m]
CALM_LOAD = 1e-3  # of the weight
CLOCK_RATE = 1000.0  # x real time


def run(body: Body, commands: np.ndarray, seconds: float) -> None:
    limits = np.full(commands.shape, 0.1)
    for _ in range(round(seconds / body.world.tick)):
        body.step(commands, limits)


def corners(body: Body) -> np.ndarray:
    """Hips and axles in world: what sags."""
    poses = body.link_poses()
    hips = [poses[f"leg{leg + 1}_hip_yaw"].translation for leg in range(6)]
    return np.array([*hips, *body.axles])


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("robot", ROBOTS)
def test_settled_sag_is_that_of_a_tick_of_half_a_millisecond(make_body, robot):
    """On six wheels, then with leg 1 up (on T12 at a pallet corner): friction's history and the docks take part."""
    coarse, fine = make_body(robot), make_body(robot, tick=FINE_TICK)
    commands = coarse.motors
    lifted = commands.copy()
    up, ok = leg_ik(coarse.spec, 0, (kinematics(robot).leg_wheel(0, commands[0]).translation + [0.0, 0.0, LIFT])[None])
    assert ok[0]
    lifted[0] = up[0]
    for posture, seconds in ((commands, 6.0), (lifted, 12.0)):
        for body in (coarse, fine):
            run(body, posture, seconds)
        assert np.abs(corners(coarse) - corners(fine)).max() < SAG_TOLERANCE
    assert coarse.tyre.loads[0] == fine.tyre.loads[0] == 0.0


@pytest.mark.parametrize("tick", [0.0, -0.001, 1.0 / 120.0, float("nan")])
def test_a_tick_coarser_than_the_gains_bear_is_refused(make_body, tick):
    with pytest.raises(PhysicsError, match=r"tick is .* at most 0\.004167 s"):
        make_body("sdm_b", tick=tick)


def athlete(robot: str) -> Athlete:
    """A twin with its own deviations among rocks, on little ground so that it is made quickly."""
    yard = replace(load_scenario("rock_field"), size=(13.0, 10.0), x_min=-5.0, cell=0.1)
    return Athlete(load_spec(robot), yard, 1)


def carry_out(robot: Athlete, *commands: Command) -> None:
    """Until the sequence is done and the robot at rest again."""
    number = robot.executive.newest_seq + 1
    made = robot.receive(CommandSequence(seq=number, robot_id=robot.robot_id, t=robot.t, sequence_id=number, commands=commands))
    while robot.busy or robot.truth().moving:
        made += robot.advance(robot.t + 0.5)
    assert not [m for m in made if isinstance(m, Fault)]


def hold(robot: Athlete, seconds: float) -> None:
    """What the clock leaves out: every tick of the time in which nothing is commanded."""
    run(robot.body, robot.executive.setpoint - robot.trial.encoder_zero, seconds)
    robot.t += seconds


def apart(a: Athlete, b: Athlete) -> float:
    """Largest distance between wheels and chassis of two robots [m]."""
    chassis = a.body.world_from_hex().translation - b.body.world_from_hex().translation
    return float(max(np.abs(chassis).max(), np.abs(a.body.axles - b.body.axles).max()))


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_robot_held_by_the_clock_goes_on_like_one_that_was_integrated(robot):
    frozen, integrated = athlete(robot), athlete(robot)
    try:
        wheel = frozen.kin.leg_wheel(1, frozen.executive.setpoint[1]).translation
        up = wheel + [0.0, 0.0, 1.2 * frozen.spec.wheel.radius]
        lift = LegMove(leg=1, wheel_in_hex=up, guard="break_contact")
        for one in (frozen, integrated):
            carry_out(one, BodyMove(translation_in_hex=np.array([0.03, 0.0, 0.0])))
        assert apart(frozen, integrated) == 0.0
        for commands in ((lift, BodyMove(translation_in_hex=np.array([-0.05, 0.0, 0.0]))), (LegMove(leg=1, wheel_in_hex=up),)):
            until, begun = frozen.t + HELD, time.perf_counter()
            while frozen.t < until - 1e-9:
                frozen.advance(until)
            assert HELD / (time.perf_counter() - begun) > CLOCK_RATE
            hold(integrated, HELD)
            assert apart(frozen, integrated) < HELD_TOLERANCE
            for one in (frozen, integrated):
                carry_out(one, *commands)
            assert apart(frozen, integrated) < HELD_TOLERANCE
    finally:
        frozen.close()
        integrated.close()


@pytest.mark.slow
@pytest.mark.ci
def test_what_sways_is_not_settled_where_it_turns(make_body):
    """At a turning point all is still for a moment: T12's sway after it was put down passes several."""
    body = make_body("t12")
    commands = body.motors
    run(body, commands, 2.0)
    turning = 0
    while not settled(body):
        run(body, commands, body.world.tick)
        turning += body.calm_ticks == 1
    assert turning > 1
    before = body.axles.copy()
    run(body, commands, 5.0)
    assert np.abs(body.axles - before).max() < HELD_TOLERANCE


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("overhang", [-0.4, 0.0, 0.4])
@pytest.mark.slow
def test_a_robot_with_a_wheel_on_an_edge_comes_to_rest(make_body, robot, overhang):
    """The edge runs past wheel 2, inside, under or outside its axle by a part of its radius; T12 sways for 25 s."""
    spec = load_spec(robot)
    wheel = stance_wheels_in_hex(spec)[1]
    along = np.linspace(-6.0, 6.0, 241)
    beyond = (along[:, None] >= wheel[0] + overhang * spec.wheel.radius) & (np.abs(along[None, :] - wheel[1]) < 0.6)
    ground = HeightGrid(origin_x=-6.0, origin_y=-6.0, cell=0.05, heights=np.where(beyond, EDGE, 0.0))
    body = make_body(robot, ground=ground)
    commands = body.motors
    run(body, commands, 30.0)
    assert settled(body)
    before, axles = body.tyre.loads.copy(), body.axles.copy()
    run(body, commands, 1.0)
    assert np.abs(body.tyre.loads - before).max() < CALM_LOAD * spec.mass * GRAVITY
    assert np.abs(body.axles - axles).max() < HELD_TOLERANCE
    assert body.tyre.loads[1] > 0.0


@pytest.mark.slow
@pytest.mark.ci
def test_a_robot_that_has_not_settled_is_not_at_rest(monkeypatch):
    monkeypatch.setattr("athlete_twin.athlete.SETTLE_LIMIT", 0.2)
    athlete = Athlete(load_spec("t12"), load_scenario("calibration_yard"), 0)
    try:
        assert athlete.truth().moving
        before = athlete.body.axles.copy()
        while athlete.t < 1.0 - 1e-6:
            athlete.advance(1.0)
        assert np.abs(athlete.body.axles - before).max() > HELD_TOLERANCE
        while athlete.t < 60.0 - 1e-6:
            athlete.advance(60.0)
        assert not athlete.truth().moving
    finally:
        athlete.close()
