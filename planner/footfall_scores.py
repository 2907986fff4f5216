"""What a footfall costs by each method, for every cell of a map at once: the ground under a foot to one number.

The methods of [Caillas1989] s3.1 and its s2 over the footprint of a wheel, a disc or a square; the smaller the better. A
printed formula whose dimensions are off is taken for what it means:

- `max_min`, eq. 2: highest less lowest elevation [m].
- `plane_fit`, eqs 3-4: mean square distance from the mean elevation [m2]. The paper's plane is horizontal.
- `support_area`: depth below the highest point at which a share of the foot bears [m]. The paper's algorithm: what the
  soil's P = k delta^n makes of it has its minimum where the depth has, "in first approximation".
- `support_energy`, eqs 5-6: work of sinking there [J]. What that approximation leaves out.
- `free_volume`, eq. 8: room between a plate resting on the highest point and the ground [m3]. The paper chose it. Its
  factor is printed d^2 / n^2 for n samples, which vanishes as n grows; the mean gap times the footprint's area is meant.
- `equilibrium`: of the footfalls in a region whose free volume is nearly the least, the one whose room below the plate
  has the least first moment. The moment is printed without the area of a sample: times it, it is in m4. Over a footprint
  that is symmetric, and all are, it is the slope of the best plane times the footprint's second moment.
- `asv_slope`: slope of the best plane where it exceeds a threshold, nothing elsewhere [rad]. What the Adaptive
  Suspension Vehicle did, as a baseline.

`equilibrium` is a choice in two passes and not a number; `_equilibrium` gives a number whose order is that choice.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Cells
from planner.footfall_support import bearing_cells, energy, level

METHODS = ("max_min", "plane_fit", "support_area", "support_energy", "free_volume", "equilibrium", "asv_slope")
SHAPES = ("disc", "square")
TYPICAL = {
    "max_min": 0.026, "plane_fit": 4.5e-5, "support_area": 0.013, "support_energy": 2.6, "free_volume": 0.0015,
    "equilibrium": 0.0015, "asv_slope": np.deg2rad(14.0) / 3.0,
}  # fmt: skip
"""cost under SDM-B's wheel where the free volume is typical of walkable ground: medians over such cells of five fields each of
`rock_field`, `black_point` and `moses_lake`. A step search weighs no more than three times it: beyond the ASV's threshold"""
NO_FOOTFALL = 1e6
"""free volume of what is no footfall [m3]"""


@dataclass(frozen=True, kw_only=True)
class CostConfig:
    """A method, the footprint it looks at, and its constants."""

    method: str = "free_volume"
    """one of `METHODS`; "free_volume" is what [Caillas1989] s5 recommends"""
    shape: str = "disc"
    """of the footprint: "disc", since the wheel may be steered any way, or the paper's "square" """
    footprint_fraction: float = 0.75
    """footprint radius (half side of a square) over the wheel's: a tyre's patch and the tread's curve beside it"""
    footprint_diameter: float | None = None
    """(side of a square) instead of that fraction [m]; 0.30 is the foot of [Caillas1989] figure 4"""
    min_support_fraction: float = 0.5
    """of the footprint: what must bear before a foot stops sinking; [Caillas1989] s3.2.1 reckons with one half"""
    soil_k: float = 1.5e6
    """k of P = k delta^n [Pa/m^n]: k_phi + k_c / b of Bekker's dry sand, 1528 and 0.99 kN, for a foot of b = 15 cm"""
    soil_n: float = 1.1
    """n of P = k delta^n: the same sand"""
    equilibrium_slack: float = 0.10
    """x: free volumes up to (1 + x) of the region's least are alike; 0.05 to 0.10 in [Caillas1989] s3.1.5"""
    equilibrium_region: float = 1.0
    """side of the square round a cell among which the least is sought [m]; the regions of [Caillas1989] s3.2.2"""
    asv_slope_deg: float = 14.0
    """slope up to which "asv_slope" takes any ground [deg]; the steepest on which SDM-B was walked"""
    deviations: float = 1.0
    """by so many sigma the highest point is taken to be higher and all others lower; 1 is the map's own statement of how far
    heights are off, and adds to `plane_fit` what noise of that sigma adds; 0 scores the heights as they are"""

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ConfigError(f"footfall method {self.method!r} is not one of {', '.join(METHODS)}")
        if self.shape not in SHAPES:
            raise ConfigError(f"footprint shape {self.shape!r} is not one of {', '.join(SHAPES)}")
        if not 0.0 < self.footprint_fraction <= 2.0:
            raise ConfigError(f"footprint_fraction is {self.footprint_fraction}, must be within 0 to 2")
        if self.footprint_diameter is not None and not 0.0 < self.footprint_diameter <= 2.0:
            raise ConfigError(f"footprint_diameter is {self.footprint_diameter} m, must be positive and at most 2")
        if not 0.0 < self.min_support_fraction <= 1.0:
            raise ConfigError(f"min_support_fraction is {self.min_support_fraction}, must be positive and at most 1")
        for name in ("soil_k", "soil_n", "equilibrium_slack", "equilibrium_region", "asv_slope_deg"):
            if not (getattr(self, name) > 0.0 and np.isfinite(getattr(self, name))):
                raise ConfigError(f"{name} is {getattr(self, name)}, must be positive")
        if not (self.deviations >= 0.0 and np.isfinite(self.deviations)):
            raise ConfigError(f"deviations is {self.deviations}, must not be negative")

    def footprint_radius(self, wheel_radius: float) -> float:
        """Radius of the footprint, or half its side [m]."""
        return self.footprint_fraction * wheel_radius if self.footprint_diameter is None else 0.5 * self.footprint_diameter


