"""Verdicts on every cell of a map, held against Pinocchio, coal's distances, scipy's hulls and a search for angles."""

import dataclasses
import importlib.util
import re
from pathlib import Path

import coal
import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial import ConvexHull

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
from planner.motion.collision import ClearanceTable, CollisionConfig
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
from planner.stability.stability_map import StabilityConfig
from planner.stability.stance_torque import peak_torques, zero_interaction

SEARCH = importlib.util.spec_from_file_location("stability_oracle", Path(__file__).parents[3] / "scripts" / "stability_oracle.py")
oracle = importlib.util.module_from_spec(SEARCH)
SEARCH.loader.exec_module(oracle)
UP = np.array([0.0, 0.0, 1.0])
MILLIMETRE = 1e-3


class Stand:
    """A robot in its normal stance over flat ground with one rock and one dark patch."""

    def __init__(self, robot, *, cell=0.2, tilt=0.0, rock_height=0.5):
        self.spec = load_spec(robot)
        self.kin = Kinematics(self.spec)
        self.joints = regular_stance(self.spec)
        n = round(8.0 / cell) if robot == "sdm_b" else round(12.0 / cell)
        first = -0.5 * cell * (n - 1)
        heights = np.zeros((n, n))
        x = first + cell * np.arange(n)
        rock = np.hypot(x[:, None] - 2.4, x[None, :] - 0.2) < 0.3
        heights[rock] = rock_height
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


def hull_distance(point, corners):
    """Of a point to the border of a hull in plan view, positive inside; by scipy."""
    return float(-np.max(ConvexHull(corners).equations @ np.append(point, 1.0)))


@pytest.mark.slow
def test_reached_cells_are_reached_and_few_denied_ones_are_found_by_search(stand):
    """A claim is proven by Pinocchio's forward kinematics, the leg's limits and a plumb last link; a denial is held against a search."""
    found = stand.map(0, collision=None, footfalls=None, max_torque_fraction=np.inf)
    assert (found.reason == UNKNOWN).sum() == np.isnan(stand.grid.heights).sum() > 0
    assert sum(found.counts().values()) == found.reason.size
    spec, lift = stand.spec, stand.config().lift
    places, hex_from_world = stand.places().reshape(*stand.grid.shape, 3), stand.pose.inverse()
    down, last = hex_from_world.rotate(-UP), np.asarray(spec.wheel.offset) / np.linalg.norm(spec.wheel.offset)
    reached = np.argwhere(~np.isin(found.reason, (UNKNOWN, UNREACHABLE, LAST_LINK)))
    assert len(reached) > 100
    for ix, iy in reached[::7]:
        angles = found.joints[ix, iy]
        assert (angles >= spec.lower - 1e-9).all() and (angles <= spec.upper + 1e-9).all()
        wheel = stand.kin.leg_wheel(0, angles)
        np.testing.assert_allclose(stand.pose.apply(wheel.translation), places[ix, iy] + spec.wheel.radius * UP, atol=1e-6)
        np.testing.assert_allclose(wheel.rotation @ last, down, atol=1e-6)
    rng = np.random.default_rng(5)

    def searched(ix, iy, starts):
        wheels = [hex_from_world.apply(places[ix, iy] + (spec.wheel.radius + up) * UP) for up in (0.0, lift)]
        return all(oracle.reaches(stand.kin, 0, wheel, down, rng=rng, starts=starts) for wheel in wheels)

    assert all(searched(ix, iy, 150) for ix, iy in rng.permutation(reached)[:8])  # above the cell too
    rim = np.argwhere(np.isin(found.reason, (UNREACHABLE, LAST_LINK)))
    hip = stand.pose.apply(spec.hips_in_hex[0])[:2]
    far = sum(float(np.linalg.norm(joint.offset)) for joint in spec.joints)
    rim = rim[np.linalg.norm(places[rim[:, 0], rim[:, 1], :2] - hip, axis=1) < far]
    assert len(rim) > 30
    missed = sum(searched(ix, iy, 12) for ix, iy in rim)
    assert missed <= 0.03 * (len(reached) + missed)  # a search is content within 2 mm and 0.2 deg, and may use the rolls


def test_margins_are_those_of_another_library_s_hulls(stand):
    least = {"sdm_b": 0.55, "t12": 0.75}[stand.spec.name]  # between the margins that occur
    found = stand.map(0, collision=None, footfalls=None, max_torque_fraction=np.inf, stability=StabilityConfig(min_margin=least))
    places = stand.places().reshape(*stand.grid.shape, 3)
    cells = np.argwhere(np.isin(found.reason, (OK, MARGIN)))[::5]
    seen = {OK: 0, MARGIN: 0}
    for ix, iy in cells:
        joints, margins = stand.joints.copy(), []
        for up in (0.0, stand.config().lift):
            wheel = stand.pose.inverse().apply(places[ix, iy] + (stand.spec.wheel.radius + up) * UP)
            joints[0] = leg_ik(stand.spec, 0, wheel[None], last_link_in_hex=stand.pose.inverse().rotate(-UP))[0][0]
            com = stand.pose.apply(stand.kin.com_in_hex(joints))[:2]
            contacts = stand.pose.apply(stand.kin.wheels_in_hex(joints))[:, :2]
            removed = [0] if up else range(6)  # in the air only this wheel is missing; with all down any one may fail
            margins += [hull_distance(com, np.delete(contacts, leg, axis=0)) for leg in removed]
        seen[int(found.reason[ix, iy])] += 1
        assert (found.reason[ix, iy] == OK) == (min(margins) >= least)
    assert min(seen.values()) > 5


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


BY_HAND = CollisionConfig(table=ClearanceTable(same_leg=(0.02, 0.03), body=0.04, other_leg=0.06))


