"""Sequences with one fault put in, each checked by something other than the preview: what a preview has to find.

Begun from sound motions of a walk. A fault that its own check does not confirm is drawn again:

- `wrong_robot`: another robot's name.
- `joint_limit`: a way-point beyond a joint's range, or a wheel or chassis sent where the executive itself says that it cannot.
- `self_collision`: a way-point at which Bullet finds the leg inside another part.
- `tip_over`: neighbouring legs lifted until scipy's convex hull of the other wheels leaves the centre of mass out.
- `torque`: less torque allowed than rigid statics ask for with the leg in the air.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import pybullet
from scipy.spatial import ConvexHull

from athlete_twin.assets import robot_dir
from athlete_twin.executive import CONTROL_PERIOD
from athlete_twin.messages import BodyMove, Command, CommandSequence, JointMove, LegMove
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import LEGS
from athlete_twin.model.statics import peak_torque_fraction
from athlete_twin.moves import MoveFailedError, body_move, leg_move
from planner.belief import Belief

KINDS = ("wrong_robot", "joint_limit", "self_collision", "tip_over", "torque")
TRIES = 400
INSIDE = 0.02
"""by which parts overlap at least [m]"""
TIPPED = 0.05
"""by which the centre of mass is out at least [m]"""
TOO_MUCH = 1.15
"""rigid torque over the allowed one at least"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Seeded:
    """A sequence with a fault, and how that was confirmed."""

    kind: str
    sequence: CommandSequence
    proof: str


