"""What it costs to be where: for every place of the chassis on a coarse grid, seconds a metre on foot and on wheels.

Fused terrain and footfall scores -> `Places`. The robot keeps its heading, so a place of the chassis is a place for
each wheel. On foot every leg needs a footfall near its regular place: the map's refusals there, its cost and its
unknown cells make the way slower, and a place where one leg has none is refused. On wheels the ground under all six has
to be seen, smooth and nearly plane. Both need room under the chassis. What lies beyond sight may be walked to, at a price.

This is the coarsest of three resolutions, the route of [SunSpiral2012] s5.3.1 (the planner of Smith et al. 2008): a gait
goes along it, and leg motions within that.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from athlete_twin.errors import ConfigError, PlanningError
from athlete_twin.geometry.arrays import Cells, Points2, Vec2
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.footfall import UNCERTAIN, UNKNOWN, FootfallMap
from planner.gait.skeleton import regular_places

REASONS = ("ok", "no_footfall", "clearance", "slope")
"""names of the codes in `Places.refusal`"""
OK, NO_FOOTFALL, CLEARANCE, SLOPE = range(len(REASONS))


@dataclass(frozen=True, kw_only=True)
class RouteConfig:
    """How a route weighs time, ground and what nobody saw."""

    cell: float = 0.2
    """of the grid of chassis places: a third of SDM-B's stride [m]"""
    margin: float = 3.0
    """of that grid beyond start and goal where the map ends, for detours over ground not seen yet [m]"""
    max_places: int = 250_000
    """of that grid: 100 m by 100 m; a search over them takes seconds"""
    step_seconds: float = 55.0
    """mission time of one step with its command cycle; measured on rock_field at 5 s of delay: 52 s (SDM-B), 76 s (T12)"""
    drive_start_seconds: float = 90.0
    """of each drive: steering to and fro at 0.05 rad/s, command cycle, pictures"""
    drive_speed_fraction: float = 0.5
    """of the robot's own drive speed"""
    footfall_radius_fraction: float = 0.6
    """of the stride: footfalls lie this near to a leg's regular place, as in `SearchConfig.radius_fraction`"""
    min_footfalls: float = 0.05
    """share of that disc that must be allowed or out of sight, or the place is refused"""
    refused_weight: float = 1.0
    """added to the pace where all of the discs are refused, in proportion: more tries, cut shifts, steps aside"""
    terrain_weight: float = 0.2
    """added where allowed footfalls are as dear as the dearest, in proportion"""
    unknown_weight: float = 0.3
    """added where all of the discs are unknown, in proportion"""
    slope_weight: float = 0.5
    """added at `max_slope_deg`, in proportion"""
    sight: float = 1.2
    """unknown ground this near the wheels' present places has been looked at in vain: no footfall there [m]"""
    max_slope_deg: float = 20.0
    """of the plane under the six wheels [deg]"""
    body_clearance: float = 0.30
    """between the chassis' lowest part and the ground below it [m]"""
    drive_height_range: float = 0.05
    """of the ground under a rolling wheel beyond its slope's own, smoothed over three cells [m]"""
    drive_slope_deg: float = 10.0
    """of that ground and of the plane under the six wheels: legs keep their posture, so the chassis leans [deg]"""
    drive_uneven: float = 0.05
    """by which one wheel's ground may lie off the plane of all six: about what a wheel's share of the weight presses its
    foot's spring in, SDM-B [m]"""
    escape: float = 0.8
    """a refused place this near the start may be left on foot, at `escape_weight` more [m]"""
    escape_weight: float = 3.0
    look_ahead: float = 1.5
    """along the route: the gait heads for the point so far ahead [m]"""

    def __post_init__(self) -> None:
        positive = (
            "cell", "step_seconds", "drive_speed_fraction", "footfall_radius_fraction", "max_slope_deg", "drive_slope_deg",
            "drive_height_range", "drive_uneven", "look_ahead",
        )  # fmt: skip
        for name in positive:
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ConfigError(f"{name} is {getattr(self, name)}, must be positive and finite")
        least_zero = (
            "margin", "drive_start_seconds", "refused_weight", "terrain_weight", "unknown_weight", "slope_weight", "sight",
            "body_clearance", "escape", "escape_weight",
        )  # fmt: skip
        for name in least_zero:
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise ConfigError(f"{name} is {getattr(self, name)}, must be finite and not negative")
        if not 0.0 < self.min_footfalls <= 1.0:
            raise ConfigError(f"min_footfalls is {self.min_footfalls}, must be above 0 and at most 1")
        if self.drive_speed_fraction > 1.0:
            raise ConfigError(f"drive_speed_fraction is {self.drive_speed_fraction}, must be at most 1: the robot's own speed")
        if not (self.max_slope_deg < 60.0 and self.drive_slope_deg <= self.max_slope_deg):
            raise ConfigError(
                f"drive_slope_deg and max_slope_deg are {self.drive_slope_deg} and {self.max_slope_deg}: need drive_slope_deg "
                "at most max_slope_deg, and that below 60"
            )
        if self.max_places < 4:
            raise ConfigError(f"max_places is {self.max_places}, must be at least 4")

    def pace(self, spec: RobotSpec) -> float:
        """Seconds a metre on foot over open ground: a cycle of six steps goes one stride."""
        return self.step_seconds * LEGS / spec.stride

    def drive_pace(self, spec: RobotSpec) -> float:
        """Seconds a metre on wheels."""
        return 1.0 / (self.drive_speed_fraction * spec.drive_speed)


