"""The seam between link and robot in the twin: a command is heard at the physics tick of its arrival, a stop halts within 50 ms."""

import numpy as np
import pytest

from athlete_twin.athlete import Athlete
from athlete_twin.link import DelayedLink, LinkConfig
from athlete_twin.messages import BodyMove, CommandSequence, Drive, JointMove, Stop, Wait, encode
from athlete_twin.model.spec import load_spec
from athlete_twin.world.bullet_world import TICK
from athlete_twin.world.scenario import load_scenario
from envs.mission import Mission

HALT = 0.05
"""a stop halts all motors within that after it arrived [s]"""


@pytest.fixture(params=["sdm_b", "t12"])
def athlete(request):
    robot = Athlete(load_spec(request.param), load_scenario("calibration_yard"), 0)
    yield robot
    robot.close()


class Heard:
    """Notes when bytes came up."""

    def __init__(self, robot):
        self.robot, self.at, self._receive = robot, [], robot.receive_raw
        robot.receive_raw = self

    def __call__(self, raw):
        self.at.append(self.robot.t)
        return self._receive(raw)


def a_mission(robot, delay):
    up, down = LinkConfig(delay=delay, bandwidth=64e3), LinkConfig(delay=delay, bandwidth=2e6)
    return Mission(robot, up=DelayedLink(up, np.random.default_rng(1)), down=DelayedLink(down, np.random.default_rng(2)))


@pytest.mark.slow
@pytest.mark.ci
def test_commands_are_heard_within_a_physics_tick_of_their_arrival_while_the_robot_moves(athlete):
    heard, mission, rng, due = Heard(athlete), a_mission(athlete, 0.731), np.random.default_rng(3), []
    moves = (BodyMove(translation_in_hex=np.array([0.2, 0.0, 0.0])), BodyMove(translation_in_hex=np.array([-0.2, 0.0, 0.0])))
    mission.send(CommandSequence(seq=0, robot_id=athlete.robot_id, t=0.0, sequence_id=0, commands=moves))
    due.append(mission.up.next_arrival())
    mission.advance(1.5)
    for k in range(1, 8):
        mission.advance(mission.t + float(rng.uniform(0.2, 0.4)))
        message = CommandSequence(seq=k, robot_id=athlete.robot_id, t=mission.t, sequence_id=k, commands=(Wait(duration=0.1),))
        raw = encode(message)
        due.append(max(mission.t, mission.up._free_at) + 8 * len(raw) / 64e3 + 0.731)
        mission.send(message)
    mission.advance(mission.t + 3.0)
    late = np.array(heard.at) - np.array(due)
    assert athlete.busy and len(late) == 8
    assert (late > -1e-9).all() and (late < TICK + 1e-9).all()


@pytest.mark.slow
def test_a_stop_halts_the_motors_within_50_ms_whatever_moves(athlete):
    spec, rng = athlete.spec, np.random.default_rng(4)
    stance = athlete.truth().motors
    there = stance[0] + 0.05 * np.eye(spec.dof)[0]
    kinds = {
        "body": (BodyMove(translation_in_hex=np.array([0.1, 0.05, 0.0])), BodyMove(translation_in_hex=np.array([-0.1, -0.05, 0.0]))),
        "drive": (Drive(translation_in_hex=np.array([0.6, 0.0]), speed=0.3 * spec.drive_speed),),
        "joint": (JointMove(leg=0, waypoints=np.array([there, stance[0]])),),
    }
    seq = 0
    for name, commands in kinds.items():
        for _ in range(2):
            athlete.receive_raw(
                encode(CommandSequence(seq=seq, robot_id=spec.name, t=athlete.t, sequence_id=seq, commands=commands))
            )
            seq += 1
            until = athlete.t + float(rng.uniform(0.5, 2.5))
            while athlete.t < until:
                athlete.advance(until)
            moving = athlete.busy
            arrival = athlete.t
            athlete.receive_raw(encode(Stop(seq=seq, robot_id=spec.name, t=athlete.t)))
            assert moving and athlete.executive.state == "stopped", name
            while athlete.t < arrival + HALT - 1e-9:
                athlete.advance(arrival + HALT)
            halted = athlete.truth().motors
            assert not athlete.executive.rolling
            athlete.advance(athlete.t + 0.5)
            np.testing.assert_allclose(athlete.truth().motors, halted, atol=1e-9, err_msg=name)
            athlete.advance(athlete.t + 2.0)
