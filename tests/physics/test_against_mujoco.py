"""The same URDF in MuJoCo: masses, gravity torques and mass matrices of Pinocchio and Bullet, and loads on three wheels."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

from athlete_twin.assets import robot_dir
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.physics.body import Body, settled
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.physics.tyre import Footing
from athlete_twin.world.bullet_world import BulletWorld

mujoco = pytest.importorskip("mujoco")

CONFIGURATIONS = 50
RELATIVE = 1e-6
"""of the largest entry of the vector or matrix that is compared: a small entry is a difference of large ones"""
LOAD = 0.01
"""of the load that a wheel carries"""
# Importing a URDF, MuJoCo would weld the chassis to the world and drop what it takes for scenery.
COMPILER = '<mujoco><compiler discardvisual="true" fusestatic="false" balanceinertia="false" strippath="false"/></mujoco>'


class Rival:
    """MuJoCo's model of a robot, on a free base."""

    def __init__(self, robot: str) -> None:
        self.spec = load_spec(robot)
        text = (robot_dir(robot) / "robot.urdf").read_text()
        opening = f'<robot name="{robot}">'
        assert opening in text
        description = mujoco.MjSpec.from_string(text.replace(opening, opening + COMPILER))
        description.body("hex").add_freejoint()
        self.model = description.compile()
        self.model.opt.gravity[:] = [0.0, 0.0, -GRAVITY]
        self.data = mujoco.MjData(self.model)
        self.names = [self.model.joint(i).name for i in range(1, self.model.njnt)]

    def place(self, world_from_hex: SE3, angles: dict[str, float]) -> None:
        x, y, z, w = world_from_hex.quaternion_xyzw()
        self.data.qpos[:7] = [*world_from_hex.translation, w, x, y, z]
        self.data.qvel[:] = 0.0
        for name in self.names:
            self.data.qpos[self.model.joint(name).qposadr[0]] = angles.get(name, 0.0)
        mujoco.mj_forward(self.model, self.data)

    def dofs(self, names: list[str]) -> np.ndarray:
        return np.array([self.model.joint(n).dofadr[0] for n in names])

    def mass_matrix(self) -> np.ndarray:
        full = np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_fullM(self.model, self.data, full)
        return full


@pytest.fixture(scope="module", params=("sdm_b", "t12"))
def rival(request) -> Rival:
    return Rival(request.param)


@pytest.fixture
def flat_world():
    from athlete_twin.geometry.grid import HeightGrid

    with BulletWorld(HeightGrid(origin_x=-8.0, origin_y=-8.0, cell=1.0, heights=np.zeros((17, 17)))) as world:
        yield world


def leg_names(rival: Rival) -> list[str]:
    return [f"leg{leg + 1}_{n}" for leg in range(6) for n in rival.spec.joint_names]


def configurations(rival: Rival):
    """Joint angles over their whole range, and tilts of the chassis."""
    rng = np.random.default_rng(7)
    for _ in range(CONFIGURATIONS):
        joints = rng.uniform(rival.spec.lower, rival.spec.upper, (6, rival.spec.dof))
        yield joints, SE3.from_rotvec(rng.normal(0.0, 0.4, 3), rng.normal(0.0, 1.0, 3))


def assert_same(ours: np.ndarray, theirs: np.ndarray) -> None:
    assert ours.shape == theirs.shape
    assert np.abs(ours - theirs).max() < RELATIVE * np.abs(theirs).max()


def test_every_link_of_the_true_body_weighs_the_same(rival, flat_world):
    body = Body(flat_world, rival.spec, nominal_truth(rival.spec), footing=Footing.hard(0.7))
    bullet, client = flat_world.bullet, flat_world.client
    names = {bullet.getJointInfo(body.robot, i, physicsClientId=client)[12].decode(): i for i in body._names}
    assert rival.model.nbody == len(names) + 2  # world and hex
    for name, index in {"hex": -1, **names}.items():
        mass = bullet.getDynamicsInfo(body.robot, index, physicsClientId=client)[0]
        assert mass == pytest.approx(float(rival.model.body(name).mass[0]), rel=RELATIVE), name
    assert body.mass == pytest.approx(rival.model.body_mass.sum(), rel=RELATIVE)