class Solids:
    """The solids of the drawn robot from its URDF, and how far those of one leg are from what they must not touch, by coal."""

    def __init__(self, stand, leg):
        self.stand, self.leg, self.spec, self.config = stand, leg, stand.spec, BY_HAND
        urdf = str(robot_dir(self.spec.name) / "robot.urdf")
        self.model = pin.buildModelFromUrdf(urdf)
        self.geometry = pin.buildGeomFromUrdf(self.model, urdf, pin.COLLISION)
        self.solids = self.geometry.geometryObjects
        self.state, self.scratch = self.geometry.createData(), self.model.createData()
        self.part = [self._part(str(o.name)) for o in self.solids]
        mine = [i for i, (owner, _) in enumerate(self.part) if owner == leg]
        pairs = [(i, j, self._clearance(i, j)) for i in mine for j in range(len(self.solids)) if j not in mine or j > i]
        # What is close by construction is no collision: it is as close in the stance of the drawings.
        drawn = self._distances(regular_stance(self.spec), [(i, j) for i, j, _ in pairs])
        self.pairs = [(i, j, c) for (i, j, c), d in zip(pairs, drawn, strict=True) if c is not None and d > c]
        self.grounded = [i for i in mine if 0 < self.part[i][1] < self.spec.dof]
        self.ground = [self._surface(diagonal) for diagonal in (0, 1)]

    def least(self, angles):
        """Least distance over what is asked for, of all pairs, for either way of cutting the ground's squares, shape (2,) [m]."""
        joints = self.stand.joints.copy()
        joints[self.leg] = angles
        own = self._distances(joints, [(i, j) for i, j, _ in self.pairs])
        apart = min(d - c for d, (_, _, c) in zip(own, self.pairs, strict=True))
        world = pin.SE3(self.stand.pose.rotation, self.stand.pose.translation)
        over = []
        for surface in self.ground:
            each = [self._distance(self.solids[i].geometry, world * self.state.oMg[i], surface, pin.SE3.Identity()) for i in self.grounded]
            over.append(min(each) - self.config.near_ground_clearance)
        return np.minimum(apart, over)

    def _part(self, name):
        """Leg and place of a link along it, 0 for the hip's housing; the chassis is leg -1."""
        leg = re.match(r"(?:leg|wheel)(\d)(?:_([a-z_]+?))?(?:_\d+)?$", name)
        if leg is None:
            return -1, -1
        return int(leg[1]) - 1, self.spec.joint_names.index(leg[2]) if leg[2] else self.spec.dof

    def _clearance(self, i, j):
        (a, first), (b, second) = self.part[i], self.part[j]
        if b < 0:
            return None if first == 0 else self.config.table.body
        if a == b:
            links = [*(joint.offset for joint in self.spec.joints[1:]), np.zeros(3)]
            pivots = sum(bool(np.any(offset)) for offset in links[min(first, second) : max(first, second)])
            table = self.config.table.same_leg
            return None if pivots < 2 else table[min(pivots, len(table) + 1) - 2]
        return self.config.table.other_leg

    def _distances(self, joints, pairs):
        q = pin.neutral(self.model)
        for leg in range(6):
            for place, name in enumerate(self.spec.joint_names):
                q[self.model.joints[self.model.getJointId(f"leg{leg + 1}_{name}")].idx_q] = joints[leg, place]
        pin.updateGeometryPlacements(self.model, self.scratch, self.geometry, self.state, q)
        placed = self.state.oMg
        return [self._distance(self.solids[i].geometry, placed[i], self.solids[j].geometry, placed[j]) for i, j in pairs]

    def _distance(self, one, one_at, other, other_at):
        transforms = (coal.Transform3s(m.rotation, m.translation) for m in (one_at, other_at))
        return coal.distance(one, next(transforms), other, next(transforms), coal.DistanceRequest(), coal.DistanceResult())

    def _surface(self, diagonal):
        """The ground as triangles; unknown ground is flat in this test."""
        grid = self.stand.grid
        (nx, ny), (x, y) = grid.shape, grid.centres()
        heights = np.nan_to_num(grid.heights)
        surface = coal.BVHModelOBBRSS()
        surface.beginModel(2 * nx * ny, nx * ny)
        surface.addVertices(np.stack([*np.meshgrid(x, y, indexing="ij"), heights], axis=-1).reshape(-1, 3))
        triangles = []
        for i in range(nx - 1):
            for j in range(ny - 1):
                a, b, c, d = i * ny + j, (i + 1) * ny + j, (i + 1) * ny + j + 1, i * ny + j + 1
                triangles += [(a, b, c), (a, c, d)] if diagonal else [(a, b, d), (b, c, d)]
        surface.addTriangles(np.array(triangles))
        surface.endModel()
        return surface


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.slow
@pytest.mark.ci
def test_collisions_are_where_coal_s_distances_are_too_small(robot):
    stand = Stand(robot, rock_height=1.2)  # as high as a leg's links, so that they meet ground as well as robot
    found, solids = stand.map(0, collision=BY_HAND), Solids(stand, 0)
    reached = np.argwhere(np.isfinite(found.joints[..., 0]) & ~np.isin(found.reason, (UNREACHABLE, LAST_LINK)))
    seen = {"hit": 0, "free": 0, "close": 0}
    for ix, iy in reached[::3]:
        over = solids.least(found.joints[ix, iy])
        if over.max() < -MILLIMETRE:
            seen["hit"] += 1
            assert found.reason[ix, iy] == COLLISION
        elif over.min() > MILLIMETRE:
            seen["free"] += 1
            assert found.reason[ix, iy] != COLLISION
        else:
            seen["close"] += 1
    assert min(seen["hit"], seen["free"]) > 10
    assert seen["close"] < 0.1 * sum(seen.values())


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
