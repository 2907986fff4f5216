"""A cycle of the regular gait executed by the twin: the robot stands on the yard, is told every phase, and the truth is watched.

The wheels are first put where the cycle begins. Then, phase by phase, the chassis goes to its place and the phase's legs
step. Nothing corrects the robot on its way but the guards of its own executive and the levelling of the commanded places after
a step, so what the joints carry is what this gait asks of them, compliance and interaction included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from sag_yard import DEEPEST, MAX_TILT, TOUCH, SagYard, StanceRefusedError, Watch

from athlete_twin.athlete import TruthState
from athlete_twin.geometry.arrays import Vec3
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import Command, LegMove
from athlete_twin.model.kinematics import GRAVITY
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import LEGS
from athlete_twin.world.scenario import Scenario
from planner.gait.cycle import GaitCycle

PATIENT = 1.3
"""torque over its limit at which the executive stops: a gait beyond saturation shall show by how much"""
LONGEST_WAY = 0.15
"""of the chassis in one move [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class WalkedCycle:
    """What executing a cycle truly asked."""

    torques: np.ndarray
    """largest joint torque over its limit in each phase, its swing and the shift to the next, shape (k,)"""
    advance: float
    """of the true chassis along the heading [m]"""
    side: float
    """largest way of the true chassis to either side of the straight line [m]"""
    slip: float
    """longest way along the ground that a standing wheel went, its tyre's shear taken off [m]"""
    struck: tuple[str, ...]
    """parts that touched what they should not, such as "leg1_knee_roll on ground" """
    ended_by: str
    """why the cycle was not finished; empty when it was"""

    @property
    def peak(self) -> float:
        """The largest of all phases that were walked; NaN when none was."""
        return float(np.nanmax(self.torques)) if np.isfinite(self.torques).any() else float("nan")


class GaitYard(SagYard):
    """The yard with a robot that walks."""

    def __init__(self, robot: str, seed: int, **ground: Any) -> None:
        """As of `SagYard`; on another ground than level concrete the robot begins where it is put."""
        self._seen, self._slip = 0.0, 0.0
        self._poses: list[Vec3] = []
        self._anchors: dict[int, np.ndarray] = {}
        self._put = ground.get("start") is not None
        super().__init__(robot, seed, **ground)

    @classmethod
    def beginning(cls, cycle: GaitCycle, seed: int, scenario: Scenario) -> GaitYard:
        """A robot set down where a cycle begins, on the soil of a flat or sloping scenario that rises as its footing says."""
        footing, spec = cycle.footing, cycle.spec
        world_from_hex = SE3(rotation=_turned(footing.up, np.array([0.0, 0.0, 1.0])), translation=np.zeros(3))
        normal = world_from_hex.rotate(footing.normal)
        angle, heading = np.arccos(np.clip(normal[2], -1.0, 1.0)), np.arctan2(-normal[1], -normal[0])
        figures = {"angle_deg": float(np.rad2deg(angle)), "heading_deg": float(np.rad2deg(heading))}
        figures["roughness"] = scenario.parameters["roughness"]
        joints, reaches = all_legs_ik(spec, cycle.start[0] - cycle.chassis[0], last_link_in_hex=-footing.up)
        if not reaches.all():
            raise StanceRefusedError(f"leg {int(np.argmin(reaches)) + 1} does not reach where the cycle begins")
        place = world_from_hex.rotate(cycle.chassis[0])
        tilt = float(np.arccos(np.clip(footing.up[2], -1.0, 1.0)))
        begin = SE3(rotation=world_from_hex.rotation, translation=place)
        ground = replace(scenario, kind="slope", parameters=figures)
        return cls(spec.name, seed, scenario=ground, start=(joints, begin), max_tilt=MAX_TILT + tilt)

    def walk(self, cycle: GaitCycle, displacements: np.ndarray | None = None) -> WalkedCycle:
        """Put the wheels where the cycle begins, then walk it once; the chassis displaced by (k, 3) [m], by nothing when None."""
        places = cycle.chassis if displacements is None else cycle.chassis + displacements
        following = np.concatenate([places[1:], places[:1] + cycle.advance])
        torques = np.full(cycle.phases, np.nan)
        if not self._put:
            self._stand(cycle, places[0])
        self._anchors, self._slip, touched = {}, 0.0, len(self.robot.collisions)
        lean = _turned(cycle.footing.normal, cycle.footing.up)
        begin, self._poses = self.robot.truth().world_from_hex.translation.copy(), []
        ended = ""
        for k, group in enumerate(cycle.groups):
            self._seen = 0.0
            try:
                self._step(group, (cycle.goal[k] - places[k])[list(group), :2], over=cycle.lift, lean=lean)
                self._go(following[k] - places[k])
            except StanceRefusedError as e:
                ended = f"phase {k + 1}: {e}"
                break
            finally:
                torques[k] = self._seen
        way = np.array([*self._poses, self.robot.truth().world_from_hex.translation]) - begin
        along = _turned(cycle.footing.up, np.array([0.0, 0.0, 1.0])) @ cycle.advance / np.linalg.norm(cycle.advance)
        across = np.array([-along[1], along[0], 0.0]) / np.hypot(along[0], along[1])
        struck = tuple(dict.fromkeys(f"{c.part} on {c.other}" for c in self.robot.collisions[touched:]))
        return WalkedCycle(
            torques=torques, advance=float(way[-1] @ along), side=float(np.abs(way @ across).max()), slip=self._slip,
            struck=struck, ended_by=ended,
        )  # fmt: skip

    def run(self, commands: Sequence[Command], *, watch: Watch | None = None, torque: float = PATIENT) -> None:
        """As the yard's, always watched."""
        super().run(commands, watch=self._note if watch is None else watch, torque=torque)

    def _note(self, truth: TruthState) -> None:
        self._seen = max(self._seen, float(np.abs(truth.torques / self.spec.torque_limits).max()))
        self._poses.append(truth.world_from_hex.translation.copy())
        trial = self.robot.trial
        stiffness = np.broadcast_to(trial.truth.tyre_lateral_stiffness * trial.tyre_scale, LEGS)
        for leg, phase in enumerate(truth.phases):
            if phase != "stance" or truth.wheel_loads[leg] <= 0.0:
                self._anchors.pop(leg, None)
                continue
            place = truth.wheels_in_world[leg]
            normal = self.robot.terrain.normal(place[:2])
            shear = -truth.wheel_forces[leg] / stiffness[leg]
            at = place - shear
            at = at - (at @ normal) * normal
            self._slip = max(self._slip, float(np.linalg.norm(at - self._anchors.setdefault(leg, at))))

    def _stand(self, cycle: GaitCycle, chassis: Vec3) -> None:
        """The cycle's first stance: feet first, then the height."""
        wanted = cycle.start[0] - chassis
        for leg in range(LEGS):
            if np.linalg.norm(wanted[leg, :2] - self.axles[leg, :2]) > 0.01:
                self._step((leg,), wanted[leg : leg + 1, :2], over=cycle.lift)
        self._go(np.array([0.0, 0.0, -float(np.mean(wanted[:, 2] - self.axles[:, 2]))]))

    def _go(self, way: Vec3) -> None:
        """Move the chassis, in moves that the executive takes."""
        count = max(1, int(np.ceil(np.linalg.norm(way) / LONGEST_WAY)))
        for _ in range(count):
            self.move_body(way / count, np.zeros(3))

    def _step(
        self, group: Sequence[int], places_in_hex: np.ndarray, *, over: float, lean: np.ndarray | None = None
    ) -> None:
        """The group's legs up together, over together, and down together until they carry.

        Args:
            group: indices of legs.
            places_in_hex: x and y of where they shall stand, shape (n, 2) [m].
            over: height of the lift [m].
            lean: turns the ground's normal to where wheels are lifted; nowhere by default.
        """
        up = self.up_in_hex if lean is None else lean @ self.up_in_hex
        paths = [self.foot_path(leg, place, over=over, up_in_hex=up) for leg, place in zip(group, places_in_hex, strict=True)]
        load = TOUCH * self.spec.mass * GRAVITY
        for leg, path in zip(group, paths, strict=True):
            self._leaves(leg, path[2] + DEEPEST * up)
        commands: list[Command] = []
        commands += [LegMove(leg=g, wheel_in_hex=p[0], guard="break_contact") for g, p in zip(group, paths, strict=True)]
        commands += [LegMove(leg=g, wheel_in_hex=p[1]) for g, p in zip(group, paths, strict=True)]
        commands += [
            LegMove(leg=g, wheel_in_hex=p[2], guard="contact", contact_load=load) for g, p in zip(group, paths, strict=True)
        ]
        self.run(commands)
        self.lifted = tuple(other for other in self.lifted if other not in group)
        self.level(torque=PATIENT)


def _turned(old: Vec3, new: Vec3) -> np.ndarray:
    """The shortest turn from one unit vector to another, shape (3, 3)."""
    axis, cosine = np.cross(old, new), float(old @ new)
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1.0 + cosine))
