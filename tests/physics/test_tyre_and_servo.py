"""Tyres and servos against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.model.spec import load_spec
from athlete_twin.physics.servo import Servos
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.physics.tyre import Tyres
from athlete_twin.world.bullet_world import TICK

SPEC = load_spec("sdm_b")
TRIAL = nominal_truth(SPEC)
AXES = np.tile([0.0, 1.0, 0.0], (6, 1))
STILL = np.zeros((6, 3))


def ground(slope: float = 0.0) -> HeightGrid:
    x = np.arange(-3.0, 3.0, 0.05)
    return HeightGrid(origin_x=-3.0, origin_y=-3.0, cell=0.05, heights=np.repeat(np.tan(slope) * x[:, None], len(x), axis=1))


def tyres(grid: HeightGrid, friction: float = 0.7) -> Tyres:
    return Tyres(SPEC.wheel, TRIAL, grid, friction=friction, sprung_mass=SPEC.mass)


@pytest.mark.parametrize("deflection", [0.005, 0.02, 0.061, 0.10])
def test_normal_force_is_the_stiffening_law(deflection):
    axles = np.tile([0.3, 0.2, SPEC.wheel.radius - deflection], (6, 1))
    forces = tyres(ground()).step(axles, AXES, STILL, STILL, TICK)
    expected = TRIAL.truth.tyre_k1 * deflection + TRIAL.truth.tyre_k2 * deflection**2
    assert forces.loads == pytest.approx(np.full(6, expected), rel=1e-6)
    assert forces.forces_in_world[:, 2] == pytest.approx(np.full(6, expected), rel=1e-6)
    assert np.abs(forces.forces_in_world[:, :2]).max() < 1e-6 * expected


def test_at_sdm_bs_load_a_tyre_gives_way_as_estimated():
    """Robot facts 2.6: 6.1 cm and 23 kN/m secant at 1390 N."""
    k1, k2 = TRIAL.truth.tyre_k1, TRIAL.truth.tyre_k2
    deflection = (np.sqrt(k1**2 + 4 * k2 * 1390.0) - k1) / (2 * k2)
    assert deflection == pytest.approx(0.061, abs=1e-3)
    assert 1390.0 / deflection == pytest.approx(23e3, rel=0.02)


def test_a_wheel_above_the_ground_feels_nothing():
    axles = np.tile([0.0, 0.0, SPEC.wheel.radius + 1e-4], (6, 1))
    forces = tyres(ground()).step(axles, AXES, STILL, STILL, TICK)
    assert not forces.forces_in_world.any()
    assert not forces.deflections.any()


def test_force_on_a_slope_is_along_its_normal():
    slope = np.deg2rad(14.0)
    normal = np.array([-np.sin(slope), 0.0, np.cos(slope)])
    axles = np.tile((SPEC.wheel.radius - 0.05) * normal, (6, 1))
    forces = tyres(ground(slope)).step(axles, AXES, STILL, STILL, TICK)
    direction = forces.forces_in_world[0] / np.linalg.norm(forces.forces_in_world[0])
    assert direction == pytest.approx(normal, abs=1e-3)
    assert forces.deflections[0] == pytest.approx(0.05, abs=1e-3)


def test_a_dragged_tyre_sticks_then_slips_at_coulombs_limit():
    model, friction = tyres(ground(), friction=0.5), 0.5
    axles = np.tile([0.0, 0.0, SPEC.wheel.radius - 0.05], (6, 1))
    creep, sideways = 0.01, []
    velocity = np.tile([creep, 0.0, 0.0], (6, 1))
    for _ in range(1200):
        axles = axles + velocity * TICK
        forces = model.step(axles, AXES, velocity, STILL, TICK)
        sideways.append(-forces.forces_in_world[0, 0])
    limit = friction * forces.loads[0]
    assert max(sideways) <= limit * (1 + 1e-9)
    assert sideways[-1] == pytest.approx(limit, rel=1e-6)
    stretch = 48 * creep * TICK
    damper = 2 * TRIAL.truth.tyre_damping_ratio * np.sqrt(TRIAL.truth.tyre_lateral_stiffness * SPEC.mass / 6) * creep
    assert sideways[47] == pytest.approx(TRIAL.truth.tyre_lateral_stiffness * stretch + damper, rel=0.02)


def test_a_hull_in_a_wall_is_measured_deep():
    grid = ground()
    heights = grid.heights.copy()
    heights[grid.centres()[0] > 0.30] = 1.0
    wall = replace(grid, heights=heights)
    depths, places = tyres(wall).hull_depths(np.tile([0.15, 0.0, 0.5], (6, 1)), AXES)
    assert depths[0] > 0.01
    assert places[0, 0] > 0.2
    assert tyres(wall).hull_depths(np.tile([-0.5, 0.0, 0.5], (6, 1)), AXES)[0].max() == 0.0


def servos(start: np.ndarray) -> Servos:
    return Servos(TRIAL.truth, SPEC.torque_limits, np.full((6, 6), 10.0), start)


def test_torque_is_the_wind_up_times_the_stiffness():
    """Robot facts 2.4: 2165 N m wind a hip up by 1.2 deg."""
    start = np.zeros((6, 6))
    model = servos(start)
    links = start.copy()
    links[:, 1] = -np.deg2rad(1.0)
    torques = model.step(links, np.zeros((6, 6)), start, np.full((6, 6), 0.1), TICK)
    assert torques[:, 1] == pytest.approx(np.full(6, 1e5 * np.deg2rad(1.0)))
    assert np.rad2deg(SPEC.torque_limits[1] / TRIAL.truth.joint_stiffness[1]) == pytest.approx(1.24, abs=0.01)


def test_motors_follow_at_their_rate_limit_and_are_not_driven_back():
    model, zero = servos(np.zeros((6, 6))), np.zeros((6, 6))
    for _ in range(240):
        model.step(zero + model.motors, zero, np.full((6, 6), 0.5), np.full((6, 6), 0.1), TICK)
    assert model.motors == pytest.approx(np.full((6, 6), 0.1), rel=1e-6)
    held = model.motors.copy()
    model.step(held - 0.005, zero, held, np.full((6, 6), 0.1), TICK)
    assert np.array_equal(model.motors, held)


def test_beyond_the_torque_limit_the_motor_gives_way():
    model, zero = servos(np.zeros((6, 6))), np.zeros((6, 6))
    links = np.full((6, 6), -1.0)
    torques = model.step(links, zero, zero, np.full((6, 6), 0.1), TICK)
    assert torques == pytest.approx(np.tile(SPEC.torque_limits, (6, 1)))
    assert model.torques(links) == pytest.approx(np.tile(SPEC.torque_limits, (6, 1)))
