"""Verdicts on every cell of a map, held against Pinocchio, coal and the candidates' judgement one by one."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest

from athlete_twin.assets import robot_dir
from athlete_twin.errors import KinematicsError, SupportError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.leg_torques import leg_torques
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.model.statics import wheel_loads
from planner.footfall import FootfallConfig, score_footfalls
from planner.motion.collision import CollisionConfig, LegCollision
from planner.stability.ground_map import (
    COLLISION,
    GROUND,
    LAST_LINK,
    MARGIN,
    OK,
    TORQUE,
    UNKNOWN,
    UNREACHABLE,
    GroundMapConfig,
    ground_map,
    ground_maps,
)
from planner.stability.stability_map import StabilityConfig, stability_map
from planner.stability.stance_torque import peak_torques, zero_interaction

UP = np.array([0.0, 0.0, 1.0])


class Stand:
    """A robot in its normal stance over flat ground with one rock and one dark patch."""

    def __init__(self, robot, *, cell=0.2, tilt=0.0):
        self.spec = load_spec(robot)
        self.kin = Kinematics(self.spec)
        self.joints = regular_stance(self.spec)
        n = round(8.0 / cell) if robot == "sdm_b" else round(12.0 / cell)
        first = -0.5 * cell * (n - 1)
        heights = np.zeros((n, n))
        x = first + cell * np.arange(n)
        rock = np.hypot(x[:, None] - 2.4, x[None, :] - 0.2) < 0.3
        heights[rock] = 0.5
        heights[(np.abs(x[:, None] + 2.2) < 0.3) & (np.abs(x[None, :]) < 0.3)] = np.nan
        self.grid = HeightGrid(origin_x=first, origin_y=first, cell=cell, heights=heights)
        self.pose = SE3.from_rpy(0.0, tilt, 0.0, np.array([0.0, 0.0, self.spec.chassis_height - 0.05]))
        self.footfalls = score_footfalls(
            self.grid, np.full((n, n), 1e-4), wheel_radius=self.spec.wheel.radius, config=FootfallConfig()
        )

    def config(self, **changes):
        made = GroundMapConfig(stability=StabilityConfig(min_margin=self.spec.min_support_margin))
        return dataclasses.replace(made, **changes)

    def map(self, leg, **changes):
        footfalls = changes.pop("footfalls", self.footfalls)
        return ground_map(
            self.kin, self.joints, leg, terrain=self.grid, world_from_hex=self.pose, config=self.config(**changes), footfalls=footfalls
        )

    def places(self):
        x, y = self.grid.centres()
        return np.stack([*np.meshgrid(x, y, indexing="ij"), self.grid.heights], axis=-1).reshape(-1, 3)


@pytest.fixture(scope="module", params=["sdm_b", "t12"])
def stand(request):
    return Stand(request.param)


def test_reach_and_margins_are_those_of_the_candidates(stand):
    found = stand.map(0, collision=None, footfalls=None, max_torque_fraction=np.inf)
    judged = stability_map(
        stand.kin, stand.joints, leg=0, footfalls_in_world=stand.places(), world_from_hex=stand.pose,
        config=stand.config().stability, lift=stand.config().lift,
    )  # fmt: skip
    reached = ~np.isin(found.reason.ravel(), (UNKNOWN, UNREACHABLE, LAST_LINK))
    np.testing.assert_array_equal(reached, judged.reachable)
    np.testing.assert_array_equal(found.ok.ravel(), judged.ok)
    assert (found.reason == UNKNOWN).sum() == np.isnan(stand.grid.heights).sum() > 0
    assert sum(found.counts().values()) == found.reason.size


def test_joints_put_the_wheel_on_its_cell(stand):
    found = stand.map(3, collision=None)
    places = stand.places().reshape(*stand.grid.shape, 3)
    cells = np.argwhere(found.ok)
    assert len(cells) > 20
    for ix, iy in cells[::17]:
        wheel = stand.kin.leg_wheel(3, found.joints[ix, iy])
        np.testing.assert_allclose(stand.pose.apply(wheel.translation), places[ix, iy] + stand.spec.wheel.radius * UP, atol=1e-6)


def test_a_cell_only_a_leaning_last_link_reaches_is_told_from_one_out_of_reach(stand):
    found = stand.map(1, collision=None)
    rim = found.reason == LAST_LINK
    assert rim.any()
    hip = stand.pose.apply(stand.spec.hips_in_hex[1])[:2]
    distance = np.linalg.norm(stand.places()[:, :2] - hip, axis=1).reshape(rim.shape)
    reached = ~np.isin(found.reason, (UNKNOWN, UNREACHABLE, LAST_LINK))
    flat = stand.grid.heights == 0.0
    assert distance[rim & flat].max() > distance[reached & flat].max()


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_on_a_tilted_chassis_no_green_cells_last_link_leans_more_than_is_allowed(robot):
    stand = Stand(robot, tilt=np.deg2rad(14.0))
    spec = stand.spec
    last = np.asarray(spec.wheel.offset) / np.linalg.norm(spec.wheel.offset)

    def leans(found):
        cells = np.argwhere(np.isfinite(found.joints[..., 0]))[::11]
        turned = [stand.pose.rotate(stand.kin.leg_wheel(1, found.joints[ix, iy]).rotation @ last) for ix, iy in cells]
        return np.rad2deg(np.arccos(np.clip(-np.array(turned)[:, 2], -1.0, 1.0)))

    open_to_all, kept = stand.map(1, collision=None, max_lean_deg=90.0), stand.map(1, collision=None)
    assert leans(open_to_all).max() > 12.0
    assert leans(kept).max() <= 10.0 + 1e-6
    refused = open_to_all.ok & ~kept.ok
    assert refused.any() and (kept.reason[refused] == LAST_LINK).all()
    assert not (kept.ok & ~open_to_all.ok).any()


def test_collisions_are_coals(stand):
    found = stand.map(0)
    filled = HeightGrid(
        origin_x=stand.grid.origin_x, origin_y=stand.grid.origin_y, cell=stand.grid.cell,
        heights=np.nan_to_num(stand.grid.heights),
    )  # fmt: skip
    check = LegCollision(stand.spec, filled, stand.pose, stand.joints, 0, CollisionConfig())
    reached = np.argwhere(np.isfinite(found.joints[..., 0]) & ~np.isin(found.reason, (UNREACHABLE, LAST_LINK)))
    verdicts = [(found.reason[ix, iy] == COLLISION, check.is_free_near_ground(found.joints[ix, iy])) for ix, iy in reached]
    assert all(hit != free for hit, free in verdicts)
    assert {hit for hit, _ in verdicts} == {True, False}


def test_first_reason_wins_and_the_ground_comes_last(stand):
    free = stand.map(0, collision=None)
    assert (free.reason == GROUND).any()
    weak = stand.map(0, collision=None, max_torque_fraction=0.05)
    assert not (weak.reason == OK).any() and not (weak.reason == GROUND).any() and (weak.reason == TORQUE).any()
    shaky = stand.map(0, collision=None, max_torque_fraction=0.05, stability=StabilityConfig(min_margin=2.0))
    assert (shaky.reason == MARGIN).any() and not (shaky.reason == TORQUE).any()


def test_six_maps_are_the_six_legs(stand):
    config = stand.config(collision=None)
    maps = ground_maps(
        stand.kin, stand.joints, terrain=stand.grid, world_from_hex=stand.pose, config=config, footfalls=stand.footfalls
    )
    assert [m.leg for m in maps] == list(range(6))
    np.testing.assert_array_equal(maps[4].reason, stand.map(4, collision=None).reason)


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_torques_of_one_leg_are_pinocchios(robot):
    spec, kin = load_spec(robot), Kinematics(load_spec(robot))
    rng = np.random.default_rng(3)
    joints = rng.uniform(spec.lower, spec.upper, (6, spec.dof))
    forces, contacts, gravity = rng.normal(0.0, 2000.0, (6, 3)), rng.normal(0.0, 2.0, (6, 3)), np.array([0.8, -0.5, -9.7])
    expected = kin.gravity_torques(joints, gravity, forces, contacts)
    for leg in range(6):
        found = leg_torques(
            spec, leg, joints[[leg]], force_in_hex=forces[[leg]], contact_in_hex=contacts[[leg]], gravity_in_hex=gravity
        )
        np.testing.assert_allclose(found[0], expected[leg], atol=1e-6)  # Pinocchio's URDF rounds angles to 1e-9


def test_forces_of_many_stances_are_those_of_each():
    rng = np.random.default_rng(4)
    contacts = rng.normal(0.0, 1.0, (20, 5, 3)) * [2.0, 2.0, 0.2]
    com, down = rng.normal(0.0, 0.2, (20, 3)) + UP, np.array([0.1, 0.0, -1.0])
    down /= np.linalg.norm(down)
    found = zero_interaction(contacts, com, weight=8000.0, down=down)
    for k in range(20):
        expected = wheel_loads(contacts[k], com[k], weight=8000.0, gravity_direction=down)
        np.testing.assert_allclose(found[k], expected, atol=1e-5)


class Afloat:
    """The whole robot on a free-flying base, built in this test: Pinocchio weighs it, and nothing of the planner's is asked."""

    def __init__(self, spec):
        text = (robot_dir(spec.name) / "robot.urdf").read_text().replace('<joint name="', '<joint name="joint_')
        whole = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
        held = [whole.getJointId(n) for n in whole.names if n.startswith(("joint_wheel", "joint_dock"))]
        self.spec, self.model = spec, pin.buildReducedModel(whole, held, pin.neutral(whole))
        self.data = self.model.createData()

    def peak(self, pose, joints, standing):
        """Largest torque over its limit when the standing wheels share the weight with the least forces that balance it."""
        q, rows = pin.neutral(self.model), np.empty((6, self.spec.dof), dtype=int)
        q[:7] = pin.SE3ToXYZQUAT(pin.SE3(pose.rotation, pose.translation))
        for leg in range(6):
            for place, name in enumerate(self.spec.joint_names):
                joint = self.model.joints[self.model.getJointId(f"joint_leg{leg + 1}_{name}")]
                q[joint.idx_q], rows[leg, place] = joints[leg, place], joint.idx_v
        gravity = pin.rnea(self.model, self.data, q, np.zeros(self.model.nv), np.zeros(self.model.nv))
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        patches = []
        for leg in np.flatnonzero(standing):
            frame = self.model.getFrameId(f"wheel{leg + 1}", pin.FrameType.BODY)
            moves = pin.getFrameJacobian(self.model, self.data, frame, pin.LOCAL_WORLD_ALIGNED)
            arm = -self.spec.wheel.radius * UP
            patches.append(moves[:3] - np.cross(arm, moves[3:].T).T)  # velocity of the point under the axle
        patches = np.concatenate(patches)
        forces = np.linalg.lstsq(patches[:, :6].T, gravity[:6], rcond=1e-9)[0]  # the base is held by the ground alone
        return np.abs((gravity - patches.T @ forces)[rows] / self.spec.torque_limits).max()


