import numpy as np
import pytest

from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.leg_coms import leg_coms_in_hex
from athlete_twin.model.stance import regular_stance

MICROMETRE = 1e-6


@pytest.mark.parametrize("name", ["sdm_b", "t12"])
def test_a_legs_centre_of_mass_moves_the_robots_as_pinocchio_says(name):
    robot, rng = kinematics(name), np.random.default_rng(2)
    spec, joints = robot.spec, regular_stance(robot.spec)
    leg_mass = sum(j.link_mass for j in spec.joints) + spec.wheel.mass
    q = rng.uniform(-1.0, 1.0, (4, spec.dof))
    for leg in range(6):
        now = leg_coms_in_hex(spec, leg, joints[leg : leg + 1])[0]
        for row, com in zip(q, leg_coms_in_hex(spec, leg, q), strict=True):
            moved = joints.copy()
            moved[leg] = row
            change = spec.mass * (robot.com_in_hex(moved) - robot.com_in_hex(joints))
            assert leg_mass * (com - now) == pytest.approx(change, abs=spec.mass * MICROMETRE)


def test_a_configuration_that_is_none_has_no_centre_of_mass():
    robot = kinematics("sdm_b")
    q = regular_stance(robot.spec)[[0, 0]]
    q[1, 2] = np.nan
    found = leg_coms_in_hex(robot.spec, 0, q)
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()
