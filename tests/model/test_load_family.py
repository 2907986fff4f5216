"""The forces that balance a stance, and the best the ground can give, against sampling, closed forms and Pinocchio."""

import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import OptimizeResult, nnls

from athlete_twin.errors import SupportError
from athlete_twin.model import load_family
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.load_bearing import load_bearing
from athlete_twin.model.load_family import force_family, least_torque_loads
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.model.statics import balance_matrix, peak_torque_fraction, stance_loads, torque_fractions

ALL = np.ones(6, dtype=bool)
DOWN = np.array([0.0, 0.0, -1.0])
WEIGHT = 8000.0


def without(*legs):
    standing = ALL.copy()
    standing[list(legs)] = False
    return standing


def contacts_of(robot, joints):
    kin = kinematics(robot)
    return kin.wheels_in_hex(joints) + kin.spec.wheel.radius * DOWN


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(3, 6))
def test_zero_interaction_is_the_least_norm_member_and_no_pair_works_against_each_other(seed, count):
    rng = np.random.default_rng(seed)
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, 6))[:count] + np.arange(count)
    contacts = np.column_stack([2.0 * np.cos(angles), 2.0 * np.sin(angles), rng.normal(0.0, 0.3, count)])
    com = np.array([*rng.normal(0.0, 0.3, 2), 1.0])
    family = force_family(contacts, com, weight=WEIGHT)
    assert family.basis.shape == (3 * count, 3 * count - 6)
    balance = balance_matrix(contacts, com)
    np.testing.assert_allclose(balance @ family.basis, 0.0, atol=1e-9)
    other = family.least_norm + (family.basis @ rng.normal(0.0, 1000.0, 3 * count - 6)).reshape(-1, 3)
    np.testing.assert_allclose(balance @ other.ravel(), [0.0, 0.0, WEIGHT, 0.0, 0.0, 0.0], atol=1e-6)
    assert np.linalg.norm(family.least_norm) <= np.linalg.norm(other) + 1e-9
    for i in range(count):
        for j in range(i):
            line = contacts[i] - contacts[j]
            assert abs((family.least_norm[i] - family.least_norm[j]) @ line) < 1e-6 * WEIGHT


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.parametrize("standing", [ALL, without(0), without(1, 4)], ids=["six", "five", "four"])
def test_best_loads_balance_push_hold_and_are_no_worse_than_zero_interaction(robot, standing):
    kin, joints = kinematics(robot), regular_stance(load_spec(robot))
    found = least_torque_loads(kin, joints, supporting=standing, friction=0.5)
    assert found.feasible
    contacts, com = contacts_of(robot, joints), kin.com_in_hex(joints)
    weight = kin.spec.mass * GRAVITY
    wrench = balance_matrix(contacts[standing], com) @ found.forces[standing].ravel()
    np.testing.assert_allclose(wrench, [0.0, 0.0, weight, 0.0, 0.0, 0.0], atol=1e-5 * weight)
    assert (found.forces[~standing] == 0.0).all() and (found.forces[standing, 2] >= -1e-6 * weight).all()
    assert (np.hypot(*found.forces[:, :2].T) <= 0.5 * found.forces[:, 2] + 1e-6 * weight).all()
    assert found.peak_torque_fraction <= peak_torque_fraction(kin, joints, supporting=standing) + 1e-7


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_no_sample_of_the_family_beats_the_best_by_more_than_the_pyramid_leaves_out(robot):
    kin, joints, friction = kinematics(robot), regular_stance(load_spec(robot)), 0.5
    standing = without(2)
    contacts, com, weight = contacts_of(robot, joints), kin.com_in_hex(joints), kin.spec.mass * GRAVITY
    found = least_torque_loads(kin, joints, supporting=standing, friction=friction, sides=64)
    family = force_family(contacts[standing], com, weight=weight)
    rng = np.random.default_rng(5)
    best = np.inf
    for scale in 10.0 ** rng.uniform(0.0, np.log10(0.3 * weight), 3000):
        forces = np.zeros((6, 3))
        forces[standing] = family.least_norm + (family.basis @ rng.normal(0.0, scale, family.basis.shape[1])).reshape(-1, 3)
        if (forces[standing, 2] < 0.0).any() or (np.hypot(*forces[:, :2].T) > friction * forces[:, 2]).any():
            continue
        fractions = torque_fractions(kin, joints, wheel_forces_in_hex=forces, contact_in_hex=contacts)
        best = min(best, float(np.abs(fractions).max()))
    assert found.peak_torque_fraction <= best + 2e-3  # a pyramid of 64 sides lacks 0.12 % of the cone
    assert best < 1.0


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000), robot=st.sampled_from(["sdm_b", "t12"]),
    lifted=st.integers(0, 3), friction=st.sampled_from([0.0, 0.2, 0.5]),
)  # fmt: skip
def test_of_any_stance_on_any_slope_a_second_solver_finds_the_same_best_loads(seed, robot, lifted, friction):
    """Feet out of place, the chassis out of level: non-negative least squares reach the peak and not a thousandth less."""
    rng, kin, spec = np.random.default_rng(seed), kinematics(robot), load_spec(robot)
    down = np.array([*rng.normal(0.0, 0.12, 2), -1.0])
    down /= np.linalg.norm(down)
    gravity, weight = GRAVITY * down, spec.mass * GRAVITY
    places = kin.wheels_in_hex(regular_stance(spec)) + rng.normal(0.0, 0.15, (6, 3))
    joints, reached = all_legs_ik(spec, places, last_link_in_hex=down)
    assume(reached.all())
    standing = without(*rng.choice(6, lifted, replace=False))
    rigid, contacts = stance_loads(kin, joints, supporting=standing, gravity_in_hex=gravity)
    for i, j in itertools.combinations(np.flatnonzero(standing), 2):
        assert abs((rigid[i] - rigid[j]) @ (contacts[i] - contacts[j])) < 1e-6 * weight

    def fractions(forces):
        return torque_fractions(kin, joints, wheel_forces_in_hex=forces, contact_in_hex=contacts, gravity_in_hex=gravity).ravel()

    def shortfall(peak):
        """Of the best try at forces that balance and keep all torques within the peak: zero when there are such forces."""
        whole = np.block([[balance, np.zeros((6, 2 * held.size))], [np.vstack([push, -push]), np.eye(2 * held.size)]])
        return nnls(whole, np.concatenate([-down, np.zeros(3), peak - held, peak + held]), maxiter=50_000)[1]

    held, each = fractions(np.zeros((6, 3))), []
    for leg in np.flatnonzero(standing):
        for edge in load_family._pyramid(-down, friction, load_family.SIDES):
            each.append(np.zeros((6, 3)))
            each[-1][leg] = edge
    push = np.column_stack([fractions(weight * one) - held for one in each])
    by_force = balance_matrix(contacts[standing], kin.com_in_hex(joints))
    balance = np.column_stack([by_force @ one[standing].ravel() for one in each])

    found = least_torque_loads(kin, joints, supporting=standing, friction=friction, gravity_in_hex=gravity)
    exists = nnls(balance, np.concatenate([-down, np.zeros(3)]))[1] < 1e-8
    assert found.feasible == exists
    if not exists:
        return
    wrench = by_force @ found.forces[standing].ravel()
    np.testing.assert_allclose(wrench, weight * np.concatenate([-down, np.zeros(3)]), atol=1e-6 * weight)
    assert tangential(found.forces, down, friction).max() <= 1e-6 * weight
    assert shortfall(found.peak_torque_fraction + 1e-6) < 1e-8 and shortfall(found.peak_torque_fraction - 1e-3) > 1e-5
    if tangential(rigid, down, friction * np.cos(np.pi / load_family.SIDES)).max() <= 0.0:  # a cone inside the pyramid
        assert found.peak_torque_fraction <= np.abs(fractions(rigid)).max() + 1e-7


