"""Where a wheel may be put down: the fused terrain to a cost and a veto, with its reason, for every cell.

The cost is that of one method over the wheel's footprint (`footfall_scores.py`). The veto is the same whatever the method:
a cell is refused when the ground under the wheel is unknown, uncertain, steep or rough, or when the wheel's flank would
touch a rock beside it. Roughness is what remains of height range and mean gap after the slope's own part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numba
import numpy as np

from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.geometry.arrays import Cells
from athlete_twin.geometry.grid import HeightGrid
from planner.footfall_scores import METHODS, CostConfig, Underfoot, cost, footprint, underfoot, window_sum

__all__ = ["METHODS", "REASONS", "FootfallConfig", "FootfallMap", "footprint", "score_footfalls", "unknown_share"]

REASONS = ("ok", "unknown", "uncertain", "steep", "rough", "step_beside")
"""names of the codes in `FootfallMap.veto`"""
OK, UNKNOWN, UNCERTAIN, STEEP, ROUGH, STEP_BESIDE = range(len(REASONS))


@dataclass(frozen=True, kw_only=True)
class FootfallConfig(CostConfig):
    """How footfalls are scored and which are refused."""

    max_unknown_fraction: float = 0.10
    """of the footprint: a shadowed cell or two under a wheel shall not refuse it"""
    max_sigma: float = 0.04
    """root of the mean height variance under the wheel [m]; fused stereo has 1-2 cm within reach"""
    max_slope_deg: float = 20.0
    """[deg]; SDM-B was walked on 14 and slid there ([SunSpiral2012] s5.3.4), tyres on a patch bear a little more"""
    max_height_range: float = 0.10
    """beyond the slope's own [m]; 0.4 of SDM-B's wheel radius, 4 sigma of the map's noise"""
    max_mean_gap: float = 0.06
    """free volume over area beyond the slope's own [m]"""
    flank_clearance: float = 0.05
    """kept sideways between wheel and rocks [m]; covers touchdown and localisation errors"""
    flank_tolerance: float = 0.05
    """height by which ground beside the footprint may stand into the clearance [m]; map noise and the tyre's give"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.max_unknown_fraction < 1.0:
            raise ConfigError(f"max_unknown_fraction is {self.max_unknown_fraction}, must be at least 0 and below 1")
        for name in ("max_sigma", "max_slope_deg", "max_height_range", "max_mean_gap"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be positive and finite")
        if not self.max_slope_deg < 90.0:
            raise ConfigError(f"max_slope_deg is {self.max_slope_deg}, must be below 90")
        for name in ("flank_clearance", "flank_tolerance"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise ConfigError(f"{name} is {getattr(self, name)} m, must be 0 or more and finite")


@dataclass(frozen=True, eq=False, kw_only=True)
class FootfallMap:
    """A cost and a veto for every cell of a height grid."""

    grid: HeightGrid
    """the terrain that was scored"""
    method: str
    cost: Cells
    """of putting the wheel's centre on this cell, in the method's unit; NaN where the ground is unknown"""
    veto: np.ndarray
    """code into `REASONS`, uint8, shape (nx, ny): the first reason that refuses the cell, 0 for none"""
    contact_height: Cells
    """height of the contact under the axle of a wheel standing there [m]; NaN where the ground is unknown"""
    slope: Cells
    """of the plane through the footprint [rad]; NaN where the ground is unknown"""
    reasons: tuple[str, ...] = REASONS
    """name of each veto code"""

    @property
    def allowed(self) -> np.ndarray:
        """Cells that nothing refuses, shape (nx, ny)."""
        return np.asarray(self.veto == OK)

    def reason_at(self, xy: np.ndarray) -> str:
        """Name of the veto at a point (2,); "unknown" outside the map."""
        ix, iy, inside = self.grid.index(np.reshape(xy, (1, 2)))
        return self.reasons[int(self.veto[ix[0], iy[0]])] if bool(inside[0]) else REASONS[UNKNOWN]


def score_footfalls(
    grid: HeightGrid, variance: Cells, *, wheel_radius: float, config: FootfallConfig
) -> FootfallMap:
    """Scores every cell of a terrain as a footfall.

    Args:
        grid: heights, NaN where unknown.
        variance: of the heights, same shape [m2]; NaN or infinite makes a cell unknown ground, whatever its height.
        wheel_radius: [m]
        config: method and limits.

    Raises:
        TerrainError: of shapes, a map smaller than a footprint, a wheel without radius, or a negative variance.
    """
    heights = np.asarray(grid.heights, dtype=np.float64)
    if variance.shape != heights.shape:
        raise TerrainError(f"variance has shape {variance.shape}, the heights {heights.shape}")
    below = variance < 0.0
    if below.any():
        i, j = (int(k) for k in np.argwhere(below)[0])
        limit = "must not be negative; NaN or infinite for unknown ground"
        raise TerrainError(f"variance is {variance[i, j]:g} m2 at cell ({i}, {j}), {limit}")
    if not 0.0 < wheel_radius < np.inf:
        raise TerrainError(f"wheel radius is {wheel_radius} m, must be positive and finite")
    radius = config.footprint_radius(wheel_radius)
    foot = footprint(radius, grid.cell, shape=config.shape)
    if min(heights.shape) < foot.shape[0]:
        raise TerrainError(f"map of {heights.shape} cells is smaller than a footprint of {foot.shape} cells")
    known = np.isfinite(heights) & np.isfinite(variance)
    filled = _fill(heights, known, foot)

    n = float(foot.sum())
    refused = 1.0 - _count(known, foot) / n > config.max_unknown_fraction + 1e-9
    under = underfoot(filled, foot, cell=grid.cell)
    # A wheel on a plane touches it beside its axle's foot: its axle stands higher by R (1 / cos - 1).
    contact = under.mean + wheel_radius * (np.hypot(1.0, under.steepness) - 1.0)
    intrusion = _flank_intrusion(filled, known, grid.cell, radius, wheel_radius, config.flank_clearance) - contact
    # An unknown cell may be as wrong as the worst that is let pass: the mean is beyond the limit where that of the known is.
    supposed = np.where(known, variance, config.max_sigma**2)
    sigma2 = window_sum(supposed, foot) / n

    veto = np.select(
        [
            refused,
            sigma2 > config.max_sigma**2,
            under.steepness > np.tan(np.deg2rad(config.max_slope_deg)),
            _is_rough(under, config),
            intrusion > config.flank_tolerance,
        ],
        [UNKNOWN, UNCERTAIN, STEEP, ROUGH, STEP_BESIDE],
        OK,
    ).astype(np.uint8)
    return FootfallMap(
        grid=grid,
        method=config.method,
        cost=np.where(refused, np.nan, cost(under, config, variance=supposed, refused=refused)),
        veto=veto,
        contact_height=np.where(refused, np.nan, contact),
        slope=np.where(refused, np.nan, np.arctan(under.steepness)),
    )


def _fill(heights: np.ndarray, known: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """Unknown heights replaced by the mean of the known ones around; by the map's mean where there is none."""
    if not known.any():
        return np.zeros_like(heights)
    level = float(heights[known].mean())
    if known.all():
        return np.ascontiguousarray(heights)
    around = np.ones((max(foot.shape[0], 3),) * 2)
    total = window_sum(np.where(known, heights - level, 0.0), around, border=0.0)
    count = np.maximum(_count(known, around), 1.0)
    return np.ascontiguousarray(np.where(known, heights, level + total / count))


