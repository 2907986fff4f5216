"""What pose optimisation before a lift gains on the true robot: each leg lifted from the normal stance, with and without it.

Without, the wheel goes up by what the springs foresee on top of the clearance; with it the chassis is first commanded to
the pose that it will sag out of, level and at the commanded height. The springs are the drawings'.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from bench_table import Row, refusal, row
from sag_yard import REST, SagYard, StanceRefusedError

from athlete_twin.errors import AthleteError
from athlete_twin.messages import Command, LegMove, Wait
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.spec import LEGS
from planner.sag.compensate import SagConfig, predict_sag
from planner.sag.lift_pose import NoPose, PoseConfig
from planner.sag.pose import optimise_pose
from planner.sag.sag_model import FootSprings

CLEARANCE = {"sdm_b": 0.25, "t12": 0.40}
"""asked for over the ground: enough to break contact where the truth sags otherwise than believed [m]"""


@dataclass(frozen=True, kw_only=True)
class Lifted:
    """The true robot with a leg in the air."""

    tilt: float
    """of the plane through the six hips [rad]"""
    sink: float
    """of the mean hip under the commanded height [m]"""
    clearance: float
    """of the lifted wheel over the ground, less what was asked for [m]"""
    peak_load: float
    """of a wheel [N]"""


class NoPoseError(AthleteError):
    """There is no pose before a lift; the text is the reason."""


def rows(*, robots: tuple[str, ...], seed: int = 0) -> list[Row]:
    """Means over the legs of one individual a robot: optimised, and without as the peer. About two minutes a robot.

    A leg that does not lift in one of the two ways is a row that says why, and counts in neither mean.
    """
    out: list[Row] = []
    for robot in robots:
        pairs: list[tuple[Lifted, Lifted]] = []
        for leg in range(LEGS):
            try:
                pairs.append((_lifted(robot, seed, leg, optimise=True), _lifted(robot, seed, leg, optimise=False)))
            except (NoPoseError, StanceRefusedError) as e:
                out.append(refusal(f"{robot}, leg {leg + 1} lifted with and without a pose optimised", str(e)))
        if not pairs:
            continue
        legs = "a leg up" if len(pairs) == LEGS else f"one of {len(pairs)} legs up"
        for field, words, unit in (
            ("tilt", "tilt of the chassis", "rad"), ("sink", "sink of the chassis, absolute", "m"),
            ("clearance", "clearance, off what was asked for", "m"), ("peak_load", "largest load of a wheel", "N"),
        ):  # fmt: skip
            ours, peer = (float(np.mean([abs(getattr(pair[way], field)) for pair in pairs])) for way in (0, 1))
            out.append(row(f"{robot}, {legs}, pose optimised: {words}", ours, unit, peer_name="without", peer=peer))
    return out


def _lifted(robot: str, seed: int, leg: int, *, optimise: bool) -> Lifted:
    yard = SagYard(robot, seed)
    try:
        springs, asked = FootSprings.from_spec(yard.spec), CLEARANCE[robot]
        if optimise:
            pose = optimise_pose(yard.kin, yard.motors, leg, springs=springs, clearance=asked, config=PoseConfig())
            if isinstance(pose, NoPose):
                raise NoPoseError(f"no pose from the normal stance: {pose.reason}")
            commands: list[Command] = [pose.move, LegMove(leg=leg, wheel_in_hex=pose.lift_in_hex, guard="break_contact")]
        else:
            com = yard.kin.com_in_hex(yard.motors)
            foreseen = predict_sag(
                yard.axles, leg, com_planted=com, com_airborne=com, weight=yard.spec.mass * GRAVITY, clearance=asked,
                springs=springs, config=SagConfig(),
            )  # fmt: skip
            if foreseen.status != "converged":
                raise NoPoseError(f"the springs foresee no lift from the normal stance: {foreseen.status}")
            up = yard.axles[leg] + [0.0, 0.0, foreseen.commanded_lift]
            commands = [LegMove(leg=leg, wheel_in_hex=up, guard="break_contact")]
        yard.run([*commands, Wait(duration=REST)])
        return _look(yard, leg, asked)
    finally:
        yard.close()


def _look(yard: SagYard, leg: int, asked: float) -> Lifted:
    links, truth, spec = yard.robot.link_poses(), yard.robot.truth(), yard.spec
    hips = np.array([links[f"leg{k + 1}_hip_yaw"].translation for k in range(LEGS)])
    slope = np.linalg.lstsq(np.column_stack([hips[:, :2], np.ones(LEGS)]), hips[:, 2], rcond=None)[0][:2]
    commanded = spec.chassis_height + float(np.mean(spec.hips_in_hex[:, 2]))
    ground = float(yard.robot.terrain.grid.sample(truth.wheels_in_world[leg : leg + 1, :2])[0])
    return Lifted(
        tilt=float(np.arctan(np.linalg.norm(slope))),
        sink=commanded - float(hips[:, 2].mean()),
        clearance=float(truth.wheels_in_world[leg, 2]) - spec.wheel.radius - ground - asked,
        peak_load=float(truth.wheel_loads.max()),
    )