@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_peak_torque_is_that_of_the_leg_in_the_air_above_its_place_and_of_the_leg_on_it(robot, tilt):
    stand = Stand(robot, tilt=tilt)
    found = stand.map(2, collision=None, footfalls=None, max_torque_fraction=np.inf)
    cells = np.argwhere(found.ok)[::7]
    q = np.array([found.joints[ix, iy] for ix, iy in cells])
    places = np.array([stand.places().reshape(*stand.grid.shape, 3)[ix, iy] for ix, iy in cells])
    above = places + (stand.spec.wheel.radius + 0.5) * UP
    down = stand.pose.inverse().rotate(-UP)
    lifted, there = leg_ik(stand.spec, 2, stand.pose.inverse().apply(above), last_link_in_hex=down)
    q, places, lifted = q[there], places[there], lifted[there]
    assert len(q) > 5
    by_pinocchio = Afloat(stand.spec)
    air, ground, as_landed = np.empty(len(q)), np.empty(len(q)), np.empty(len(q))
    for k in range(len(q)):
        joints = stand.joints.copy()
        joints[2] = q[k]
        ground[k] = by_pinocchio.peak(stand.pose, joints, np.ones(6, dtype=bool))
        as_landed[k] = by_pinocchio.peak(stand.pose, joints, np.arange(6) != 2)
        joints[2] = lifted[k]
        air[k] = by_pinocchio.peak(stand.pose, joints, np.arange(6) != 2)
    peaks = peak_torques(stand.kin, stand.joints, 2, q, lifted=lifted, places=places, world_from_hex=stand.pose)
    assert peaks == pytest.approx(np.maximum(air, ground), rel=1e-5)
    assert np.abs(air - as_landed).max() > 1e-3  # it does matter where the leg hangs
    just_off = peak_torques(stand.kin, stand.joints, 2, q, places=places, world_from_hex=stand.pose)
    assert just_off == pytest.approx(np.maximum(as_landed, ground), rel=1e-5)


