"""The robot's true body in Bullet: articulated rigid links from the URDF, servos, tyres and docks as forces, no motor rows.

`step` is one tick of the world (1/240 s): servo torques and tyre forces from the state after the last tick, then Bullet's
articulated-body step. Hull contacts (anything but a wheel on ground or robot) are Bullet's own and are read out for the
collision record; wheels carry no Bullet contact, since the tyre is a force, and are watched by `Tyres.hull_depths`.
"""

from __future__ import annotations

import copy
import weakref
from dataclasses import dataclass
from typing import Any, no_type_check

import numba
import numpy as np
import pinocchio as pin

from athlete_twin.assets import robot_dir
from athlete_twin.errors import PhysicsError
from athlete_twin.geometry.arrays import Joints, PerLeg, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.physics.flex import DockFlex
from athlete_twin.physics.servo import Servos
from athlete_twin.physics.truth import TrialTruth
from athlete_twin.physics.tyre import Footing, TyreForces, Tyres
from athlete_twin.world.bullet_world import BulletWorld

WHEEL_LOCK = 2.0e4
"""holds a locked wheel against its fork [N m/rad]"""
DRIVE_RESPONSE = 0.01
"""in which a driven wheel would take up its rate in the air [s]: more than two ticks"""
DISTAL = ("knee_pitch", "knee_roll", "ankle_pitch", "ankle_roll")
"""links that get the truth's armature"""
RUNAWAY_SPEED = 20.0
"""a chassis faster than this is no robot any more [m/s]"""
STILL_SPEED = 2e-4
"""what moves slower counts as still [m/s, rad/s]"""
CALM_TIME = 0.5
"""so long all must be still before the robot counts as settled: half a swing of the slowest sway, which at its turning
points is still for a moment as well [s]"""
READS = (
    "joints", "rates", "_wheel_angles", "_wheel_rates", "dock_angles", "_dock_rates",
    "axles", "axes", "_axle_velocities", "_axle_spins", "tyre", "_locked_at", "calm_ticks",
)  # fmt: skip
"""what `Body` keeps of the last tick; Bullet's snapshot does not hold them"""


@dataclass(frozen=True, kw_only=True)
class HullContact:
    """One contact of a part that is not a wheel, at one tick."""

    part: str
    """URDF link of the robot"""
    other: str
    """ "ground" or another link"""
    place_in_world: Vec3
    """[m]"""
    force: float
    """normal force [N]; 0 for parts within Bullet's margin that press nothing, as a hull does while it chatters"""


@dataclass(frozen=True, kw_only=True, eq=False)
class BodyState:
    """One moment of one body, to come back to. Bullet's share of it is freed when nobody holds this any more."""

    world: BulletWorld
    """it was made in, and can be restored in"""
    snapshot: int
    """Bullet's number for its own part"""
    servos: dict[str, np.ndarray]
    tyres: dict[str, np.ndarray]
    reads: dict[str, Any]
    """of the last tick, by the names in `READS`"""

    def __post_init__(self) -> None:
        weakref.finalize(self, self.world.forget, self.snapshot).atexit = False


