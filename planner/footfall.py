"""Where a wheel may be put down: the fused terrain to a cost and a veto, with its reason, for every cell.

Costs are those of [Caillas1989] s3.1 over the wheel's footprint; the smaller the better:

- `max_min`, eq. 2: highest less lowest elevation [m].
- `plane_fit`, eqs 3-4: mean square distance from the mean elevation [m2]. The paper's plane is horizontal.
- `free_volume`, eq. 8: room between a plate resting on the highest point and the ground [m3]. The paper chose it. Its
  factor is printed d^2 / n^2 for n samples, which vanishes as n grows; the mean gap times the footprint's area is
  meant.

A cell is vetoed when the ground under the wheel is unknown, uncertain, steep or rough, or when the wheel's flank would
touch a rock beside it. Roughness is what remains of height range and mean gap after the slope's own part.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.geometry.arrays import Cells
from athlete_twin.geometry.grid import HeightGrid

METHODS = ("max_min", "plane_fit", "free_volume")
SHAPES = ("disc", "square")
REASONS = ("ok", "unknown", "uncertain", "steep", "rough", "step_beside")
"""names of the codes in `FootfallMap.veto`"""
OK, UNKNOWN, UNCERTAIN, STEEP, ROUGH, STEP_BESIDE = range(len(REASONS))


@dataclass(frozen=True, kw_only=True)
class FootfallConfig:
    """How footfalls are scored and which are refused."""

    method: str = "free_volume"
    """"max_min", "plane_fit" or "free_volume"; the last is what [Caillas1989] s5 recommends"""
    shape: str = "disc"
    """of the footprint: "disc", since the wheel may be steered any way, or the paper's "square" """
    footprint_fraction: float = 0.75
    """footprint radius (half side of a square) over the wheel's: a tyre's patch and the tread's curve beside it"""
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
        if self.method not in METHODS:
            raise ConfigError(f"footfall method {self.method!r} is not one of {', '.join(METHODS)}")
        if self.shape not in SHAPES:
            raise ConfigError(f"footprint shape {self.shape!r} is not one of {', '.join(SHAPES)}")
        if not 0.0 < self.footprint_fraction <= 2.0:
            raise ConfigError(f"footprint_fraction is {self.footprint_fraction}, must be within 0 to 2")
        if not 0.0 <= self.max_unknown_fraction < 1.0:
            raise ConfigError(f"max_unknown_fraction is {self.max_unknown_fraction}, must be at least 0 and below 1")
        for name in ("max_sigma", "max_slope_deg", "max_height_range", "max_mean_gap"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be positive")
        if self.flank_clearance < 0.0 or self.flank_tolerance < 0.0:
            raise ConfigError(f"flank clearance and tolerance are {self.flank_clearance} and {self.flank_tolerance} m")


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
        variance: of the heights, same shape [m2]; ignored where unknown.
        wheel_radius: [m]
        config: method and limits.
    """
    heights = np.asarray(grid.heights, dtype=np.float64)
    if variance.shape != heights.shape:
        raise TerrainError(f"variance has shape {variance.shape}, the heights {heights.shape}")
    if not wheel_radius > 0.0:
        raise TerrainError(f"wheel radius is {wheel_radius} m, must be positive")
    radius = config.footprint_fraction * wheel_radius
    foot = footprint(radius, grid.cell, shape=config.shape)
    if min(heights.shape) < foot.shape[0]:
        raise TerrainError(f"map of {heights.shape} cells is smaller than a footprint of {foot.shape} cells")
    known = np.isfinite(heights)
    filled = _fill(heights, known, foot)

    n = float(foot.sum())
    unknown_share = 1.0 - _sum(known.astype(np.float64), foot, border=0.0) / n
    mean = _sum(filled, foot) / n
    highest, lowest = cv2.dilate(filled, foot), cv2.erode(filled, foot)
    slope_x, slope_y = _slopes(filled, foot, grid.cell)
    range_of_slope, gap_of_slope = _slope_parts(slope_x, slope_y, foot, grid.cell)
    height_range, mean_gap = highest - lowest, highest - mean
    steepness = np.hypot(slope_x, slope_y)

    if config.method == "max_min":
        cost = height_range
    elif config.method == "plane_fit":
        cost = _sum(filled * filled, foot) / n - mean * mean
        cost = np.maximum(cost, 0.0)
    else:
        cost = mean_gap * n * grid.cell**2
    # A wheel on a plane touches it beside its axle's foot: its axle stands higher by R (1 / cos - 1).
    contact = mean + wheel_radius * (np.hypot(1.0, steepness) - 1.0)
    intrusion = _flank_intrusion(filled, known, grid.cell, radius, wheel_radius, config.flank_clearance) - contact
    trusted = np.where(known & np.isfinite(variance), variance, 0.0)
    sigma2 = _sum(trusted, foot) / np.maximum(_sum(known.astype(np.float64), foot), 1.0)

    refused = unknown_share > config.max_unknown_fraction + 1e-9
    veto = np.select(
        [
            refused,
            sigma2 > config.max_sigma**2,
            steepness > np.tan(np.deg2rad(config.max_slope_deg)),
            (height_range - range_of_slope > config.max_height_range) | (mean_gap - gap_of_slope > config.max_mean_gap),
            intrusion > config.flank_tolerance,
        ],
        [UNKNOWN, UNCERTAIN, STEEP, ROUGH, STEP_BESIDE],
        OK,
    ).astype(np.uint8)
    return FootfallMap(
        grid=grid,
        method=config.method,
        cost=np.where(refused, np.nan, cost),
        veto=veto,
        contact_height=np.where(refused, np.nan, contact),
        slope=np.where(refused, np.nan, np.arctan(steepness)),
    )


def footprint(radius: float, cell: float, *, shape: str = "disc") -> np.ndarray:
    """Cells under a wheel centred on a cell, uint8, shape (2 k + 1, 2 k + 1): those with their centre within."""
    k = int(np.floor(radius / cell + 1e-9))
    x, y = np.meshgrid(np.arange(-k, k + 1), np.arange(-k, k + 1), indexing="ij")
    inside = np.hypot(x, y) * cell <= radius + 1e-9 if shape == "disc" else np.ones_like(x, dtype=bool)
    return np.asarray(inside.astype(np.uint8))


def _sum(values: np.ndarray, foot: np.ndarray, *, border: float | None = None) -> np.ndarray:
    """Sum over the footprint of each cell. Beyond the map: `border`, or the nearest cell's value."""
    kernel = foot.astype(np.float64)
    if border is None:
        return np.asarray(cv2.filter2D(values, cv2.CV_64F, kernel, borderType=cv2.BORDER_REPLICATE))
    k = foot.shape[0] // 2
    padded = cv2.copyMakeBorder(values, k, k, k, k, cv2.BORDER_CONSTANT, value=border)
    return np.asarray(cv2.filter2D(padded, cv2.CV_64F, kernel)[k:-k, k:-k] if k else values * kernel[0, 0])


def _fill(heights: np.ndarray, known: np.ndarray, foot: np.ndarray) -> np.ndarray:
    """Unknown heights replaced by the mean of the known ones around; by the map's mean where there is none."""
    if not known.any():
        return np.zeros_like(heights)
    level = float(heights[known].mean())
    if known.all():
        return np.ascontiguousarray(heights)
    around = np.ones((max(foot.shape[0], 3),) * 2)
    total = _sum(np.where(known, heights - level, 0.0), around, border=0.0)
    count = _sum(known.astype(np.float64), around, border=0.0)
    return np.ascontiguousarray(np.where(known, heights, level + total / np.maximum(np.rint(count), 1.0)))


def _slopes(filled: np.ndarray, foot: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Gradient along x and y of the least-squares plane through each footprint."""
    k = foot.shape[0] // 2
    offset = cell * np.arange(-k, k + 1)[:, None] * foot
    spread = float(np.sum(offset**2))
    if spread == 0.0:
        return np.zeros_like(filled), np.zeros_like(filled)
    along_x = cv2.filter2D(filled, cv2.CV_64F, offset / spread, borderType=cv2.BORDER_REPLICATE)
    along_y = cv2.filter2D(filled, cv2.CV_64F, offset.T / spread, borderType=cv2.BORDER_REPLICATE)
    return along_x, along_y


def _slope_parts(
    slope_x: np.ndarray, slope_y: np.ndarray, foot: np.ndarray, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Height range and mean gap that a plane of the given gradient has over the footprint's cells [m].

    Only the footprint's outermost cells reach the extremes of a plane, and it is symmetric: the gap is half the range.
    """
    k = foot.shape[0] // 2
    half = np.zeros_like(slope_x)
    for row in range(2 * k + 1):
        reach = np.flatnonzero(foot[row]).max() - k
        half = np.maximum(half, np.abs(slope_x) * (row - k) + np.abs(slope_y) * reach)
    return 2.0 * cell * half, cell * half


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
        np.maximum(highest, reached - hull, out=highest)
    return highest
