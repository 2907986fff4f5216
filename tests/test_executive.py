"""The executive keeps its guards: every fault has a cause here. A fake body moves as commanded and feels what it is told."""

import numpy as np
import pytest

from athlete_twin.driving import rolling_velocities
from athlete_twin.errors import CommandError
from athlete_twin.executive import CONTROL_PERIOD, Event, Executive
from athlete_twin.messages import (
    CORNER_TOLERANCE,
    BodyMove,
    CommandSequence,
    Drive,
    ImageRequest,
    JointMove,
    LegMove,
    Stop,
    Wait,
)
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.leg_timing import leg_timing
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.moves import Sensed

ROBOTS = ("sdm_b", "t12")


def executive(robot: str = "sdm_b") -> Executive:
    return Executive(kin=kinematics(robot), setpoint=regular_stance(load_spec(robot)))


def sequence(*commands, number: int = 1, robot: str = "sdm_b", **limits) -> CommandSequence:
    return CommandSequence(seq=number, robot_id=robot, t=0.0, sequence_id=number, commands=commands, **limits)


def run(robot: Executive, *, load: float = 0.0, torque: float = 0.0, tilt: float = 0.0, most: int = 4000) -> list[Event]:
    """Ticks until idle; every wheel carries `load` [N], every joint feels `torque` of its limit on top."""
    spec, kin, events = robot.kin.spec, robot.kin, []
    for _ in range(most):
        joints = robot.setpoint
        gravity = np.array([0.0, 0.0, -9.81])
        force = np.tile([0.0, 0.0, load], (6, 1))
        contacts = kin.wheels_in_hex(joints) - [0.0, 0.0, spec.wheel.radius]
        torques = kin.gravity_torques(joints, gravity, force, contacts) + torque * spec.torque_limits
        events += robot.tick(Sensed(joints=joints, torques=torques, attitude_rpy=np.array([tilt, 0.0, 0.0])))
        if not robot.busy:
            return events
    raise AssertionError("the executive never became idle")


def faults(events: list[Event]) -> list[str]:
    return [e.status for e in events if e.kind == "fault"]


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_lift_goes_straight_up_within_the_joint_speeds(robot):
    e = executive(robot)
    start = e.kin.leg_wheel(2, e.setpoint[2]).translation
    e.accept(sequence(LegMove(leg=2, wheel_in_hex=start + [0.0, 0.0, 0.2], guard="break_contact"), robot=robot))
    before, places = e.setpoint, []
    while e.busy:
        e.tick(Sensed(joints=e.setpoint, torques=np.zeros_like(e.setpoint), attitude_rpy=np.zeros(3)))
        assert np.abs(e.setpoint - before).max() <= e.kin.spec.speed_unloaded * CONTROL_PERIOD + 1e-9
        before = e.setpoint
        places.append(e.kin.leg_wheel(2, e.setpoint[2]).translation)
        if e.state == "fault":
            break
    places = np.array(places)
    assert np.abs(places[:, :2] - start[:2]).max() < 1e-6
    assert (np.diff(places[:, 2]) > -1e-9).all()


def test_a_descent_stops_at_the_load_asked_for():
    e = executive()
    wheel = e.kin.leg_wheel(0, e.setpoint[0]).translation
    e.accept(sequence(LegMove(leg=0, wheel_in_hex=wheel - [0.0, 0.0, 0.1], guard="contact", contact_load=500.0)))
    events = []
    for _ in range(2000):
        z = e.kin.leg_wheel(0, e.setpoint[0]).translation[2]
        pressed = max(0.0, wheel[2] - 0.04 - z) * 20e3  # ground 4 cm below, 20 kN/m
        gravity = np.array([0.0, 0.0, -9.81])
        force = np.zeros((6, 3))
        force[0, 2] = pressed
        contacts = e.kin.wheels_in_hex(e.setpoint) - [0.0, 0.0, e.kin.spec.wheel.radius]
        torques = e.kin.gravity_torques(e.setpoint, gravity, force, contacts)
        events += e.tick(Sensed(joints=e.setpoint, torques=torques, attitude_rpy=np.zeros(3)))
        if not e.busy:
            break
    assert faults(events) == []
    assert 500.0 <= pressed <= 560.0
    assert e.phases[0] == "stance"


