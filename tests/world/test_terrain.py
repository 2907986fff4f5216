import numpy as np
import pytest

from athlete_twin.errors import TerrainError
from athlete_twin.world.rocks import RockShape, across_line, draw_diameters
from athlete_twin.world.scenario import RockField
from athlete_twin.world.soil import MATERIALS
from athlete_twin.world.terrain import build_terrain, load_scenario

SDM_B_WHEELS = 1.95 * np.array([[np.cos(a), np.sin(a)] for a in np.deg2rad([0, 60, 120, 180, 240, 300])])
NOWHERE = np.zeros((0, 2))
CLEAR = 0.35


def built(name, seed=0, clear_xy=SDM_B_WHEELS):
    return build_terrain(load_scenario(name), seed, clear_xy=clear_xy, clear_radius=CLEAR)


@pytest.mark.parametrize("k", [0.05, 0.10, 0.15])
def test_rock_diameters_follow_the_cumulative_area_fraction(k):
    field = RockField(k=k)
    area, seeds = 24.0 * 24.0, 150
    drawn = [draw_diameters(field, area, np.random.default_rng([s, 1])) for s in range(seeds)]
    q = 1.79 + 0.152 / k
    for d in (0.15, 0.3, 0.6, 1.0):
        formula = k * (np.exp(-q * d) - np.exp(-q * 1.5))
        per_seed = np.array([0.25 * np.pi * np.sum(n[n >= d] ** 2) / area for n in drawn])
        three_sigma = 3.0 * per_seed.std() / np.sqrt(seeds)
        assert abs(per_seed.mean() - formula) < three_sigma + 0.002 * formula
        assert field.area_fraction(d) == pytest.approx(formula)


@pytest.mark.slow
@pytest.mark.ci
def test_ground_seen_as_rock_is_the_area_fraction_of_the_formula():
    covered = [np.mean(built("rock_field", seed, NOWHERE).rock_index >= 0) for seed in range(4)]
    formula = 0.10 * (np.exp(-3.31 * 0.15) - np.exp(-3.31 * 1.5))
    assert np.mean(covered) == pytest.approx(formula, rel=0.12)


def test_rock_outline_covers_the_area_of_its_disc():
    u = np.linspace(-1.6, 1.6, 401)
    for seed in range(12):
        shape = RockShape(np.random.default_rng(seed)).height(u[:, None], u[None, :])
        assert np.count_nonzero(shape > 0) * (u[1] - u[0]) ** 2 == pytest.approx(np.pi, rel=0.05)
        assert shape.max() == pytest.approx(1.0, abs=0.03)


def test_rocks_stand_between_four_and_six_tenths_of_their_diameter_above_the_ground():
    terrain = built("rock_field")
    assert len(terrain.rocks) > 300
    above = terrain.grid.heights - terrain.ground.heights
    for i, rock in enumerate(terrain.rocks):
        assert 0.4 * rock.diameter <= rock.height <= 0.6 * rock.diameter
        if rock.diameter > 0.5 and np.hypot(rock.x, rock.y) < 8:
            measured = above[terrain.rock_index == i].max()
            assert measured == pytest.approx(rock.height, abs=0.05)


def test_only_the_first_patches_are_clear_of_rocks():
    scenario = load_scenario("rock_field")
    all_rocks = build_terrain(scenario, 3, clear_xy=NOWHERE, clear_radius=CLEAR).rocks
    kept = build_terrain(scenario, 3, clear_xy=SDM_B_WHEELS, clear_radius=CLEAR).rocks
    reach = [min(np.hypot(*(SDM_B_WHEELS - [r.x, r.y]).T)) - 0.5 * r.diameter for r in all_rocks]
    assert kept == tuple(r for r, d in zip(all_rocks, reach, strict=True) if d >= CLEAR)
    assert 0 < len(kept) < len(all_rocks)


@pytest.mark.parametrize("wheels", [SDM_B_WHEELS, 2.8 * SDM_B_WHEELS[:, ::-1] / 1.95])
def test_black_point_has_two_large_rocks_across_the_line_for_every_seed(wheels):
    from athlete_twin.world.rocks import scatter_rocks

    scenario = load_scenario("black_point")
    for seed in range(12):
        rocks = scatter_rocks(scenario, np.random.default_rng(seed), clear_xy=wheels, clear_radius=CLEAR)
        assert across_line(rocks, scenario.goal_distance, diameter=0.8) >= 2


def test_moses_lake_keeps_its_rock_to_step_over():
    for wheels in (SDM_B_WHEELS, 2.8 * SDM_B_WHEELS[:, ::-1] / 1.95):
        assert len(built("moses_lake", 5, wheels).rocks) == 1


@pytest.mark.parametrize("angle", [7, 14])
def test_slope_rises_towards_the_goal_by_its_angle(angle):
    grid = built(f"slope_{angle}").grid
    rise = grid.sample(np.array([10.0, 0.0])) - grid.sample(np.array([-8.0, 0.0]))
    assert np.rad2deg(np.arctan(rise / 18.0)) == pytest.approx(angle, abs=0.3)


@pytest.mark.parametrize(
    "name", ["calibration_yard", "rock_field", "moses_lake", "black_point", "slope_7", "measured_map"]
)
@pytest.mark.slow
@pytest.mark.ci
def test_ground_is_finite_zero_at_the_start_and_the_same_bytes_again(name):
    first, again = built(name), built(name)
    assert np.isfinite(first.grid.heights).all()
    assert float(first.ground.sample(np.zeros(2))) == pytest.approx(0.0, abs=1e-12)
    assert first.grid.heights.tobytes() == again.grid.heights.tobytes()
    assert first.albedo.tobytes() == again.albedo.tobytes()
    assert not first.grid.heights.flags.writeable


def test_another_seed_gives_another_field():
    assert built("rock_field", 0).rocks != built("rock_field", 1).rocks


def test_mesh_is_the_height_field_with_its_faces_up():
    terrain = built("measured_map")
    vertices, triangles = terrain.mesh()
    a, b, c = (vertices[triangles[::97, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    np.testing.assert_allclose(terrain.height(vertices[::131, :2]), vertices[::131, 2], atol=1e-6)


def test_measured_map_keeps_the_measured_heights():
    import cv2

    scenario = load_scenario("measured_map")
    counts = cv2.imread(str(scenario.file), cv2.IMREAD_UNCHANGED)[::-1].T
    terrain = built("measured_map")
    ix, iy = 80, 70
    at = np.array([ix * 0.08 - 6.0, iy * 0.08 - 6.0])
    start = 0.001 * counts[75, 75]
    assert float(terrain.height(at)) == pytest.approx(0.001 * counts[ix, iy] - start, abs=0.01)


def test_negative_seed_is_refused():
    with pytest.raises(TerrainError, match="seed is -1"):
        built("calibration_yard", -1)


def test_sinkage_inverts_pressure_and_rock_is_hard():
    for soil in MATERIALS.values():
        depth = np.array([0.001, 0.01, 0.05])
        np.testing.assert_allclose(soil.sinkage(soil.pressure(depth)), depth, rtol=1e-9)
    assert MATERIALS["rock"].sinkage(55e3) < 1e-4
    assert 0.03 < MATERIALS["dune_sand"].sinkage(55e3) < 0.06


def test_friction_is_the_rocks_own_on_a_rock():
    terrain = built("rock_field")
    rock = max(terrain.rocks, key=lambda r: r.diameter)
    mu = terrain.friction_at(np.array([[rock.x, rock.y], SDM_B_WHEELS[0]]))
    assert list(mu) == [MATERIALS["rock"].friction, terrain.friction]
