from __future__ import annotations

import numpy as np
import pinocchio
import pybullet
import pytest

from athlete_twin.assets import robot_dir, robot_names
from athlete_twin.model.link_solids import MIN_INERTIA, box_inertia, inertias, tube_inertia
from athlete_twin.model.spec import load_spec

POSITION_TOLERANCE = 1e-6  # m
CONFIGURATIONS = 1000


@pytest.fixture(params=robot_names())
def robot(request):
    return request.param


@pytest.fixture
def bullet(robot):
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    body = pybullet.loadURDF(
        str(robot_dir(robot) / "robot.urdf"), useFixedBase=True, flags=flags, physicsClientId=client
    )
    yield client, body
    pybullet.disconnect(client)


def test_both_libraries_put_every_link_at_the_same_place(robot, bullet):
    client, body = bullet
    model = pinocchio.buildModelFromUrdf(str(robot_dir(robot) / "robot.urdf"))
    data = model.createData()
    joints = [
        pybullet.getJointInfo(body, j, physicsClientId=client) for j in range(pybullet.getNumJoints(body, client))
    ]
    names = [info[1].decode() for info in joints]
    frames = [model.getFrameId(info[12].decode(), pinocchio.FrameType.BODY) for info in joints]
    # Bullet's world is at the base's centre of mass, Pinocchio's at the base link's frame.
    base = np.array(pybullet.getBasePositionAndOrientation(body, client)[0]) - load_spec(robot).body_com
    rng = np.random.default_rng(0)
    for _ in range(CONFIGURATIONS):
        angles = rng.uniform([info[8] for info in joints], [max(i[9], i[8] + 1.0) for i in joints])
        q = pinocchio.neutral(model)
        for name, angle in zip(names, angles, strict=True):
            joint = model.joints[model.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = angle if joint.nq == 1 else (np.cos(angle), np.sin(angle))
        pinocchio.framesForwardKinematics(model, data, q)
        ours = np.array([data.oMf[f].translation for f in frames])
        pybullet.resetJointStatesMultiDof(body, range(len(joints)), [[a] for a in angles], physicsClientId=client)
        states = pybullet.getLinkStates(body, range(len(joints)), computeForwardKinematics=1, physicsClientId=client)
        theirs = np.array([s[4] for s in states]) - base
        assert np.abs(ours - theirs).max() < POSITION_TOLERANCE


def test_mass_and_centre_of_mass_are_as_drawn(robot):
    spec = load_spec(robot)
    model = pinocchio.buildModelFromUrdf(str(robot_dir(robot) / "robot.urdf"))
    # Pinocchio files the fixed base under the universe, which a total over joints leaves out.
    mass = pinocchio.computeTotalMass(model) + model.inertias[0].mass
    assert mass == pytest.approx(spec.mass, abs=1e-6)
    moment = spec.body_mass * spec.body_com + sum(d.mass * d.part.centre for d in spec.decks)
    for azimuth, hip in zip(spec.hip_azimuths, spec.hips_in_hex, strict=True):
        outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        place = np.zeros(3)
        for joint in spec.joints:
            place = place + joint.offset
            com = place + joint.link_com
            moment = moment + joint.link_mass * (hip + com[0] * outward + [0, 0, com[2]])
        place = place + spec.wheel.offset
        moment = moment + spec.wheel.mass * (hip + place[0] * outward + [0, 0, place[2]])
    data = model.createData()
    com = pinocchio.centerOfMass(model, data, pinocchio.neutral(model)) * pinocchio.computeTotalMass(model)
    com = (com + model.inertias[0].mass * model.inertias[0].lever) / mass
    assert com == pytest.approx(moment / spec.mass, abs=1e-9)


def test_axles_of_the_zero_pose_lie_straight_out_along_the_azimuths(robot):
    spec = load_spec(robot)
    model = pinocchio.buildModelFromUrdf(str(robot_dir(robot) / "robot.urdf"))
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, pinocchio.neutral(model))
    reach = sum(j.offset for j in spec.joints) + spec.wheel.offset
    for leg in range(6):
        azimuth = spec.hip_azimuths[leg]
        expected = spec.hips_in_hex[leg] + [reach[0] * np.cos(azimuth), reach[0] * np.sin(azimuth), reach[2]]
        assert data.oMf[model.getFrameId(f"wheel{leg + 1}", pinocchio.FrameType.BODY)].translation == pytest.approx(
            expected, abs=1e-9
        )


def test_limits_reach_bullet_as_drawn(robot, bullet):
    client, body = bullet
    spec = load_spec(robot)
    infos = {}
    for j in range(pybullet.getNumJoints(body, client)):
        info = pybullet.getJointInfo(body, j, physicsClientId=client)
        infos[info[1].decode()] = info
        assert info[1] == info[12] or info[1].startswith(b"dock_")
    for leg in range(1, 7):
        for joint in spec.joints:
            info = infos[f"leg{leg}_{joint.name}"]
            assert info[8:12] == pytest.approx((joint.lower, joint.upper, joint.torque, spec.speed_unloaded))
            assert info[13] == pytest.approx(tuple(joint.axis))
    docks = sorted(n for n in infos if n.startswith("dock"))
    sides = [d.name.removeprefix("deck_") for d in spec.decks]
    assert docks == sorted(f"dock_{s}_{a}" for s in sides for a in ("bend", "twist"))
    assert len(infos) == 6 * (spec.dof + 1) + len(docks)


def test_no_capsules_and_no_long_lines(robot):
    text = (robot_dir(robot) / "robot.urdf").read_text()
    assert "capsule" not in text
    assert max(len(line) for line in text.splitlines()) < 1000


def test_inertias_are_of_real_bodies(robot):
    for kind, moments in inertias(load_spec(robot)).items():
        assert moments.min() >= MIN_INERTIA, kind
        assert 2 * moments.max() <= moments.sum() + 1e-12, kind  # triangle inequality


def test_inertia_formulas_agree_with_sums_over_points():
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.5, 0.5, (400_000, 3)) * [2.0, 0.5, 0.3]
    sampled = (np.square(points).sum(axis=1)[:, None] - np.square(points)).mean(axis=0) * 7.0
    assert sampled == pytest.approx(box_inertia(7.0, np.array([2.0, 0.5, 0.3])), rel=0.01)
    angle, x = rng.uniform(0, 2 * np.pi, 400_000), rng.uniform(-0.4, 0.4, 400_000)
    points = np.column_stack([x, 0.1 * np.cos(angle), 0.1 * np.sin(angle)])
    sampled = (np.square(points).sum(axis=1)[:, None] - np.square(points)).mean(axis=0) * 5.0
    assert sampled == pytest.approx(tube_inertia(5.0, 0.1, 0.8), rel=0.01)
