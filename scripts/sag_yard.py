"""A robot on a yard, told over the link to take stances, and read with a distance meter.

As [SunSpiral2012] s5.1.2-5.1.3 did it: the robot comes to rest in a stance, and somebody reads the heights of the chassis'
corners, where the legs are attached, and of the wheels' axles. What the ground knows of a stance is what telemetry says
of the motors, and these readings with the instrument's error; nobody opens the file of the truth. A robot is an
individual: its seed draws tyres, masses and encoder zeros.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from athlete_twin.athlete import Athlete, TruthState
from athlete_twin.errors import AthleteError
from athlete_twin.geometry.arrays import Joints, PerLeg, PerLegFlag, Vec3, Wheels
from athlete_twin.geometry.polygon import signed_distance
from athlete_twin.geometry.se3 import SE3
from athlete_twin.link import DelayedLink, downlink, uplink
from athlete_twin.messages import BodyMove, Command, CommandSequence, LegMove, Telemetry, Wait
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS, load_spec
from athlete_twin.model.statics import peak_torque_fraction
from athlete_twin.world.scenario import Scenario, load_scenario
from athlete_twin.world.terrain import Terrain
from envs.mission import Mission
from planner.sag.identify import MeasuredStance

INSTRUMENT_SIGMA = 0.003
"""of one reading: a hand-held laser distance meter's 1.5 mm, doubled for the hand that holds it to its spot; EST [m]"""
DELAY = 2.0
"""of the link, each way [s]"""
REST = 12.0
"""for which the robot is left alone before it is read [s]. T12 sways for longer, by less than the instrument's error"""
DEEPEST = 0.05
"""a guarded descent goes no further below its commanded place [m]: a sunken chassis lets the wheel touch above it"""
TOUCH = 0.1
"""share of the weight at which a guarded descent ends"""
LEVEL_ENOUGH = 0.002
"""standing wheels within this of one plane are left as they are [m]"""
LONGEST_MOVE = 0.15
"""of one wheel in one command that levels them [m]"""
LOOK_EVERY, WATCH_EVERY = 5.0, 0.1
"""whether a sequence has ended, or what the truth is, is looked at that often [s]"""
MAX_TILT = 0.35
"""of the chassis, at which the executive stops on level ground: its default [rad]"""
PATIENCE = 3600.0
"""after which a sequence that has not ended is given up [s]"""


Watch = Callable[[TruthState], None]


class StanceRefusedError(AthleteError):
    """The robot did not do what it was told; the text is its own reason."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Reading:
    """One stance, read."""

    stance: MeasuredStance
    """the corners' heights with the instrument's error"""
    lifted: tuple[int, ...]
    """indices of the legs in the air"""
    motors: Joints
    """what was commanded, by telemetry [rad]"""
    axle_heights: PerLeg
    """read above the ground under each wheel, with the instrument's error [m]"""

    @property
    def standing(self) -> PerLegFlag:
        """Which wheels stand, shape (6,)."""
        return ~np.isin(np.arange(LEGS), self.lifted)


