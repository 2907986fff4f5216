"""The optimised pose on the twin, whose tyres, masses and encoders differ from the drawings and whose legs wind up."""

from dataclasses import dataclass

import numpy as np
import pytest

from athlete_twin.link import DelayedLink, downlink, uplink
from athlete_twin.messages import Command, CommandSequence, LegMove, Telemetry, Wait
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.world.scenario import load_scenario
from envs.build import twin
from envs.mission import Mission
from planner.sag.compensate import SagConfig, predict_sag
from planner.sag.lift_pose import LiftPose, PoseConfig
from planner.sag.pose import optimise_pose
from planner.sag.sag_model import FootSprings

DELAY, REST = 1.0, 12.0
CLEARANCE = {"sdm_b": 0.25, "t12": 0.40}
"""asked for over the ground: enough to break contact although the truth sags otherwise than believed [m]"""
CENTIMETRE = 0.01


@dataclass(frozen=True, kw_only=True)
class Lifted:
    """The true robot with a leg in the air."""

    tilt: float
    """of the plane through the six hips [rad]"""
    sink: float
    """of the mean hip under the commanded height [m]"""
    clearance: float
    """of the lifted wheel's axle over where it stood before the lift without load [m]"""
    peak_load: float
    """[N]"""


class Yard:
    """One individual on level ground, commanded over a link."""

    def __init__(self, robot: str, seed: int) -> None:
        self.kin = kinematics(robot)
        self.robot, _ = twin(self.kin.spec, load_scenario("calibration_yard"), seed)
        self.mission = Mission(
            self.robot,
            up=DelayedLink(uplink(DELAY), np.random.default_rng([seed, 1])),
            down=DelayedLink(downlink(DELAY), np.random.default_rng([seed, 2])),
        )
        self.sent = 0
        self.motors = self.run(Wait(duration=REST)).motors

    def springs(self, belief: str) -> FootSprings:
        """As drawn, or from how far the hips hang under their commanded height with six wheels down: W/6k."""
        drawn, spec = FootSprings.from_spec(self.kin.spec), self.kin.spec
        if belief == "drawn":
            return drawn
        stiffness = spec.mass * GRAVITY / (6.0 * self.look(0).sink)
        return FootSprings(stiffness_z=np.full(6, stiffness), lateral_ratio=drawn.lateral_ratio)

    def run(self, *commands: Command) -> Telemetry:
        """Sends commands; the telemetry that ends them."""
        self.sent += 1
        mission = self.mission
        mission.send(
            CommandSequence(
                seq=self.sent, robot_id=self.robot.robot_id, t=mission.t, sequence_id=self.sent, commands=commands
            )
        )
        until = mission.t + 600.0
        while mission.t < until:
            for message in mission.advance(mission.t + 2.0):
                done = isinstance(message, Telemetry) and message.sequence_id == self.sent
                if done and message.executive_state != "executing":
                    assert message.executive_state == "idle", mission.last_fault
                    return message
        raise AssertionError(f"{commands} did not end in {until} s")

    def look(self, leg: int) -> Lifted:
        """What is true."""
        links, truth, spec = self.robot.link_poses(), self.robot.truth(), self.kin.spec
        hips = np.array([links[f"leg{j + 1}_hip_yaw"].translation for j in range(6)])
        slope = np.linalg.lstsq(np.column_stack([hips[:, :2], np.ones(6)]), hips[:, 2], rcond=None)[0][:2]
        commanded = spec.chassis_height + np.mean([h[2] for h in spec.hips_in_hex])
        return Lifted(
            tilt=float(np.arctan(np.linalg.norm(slope))),
            sink=float(commanded - hips[:, 2].mean()),
            clearance=float(truth.wheels_in_world[leg, 2] - spec.wheel.radius),
            peak_load=float(truth.wheel_loads.max()),
        )


def _rigid(yard: Yard, leg: int, springs: FootSprings) -> Lifted:
    """As without pose optimisation: the wheel goes up by what the springs say on top of the clearance."""
    kin, com = yard.kin, yard.kin.com_in_hex(yard.motors)
    foreseen = predict_sag(
        kin.wheels_in_hex(yard.motors), leg, com_planted=com, com_airborne=com, weight=kin.spec.mass * GRAVITY,
        clearance=CLEARANCE[kin.spec.name], springs=springs, config=SagConfig(),
    )  # fmt: skip
    up = kin.wheels_in_hex(yard.motors)[leg] + [0.0, 0.0, foreseen.commanded_lift]
    yard.run(LegMove(leg=leg, wheel_in_hex=up, guard="break_contact"), Wait(duration=REST))
    return yard.look(leg)


def _optimised(yard: Yard, leg: int, springs: FootSprings) -> Lifted:
    kin = yard.kin
    pose = optimise_pose(
        kin, yard.motors, leg, springs=springs, clearance=CLEARANCE[kin.spec.name], config=PoseConfig()
    )
    assert isinstance(pose, LiftPose), pose
    lift = LegMove(leg=leg, wheel_in_hex=pose.lift_in_hex, guard="break_contact")
    yard.run(pose.move, lift, Wait(duration=REST))
    return yard.look(leg)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.parametrize("leg", [0, 1])
@pytest.mark.parametrize("belief", ["drawn", "measured"])
def test_with_the_optimised_pose_the_true_chassis_tilts_and_sinks_less(robot, leg, belief):
    seen = {}
    for name, lift in (("rigid", _rigid), ("optimised", _optimised)):
        yard = Yard(robot, seed=0)
        seen[name] = lift(yard, leg, yard.springs(belief))
        yard.robot.close()
    rigid, optimised = seen["rigid"], seen["optimised"]
    assert optimised.tilt < 0.6 * rigid.tilt
    assert abs(optimised.sink) < (1.0 if belief == "drawn" else 0.5) * abs(rigid.sink)
    assert optimised.peak_load < rigid.peak_load
    if belief == "measured":
        assert abs(optimised.clearance - CLEARANCE[robot]) < 6 * CENTIMETRE
