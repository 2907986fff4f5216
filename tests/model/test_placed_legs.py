import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.placed_legs import LegChains

ROBOTS = ("sdm_b", "t12")
MICROMETRE, MILLINEWTONMETRE = 1e-6, 1e-3


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(ROBOTS), st.integers(0, 10**6))
def test_placed_legs_are_pinocchios(robot, seed):
    rng, kin = np.random.default_rng(seed), kinematics(robot)
    joints = rng.uniform(kin.spec.lower, kin.spec.upper, (6, kin.spec.dof))
    placed = LegChains(kin).placed(joints)
    assert placed.wheels == pytest.approx(kin.wheels_in_hex(joints), abs=MICROMETRE)
    assert placed.com == pytest.approx(kin.com_in_hex(joints), abs=MICROMETRE)


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(ROBOTS), st.integers(0, 10**6))
def test_what_holds_them_is_what_pinocchio_says(robot, seed):
    rng, kin = np.random.default_rng(seed), kinematics(robot)
    joints = rng.uniform(kin.spec.lower, kin.spec.upper, (6, kin.spec.dof))
    gravity = np.array([*rng.normal(0.0, 1.0, 2), -GRAVITY])
    forces, contacts = rng.normal(0.0, 2000.0, (6, 3)), kin.wheels_in_hex(joints) + rng.normal(0.0, 0.3, (6, 3))
    chains = LegChains(kin)
    torques = chains.held(chains.placed(joints), gravity, forces, contacts)
    assert torques == pytest.approx(kin.gravity_torques(joints, gravity, forces, contacts), abs=MILLINEWTONMETRE)
