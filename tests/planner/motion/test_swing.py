import itertools
from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.leg_timing import leg_timing
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from planner.motion.collision import CollisionConfig, LegCollision
from planner.motion.sbl import NoPath, SblConfig
from planner.motion.swing import SwingConfig, SwingPath, plan_swing

ROBOTS = ("sdm_b", "t12")
CELL = 0.05
LIFT = 0.2
LEG = 0


class Step:
    """Leg 1 steps along its tangent by 2 x half over what may stand between.

    `height(along, out)` is given by the distance along the step from its middle, and outward from the axles.
    """

    def __init__(self, robot: str, height=lambda along, out: 0.0 * along, *, half: float = 0.3) -> None:
        self.spec, self.kin = load_spec(robot), kinematics(robot)
        self.middle = stance_wheels_in_hex(self.spec)[LEG]
        azimuth = self.spec.hip_azimuths[LEG]
        outward, tangent = np.array([np.cos(azimuth), np.sin(azimuth)]), np.array([-np.sin(azimuth), np.cos(azimuth)])
        xy = np.stack(np.meshgrid(-6 + CELL * np.arange(241), -6 + CELL * np.arange(241), indexing="ij"), axis=-1)
        along, out = (xy - self.middle[:2]) @ tangent, (xy - self.middle[:2]) @ outward
        heights = HeightGrid(origin_x=-6.0, origin_y=-6.0, cell=CELL, heights=np.asarray(height(along, out), dtype=float))
        self.pose = SE3.from_translation(np.array([0.0, 0.0, self.spec.chassis_height]))
        joints = regular_stance(self.spec)
        stride, up = half * np.append(tangent, 0.0), np.array([0.0, 0.0, LIFT])
        self.start, self.lift = self.ik(self.middle - stride), self.ik(self.middle - stride + up)
        self.goal, self.touchdown = self.ik(self.middle + stride), self.ik(self.middle + stride + up)
        joints[LEG] = self.start
        self.collision = LegCollision(self.spec, heights, self.pose, joints, LEG, CollisionConfig())

    def ik(self, wheel):
        q, ok = leg_ik(self.spec, LEG, wheel[None])
        assert ok.all()
        return q[0]

    def plan(self, *, planner="sbl", seed=0, config=None, **changes):
        arguments = {"lift_waypoint_q": self.lift, "touchdown_waypoint_q": self.touchdown} | changes
        q_start = arguments.pop("q_start", self.start)
        return plan_swing(
            self.collision,
            self.spec,
            q_start,
            self.goal,
            planner=planner,
            rng=np.random.default_rng(seed),
            config=SwingConfig() if config is None else config,
            **arguments,
        )


def low_wall(along, out):
    """0.6 m across the straight line, between both footfalls."""
    return np.where((np.abs(along) < 0.08) & (out > -0.3), 0.6, 0.0)


def beside_rock(robot: str, height: float = 0.32) -> Step:
    """Tyre and fork touch the flank of a rock behind the start."""
    spec, yaw = load_spec(robot), Step(robot).start[0]
    extent = spec.wheel.radius * abs(np.sin(yaw)) + 0.5 * spec.wheel.width * np.cos(yaw)
    return Step(robot, lambda along, out: np.where(along < -0.3 - extent + 0.02, height, 0.0))


def assert_holds(path: SwingPath, step: Step) -> None:
    kin = step.kin
    np.testing.assert_array_equal(path.lift[0], step.start)
    np.testing.assert_array_equal(path.lift[-1], step.lift)
    np.testing.assert_array_equal(path.waypoints[[0, -1]], [step.lift, step.touchdown])
    np.testing.assert_array_equal(path.descent[0], step.touchdown)
    np.testing.assert_array_equal(path.descent[-1], step.goal)
    for straight in (path.lift, path.descent):
        wheels = np.array([kin.leg_wheel(LEG, q).translation for q in straight])
        np.testing.assert_allclose(wheels[:, :2], np.broadcast_to(wheels[0, :2], wheels[:, :2].shape), atol=1e-6)
    whole = np.concatenate([path.lift, path.waypoints, path.descent])
    assert (whole >= step.spec.lower).all() and (whole <= step.spec.upper).all()
    rolls = [i for i, j in enumerate(step.spec.joints) if j.axis[0] == 1.0]
    assert np.abs(whole[:, rolls]).max() <= np.deg2rad(5.0) + 1e-9
    climbed = path.stats.raised_by > 0.0
    for a, b in itertools.pairwise(path.waypoints):
        for s in np.linspace(0, 1, 2 + int(np.linalg.norm(b - a) / 0.01)):
            q = a + s * (b - a)
            # Between the samples of 0.01 rad a clearance may be undershot by what the leg moves in half of that.
            assert step.collision.is_free(q) or climbed or step.collision.is_free_near_ground(q)