def _count(what: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """Number of true cells under each footprint, none beyond the map; single precision holds it exactly, and is filtered faster."""
    counted = cv2.filter2D(what.astype(np.float32), cv2.CV_32F, foot.astype(np.float32), borderType=cv2.BORDER_CONSTANT)
    return np.asarray(np.rint(counted.astype(np.float64)))


def _is_rough(under: Underfoot, config: FootfallConfig) -> np.ndarray:
    """Where height range or mean gap exceed what is allowed beyond those of a plane of the same slope.

    Only the footprint's outermost cells reach the extremes of a plane, and it is symmetric: the gap is half the range.
    """
    k = under.foot.shape[0] // 2
    reaches = [int(np.flatnonzero(under.foot[k + row]).max()) - k for row in range(k + 1)]
    # A row farther out that is as wide reaches farther.
    corners = np.array([(row, reach) for row, reach in enumerate(reaches) if reach not in reaches[row + 1 :]])
    return np.asarray(
        _rough(
            under.highest, under.lowest, under.mean, under.slope_x, under.slope_y, corners, under.cell,
            config.max_height_range, config.max_mean_gap,
        )
    )  # fmt: skip


@numba.njit(cache=True)
@no_type_check
def _rough(highest, lowest, mean, slope_x, slope_y, corners, cell, max_range, max_gap):
    nx, ny = highest.shape
    rough = np.empty((nx, ny), dtype=np.bool_)
    for i in range(nx):
        for j in range(ny):
            along, across, half = abs(slope_x[i, j]), abs(slope_y[i, j]), 0.0
            for c in range(len(corners)):
                half = max(half, along * corners[c, 0] + across * corners[c, 1])
            too_far = highest[i, j] - lowest[i, j] - 2.0 * cell * half > max_range
            rough[i, j] = too_far or highest[i, j] - mean[i, j] - cell * half > max_gap
    return rough


def _flank_intrusion(
    filled: np.ndarray, known: np.ndarray, cell: float, inner: float, wheel_radius: float, clearance: float
) -> np.ndarray:
    """Highest ground around each cell, less the height of the widened wheel's hull over its lowest point there [m].

    The wheel may be steered any way, so its hull is a sphere of its radius; widened sideways by the clearance. Cells of
    the footprint are left to the roughness veto, unknown cells to nobody: they are taken as no obstacle.
    """
    outer = wheel_radius + clearance
    k = int(np.floor(outer / cell + 1e-9))
    x, y = np.meshgrid(np.arange(-k, k + 1), np.arange(-k, k + 1), indexing="ij")
    steps = x * x + y * y
    distance = cell * np.sqrt(steps)
    ground = np.where(known, filled, -1e6)
    highest = np.full_like(filled, -1e6)
    # All cells at one distance meet the hull at one height, so one flat dilation serves the ring.
    for ring in np.unique(steps[(distance > inner) & (distance <= outer + 1e-9)]):
        d = max(0.0, cell * float(np.sqrt(ring)) - clearance)
        hull = wheel_radius - float(np.sqrt(max(0.0, wheel_radius**2 - d**2)))
        reached = cv2.dilate(ground, (steps == ring).astype(np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=-1e6)
        np.subtract(reached, hull, out=reached)
        np.maximum(highest, reached, out=highest)
    return highest


def unknown_share(grid: HeightGrid, footfall_in_world: np.ndarray, *, radius: float) -> float:
    """Share of the cells under a wheel of `radius` [m] at a footfall, shape (3,), that nobody saw; all of them outside the map."""
    x, y = grid.centres()
    under = np.hypot(x[:, None] - footfall_in_world[0], y[None, :] - footfall_in_world[1]) <= radius
    return float(np.mean(np.isnan(grid.heights[under]))) if under.any() else 1.0
