"""The fast tyre model hides no collision: shank, chassis and a wheel's side are driven into a rock, and each is seen."""

from collections.abc import Iterator

import numpy as np
import pytest

from athlete_twin.athlete import Athlete
from athlete_twin.executive import CONTROL_PERIOD
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import BodyMove, CommandSequence, Drive, JointMove, LegMove
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import Terrain, build_terrain


def with_block(x: tuple[float, float], y: tuple[float, float], height: float) -> Terrain:
    """The flat yard with one block on it."""
    from dataclasses import replace

    yard = build_terrain(load_scenario("calibration_yard"), 0, clear_xy=np.zeros((0, 2)), clear_radius=0.0)
    xs, ys = yard.grid.centres()
    heights = np.zeros(yard.grid.shape)
    inside = (xs[:, None] >= x[0]) & (xs[:, None] <= x[1]) & (ys[None] >= y[0]) & (ys[None] <= y[1])
    heights[inside] = height
    grid = HeightGrid(origin_x=yard.grid.origin_x, origin_y=yard.grid.origin_y, cell=yard.grid.cell, heights=heights)
    return replace(yard, grid=grid)


@pytest.fixture
def robot() -> Iterator:
    made = []

    def make(terrain: Terrain) -> Athlete:
        spec = load_spec("sdm_b")
        athlete = Athlete(spec, load_scenario("calibration_yard"), 0, trial=nominal_truth(spec), terrain=terrain)
        made.append(athlete)
        return athlete

    yield make
    for athlete in made:
        athlete.close()


def run(athlete: Athlete, *commands) -> None:
    number = athlete.executive.newest_seq + 1
    athlete.receive(CommandSequence(seq=number, robot_id="sdm_b", t=athlete.t, sequence_id=number, commands=commands))
    for _ in range(300):
        athlete.advance(athlete.t + 1.0)
        if not athlete.busy:
            return


def parts(athlete: Athlete) -> set[str]:
    return {c.part for c in athlete.collisions if c.other == "ground"}


def leg_to(athlete: Athlete, leg: int, wheel: np.ndarray) -> np.ndarray:
    q, ok = leg_ik(athlete.spec, leg, wheel[None])
    assert ok[0]
    return q


@pytest.mark.slow
@pytest.mark.ci
def test_a_clean_step_counts_no_collision(robot):
    athlete = robot(with_block((8.0, 8.1), (0.0, 0.1), 0.1))
    wheel = athlete.kin.leg_wheel(0, athlete.executive.setpoint[0]).translation
    run(athlete, LegMove(leg=0, wheel_in_hex=wheel + [0.0, 0.0, 0.3], guard="break_contact"))
    assert athlete.executive.state == "idle"
    assert not athlete.collisions


@pytest.mark.slow
@pytest.mark.ci
def test_a_wheels_side_driven_into_a_rock_is_seen(robot):
    athlete = robot(with_block((2.35, 2.9), (-0.4, 0.4), 0.6))
    wheel = athlete.kin.leg_wheel(0, athlete.executive.setpoint[0]).translation
    lifted = wheel + [0.0, 0.0, 0.25]
    run(
        athlete,
        LegMove(leg=0, wheel_in_hex=lifted, guard="break_contact"),
        JointMove(leg=0, waypoints=leg_to(athlete, 0, lifted + [0.40, 0.0, 0.0])),
    )
    assert "wheel1" in parts(athlete)
    strike = next(c for c in athlete.collisions if c.part == "wheel1")
    assert strike.force > 0.0
    assert 2.2 < strike.place_in_world[0] < 2.9


@pytest.mark.slow
@pytest.mark.ci
def test_a_shank_driven_into_a_rock_is_seen(robot):
    # The knee stands out beyond the wheel: a tall slab beside it, clear of the wheel, meets the shank when the leg turns.
    athlete = robot(with_block((2.02, 2.4), (0.35, 0.75), 1.10))
    wheel = athlete.kin.leg_wheel(0, athlete.executive.setpoint[0]).translation
    lifted = wheel + [-0.25, 0.0, 0.25]
    run(
        athlete,
        LegMove(leg=0, wheel_in_hex=wheel + [0.0, 0.0, 0.25], guard="break_contact"),
        JointMove(leg=0, waypoints=leg_to(athlete, 0, lifted)),
        JointMove(leg=0, waypoints=leg_to(athlete, 0, lifted + [-0.05, 0.55, 0.0])),
    )
    assert parts(athlete) & {"leg1_knee_roll", "leg1_knee_pitch", "leg1_ankle_pitch", "leg1_hip_pitch"}


@pytest.mark.slow
@pytest.mark.ci
def test_the_chassis_lowered_onto_a_rock_is_seen(robot):
    # Below one side of the ring, between two hips, which reach lower than the ring does.
    athlete = robot(with_block((0.88, 1.18), (0.42, 0.78), 1.35))
    run(athlete, BodyMove(translation_in_hex=np.array([0.0, 0.0, -0.30])))
    assert "hex" in parts(athlete)
    assert all(c.force > 0.0 for c in athlete.collisions)


@pytest.mark.slow
@pytest.mark.ci
def test_one_contact_episode_counts_once(robot):
    # Below one side of the ring, between two hips, which reach lower than the ring does.
    athlete = robot(with_block((0.88, 1.18), (0.42, 0.78), 1.35))
    run(athlete, BodyMove(translation_in_hex=np.array([0.0, 0.0, -0.30])))
    assert len([c for c in athlete.collisions if c.part == "hex"]) == 1


@pytest.mark.slow
@pytest.mark.ci
def test_a_wheel_driven_into_a_rock_is_seen_and_driving_over_a_pebble_is_none(robot):
    axle = load_spec("sdm_b").foot_radius
    for height, strikes in ((0.30, {"wheel1"}), (0.03, set())):
        athlete = robot(with_block((axle + 0.5, axle + 0.9), (-0.3, 0.3), height))
        run(athlete, Drive(translation_in_hex=np.array([0.6, 0.0]), speed=0.2))
        assert {p for p in parts(athlete) if p.startswith("wheel")} == strikes, height


@pytest.mark.slow
@pytest.mark.ci
def test_hulls_are_looked_at_in_every_control_tick_and_strikes_of_wheels_half_as_often(robot):
    athlete = robot(with_block((4.0, 5.0), (4.0, 5.0), 0.3))
    looked = {"hull_contacts": [], "hull_depths": []}
    for name, times in looked.items():
        look = getattr(athlete.body, name)
        setattr(athlete.body, name, lambda look=look, times=times, **k: times.append(athlete.t) or look(**k))
    run(athlete, BodyMove(translation_in_hex=np.array([0.05, 0.0, 0.0])))
    assert len(looked["hull_contacts"]) > 24
    np.testing.assert_allclose(np.diff(looked["hull_contacts"]), CONTROL_PERIOD, atol=1e-9)
    # Telemetry counts as a reading as well, so that the looks at the wheels come a tick sooner or later.
    assert np.diff(looked["hull_depths"]).mean() == pytest.approx(2 * CONTROL_PERIOD, rel=0.1)