def test_the_map_judges_the_torque_of_the_leg_lifted_above_each_cell(stand):
    found = stand.map(2, collision=None, footfalls=None, max_torque_fraction=np.inf, lift=0.5)
    cells, by_pinocchio = np.argwhere(found.ok)[::7], Afloat(stand.spec)
    places, peaks = stand.places().reshape(*stand.grid.shape, 3), []
    for ix, iy in cells:
        wheel = stand.pose.inverse().apply(places[ix, iy] + (stand.spec.wheel.radius + 0.5) * UP)
        lifted, there = leg_ik(stand.spec, 2, wheel[None], last_link_in_hex=stand.pose.inverse().rotate(-UP))
        assert there[0]
        each = []
        for angles, standing in ((lifted[0], np.arange(6) != 2), (found.joints[ix, iy], np.ones(6, dtype=bool))):
            joints = stand.joints.copy()
            joints[2] = angles
            each.append(by_pinocchio.peak(stand.pose, joints, standing))
        peaks.append(max(each))
    for limit in np.quantile(peaks, [0.2, 0.5, 0.8]):
        judged = stand.map(2, collision=None, footfalls=None, max_torque_fraction=float(limit) * (1.0 + 1e-6), lift=0.5)
        for (ix, iy), peak in zip(cells, peaks, strict=True):
            assert (judged.reason[ix, iy] == OK) == (peak <= limit)