class Body:
    """One robot in one world."""

    def __init__(
        self,
        world: BulletWorld,
        spec: RobotSpec,
        trial: TrialTruth,
        *,
        footing: Footing,
        payload_kg: float = 0.0,
    ) -> None:
        self.spec, self.trial, self.world = spec, trial, world
        self._bullet, self._client = world.bullet, world.client
        self.robot = self._load(payload_kg)
        self._legs = np.array([[self._joint[f"leg{leg + 1}_{n}"] for n in spec.joint_names] for leg in range(LEGS)])
        self._leg_list: list[int] = self._legs.ravel().tolist()
        self._wheels: list[int] = [self._joint[f"wheel{leg + 1}"] for leg in range(LEGS)]
        self._docks: list[int] = [i for n, i in self._joint.items() if n.startswith("dock")]
        self._driven = self._leg_list + self._wheels + self._docks
        self._names = {i: n for n, i in self._link.items()}
        self._flex = DockFlex(trial.truth, [n for n in self._joint if n.startswith("dock")])
        self._footing, self._payload = footing, payload_kg
        self._wheel_drive = trial.truth.tyre_drive_torque
        self._locked_at = np.zeros(LEGS)
        self.calm_ticks = 0
        """so many ticks nothing has moved faster than `STILL_SPEED`"""
        self._servos: Servos | None = None
        self._tyres: Tyres | None = None
        self._filter_collisions()

    # --- state ----------------------------------------------------------------------------------------------------

    def place(self, world_from_hex: SE3, joints: Joints, *, damped_for: Joints | None = None) -> None:
        """Put the robot somewhere, at rest, motors where the links are. To be called once, before the first step.

        Args:
            world_from_hex: of the chassis.
            joints: shape (6, dof) [rad].
            damped_for: the posture whose inertias the joints' dampers are made for, shape (6, dof) [rad]; `joints` by default.
                A bent ankle makes dampers of the rolls that a straight one turns unstable at this tick.
        """
        b = self._bullet
        for leg in range(LEGS):
            for k in range(self.spec.dof):
                b.resetJointState(self.robot, int(self._legs[leg, k]), float(joints[leg, k]), 0.0, physicsClientId=self._client)
        com = world_from_hex.apply(self._base_com)
        b.resetBasePositionAndOrientation(
            self.robot, com.tolist(), world_from_hex.quaternion_xyzw().tolist(), physicsClientId=self._client
        )
        inertias = self._joint_inertias(joints if damped_for is None else damped_for)
        legs, docks = inertias[: LEGS * self.spec.dof], inertias[LEGS * (self.spec.dof + 1) :]
        limits = self.spec.torque_limits
        self._servos = Servos(self.trial.truth, limits, legs.reshape(LEGS, -1), np.array(joints, dtype=float))
        self._flex.set_inertias(docks)
        self._tyres = Tyres(
            self.spec.wheel, self.trial, self.world.ground, self._footing, sprung_mass=self.spec.mass + self._payload
        )
        self._read()

    def step(self, commands: Joints, rate_limits: Joints, wheel_rates: PerLeg | None = None) -> None:
        """One tick.

        Args:
            commands: motor angles, shape (6, dof) [rad].
            rate_limits: at which the motors approach them at most, shape (6, dof) [rad/s].
            wheel_rates: of the wheels on their forks, shape (6,) [rad/s]; None locks them where they are.
        """
        servos, tyres = self._ready()
        b, client, robot = self._bullet, self._client, self.robot
        torques = servos.step(self.joints, self.rates, commands, rate_limits, self.world.tick)
        if wheel_rates is None:
            wheel = -WHEEL_LOCK * (self._wheel_angles - self._locked_at) - self._wheel_damping * self._wheel_rates
        else:
            self._locked_at = self._wheel_angles
            error = wheel_rates - self._wheel_rates
            wheel = np.clip(self._wheel_gain * error, -self._wheel_drive, self._wheel_drive)
        dock = self._flex.torques(self.dock_angles, self._dock_rates)
        b.setJointMotorControlArray(
            robot,
            self._driven,
            b.TORQUE_CONTROL,
            forces=np.concatenate([torques.ravel(), wheel, dock]).tolist(),
            physicsClientId=client,
        )
        ground = tyres.step(self.axles, self.axes, self._axle_velocities, self._axle_spins, self.world.tick)
        self.tyre = ground
        forces, patches = ground.forces_in_world.tolist(), ground.patches_in_world.tolist()
        for leg in range(LEGS):
            if ground.loads[leg] > 0.0:
                b.applyExternalForce(
                    robot, self._wheels[leg], forces[leg], patches[leg], b.WORLD_FRAME, physicsClientId=client
                )
        b.stepSimulation(physicsClientId=client)
        self._read()

    def save(self) -> BodyState:
        """This moment: what follows `restore` of it equals what follows now, to the last bit.

        Not while a hull touches something: Bullet mixes up the contacts of hulls made of several shapes when it
        restores them (bulletphysics/bullet3 issue 4387), so that is refused.
        """
        servos, tyres = self._ready()
        touching = self._bullet.getContactPoints(bodyA=self.robot, physicsClientId=self._client)
        if touching:
            part = self._names.get(touching[0][3], "hex")
            raise PhysicsError(f"{part} touches something: a state can be saved only while no hull does")
        reads = {name: copy.copy(vars(self)[name]) for name in READS if name in vars(self)}
        return BodyState(
            world=self.world, snapshot=self.world.save(), servos=servos.state(), tyres=tyres.state(), reads=reads
        )

    def restore(self, state: BodyState) -> None:
        """Back to a moment that this body saved."""
        servos, tyres = self._ready()
        if state.world is not self.world:
            raise PhysicsError("the state was saved in another world: only the world it was saved in can restore it")
        self.world.restore(state.snapshot)
        servos.set_state(state.servos)
        tyres.set_state(state.tyres)
        vars(self).update({name: copy.copy(read) for name, read in state.reads.items()})

    @property
    def motors(self) -> Joints:
        """Motor angles, before the wind-up, shape (6, dof) [rad]."""
        return self._ready()[0].motors.copy()

    @property
    def slipped(self) -> Joints:
        """By ratcheting, motor less gear, shape (6, dof) [rad]."""
        return self._ready()[0].slipped.copy()

    def torques(self) -> Joints:
        """Torques carried by the joints, shape (6, dof) [N m]."""
        return self._ready()[0].torques(self.joints)

    def stick(self, leg: int, joint: int) -> None:
        """From now on the motor of one joint does not turn."""
        self._ready()[0].stuck[leg, joint] = True

    def lose_pressure(self, leg: int, left: float) -> None:
        """From now on one tyre has at most this part of the stiffness that it has when pumped up."""
        self._ready()[1].lose_pressure(leg, left)

    def hull_depths(self, *, standing: bool = False) -> tuple[PerLeg, Wheels]:
        """How deep each wheel's unloaded hull is in the ground [m], and where; what it stands on left out if `standing`."""
        return self._ready()[1].hull_depths(self.axles, self.axes, standing=standing)

    def world_from_hex(self) -> SE3:
        """True pose of the chassis."""
        position, quaternion = self._bullet.getBasePositionAndOrientation(self.robot, physicsClientId=self._client)
        com = SE3.from_quaternion(quaternion, position)
        return SE3(com.rotation, com.translation - com.rotation @ self._base_com)

    def velocity(self) -> tuple[Vec3, Vec3]:
        """Linear velocity of the chassis' centre of mass [m/s] and its angular velocity [rad/s], in world."""
        linear, angular = self._bullet.getBaseVelocity(self.robot, physicsClientId=self._client)
        return np.array(linear), np.array(angular)

    def link_poses(self) -> dict[str, SE3]:
        """`world_from_link` of every link by its URDF name."""
        states = self._bullet.getLinkStates(self.robot, list(self._names), physicsClientId=self._client)
        poses = {n: SE3.from_quaternion(s[5], s[4]) for n, s in zip(self._names.values(), states, strict=True)}
        poses["hex"] = self.world_from_hex()
        return poses

    def com_in_world(self) -> Vec3:
        """True centre of mass, payload included [m]."""
        states = self._bullet.getLinkStates(self.robot, list(self._names), physicsClientId=self._client)
        centres = np.array([s[0] for s in states])
        base = np.array(self._bullet.getBasePositionAndOrientation(self.robot, physicsClientId=self._client)[0])
        total = self._link_masses.sum() + self._base_mass
        return np.asarray((self._link_masses @ centres + self._base_mass * base) / total)

    @property
    def mass(self) -> float:
        """True mass with payload [kg]."""
        return float(self._link_masses.sum() + self._base_mass)

    def hull_contacts(self) -> list[HullContact]:
        """Contacts of this tick between hulls and ground or robot."""
        found = self._bullet.getContactPoints(bodyA=self.robot, physicsClientId=self._client) or ()
        contacts = []
        for c in found:
            other = "ground" if c[2] == self.world.ground_body else self._names.get(c[4], "hex")
            part = self._names.get(c[3], "hex")
            contacts.append(HullContact(part=part, other=other, place_in_world=np.array(c[5]), force=float(c[9])))
        return contacts

    # --- internals ------------------------------------------------------------------------------------------------

    def _ready(self) -> tuple[Servos, Tyres]:
        if self._servos is None or self._tyres is None:
            raise PhysicsError("the body was not placed: call place() before step()")
        return self._servos, self._tyres

    def _read(self) -> None:
        b, client = self._bullet, self._client
        states = b.getJointStates(self.robot, self._driven, physicsClientId=client)
        angles, rates = np.array([[s[0] for s in states], [s[1] for s in states]])
        n = LEGS * self.spec.dof
        self.joints: Joints = angles[:n].reshape(LEGS, -1)
        """link angles, after the wind-up, shape (6, dof) [rad]"""
        self.rates: Joints = rates[:n].reshape(LEGS, -1)
        self._wheel_angles, self._wheel_rates = angles[n : n + LEGS], rates[n : n + LEGS]
        self.dock_angles, self._dock_rates = angles[n + LEGS :], rates[n + LEGS :]
        # Without fresh kinematics Bullet's link poses are a tick old, and so is the place where the tyre's force would act.
        wheels = b.getLinkStates(
            self.robot, self._wheels, computeLinkVelocity=1, computeForwardKinematics=1, physicsClientId=client
        )
        poses = np.array([w[4] + w[5] + w[6] + w[7] for w in wheels])  # one array: making each costs more than filling it
        axles, axes, velocities, spins, fastest, fastest_wheel, finite = _digest(poses, angles, rates)
        self.axles: Wheels = axles
        """axle centres in world, shape (6, 3) [m]"""
        self.axes: Wheels = axes
        """unit axle directions in world, shape (6, 3)"""
        self._axle_velocities, self._axle_spins = velocities, spins
        self.calm_ticks = self.calm_ticks + 1 if fastest < STILL_SPEED else 0
        if not finite or fastest_wheel > RUNAWAY_SPEED:
            raise PhysicsError(f"the simulation ran away: a wheel moves at {fastest_wheel:.1f} m/s")

    def _load(self, payload_kg: float) -> int:
        b, client = self._bullet, self._client
        robot = int(
            b.loadURDF(
                str(robot_dir(self.spec.name) / "robot.urdf"),
                useFixedBase=False,
                flags=b.URDF_USE_INERTIA_FROM_FILE | b.URDF_USE_SELF_COLLISION | b.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT,
                physicsClientId=client,
            )
        )
        self._joint: dict[str, int] = {}
        self._link: dict[str, int] = {}
        for i in range(b.getNumJoints(robot, physicsClientId=client)):
            info = b.getJointInfo(robot, i, physicsClientId=client)
            self._link[info[12].decode()] = i
            if info[2] != b.JOINT_FIXED:
                self._joint[info[1].decode()] = i
                b.setJointMotorControl2(robot, i, b.VELOCITY_CONTROL, force=0.0, physicsClientId=client)
        masses = []
        for name, i in [("hex", -1), *self._link.items()]:
            info = b.getDynamicsInfo(robot, i, physicsClientId=client)
            scale = self.trial.mass_scale.get(name, 1.0)
            mass = info[0] * scale
            armature = self.trial.truth.joint_armature if name.endswith(DISTAL) else 0.0
            b.changeDynamics(
                robot,
                i,
                mass=mass,
                localInertiaDiagonal=[scale * moment + armature for moment in info[2]],
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                physicsClientId=client,
            )
            masses.append(mass)
            if i == -1:
                self._base_com = np.array(info[3])
        self._base_mass = masses[0]
        self._link_masses = np.array(masses[1:])
        if payload_kg > 0.0:
            self._add_payload(robot, payload_kg)
        return robot

    def _add_payload(self, robot: int, payload_kg: float) -> None:
        """A payload on the deck: the base link gets heavier.

        Bullet cannot shift a link's centre of mass after loading, so the load is put at the base's own centre: exact
        for the wheel loads on level ground, and off by payload x height in the tip-over moment.
        """
        self._base_mass += payload_kg
        self._bullet.changeDynamics(robot, -1, mass=self._base_mass, physicsClientId=self._client)

    def _filter_collisions(self) -> None:
        b, client = self._bullet, self._client
        for wheel in self._wheels:
            b.setCollisionFilterPair(self.robot, self.world.ground_body, wheel, -1, 0, physicsClientId=client)
        # Links that share a joint region by construction: same leg within two joints, hips with what carries them.
        names = {-1: "hex", **self._names}
        for i, a in names.items():
            for j, c in names.items():
                if i < j and self._neighbours(a, c):
                    b.setCollisionFilterPair(self.robot, self.robot, i, j, 0, physicsClientId=client)

    def _neighbours(self, a: str, c: str) -> bool:
        order = {n: k for k, n in enumerate((*self.spec.joint_names, "wheel"))}

        def split(name: str) -> tuple[int, int]:
            if name.startswith("leg"):
                return int(name[3]), order[name[5:]]
            if name.startswith("wheel"):
                return int(name[5]), order["wheel"]
            return 0, -1

        (leg_a, k_a), (leg_c, k_c) = split(a), split(c)
        if leg_a == 0 and leg_c == 0:
            return True
        if leg_a == 0 or leg_c == 0:
            return max(k_a, k_c) <= 1
        return leg_a == leg_c and abs(k_a - k_c) <= 2

    def _joint_inertias(self, joints: Joints) -> np.ndarray:
        """Inertia that each driven joint sees, everything else free: one over the diagonal of the inverse mass matrix.

        Of the drawn robot, by Pinocchio: Bullet's own mass matrix refuses inertias that are unsymmetric in the last bit.
        """
        text = (robot_dir(self.spec.name) / "robot.urdf").read_text().replace('<joint name="', '<joint name="joint_')
        model = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
        q = pin.neutral(model)
        place = {name: model.joints[model.getJointId(f"joint_{name}")] for name in self._joint}
        for leg in range(LEGS):
            for k, name in enumerate(self.spec.joint_names):
                q[place[f"leg{leg + 1}_{name}"].idx_q] = joints[leg, k]
        full = pin.crba(model, model.createData(), q)
        full = np.triu(full) + np.triu(full, 1).T
        for name, joint in place.items():
            if name.endswith(DISTAL):
                full[joint.idx_v, joint.idx_v] += self.trial.truth.joint_armature
        inverse = np.diag(np.linalg.inv(full))
        inertia = {self._joint[name]: 1.0 / inverse[joint.idx_v] for name, joint in place.items()}
        wheels = np.array([inertia[i] for i in self._wheels])
        self._wheel_damping = 2.0 * 0.3 * np.sqrt(WHEEL_LOCK * wheels)
        self._wheel_gain = wheels / DRIVE_RESPONSE
        return np.array([inertia[i] for i in self._driven])


