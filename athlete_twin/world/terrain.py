"""The true ground of one trial: height field, rocks, soil and looks, from a scenario and a seed.

Only the wheels' first patches are kept free of rocks. The planner never sees this: it sees images of it.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import TerrainError
from athlete_twin.geometry.arrays import Cells, Vec2
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.world.relief import fractal, relief
from athlete_twin.world.rocks import RockShape, scatter_rocks
from athlete_twin.world.scenario import Rock, RockField, Scenario, load_scenario
from athlete_twin.world.soil import ROCK, SoilMaterial, soil_material

__all__ = ["Rock", "RockField", "Scenario", "Terrain", "build_terrain", "load_scenario"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Terrain:
    """Ground truth. Arrays are read-only."""

    scenario: Scenario
    seed: int
    grid: HeightGrid
    """true surface with rocks"""
    ground: HeightGrid
    """the same without rocks"""
    rocks: tuple[Rock, ...]
    rock_index: np.ndarray
    """index into `rocks` of the rock that is the surface there, -1 for ground, shape (nx, ny)"""
    friction: float
    """Coulomb coefficient between the rocks"""
    soil: SoilMaterial
    """between the rocks"""
    rock_material: SoilMaterial
    albedo: Cells
    """share of the sunlight reflected, before the renderer adds its fine texture"""
    goal: Vec2
    """in world [m]"""

    def height(self, xy: np.ndarray) -> np.ndarray:
        """Height of the surface under points (..., 2) [m]."""
        return self.grid.sample(xy)

    def normal(self, xy: np.ndarray) -> np.ndarray:
        """Upward unit normal of the surface under points (..., 2)."""
        return self.grid.normal(xy)

    def on_rock(self, xy: np.ndarray) -> np.ndarray:
        """Whether points (..., 2) lie on a rock."""
        ix, iy, _ = self.grid.index(xy)
        return np.asarray(self.rock_index[ix, iy] >= 0)

    def friction_at(self, xy: np.ndarray) -> np.ndarray:
        """Coulomb coefficient under points (..., 2)."""
        return np.where(self.on_rock(xy), self.rock_material.friction, self.friction)

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (nx ny, 3) [m] and triangles (2 (nx-1)(ny-1), 3), outward (upward) by the right hand."""
        x, y = self.grid.centres()
        nx, ny = self.grid.shape
        vertices = np.empty((nx, ny, 3))
        vertices[..., 0] = x[:, None]
        vertices[..., 1] = y[None, :]
        vertices[..., 2] = self.grid.heights
        at = np.arange(nx * ny).reshape(nx, ny)
        a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
        triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
        return vertices.reshape(-1, 3), triangles


def generator(seed: int, stream: str, index: int = 0) -> np.random.Generator:
    """The random generator of one named stream of the world."""
    return np.random.default_rng([seed, zlib.crc32(stream.encode()), index])