class SagYard:
    """One individual of a robot, standing on the yard: level concrete, if no other ground is given."""

    def __init__(
        self,
        robot: str,
        seed: int,
        *,
        scenario: Scenario | None = None,
        terrain: Terrain | None = None,
        start: tuple[Joints, SE3] | None = None,
        max_tilt: float = MAX_TILT,
    ) -> None:
        """Set the robot down.

        Args:
            robot: its name.
            seed: of ground and individual.
            scenario: the ground; the calibration yard by default.
            terrain: instead of the scenario's own.
            start: as of `Athlete`.
            max_tilt: of the chassis, at which the executive stops [rad].
        """
        self.spec, self.seed, self.max_tilt = load_spec(robot), seed, max_tilt
        self.kin = Kinematics(self.spec)
        ground = load_scenario("calibration_yard") if scenario is None else scenario
        self.robot = Athlete(self.spec, ground, seed, terrain=terrain, start=start)
        self.lifted: tuple[int, ...] = ()
        self._place = np.zeros((LEGS, 3))
        links = (DelayedLink(make(DELAY), np.random.default_rng([seed, k])) for k, make in ((1, uplink), (2, downlink)))
        self._mission = Mission(self.robot, up=next(links), down=next(links))
        self._instrument = np.random.default_rng([seed, 3])
        self._sent = 0
        self._telemetry: Telemetry | None = None
        self.run([Wait(duration=1.0)])

    def close(self) -> None:
        """Free the physics client."""
        self.robot.close()

    # --- what the ground knows ------------------------------------------------------------------------------------

    @property
    def motors(self) -> Joints:
        """Commanded angles, by the last telemetry, shape (6, dof) [rad]."""
        assert self._telemetry is not None  # the constructor waited for one
        return self._telemetry.motors

    @property
    def axles(self) -> Wheels:
        """Commanded places of the axles in hex, shape (6, 3) [m]."""
        return self.kin.wheels_in_hex(self.motors)

    @property
    def standing(self) -> PerLegFlag:
        """Which wheels stand, shape (6,)."""
        return ~np.isin(np.arange(LEGS), self.lifted)

    @property
    def up_in_hex(self) -> Vec3:
        """Normal of the plane through the commanded places of the standing wheels."""
        places = self.axles[self.standing]
        normal = np.linalg.svd(places - places.mean(axis=0))[2][2]
        return np.asarray(normal * np.sign(normal[2]))

    def margin_without(self, legs: Sequence[int]) -> float:
        """Support margin that the drawings promise with some legs in the air [m]."""
        standing = ~np.isin(np.arange(LEGS), legs)
        com = self.kin.com_in_hex(self.motors)
        return signed_distance(com[:2].copy(), self.axles[standing][:, :2].copy())

    def torque_without(self, legs: Sequence[int]) -> float:
        """Largest static joint torque over its limit that the drawings promise with some legs in the air."""
        standing = ~np.isin(np.arange(LEGS), legs)
        return peak_torque_fraction(self.kin, self.motors, supporting=standing, gravity_in_hex=-GRAVITY * self.up_in_hex)

    # --- what it can be told --------------------------------------------------------------------------------------

    def run(self, commands: Sequence[Command], *, watch: Watch | None = None, torque: float = 1.0) -> None:
        """Send commands up and wait for the telemetry that ends them.

        Args:
            commands: one sequence.
            watch: sees the truth every `WATCH_EVERY` s.
            torque: over its limit, at which the executive stops.
        """
        self._sent += 1
        mission = self._mission
        mission.send(
            CommandSequence(
                seq=self._sent, robot_id=self.robot.robot_id, t=mission.t, sequence_id=self._sent, commands=tuple(commands),
                max_torque_fraction=torque, max_tilt=self.max_tilt,
            )
        )  # fmt: skip
        given_up = mission.t + PATIENCE
        while mission.t < given_up:
            for message in mission.advance(mission.t + (WATCH_EVERY if watch else LOOK_EVERY)):
                if not isinstance(message, Telemetry):
                    continue
                self._telemetry = message
                if message.sequence_id == self._sent and message.executive_state == "idle":
                    return
                if message.sequence_id == self._sent and message.executive_state != "executing":
                    fault = mission.last_fault
                    raise StanceRefusedError(fault.text if fault else f"the executive is in state {message.executive_state!r}")
            if watch is not None:
                watch(self.robot.truth())
        raise StanceRefusedError(f"sequence {self._sent} has not ended after {PATIENCE:.0f} s")

    def raise_leg(self, leg: int, by: float, *, slow: float = 1.0, watch: Watch | None = None) -> None:
        """Lift a standing leg straight up by `by` [m], at a share of the usual speed."""
        place = self.axles[leg]
        self._leaves(leg, place)
        target = place + by * self.up_in_hex
        self.run([LegMove(leg=leg, wheel_in_hex=target, guard="break_contact", speed_scale=slow)], watch=watch)

    def put_down(self, leg: int, *, slow: float = 1.0, watch: Watch | None = None, torque: float = 1.0) -> None:
        """Lower a leg to its place until it carries, then bring all standing wheels into one plane; arguments as of `run`."""
        target = self._place[leg] - DEEPEST * self.up_in_hex
        load = TOUCH * self.spec.mass * GRAVITY
        self.run(
            [LegMove(leg=leg, wheel_in_hex=target, guard="contact", contact_load=load, speed_scale=slow)],
            watch=watch, torque=torque,
        )  # fmt: skip
        self.lifted = tuple(other for other in self.lifted if other != leg)
        self.level(torque=torque)

    def foot_path(self, leg: int, place_in_hex: np.ndarray, *, over: float, up_in_hex: Vec3 | None = None) -> np.ndarray:
        """Commanded places of a standing leg's axle that is put down elsewhere: up, over, down, shape (3, 3) [m].

        Args:
            leg: index 0 to 5.
            place_in_hex: x and y of where it shall stand, shape (2,) [m].
            over: height that the wheel is lifted to on its way [m].
            up_in_hex: where it is lifted to; square to the commanded plane by default.
        """
        old, normal = self.axles[leg], self.up_in_hex
        up = normal if up_in_hex is None else up_in_hex
        new = np.array([*place_in_hex, old[2] - normal[:2] @ (place_in_hex - old[:2]) / normal[2]])
        return np.array([old + over * up, new + over * up, new - DEEPEST * up])

    def move_foot(self, leg: int, path: np.ndarray) -> None:
        """Put a standing leg down elsewhere, along a path from `foot_path`."""
        self._leaves(leg, path[2] + DEEPEST * self.up_in_hex)
        self.run([LegMove(leg=leg, wheel_in_hex=path[0], guard="break_contact"), LegMove(leg=leg, wheel_in_hex=path[1])])
        self.put_down(leg)

    def move_body(self, translation_in_hex: Vec3, rotvec_in_hex: Vec3) -> None:
        """Move the chassis over planted wheels [m], [rad]."""
        self.run([BodyMove(translation_in_hex=translation_in_hex, rotvec_in_hex=rotvec_in_hex)])

    def level(self, *, torque: float = 1.0) -> None:
        """Bring the commanded places of all standing wheels into one plane, in moves that the executive takes."""
        places, standing = self.axles, self.standing
        plane = np.column_stack([places[standing][:, :2], np.ones(int(standing.sum()))])
        off = np.zeros((LEGS, 3))
        off[standing, 2] = plane @ np.linalg.lstsq(plane, places[standing][:, 2], rcond=None)[0] - places[standing][:, 2]
        while np.abs(off).max() > LEVEL_ENOUGH:
            part = np.clip(off, -LONGEST_MOVE, LONGEST_MOVE)
            self.run([BodyMove(translation_in_hex=np.zeros(3), wheel_offsets_in_hex=part)], torque=torque)
            off = off - part

    def _leaves(self, leg: int, comes_back_to: Vec3) -> None:
        self._place[leg] = comes_back_to
        self.lifted = (*self.lifted, leg)

    # --- what somebody reads --------------------------------------------------------------------------------------

    def read(self) -> Reading:
        """Let the robot come to rest; its stance by telemetry, its heights by the instrument."""
        self.run([Wait(duration=REST)])
        up, standing, radius = self.up_in_hex, self.standing, self.spec.wheel.radius
        feet = self.axles - radius * up
        origin_height = -float((feet @ up)[standing].mean())
        poses, truth = self.robot.link_poses(), self.robot.truth()
        corners = np.array([poses[f"leg{leg + 1}_hip_yaw"].translation for leg in range(LEGS)])
        stance = MeasuredStance(
            feet_in_hex=feet,
            com_in_hex=self.kin.com_in_hex(self.motors),
            weight=self.spec.mass * GRAVITY,
            lifts=feet @ up + origin_height,
            corners_in_hex=np.array(self.spec.hips_in_hex),
            heights=self._metered(corners),
            origin_height=origin_height,
            gravity_in_hex=-up,
        )
        return Reading(
            stance=stance, lifted=self.lifted, motors=self.motors.copy(), axle_heights=self._metered(truth.wheels_in_world)
        )

    def _metered(self, points_in_world: np.ndarray) -> np.ndarray:
        """Heights of points over the ground below them, as the instrument says them [m]."""
        above = points_in_world[:, 2] - self.robot.terrain.grid.sample(points_in_world[:, :2])
        return np.asarray(above + self._instrument.normal(0.0, INSTRUMENT_SIGMA, len(above)))
