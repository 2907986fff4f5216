"""A descent with the guard `place` goes to its end, whatever the wheel feels, and the wheel stands from then on."""

import numpy as np
import pytest

from athlete_twin.executive import Executive
from athlete_twin.messages import CommandSequence, LegMove, Wait
from athlete_twin.mock import MockAthlete
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.moves import Sensed


@pytest.fixture(params=["sdm_b", "t12"])
def robot(request):
    return request.param


def told(robot, *commands):
    return CommandSequence(seq=1, robot_id=robot, t=0.0, sequence_id=1, commands=commands)


def carried_out(robot, load, *commands):
    """Events of the executive, wheel 1 feeling a vertical `load` [N], and the executive."""
    kin, spec, events = kinematics(robot), load_spec(robot), []
    executive = Executive(kin=kin, setpoint=regular_stance(spec))
    executive.accept(told(robot, *commands))
    for _ in range(4000):
        joints = executive.setpoint
        contacts = kin.wheels_in_hex(joints) - [0.0, 0.0, spec.wheel.radius]
        force = np.zeros((6, 3))
        force[0, 2] = load
        torques = kin.gravity_torques(joints, np.array([0.0, 0.0, -GRAVITY]), force, contacts)
        events += executive.tick(Sensed(joints=joints, torques=torques, attitude_rpy=np.zeros(3)))
        if not executive.busy:
            return events, executive
    raise AssertionError("the executive never became idle")


@pytest.mark.parametrize("load", [0.0, 700.0])
def test_it_ends_where_it_was_told_to_whatever_the_wheel_feels(robot, load):
    start = kinematics(robot).leg_wheel(0, regular_stance(load_spec(robot))[0]).translation
    down = start - [0.0, 0.0, 0.08]
    events, executive = carried_out(robot, load, LegMove(leg=0, wheel_in_hex=down, guard="place"))
    assert [e.status for e in events if e.kind == "fault"] == []
    np.testing.assert_allclose(executive.kin.leg_wheel(0, executive.setpoint[0]).translation, down, atol=1e-6)
    assert executive.phases[0] == "stance"


def test_an_unguarded_move_leaves_the_leg_in_the_air(robot):
    axle = kinematics(robot).leg_wheel(0, regular_stance(load_spec(robot))[0]).translation
    _, executive = carried_out(robot, 0.0, LegMove(leg=0, wheel_in_hex=axle + [0.0, 0.0, 0.02]))
    assert executive.phases[0] == "swing"


@pytest.mark.slow
@pytest.mark.ci
def test_where_an_unguarded_move_strikes_the_ground_a_placed_wheel_takes_its_load_back(robot):
    mock = MockAthlete(load_spec(robot))
    wheel = mock.kin.leg_wheel(0, mock.executive.setpoint[0]).translation
    lift = LegMove(leg=0, wheel_in_hex=wheel + [0.0, 0.0, 0.3], guard="break_contact")
    codes = {}
    for guard in ("none", "place"):
        mock = MockAthlete(load_spec(robot))
        mock.advance(0.1)
        mock.receive(told(robot, lift, LegMove(leg=0, wheel_in_hex=wheel, guard=guard), Wait(duration=1.0)))
        heard = []
        while mock.busy:
            heard += mock.advance(mock.t + 5.0)
        codes[guard] = [m.code for m in heard if type(m).__name__ == "Fault"]
        if guard == "place":  # its load is back, and it holds its place
            assert mock.truth().wheel_loads[0] == pytest.approx(MockAthlete(load_spec(robot)).truth().wheel_loads[0], rel=1e-3)
            assert mock.truth().phases[0] == "stance"
    assert codes == {"none": ["swing_contact"], "place": []}