class FaultSeeder:
    """Puts faults into the sequences of one robot."""

    def __init__(self, kin: Kinematics, rng: np.random.Generator) -> None:
        self.kin, self.spec, self._rng = kin, kin.spec, rng
        self._client = pybullet.connect(pybullet.DIRECT)
        urdf = str(robot_dir(kin.spec.name) / "robot.urdf")
        self._body = pybullet.loadURDF(
            urdf, useFixedBase=True, flags=pybullet.URDF_USE_SELF_COLLISION, physicsClientId=self._client
        )
        count = pybullet.getNumJoints(self._body, physicsClientId=self._client)
        infos = [pybullet.getJointInfo(self._body, j, physicsClientId=self._client) for j in range(count)]
        self._joint = {info[1].decode(): j for j, info in enumerate(infos)}
        self._link = {info[12].decode(): j for j, info in enumerate(infos)}

    def close(self) -> None:
        """Frees Bullet's world."""
        pybullet.disconnect(physicsClientId=self._client)

    def seeded(self, kind: str, belief: Belief, sequence: CommandSequence) -> Seeded | None:
        """The sequence with a fault of a kind; None where none is confirmed."""
        makers: dict[str, Callable[[Belief, CommandSequence], Seeded | None]] = {
            "wrong_robot": self._wrong_robot, "joint_limit": self._joint_limit, "self_collision": self._self_collision,
            "tip_over": self._tip_over, "torque": self._torque,
        }  # fmt: skip
        return makers[kind](belief, sequence)

    def _wrong_robot(self, _belief: Belief, sequence: CommandSequence) -> Seeded:
        name = str(self._rng.choice(["sdm_a", "t12" if self.spec.name == "sdm_b" else "sdm_b", self.spec.name.upper(), ""]))
        return Seeded(kind="wrong_robot", sequence=replace(sequence, robot_id=name), proof=f"for {name!r}")

    def _joint_limit(self, belief: Belief, sequence: CommandSequence) -> Seeded | None:
        commands = sequence.commands
        index = int(self._rng.choice([i for i, c in enumerate(commands) if isinstance(c, JointMove | LegMove | BodyMove)]))
        command = commands[index]
        if isinstance(command, JointMove):
            waypoints = command.waypoints.copy()
            row, joint = int(self._rng.integers(len(waypoints))), int(self._rng.integers(self.spec.dof))
            past = float(np.deg2rad(self._rng.uniform(0.5, 20.0)))
            up = self._rng.random() < 0.5
            waypoints[row, joint] = self.spec.upper[joint] + past if up else self.spec.lower[joint] - past
            spoilt: Command = replace(command, waypoints=waypoints)
            return self._with(sequence, index, spoilt, "joint_limit", f"{np.rad2deg(past):.1f} deg beyond")
        if isinstance(command, LegMove):
            out = np.append(self.spec.hips_in_hex[command.leg, :2], 0.0)
            spoilt = replace(command, wheel_in_hex=command.wheel_in_hex + self._rng.uniform(1.0, 3.0) * out / np.linalg.norm(out))
            begin = self._motors_before(belief, commands, index)
            failed = self._refused(leg_move(self.kin, spoilt, begin, CONTROL_PERIOD))
        else:
            assert isinstance(command, BodyMove)
            way = self._rng.standard_normal(3) * np.array([1.0, 1.0, 0.3])
            spoilt = replace(command, translation_in_hex=self._rng.uniform(1.0, 3.0) * way / np.linalg.norm(way))
            failed = self._refused(body_move(self.kin, spoilt, belief.motors, CONTROL_PERIOD))
        return self._with(sequence, index, spoilt, "joint_limit", failed) if failed else None

    def _motors_before(self, belief: Belief, commands: tuple[Command, ...], index: int) -> np.ndarray:
        """Roughly: what the joint moves before it command."""
        motors = belief.motors.copy()
        for command in commands[:index]:
            if isinstance(command, JointMove):
                motors[command.leg] = command.waypoints[-1]
        return motors

    @staticmethod
    def _refused(move: object) -> str:
        """What the executive says of a motion, empty where it begins it."""
        try:
            with suppress(StopIteration):
                next(move)  # type: ignore[call-overload]  # a generator behind a name of its own
        except MoveFailedError as e:
            return e.text
        return ""

    def _self_collision(self, belief: Belief, sequence: CommandSequence) -> Seeded | None:
        moves = [i for i, c in enumerate(sequence.commands) if isinstance(c, JointMove)]
        if not moves:
            return None
        index = moves[0]
        command = sequence.commands[index]
        assert isinstance(command, JointMove)
        for _ in range(TRIES):
            q = command.waypoints[-1].copy()
            turned = int(self._rng.integers(2))
            q[turned] = self._rng.uniform(self.spec.lower[turned], self.spec.upper[turned])
            q[2:] = self._rng.uniform(self.spec.lower[2:], self.spec.upper[2:])
            depth, pair = self._overlap(belief, command.leg, q)
            if depth > INSIDE:
                spoilt = replace(command, waypoints=np.concatenate([q[None], command.waypoints]))
                return self._with(sequence, index, spoilt, "self_collision", f"{pair} by {100 * depth:.0f} cm")
        return None

    def _overlap(self, belief: Belief, leg: int, q: np.ndarray) -> tuple[float, str]:
        """Deepest overlap of a leg's outer links with other legs or the chassis by Bullet [m], and of which links."""
        joints = belief.joints.copy()
        joints[leg] = q
        for other in range(LEGS):
            for name, angle in zip(self.spec.joint_names, joints[other], strict=True):
                joint = self._joint[f"leg{other + 1}_{name}"]
                pybullet.resetJointState(self._body, joint, float(angle), physicsClientId=self._client)
        pybullet.performCollisionDetection(physicsClientId=self._client)
        outer = {self._link[f"leg{leg + 1}_{name}"]: name for name in self.spec.joint_names[-3:]}
        outer[self._link[f"wheel{leg + 1}"]] = "wheel"
        mine = {j for name, j in self._link.items() if name.startswith(f"leg{leg + 1}_") or name == f"wheel{leg + 1}"}
        deepest, pair = 0.0, ""
        for contact in pybullet.getContactPoints(self._body, self._body, physicsClientId=self._client):
            a, b, distance = contact[3], contact[4], contact[8]
            if (a in outer) == (b in outer) or (a in mine and b in mine):
                continue
            if -distance > deepest:
                deepest, pair = -distance, f"links {a} and {b}"
        return deepest, pair

    def _tip_over(self, belief: Belief, sequence: CommandSequence) -> Seeded | None:
        first = int(self._rng.integers(LEGS))
        hips = self.spec.hips_in_hex
        order = np.argsort(np.linalg.norm(hips - hips[first], axis=1))
        contacts = belief.contacts_in_world[:, :2]
        com = belief.world_from_hex.apply(self.kin.com_in_hex(belief.joints))[:2]
        commands: list[LegMove] = []
        for n, leg in enumerate(order[:3]):
            up = self.kin.leg_wheel(int(leg), belief.motors[leg]).translation + np.array([0.0, 0.0, self._rng.uniform(0.45, 0.55)])
            commands.append(LegMove(leg=int(leg), wheel_in_hex=up, guard="break_contact"))
            if self._refused(leg_move(self.kin, commands[-1], belief.motors, CONTROL_PERIOD)):
                return None
            rest = np.delete(contacts, order[: n + 1], axis=0)
            hull = ConvexHull(rest)
            out = float((hull.equations[:, :2] @ com + hull.equations[:, 2]).max())
            if out > TIPPED:
                return Seeded(
                    kind="tip_over", sequence=replace(sequence, commands=tuple(commands)), proof=f"{100 * out:.0f} cm beside {5 - n} wheels"
                )
        return None

    def _torque(self, belief: Belief, sequence: CommandSequence) -> Seeded | None:
        lifted = [c.leg for c in sequence.commands if isinstance(c, LegMove) and c.guard == "break_contact"]
        if not lifted:
            return None
        peak = peak_torque_fraction(
            self.kin, belief.joints, supporting=np.arange(LEGS) != lifted[0], gravity_in_hex=belief.gravity_in_hex()
        )
        allowed = peak / self._rng.uniform(TOO_MUCH, 3.0)
        standing = peak_torque_fraction(
            self.kin, belief.joints, supporting=np.ones(LEGS, dtype=bool), gravity_in_hex=belief.gravity_in_hex()
        )
        if allowed < standing:  # the executive allows what the stance asks for, and a little more
            return None
        text = f"{100 * peak:.0f} % by rigid statics, allowed {100 * allowed:.0f} %"
        return Seeded(kind="torque", sequence=replace(sequence, max_torque_fraction=float(allowed)), proof=text)

    @staticmethod
    def _with(sequence: CommandSequence, index: int, command: Command, kind: str, proof: str) -> Seeded:
        commands = (*sequence.commands[:index], command, *sequence.commands[index + 1 :])
        return Seeded(kind=kind, sequence=replace(sequence, commands=commands), proof=proof)
