"""The twin on its wheels: it goes where it was told, at its published speed, and stands where it stops."""

import numpy as np
import pytest

from athlete_twin.athlete import Athlete
from athlete_twin.messages import CommandSequence, Drive
from athlete_twin.model.spec import load_spec
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.world.scenario import load_scenario


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.slow
@pytest.mark.ci
def test_the_twin_drives_a_line_and_stays_where_it_stops(robot):
    spec = load_spec(robot)
    athlete = Athlete(spec, load_scenario("calibration_yard"), 0, trial=nominal_truth(spec))
    try:
        before, stance = athlete.truth().world_from_hex, athlete.executive.setpoint.copy()
        drive = Drive(translation_in_hex=np.array([2.0, 0.0]), speed=spec.drive_speed)
        athlete.receive(CommandSequence(seq=0, robot_id=robot, t=athlete.t, sequence_id=0, commands=(drive,)))
        fastest, last, t = 0.0, before.translation, athlete.t
        while athlete.busy:
            athlete.advance(athlete.t + 0.2)
            here = athlete.truth().world_from_hex.translation
            fastest = max(fastest, float(np.linalg.norm(here - last)) / max(athlete.t - t, 1e-9))
            last, t = here, athlete.t
        moved = athlete.truth().world_from_hex.translation - before.translation
        np.testing.assert_allclose(moved[:2], [2.0, 0.0], atol=0.08)
        assert fastest > 0.9 * min(spec.drive_speed, np.sqrt(2.0 * 0.3))  # 2 m are too short for SDM-B's 3 km/h
        np.testing.assert_allclose(athlete.executive.setpoint, stance, atol=1e-9)
        assert not athlete.collisions
        stopped = athlete.truth().world_from_hex.translation
        athlete.advance(athlete.t + 30.0)
        assert np.linalg.norm(athlete.truth().world_from_hex.translation - stopped) < 1e-3
    finally:
        athlete.close()
