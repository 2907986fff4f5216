"""What `validate_twin.py` measures: the true robot brought to rest in a stance, on flat ground or a slope, and read out.

Nothing here knows a target. Every run goes through `Body`, so it measures the twin and no copy of its equations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.arrays import Joints, LegJoints, PerLeg, PerLegFlag, Vec3, Wheels
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.reach import all_legs_ik, leg_ik
from athlete_twin.model.spec import LEGS, RobotSpec, load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from athlete_twin.model.statics import peak_torque_fraction
from athlete_twin.physics.body import Body, settled
from athlete_twin.physics.truth import TrialTruth, draw_truth, nominal_truth
from athlete_twin.physics.tyre import Footing
from athlete_twin.world.bullet_world import TICK, BulletWorld

FOOT_RADIUS = {"sdm_b": 1.793, "t12": None}
"""of the stance that FF12 fig. 16 was read back to (robot facts 2.5) [m]; None is the drawings' own"""
HARD = Footing.hard(0.7)
SLOPE = Footing.hard(0.45)
"""the friction of loose sand on a hard base, as in the scenario `slope_14`"""
LIFT = 0.35
"""of a leg that shall be in the air, with certainty [m]"""
SLOPE_LIFT = 0.25
SLOPE_FOOT_RADIUS = 2.1
"""the only one of 1.8, 1.95 and 2.1 m whose level stance still steps on 20 deg"""
RAMP = 0.01
"""speed of a lift that is watched for the moment of breaking contact [m/s]"""
LONGEST, LONG = 9600, 2400
"""ticks after which a robot that still rocks is read out as it is, for single runs and for sets of tyres. T12 with a corner
leg up rocks for half a minute; its average is right after ten seconds, within 0.6 points of torque and 0.001 of the weight"""
WINDOW = 480
"""ticks over which a reading is averaged: two seconds, some periods of the slowest rocking"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Rest:
    """The true robot at rest in one stance."""

    lifted: tuple[int, ...]
    """indices of the legs in the air"""
    commands: Joints
    """[rad]"""
    world_from_hex: SE3
    loads: PerLeg
    """of the wheels, over the weight"""
    torque: float
    """largest joint torque over its limit"""
    corner_heights: PerLeg
    """of the chassis' corners, where the legs are attached [m]"""
    axles: Wheels
    """in world [m]"""
    contacts: Wheels
    """where the ground acts, in world [m]"""
    com: Vec3
    """in world [m]"""

    @property
    def supporting(self) -> PerLegFlag:
        """Which wheels stand, shape (6,)."""
        return ~np.isin(np.arange(LEGS), self.lifted)


@dataclass(frozen=True, eq=False, kw_only=True)
class Slide:
    """What lifting and lowering each leg once does on a slope."""

    angle: float
    """[rad]"""
    height: float
    """of the chassis above the slope, before sag [m]"""
    downhill: PerLeg
    """how far the chassis has moved down after each leg's turn [m]"""
    torque: float
    """largest joint torque over its limit, of all stances"""


def flat_ground(angle: float = 0.0) -> HeightGrid:
    """A plane that rises along x by `angle` [rad]."""
    x = np.linspace(-8.0, 8.0, 17)
    return HeightGrid(origin_x=-8.0, origin_y=-8.0, cell=1.0, heights=np.repeat(np.tan(angle) * x[:, None], len(x), axis=1))


def stance_with(spec: RobotSpec, lifted: tuple[int, ...], lift: float = LIFT) -> tuple[Joints, Joints]:
    """Joint angles of the studied stance, and of the same with some legs lifted straight up by `lift` [m]."""
    planted = regular_stance(spec, FOOT_RADIUS[spec.name])
    joints = planted.copy()
    for leg in lifted:
        joints[leg] = _raised(spec, leg, planted[leg], np.array([lift]))[0]
    return planted, joints


def settle(body: Body, commands: Joints, *, longest: int = LONGEST) -> None:
    """Run until motors are where they shall be and nothing moves any more, or for `longest` ticks."""
    limits = np.full(commands.shape, body.spec.speed_unloaded)
    for tick in range(1, longest + 1):
        body.step(commands, limits)
        if tick >= 240 and tick % 60 == 0 and settled(body) and _arrived(body, commands):
            return


