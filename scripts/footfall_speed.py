"""How long all footfall scores of a 400 x 400 map take, by method and footprint. Two threads, no GPU.

Ours is `score_footfalls`: cost, vetoes with their reasons and contact heights of every cell of a map of 5 cm cells of which a
twentieth is unknown; the best of several runs, since other jobs on the machine only add. The peer is what one would write
first, scipy.ndimage.generic_filter with a line of numpy for the cost alone, in the same run on a smaller map without unknown
cells, scaled by the number of cells.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from bench_table import Row, row
from scipy import ndimage

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.model.spec import load_spec
from planner.footfall import FootfallConfig, score_footfalls
from planner.footfall_scores import METHODS, footprint

SIZE = 400
CELL = 0.05
"""[m]"""
PEER_SIZE = 60
RUNS = 9
THREADS = 2
TARGET = "<= 50"
"""for a map, per method [ms]"""
FEET = ("30 cm disc", "sdm_b wheel", "t12 wheel")


def rows(*, feet: tuple[str, ...] = FEET) -> list[Row]:
    """Milliseconds of each method over each footprint."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(THREADS)
    try:
        return [_row(foot, method) for foot in feet for method in METHODS]
    finally:
        cv2.setNumThreads(before)


def _row(foot: str, method: str) -> Row:
    robot = foot.split()[0] if foot.endswith("wheel") else "sdm_b"
    wheel = load_spec(robot).wheel.radius
    # As the planner's variants have it; the line of numpy knows of no doubt either.
    config = FootfallConfig(method=method, footprint_diameter=None if foot.endswith("wheel") else 0.30, deviations=0.0)
    heights = _ground(SIZE)
    heights[np.random.default_rng(1).random(heights.shape) < 0.05] = np.nan
    grid = HeightGrid(origin_x=0.0, origin_y=0.0, cell=CELL, heights=heights)
    variance = np.full(heights.shape, 1e-4)
    ours = _best(lambda: score_footfalls(grid, variance, wheel_radius=wheel, config=config), runs=RUNS)
    cells = footprint(config.footprint_radius(wheel), CELL)
    small = _ground(PEER_SIZE)
    of_values = _by_hand(method, cells, config)
    peer = _best(lambda: ndimage.generic_filter(small, of_values, footprint=cells, mode="nearest"), runs=1)
    return row(
        f"footfall {method}, {foot} ({int(cells.sum())} cells), 400 x 400", ours, "ms", target=TARGET,
        peer_name="scipy generic_filter", peer=peer * (SIZE / PEER_SIZE) ** 2,
    )  # fmt: skip


def _best(call: Callable[[], object], *, runs: int) -> float:
    """Shortest time of a call after one that compiles [ms]."""
    times = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        call()
        times.append(1000.0 * (time.perf_counter() - start))
    return min(times[1:])


def _ground(size: int) -> np.ndarray:
    """Waves and noise, which no method has an easy time with, shape (size, size) [m]."""
    at = CELL * np.arange(size)
    noise = np.random.default_rng(0).normal(0.0, 0.02, (size, size))
    return np.asarray(0.2 * np.sin(at)[:, None] * np.cos(0.7 * at)[None, :] + noise)


def _by_hand(method: str, foot: np.ndarray, config: FootfallConfig) -> Callable[[np.ndarray], float]:
    """A line of numpy for the heights under one foot."""
    n = int(foot.sum())
    rank = n - int(np.ceil(config.min_support_fraction * n))
    x, y = CELL * (np.array(np.nonzero(foot)) - foot.shape[0] // 2)
    spread, p, area = float(x @ x), config.soil_n + 1.0, CELL**2

    def depth(z: np.ndarray) -> float:
        return float(z.max() - np.partition(z, rank)[rank])

    def energy(z: np.ndarray) -> float:
        gaps = np.minimum(z.max() - z, depth(z))
        return float(config.soil_k * area / p * np.sum(depth(z) ** p - gaps**p))

    def slope(z: np.ndarray) -> float:
        return float(np.arctan(np.hypot(x @ z, y @ z) / spread))

    def volume(z: np.ndarray) -> float:
        return float(area * np.sum(z.max() - z))

    return {
        "max_min": lambda z: float(z.max() - z.min()),
        "plane_fit": lambda z: float(np.var(z)),
        "support_area": depth,
        "support_energy": energy,
        "free_volume": volume,
        "equilibrium": lambda z: volume(z) + area * float(np.hypot(x @ z, y @ z)),  # both numbers, without the second pass
        "asv_slope": slope,
    }[method]