def test_a_descent_into_nothing_is_a_fault():
    e = executive()
    wheel = e.kin.leg_wheel(0, e.setpoint[0]).translation
    e.accept(sequence(LegMove(leg=0, wheel_in_hex=wheel - [0.0, 0.0, 0.1], guard="contact", contact_load=500.0)))
    assert faults(run(e)) == ["no_contact"]
    assert e.state == "fault"


def test_a_lift_that_still_carries_is_a_fault():
    e = executive()
    wheel = e.kin.leg_wheel(0, e.setpoint[0]).translation
    e.accept(sequence(LegMove(leg=0, wheel_in_hex=wheel + [0.0, 0.0, 0.1], guard="break_contact")))
    assert faults(run(e, load=800.0)) == ["contact_not_broken"]


@pytest.mark.parametrize("robot", ROBOTS)
def test_what_is_out_of_reach_is_refused_before_anything_moves(robot):
    e = executive(robot)
    before = e.setpoint.copy()
    e.accept(sequence(LegMove(leg=1, wheel_in_hex=np.array([9.0, 0.0, -1.0])), robot=robot))
    assert faults(run(e)) == ["unreachable"]
    assert np.array_equal(e.setpoint, before)
    e.accept(sequence(BodyMove(translation_in_hex=np.array([4.0, 0.0, 0.0])), number=2, robot=robot))
    assert faults(run(e)) == ["unreachable"]
    assert np.array_equal(e.setpoint, before)


def test_a_way_point_beyond_a_joint_limit_names_the_joint():
    e = executive()
    q = e.setpoint[0].copy()
    q[1] = 2.0
    e.accept(sequence(JointMove(leg=0, waypoints=q[None])))
    (fault,) = [event for event in run(e) if event.kind == "fault"]
    assert fault.status == "unreachable"
    assert "hip_pitch of leg 1 at 114.6 deg is beyond -90 to 90 deg" in fault.text


def test_way_points_of_another_robot_are_a_bad_command():
    e = executive()
    e.accept(sequence(JointMove(leg=0, waypoints=np.zeros((1, 7)))))
    assert faults(run(e)) == ["bad_command"]


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_a_joint_move_goes_from_rest_to_rest_within_its_limits_in_the_time_foretold(robot, scale):
    e = executive(robot)
    spec, start = e.kin.spec, e.setpoint[2].copy()
    ways = start + np.cumsum(0.1 * np.random.default_rng(7).standard_normal((4, spec.dof)), axis=0)
    ways = np.clip(ways, spec.lower, spec.upper)
    e.accept(sequence(JointMove(leg=2, waypoints=ways, speed_scale=scale), robot=robot))
    commanded = [e.setpoint[2].copy()] * 2
    while e.command_index == 0 and not faults(e.tick(Sensed(joints=e.setpoint, torques=0 * e.setpoint, attitude_rpy=np.zeros(3)))):
        commanded.append(e.setpoint[2].copy())
    rates = np.diff(commanded, axis=0) / CONTROL_PERIOD
    assert np.abs(rates).max() <= scale * spec.speed_unloaded * (1.0 + 1e-9)
    assert np.abs(np.diff(rates, axis=0)).max() / CONTROL_PERIOD <= scale**2 * spec.acceleration_unloaded * (1.0 + 1e-9)
    assert (rates[-1] == 0.0).all()
    np.testing.assert_array_equal(e.setpoint[2], ways[-1])
    foretold = leg_timing(spec, np.concatenate([start[None], ways]), corner_tolerance=CORNER_TOLERANCE, speed_scale=scale).duration
    moving = np.count_nonzero(rates.any(axis=1)) * CONTROL_PERIOD
    assert foretold - 1e-9 <= moving <= foretold + CONTROL_PERIOD