def test_gravity_torques_of_the_drawings(rival):
    kin, order = kinematics(rival.spec.name), leg_names(rival)
    for joints, world_from_hex in configurations(rival):
        rival.place(world_from_hex, dict(zip(order, joints.ravel(), strict=True)))
        gravity = world_from_hex.inverse().rotate(np.array([0.0, 0.0, -GRAVITY]))
        ours = kin.gravity_torques(joints, gravity, np.zeros((6, 3)), np.zeros((6, 3)))
        assert_same(ours.ravel(), rival.data.qfrc_bias[rival.dofs(order)])


def test_centre_of_mass_of_the_drawings(rival):
    kin, order = kinematics(rival.spec.name), leg_names(rival)
    for joints, world_from_hex in configurations(rival):
        rival.place(world_from_hex, dict(zip(order, joints.ravel(), strict=True)))
        ours = world_from_hex.apply(kin.com_in_hex(joints))
        assert np.abs(ours - rival.data.subtree_com[0]).max() < RELATIVE  # m


def test_mass_matrix_that_the_servos_are_damped_by(rival):
    """Pinocchio's, on a free base: its rates of the base are in the base's frame, MuJoCo's linear ones in the world's."""
    text = (robot_dir(rival.spec.name) / "robot.urdf").read_text().replace('<joint name="', '<joint name="joint_')
    model = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
    places = {n: model.joints[model.getJointId(f"joint_{n}")] for n in rival.names}
    our_dofs = np.array([*range(6), *(places[n].idx_v for n in rival.names)])
    their_dofs = np.array([*range(6), *rival.dofs(rival.names)])
    data, rng = model.createData(), np.random.default_rng(8)
    for joints, world_from_hex in configurations(rival):
        angles = dict(zip(leg_names(rival), joints.ravel(), strict=True))
        angles |= {n: rng.uniform(-1.0, 1.0) for n in rival.names if n not in angles}  # wheels and docks
        rival.place(world_from_hex, angles)
        q = pin.neutral(model)
        q[:7] = [*world_from_hex.translation, *world_from_hex.quaternion_xyzw()]
        for name, angle in angles.items():
            place = places[name]
            q[place.idx_q : place.idx_q + place.nq] = angle if place.nq == 1 else (np.cos(angle), np.sin(angle))
        upper = np.triu(pin.crba(model, data, q))
        ours = (upper + np.triu(upper, 1).T)[np.ix_(our_dofs, our_dofs)]
        turn = np.eye(len(their_dofs))
        turn[:3, :3] = world_from_hex.rotation
        theirs = turn.T @ rival.mass_matrix()[np.ix_(their_dofs, their_dofs)] @ turn
        assert_same(ours, theirs)


def test_gravity_torques_and_mass_matrix_of_bullet(rival):
    """Bullet's own, of the URDF as the twin loads it, before the truth adds its armature."""
    import pybullet as b

    client = b.connect(b.DIRECT)
    try:
        robot = b.loadURDF(
            str(robot_dir(rival.spec.name) / "robot.urdf"),
            useFixedBase=True,
            flags=b.URDF_USE_INERTIA_FROM_FILE,
            physicsClientId=client,
        )
        b.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        infos = [b.getJointInfo(robot, i, physicsClientId=client) for i in range(b.getNumJoints(robot, client))]
        names = [info[1].decode() for info in infos if info[2] != b.JOINT_FIXED]
        still = [0.0] * len(names)
        dofs = rival.dofs(names)
        for joints, _ in configurations(rival):
            angles = dict(zip(leg_names(rival), joints.ravel(), strict=True))
            rival.place(SE3.identity(), angles)
            q = [float(angles.get(n, 0.0)) for n in names]
            torques = np.array(b.calculateInverseDynamics(robot, q, still, still, physicsClientId=client))
            assert_same(torques, rival.data.qfrc_bias[dofs])
            matrix = np.array(b.calculateMassMatrix(robot, q, physicsClientId=client))
            assert_same(matrix, rival.mass_matrix()[np.ix_(dofs, dofs)])
    finally:
        b.disconnect(client)


