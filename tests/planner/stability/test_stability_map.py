import numpy as np
import pytest

from athlete_twin.errors import SupportError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.stance import regular_stance
from planner.stability.margin import cps_margin, support_margin
from planner.stability.stability_map import (
    REASONS,
    StabilityConfig,
    stability_map,
)

MICROMETRE = 1e-6
SPACING = np.linspace(-0.55, 0.55, 15)
"""about the foot, over the foot radius: well beyond reach"""


@pytest.fixture(params=["sdm_b", "t12"])
def standing(request):
    robot = kinematics(request.param)
    joints = regular_stance(robot.spec)
    height = robot.spec.chassis_height
    return robot, joints, SE3.from_rpy(0.0, 0.0, 0.4, np.array([2.0, -1.0, height]))


def _candidates(robot, joints, world_from_hex, leg):
    centre = world_from_hex.apply(robot.wheels_in_hex(joints))[leg] - [0.0, 0.0, robot.spec.wheel.radius]
    side = SPACING * 2.2 * robot.spec.foot_radius
    x, y = np.meshgrid(side, side, indexing="ij")
    rng = np.random.default_rng(1)
    return centre + np.column_stack([x.ravel(), y.ravel(), rng.normal(0.0, 0.05, x.size)])


def _judge(standing, leg=1, **changes):
    robot, joints, world_from_hex = standing
    config = StabilityConfig(**({"min_margin": robot.spec.min_support_margin} | changes))
    places = _candidates(robot, joints, world_from_hex, leg)
    judged = stability_map(
        robot, joints, leg=leg, footfalls_in_world=places, world_from_hex=world_from_hex, config=config, lift=0.2
    )
    return places, judged


def test_margins_equal_those_of_each_stance_computed_alone(standing):
    robot, joints, world_from_hex = standing
    leg = 1
    places, judged = _judge(standing, leg)
    assert 20 < judged.reachable.sum() < len(places)
    wheel = np.array([0.0, 0.0, robot.spec.wheel.radius])
    for i in np.flatnonzero(judged.reachable)[::7]:
        moved = joints.copy()
        moved[leg] = judged.joints[i]
        contacts = world_from_hex.apply(robot.wheels_in_hex(moved)) - wheel
        assert contacts[leg] == pytest.approx(places[i], abs=MICROMETRE)
        com = world_from_hex.apply(robot.com_in_hex(moved))
        assert judged.margin[i] == pytest.approx(support_margin(com, contacts), abs=MICROMETRE)
        assert judged.cps_margin[i] == pytest.approx(cps_margin(com, contacts), abs=MICROMETRE)
        lifted, ok = leg_ik(
            robot.spec, leg, world_from_hex.inverse().apply(places[i : i + 1] + wheel + [0.0, 0.0, 0.2])
        )
        assert ok.all()
        assert judged.lifted[i] == pytest.approx(lifted[0])
        moved[leg] = lifted[0]
        swing = support_margin(world_from_hex.apply(robot.com_in_hex(moved)), np.delete(contacts, leg, axis=0))
        assert judged.swing_margin[i] == pytest.approx(swing, abs=MICROMETRE)


def test_every_refusal_has_its_reason(standing):
    robot = standing[0]
    places, judged = _judge(standing)
    assert judged.ok.any()
    assert np.array_equal(judged.ok, judged.reason == 0)
    assert sum(judged.counts().values()) == len(places)
    landed = judged.reason == REASONS.index("landed_margin")
    assert (judged.cps_margin[landed] < robot.spec.min_support_margin).all()
    assert (judged.cps_margin[judged.ok] >= robot.spec.min_support_margin).all()
    assert np.isnan(judged.margin[~judged.reachable]).all()
    assert not judged.ok[~judged.reachable].any()


def test_stricter_margins_refuse_more(standing):
    easy = _judge(standing, min_margin=0.1)[1].ok
    hard = _judge(standing, min_margin=0.8)[1].ok
    assert hard.sum() < easy.sum()
    assert not (hard & ~easy).any()


def test_a_high_way_point_takes_places_away(standing):
    robot, joints, world_from_hex = standing
    places = _candidates(robot, joints, world_from_hex, 0)
    config = StabilityConfig(min_margin=-10.0, all_down="support")
    maps = [
        stability_map(
            robot, joints, leg=0, footfalls_in_world=places, world_from_hex=world_from_hex, config=config, lift=lift
        )
        for lift in (0.0, 1.0 * robot.spec.foot_radius)
    ]
    assert "unreachable_above" not in {k for k, v in maps[0].counts().items() if v}
    assert maps[1].counts()["unreachable_above"] > 0
    assert not (maps[1].reachable & ~maps[0].reachable).any()


def test_unknown_ground_is_never_reachable(standing):
    robot, joints, world_from_hex = standing
    places = _candidates(robot, joints, world_from_hex, 2)
    places[::2, 2] = np.nan
    judged = stability_map(
        robot,
        joints,
        leg=2,
        footfalls_in_world=places,
        world_from_hex=world_from_hex,
        config=StabilityConfig(min_margin=0.0),
    )
    assert (judged.reason[::2] == REASONS.index("unknown")).all()


def test_energy_can_decide(standing):
    judged = _judge(standing, all_down="energy", min_energy=0.02)[1]
    assert np.isfinite(judged.energy[judged.reachable]).all()
    assert (judged.energy[judged.ok] >= 0.02).all()


def test_unknown_margins_are_refused():
    with pytest.raises(SupportError, match="cps, support, energy"):
        StabilityConfig(min_margin=0.3, all_down="ssm")
    with pytest.raises(SupportError, match="finite"):
        StabilityConfig(min_margin=float("nan"))
