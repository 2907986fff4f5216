"""From what the rays hit to light: one pass over the pixels before the shadow rays. Compiled; same bytes on any threads."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, no_type_check

import numba
import numpy as np
from scipy.ndimage import gaussian_filter

from athlete_twin.sensors.texture import GROUND, ROBOT, ROCK, SKY, grain
from athlete_twin.world.terrain import Terrain

SKYLIGHT = 0.26
"""irradiance of the open sky over that of the sun"""
GROUND_ALBEDO = 0.3
"""of the ground that throws light up against a robot's belly"""
MAX_THREADS = 8
PIXELS_A_THREAD = 20_000
"""fewer are not worth a thread"""
SLOPE_X, SLOPE_Y, ROCKY, ALBEDO, OPENNESS = range(5)
"""layers of the surface fields"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Surface:
    """What each ray met and how bright it is, flat over the rays; float32 where not said otherwise."""

    depth: np.ndarray
    """along the boresight, NaN for sky [m]"""
    label: np.ndarray
    """sky, ground, rock or robot, uint8"""
    part: np.ndarray
    """index of the robot's part, -1 elsewhere, int32"""
    rocky: np.ndarray
    """share of rock in the cell's surroundings"""
    points: np.ndarray
    """in world, shape (n, 3) [m]"""
    facets: np.ndarray
    """outward normals of the triangles, shape (n, 3)"""
    normals: np.ndarray
    """smooth normals bent by the grain, shape (n, 3)"""
    albedo: np.ndarray
    """with grain"""
    ambient: np.ndarray
    """light of sky and ground"""
    toward: np.ndarray
    """cosine to the sun, 0 where the surface faces away"""


def surface_fields(terrain: Terrain) -> np.ndarray:
    """Layers that shading reads between cells: slopes, rock, albedo, openness; shape (nx, ny, 5), float32."""
    heights, cell = terrain.grid.heights, terrain.grid.cell
    fields = np.empty((*heights.shape, 5), dtype=np.float32)
    fields[..., SLOPE_X], fields[..., SLOPE_Y] = np.gradient(heights, cell)
    fields[..., ROCKY] = terrain.rock_index >= 0
    fields[..., ALBEDO] = terrain.albedo
    # A place lower than its surroundings sees less of the sky.
    openness = np.ones(heights.shape)
    for radius in (0.08, 0.25):
        hollow = gaussian_filter(heights, radius / cell) - heights
        openness *= np.exp(-1.6 * np.maximum(hollow, 0.0) / radius)
    fields[..., OPENNESS] = openness
    return fields