def test_five_wheels_on_one_line_are_refused_by_name(stand, monkeypatch):
    monkeypatch.setattr(stand.kin, "wheels_in_hex", lambda joints: np.outer(np.arange(6.0), [1.0, 0.0, 0.0]))
    with pytest.raises(SupportError, match="5 wheels on one line"):
        peak_torques(stand.kin, stand.joints, 0, stand.joints[:1], places=np.array([[0.0, 3.0, 0.0]]), world_from_hex=stand.pose)


def test_wrong_use_is_refused(stand):
    with pytest.raises(SupportError, match="leg index 6"):
        stand.map(6)
    with pytest.raises(SupportError, match=r"lift is -0\.1 m"):
        stand.config(lift=-0.1)
    with pytest.raises(SupportError, match=r"max_torque_fraction is 0\.0"):
        stand.config(max_torque_fraction=0.0)
    with pytest.raises(SupportError, match=r"lifted angles have shape \(1, .\), the landed ones \(2, .\)"):
        two = stand.joints[:2]
        peak_torques(stand.kin, stand.joints, 0, two, lifted=two[:1], places=np.zeros((2, 3)), world_from_hex=stand.pose)
    with pytest.raises(SupportError, match=r"max_lean_deg is 0\.0 deg"):
        stand.config(max_lean_deg=0.0)
    with pytest.raises(SupportError, match="between 0 and 90"):
        stand.config(tilts_deg=(95.0,))
    with pytest.raises(KinematicsError, match=r"payload is -1\.0 kg"):
        ground_map(
            stand.kin, stand.joints, 0, terrain=stand.grid, world_from_hex=stand.pose, config=stand.config(), payload_kg=-1.0
        )
    other = Stand(stand.spec.name, cell=0.5)
    with pytest.raises(SupportError, match="footfall scores have shape"):
        stand.map(0, footfalls=other.footfalls)
