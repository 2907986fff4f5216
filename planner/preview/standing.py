"""Where the chassis stands, and every wheel, for given motors: the belief moved on by the contact springs.

Place in the flow: belief -> `Stance` -> `foresee`, which asks it at every turn of a motion. The belief says where the robot stands now,
sag and all; the springs say by how much that changes when a leg unloads, the chassis moves, or a wheel comes down elsewhere. A standing
wheel stays where it is and gives way as its tyre does; what a change of loads brings sideways is `sag.leg_compliance`'s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from athlete_twin.geometry.arrays import Joints, PerLeg, PerLegFlag, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.spec import LEGS
from planner.belief import Belief
from planner.sag.compensate import stand_on
from planner.sag.docked import DockedSag, Docks
from planner.sag.leg_compliance import held_response, horizontal, patch_compliance
from planner.sag.sag_model import AIRBORNE, FootSprings

WORLD_UP = np.array([0.0, 0.0, 1.0])
UNLOADING_POINTS = 16
"""between the load of a wheel and none at which its lift-off is looked at"""
ROLLING_PASSES = 3
"""of axles that roll as the chassis inclines, and incline it: each pass leaves a tenth of what was left or less"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Standing:
    """The robot at one moment, believed."""

    world_from_hex: SE3
    """the chassis; the pallet, of a robot with docks"""
    world_from_leg: tuple[SE3, ...]
    """for each leg the hex frame of what carries it: the chassis, or its deck twisted on its dock"""
    forces: Wheels
    """of the ground on the wheels, in the hex frame, shape (6, 3) [N]"""
    loads: PerLeg
    """their vertical part [N]"""
    sideways_in_world: Wheels
    """horizontal forces of the ground on the wheels that came since the start, shape (6, 3) [N]"""
    rolled_in_world: Wheels
    """by which the axles of standing wheels have rolled on, a wheel being locked to its fork and that inclined, shape (6, 3) [m]"""
    status: str
    """"converged", or why no such stance is: see `SagSolution.status`"""


