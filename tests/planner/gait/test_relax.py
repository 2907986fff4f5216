"""Wheels shifted so that legs stop working against each other, and so that the next lift finds them unstrained."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.model.statics import patches_in_hex
from planner.gait.relax import RelaxConfig, relaxing_offsets
from planner.sag.leg_compliance import held_response, patch_compliance


def soft(robot):
    """The belief of a robot whose joints give way."""
    return replace(robot.belief, joint_stiffness=np.full(robot.spec.dof, 5e4), interaction=np.zeros((6, 3)))


def offsets(robot, belief, *, leg=0, next_leg=None, change=None, **config):
    return relaxing_offsets(
        robot.kin, belief, belief.joints, leg=leg, next_leg=next_leg, next_change=np.zeros(6) if change is None else change,
        config=RelaxConfig(**config),
    )  # fmt: skip


def test_a_wheel_goes_where_it_is_pushed_by_its_compliance_except_the_one_that_has_just_stepped(robot):
    interaction = np.zeros((6, 3))
    interaction[:3, 0] = [400.0, 100.0, -100.0]
    belief = replace(soft(robot), interaction=interaction)
    compliance = patch_compliance(robot.kin, belief.joints, belief.joint_stiffness, belief.gravity_in_hex())
    found = offsets(robot, belief, gain=0.7)
    assert not found[[0, 3, 4, 5]].any()
    for leg in (1, 2):
        np.testing.assert_allclose(found[leg], 0.7 * compliance[leg] @ interaction[leg], rtol=1e-12)


def test_no_offset_is_longer_than_its_limit(robot):
    interaction = np.zeros((6, 3))
    interaction[4, 1] = 1e6
    found = offsets(robot, replace(soft(robot), interaction=interaction), max_offset=0.05)
    assert np.linalg.norm(found[4]) == pytest.approx(0.05)


@pytest.mark.parametrize("next_leg", range(6))
def test_what_the_next_lift_brings_is_taken_back_beforehand(robot, next_leg):
    """Force left by the offsets, and force that comes with the lift, cancel on every wheel that stands."""
    belief = soft(robot)
    gravity, standing = belief.gravity_in_hex(), np.arange(6) != next_leg
    change = np.where(standing, np.random.default_rng(next_leg).uniform(-800.0, 2000.0, 6), -3000.0)
    found = offsets(robot, belief, next_leg=next_leg, change=change, max_offset=0.5)
    compliance = patch_compliance(robot.kin, belief.joints, belief.joint_stiffness, gravity)
    contacts = patches_in_hex(robot.kin, belief.joints, gravity)
    coming = held_response(compliance, np.where(standing, change, 0.0), contacts, standing, gravity).forces
    left = -np.linalg.solve(compliance, found[..., None])[..., 0]
    np.testing.assert_allclose(left + coming, 0.0, atol=1e-6)
    assert not found[next_leg].any()
    assert np.abs(coming).max() > 10.0


def test_who_does_not_know_the_next_leg_relaxes_only(robot):
    assert not offsets(robot, soft(robot), next_leg=None, change=np.full(6, 1e3)).any()
    assert not offsets(robot, soft(robot), next_leg=2, change=np.full(6, 1e3), anticipation=0.0).any()


@pytest.mark.parametrize(("name", "value"), [("gain", -0.1), ("gain", np.nan), ("anticipation", 1.5), ("max_offset", np.inf)])
def test_unusable_settings_are_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        RelaxConfig(**{name: value})
