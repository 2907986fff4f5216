"""The rank filter against another library's, and the energy against its integral."""

import numpy as np
import pytest
from scipy import ndimage

from planner.footfall_scores import footprint
from planner.footfall_support import bearing_cells, energy, level

CELL = 0.05


@pytest.mark.parametrize("shape", ["disc", "square"])
@pytest.mark.parametrize("radius", [0.01, 0.05, 0.15, 0.27])
@pytest.mark.parametrize("share", [0.01, 0.3, 0.5, 1.0])
def test_levels_equal_another_library_s_rank_filter(shape, radius, share):
    heights = np.random.default_rng(1).normal(size=(33, 150))  # wider than two blocks, and not a multiple of one
    heights[:, 70:90] = np.round(heights[:, 70:90], 1)  # with ties
    foot = footprint(radius, CELL, shape=shape)
    bearing = bearing_cells(share, foot)
    expected = ndimage.rank_filter(heights, rank=int(foot.sum()) - bearing, footprint=foot, mode="nearest")
    assert np.array_equal(level(heights, foot, bearing), expected)


def test_levels_of_heights_seen_through_a_window_are_the_same():
    heights = np.random.default_rng(2).normal(size=(40, 40))
    foot = footprint(0.10, CELL)
    assert np.array_equal(level(heights.T, foot, 4), level(np.ascontiguousarray(heights.T), foot, 4))


@pytest.mark.parametrize("n", [0.2, 0.5, 1.0, 1.1, 2.0])
def test_energy_is_the_sum_of_powers_for_any_soil(n):
    rng = np.random.default_rng(3)
    heights = rng.normal(0.0, 0.03, (20, 21))
    foot = footprint(0.18, CELL)
    k = foot.shape[0] // 2
    highest = ndimage.maximum_filter(heights, footprint=foot, mode="nearest")
    depth = highest - level(heights, foot, bearing_cells(0.5, foot))
    found = energy(highest, depth, heights, foot, cell=CELL, k=2e6, n=n)
    for i, j in rng.integers([k, k], [20 - k, 21 - k], (30, 2)):
        gaps = highest[i, j] - heights[i - k : i + k + 1, j - k : j + k + 1][foot.astype(bool)]
        gaps = gaps[gaps < depth[i, j]]
        expected = 2e6 * CELL**2 / (n + 1) * np.sum(depth[i, j] ** (n + 1) - gaps ** (n + 1))
        assert found[i, j] == pytest.approx(expected, rel=1e-5)


def test_at_least_one_cell_bears():
    foot = footprint(0.05, CELL)
    assert [bearing_cells(share, foot) for share in (1e-6, 0.2, 0.21, 1.0)] == [1, 1, 2, 5]