def stand(robot: str, lifted: tuple[int, ...], *, payload_kg: float = 0.0) -> Rest:
    """Stand on all wheels, then lift some legs, with equal tyres."""
    spec = load_spec(robot)
    planted, joints = stance_with(spec, lifted)
    with BulletWorld(flat_ground()) as world:
        body = Body(world, spec, nominal_truth(spec), footing=HARD, payload_kg=payload_kg)
        body.place(SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height])), planted)
        settle(body, planted)
        if lifted:
            settle(body, joints)
        return _read_out(body, lifted, joints)


def stand_on_drawn_tyres(robot: str, seed: int | None, nominal: tuple[Rest, ...]) -> tuple[Rest, ...]:
    """The same stances with one seeded set of tyres, equal ones for None, begun where equal tyres came to rest."""
    spec = load_spec(robot)
    trial = nominal_truth(spec)
    if seed is not None:
        trial = replace(trial, tyre_scale=draw_truth(spec, seed, link_names=()).tyre_scale)
    return tuple(_stand_near(spec, trial, rest) for rest in nominal)


def lift_that_breaks_contact(robot: str, leg: int, *, payload_kg: float, highest: float) -> tuple[float, float]:
    """Commanded lift of the last touch on the way up, and the wheel's clearance at rest at `highest` [m]."""
    spec = load_spec(robot)
    planted, _ = stance_with(spec, ())
    path = _raised(spec, leg, planted[leg], np.arange(0.0, highest, RAMP * TICK * 10))
    limits = np.full(planted.shape, spec.speed_unloaded)
    with BulletWorld(flat_ground()) as world:
        body = Body(world, spec, nominal_truth(spec), footing=HARD, payload_kg=payload_kg)
        body.place(SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height])), planted)
        settle(body, planted)
        commands, last = planted.copy(), 0.0
        for k, angles in enumerate(path):
            commands[leg] = angles
            for _ in range(10):
                body.step(commands, limits)
            if body.tyre.loads[leg] > 0.0:
                last = k * RAMP * TICK * 10
        settle(body, commands)
        return last, float(body.axles[leg, 2] - spec.wheel.radius)


def step_on_slope(robot: str, angle: float) -> Slide:
    """Stand on a slope along x with a level chassis; lift and lower each leg in turn, leg 1 being the uphill one."""
    spec = load_spec(robot)
    height, planted, raised = slope_stance(spec, angle)
    downhill, torque = np.zeros(LEGS), 0.0
    with BulletWorld(flat_ground(angle)) as world:
        body = Body(world, spec, nominal_truth(spec), footing=SLOPE)
        body.place(SE3.from_translation(np.array([0.0, 0.0, height])), planted)
        settle(body, planted)
        before = body.world_from_hex().translation[0]
        for leg in range(LEGS):
            commands = planted.copy()
            commands[leg] = raised[leg]
            for pose in (commands, planted):
                settle(body, pose)
                torque = max(torque, _peak_torque(body))
            after = body.world_from_hex().translation[0]
            downhill[leg], before = (before - after) / np.cos(angle), after
    return Slide(angle=angle, height=height, downhill=downhill, torque=torque)


def slope_stance(spec: RobotSpec, angle: float) -> tuple[float, Joints, Joints]:
    """Chassis height of least peak torque among those that reach, planted angles, and angles of each leg lifted."""
    kin, best = kinematics(spec.name), None
    for height in np.arange(1.0, spec.chassis_height + 0.01, 0.025):
        wheels = slope_wheels_in_hex(spec, angle, height=float(height), foot_radius=SLOPE_FOOT_RADIUS)
        planted, reaches = all_legs_ik(spec, wheels)
        raised, reaches_up = all_legs_ik(spec, wheels + [0.0, 0.0, SLOPE_LIFT])
        if not (reaches.all() and reaches_up.all()):
            continue
        peak = 0.0
        for leg in range(LEGS):
            joints, supporting = planted.copy(), np.ones(LEGS, dtype=bool)
            joints[leg], supporting[leg] = raised[leg], False
            peak = max(peak, peak_torque_fraction(kin, joints, supporting=supporting))
        if best is None or peak < best[0]:
            best = (peak, float(height), planted, raised)
    if best is None:
        raise KinematicsError(f"{spec.name} reaches no level stance on {np.rad2deg(angle):.0f} deg")
    return best[1], best[2], best[3]