def tangential(forces, down, friction):
    """By how much the sideways part of each force is beyond friction on its normal part; a pull is beyond it too [N]."""
    normal = -forces @ down
    return np.maximum(np.linalg.norm(forces + normal[:, None] * down, axis=1) - friction * normal, -normal)


def test_more_friction_never_asks_for_more_torque_and_none_is_the_vertical_forces():
    kin, joints = kinematics("sdm_b"), regular_stance(load_spec("sdm_b"))
    peaks = [least_torque_loads(kin, joints, supporting=without(3), friction=mu).peak_torque_fraction for mu in (0.0, 0.1, 0.3, 0.6)]
    assert all(after <= before + 1e-9 for before, after in itertools.pairwise(peaks))
    vertical = least_torque_loads(kin, joints, supporting=without(3), friction=0.0)
    assert np.abs(vertical.forces[:, :2]).max() < 1e-6


def test_a_stance_the_ground_cannot_hold_says_why():
    kin, joints = kinematics("sdm_b"), regular_stance(load_spec("sdm_b"))
    tilted = GRAVITY * np.array([0.95, 0.0, -0.3])
    found = least_torque_loads(kin, joints, supporting=without(1, 2), friction=0.0, gravity_in_hex=tilted)
    assert not found.feasible and np.isnan(found.peak_torque_fraction) and np.isnan(found.forces).all()
    assert "friction 0 on 4 wheels" in found.reason


