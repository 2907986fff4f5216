"""Shadow rays are left out only where a ray cast would have found the sun."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.sensors.backdrop import ground_mesh
from athlete_twin.sensors.sun_cover import SunCover
from athlete_twin.world.terrain import build_terrain, load_scenario

POINTS = 100_000


@pytest.fixture(scope="module")
def ground():
    """A terrain, its triangles beyond the border, and a ray caster of all of it."""
    terrain = build_terrain(load_scenario("rock_field"), 3, clear_xy=np.zeros((0, 2)), clear_radius=0.3)
    vertices, triangles, _ = ground_mesh(terrain)
    nx, ny = terrain.grid.shape
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32)))
    return terrain, vertices[triangles[2 * (nx - 1) * (ny - 1) :]], scene


@pytest.mark.parametrize("azimuth", [0.0, 33.0, 135.0, 260.0])
@pytest.mark.parametrize("elevation", [4.0, 15.0, 35.0, 70.0])
def test_no_shaded_point_is_left_out(ground, elevation, azimuth):
    terrain, beyond, scene = ground
    scenario = replace(load_scenario("rock_field"), sun_elevation=np.deg2rad(elevation), sun_azimuth=np.deg2rad(azimuth))
    sun = scenario.sun_in_world()
    cover = SunCover(terrain.grid, beyond, sun)
    o3d = open3d()
    rng = np.random.default_rng(5)
    x, y = terrain.grid.centres()
    xy = rng.uniform([x[0], y[0]], [x[-1], y[-1]], (POINTS, 2))
    # No lower than the renderer starts its rays: a point on the surface is shaded by rounding.
    lift = 0.004 + np.where(rng.random(POINTS) < 0.8, 0.0, rng.exponential(0.3, POINTS))
    # Onto the triangles: between the corners of a cell they are not the surface that the grid's samples lie on.
    above = np.column_stack([xy, np.full(POINTS, 9.0), np.tile([0.0, 0.0, -1.0], (POINTS, 1))]).astype(np.float32)
    height = 9.0 - scene.cast_rays(o3d.core.Tensor(above))["t_hit"].numpy()
    rays = np.column_stack([xy, height + lift, np.tile(sun, (POINTS, 1))]).astype(np.float32)
    shaded = scene.test_occlusions(o3d.core.Tensor(rays)).numpy()
    may = cover.may_shade(rays)
    assert not (shaded & ~may).any()
    if elevation >= 35.0:
        assert may.mean() < 0.4  # most need not be asked


def test_a_sun_straight_up_or_down_asks_everywhere(ground):
    terrain, _, _ = ground
    for sun in (np.array([0.0, 0.0, 1.0]), np.array([0.995, 0.0, -0.1])):
        cover = SunCover(terrain.grid, np.zeros((0, 3, 3)), sun)
        assert cover.may_shade(np.zeros((4, 3), np.float32)).all()