@no_type_check
@numba.njit(cache=True)
def _digest(poses, angles, rates):  # type: ignore[no-untyped-def]
    """What a tick needs of the wheels' poses, (6, 13): position, xyzw, velocity, spin in world; and of the joints, (n,).

    Axles, their unit y axes, velocities and spins, (6, 3) each; the fastest of all joints and wheels [rad/s, m/s], the
    fastest wheel [m/s], and whether all is finite.
    """
    n = len(poses)
    axes = np.empty((n, 3))
    fastest_wheel, fastest, finite = 0.0, 0.0, True
    for i in range(n):
        x, y, z, w = poses[i, 3], poses[i, 4], poses[i, 5], poses[i, 6]
        axes[i, 0] = 2 * (x * y - w * z)
        axes[i, 1] = 1 - 2 * (x * x + z * z)
        axes[i, 2] = 2 * (y * z + w * x)
        for k in range(13):
            finite = finite and np.isfinite(poses[i, k])
        for k in range(3):
            fastest_wheel = max(fastest_wheel, abs(poses[i, 7 + k]))
            fastest = max(fastest, abs(poses[i, 10 + k]))
    for i in range(len(angles)):
        finite = finite and np.isfinite(angles[i]) and np.isfinite(rates[i])
        fastest = max(fastest, abs(rates[i]))
    axles, velocities, spins = poses[:, :3].copy(), poses[:, 7:10].copy(), poses[:, 10:].copy()
    return axles, axes, velocities, spins, max(fastest, fastest_wheel), fastest_wheel, finite


def settled(body: Body) -> bool:
    """Whether nothing moves any more: wheels and joints, and with them the chassis, were still for `CALM_TIME`."""
    return body.calm_ticks * body.world.tick >= CALM_TIME


__all__ = ["Body", "HullContact", "TyreForces", "settled"]