def test_a_solver_that_gives_up_is_not_taken_for_a_proof(monkeypatch):
    kin, joints = kinematics("sdm_b"), regular_stance(load_spec("sdm_b"))
    stopped = OptimizeResult(success=False, status=1, message="iteration limit", x=None)
    monkeypatch.setattr(load_family, "linprog", lambda *_, **__: stopped)
    found = least_torque_loads(kin, joints, supporting=ALL, friction=0.5)
    assert not found.feasible and found.reason == "the solver gave up, so forces may exist: iteration limit"


def test_wrong_use_of_the_family_is_refused():
    kin, joints = kinematics("sdm_b"), regular_stance(load_spec("sdm_b"))
    with pytest.raises(SupportError, match=r"friction is -0\.1"):
        least_torque_loads(kin, joints, supporting=ALL, friction=-0.1)
    with pytest.raises(SupportError, match="2 sides"):
        least_torque_loads(kin, joints, supporting=ALL, friction=0.5, sides=2)
    with pytest.raises(SupportError, match="at least 3 wheels"):
        least_torque_loads(kin, joints, supporting=without(0, 1, 2, 3), friction=0.5)


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_where_a_leg_carries_its_torques_are_pinocchios_and_within_limits(robot):
    kin, spec, rng = kinematics(robot), load_spec(robot), np.random.default_rng(6)
    stance = kin.wheels_in_hex(regular_stance(spec))
    places = stance[2] + rng.uniform(-1.0, 1.0, (90, 3)) * spec.foot_radius * np.array([0.8, 0.8, 0.2])
    gravity = np.array([0.05, -0.03, -1.0])
    load = spec.mass * GRAVITY / 3.0
    found = load_bearing(spec, 2, places, load=load, max_torque_fraction=0.6, gravity_direction=gravity)
    assert found.reaches.any() and not found.reaches.all()
    assert found.carries.any() and (found.reaches & ~found.carries).any()
    down = gravity / np.linalg.norm(gravity)
    for k in np.flatnonzero(found.reaches)[::7]:
        joints = regular_stance(spec)
        joints[2] = found.joints[k]
        forces, contacts = np.zeros((6, 3)), np.zeros((6, 3))
        forces[2], contacts[2] = -load * down, places[k] + spec.wheel.radius * down
        torques = kin.gravity_torques(joints, GRAVITY * down, forces, contacts)[2]
        assert found.torque_fraction[k] == pytest.approx(np.abs(torques / spec.torque_limits).max(), rel=1e-6)
        assert found.carries[k] == (found.torque_fraction[k] <= 0.6)


def test_a_leg_carries_less_far_under_more_load():
    spec = load_spec("sdm_b")
    azimuth = spec.hip_azimuths[0]
    out = np.linspace(0.5, 2.6, 80)
    places = spec.hips_in_hex[0] + np.column_stack([out * np.cos(azimuth), out * np.sin(azimuth), np.full(80, -1.5)])
    reach = [int(load_bearing(spec, 0, places, load=load).carries.sum()) for load in (0.0, 1400.0, 2800.0, 5600.0)]
    assert reach == sorted(reach, reverse=True) and reach[0] > reach[-1]


def test_wrong_use_of_the_workspace_is_refused():
    spec = load_spec("t12")
    with pytest.raises(SupportError, match="leg index 6"):
        load_bearing(spec, 6, np.zeros((1, 3)), load=1.0)
    with pytest.raises(SupportError, match=r"load is -1\.0 N"):
        load_bearing(spec, 0, np.zeros((1, 3)), load=-1.0)
    with pytest.raises(SupportError, match=r"max_torque_fraction is 0\.0"):
        load_bearing(spec, 0, np.zeros((1, 3)), load=1.0, max_torque_fraction=0.0)
    with pytest.raises(SupportError, match="no length"):
        load_bearing(spec, 0, np.zeros((1, 3)), load=1.0, gravity_direction=np.zeros(3))
    with pytest.raises(SupportError, match="1 values of the wheels' places are not finite"):
        load_bearing(spec, 0, np.array([[np.nan, 0.0, -1.0]]), load=1.0)
