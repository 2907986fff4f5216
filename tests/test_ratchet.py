"""What SDM-B tells of a gear that skipped a tooth, with the twin's own gears: it tells of no sound one."""

from collections.abc import Iterator

import numpy as np
import pytest

from athlete_twin.athlete import Athlete
from athlete_twin.messages import CommandSequence, Fault, LegMove, Telemetry, Wait
from athlete_twin.model.spec import load_spec
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.world.bullet_world import TICK
from athlete_twin.world.scenario import load_scenario

SPEC = load_spec("sdm_b")
LIFTED = 9.0
"""by then leg 1 is in the air [s]"""


@pytest.fixture
def twin() -> Iterator[Athlete]:
    athlete = Athlete(SPEC, load_scenario("calibration_yard"), 0, trial=nominal_truth(SPEC))
    yield athlete
    athlete.close()


def pushed(athlete: Athlete, force: float, *, over: float) -> list:
    """What comes down while leg 1 is lifted and its wheel then pushed back, by a force that grows over a time [N, s]."""
    body, step, ticks = athlete.body, athlete.body.step, 0

    def step_with_push(*args):
        nonlocal ticks
        t, ticks = ticks * TICK - LIFTED, ticks + 1
        if 0.0 < t < over:
            push, at, bullet = [-force * t / over, 0.0, 0.0], body.axles[0].tolist(), body.world.bullet
            bullet.applyExternalForce(
                body.robot, body._wheels[0], push, at, bullet.WORLD_FRAME, physicsClientId=body.world.client
            )
        return step(*args)

    body.step = step_with_push
    wheel = athlete.kin.leg_wheel(0, athlete.executive.setpoint[0]).translation
    commands = (LegMove(leg=0, wheel_in_hex=wheel + [0.0, 0.0, 0.25]), Wait(duration=8.0))
    athlete.receive(
        CommandSequence(
            seq=1, robot_id="sdm_b", t=0.0, sequence_id=1, commands=commands, max_torque_fraction=10.0, max_swing_force=1e6
        )
    )
    out = []
    while athlete.t < LIFTED + over + 3.0 - 1e-6:
        out += athlete.advance(LIFTED + over + 3.0)
    return out


@pytest.mark.parametrize(("force", "over"), [(1500.0, 1.0), (2000.0, 0.03)])
@pytest.mark.slow
@pytest.mark.ci
def test_sound_gears_are_not_suspected_whatever_is_let_go(twin, force, over):
    """A load that is let go changes a reading by two teeth and more in a control tick: the jump itself proves nothing."""
    told = pushed(twin, force, over=over)
    assert not twin.body.slipped.any()
    assert not [m for m in told if isinstance(m, Fault)]


@pytest.mark.slow
@pytest.mark.ci
def test_a_gear_that_skipped_is_told_by_leg_and_joint_and_reads_wrong_from_then_on(twin):
    told = pushed(twin, 1900.0, over=4.75)
    skipped = {(int(leg), SPEC.joint_names[joint]) for leg, joint in np.argwhere(twin.body.slipped)}
    assert skipped
    suspected = [m for m in told if isinstance(m, Fault)]
    assert {m.code for m in suspected} == {"ratchet_slip"}
    assert {(m.leg, m.text.split()[0]) for m in suspected} <= skipped
    last = next(m for m in reversed(told) if isinstance(m, Telemetry))
    assert np.abs(last.torques - twin.truth().torques).max() > 150.0
