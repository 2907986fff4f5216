"""To what extent do methods of choosing a footfall agree? The experiment of [Caillas1989] s3.2.2 on seeded ground.

An elevation map of 10 cm cells, 16 regions of 1 m2 from flat to very rough. In each, each method chooses the best foot of
30 cm, and the others judge its choice: 0 if it is their own best, 1 if it is the worst of the region (eq. 9). The mean over
the regions (eq. 10) is a table of who chose by who judges; a row's mean (eq. 11) is how well its method suits the others.

Equilibrium chooses and does not judge, as in the paper: it is no number but a choice in two passes. Equation 11 divides by
K - 1 = 4; the first four methods have three judges beside themselves, so that their printed means are a quarter lower than
the mean over who judged, and Equilibrium's is not. `row_means` gives either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import build_terrain, generator
from planner.footfall_scores import CostConfig, cost, footprint, underfoot

CELL = 0.10
REGION_CELLS = 10
SIDE = 4
"""regions along each edge of the map"""
FOOT = 0.30
"""side of the square, or diameter [m]"""
FINE = 5
"""heights along each edge of a cell that its elevation is the mean of"""
CHOOSERS = ("max_min", "plane_fit", "support_area", "free_volume", "equilibrium")
JUDGES = CHOOSERS[:4]
BESIDE = ("support_energy", "asv_slope")
"""not in the paper's table: eq. 6 in full, and the Adaptive Suspension Vehicle's threshold"""
NAMES = {
    "max_min": "Max-Min", "plane_fit": "Plane Fit", "support_area": "Support Area", "free_volume": "Free Volume",
    "equilibrium": "Equilibrium", "support_energy": "Support energy", "asv_slope": "ASV's slope",
}  # fmt: skip
PAPER = np.array([[0, 4, 9, 6.5], [8, 0, 22, 15.5], [34.5, 43.5, 0, 28.5], [8.5, 10.5, 6, 0], [2, 3, 12.5, 5.5]])
"""[%], rows `CHOOSERS`, columns `JUDGES`; "about 5", 12 and "more than 25" in its text are the rows' sums over 4"""
GROUNDS = ("sandbox", "rock_field", "black_point", "moses_lake")
RAMP = (0.1, 1.5)
"""by which heights of `black_point`'s kind are multiplied from one edge of the sandbox to the other: flat to very rough"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Region:
    """What every method thinks of every footfall in one region."""

    heights: np.ndarray
    """shape (10, 10) [m]"""
    costs: dict[str, np.ndarray]
    """by method, shape (8, 8): of feet that lie within the region"""

    def best(self, method: str) -> tuple[int, int]:
        """The footfall that a method chooses; of several that it likes the same, the one nearest to the middle."""
        found = self.costs[method]
        i, j = np.nonzero(found == found.min())
        middle = 0.5 * (np.array(found.shape) - 1)
        nearest = int(np.argmin(np.hypot(i - middle[0], j - middle[1])))
        return int(i[nearest]), int(j[nearest])

    def judged(self, method: str, at: tuple[int, int]) -> float:
        """Eq. 9: 0 for the method's best, 1 for its worst; 0 where all are alike."""
        found = self.costs[method]
        span = float(np.ptp(found))
        return (float(found[at]) - float(found.min())) / span if span > 0.0 else 0.0