@pytest.mark.parametrize("lifted", [(0, 2, 4), (1, 3, 5)])
@pytest.mark.slow
def test_three_wheels_carry_what_mujocos_masses_say(rival, flat_world, lifted):
    """Statically determinate: whatever tyres, docks and joints do, the weight's moments give the loads."""
    spec = rival.spec
    aside = np.array([0.24, -0.14, 0.0])  # the chassis off the wheels' middle, so that no two loads are equal
    wheels = stance_wheels_in_hex(spec) + aside
    planted, reaches = all_legs_ik(spec, wheels)
    wheels[list(lifted), 2] += 0.30
    joints, reaches_up = all_legs_ik(spec, wheels)
    assert reaches.all()
    assert reaches_up.all()
    body = Body(flat_world, spec, nominal_truth(spec), footing=Footing.hard(0.7))
    body.place(SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height - 0.06])), planted)
    limits = np.full(joints.shape, 0.2)
    for tick in range(9600):
        body.step(joints, limits)
        if tick > 1200 and tick % 60 == 0 and settled(body):
            break
    standing = np.setdiff1d(np.arange(6), lifted)
    assert not body.tyre.loads[list(lifted)].any()
    assert not body.hull_contacts()

    loads, patches = np.zeros(6), body.tyre.patches_in_world[standing]
    forces = np.zeros((6, 3))
    for _ in range(240):  # a second of what is left of the bounce
        body.step(joints, limits)
        loads += body.tyre.loads / 240
        forces += body.tyre.forces_in_world / 240

    angles = dict(zip(leg_names(rival), body.joints.ravel(), strict=True))
    docks = [n for n in rival.names if n.startswith("dock")]
    angles |= dict(zip(docks, _dock_angles(body, docks), strict=True))
    rival.place(body.world_from_hex(), angles)
    com, weight = rival.data.subtree_com[0], rival.model.body_mass.sum() * GRAVITY
    # The patches' heights differ by millimetres, so that friction has next to no moment; it is counted all the same.
    arms = patches - com
    sideways = forces[standing]
    balance = np.array([np.ones(3), arms[:, 1], -arms[:, 0]])
    moments = np.array([weight, np.sum(arms[:, 2] * sideways[:, 1]), -np.sum(arms[:, 2] * sideways[:, 0])])
    expected = np.linalg.solve(balance, moments)
    assert np.ptp(expected) > 3.0 * LOAD * weight
    assert loads[standing] == pytest.approx(expected, rel=LOAD)


def _dock_angles(body: Body, names: list[str]) -> np.ndarray:
    """In the order of their names in the URDF, which is Bullet's."""
    bullet, client = body.world.bullet, body.world.client
    infos = [bullet.getJointInfo(body.robot, i, physicsClientId=client) for i in body._names]
    indices = {info[1].decode(): info[0] for info in infos}
    return np.array([bullet.getJointState(body.robot, indices[n], physicsClientId=client)[0] for n in names])


def test_a_turned_base_has_the_same_gravity_in_both(rival):
    """The quaternions of the two libraries are ordered differently: this would show a mix-up."""
    turn = Rotation.from_euler("xyz", [0.3, -0.2, 1.0])
    rival.place(SE3(turn.as_matrix(), np.zeros(3)), {})
    assert rival.data.xmat[rival.model.body("hex").id].reshape(3, 3) == pytest.approx(turn.as_matrix(), abs=1e-12)
