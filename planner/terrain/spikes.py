"""Fused terrain without what cannot stand: lumps that are tall and thin, left over from the robot's own legs.

Beside a leg's outline stereo finds depths between the leg's and the ground's. Seen once, from one place, they become
blades of "terrain" a cell or three wide and half a metre high ([SunSpiral2012] s4.3 calls them artifacts that extend away
from the camera). Ground and rocks are no blades: a feature that rises far above what a morphological opening leaves of
it is narrower than the opening's width, and is taken back to unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.grid import HeightGrid
from planner.terrain.fusion import FusedTerrain


@dataclass(frozen=True, kw_only=True)
class SpikeConfig:
    """What is too tall for its width."""

    height: float = 0.25
    """above its surroundings: lower ones are left, rocks that narrow are lower [m]"""
    width: float = 0.25
    """features narrower than this are judged [m]"""
    surroundings: float = 0.6
    """edge of the window whose lowest known cell stands for unknown ones [m]"""

    def __post_init__(self) -> None:
        if not (self.height > 0.0 and self.width > 0.0 and self.surroundings > self.width):
            raise ConfigError(f"spikes need positive height and width, and wider surroundings, got {self}")


def without_spikes(terrain: FusedTerrain, *, config: SpikeConfig) -> FusedTerrain:
    """The terrain with blades unknown again. Cost grows with the map's cells alone."""
    heights, cell = terrain.grid.heights, terrain.grid.cell
    known = np.isfinite(heights)
    if not known.any():
        return terrain
    low = cv2.erode(np.where(known, heights, np.inf).astype(np.float32), _square(config.surroundings, cell))
    low = np.where(np.isfinite(low), low, float(np.min(heights[known])))
    solid = np.where(known, heights, low).astype(np.float32)
    opened = cv2.morphologyEx(solid, cv2.MORPH_OPEN, _square(config.width, cell))
    spike = known & (solid - opened > config.height)
    if not spike.any():
        return terrain
    grid = HeightGrid(
        origin_x=terrain.grid.origin_x,
        origin_y=terrain.grid.origin_y,
        cell=cell,
        heights=np.where(spike, np.nan, heights),
    )
    return FusedTerrain(
        grid=grid,
        variance=np.where(spike, np.inf, terrain.variance),
        count=np.where(spike, 0, terrain.count),
        seen=np.where(spike, -np.inf, terrain.seen),
    )


def _square(width: float, cell: float) -> np.ndarray:
    edge = max(1, round(width / cell))
    return np.ones((edge, edge), dtype=np.uint8)
