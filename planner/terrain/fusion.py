"""Masked depth images over time -> one fused terrain: height, variance, count and age per cell of a world-fixed grid.

Each view's points become cell heights (`elevation.measure_cells`), which two hypotheses a cell take in, and its rays
take back what they passed through (`hypotheses`): a piece of the robot's leg that slipped through the mask once does not
stay. The map is fixed to the world and outlives every pose of the robot, so what goes out of view survives; its window
follows the robot by whole cells, so memory and time do not grow with the way. Unknown cells are NaN until seen or touched.

The stated variance has three parts: what averaging removes, by the hypotheses' own filters; what all views have in
common; and the sideways error of the map, which on a slope is an error of height.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.geometry.arrays import CellCounts, CellFlags, Cells, Points2, Points3, Vec3
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from planner.perception.stereo import DepthImage
from planner.terrain.elevation import ElevationConfig, GridLayout, measure_cells
from planner.terrain.hypotheses import CellStates, pass_through, take_in
from planner.terrain.points import points_in_world

OUTLIERS = ("neighbours", "statistical", "none")
FILLS = ("nearest", "highest", "smooth")


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """How views become one map."""

    size_x: float = 16.0
    """of the map along x [m]"""
    size_y: float = 16.0
    """[m]"""
    cell: float = 0.05
    """a fifth of SDM-B's wheel radius, and about the stereo's footprint at 5 m [m]"""
    max_depth: float = 9.0
    """points farther away are not used [m]"""
    max_sigma: float = 0.08
    """nor points whose depth is worse than this [m]"""
    bridge: int = 4
    """the gap between neighbouring rows of pixels, wider than a cell on far ground, is bridged by up to as many points
    less one, where both lie on one surface"""
    bridge_step_px: float = 1.0
    """their disparities differ by less than this"""
    outliers: str = "neighbours"
    """"neighbours" (in the image, milliseconds), "statistical" (Open3D's, after a voxel filter) or "none" """
    gate_sigma: float = 3.0
    """views that differ by more than this many sigma contradict each other"""
    gate_floor: float = 0.03
    """and by at least this: less is no contradiction [m]"""
    trust_limit: int = 4
    """agreeing views beyond this many are not remembered: what moved is unlearned in as many views"""
    drift_sigma: float = 0.002
    """a cell's own standard deviation grows by this between two views, for what the pose estimate adds [m]"""
    sigma_common: float = 0.0025
    """of a fused cell's height, from what views have in common and averaging does not remove: the cameras' mountings, the
    world's zero [m]; a robot's drawings say how much (`RobotSpec.believed_map_sigma`), with `sigma_sideways` fitted so that
    90 % of the truth lies in the band, on walks of other seeds than those reported"""
    sigma_sideways: float = 0.012
    """of a fused cell's place, from the same causes; counts times the slope [m]"""
    passed_below: float = 0.05
    """a ray that passes so far below a cell's height speaks against it [m]; 0 takes no such evidence"""
    passed_rays: int = 3
    """fewer such rays are chance"""
    ray_stride: int = 7
    """every so manieth point's ray is followed"""
    follow_fraction: float = 0.2
    """of the map's size: when the robot is so far from its middle, along x or y, the map moves"""
    elevation: ElevationConfig = field(default_factory=ElevationConfig)

    def __post_init__(self) -> None:
        if self.outliers not in OUTLIERS:
            raise ConfigError(f"outliers {self.outliers!r} is not one of {', '.join(OUTLIERS)}")
        if self.trust_limit < 1:
            raise ConfigError(f"trust_limit is {self.trust_limit}, must be at least 1")
        if not 0.0 < self.follow_fraction < 0.5:
            raise ConfigError(f"follow_fraction is {self.follow_fraction}, must be above 0 and below 0.5")
        if not (self.sigma_common >= 0.0 and self.sigma_sideways >= 0.0 and self.passed_below >= 0.0):
            raise ConfigError(
                f"sigma_common, sigma_sideways and passed_below are {self.sigma_common}, {self.sigma_sideways} and "
                f"{self.passed_below} m, must be 0 or more"
            )
        if min(self.passed_rays, self.ray_stride) < 1:
            raise ConfigError(f"passed_rays and ray_stride are {self.passed_rays} and {self.ray_stride}, must be at least 1")


@dataclass(frozen=True, eq=False, kw_only=True)
class FusedTerrain:
    """A snapshot of the map."""

    grid: HeightGrid
    """heights, NaN where unknown [m]"""
    variance: Cells
    """of the height, infinite where unknown [m2]"""
    count: CellCounts
    """views that measured the cell, 0 where unknown: stays 0 where a fill guessed a height"""
    seen: Cells
    """mission time at which the cell was last measured, minus infinity where unknown [s]"""

    def __post_init__(self) -> None:
        shapes = {self.variance.shape, self.count.shape, self.seen.shape}
        if shapes != {self.grid.shape}:
            raise TerrainError(f"variance, count and seen have shapes {shapes}, need the grid's {self.grid.shape}")

    def age(self, t: float) -> Cells:
        """Time since each cell was last measured, at mission time `t`; infinite where unknown [s]."""
        return np.asarray(t - self.seen)

    @property
    def unknown(self) -> CellFlags:
        """Cells that nothing was ever known of."""
        return np.asarray(self.count == 0)

    @property
    def sigma(self) -> Cells:
        """One sigma of the heights [m]."""
        return np.asarray(np.sqrt(self.variance))

    def filled(self, method: str, *, margin: float = 0.0) -> FusedTerrain:
        """A copy without NaN; `unknown` still tells the guessed cells, whose variance stays infinite.

        Args:
            method: "nearest" takes the nearest known height; "smooth" interpolates between known cells; "highest"
                takes the highest known height within as far as the nearest known cell, for collision checks.
            margin: added to guessed heights [m].
        """
        if method not in FILLS:
            raise ConfigError(f"fill {method!r} is not one of {', '.join(FILLS)}")
        unknown = self.unknown
        if unknown.all():
            raise TerrainError("no cell of the map is known, there is nothing to fill from")
        heights = _fill(self.grid.heights, unknown, method)
        heights[unknown] += margin
        return replace(self, grid=replace(self.grid, heights=heights))

    def raised(self, deviations: float, *, over: float) -> FusedTerrain:
        """A copy whose measured cells are higher by what so many sigma of theirs exceed `over` [m]: what a clearance does not cover.

        Guessed cells stay: what is guessed has no sigma.
        """
        if not (deviations >= 0.0 and over >= 0.0):
            raise ConfigError(f"deviations are {deviations} and the height covered is {over} m, must not be negative")
        sigma = np.where(self.unknown, 0.0, self.sigma)
        heights = self.grid.heights + np.maximum(deviations * sigma - over, 0.0)
        return replace(self, grid=replace(self.grid, heights=heights))


class TerrainMap:
    """The map as it grows: fuse views into it, take snapshots of it."""

    def __init__(self, layout: GridLayout, *, config: FusionConfig) -> None:
        self.layout = layout
        self.config = config
        self._cells = CellStates.empty(layout.nx * layout.ny)

    @staticmethod
    def around(x: float, y: float, *, config: FusionConfig) -> TerrainMap:
        """An empty map centred on a place [m]."""
        layout = GridLayout.centred(x, y, size_x=config.size_x, size_y=config.size_y, cell=config.cell)
        return TerrainMap(layout, config=config)

    def fuse(self, depth: DepthImage, world_from_camera: SE3) -> int:
        """Take in one depth image without the robot in it; returns how many cells it measured."""
        points, sigma = points_in_world(depth, world_from_camera, config=self.config)
        return self.fuse_points(points, sigma, t=depth.t, origin_in_world=world_from_camera.translation)

    def fuse_points(
        self, points: Points3, sigma_z: np.ndarray, *, t: float = 0.0, origin_in_world: Vec3 | None = None
    ) -> int:
        """Take in the points of one view; returns how many cells they measured.

        Args:
            points: in world, shape (n, 3) [m]; rows that are not finite are left out.
            sigma_z: one sigma of each point's height, shape (n,) [m].
            t: mission time of the view [s].
            origin_in_world: the eye that saw them: its rays take back what they passed through; none do without it [m].
        """
        c = self.config
        good = np.isfinite(points).all(axis=1) & np.isfinite(sigma_z) & (sigma_z > 0.0)
        if not good.all():
            points, sigma_z = points[good], sigma_z[good]
        cells = measure_cells(points, sigma_z, layout=self.layout, config=c.elevation)
        take_in(
            self._cells, cells, t=t, gate_sigma=c.gate_sigma, gate_floor=c.gate_floor, drift_variance=c.drift_sigma**2,
            trust_limit=c.trust_limit,
        )  # fmt: skip
        if origin_in_world is not None and c.passed_below > 0.0:
            pass_through(
                self._cells, origin_in_world, points[:: c.ray_stride], cells.index, layout=self.layout,
                margin=c.passed_below, gate_sigma=c.gate_sigma, least_rays=c.passed_rays,
            )  # fmt: skip
        return len(cells.index)

    def set_known(self, xy: Points2, heights: np.ndarray, *, radius: float, variance: float, t: float = 0.0) -> None:
        """Heights known otherwise than by sight, such as under a planted wheel: they replace what was seen there.

        Args:
            xy: places, shape (n, 2) [m].
            heights: of the ground there, shape (n,) [m].
            radius: cells whose centre is this near take the height; at least the nearest one does [m].
            variance: of the heights [m2].
            t: mission time [s].
        """
        state = self._cells
        xs = self.layout.origin_x + self.layout.cell * np.arange(self.layout.nx)
        ys = self.layout.origin_y + self.layout.cell * np.arange(self.layout.ny)
        for (x, y), height in zip(np.asarray(xy), np.asarray(heights), strict=True):
            near = (xs[:, None] - x) ** 2 + (ys[None, :] - y) ** 2 <= radius**2
            flat, inside = self.layout.flat_index(np.array([[x, y]]))
            touched = near.ravel()
            touched[flat[inside]] = True
            state.height[touched] = height
            state.variance[touched] = variance
            state.count[touched] += 1
            state.trust[touched] = self.config.trust_limit
            state.seen[touched] = np.maximum(state.seen[touched], t)

    def follow(self, x: float, y: float) -> bool:
        """Move the window over a place that is far from its middle; whether it moved. What it leaves is forgotten [m]."""
        layout = self.layout
        middle_x = layout.origin_x + 0.5 * layout.cell * (layout.nx - 1)
        middle_y = layout.origin_y + 0.5 * layout.cell * (layout.ny - 1)
        config = self.config
        off = max(abs(x - middle_x) / config.size_x, abs(y - middle_y) / config.size_y)
        if off <= config.follow_fraction:
            return False
        after = GridLayout.centred(x, y, size_x=config.size_x, size_y=config.size_y, cell=layout.cell)
        self._cells = self._cells.moved(layout, after)
        self.layout = after
        return True

    def lower(self, by: float) -> None:
        """The world's zero is so much higher than was thought: all heights sink [m]."""
        self._cells.height -= by
        self._cells.other_height -= by

    def fused(self) -> FusedTerrain:
        """Snapshot of the map as it is now; it does not change when the map does."""
        shape = (self.layout.nx, self.layout.ny)
        heights, count = self._cells.height.copy().reshape(shape), self._cells.count.copy().reshape(shape)
        seen = self._cells.seen.copy().reshape(shape)
        variance = self._cells.variance.reshape(shape) + self.config.sigma_common**2
        variance = variance + self.config.sigma_sideways**2 * _slope_squared(heights, self.layout.cell)
        for array in (heights, variance, count, seen):
            array.setflags(write=False)
        return FusedTerrain(grid=self.layout.grid(heights), variance=variance, count=count, seen=seen)


def _slope_squared(heights: Cells, cell: float) -> Cells:
    """Square of the steepest one-sided slope along x plus along y; steps to unknown cells count as none."""
    along_x, along_y = np.abs(np.diff(heights, axis=0)), np.abs(np.diff(heights, axis=1))
    along_x, along_y = np.nan_to_num(along_x / cell), np.nan_to_num(along_y / cell)
    gx, gy = np.zeros(heights.shape), np.zeros(heights.shape)
    gx[:-1], gy[:, :-1] = along_x, along_y
    gx[1:], gy[:, 1:] = np.maximum(gx[1:], along_x), np.maximum(gy[:, 1:], along_y)
    return np.asarray(gx**2 + gy**2)


def _fill(heights: Cells, unknown: CellFlags, method: str) -> Cells:
    distance, nearest = ndimage.distance_transform_edt(unknown, return_indices=True)
    out = np.array(heights[tuple(nearest)])
    if method == "smooth":
        # Relax guessed cells towards the mean of their neighbours, the known ones held: Laplace's equation from the
        # nearest-cell guess.
        for _ in range(50):
            out[unknown] = ndimage.uniform_filter(out, 5, mode="nearest")[unknown]
    if method == "highest":
        # Growing windows: a cell d cells from the known ones takes the highest known height within 2 d.
        low = np.where(unknown, -np.inf, heights)
        for reach in (2, 4, 8, 16, 32):
            ring = unknown & (distance <= reach) & (distance > reach / 2 if reach > 2 else True)
            if ring.any():
                out[ring] = np.maximum(ndimage.maximum_filter(low, 2 * reach + 1, mode="nearest")[ring], out[ring])
    return out


__all__ = ["FILLS", "OUTLIERS", "FusedTerrain", "FusionConfig", "TerrainMap", "points_in_world"]