def shade(
    ground: dict[str, Any],
    robot: dict[str, Any] | None,
    *,
    origin: np.ndarray,
    directions: np.ndarray,
    near: float,
    focal: float,
    terrain: Terrain,
    fields: np.ndarray,
    first_far_rock: int,
    part_of_triangle: np.ndarray,
    link_from_world: np.ndarray,
    part_albedo: np.ndarray,
    sun: np.ndarray,
) -> Surface:
    """Everything about the pixels but their shadows.

    Args:
        ground: Open3D's answer for the rays against the ground.
        robot: the same against the robot, None without one.
        origin: of the rays, before the shift by `near`, shape (3,) [m].
        directions: length 1 along the boresight, shape (n, 3).
        near: how far along its direction each ray started [m].
        focal: of the eye [px].
        terrain: for the grid's place.
        fields: of `surface_fields`.
        first_far_rock: triangles of the ground from here on are rocks beyond the border.
        part_of_triangle: index of the robot's part by triangle.
        link_from_world: of each part's link, shape (parts, 3, 4).
        part_albedo: shape (parts,).
        sun: unit vectors towards the sun, one for all (1, 3) or one a ray (n, 3).
    """
    n = len(directions)
    at = {k: np.empty(n, dtype=np.float32) for k in ("depth", "rocky", "albedo", "ambient", "toward")}
    vectors = {k: np.empty((n, 3), dtype=np.float32) for k in ("points", "facets", "normals")}
    label, part = np.empty(n, dtype=np.uint8), np.empty(n, dtype=np.int32)
    ids = ground["primitive_ids"].numpy()
    if robot is None:
        t_robot, n_robot, id_robot = np.full(n, np.inf, dtype=np.float32), vectors["facets"], ids
    else:
        t_robot, n_robot = robot["t_hit"].numpy(), robot["primitive_normals"].numpy()
        id_robot = robot["primitive_ids"].numpy()
    grid = terrain.grid
    place = np.array([grid.origin_x, grid.origin_y, grid.cell])
    t_ground, n_ground = ground["t_hit"].numpy(), ground["primitive_normals"].numpy()
    suns = np.ascontiguousarray(sun)

    def shade_slice(k: slice) -> None:
        _shade(
            t_ground[k], n_ground[k], ids[k], t_robot[k], n_robot[k], id_robot[k],
            origin, directions[k], near, focal, place, fields, first_far_rock,
            float(terrain.rock_material.albedo), float(terrain.soil.albedo),
            part_of_triangle, link_from_world, part_albedo, suns if len(suns) == 1 else suns[k],
            at["depth"][k], label[k], part[k], at["rocky"][k], vectors["points"][k], vectors["facets"][k],
            vectors["normals"][k], at["albedo"][k], at["ambient"][k], at["toward"][k],
        )  # fmt: skip

    # Pixels do not know of each other: threads share them out, and the bytes stay the same.
    threads = min(MAX_THREADS, len(os.sched_getaffinity(0)), 1 + n // PIXELS_A_THREAD)
    edges = np.linspace(0, n, threads + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(shade_slice, [slice(a, b) for a, b in pairwise(edges.tolist())]))
    return Surface(label=label, part=part, **at, **vectors)


@no_type_check
@numba.njit(nogil=True, cache=True, error_model="numpy")
def _shade(  # type: ignore[no-untyped-def]
    t_ground, n_ground, id_ground, t_robot, n_robot, id_robot,
    origin, directions, near, focal, grid, fields, first_far_rock,
    rock_albedo, soil_albedo, part_of_triangle, link_from_world, part_albedo, sun,
    depth, label, part, rocky, points, facets, normals, albedo, ambient, toward,
):  # fmt: skip
    nx_cells, ny_cells = fields.shape[0], fields.shape[1]
    layer = np.empty(5)
    for i in range(t_ground.shape[0]):
        t = min(t_ground[i], t_robot[i])
        part[i], rocky[i], ambient[i], toward[i], albedo[i] = -1, 0.0, 0.0, 0.0, 0.0
        if not t < 1.0e6:
            label[i], depth[i] = SKY, np.nan
            for k in range(3):
                points[i, k], facets[i, k], normals[i, k] = 0.0, 0.0, 0.0
            continue
        d = t + near
        depth[i] = d
        px, py, pz = (
            origin[0] + d * directions[i, 0],
            origin[1] + d * directions[i, 1],
            origin[2] + d * directions[i, 2],
        )
        points[i, 0], points[i, 1], points[i, 2] = px, py, pz
        view = np.sqrt(directions[i, 0] ** 2 + directions[i, 1] ** 2 + directions[i, 2] ** 2)
        on_robot = t_robot[i] < t_ground[i]
        if on_robot:
            fx, fy, fz = n_robot[i, 0], n_robot[i, 1], n_robot[i, 2]
            if fx * directions[i, 0] + fy * directions[i, 1] + fz * directions[i, 2] > 0.0:
                fx, fy, fz = -fx, -fy, -fz
        else:
            fx, fy, fz = n_ground[i, 0], n_ground[i, 1], n_ground[i, 2]
        facets[i, 0], facets[i, 1], facets[i, 2] = fx, fy, fz
        facing = abs(fx * directions[i, 0] + fy * directions[i, 1] + fz * directions[i, 2]) / view
        # A pixel's patch is longer where the surface is seen at a flat angle; the mean of both sides counts.
        footprint = d / focal / np.sqrt(max(facing, 0.04))
        if on_robot:
            label[i] = ROBOT
            p = part_of_triangle[id_robot[i]]
            part[i] = p
            m = link_from_world[p]
            factor, bx, by, bz = grain(
                m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3],
                m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3],
                m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3],
                m[0, 0] * fx + m[0, 1] * fy + m[0, 2] * fz,
                m[1, 0] * fx + m[1, 1] * fy + m[1, 2] * fz,
                m[2, 0] * fx + m[2, 1] * fy + m[2, 2] * fz,
                ROBOT, footprint,
            )  # fmt: skip
            qx = m[0, 0] * bx + m[1, 0] * by + m[2, 0] * bz
            qy = m[0, 1] * bx + m[1, 1] * by + m[2, 1] * bz
            qz = m[0, 2] * bx + m[1, 2] * by + m[2, 2] * bz
            albedo[i] = part_albedo[p] * factor
            openness = 1.0
        else:
            u = min(max((px - grid[0]) / grid[2], 0.0), nx_cells - 1.0001)
            v = min(max((py - grid[1]) / grid[2], 0.0), ny_cells - 1.0001)
            ix, iy = int(u), int(v)
            a, b = u - ix, v - iy
            for k in range(5):
                low = fields[ix, iy, k] * (1.0 - a) + fields[ix + 1, iy, k] * a
                high = fields[ix, iy + 1, k] * (1.0 - a) + fields[ix + 1, iy + 1, k] * a
                layer[k] = low + b * (high - low)
            outside = (
                px < grid[0] or py < grid[1]
                or px > grid[0] + (nx_cells - 1) * grid[2] or py > grid[1] + (ny_cells - 1) * grid[2]
            )  # fmt: skip
            if outside:
                far_rock = id_ground[i] >= first_far_rock
                rocky[i] = 1.0 if far_rock else 0.0
                beyond = np.hypot(
                    max(grid[0] - px, px - grid[0] - (nx_cells - 1) * grid[2], 0.0),
                    max(grid[1] - py, py - grid[1] - (ny_cells - 1) * grid[2], 0.0),
                )
                # The border's patches fade into the plain, or they would be drawn out to the horizon.
                kept = np.exp(-beyond / 0.7) * (1.0 - layer[ROCKY])
                base = rock_albedo if far_rock else soil_albedo + kept * (layer[ALBEDO] - soil_albedo)
                openness = 1.0
                # The plain's facets are metres long and slivers; level shading hides them.
                sx, sy, sz = (fx, fy, fz) if far_rock else (0.0, 0.0, 1.0)
            else:
                rocky[i], base, openness = layer[ROCKY], layer[ALBEDO], layer[OPENNESS]
                sz = 1.0 / np.sqrt(1.0 + layer[SLOPE_X] ** 2 + layer[SLOPE_Y] ** 2)
                sx, sy = -layer[SLOPE_X] * sz, -layer[SLOPE_Y] * sz
            label[i] = ROCK if rocky[i] > 0.5 else GROUND
            factor, qx, qy, qz = grain(px, py, pz, sx, sy, sz, label[i], footprint)
            albedo[i] = base * factor
        normals[i, 0], normals[i, 1], normals[i, 2] = qx, qy, qz
        s = i if sun.shape[0] > 1 else 0
        cosine = qx * sun[s, 0] + qy * sun[s, 1] + qz * sun[s, 2]
        if cosine > 0.0 and fx * sun[s, 0] + fy * sun[s, 1] + fz * sun[s, 2] > 0.0:
            toward[i] = cosine
        sky = 0.5 + 0.5 * qz
        ambient[i] = SKYLIGHT * sky * openness + GROUND_ALBEDO * 0.7 * max(sun[s, 2], 0.0) * (1.0 - sky)