def test_torque_beyond_the_allowed_fraction_stops_the_sequence():
    e = executive()
    e.accept(sequence(Wait(duration=1.0), max_torque_fraction=0.5))
    e.tick(Sensed(joints=e.setpoint, torques=np.zeros_like(e.setpoint), attitude_rpy=np.zeros(3)))
    assert faults(run(e, torque=0.9)) == ["torque_limit"]


def read(e: Executive, leg: int, joint: int, share: float) -> Sensed:
    torques = np.zeros_like(e.setpoint)
    torques[leg, joint] = share * e.kin.spec.torque_limits[joint]
    return Sensed(joints=e.setpoint, torques=torques, attitude_rpy=np.zeros(3))


def test_a_torque_that_no_gear_of_sdm_b_can_hold_is_told_once_and_stops_the_sequence():
    e = executive()
    e.accept(sequence(Wait(duration=5.0), max_torque_fraction=10.0))
    assert faults(e.tick(read(e, 2, 4, 1.25))) == []
    (fault, receipt) = e.tick(read(e, 2, 4, -1.4))
    assert (fault.status, fault.sequence_id, fault.leg) == ("ratchet_slip", 1, 2)
    assert "ankle_pitch of leg 3 reads -140 % of its limit" in fault.text and "wrong from now on" in fault.text
    assert (receipt.status, e.state, e.busy) == ("failed", "fault", False)
    e.accept(sequence(Wait(duration=0.1), number=2, max_torque_fraction=10.0))
    assert faults([x for _ in range(60) for x in e.tick(read(e, 2, 4, -1.4))]) == []
    assert e.state == "idle"
    assert e.setpoint == pytest.approx(regular_stance(e.kin.spec))  # nothing is set right behind the ground's back


def test_an_idle_robot_tells_of_a_slipped_gear_as_well_and_of_each_joint():
    e = executive()
    e.accept(sequence(Wait(duration=0.1)))
    run(e)
    torques = read(e, 0, 1, 1.5).torques + read(e, 5, 2, -2.0).torques
    events = e.tick(Sensed(joints=e.setpoint, torques=torques, attitude_rpy=np.zeros(3)))
    assert [(x.kind, x.status, x.sequence_id, x.leg) for x in events] == [
        ("fault", "ratchet_slip", -1, 0), ("fault", "ratchet_slip", -1, 5),
    ]  # fmt: skip


def test_t12s_gears_do_not_ratchet():
    e = executive("t12")
    assert e.tick(read(e, 0, 1, 1.5)) == []


def test_a_robot_beyond_its_torque_limit_may_still_be_led_out():
    e = executive()
    e.accept(sequence(Wait(duration=0.5), max_torque_fraction=0.5))
    assert faults(run(e, torque=0.9)) == []


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("share, fault", [(0.01, []), (0.06, ["swing_contact"])])
def test_a_wheel_that_strikes_something_in_the_air_stops_the_sequence(robot, share, fault):
    e = executive(robot)
    spec, weight = e.kin.spec, e.kin.spec.mass * 9.81
    start = e.setpoint[0]
    e.accept(sequence(JointMove(leg=0, waypoints=(start + np.eye(spec.dof)[0] * 0.5)[None]), robot=robot))
    events, gravity, felt = [], np.array([0.0, 0.0, -9.81]), np.zeros((6, 3))
    for _ in range(2000):
        felt[0, 0] = -share * weight if abs(e.setpoint[0, 0] - start[0]) > 0.25 else 0.0  # half-way, from the front
        contacts = e.kin.wheels_in_hex(e.setpoint) - [0.0, 0.0, spec.wheel.radius]
        torques = e.kin.gravity_torques(e.setpoint, gravity, felt, contacts)
        events += e.tick(Sensed(joints=e.setpoint, torques=torques, attitude_rpy=np.zeros(3)))
        if not e.busy:
            break
    assert faults(events) == fault
    assert (abs(e.setpoint[0, 0] - start[0]) < 0.5 - 1e-9) == bool(fault)