def elevation(ground: str, seed: int) -> np.ndarray:
    """Mean heights of 10 cm cells, shape (40, 40) [m]: "sandbox", or 4 m by 4 m of the kind of ground of a scenario."""
    edge = SIDE * REGION_CELLS * CELL
    known = load_scenario("black_point" if ground == "sandbox" else ground)
    rocks = replace(known.rocks, min_big_across_line=0)
    scenario = replace(known, size=(edge + 0.4, edge + 0.4), x_min=-0.2, cell=CELL / FINE, rocks=rocks)
    terrain = build_terrain(scenario, seed, clear_xy=np.zeros((0, 2)), clear_radius=0.0)
    at = CELL / FINE * (np.arange(SIDE * REGION_CELLS * FINE) + 0.5)
    fine = terrain.height(np.stack(np.meshgrid(at, at - 0.5 * edge, indexing="ij"), axis=-1))
    if ground == "sandbox":
        fine = fine * np.linspace(*RAMP, len(at))[:, None]
    blocks = fine.reshape(len(at) // FINE, FINE, len(at) // FINE, FINE)
    return np.asarray(blocks.mean(axis=(1, 3)))


def with_error(heights: np.ndarray, error: float, seed: int) -> np.ndarray:
    """The same with an error of `error` [m], one sigma, of its own in every cell."""
    return np.asarray(heights + error * generator(seed, "footfall_error").standard_normal(heights.shape))


def regions(heights: np.ndarray, *, shape: str = "square", support: float = 0.5) -> list[Region]:
    """All regions of a map, each scored by itself with the planner's own code.

    Args:
        heights: shape (40, 40) [m].
        shape: of the foot, "square" or "disc".
        support: share of the foot that must bear.
    """
    parts = heights.reshape(SIDE, REGION_CELLS, SIDE, REGION_CELLS).transpose(0, 2, 1, 3)
    return [_region(np.ascontiguousarray(part), shape, support) for part in parts.reshape(-1, REGION_CELLS, REGION_CELLS)]


def table(chosen: Sequence[Region], judging: Sequence[Region], choosers: Sequence[str] = CHOOSERS) -> np.ndarray:
    """Eq. 10: mean judgement of each judge (column) on each method's choice (row) [%].

    Args:
        chosen: regions of the map on which the methods choose.
        judging: the same regions of the map on which they are judged; the same map in the paper.
        choosers: rows.
    """
    values = [
        [[judge.judged(by, one.best(method)) for by in JUDGES] for method in choosers]
        for one, judge in zip(chosen, judging, strict=True)
    ]
    return np.asarray(100.0 * np.mean(values, axis=0))


def row_means(values: np.ndarray, choosers: Sequence[str] = CHOOSERS, *, over: str) -> np.ndarray:
    """Eq. 11 of each row: "printed" divides by K - 1 = 4, "judges" by those who judge it beside itself [%]."""
    others = np.array([sum(judge != method for judge in JUDGES) for method in choosers])
    return np.asarray(values.sum(axis=1) / (len(CHOOSERS) - 1 if over == "printed" else others))


def order_holds(means: np.ndarray) -> dict[str, bool]:
    """What the paper found of the rows' means: each of three agrees better than Plane Fit, and Plane Fit better than Support Area."""
    max_min, plane_fit, support, volume, equilibrium = means
    found = {
        "three_below_plane_fit": bool(max(max_min, volume, equilibrium) < plane_fit),
        "plane_fit_below_support_area": bool(plane_fit < support),
    }
    return {**found, "all": all(found.values())}


def loss(chosen: Sequence[Region], true: Sequence[Region]) -> dict[str, tuple[float, float]]:
    """What choosing on a map with errors costs on the ground itself, by method.

    Mean of the method's own judgement there, 0 for the best footfall of a region and 100 for its worst [%], and mean
    height range under the foot [m].
    """
    found = {}
    for method in JUDGES:
        places = [one.best(method) for one in chosen]
        own = np.mean([ground.judged(method, at) for ground, at in zip(true, places, strict=True)])
        height_range = np.mean([ground.costs["max_min"][at] for ground, at in zip(true, places, strict=True)])
        found[method] = (100.0 * float(own), float(height_range))
    return found


def _region(heights: np.ndarray, shape: str, support: float) -> Region:
    foot = footprint(0.5 * FOOT, CELL, shape=shape)
    under, k = underfoot(heights, foot, cell=CELL), foot.shape[0] // 2
    outside = np.ones(heights.shape, dtype=bool)
    outside[k:-k, k:-k] = False
    costs = {}
    for method in (*CHOOSERS, *BESIDE):
        # Twice as wide as the region: its least free volume is the same for all of its cells.
        config = CostConfig(method=method, min_support_fraction=support, equilibrium_region=2.0 * REGION_CELLS * CELL)
        costs[method] = cost(under, config, variance=np.zeros(heights.shape), refused=outside)[k:-k, k:-k]
    return Region(heights=heights, costs=costs)
