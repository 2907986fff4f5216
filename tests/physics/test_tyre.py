"""Tyres and soil against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.model.spec import load_spec
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.physics.tyre import Footing, Tyres
from athlete_twin.world.bullet_world import TICK
from athlete_twin.world.soil import MATERIALS

SPEC = load_spec("sdm_b")
TRIAL = nominal_truth(SPEC)
AXES = np.tile([0.0, 1.0, 0.0], (6, 1))
STILL = np.zeros((6, 3))


def ground(slope: float = 0.0) -> HeightGrid:
    x = np.arange(-3.0, 3.0, 0.05)
    return HeightGrid(origin_x=-3.0, origin_y=-3.0, cell=0.05, heights=np.repeat(np.tan(slope) * x[:, None], len(x), axis=1))


def tyres(grid: HeightGrid, friction: float = 0.7) -> Tyres:
    return Tyres(SPEC.wheel, TRIAL, grid, Footing.hard(friction), sprung_mass=SPEC.mass)


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


def on_soil(name: str, *, is_rock: np.ndarray | None = None) -> Tyres:
    soil = MATERIALS[name]
    footing = Footing(friction=soil.friction, rock_friction=0.8, soil=soil, is_rock=is_rock)
    return Tyres(SPEC.wheel, TRIAL, ground(), footing, sprung_mass=SPEC.mass)


def pressed(model: Tyres, depth: float, *, x: float = 0.0):
    return model.step(np.tile([x, 0.0, SPEC.wheel.radius - depth], (6, 1)), AXES, STILL, STILL, TICK)


@pytest.mark.parametrize("name", ["packed_soil", "dune_sand"])
@pytest.mark.parametrize("depth", [0.03, 0.08, 0.12])
def test_soil_and_tyre_carry_the_same_load_in_series(name, depth):
    """P = k delta^n of [Caillas1989] eq. 5 under the patch, F = k1 d + k2 d^2 in the tyre, d + delta as deep as it is."""
    model, soil = on_soil(name), MATERIALS[name]
    load = pressed(model, depth).loads[0]
    deflection, sunk = depth - model.ruts[0], model.ruts[0]
    assert load == pytest.approx(TRIAL.truth.tyre_k1 * deflection + TRIAL.truth.tyre_k2 * deflection**2)
    patch = 5e-3 + load / SPEC.wheel.pressure
    assert soil.sinkage_modulus * sunk**soil.sinkage_exponent == pytest.approx(load / patch, rel=0.03)


def test_soil_stays_down_until_the_wheel_leaves():
    model = on_soil("dune_sand")
    pressed(model, 0.10)
    rut = model.ruts[0]
    assert rut > 0.03
    assert pressed(model, rut - 0.001).loads[0] == 0.0
    assert model.ruts[0] == rut
    assert pressed(model, rut + 0.02).deflections[0] == pytest.approx(0.02)
    pressed(model, -0.01)
    assert model.ruts[0] == 0.0


def test_rocks_are_hard_and_have_their_own_friction():
    rock = np.zeros(ground().shape, dtype=bool)
    rock[ground().centres()[0] > 0.5] = True
    model = on_soil("dune_sand", is_rock=rock)
    assert pressed(model, 0.06, x=1.5).deflections[0] == pytest.approx(0.06)
    assert pressed(on_soil("dune_sand", is_rock=rock), 0.06, x=-1.5).deflections[0] < 0.05


def test_a_flat_tyre_carries_its_part():
    model = tyres(ground())
    before = pressed(model, 0.06).loads
    model.lose_pressure(2, 0.25)
    after = pressed(model, 0.06).loads
    assert after[2] == pytest.approx(0.25 * before[2])
    assert np.delete(after, 2) == pytest.approx(np.delete(before, 2))


def test_of_two_losses_of_one_tyre_the_greater_counts():
    once, twice, again = tyres(ground()), tyres(ground()), tyres(ground())
    once.lose_pressure(2, 0.4)
    for part in (0.6, 0.4):
        twice.lose_pressure(2, part)
    for part in (0.4, 0.6):  # a tyre only loses
        again.lose_pressure(2, part)
    load = pressed(once, 0.06).loads[2]
    assert pressed(twice, 0.06).loads[2] == load
    assert pressed(again, 0.06).loads[2] == load


def test_a_soft_tyre_keeps_its_damping_ratio():
    """c = 2 zeta sqrt(k m): a quarter of the stiffness damps half as much at the same ratio."""
    sinking = np.tile([0.0, 0.0, -0.1], (6, 1))
    axles = np.tile([0.0, 0.0, SPEC.wheel.radius - 0.06], (6, 1))

    def damped(model: Tyres) -> float:
        return float(model.step(axles, AXES, sinking, STILL, TICK).loads[2] - pressed(model, 0.06).loads[2])

    soft = tyres(ground())
    soft.lose_pressure(2, 0.25)
    assert damped(soft) == pytest.approx(0.5 * damped(tyres(ground())))


def test_a_soft_tyre_spreads_its_load_and_sinks_less():
    """Stiffness and contact pressure both go with the air: half of it, half the pressure on the soil at high load."""
    soil = MATERIALS["dune_sand"]
    firm, soft = on_soil("dune_sand"), on_soil("dune_sand")
    soft.lose_pressure(0, 0.5)
    load = pressed(soft, 0.12).loads[0]
    sunk = soft.ruts[0]
    assert soil.sinkage_modulus * sunk**soil.sinkage_exponent == pytest.approx(
        load / (5e-3 + load / (0.5 * SPEC.wheel.pressure)), rel=0.03
    )
    deeper = next(d for d in np.arange(0.02, 0.12, 0.0005) if pressed(firm, d).loads[0] >= load)
    assert pressed(firm, deeper).loads[0] == pytest.approx(load, rel=0.05)
    assert sunk < 0.8 * firm.ruts[0]


def test_lost_pressure_is_part_of_what_is_saved():
    model = tyres(ground())
    before, fresh = model.state(), pressed(model, 0.06).loads
    model.lose_pressure(2, 0.25)
    after = model.state()
    model.set_state(before)
    assert np.array_equal(pressed(model, 0.06).loads, fresh)
    model.lose_pressure(2, 0.5)
    assert pressed(model, 0.06).loads[2] == pytest.approx(0.5 * fresh[2])
    model.set_state(after)
    assert pressed(model, 0.06).loads[2] == pytest.approx(0.25 * fresh[2])


def test_a_rolling_wheel_creeps_in_proportion_to_its_pull():
    """A bristle leaves the patch within its length, so the pull is k_t x creep x length over the rolling speed."""
    model = tyres(ground())
    depth, rate = 0.05, 2.0
    length = 2 * np.sqrt(2 * SPEC.wheel.radius * depth - depth**2)
    arm = SPEC.wheel.radius - depth - pressed(model, depth).patches_in_world[0, 2]
    assert SPEC.wheel.radius - depth < arm < SPEC.wheel.radius
    creep = 0.01 * rate * arm
    velocity, spins = np.tile([rate * arm - creep, 0.0, 0.0], (6, 1)), rate * AXES
    axles = np.tile([-2.0, 0.0, SPEC.wheel.radius - depth], (6, 1))
    for _ in range(1200):
        axles = axles + velocity * TICK
        forces = model.step(axles, AXES, velocity, spins, TICK)
    truth = TRIAL.truth
    damper = 2 * truth.tyre_damping_ratio * np.sqrt(truth.tyre_lateral_stiffness * SPEC.mass / 6)
    relaxed = truth.tyre_lateral_stiffness * creep * length / (rate * SPEC.wheel.radius)
    assert forces.forces_in_world[0, 0] == pytest.approx(relaxed + damper * creep, rel=0.05)


def test_a_tyre_on_the_edge_of_a_step_lies_still():
    """The force changes without jumps as a wheel is moved over an edge, so nothing can jitter there."""
    grid = ground()
    heights = grid.heights.copy()
    heights[grid.centres()[0] > 0.0] = 0.06
    step = replace(grid, heights=heights)
    loads = []
    for x in np.arange(-0.4, 0.1, 0.001):
        model = tyres(step)
        loads.append(model.step(np.tile([x, 0.0, SPEC.wheel.radius + 0.02], (6, 1)), AXES, STILL, STILL, TICK).loads[0])
    change = np.abs(np.diff(loads))
    assert max(loads) > 500.0
    assert change.max() < 0.05 * max(loads)
