"""Each fault that a scenario can inject does what it says, at its time, and is recorded."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.athlete import Athlete
from athlete_twin.errors import ConfigError
from athlete_twin.messages import (
    CommandSequence,
    Fault,
    ImageRequest,
    JointMove,
    LegMove,
    Receipt,
    StereoPair,
    Telemetry,
    Wait,
)
from athlete_twin.model.spec import load_spec
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.world.injected import InjectedFault
from athlete_twin.world.scenario import load_scenario

SPEC = load_spec("sdm_b")


@pytest.fixture
def twin():
    made = []

    def make(*faults: InjectedFault) -> Athlete:
        scenario = replace(load_scenario("calibration_yard"), faults=faults)
        made.append(Athlete(SPEC, scenario, 0, trial=nominal_truth(SPEC)))
        return made[-1]

    yield make
    for athlete in made:
        athlete.close()


def send(athlete: Athlete, *commands, number: int = 1):
    sequence = CommandSequence(seq=number, robot_id="sdm_b", t=athlete.t, sequence_id=number, commands=commands)
    return athlete.receive(sequence)


def until(athlete: Athlete, t: float) -> list:
    out = []
    while athlete.t < t - 1e-6:
        out += athlete.advance(t)
    return out


@pytest.mark.slow
@pytest.mark.ci
def test_a_stuck_motor_stays_where_it_is(twin):
    athlete = twin(InjectedFault(kind="stuck_joint", t=0.5, leg=2, joint="ankle_roll"))
    q = athlete.executive.setpoint[2].copy()
    q[-1] += 0.3
    until(athlete, 1.0)
    before = athlete.truth().motors[2].copy()
    send(athlete, JointMove(leg=2, waypoints=q[None]))
    until(athlete, 12.0)
    assert athlete.truth().motors[2, -1] == before[-1]
    assert [f.kind for f in athlete.injected] == ["stuck_joint"]


@pytest.mark.slow
@pytest.mark.ci
def test_a_biased_encoder_reads_wrong_angle_and_torque_and_moves_nothing(twin):
    athlete = twin(InjectedFault(kind="encoder_bias", t=5.0, leg=1, joint="knee_pitch", value=0.3))
    send(athlete, Wait(duration=10.0))
    told = [m for m in until(athlete, 10.0) if isinstance(m, Telemetry)]
    before, after = (next(m for m in told if a < m.t < b) for a, b in ((3.0, 5.0), (6.0, 8.0)))
    k = SPEC.joint_names.index("knee_pitch")
    assert after.joints[1, k] - before.joints[1, k] == pytest.approx(np.deg2rad(0.3), abs=3e-4)
    stiffness = athlete.trial.truth.joint_stiffness[k]
    assert before.torques[1, k] - after.torques[1, k] == pytest.approx(stiffness * np.deg2rad(0.3), rel=0.1)
    assert np.abs(athlete.truth().joints[1, k] - before.joints[1, k]) < 3e-4


@pytest.mark.slow
@pytest.mark.ci
def test_a_torque_sensor_drifts_by_the_minute(twin):
    athlete = twin(InjectedFault(kind="torque_drift", t=60.0, leg=0, joint="hip_pitch", value=50.0))
    until(athlete, 59.0)
    send(athlete, Wait(duration=1.0))
    before = next(m for m in until(athlete, 62.0) if isinstance(m, Telemetry))
    until(athlete, 180.0)
    send(athlete, Wait(duration=1.0), number=2)
    after = [m for m in until(athlete, 183.0) if isinstance(m, Telemetry)][-1]
    k = SPEC.joint_names.index("hip_pitch")
    assert after.torques[0, k] - before.torques[0, k] == pytest.approx(50.0 * (after.t - 60.0) / 60.0, abs=25.0)


@pytest.mark.slow
@pytest.mark.ci
def test_a_tyre_that_loses_pressure_lowers_its_corner_even_while_the_robot_waits(twin):
    athlete = twin(InjectedFault(kind="soft_tyre", t=30.0, leg=3, value=0.4))
    until(athlete, 29.0)
    before = athlete.truth()
    until(athlete, 60.0)
    after = athlete.truth()
    drop = before.wheels_in_world[:, 2] - after.wheels_in_world[:, 2]
    assert drop[3] > 0.02
    assert drop[3] > 1.5 * np.abs(np.delete(drop, 3)).max()  # the chassis is rigid: it tilts over that corner
    assert after.wheel_loads.sum() == pytest.approx(before.wheel_loads.sum(), rel=1e-3)


@pytest.mark.slow
@pytest.mark.ci
def test_a_dead_camera_sends_black_pictures_and_the_others_do_not(twin):
    athlete = twin(InjectedFault(kind="dead_camera", t=0.0, camera="navcam_2"))
    send(athlete, ImageRequest(cameras=("navcam_1", "navcam_2"), binning=4))
    pairs = {m.camera: m for m in until(athlete, 4.0) if isinstance(m, StereoPair)}
    assert not pairs["navcam_2"].left.any() and not pairs["navcam_2"].right.any()
    assert pairs["navcam_1"].left.mean() > 30.0


@pytest.mark.slow
@pytest.mark.ci
def test_a_brown_out_loses_the_sequence_and_the_queue_and_answers_afterwards(twin):
    athlete = twin(InjectedFault(kind="brown_out", t=3.0, value=20.0))
    wheel = athlete.kin.leg_wheel(0, athlete.executive.setpoint[0]).translation
    send(athlete, LegMove(leg=0, wheel_in_hex=wheel + [0.0, 0.0, 0.3]))
    send(athlete, Wait(duration=1.0), number=2)
    assert not [m for m in until(athlete, 10.0) if isinstance(m, Fault) or (isinstance(m, Telemetry) and m.t > 3.1)]
    held = athlete.truth().motors.copy()
    assert send(athlete, Wait(duration=1.0), number=3) == []
    told = until(athlete, 30.0)
    (fault,) = [m for m in told if isinstance(m, Fault)]
    assert (fault.code, fault.sequence_id) == ("brown_out", 1)
    assert fault.t == pytest.approx(23.0, abs=0.1)
    assert next(m.executive_state for m in told if isinstance(m, Telemetry)) == "fault"
    assert np.array_equal(athlete.truth().motors, held)
    send(athlete, Wait(duration=1.0), number=4)
    assert any(isinstance(m, Receipt) and m.sequence_id == 4 and m.status == "completed" for m in until(athlete, 40.0))


def test_a_joint_that_the_robot_lacks_is_refused_by_name(twin):
    fine = InjectedFault(kind="brown_out", t=9.0, value=1.0)
    says = r"scenario 'calibration_yard': fault\[1\]\.joint = 'thigh_pitch' is not on sdm_b; it has hip_yaw, "
    with pytest.raises(ConfigError, match=says):
        twin(fine, InjectedFault(kind="stuck_joint", t=0.5, leg=2, joint="thigh_pitch"))
    says = r"scenario 'calibration_yard': fault\[0\]\.camera = 'toolcam_9' is not on sdm_b; it has .*navcam_1, "
    with pytest.raises(ConfigError, match=says):
        twin(InjectedFault(kind="dead_camera", t=0.5, camera="toolcam_9"), fine)


@pytest.mark.slow
@pytest.mark.ci
def test_a_refused_fault_leaves_no_physics_client_behind(twin):
    first = twin().world.client
    with pytest.raises(ConfigError):
        twin(InjectedFault(kind="stuck_joint", t=0.5, leg=2, joint="thigh_pitch"))
    assert twin().world.client == first + 1  # Bullet numbers its clients by the first that is free
