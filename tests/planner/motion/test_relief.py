"""Torque-aware smoothing: less torque at little more length, through nothing, or the path as it was."""

import itertools

import numpy as np
import pytest

from athlete_twin.errors import PlanningError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.spec import load_spec
from planner.motion.relief import ReliefConfig, hanging_torque, path_peak, relieve
from planner.motion.smoothing import path_length

STRAIGHT = np.array([[-1.0, 0.0], [1.0, 0.0]])
BOX = (np.full(2, -2.0), np.full(2, 2.0))


def hill(q: np.ndarray) -> np.ndarray:
    """A round hill on the straight way."""
    return np.exp(-4.0 * (q**2).sum(axis=1))


def bent(is_free=lambda _: True, *, seed=0, peak=hill, path=STRAIGHT, **config):
    return relieve(path, peak, is_free, *BOX, np.random.default_rng(seed), ReliefConfig(**config))


def test_a_path_goes_round_a_hill_as_far_as_its_length_allows():
    """A detour of two straight halves by 10 % of the length passes the top at 0.458: the best there is has no more than that hill."""
    found = bent()
    assert path_length(found.waypoints) <= 1.10 * 2.0 + 1e-12
    np.testing.assert_array_equal(found.waypoints[[0, -1]], STRAIGHT)
    ends = hill(STRAIGHT).max()
    tent = path_peak(np.array([[-1.0, 0.0], [0.0, np.sqrt(1.1**2 - 1.0)], [1.0, 0.0]]), hill)
    assert path_peak(found.waypoints, hill) - ends <= 1.1 * (tent - ends)
    assert found.peaks[0] == pytest.approx(1.0, abs=1e-3) and found.peaks[-1] == pytest.approx(path_peak(found.waypoints, hill))


def test_it_never_goes_through_anything():
    wall = lambda q: not (abs(q[0]) < 0.3 and q[1] > 0.1)  # noqa: E731
    found = bent(wall)
    for a, b in itertools.pairwise(found.waypoints):
        assert all(wall(a + s * (b - a)) for s in np.linspace(0.0, 1.0, 200))
    assert found.waypoints[:, 1].min() < -0.2  # the other way round


def test_where_nothing_can_be_gained_the_path_stays():
    flat = bent(peak=lambda q: np.ones(len(q)))
    assert flat.waypoints is not None and len(flat.peaks) == 1 and flat.checks == 0
    np.testing.assert_array_equal(flat.waypoints, STRAIGHT)
    corridor = bent(lambda q: abs(q[1]) < 1e-6)
    np.testing.assert_array_equal(corridor.waypoints, STRAIGHT)


def test_the_same_seed_bends_the_same_way():
    assert bent(seed=3).waypoints.tobytes() == bent(seed=3).waypoints.tobytes()
    assert bent(seed=3).waypoints.tobytes() != bent(seed=4).waypoints.tobytes()


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_the_hanging_torque_is_pinocchios(robot):
    spec, kin = load_spec(robot), kinematics(robot)
    pose = SE3.from_rpy(0.05, -0.08, 0.4)
    gravity = pose.inverse().rotate(np.array([0.0, 0.0, -GRAVITY]))
    rng = np.random.default_rng(1)
    for leg in (0, 4):
        q = rng.uniform(spec.lower, spec.upper, (5, spec.dof))
        peaks = hanging_torque(spec, leg, pose)(q)
        for one, peak in zip(q, peaks, strict=True):
            joints = np.zeros((6, spec.dof))
            joints[leg] = one
            torques = kin.gravity_torques(joints, gravity, np.zeros((6, 3)), np.zeros((6, 3)))[leg]
            assert peak == pytest.approx(np.abs(torques / spec.torque_limits).max(), rel=1e-6)


def test_unusable_paths_and_settings_are_refused():
    with pytest.raises(PlanningError, match="a path needs finite shape"):
        bent(path=np.array([[0.0, np.nan], [1.0, 1.0]]))
    for wrong in ({"max_extra": -0.1}, {"max_extra": np.nan}, {"kicks": 0}, {"edge_points": 1}, {"spread": np.inf}):
        with pytest.raises(PlanningError, match="relief needs"):
            ReliefConfig(**wrong)