def test_a_leg_is_led_out_of_a_contact_without_a_fault():
    e = executive()
    e.accept(sequence(JointMove(leg=0, waypoints=(e.setpoint[0] + np.eye(6)[0] * 0.2)[None])))
    assert faults(run(e, load=2000.0)) == []


def test_tilt_beyond_the_limit_stops_the_sequence():
    e = executive()
    e.accept(sequence(Wait(duration=1.0), max_tilt=0.2))
    assert faults(run(e, tilt=0.3)) == ["tilt"]


def test_a_fault_empties_the_queue_and_the_next_sequence_starts_afresh():
    e = executive()
    e.accept(sequence(LegMove(leg=1, wheel_in_hex=np.array([9.0, 0.0, -1.0])), number=1))
    e.accept(sequence(Wait(duration=0.1), number=2))
    events = run(e)
    assert any(x.status == "cancelled" and x.sequence_id == 2 for x in events)
    e.accept(sequence(Wait(duration=0.1), number=3))
    events = run(e)
    assert any(x.status == "completed" and x.sequence_id == 3 and x.command_index == -1 for x in events)
    assert e.state == "idle"


def test_stop_ends_motion_at_once_and_says_what_was_cancelled():
    e = executive()
    e.accept(sequence(BodyMove(translation_in_hex=np.array([0.3, 0.0, 0.0])), number=1))
    e.accept(sequence(Wait(duration=0.1), number=2))
    for _ in range(10):
        e.tick(Sensed(joints=e.setpoint, torques=np.zeros_like(e.setpoint), attitude_rpy=np.zeros(3)))
    at = e.setpoint.copy()
    events = e.accept(Stop(seq=0, robot_id="sdm_b", t=0.0, reason="test"))
    assert [x.status for x in events] == ["cancelled", "cancelled"]
    e.tick(Sensed(joints=e.setpoint, torques=np.zeros_like(e.setpoint), attitude_rpy=np.zeros(3)))
    assert np.array_equal(e.setpoint, at)
    assert e.state == "stopped"


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_body_move_keeps_every_wheel_in_place(robot):
    e = executive(robot)
    wheels = e.kin.wheels_in_hex(e.setpoint)
    shift, turn = np.array([0.10, -0.05, -0.04]), np.array([0.02, -0.03, 0.05])
    e.accept(sequence(BodyMove(translation_in_hex=shift, rotvec_in_hex=turn), robot=robot))
    assert faults(run(e)) == []
    from athlete_twin.geometry.se3 import SE3

    moved = SE3.from_rotvec(turn, shift).apply(e.kin.wheels_in_hex(e.setpoint))
    assert moved == pytest.approx(wheels, abs=1e-6)


def test_wheel_offsets_move_only_their_wheel():
    e = executive()
    wheels = e.kin.wheels_in_hex(e.setpoint)
    offsets = np.zeros((6, 3))
    offsets[3] = [0.01, -0.02, 0.015]
    e.accept(sequence(BodyMove(translation_in_hex=np.zeros(3), wheel_offsets_in_hex=offsets)))
    assert faults(run(e)) == []
    assert e.kin.wheels_in_hex(e.setpoint) == pytest.approx(wheels + offsets, abs=1e-6)


def test_pictures_are_asked_for_after_standing_still():
    e = executive()
    e.accept(sequence(ImageRequest(cameras=("hazcam_1",))))
    events = run(e)
    assert [x.request.cameras for x in events if x.kind == "capture"] == [("hazcam_1",)]