def slope_wheels_in_hex(spec: RobotSpec, angle: float, *, height: float, foot_radius: float) -> Wheels:
    """Axle centres of a level chassis on a slope along x, unloaded tyres, shape (6, 3) [m]."""
    wheels = stance_wheels_in_hex(spec, foot_radius, height)
    wheels[:, 2] = spec.wheel.radius / np.cos(angle) - height + np.tan(angle) * wheels[:, 0]
    return wheels


def straight_sizes(robot: str) -> tuple[float, float]:
    """Height of the hex origin with the legs straight down, and reach with them straight out, of the loaded body [m]."""
    spec = load_spec(robot)
    axles = []
    for hip_pitch in (0.5 * np.pi, 0.0):
        joints = np.zeros((LEGS, spec.dof))
        joints[:, 1] = hip_pitch
        with BulletWorld(flat_ground()) as world:
            body = Body(world, spec, nominal_truth(spec), footing=HARD)
            body.place(SE3.identity(), joints)
            axles.append(body.axles)
    reach = np.linalg.norm(axles[1][:, :2], axis=1).max() + spec.wheel.radius
    return float(-axles[0][:, 2].min() + spec.wheel.radius), float(reach)


def _stand_near(spec: RobotSpec, trial: TrialTruth, nominal: Rest) -> Rest:
    standing = nominal.supporting
    wheels = kinematics(spec.name).wheels_in_hex(nominal.commands)
    pose = _rigid_fit(wheels[standing], nominal.axles[standing])
    with BulletWorld(flat_ground()) as world:
        body = Body(world, spec, trial, footing=HARD)
        body.place(pose, nominal.commands)
        settle(body, nominal.commands, longest=LONG)
        return _read_out(body, nominal.lifted, nominal.commands)


def _read_out(body: Body, lifted: tuple[int, ...], commands: Joints) -> Rest:
    limits = np.full(commands.shape, body.spec.speed_unloaded)
    loads, torques = np.zeros(LEGS), np.zeros(commands.shape)
    for _ in range(WINDOW):
        body.step(commands, limits)
        loads += body.tyre.loads / WINDOW
        torques += body.torques() / WINDOW
    poses = body.link_poses()
    return Rest(
        lifted=lifted,
        commands=commands,
        world_from_hex=body.world_from_hex(),
        loads=loads / (body.mass * GRAVITY),
        torque=float(np.abs(torques / body.spec.torque_limits).max()),
        corner_heights=np.array([poses[f"leg{leg + 1}_hip_yaw"].translation[2] for leg in range(LEGS)]),
        axles=body.axles.copy(),
        contacts=body.tyre.patches_in_world.copy(),
        com=body.com_in_world(),
    )


def _arrived(body: Body, commands: Joints) -> bool:
    return bool(np.abs(body.motors - commands).max() < 1e-3)


def _peak_torque(body: Body) -> float:
    return float(np.abs(body.torques() / body.spec.torque_limits).max())


def _raised(spec: RobotSpec, leg: int, planted: LegJoints, lifts: np.ndarray) -> np.ndarray:
    """Angles of one leg with its wheel straight above its place by each of `lifts` (n,) [m], shape (n, dof)."""
    wheel = kinematics(spec.name).leg_wheel(leg, planted).translation
    angles, reaches = leg_ik(spec, leg, wheel + lifts[:, None] * np.array([0.0, 0.0, 1.0]))
    if not reaches.all():
        raise KinematicsError(f"leg {leg + 1} of {spec.name} cannot be lifted by {lifts[~reaches].min():.2f} m")
    return angles


def _rigid_fit(before: np.ndarray, after: np.ndarray) -> SE3:
    """The rigid motion that takes one set of points to the other, in the least-squares sense."""
    centre, moved = before.mean(axis=0), after.mean(axis=0)
    u, _, vt = np.linalg.svd((after - moved).T @ (before - centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return SE3(rotation, moved - rotation @ centre)
