import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from athlete_twin.flat_stance import balance, fit_plan
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import (
    BodyMove,
    CommandSequence,
    Drive,
    Fault,
    ImageRequest,
    LegMove,
    Receipt,
    StereoPair,
    Stop,
    Telemetry,
    Wait,
)
from athlete_twin.mock import MockAthlete, ground_picture
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.robot import Robot, SimulatedRobot

ROBOTS = ("sdm_b", "t12")
MILLIMETRE = 1e-3


def sequence(robot, *commands, number=0):
    return CommandSequence(seq=number, robot_id=robot.robot_id, t=robot.t, sequence_id=number, commands=commands)


def carried_out(robot, *commands, number=0):
    out = robot.receive(sequence(robot, *commands, number=number))
    while robot.busy:
        out += robot.advance(robot.t + 60.0)
    return out


@pytest.mark.parametrize("name", ROBOTS)
def test_mock_keeps_the_robot_protocol(name):
    robot = MockAthlete(load_spec(name))
    assert isinstance(robot, Robot) and isinstance(robot, SimulatedRobot)


@pytest.mark.parametrize("name", ROBOTS)
def test_standing_mock_sags_by_its_weight_over_its_springs(name):
    robot = MockAthlete(load_spec(name))
    spec, truth = robot.spec, robot.truth()
    sag = spec.chassis_height - truth.world_from_hex.translation[2]
    # Closed form holds for loads that differ little; the centre of mass lies near the middle.
    assert sag == pytest.approx(spec.mass * GRAVITY / (6 * spec.believed_foot_stiffness), rel=0.02)
    assert truth.wheel_loads.sum() == pytest.approx(spec.mass * GRAVITY)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_balance_is_the_least_energy(seed):
    rng = np.random.default_rng(seed)
    wheels = stance_wheels_in_hex(load_spec("sdm_b")) + rng.uniform(-0.1, 0.1, (6, 3))
    com = rng.uniform(-0.2, 0.2, 3)
    radius, stiffness, weight = 0.242, 18000.0, 8340.0

    def energy(state):
        placed = SE3.from_rpy(state[1], state[2], 0.0, np.array([0, 0, state[0]]))
        sink = np.maximum(radius - placed.apply(wheels)[:, 2], 0.0)
        return weight * placed.apply(com)[2] + 0.5 * stiffness * float(sink @ sink)

    state, loads = balance(wheels, com, start=np.array([1.7, 0, 0]), radius=radius, stiffness=stiffness, weight=weight)
    best = minimize(
        energy, state + rng.normal(0, 0.02, 3), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-9}
    )
    assert np.abs(state - best.x).max() < MILLIMETRE
    assert loads.sum() == pytest.approx(weight, rel=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_plan_fit_recovers_a_rigid_motion(x, y, yaw):
    points = np.random.default_rng(0).uniform(-2, 2, (6, 2))
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    found = fit_plan(points, points @ turn.T + [x, y], np.array([True] * 5 + [False]))
    assert found == pytest.approx([x, y, yaw])


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.slow
def test_step_and_shift_do_what_they_say(name):
    robot = MockAthlete(load_spec(name))
    wheel = robot.kin.wheels_in_hex(robot.executive.setpoint)[0]
    lifted = wheel + np.array([0.0, 0.0, 0.3])
    ahead, deep = lifted + np.array([0.1, 0.0, 0.0]), wheel + np.array([0.1, 0.0, -0.03])
    before = robot.truth().wheels_in_world
    made = carried_out(
        robot,
        LegMove(leg=0, wheel_in_hex=lifted, guard="break_contact"),
        LegMove(leg=0, wheel_in_hex=ahead),
        LegMove(leg=0, wheel_in_hex=deep, guard="contact", contact_load=800.0),
        BodyMove(translation_in_hex=np.array([0.1, 0.0, 0.0])),
    )
    truth = robot.truth()
    assert not [m for m in made if isinstance(m, Fault)]
    assert truth.wheels_in_world[0, 0] - before[0, 0] == pytest.approx(0.1, abs=0.03)
    assert truth.wheels_in_world[1:, :2] == pytest.approx(before[1:, :2], abs=0.03)
    assert truth.world_from_hex.translation[0] == pytest.approx(0.1, abs=0.04)
    assert (truth.wheel_loads > 0.0).all()


def test_telemetry_comes_once_a_second_and_at_each_change_of_state():
    robot = MockAthlete(load_spec("sdm_b"))
    hello = robot.advance(1.0)
    assert [type(m) for m in hello] == [Telemetry]
    telemetry = [m for m in carried_out(robot, Wait(duration=10.0)) if isinstance(m, Telemetry)]
    gaps = np.diff([m.t for m in telemetry])
    assert telemetry[0].executive_state == "executing" and telemetry[-1].executive_state == "idle"
    # One executive period of slack.
    assert gaps[:-1] == pytest.approx(1.0, abs=1 / 24 + 1e-9)
    assert robot.advance(robot.t + 100.0) == []


def test_every_end_of_a_sequence_is_followed_by_telemetry():
    robot = MockAthlete(load_spec("sdm_b"))
    far = LegMove(leg=0, wheel_in_hex=np.array([9.0, 0.0, 0.0]))
    for number in range(3):
        made = carried_out(robot, far, number=number)
        assert any(isinstance(m, Fault) for m in made)
        last = made[-1]
        assert isinstance(last, Telemetry) and last.executive_state == "fault" and last.sequence_id == number


def test_sequences_are_receipted_and_numbered():
    robot = MockAthlete(load_spec("sdm_b"))
    made = carried_out(robot, Wait(duration=0.5)) + carried_out(robot, Wait(duration=0.5), number=1)
    receipts = [m for m in made if isinstance(m, Receipt)]
    assert [m.seq for m in receipts] == list(range(len(receipts)))
    assert [(r.sequence_id, r.command_index, r.status) for r in receipts] == [
        (n, k, s) for n in (0, 1) for k, s in ((-1, "queued"), (0, "completed"), (-1, "completed"))
    ]


def test_stop_ends_the_sequence():
    robot = MockAthlete(load_spec("sdm_b"))
    robot.receive(sequence(robot, Wait(duration=100.0)))
    robot.advance(2.0)
    made = robot.receive(Stop(seq=0, robot_id="sdm_b", t=2.0))
    assert not robot.busy
    assert {m.status for m in made if isinstance(m, Receipt)} == {"cancelled"}
    assert next(m for m in made if isinstance(m, Telemetry)).executive_state == "stopped"


def test_unknown_camera_is_a_fault():
    robot = MockAthlete(load_spec("sdm_b"))
    made = carried_out(robot, ImageRequest(cameras=("eye",)))
    (fault,) = [m for m in made if isinstance(m, Fault)]
    assert fault.code == "bad_command" and "eye" in fault.text
    assert [m.status for m in made if isinstance(m, Receipt)] == ["queued", "failed"]
    assert not [m for m in made if isinstance(m, StereoPair)]


def test_pictures_show_one_ground_to_both_eyes():
    robot = MockAthlete(load_spec("sdm_b"))
    (pair,) = [
        m for m in carried_out(robot, ImageRequest(cameras=("hazcam_1",), binning=2)) if isinstance(m, StereoPair)
    ]
    camera = robot.spec.camera("hazcam_1")
    eye = camera.eye.binned(2)
    assert pair.left.shape == (eye.height_px, eye.width_px)
    world_from_camera = robot.truth().world_from_hex.compose(camera.hex_from_camera)
    # The disparity at the middle pixel follows from the distance of flat ground along its ray.
    v, u = eye.height_px // 2, eye.width_px // 2
    ray = world_from_camera.rotate(eye.rays()[v, u])
    disparity = eye.focal_px * camera.baseline / (-world_from_camera.translation[2] / ray[2])
    window = pair.left[v - 8 : v + 9, u - 8 : u + 9].astype(float)
    errors = [np.abs(pair.right[v - 8 : v + 9, u - 8 - d : u + 9 - d].astype(float) - window).mean() for d in range(60)]
    assert int(np.argmin(errors)) == pytest.approx(disparity, abs=1.0)


def test_sky_is_bright_and_untextured():
    rays = np.array([[[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]])
    upward = SE3.from_translation(np.array([0.0, 0.0, 1.5]))
    assert (ground_picture(rays, upward) == 225).all()


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.slow
def test_a_drive_moves_the_mock_by_its_length_and_nothing_else(name):
    robot = MockAthlete(load_spec(name))
    before, stance = robot.truth().world_from_hex, robot.executive.setpoint.copy()
    carried_out(robot, Drive(translation_in_hex=np.array([0.9, -0.4]), speed=0.4))
    after = robot.truth().world_from_hex
    np.testing.assert_allclose(after.translation - before.translation, [0.9, -0.4, 0.0], atol=0.02)
    np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-3)
    np.testing.assert_allclose(robot.executive.setpoint, stance, atol=1e-9)


def test_a_bracket_of_the_mock_is_a_pair_for_each_exposure():
    robot = MockAthlete(load_spec("sdm_b"))
    request = ImageRequest(cameras=("hazcam_1", "toolcam_1"), binning=4, bits=12, brackets=(1.0, 0.25))
    pairs = [m for m in carried_out(robot, request) if isinstance(m, StereoPair)]
    assert [(p.camera, p.bracket) for p in pairs] == [
        ("hazcam_1", 0), ("hazcam_1", 1), ("toolcam_1", 0), ("toolcam_1", 1),
    ]  # fmt: skip
    assert pairs[0].left.dtype == np.uint16
    assert pairs[1].left == pytest.approx(0.25 * pairs[0].left.astype(float), abs=0.6)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.slow
def test_going_back_at_every_tick_changes_no_bit(name):
    def driven(back):
        robot = MockAthlete(load_spec(name))
        lift = LegMove(leg=3, wheel_in_hex=stance_wheels_in_hex(robot.spec)[3] + [0.0, 0.0, 0.3], guard="break_contact")
        shift = BodyMove(translation_in_hex=np.array([0.05, 0.02, 0.0]), rotvec_in_hex=np.array([0.02, 0.01, 0.0]))
        drive = Drive(translation_in_hex=np.array([0.1, 0.05]), speed=robot.spec.drive_speed)
        robot.receive(sequence(robot, shift, lift, drive))
        while robot.busy:
            if back:
                robot.restore(robot.save())
            robot.advance(robot.t + 0.05)
        truth = robot.truth()
        return [a.tobytes() for a in (truth.joints, truth.wheel_loads, truth.wheels_in_world, truth.torques)]

    assert driven(back=True) == driven(back=False)
