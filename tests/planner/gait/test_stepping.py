"""Crossing ledges, ditches and walls: footfalls keep off the edges, each pose of the way stands, and the claim is not reached."""

import numpy as np
import pytest

from athlete_twin.errors import PlanningError
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.statics import peak_torque_fraction
from planner.gait.ground_profile import Profile, ditch, ledge, wall
from planner.gait.stepping import Crossing, NoCrossing, SteppingConfig, cross, footfalls, largest_crossing

CONFIG = SteppingConfig(heading_deg=30.0, stride=0.6, foot_scale=1.1, behind=0.0, lift=0.25, clear=0.12)
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def spec():
    return load_spec("sdm_b")


@pytest.fixture(scope="module")
def crossing(spec):
    found = cross(spec, ledge(0.3), CONFIG)
    assert isinstance(found, Crossing)
    return found


@pytest.mark.parametrize("profile", [ledge(0.5), ledge(-0.5), ditch(0.4), wall(0.4)], ids=lambda p: p.name)
def test_every_footfall_keeps_off_the_edges_and_all_wheels_arrive_beyond(spec, profile):
    feet, steps = footfalls(spec, profile, CONFIG)
    holds = profile.footholds(spec.wheel.radius)
    for axles in feet:
        inside = (axles[:, :1] >= holds[:, 0] - 1e-9) & (axles[:, :1] <= holds[:, 1] + 1e-9)
        assert inside.any(axis=1).all()
        np.testing.assert_allclose(axles[:, 2], profile.height(axles[:, 0]) + spec.wheel.radius)
    assert (feet[-1][:, 0] >= profile.edges[-1]).all() and len(feet) == len(steps) + 1
    for before, after, (leg, path) in zip(feet[:-1], feet[1:], steps, strict=True):
        np.testing.assert_array_equal(np.flatnonzero((before != after).any(axis=1)), [leg])
        np.testing.assert_array_equal(path[[0, 3]], [before[leg], after[leg]])
        between = np.linspace(path[1, 0], path[2, 0], 50)
        assert (path[1, 2] - spec.wheel.radius >= profile.height(between) + CONFIG.clear - 1e-9).all()


@pytest.mark.slow
def test_every_step_of_a_crossing_reaches_and_holds_as_pinocchio_says(spec, crossing):
    kin, axles, pose, worst = kinematics("sdm_b"), crossing.axles.copy(), crossing.begin, 0.0
    for step in crossing.steps:
        for pose in step.poses:
            inverse = pose.inverse()
            _, reaches = all_legs_ik(spec, inverse.apply(axles), last_link_in_hex=inverse.rotate(DOWN))
            assert reaches.all()
        inverse = pose.inverse()
        axles[step.leg] = step.path[1]
        joints, reaches = all_legs_ik(spec, inverse.apply(axles), last_link_in_hex=inverse.rotate(DOWN))
        assert reaches.all()
        gravity = 9.80665 * inverse.rotate(DOWN)
        worst = max(worst, peak_torque_fraction(kin, joints, supporting=np.arange(6) != step.leg, gravity_in_hex=gravity))
        axles[step.leg] = step.path[3]
    assert worst <= crossing.peak + 0.02 and crossing.peak <= CONFIG.torque
    assert (axles[:, 0] > 0.0).all()


@pytest.mark.slow
def test_the_chassis_moves_in_neighbouring_poses(crossing):
    before = crossing.begin
    for step in crossing.steps:
        for pose in step.poses:
            assert np.linalg.norm(pose.translation - before.translation) <= np.hypot(*CONFIG.step) + 1e-9
            before = pose


@pytest.mark.slow
@pytest.mark.ci
def test_a_ledge_beyond_reach_is_refused_by_the_step_that_cannot_be(spec):
    found = cross(spec, ledge(3.0), CONFIG)
    assert isinstance(found, NoCrossing) and found.reason.startswith("step ")


@pytest.mark.slow
def test_the_largest_is_bracketed_to_its_digit(spec):
    made = []

    def make(size):
        made.append(size)
        return ledge(0.2) if size <= 0.33 else ledge(3.0)

    found = largest_crossing(spec, make, (CONFIG,), low=0.1, high=0.9, digit=0.1)
    assert found.size == pytest.approx(0.3) and isinstance(found.crossing, Crossing) and found.ended_by
    assert len(made) <= 5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Profile(name="x", edges=np.array([1.0, 0.0]), heights=np.zeros(3), firm=np.ones(3, dtype=bool)), "ascending edges"),
        (lambda: Profile(name="x", edges=np.array([0.0]), heights=np.array([0.0, np.nan]), firm=np.ones(2, dtype=bool)), "finite"),
        (lambda: SteppingConfig(heading_deg=0.0, stride=-1.0), "must be positive"),
        (lambda: largest_crossing(load_spec("sdm_b"), ledge, (), low=0.1, high=1.0, digit=0.1), "need 0 < low < high"),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises(PlanningError, match=message):
        make()
