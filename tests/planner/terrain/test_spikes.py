"""Blades go, rocks stay."""

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.grid import HeightGrid
from planner.terrain.fusion import FusedTerrain
from planner.terrain.spikes import SpikeConfig, without_spikes

CELL = 0.05


def terrain(heights: np.ndarray) -> FusedTerrain:
    known = np.isfinite(heights)
    return FusedTerrain(
        grid=HeightGrid(origin_x=0.0, origin_y=0.0, cell=CELL, heights=heights),
        variance=np.where(known, 1e-4, np.inf),
        count=known.astype(np.int64),
        seen=np.where(known, 0.0, -np.inf),
    )


def test_a_blade_of_a_leg_becomes_unknown():
    heights = np.zeros((60, 60))
    for k in range(12):
        heights[20 + k, 20 + k : 23 + k] = 0.7
    cleaned = without_spikes(terrain(heights), config=SpikeConfig())
    assert np.array_equal(cleaned.unknown, heights > 0.5)


def test_a_blade_amid_unknown_cells_goes_too():
    heights = np.zeros((60, 60))
    heights[25:40, 25:40] = np.nan
    heights[30:32, 28:36] = 0.65
    cleaned = without_spikes(terrain(heights), config=SpikeConfig())
    assert cleaned.unknown[30:32, 28:36].all()


@pytest.mark.parametrize("diameter", [0.15, 0.25, 0.4, 0.8, 1.5])
def test_rocks_of_every_size_stay(diameter):
    """Half-ellipsoids 0.6 D high, the steepest that the rock fields have."""
    x, y = np.meshgrid(*(CELL * (np.arange(80) - 40),) * 2, indexing="ij")
    inside = np.clip(1.0 - (x**2 + y**2) / (0.5 * diameter) ** 2, 0.0, 1.0)
    heights = 0.6 * diameter * np.sqrt(inside)
    assert not without_spikes(terrain(heights), config=SpikeConfig()).unknown.any()


def test_slopes_and_an_empty_map_are_left_alone():
    slope = np.add.outer(np.arange(60) * CELL * np.tan(np.deg2rad(35.0)), np.zeros(60))
    assert not without_spikes(terrain(slope), config=SpikeConfig()).unknown.any()
    nothing = terrain(np.full((60, 60), np.nan))
    assert without_spikes(nothing, config=SpikeConfig()) is nothing


def test_silly_limits_are_refused():
    with pytest.raises(ConfigError, match="spikes need positive height"):
        SpikeConfig(height=0.0)
