"""The ground as a picture needs it: the height field, and beyond its border plain ground and coarse rocks to the horizon.

Nothing out there can be walked on or is ever scored; without it cameras aimed at the horizon would see the world's edge.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from athlete_twin.world.rocks import RockShape, draw_diameters
from athlete_twin.world.terrain import Terrain, generator

RINGS = (1.02, 1.12, 1.3, 1.6, 2.2, 3.2, 5.0, 9.0, 18.0, 40.0, 90.0)
"""of plain ground, in multiples of the border's distance from the middle"""
ROCKS_TO = 2.2
"""multiple up to which coarse rocks lie"""
SMALLEST_ROCK = 0.35
"""drawn out there; smaller ones are a few pixels [m]"""
_SPOKES, _LEVELS = 14, (1.0, 0.92, 0.75, 0.45, 0.0)


def ground_mesh(terrain: Terrain) -> tuple[np.ndarray, np.ndarray, int]:
    """Vertices (n, 3) [m], triangles (m, 3), and from which triangle on they are rocks beyond the border."""
    vertices, triangles = terrain.mesh()
    x, y = terrain.ground.centres()
    nx, ny = terrain.ground.shape
    at = np.arange(nx * ny).reshape(nx, ny)
    border = np.concatenate([at[:-1, 0], at[-1, :-1], at[:0:-1, -1], at[0, :0:-1]])
    middle = np.array([0.5 * (x[0] + x[-1]), 0.5 * (y[0] + y[-1])])
    rim = vertices[border].copy()
    # From the bare ground: a rock that the border cuts must not be drawn out to the horizon.
    rim[:, 2] = terrain.ground.heights.ravel()[border]
    design = np.column_stack([np.ones(len(rim)), rim[:, :2] - middle])
    plane = np.linalg.lstsq(design, rim[:, 2], rcond=None)[0]
    uneven = gaussian_filter1d(rim[:, 2] - design @ plane, 0.5 / terrain.ground.cell, mode="wrap")
    sheets, faces, count = [vertices, rim], [triangles], len(vertices) + len(rim)
    before = len(vertices) + np.arange(len(rim))
    for scale in RINGS:
        xy = middle + scale * (rim[:, :2] - middle)
        z = far_height(xy, middle, plane, scale) + uneven * max(0.0, 1.0 - (scale - 1.0) / 0.3)
        sheets.append(np.column_stack([xy, z]))
        here = count + np.arange(len(rim))
        count += len(rim)
        a, b, c, d = before, here, np.roll(here, -1), np.roll(before, -1)
        faces += [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
        before = here
    first_rock = sum(len(f) for f in faces)
    for rock_vertices, rock_triangles in _far_rocks(terrain, middle, plane):
        sheets.append(rock_vertices)
        faces.append(rock_triangles + count)
        count += len(rock_vertices)
    return np.concatenate(sheets), np.concatenate(faces), first_rock


def far_height(xy: np.ndarray, middle: np.ndarray, plane: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    """Height of the plain ground beyond the border: the border's plane, which runs out, with low hills far away [m]."""
    away = xy - middle
    angle = np.arctan2(away[..., 1], away[..., 0])
    hills = np.sin(3.0 * angle + 0.7) + 0.6 * np.sin(7.0 * angle + 2.1) + 0.35 * np.sin(17.0 * angle) + 0.6
    far = np.maximum(np.asarray(scale) - 2.0, 0.0)
    run = np.minimum(scale, 2.2) / scale
    return np.asarray(plane[0] + run * (away @ plane[1:]) + 0.09 * far * np.maximum(hills, -0.1))


def _far_rocks(terrain: Terrain, middle: np.ndarray, plane: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Coarse rocks of the same sizes around the height field."""
    rng = generator(terrain.seed, "far_rocks")
    half = 0.5 * np.array(terrain.scenario.size)
    out = []
    for i, diameter in enumerate(draw_diameters(terrain.scenario.rocks, float(np.prod(2.0 * half)) * ROCKS_TO**2, rng)):
        if diameter < SMALLEST_ROCK:
            break
        relative = rng.uniform(-ROCKS_TO, ROCKS_TO, 2)
        scale = float(np.abs(relative).max())
        if scale < 1.0 + 0.6 * diameter / half.min():
            continue
        shape = RockShape(generator(terrain.seed, "far_rock_shape", i))
        spoke = 2.0 * np.pi * np.arange(_SPOKES) / _SPOKES
        radius = np.repeat(np.array(_LEVELS), _SPOKES)
        u, v = radius * np.tile(np.cos(spoke), len(_LEVELS)), radius * np.tile(np.sin(spoke), len(_LEVELS))
        xy = middle + half * relative
        base = float(far_height(xy, middle, plane, scale)) - 0.04
        z = base + 0.5 * diameter * shape.height(u, v) * (radius < 1.0)
        vertices = np.column_stack([xy[0] + 0.5 * diameter * u, xy[1] + 0.5 * diameter * v, z])
        at = np.arange(len(radius)).reshape(len(_LEVELS), _SPOKES)
        a, b = at[:-1], at[1:]
        c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
        quads = [np.column_stack([p.ravel() for p in face]) for face in ((a, d, c), (a, c, b))]
        out.append((vertices, np.concatenate(quads)))
    return out
