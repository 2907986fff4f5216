"""How deep a flat foot sinks until enough of it bears: [Caillas1989] s3.1.3, for every cell of a map at once.

A foot comes down on its footprint's highest point and sinks by delta; the ground that stands within delta of that point
bears. `depth` is delta_opt, where a wanted share of the footprint bears; `energy` is eq. 6 up to there, with the soil's
pressure P = k delta^n under all that bears, as printed: a cell that was met late bears as much as the first.

The depth is a rank filter over a footprint of any shape. A network of comparisons that do not depend on the heights
(Batcher's odd-even merge sort, cut down to what reaches the one rank) runs over whole rows, so the processor compares
several cells at a time.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import no_type_check

import numba
import numpy as np

from athlete_twin.geometry.arrays import Cells

BLOCK = 64
"""cells of a row that go through the network together: with all values of a footprint they fit the nearest cache"""
MOST_THREADS = 4
"""that fill one map: more than the machine has cores are of no use, and a map is small"""
STEPS = 4096
"""of a table of powers between no depth and the whole: a power for each cell under each foot would take most of the time"""


def bearing_cells(share: float, foot: np.ndarray) -> int:
    """Number of a footprint's cells that make up a share of it, at least one."""
    return max(1, int(np.ceil(share * float(foot.sum()) - 1e-9)))


def level(heights: Cells, foot: np.ndarray, bearing: int) -> Cells:
    """Height of the `bearing`-th highest cell of each cell's footprint, shape (nx, ny) [m].

    Args:
        heights: without NaN, shape (nx, ny); beyond the map stands the nearest cell's [m].
        foot: footprint, shape (2 k + 1, 2 k + 1).
        bearing: 1 for the highest, as many as the footprint has cells for the lowest.
    """
    k = foot.shape[0] // 2
    du, dv = np.nonzero(foot)
    network = _selection(len(du), len(du) - bearing)
    padded, out = np.pad(heights, k, mode="edge"), np.empty(heights.shape)
    _by_rows(lambda first, last: _select(padded, du, dv, network, len(du) - bearing, first, last, out), len(out))
    return out


def energy(highest: Cells, depth: Cells, heights: Cells, foot: np.ndarray, *, cell: float, k: float, n: float) -> Cells:
    """Work of sinking by `depth` below the highest point, [Caillas1989] eq. 6, shape (nx, ny) [J].

    Args:
        highest: of each footprint [m].
        depth: at which the foot stops [m].
        heights: as for `level` [m].
        foot: footprint.
        cell: edge of a cell [m].
        k: of the soil's P = k delta^n [Pa/m^n].
        n: its exponent.
    """
    half = foot.shape[0] // 2
    du, dv = np.nonzero(foot)
    powers = (np.arange(STEPS + 2) / STEPS) ** (n + 1.0)
    padded, spent = np.pad(heights, half, mode="edge"), np.zeros(depth.shape)
    _by_rows(lambda first, last: _work(padded, du, dv, highest, depth, powers, first, last, spent), len(spent))
    return np.asarray(k * cell**2 / (n + 1.0) * spent * np.maximum(depth, 0.0) ** (n + 1.0))


def _by_rows(fill: Callable[[int, int], None], rows: int) -> None:
    """Fill rows of a map in as many threads as there are cores, each its own: the bytes do not depend on how many."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = min(cores, MOST_THREADS)
    bounds = np.linspace(0, rows, threads + 1).astype(int)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(fill, bounds[:-1], bounds[1:]))


@lru_cache(maxsize=32)
def _selection(size: int, rank: int) -> np.ndarray:
    """Comparators (a, b), a < b, in order, after which place `rank` of `size` holds the value of that rank, shape (c, 2)."""
    whole: list[tuple[int, int]] = []
    p = 1
    while p < size:
        q = p
        while q >= 1:
            for first in range(q % p, size - q, 2 * q):
                for a in range(first, min(first + q, size - q)):
                    if a // (2 * p) == (a + q) // (2 * p):
                        whole.append((a, a + q))
            q //= 2
        p *= 2
    wanted, kept = {rank}, []
    for a, b in reversed(whole):
        if a in wanted or b in wanted:
            wanted |= {a, b}
            kept.append((a, b))
    return np.array(kept[::-1], dtype=np.int64).reshape(-1, 2)


@numba.njit(cache=True, nogil=True)
@no_type_check
def _select(padded, du, dv, network, rank, first_row, last_row, out):
    ny = out.shape[1]
    size = len(du)
    lanes = np.empty((size, BLOCK))
    for i in range(first_row, last_row):
        for start in range(0, ny, BLOCK):
            count = min(BLOCK, ny - start)
            for c in range(size):
                first = start + dv[c]
                lanes[c, :count] = padded[i + du[c], first : first + count]
            for c in range(len(network)):
                low, high = lanes[network[c, 0]], lanes[network[c, 1]]
                for j in range(count):
                    a, b = low[j], high[j]
                    low[j] = min(a, b)
                    high[j] = max(a, b)
            out[i, start : start + count] = lanes[rank, :count]


@numba.njit(cache=True, nogil=True)
@no_type_check
def _work(padded, du, dv, highest, depth, powers, first_row, last_row, out):
    ny = depth.shape[1]
    steps = float(len(powers) - 2)
    for i in range(first_row, last_row):
        scale = steps / np.maximum(depth[i], 1e-12)
        for c in range(len(du)):
            under = padded[i + du[c], dv[c] : dv[c] + ny]
            for j in range(ny):
                at = min(max((highest[i, j] - under[j]) * scale[j], 0.0), steps)
                below = np.uint32(at)
                out[i, j] += 1.0 - powers[below] - (at - below) * (powers[below + 1] - powers[below])