@dataclass(frozen=True, eq=False, kw_only=True)
class Underfoot:
    """What lies under a foot on each cell; every array of shape (nx, ny)."""

    heights: Cells
    """without NaN [m]; beyond the map stands the nearest cell's"""
    foot: np.ndarray
    """footprint, uint8, shape (2 k + 1, 2 k + 1)"""
    cell: float
    """edge of a cell [m]"""
    highest: Cells
    """[m]"""
    lowest: Cells
    """[m]"""
    mean: Cells
    """[m]"""
    slope_x: Cells
    """gradient of the least-squares plane along x"""
    slope_y: Cells
    """along y"""
    steepness: Cells
    """tangent of the plane's slope"""

    def offsets(self) -> tuple[np.ndarray, np.ndarray]:
        """Of the footprint's cells from its middle, zero outside it, each of shape (2 k + 1, 2 k + 1) [m]."""
        k = self.foot.shape[0] // 2
        along = self.cell * np.arange(-k, k + 1)
        return along[:, None] * self.foot, along[None, :] * self.foot

    @property
    def second_moment(self) -> float:
        """Sum of x^2 over the footprint's cells; that of y^2 is the same [m2]."""
        return float(np.sum(self.offsets()[0] ** 2))

    @property
    def reach(self) -> float:
        """From the footprint's middle to the centre of its farthest cell [m]."""
        return float(np.hypot(*self.offsets()).max())


def footprint(radius: float, cell: float, *, shape: str = "disc") -> np.ndarray:
    """Cells under a wheel centred on a cell, uint8, shape (2 k + 1, 2 k + 1): those with their centre within."""
    k = int(np.floor(radius / cell + 1e-9))
    x, y = np.meshgrid(np.arange(-k, k + 1), np.arange(-k, k + 1), indexing="ij")
    inside = np.hypot(x, y) * cell <= radius + 1e-9 if shape == "disc" else np.ones_like(x, dtype=bool)
    return np.asarray(inside.astype(np.uint8))


def underfoot(heights: Cells, foot: np.ndarray, *, cell: float) -> Underfoot:
    """What every method and the vetoes share.

    Args:
        heights: without NaN, float64, shape (nx, ny) [m].
        foot: from `footprint`.
        cell: edge of a cell [m].
    """
    slope_x, slope_y = _slopes(heights, foot, cell)
    return Underfoot(
        heights=heights,
        foot=foot,
        cell=cell,
        highest=cv2.dilate(heights, foot),
        lowest=cv2.erode(heights, foot),
        mean=window_sum(heights, foot) / float(foot.sum()),
        slope_x=slope_x,
        slope_y=slope_y,
        steepness=np.hypot(slope_x, slope_y),
    )


