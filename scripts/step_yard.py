"""A planned crossing executed by the twin: ledge, ditch or wall on hard ground, step by step, the truth watched.

Before every step the ground is told where the chassis truly is, as a perfect localisation would, and moves it from there to the
planned pose: a manoeuvre of forty steps does not go blind. What it is not told is what sags and where wheels touch: descents are
guarded by contact, and after each the commanded places are brought back to the planned shape.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from gait_yard import GaitYard
from sag_yard import DEEPEST, LONGEST_MOVE, MAX_TILT, TOUCH, StanceRefusedError

from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, LegMove
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.world.scenario import Scenario, load_scenario
from athlete_twin.world.terrain import Terrain, build_terrain
from planner.gait.ground_profile import Profile
from planner.gait.stepping import Crossing, LegStep

NEAR = 0.02
"""a chassis within this of its planned place is left there [m], [rad]"""
LONGEST = 0.12
"""of the chassis in one move [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class WalkedCrossing:
    """What executing a crossing truly asked."""

    steps: int
    """finished, of those planned"""
    torques: np.ndarray
    """largest joint torque over its limit until the end of each step, shape (steps,)"""
    slip: float
    """longest way along the ground that a standing wheel went, its tyre's shear taken off [m]"""
    struck: tuple[str, ...]
    """parts that touched what they should not"""
    ended_by: str
    """why it was not finished; empty when it was"""
    poses: tuple[SE3, ...]
    """true `world_from_hex` after each step"""
    joints: np.ndarray
    """true angles after each step, shape (steps, 6, dof) [rad]"""


class StepYard(GaitYard):
    """The yard with an obstacle and a robot set down before it."""

    def __init__(self, crossing: Crossing, seed: int) -> None:
        spec, begin = crossing.spec, crossing.begin
        inverse = begin.inverse()
        joints, _ = all_legs_ik(
            spec, inverse.apply(crossing.axles), last_link_in_hex=inverse.rotate(np.array([0.0, 0.0, -1.0]))
        )
        scenario = load_scenario("calibration_yard")
        self._crossing = crossing
        super().__init__(
            spec.name, seed, scenario=scenario, terrain=obstacle(scenario, crossing.profile, seed), start=(joints, begin),
            max_tilt=MAX_TILT + crossing.largest_pitch,
        )  # fmt: skip

    def cross(self) -> WalkedCrossing:
        """Execute the whole of it, or as much as goes."""
        torques, poses, joints, ended = [], [], [], ""
        axles = self._crossing.axles.copy()
        self._anchors, self._slip, touched = {}, 0.0, len(self.robot.collisions)
        for number, step in enumerate(self._crossing.steps):
            self._seen = 0.0
            try:
                for pose in step.poses:
                    self._to(pose, near=LONGEST)
                pose = self._planned_pose(number)
                self._to(pose, near=NEAR)
                self._swing(step)
                axles[step.leg] = step.path[3]
                self._shape(pose.inverse().apply(axles), pose)
            except StanceRefusedError as e:
                ended = f"step {number + 1} (leg {step.leg + 1}): {e}"
            torques.append(self._seen)
            truth = self.robot.truth()
            poses.append(truth.world_from_hex)
            joints.append(truth.joints)
            if ended:
                break
        struck = tuple(dict.fromkeys(f"{c.part} on {c.other}" for c in self.robot.collisions[touched:]))
        return WalkedCrossing(
            steps=len(torques) - bool(ended), torques=np.array(torques), slip=self._slip, struck=struck, ended_by=ended,
            poses=tuple(poses), joints=np.array(joints),
        )  # fmt: skip

    def _planned_pose(self, number: int) -> SE3:
        """The pose that a step is made from: the last one on its way, or on an earlier step's."""
        for step in reversed(self._crossing.steps[: number + 1]):
            if step.poses:
                return step.poses[-1]
        return self._crossing.begin

    def _to(self, pose: SE3, *, near: float) -> None:
        """The chassis from where it truly is to a pose, in moves that the executive takes, until it is near."""
        for _ in range(6):
            way = self.robot.truth().world_from_hex.inverse().compose(pose)
            turn = _rotvec(way.rotation)
            size = max(float(np.linalg.norm(way.translation)), 2.0 * float(np.linalg.norm(turn)))
            if size < near:
                return
            share = min(1.0, LONGEST / size)
            self.run([BodyMove(translation_in_hex=share * way.translation, rotvec_in_hex=share * turn)])

    def _swing(self, step: LegStep) -> None:
        """Up, over and down until the wheel carries; where it goes is told in hex as it truly lies."""
        true, leg = self.robot.truth().world_from_hex, step.leg
        up = true.inverse().rotate(np.array([0.0, 0.0, 1.0]))
        old = self.axles[leg]
        rise = float(step.path[1, 2] - step.path[0, 2])
        over = true.inverse().apply(step.path[2])
        down = true.inverse().apply(step.path[3]) - DEEPEST * up
        # Where the lift ends at the height of the way over, which is level.
        above = old + rise * up
        load = TOUCH * self.spec.mass * GRAVITY
        self._leaves(leg, down + DEEPEST * up)
        self.run([
            LegMove(leg=leg, wheel_in_hex=above, guard="break_contact"),
            LegMove(leg=leg, wheel_in_hex=over),
            LegMove(leg=leg, wheel_in_hex=down, guard="contact", contact_load=load),
        ])  # fmt: skip
        self.lifted = tuple(other for other in self.lifted if other != leg)

    def _shape(self, planned_in_hex: np.ndarray, pose: SE3) -> None:
        """Bring the commanded places back to the planned shape, but for its own plane: heights alone."""
        up = pose.inverse().rotate(np.array([0.0, 0.0, 1.0]))
        off = (planned_in_hex - self.axles) @ up
        plane = np.column_stack([planned_in_hex[:, :2], np.ones(len(off))])
        off = off - plane @ np.linalg.lstsq(plane, off, rcond=None)[0]
        while np.abs(off).max() > 0.005:
            part = np.clip(off, -LONGEST_MOVE, LONGEST_MOVE)
            self.run([BodyMove(translation_in_hex=np.zeros(3), wheel_offsets_in_hex=part[:, None] * up)])
            off = off - part


def obstacle(scenario: Scenario, profile: Profile, seed: int) -> Terrain:
    """A scenario's ground with a profile on it."""
    terrain = build_terrain(scenario, seed, clear_xy=np.zeros((1, 2)), clear_radius=0.1)

    def raised(grid):  # type: ignore[no-untyped-def]
        x, _ = grid.centres()
        heights = grid.heights + profile.height(x)[:, None]
        heights.setflags(write=False)
        return replace(grid, heights=heights)

    return replace(terrain, grid=raised(terrain.grid), ground=raised(terrain.ground))


def _rotvec(rotation: np.ndarray) -> np.ndarray:
    """Of a small turn [rad]."""
    axis = 0.5 * np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    sine = float(np.linalg.norm(axis))
    return axis if sine < 1e-9 else axis / sine * np.arctan2(sine, 0.5 * (np.trace(rotation) - 1.0))