class Stance:
    """The wheels that stand, and where the chassis is above them."""

    def __init__(
        self, kin: Kinematics, belief: Belief, *, springs: FootSprings, payload_kg: float = 0.0, docks: bool = True
    ) -> None:
        self.kin, self.belief = kin, belief
        self.stands: PerLegFlag = belief.planted.copy()
        self._springs, self._payload = springs, payload_kg
        self._weight = (kin.spec.mass + payload_kg) * GRAVITY
        self._docks = docks
        solved = self._solve(belief.motors, belief.gravity_in_hex(), np.where(self.stands, 0.0, AIRBORNE))
        self._world_from_unsagged = belief.world_from_hex.compose(solved.unsagged_from_sagged.inverse())
        self._anchors = self._world_from_unsagged.apply(kin.wheels_in_hex(belief.motors))
        self._axles = belief.world_from_hex.apply(kin.wheels_in_hex(belief.joints))
        """of the standing wheels as they are now, in world [m]"""
        self._loads = self._upward(solved.forces, belief.gravity_in_hex())
        """under which they are there [N]"""
        self._first_loads = self._loads.copy()
        self._solved: dict[tuple[bytes, ...], Standing] = {}
        self._landed = np.zeros(LEGS, dtype=bool)
        """wheels that came down since the start"""
        regular = kin.spec.wheel.radius - belief.loads / kin.spec.believed_tyre_stiffness
        deeper = belief.contacts_in_world[:, 2] + regular - self._axles[:, 2]
        self._sink = float(np.mean(deeper[belief.planted]))
        """by which axles stand lower than tyres alone say, as believed of those on the ground [m]"""
        gravity = belief.gravity_in_hex()
        self._compliance = patch_compliance(kin, belief.joints, belief.joint_stiffness, gravity)
        self._contacts_in_hex = kin.wheels_in_hex(belief.joints) + kin.spec.wheel.radius * gravity / GRAVITY
        self._forks = np.zeros((LEGS, 3, 3))
        """of each standing wheel, as it stood first or touched, in world: what it has inclined since, it has rolled"""
        # By how much an axle rolls under a force at its patch, in hex: as far as the wind-up inclines its fork.
        self._rolls_under = np.array([self._rolling_compliance(leg, gravity) for leg in range(LEGS)])
        first = self._at(belief.motors)
        self._forks = self._forks_in_world([carried.rotation for carried in first.world_from_leg], belief.motors)

    def lands(self, leg: int, fork_in_world: np.ndarray, axle_in_world: Vec3, ground: float) -> None:
        """A wheel touches ground of a height [m] there, its fork as it is then: from now on it stands, loaded or not."""
        self.stands[leg] = True
        self._forks[leg] = fork_in_world
        self._anchors[leg] = np.append(axle_in_world[:2], ground + self.kin.spec.wheel.radius - self._sink)
        self._landed[leg] = True
        self._axles[leg] = self._anchors[leg]
        self._loads[leg] = 0.0

    def lifts(self, leg: int) -> None:
        """A wheel leaves the ground."""
        self.stands[leg] = False

    def stays(self, leg: int) -> None:
        """A wheel that was to leave the ground stands where it stood."""
        self.stands[leg] = True

    def unloading(self, leg: int, drop: float, friction: float) -> tuple[np.ndarray, np.ndarray]:
        """Loads of a wheel that is lifted off, falling to zero, shape (n,) [N], and the commanded heights at which it has them [m].

        Its leg unwinds and its tyre swells as the load goes, in its posture; what it leans on sideways lets go as friction lets it.

        Args:
            leg: index 0 to 5.
            drop: by which what carries the leg comes down in all [m].
            friction: coefficient between wheel and ground.
        """
        up = -self.belief.gravity_in_hex() / GRAVITY
        loads = np.linspace(self._first_loads[leg], 0.0, UNLOADING_POINTS)
        forces = np.array([self.leaving_force(leg, float(load), friction) for load in loads])
        gives = forces @ self._compliance[leg] @ up + drop * loads / max(float(loads[0]), 1e-9)
        return loads, np.maximum.accumulate(gives[0] - gives)

    def leaving_force(self, leg: int, load: float, friction: float) -> Vec3:
        """Force of the ground on a wheel whose leg unloads, when the springs give it so much load, in the hex frame [N].

        It stood with what the torques told, upward too: the springs err. Its leg would go aside as the load goes; the ground holds
        it, as long as friction does.
        """
        belief = self.belief
        up, told = -belief.gravity_in_hex() / GRAVITY, belief.forces[leg]
        if not belief.planted[leg] or self._landed[leg] or not told @ up > 0.0:
            return load * up
        across, compliance = horizontal(up), self._compliance[leg]
        left = float(np.clip(load / max(float(self._first_loads[leg]), 1e-9), 0.0, None))
        upward = float(told @ up) * left
        aside = across.T @ compliance @ up * (told @ up - upward)
        force = across.T @ told + np.linalg.solve(across.T @ compliance @ across, aside)
        # That it stands shows as much friction as holds it there.
        grip = max(friction, float(np.linalg.norm(across.T @ told)) / float(told @ up))
        held = min(1.0, grip * upward / max(float(np.linalg.norm(force)), 1e-9))
        return np.asarray(upward * up + held * (across @ force))

    def bears_at(self, leg: int) -> float:
        """Height in world at which the spring of a wheel that stands, or stood last, begins to bear [m]."""
        return float(self._anchors[leg, 2])

    def rolled(self, way: Vec3, rise: PerLeg) -> None:
        """All wheels stand elsewhere: `way` in world [m], and each higher by so much."""
        move = np.asarray(way) + np.outer(rise, WORLD_UP)
        self._anchors, self._axles = self._anchors + move, self._axles + move

    def at(self, motors: Joints) -> Standing:
        """The robot with its motors there, (6, dof) [rad], the wheels that stand where they stand."""
        key = (motors.tobytes(), self.stands.tobytes(), self._anchors.tobytes())
        if key not in self._solved:
            self._solved[key] = self._at(motors)
        return self._solved[key]

    def _at(self, motors: Joints) -> Standing:
        feet = self.kin.wheels_in_hex(motors)
        fitted = self.stands
        if fitted.sum() < 3:
            pose = self._world_from_unsagged
            still = np.zeros((LEGS, 3))
            return self._standing(pose, pose, [pose] * LEGS, still, np.zeros(LEGS), still, still, "too_few_feet")
        world_from_unsagged = _fit(feet[fitted], self._anchors[fitted])
        lifts = np.where(fitted, world_from_unsagged.apply(feet)[:, 2] - self._anchors[:, 2], AIRBORNE)
        gravity = -GRAVITY * world_from_unsagged.rotation.T @ WORLD_UP
        solved = self._solve(motors, gravity, lifts)
        loads = self._upward(solved.forces, gravity)
        aside, sideways = self._aside(loads)
        # The chassis goes along with axles that roll, and so inclines them: a little less each time.
        rolled = np.zeros((LEGS, 3))
        for _ in range(ROLLING_PASSES):
            corrected = aside.compose(world_from_unsagged)
            pose = corrected.compose(solved.unsagged_from_sagged)
            if isinstance(solved, DockedSag):
                carried = [corrected.compose(solved.unsagged_from_leg(leg)) for leg in range(LEGS)]
            else:
                carried = [pose] * LEGS
            pushed = sideways + self._pushed(world_from_unsagged.apply(feet) - self._anchors - rolled)
            rolled = self._rolled(carried, motors, np.outer(loads - self._first_loads, WORLD_UP) + pushed)
            world_from_unsagged = _fit(feet[fitted], (self._anchors + rolled)[fitted])
        forces = pose.rotation.T @ corrected.rotation @ solved.forces.T
        return self._standing(world_from_unsagged, pose, carried, forces.T, loads, pushed, rolled, solved.status)

    def _rolling_compliance(self, leg: int, gravity: Vec3) -> np.ndarray:
        """Shape (3, 3) [m/N]: the axle goes by as much more than the point of its wheel that was lowest as this one rises."""
        joints = self.belief.joints
        patch, axle = self.kin.patch_jacobian(leg, joints, gravity), self.kin.leg_jacobian(leg, joints[leg])
        return np.asarray(((axle - patch) / self.belief.joint_stiffness) @ patch.T)

    def _pushed(self, beside: Wheels) -> Wheels:
        """Horizontal forces of the ground on wheels that the motors would have so far beside where they stand, in world [N]."""
        world_from_hex, gravity = self.belief.world_from_hex, self.belief.gravity_in_hex()
        across = world_from_hex.rotate(horizontal(-gravity / GRAVITY).T).T
        out = np.zeros((LEGS, 3))
        for leg in np.flatnonzero(self.stands):
            compliance = world_from_hex.rotation @ self._compliance[leg] @ world_from_hex.rotation.T
            out[leg] = -across @ np.linalg.solve(across.T @ compliance @ across, across.T @ beside[leg])
        return out

    def _rolled(self, carried: list[SE3], motors: Joints, change: Wheels) -> Wheels:
        """By which the axles of standing wheels are beside where they were: a wheel rolls about its patch as its fork inclines.

        Args:
            carried: `world_from_leg` of each leg.
            motors: shape (6, dof) [rad].
            change: of the forces on the wheels since they stood first, in world, shape (6, 3) [N].
        """
        if not self._forks.any():
            return np.zeros((LEGS, 3))
        forks = self._forks_in_world([pose.rotation for pose in carried], motors)
        turns = Rotation.from_matrix(forks @ self._forks.transpose(0, 2, 1)).as_rotvec()
        rotation = self.belief.world_from_hex.rotation
        rolled = np.cross(turns, self.kin.spec.wheel.radius * WORLD_UP)
        rolled += np.einsum("ij,ljk,lk->li", rotation, self._rolls_under, change @ rotation)
        rolled[:, 2] = 0.0
        return np.where(self.stands[:, None], rolled, 0.0)

    def _forks_in_world(self, carried: list[np.ndarray], motors: Joints) -> np.ndarray:
        """Rotations of the forks, shape (6, 3, 3)."""
        return np.array([turn @ self.kin.leg_wheel(leg, motors[leg]).rotation for leg, turn in enumerate(carried)])

    def axles(self, standing: Standing, joints: Joints) -> Wheels:
        """Axles in world, shape (6, 3) [m]; `joints` behind the wind-up say where the legs in the air are."""
        spec = self.kin.spec
        stiffness = np.where(self._landed, spec.believed_tyre_stiffness, spec.believed_tyre_tangent)
        out = self._axles - np.outer((standing.loads - self._loads) / stiffness, WORLD_UP)
        out += standing.rolled_in_world
        out -= standing.sideways_in_world / (spec.believed_tyre_stiffness * spec.believed_lateral_ratio)
        in_hex = self.kin.wheels_in_hex(joints)
        for leg in np.flatnonzero(~self.stands | (standing.loads <= 0.0)):
            out[leg] = standing.world_from_leg[leg].apply(in_hex[leg])
        return out

    def _standing(
        self, world_from_unsagged: SE3, pose: SE3, carried: list[SE3], forces: Wheels, loads: PerLeg, sideways: Wheels,
        rolled: Wheels, status: str,
    ) -> Standing:  # fmt: skip
        self._world_from_unsagged = world_from_unsagged
        return Standing(
            world_from_hex=pose, world_from_leg=tuple(carried), forces=forces, loads=loads, sideways_in_world=sideways,
            rolled_in_world=rolled, status=status,
        )  # fmt: skip

    def _solve(self, motors: Joints, gravity: Vec3, lifts: PerLeg):  # type: ignore[no-untyped-def]  # SagSolution | DockedSag
        feet, com = self.kin.wheels_in_hex(motors), self.kin.com_in_hex(motors, self._payload)
        docks = Docks.of(self.kin, motors) if self._docks else None
        return stand_on(feet, com, self._weight, self._springs, lifts, gravity, docks)

    @staticmethod
    def _upward(forces: Wheels, gravity: Vec3) -> PerLeg:
        return np.asarray(forces @ -gravity / np.linalg.norm(gravity))

    def _aside(self, loads: PerLeg) -> tuple[SE3, Wheels]:
        """What the unloading of wheels that stood at first does sideways, and the forces that come with it, in world."""
        belief = self.belief
        first = belief.planted & (self._first_loads > 0.0)
        lost = np.where(first & ~(self.stands & (loads > 0.0)), 1.0, 0.0)
        if not lost.any() or not belief.forces.any():
            return SE3.identity(), np.zeros((LEGS, 3))
        gravity = belief.gravity_in_hex()
        standing = belief.planted & (lost == 0.0)
        change = np.where(standing, loads - belief.forces @ -gravity / GRAVITY, 0.0)
        response = held_response(
            self._compliance, change, self._contacts_in_hex, standing, gravity,
            released=np.where(lost[:, None] > 0.0, belief.forces, 0.0),
        )  # fmt: skip
        moved = belief.world_from_hex.compose(response.hex_from_moved).compose(belief.world_from_hex.inverse())
        return moved, belief.world_from_hex.rotate(response.forces)


def _fit(points: np.ndarray, places: np.ndarray) -> SE3:
    """The rigid motion that takes points to places, in the least-squares sense."""
    middle, centre = points.mean(axis=0), places.mean(axis=0)
    rotation = Rotation.align_vectors(places - centre, points - middle)[0].as_matrix()
    return SE3(rotation, centre - rotation @ middle)