@pytest.mark.parametrize("robot", ROBOTS)
def test_on_flat_ground_the_leg_goes_straight_across(robot):
    step = Step(robot)
    path = step.plan()
    assert isinstance(path, SwingPath), path
    assert path.stats.method == "direct" and path.stats.raised_by == 0.0 and len(path.waypoints) == 2
    assert_holds(path, step)
    assert path.lengths[1] == pytest.approx(np.linalg.norm(step.touchdown - step.lift))


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.slow
@pytest.mark.ci
def test_over_a_wall_the_leg_is_raised(robot):
    step = Step(robot, low_wall, half=0.5)
    path = step.plan()
    assert isinstance(path, SwingPath), path
    assert path.stats.method == "raised"
    assert_holds(path, step)
    # What is driven: the corners cut, looked at as finely as the planner looks.
    assert path.corner_tolerance > 0.0
    driven = leg_timing(step.spec, path.waypoints, corner_tolerance=path.corner_tolerance)
    places = np.linspace(0.0, driven.path.length, 2 + int(driven.path.length / 0.002))
    assert all(step.collision.is_free(q) for q in driven.path.at(places))
    highest = max(step.kin.leg_wheel(LEG, q).translation[2] for q in path.waypoints) - step.middle[2]
    assert highest > 0.6 - step.spec.wheel.radius


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.slow
def test_without_raised_points_the_sampling_planner_finds_the_way_and_repeats_it(robot):
    step = Step(robot, low_wall, half=0.5)
    config = SwingConfig(extra_heights=(0.0,))
    first, again, other = (step.plan(seed=s, config=config) for s in (1, 1, 2))
    assert isinstance(first, SwingPath), first
    assert first.stats.method == "sbl"
    np.testing.assert_array_equal(first.waypoints, again.waypoints)
    assert first.waypoints.shape != other.waypoints.shape or (first.waypoints != other.waypoints).any()
    assert first.lengths[1] <= first.stats.raw_length
    assert_holds(first, step)


@pytest.mark.slow
@pytest.mark.ci
def test_other_planners_serve_as_well():
    step = Step("sdm_b", low_wall, half=0.5)
    path = step.plan(planner="rrtconnect", config=SwingConfig(extra_heights=(0.0,)))
    assert isinstance(path, SwingPath) and path.stats.method == "rrtconnect"
    assert_holds(path, step)


@pytest.mark.parametrize("robot", ROBOTS)
def test_beside_a_rock_the_leg_climbs_before_it_crosses(robot):
    step = beside_rock(robot)
    path = step.plan()
    assert isinstance(path, SwingPath), path
    assert path.stats.raised_by > 0.0
    wheels = np.array([step.kin.leg_wheel(LEG, q).translation for q in path.waypoints])
    assert wheels[1, 2] > wheels[0, 2]
    assert_holds(path, step)


def test_each_refusal_names_its_check():
    step = Step("sdm_b")
    refusal = step.plan(lift_waypoint_q=np.zeros(6))
    assert isinstance(refusal, NoPath) and refusal.reason == "lift_unreachable" and "cannot put its wheel" in refusal.detail
    rolled = step.start + np.array([0, 0, 0, 0.2, 0, 0])
    assert step.plan(q_start=rolled).reason == "lift_off_branch"
    assert step.plan(touchdown_waypoint_q=np.zeros(6)).reason == "touchdown_unreachable"
    stretched = step.plan(config=SwingConfig(max_joint_step=0.01))
    assert stretched.reason == "lift_unreachable" and "in one step" in stretched.detail


def test_a_footfall_inside_a_rock_is_refused():
    step = Step("sdm_b", lambda along, out: np.where(along > 0.2, 0.15, 0.0))
    refusal = step.plan()
    assert refusal.reason == "touchdown_sinks" and "0.150 m inside" in refusal.detail


def test_a_leg_over_a_rock_is_refused_with_its_part():
    step = Step("sdm_b", lambda along, out: np.where(along > 0.2, 0.9, 0.0))
    refusal = step.plan()
    assert refusal.reason == "touchdown_collides" and refusal.detail.endswith("terrain")


def test_a_start_too_close_to_a_rock_is_refused():
    step = beside_rock("sdm_b")
    refusal = step.plan(config=SwingConfig(extra_heights=(0.0,)))
    assert refusal.reason == "lift_waypoint_collides" and refusal.detail == "wheel1 against terrain"


def test_a_fork_that_cannot_leave_a_rock_is_refused():
    refusal = beside_rock("sdm_b", height=1.2).plan()
    assert refusal.reason == "lift_collides"
    assert refusal.detail.startswith("leg1_") and refusal.detail.endswith("against terrain")


def test_an_endless_wall_uses_up_the_budget():
    step = Step("sdm_b", lambda along, out: np.where((np.abs(along) < 0.08) & (out > -0.15), 4.0, 0.0), half=0.45)
    config = SwingConfig(sbl=SblConfig(max_checks=150))
    refusal = step.plan(config=config)
    assert refusal.reason == "budget" and refusal.detail.startswith("sbl")
    assert refusal.checks < 500


def test_impossible_settings_are_refused():
    with pytest.raises(PlanningError, match="must be positive"):
        SwingConfig(vertical_step=0.0)
    with pytest.raises(PlanningError, match=r"corner_tolerance 0\.2 rad is outside 0 to 0\.1"):
        SwingConfig(corner_tolerance=0.2)
    with pytest.raises(PlanningError, match="must not be negative"):
        replace(SwingConfig(), extra_heights=())