def build_terrain(scenario: Scenario, seed: int, *, clear_xy: np.ndarray, clear_radius: float) -> Terrain:
    """The ground of one trial; the same arguments give the same bytes.

    Args:
        scenario: what kind of ground.
        seed: of the trial, not negative.
        clear_xy: the wheels' first patches in world, shape (n, 2) [m]; no rock reaches into them.
        clear_radius: of these patches [m].
    """
    clear_xy = np.asarray(clear_xy, dtype=float).reshape(-1, 2)
    if seed < 0:
        raise TerrainError(f"seed is {seed}, must be 0 or more")
    if not (np.isfinite(clear_xy).all() and np.isfinite(clear_radius) and clear_radius >= 0.0):
        raise TerrainError(f"clear_xy must be finite and clear_radius not negative, got {clear_radius} m")
    nx, ny = (round(s / scenario.cell) + 1 for s in scenario.size)
    x = scenario.x_min + scenario.cell * np.arange(nx)
    y = scenario.cell * (np.arange(ny) - 0.5 * (ny - 1))
    bare = relief(scenario, x, y, generator(seed, "relief"))
    origin = HeightGrid(origin_x=float(x[0]), origin_y=float(y[0]), cell=scenario.cell, heights=bare)
    ground = origin.heights - float(origin.sample(np.zeros(2)))
    rocks = scatter_rocks(scenario, generator(seed, "rocks"), clear_xy=clear_xy, clear_radius=clear_radius)
    surface, rock_index = _lay_rocks(ground, x, y, rocks, seed)
    soil = soil_material(scenario.soil)
    patches = fractal(x, y, generator(seed, "albedo"), wavelength=3.0, octaves=4, gain=0.6)
    albedo = soil.albedo * (1.0 + 0.10 * np.clip(patches, -2.0, 2.0))
    tints = np.array([generator(seed, "rock_tint", i).uniform(0.65, 1.35) for i in range(len(rocks))])
    is_rock = rock_index >= 0
    albedo[is_rock] = ROCK.albedo * tints[rock_index[is_rock]]
    for array in (ground, surface, rock_index, albedo):
        array.setflags(write=False)
    shape = {"origin_x": float(x[0]), "origin_y": float(y[0]), "cell": scenario.cell}
    return Terrain(
        scenario=scenario,
        seed=seed,
        grid=HeightGrid(**shape, heights=surface),
        ground=HeightGrid(**shape, heights=ground),
        rocks=rocks,
        rock_index=rock_index,
        friction=scenario.friction,
        soil=soil,
        rock_material=ROCK,
        albedo=albedo,
        goal=np.array([scenario.goal_distance, 0.0]),
    )


def bare_terrain(scenario: Scenario, grid: HeightGrid) -> Terrain:
    """A surface with plain looks under the scenario's sun, without rocks: what is drawn where a robot ran without a ground."""
    soil = soil_material("packed_soil")
    return Terrain(
        scenario=scenario,
        seed=0,
        grid=grid,
        ground=grid,
        rocks=(),
        rock_index=np.full(grid.shape, -1, dtype=np.int32),
        friction=soil.friction,
        soil=soil,
        rock_material=ROCK,
        albedo=np.full(grid.shape, soil.albedo),
        goal=np.array([scenario.goal_distance, 0.0]),
    )


def _lay_rocks(
    ground: np.ndarray, x: np.ndarray, y: np.ndarray, rocks: tuple[Rock, ...], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """The surface with the rocks on it, and which rock each cell shows."""
    surface = ground.copy()
    rock_index = np.full(ground.shape, -1, dtype=np.int32)
    for i, rock in enumerate(rocks):
        # Keyed by place and size, not by rank: a rock keeps its shape when another one is cleared away.
        key = zlib.crc32(np.array([rock.x, rock.y, rock.diameter]).tobytes())
        shape = RockShape(generator(seed, "rock_shape", key))
        reach = 0.85 * rock.diameter
        i0, i1 = np.searchsorted(x, [rock.x - reach, rock.x + reach])
        j0, j1 = np.searchsorted(y, [rock.y - reach, rock.y + reach])
        if i1 - i0 < 1 or j1 - j0 < 1:
            continue
        radius = 0.5 * rock.diameter
        u, v = np.meshgrid((x[i0:i1] - rock.x) / radius, (y[j0:j1] - rock.y) / radius, indexing="ij")
        bump = shape.height(u, v)
        below = ground[i0:i1, j0:j1]
        # A rock stands on the plane through the ground under it, and is buried below.
        design = np.column_stack([np.ones(u.size), u.ravel(), v.ravel()])
        plane = (design @ np.linalg.lstsq(design, below.ravel(), rcond=None)[0]).reshape(u.shape)
        top = plane + rock.height * bump
        patch = surface[i0:i1, j0:j1]
        shows = (bump > 0.0) & (top > patch)
        patch[shows] = top[shows]
        rock_index[i0:i1, j0:j1][shows] = i
    return surface, rock_index