@dataclass(frozen=True, eq=False, kw_only=True)
class Places:
    """Paces and refusals over a grid of chassis places."""

    origin: Vec2
    """of place [0, 0] [m]"""
    cell: float
    """[m]"""
    walk: Cells
    """pace on foot, infinite where refused, shape (nx, ny) [s/m]"""
    drive: Cells
    """pace on wheels, infinite where the ground is not for it [s/m]"""
    drive_start: float
    """seconds that each drive costs beside its length"""
    refusal: np.ndarray
    """code into `REASONS`, uint8, shape (nx, ny)"""
    leg: np.ndarray
    """index of the leg that "no_footfall" speaks of, int8"""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.cell) and self.cell > 0.0):
            raise PlanningError(f"cell of the route's places is {self.cell} m, must be positive")
        shapes = {self.walk.shape, self.drive.shape, self.refusal.shape, self.leg.shape}
        if len(shapes) != 1 or self.walk.ndim != 2:
            raise PlanningError(f"walk, drive, refusal and leg have shapes {sorted(shapes)}, need one and the same (nx, ny)")
        for name in ("walk", "drive"):
            pace = getattr(self, name)
            if np.isnan(pace).any() or not (pace > 0.0).all():
                raise PlanningError(f"{name} has a pace of {np.min(pace)} s/m, all must be positive, infinite where refused")

    @property
    def shape(self) -> tuple[int, int]:
        """Places along x and y."""
        return (int(self.walk.shape[0]), int(self.walk.shape[1]))

    def index(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Nearest place of points (..., 2), clipped to the grid."""
        cells = np.rint((np.asarray(xy, dtype=float) - self.origin) / self.cell).astype(np.int64)
        return np.asarray(np.clip(cells[..., 0], 0, self.shape[0] - 1)), np.asarray(np.clip(cells[..., 1], 0, self.shape[1] - 1))

    def xy(self, ix: np.ndarray, iy: np.ndarray) -> np.ndarray:
        """Coordinates of places, shape (..., 2) [m]."""
        return np.asarray(self.origin + self.cell * np.stack([ix, iy], axis=-1))

    def why(self, xy: Vec2) -> str:
        """What refuses the place nearest to a point; "ok" where nothing does."""
        ix, iy = (int(i) for i in self.index(xy))
        name = REASONS[int(self.refusal[ix, iy])]
        return f"{name} for leg {int(self.leg[ix, iy]) + 1}" if name == "no_footfall" else name


def places(
    spec: RobotSpec,
    heights: HeightGrid,
    filled: HeightGrid,
    footfalls: FootfallMap,
    world_from_hex: SE3,
    *,
    goal: Vec2,
    config: RouteConfig,
    typical_terrain: float,
    driving: bool,
) -> Places:
    """Every place of the chassis that a route to the goal may touch; the chassis stands on a place of the grid.

    Args:
        spec: the drawings.
        heights: believed ground, NaN where unknown.
        filled: the same without NaN.
        footfalls: scored on it.
        world_from_hex: the chassis, whose heading is kept.
        goal: of the chassis' origin in world [m].
        config: settings.
        typical_terrain: footfall cost that is usual on walkable ground, in the footfall method's unit.
        driving: whether the wheels may roll; without it every pace on wheels is infinite.
    """
    start = world_from_hex.translation[:2]
    _finite(start=start, goal=np.asarray(goal, dtype=float))
    origin, shape = _layout(start, goal, filled, config)
    ix, iy = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    here = origin + config.cell * np.stack([ix, iy], axis=-1)
    wheels = regular_places(spec, world_from_hex) - start

    allowed, unknown, dear = _shares(spec, footfalls, config, typical_terrain)
    unseen = np.array([_sampled(unknown, filled, here + w, 1.0) for w in wheels])
    free = np.array([_sampled(allowed, filled, here + w, 0.0) for w in wheels])
    cost = np.array([_sampled(dear, filled, here + w, 0.0) for w in wheels])
    in_sight = np.linalg.norm(here - start, axis=-1) <= config.sight
    hoped = free + np.where(in_sight, 0.0, unseen)
    scarce = hoped.min(axis=0) < config.min_footfalls

    ground = np.array([filled.sample(here + w) for w in wheels])
    slope, uneven = _plane(wheels, ground)
    clear = _clearance(spec, filled, here, ground) >= config.body_clearance
    refusal = np.select(
        [scarce, ~clear, slope > np.tan(np.deg2rad(config.max_slope_deg))], [NO_FOOTFALL, CLEARANCE, SLOPE], OK
    ).astype(np.uint8)
    factor = (
        1.0
        + config.refused_weight * (1.0 - free - unseen).clip(0.0, 1.0).mean(axis=0)
        + config.unknown_weight * unseen.mean(axis=0)
        + config.terrain_weight * cost.mean(axis=0)
        + config.slope_weight * slope / np.tan(np.deg2rad(config.max_slope_deg))
    )
    pace = config.pace(spec)
    walk = np.where(refusal == OK, pace * factor, np.inf)
    leaving = (refusal != OK) & (np.linalg.norm(here - start, axis=-1) <= config.escape)
    walk[leaving] = pace * (factor + config.escape_weight)[leaving]

    drive = np.full(walk.shape, np.inf)
    if driving:
        # A wheel rolls between places as well: all within half a cell's diagonal of its place has to do.
        reach = _disc(0.71 * config.cell, filled.cell)
        rolls = cv2.erode(drivable(spec, heights, footfalls, config).astype(np.uint8), reach)
        smooth = np.array([_sampled(rolls, filled, here + w, 0.0) for w in wheels]).min(axis=0) > 0.5
        smooth &= (slope <= np.tan(np.deg2rad(config.drive_slope_deg))) & (uneven <= config.drive_uneven) & clear
        drive[smooth] = config.drive_pace(spec)
    return Places(
        origin=origin, cell=config.cell, walk=walk, drive=drive,
        drive_start=config.drive_start_seconds, refusal=refusal, leg=hoped.argmin(axis=0).astype(np.int8),
    )  # fmt: skip


def drivable(spec: RobotSpec, heights: HeightGrid, footfalls: FootfallMap, config: RouteConfig) -> np.ndarray:
    """Cells over which a wheel may roll: a footfall, and smoother and flatter than a footfall has to be, shape (nx, ny)."""
    known = np.isfinite(heights.heights)
    level = float(heights.heights[known].mean()) if known.any() else 0.0
    calm = cv2.blur(np.where(known, heights.heights, level), (3, 3), borderType=cv2.BORDER_REPLICATE)
    count = cv2.blur(known.astype(float), (3, 3), borderType=cv2.BORDER_REPLICATE)
    # The mean of the known cells among the nine.
    calm = level + (calm - level) / np.maximum(count, 1.0 / 9.0)
    patch = 0.5 * spec.wheel.width + 0.05
    disc = _disc(patch, heights.cell)
    highest = cv2.dilate(np.where(known, calm, -1e3), disc)
    lowest = cv2.erode(np.where(known, calm, 1e3), disc)
    slope = np.tan(np.nan_to_num(footfalls.slope, nan=0.5 * np.pi - 1e-6))
    rough = highest - lowest - 2.0 * patch * slope > config.drive_height_range
    return np.asarray(footfalls.allowed & ~rough & (slope <= np.tan(np.deg2rad(config.drive_slope_deg))))


def _finite(**points: np.ndarray) -> None:
    for name, point in points.items():
        if point.shape != (2,) or not np.isfinite(point).all():
            raise PlanningError(f"the route's {name} is {point}, need two finite lengths [m]")


def _layout(start: Vec2, goal: Vec2, grid: HeightGrid, config: RouteConfig) -> tuple[Vec2, tuple[int, int]]:
    """Origin and shape of a grid with the start on a place of it, over the map, the goal and a margin."""
    (x, y), cell = grid.centres(), config.cell
    low = np.minimum(np.minimum(start, goal) - config.margin, [x[0], y[0]])
    high = np.maximum(np.maximum(start, goal) + config.margin, [x[-1], y[-1]])
    before = np.ceil((start - low) / cell).astype(int)
    after = np.ceil((high - start) / cell).astype(int)
    shape = (int(before[0] + after[0]) + 1, int(before[1] + after[1]) + 1)
    if shape[0] * shape[1] > config.max_places:
        far = float(np.linalg.norm(goal - start))
        raise PlanningError(
            f"a route of {far:.0f} m asks for {shape[0]} x {shape[1]} places of {cell} m, allowed {config.max_places}: a "
            "nearer goal, a larger cell or more max_places would do"
        )
    return np.asarray(start - cell * before), shape


def _shares(
    spec: RobotSpec, footfalls: FootfallMap, config: RouteConfig, typical: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of the disc of a leg's footfalls about each cell: allowed share, unknown share, and how dear the allowed are."""
    disc = _disc(config.footfall_radius_fraction * spec.stride, footfalls.grid.cell).astype(np.float32)
    disc /= disc.sum()
    unknown = (footfalls.veto == UNKNOWN) | (footfalls.veto == UNCERTAIN)
    dear = np.where(footfalls.allowed, np.minimum(np.nan_to_num(footfalls.cost) / (3.0 * typical), 1.0), 0.0)
    allowed, hidden, cost = (
        cv2.filter2D(part.astype(np.float32), cv2.CV_32F, disc, borderType=cv2.BORDER_REPLICATE)
        for part in (footfalls.allowed, unknown, dear)
    )
    return allowed, hidden, cost


def _sampled(values: np.ndarray, grid: HeightGrid, xy: np.ndarray, outside: float) -> np.ndarray:
    """Values of the nearest cells, `outside` beyond the map."""
    ix, iy, inside = grid.index(xy)
    return np.where(inside, values[ix, iy].astype(float), outside)


def _plane(wheels: Points2, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope of the plane under the wheels, as a tangent, and the largest distance of a wheel's ground from it [m]."""
    design = np.column_stack([wheels, np.ones(LEGS)])
    fit = np.tensordot(np.linalg.pinv(design), ground, axes=1)
    off = np.abs(ground - np.tensordot(design, fit, axes=1)).max(axis=0)
    return np.hypot(fit[0], fit[1]), off


def _clearance(spec: RobotSpec, filled: HeightGrid, here: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Room between the chassis' lowest part and the highest ground under it, for every place [m]."""
    parts = [*spec.body_parts, *(deck.part for deck in spec.decks)]
    # A ring's size is its two radii and its height; a box's are full lengths.
    reach = max(
        p.size[0] if p.shape == "hexagon_ring" else float(np.hypot(*(np.abs(p.centre[:2]) + 0.5 * p.size[:2]))) for p in parts
    )
    bottom = min(float(p.centre[2] - 0.5 * p.size[2]) for p in parts)
    highest = cv2.dilate(filled.heights, np.ones((3, 3), np.uint8))
    step = max(1, round(0.15 / filled.cell))
    coarse = highest if step == 1 else cv2.dilate(filled.heights, np.ones((2 * step + 1,) * 2, np.uint8))[::step, ::step]
    under = cv2.dilate(np.ascontiguousarray(coarse), _disc(reach, step * filled.cell))
    ix, iy, inside = filled.index(here)
    top = np.where(inside, under[np.minimum(ix // step, under.shape[0] - 1), np.minimum(iy // step, under.shape[1] - 1)], -np.inf)
    return np.asarray(ground.mean(axis=0) + spec.chassis_height + bottom - top)


def _disc(radius: float, cell: float) -> np.ndarray:
    k = int(np.ceil(radius / cell - 1e-9))
    x, y = np.meshgrid(np.arange(-k, k + 1), np.arange(-k, k + 1), indexing="ij")
    return np.asarray(cell * np.hypot(x, y) <= radius + 1e-9, dtype=np.uint8)