def test_a_camera_that_the_robot_lacks_is_a_bad_command_and_nothing_is_completed():
    e = executive()
    e.accept(sequence(Wait(duration=0.1), ImageRequest(cameras=("hazcam_1", "eye"))))
    events = run(e)
    (fault,) = [x for x in events if x.kind == "fault"]
    assert (fault.status, fault.command_index) == ("bad_command", 1)
    assert "camera 'eye' is not on sdm_b; it has navcam_1, " in fault.text
    assert not [x for x in events if x.kind == "capture"]
    outcomes = [(x.command_index, x.status) for x in events if x.kind == "receipt"]
    assert outcomes == [(0, "completed"), (1, "failed")]
    assert e.state == "fault"


def test_a_full_queue_refuses_with_a_receipt():
    e = executive()
    statuses = [e.accept(sequence(Wait(duration=1.0), number=n))[0].status for n in range(10)]
    assert statuses.count("refused") == 2


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("heading_deg", [0.0, 35.0, 90.0, -160.0])
def test_a_drive_steers_all_wheels_across_the_way_rolls_its_length_and_steers_back(robot, heading_deg):
    e = executive(robot)
    before = e.setpoint.copy()
    way = np.array([np.cos(np.deg2rad(heading_deg)), np.sin(np.deg2rad(heading_deg))])
    e.accept(sequence(Drive(translation_in_hex=1.5 * way, speed=e.kin.spec.drive_speed), robot=robot))
    covered, fastest = np.zeros((6, 3)), 0.0
    while e.busy:
        events = e.tick(Sensed(joints=e.setpoint, torques=np.zeros_like(before), attitude_rpy=np.zeros(3)))
        assert not faults(events)
        if e.rolling:
            velocities = rolling_velocities(e.kin, e.setpoint, e.wheel_rates)
            covered += velocities * CONTROL_PERIOD
            fastest = max(fastest, float(np.linalg.norm(velocities, axis=1).max()))
            for leg in range(6):
                axle = e.kin.leg_wheel(leg, e.setpoint[leg]).rotation[:, 1]
                assert abs(axle[:2] @ way) < 1e-3
    np.testing.assert_allclose(covered[:, :2], np.tile(1.5 * way, (6, 1)), atol=0.03)
    np.testing.assert_allclose(e.setpoint, before, atol=1e-9)
    assert fastest <= e.kin.spec.drive_speed * (1 + 1e-6)
    assert not e.wheel_rates.any()


def test_a_drive_faster_than_the_robot_is_a_bad_command_and_a_stop_locks_the_wheels():
    e = executive()
    e.accept(sequence(Drive(translation_in_hex=np.array([1.0, 0.0]), speed=2.0)))
    (fault,) = [event for event in run(e) if event.kind == "fault"]
    assert fault.status == "bad_command" and "2.00 m/s is above sdm_b's 0.83 m/s" in fault.text
    e.accept(sequence(Drive(translation_in_hex=np.array([5.0, 0.0]), speed=0.5), number=2))
    while not e.rolling:
        e.tick(Sensed(joints=e.setpoint, torques=np.zeros_like(e.setpoint), attitude_rpy=np.zeros(3)))
    e.accept(Stop(seq=0, robot_id="sdm_b", t=0.0))
    assert not e.rolling


def test_a_sequence_for_another_robot_is_refused():
    e = executive("t12")
    (receipt,) = e.accept(sequence(Wait(duration=1.0)))
    assert (receipt.status, receipt.cause) == ("refused", "misaddressed") and "is for 'sdm_b', this is t12" in receipt.text
    assert not e.busy


@pytest.mark.parametrize("limits", [{"max_torque_fraction": np.nan}, {"max_tilt": np.inf}, {"max_swing_force": 0.0}])
def test_guards_cannot_be_switched_off_by_what_is_no_number(limits):
    with pytest.raises(CommandError, match=next(iter(limits))):
        sequence(Wait(duration=1.0), **limits)
