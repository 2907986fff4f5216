"""A robot at rest: how little its sag depends on the tick, and how little the clock's freeze leaves out."""

import numpy as np
import pytest

from athlete_twin.errors import PhysicsError
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.physics.body import Body

ROBOTS = ("sdm_b", "t12")
SAG_TOLERANCE = 0.5e-3  # [m]
FINE_TICK = 1.0 / 2000.0  # [s]
LIFT = 0.30  # [m]


def run(body: Body, commands: np.ndarray, seconds: float) -> None:
    limits = np.full(commands.shape, 0.1)
    for _ in range(round(seconds / body.world.tick)):
        body.step(commands, limits)


def corners(body: Body) -> np.ndarray:
    """Hips and axles in world: what sags."""
    poses = body.link_poses()
    hips = [poses[f"leg{leg + 1}_hip_yaw"].translation for leg in range(6)]
    return np.array([*hips, *body.axles])


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("robot", ROBOTS)
def test_settled_sag_is_that_of_a_tick_of_half_a_millisecond(make_body, robot):
    """On six wheels, then with leg 1 up (on T12 at a pallet corner): friction's history and the docks take part."""
    coarse, fine = make_body(robot), make_body(robot, tick=FINE_TICK)
    commands = coarse.motors
    lifted = commands.copy()
    up, ok = leg_ik(coarse.spec, 0, (kinematics(robot).leg_wheel(0, commands[0]).translation + [0.0, 0.0, LIFT])[None])
    assert ok[0]
    lifted[0] = up[0]
    for posture, seconds in ((commands, 6.0), (lifted, 12.0)):
        for body in (coarse, fine):
            run(body, posture, seconds)
        assert np.abs(corners(coarse) - corners(fine)).max() < SAG_TOLERANCE
    assert coarse.tyre.loads[0] == fine.tyre.loads[0] == 0.0


@pytest.mark.parametrize("tick", [0.0, -0.001, 1.0 / 120.0, float("nan")])
def test_a_tick_coarser_than_the_gains_bear_is_refused(make_body, tick):
    with pytest.raises(PhysicsError, match=r"tick is .* at most 0\.004167 s"):
        make_body("sdm_b", tick=tick)
