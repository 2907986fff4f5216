"""Judges a believed map against the true surface, cell by cell, where the legs can stand.

**Load-bearing workspace** of a leg: ground cells on which the leg can put its wheel with the last link plumb, as it must
stand to carry load ([SunSpiral2012] s7.1): `leg_ik`, the planner's own test of a footfall's reach, gives an answer for
the axle a wheel's radius above the true ground there, the chassis being where it truly is. The union over six legs is
judged, cells that nothing could have seen (under the chassis, behind rocks) included.

**Ghost**: a cell whose believed height exceeds the highest true ground within `GHOST_RADIUS`. On a rock's flank a shift of
the map by two centimetres is an error of height; it is no ghost, since the rock is there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.terrain.fusion import FusedTerrain

UP = np.array([0.0, 0.0, 1.0])
BAND_SIGMA = 1.645
"""half width of a normal distribution's 90 % band [sigma]"""
GHOST_RADIUS = 0.10
"""two cells: a ghost that is nearer to a true rock of its height is that rock [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class MapScore:
    """How one map compares with the truth, over the cells in reach."""

    error: np.ndarray
    """believed less true, NaN outside reach or where unknown, shape (nx, ny) [m]"""
    sigma: np.ndarray
    """stated, same cells [m]"""
    reach: np.ndarray
    """cells that were judged, shape (nx, ny)"""
    highest_ghost: float
    """by which a cell stands over all true ground near it, at most; negative when none does [m]"""

    @property
    def median(self) -> float:
        """Of the absolute error [m]."""
        return float(np.nanmedian(np.abs(self.error)))

    @property
    def rms(self) -> float:
        """Of the error [m]."""
        return float(np.sqrt(np.nanmean(self.error**2)))

    @property
    def coverage(self) -> float:
        """Share of the cells in reach that are known."""
        return float(np.isfinite(self.error).sum() / max(self.reach.sum(), 1))

    @property
    def band(self) -> float:
        """Share of the known cells in reach whose truth lies within the stated 90 % band."""
        known = np.isfinite(self.error)
        return float(np.mean(np.abs(self.error[known]) <= BAND_SIGMA * self.sigma[known]))


def load_bearing(spec: RobotSpec, world_from_hex: SE3, ground: HeightGrid, xy: np.ndarray) -> np.ndarray:
    """Places (n, 2) where at least one leg could stand and carry load, shape (n,)."""
    axles = np.column_stack([xy, ground.sample(xy) + spec.wheel.radius])
    hex_from_world = world_from_hex.inverse()
    in_hex, down = hex_from_world.apply(axles), hex_from_world.rotate(-UP)
    reached = np.zeros(len(xy), dtype=bool)
    for leg in range(LEGS):
        reached |= leg_ik(spec, leg, in_hex, last_link_in_hex=down)[1]
    return reached


def score_map(
    terrain: FusedTerrain, truth: HeightGrid, *, datum: float, spec: RobotSpec, world_from_hex: SE3
) -> MapScore:
    """Compare a map with the truth.

    Args:
        terrain: believed.
        truth: the true surface.
        datum: true height of what the map calls zero [m].
        spec: the drawings.
        world_from_hex: the chassis, truly.
    """
    x, y = terrain.grid.centres()
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    true = truth.sample(xy).reshape(terrain.grid.shape)
    reach = load_bearing(spec, world_from_hex, truth, xy).reshape(terrain.grid.shape)
    error = np.where(reach, terrain.grid.heights + datum - true, np.nan)
    cells = 2 * round(GHOST_RADIUS / terrain.grid.cell) + 1
    over = terrain.grid.heights + datum - ndimage.maximum_filter(true, cells, mode="nearest")
    over = np.where(reach & np.isfinite(over), over, -np.inf)
    return MapScore(error=error, sigma=terrain.sigma, reach=reach, highest_ghost=float(over.max()))