def cost(under: Underfoot, config: CostConfig, *, variance: Cells, refused: np.ndarray) -> Cells:
    """Of putting a foot on each cell, by the method of the configuration and in its unit, shape (nx, ny).

    Args:
        under: the ground under a foot on each cell.
        config: method and constants.
        variance: of the heights [m2]; matters when `config.deviations` is not 0.
        refused: cells that are no footfall for want of known ground: none of them is a region's best.
    """
    margin = config.deviations * np.sqrt(variance) if config.deviations > 0.0 else None
    if config.method == "asv_slope":
        slope = np.arctan(under.steepness + _moment_of(margin, under) / max(under.second_moment, 1e-12))
        return np.asarray(np.where(slope > np.deg2rad(config.asv_slope_deg), slope, 0.0))
    n = float(under.foot.sum())
    if config.method == "plane_fit":
        square = window_sum(under.heights * under.heights, under.foot) / n - under.mean * under.mean
        noise = 0.0 if margin is None else window_sum(margin * margin, under.foot) / n
        return np.asarray(np.maximum(square, 0.0) + noise)
    highest = under.highest if margin is None else cv2.dilate(under.heights + margin, under.foot)
    if config.method == "max_min":
        return np.asarray(highest - (under.lowest if margin is None else cv2.erode(under.heights - margin, under.foot)))
    if config.method in ("support_area", "support_energy"):
        lower = under.heights if margin is None else under.heights - margin
        depth = highest - level(lower, under.foot, bearing_cells(config.min_support_fraction, under.foot))
        if config.method == "support_area":
            return np.asarray(depth)
        return energy(highest, depth, lower, under.foot, cell=under.cell, k=config.soil_k, n=config.soil_n)
    gap = highest - under.mean
    if margin is not None:
        gap = gap + window_sum(margin, under.foot) / n
    volume = gap * n * under.cell**2
    if config.method == "free_volume":
        return np.asarray(volume)
    return _equilibrium(volume, first_moment(under) + under.cell**2 * _moment_of(margin, under), under, config, refused)


def first_moment(under: Underfoot) -> Cells:
    """M of [Caillas1989] s3.1.5: first moment about the foot's middle of the room below a plate on it, shape (nx, ny) [m4].

    Of m_x = sum(y_i (z_max - z_i)) the part with z_max is zero over a symmetric footprint, and sum(y_i z_i) is what the
    least-squares plane is made of.
    """
    return np.asarray(under.cell**2 * under.second_moment * under.steepness)


def window_sum(values: np.ndarray, foot: np.ndarray, *, border: float | None = None) -> np.ndarray:
    """Sum over the footprint of each cell. Beyond the map: `border`, or the nearest cell's value."""
    kernel = foot.astype(np.float64)
    if border is None:
        return np.asarray(cv2.filter2D(values, cv2.CV_64F, kernel, borderType=cv2.BORDER_REPLICATE))
    k = foot.shape[0] // 2
    padded = cv2.copyMakeBorder(values, k, k, k, k, cv2.BORDER_CONSTANT, value=border)
    return np.asarray(cv2.filter2D(padded, cv2.CV_64F, kernel)[k:-k, k:-k] if k else values * kernel[0, 0])


def _equilibrium(
    volume: Cells, moment: Cells, under: Underfoot, config: CostConfig, refused: np.ndarray
) -> Cells:
    """Free volume, but for the cells within (1 + x) of the least V of their region: V + x / (1 + x) M / reach [m3].

    M is at most the free volume times the footprint's reach, so these stay within (1 + x) of the least and are
    ordered by M alone, as the paper's second pass orders them; the others follow by their free volume, as in its first.
    """
    reach = max(under.reach, 1e-12)
    k = max(1, round(0.5 * config.equilibrium_region / under.cell))
    least = cv2.erode(np.where(refused, NO_FOOTFALL, volume), np.ones((2 * k + 1, 2 * k + 1), dtype=np.uint8))
    x = config.equilibrium_slack
    return np.asarray(np.where(volume <= (1.0 + x) * least, least + x / (1.0 + x) * moment / reach, volume))


def _slopes(heights: Cells, foot: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Gradient along x and y of the least-squares plane through each footprint."""
    k = foot.shape[0] // 2
    offset = cell * np.arange(-k, k + 1)[:, None] * foot
    spread = float(np.sum(offset**2))
    if spread == 0.0:
        return np.zeros_like(heights), np.zeros_like(heights)
    along_x = cv2.filter2D(heights, cv2.CV_64F, offset / spread, borderType=cv2.BORDER_REPLICATE)
    along_y = cv2.filter2D(heights, cv2.CV_64F, offset.T / spread, borderType=cv2.BORDER_REPLICATE)
    return along_x, along_y


def _moment_of(margin: Cells | None, under: Underfoot) -> np.ndarray | float:
    """Deviation of sum(x z) when the heights' is `margin`, the same along any axis on the average [m2]."""
    if margin is None:
        return 0.0
    x, y = under.offsets()
    lever2 = 0.5 * (x * x + y * y)
    return np.asarray(np.sqrt(cv2.filter2D(margin * margin, cv2.CV_64F, lever2, borderType=cv2.BORDER_REPLICATE)))
