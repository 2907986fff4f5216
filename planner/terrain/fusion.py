"""Masked depth images over time -> one fused terrain: height, variance and count per cell of a world-fixed grid.

Model: a scalar Kalman filter per cell. Two views that agree sharpen the cell. Two that disagree by more than their
variances allow do not average, since one of them is wrong (a piece of the robot's own leg, a false match): each cell
counts how many views agreed with it, a contradicting view takes from that trust, and at none the newer view replaces
the height. A fragment seen once is therefore gone after one clean view, and a cell seen well many times survives a
fragment.

The map is fixed to the world, so it outlives every pose of the robot; unknown cells are NaN until seen or touched.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from scipy import ndimage

from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.geometry.arrays import CellCounts, CellFlags, Cells, Points2, Points3
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from planner.perception.stereo import DepthImage
from planner.terrain.elevation import CellHeights, ElevationConfig, GridLayout, measure_cells

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
    sigma_floor: float = 0.004
    """of a fused cell: agreeing views never claim more [m]"""
    elevation: ElevationConfig = field(default_factory=ElevationConfig)

    def __post_init__(self) -> None:
        if self.outliers not in OUTLIERS:
            raise ConfigError(f"outliers {self.outliers!r} is not one of {', '.join(OUTLIERS)}")
        if self.trust_limit < 1:
            raise ConfigError(f"trust_limit is {self.trust_limit}, must be at least 1")


@dataclass(frozen=True, eq=False, kw_only=True)
class FusedTerrain:
    """A snapshot of the map."""

    grid: HeightGrid
    """heights, NaN where unknown [m]"""
    variance: Cells
    """of the height, infinite where unknown [m2]"""
    count: CellCounts
    """views that measured the cell, 0 where unknown: stays 0 where a fill guessed a height"""

    def __post_init__(self) -> None:
        if self.variance.shape != self.grid.shape or self.count.shape != self.grid.shape:
            have = f"{self.variance.shape} and {self.count.shape}"
            raise TerrainError(f"variance and count have shapes {have}, need the grid's {self.grid.shape}")

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
        return FusedTerrain(
            grid=replace(self.grid, heights=heights), variance=self.variance.copy(), count=self.count.copy()
        )


class TerrainMap:
    """The map as it grows: fuse views into it, take snapshots of it."""

    def __init__(self, layout: GridLayout, *, config: FusionConfig) -> None:
        self.layout = layout
        self.config = config
        cells = layout.nx * layout.ny
        self._height = np.full(cells, np.nan)
        self._variance = np.full(cells, np.inf)
        self._count = np.zeros(cells, dtype=np.int64)
        self._trust = np.zeros(cells, dtype=np.int64)

    @staticmethod
    def around(x: float, y: float, *, config: FusionConfig) -> TerrainMap:
        """An empty map centred on a place [m]."""
        layout = GridLayout.centred(x, y, size_x=config.size_x, size_y=config.size_y, cell=config.cell)
        return TerrainMap(layout, config=config)

    def fuse(self, depth: DepthImage, world_from_camera: SE3) -> int:
        """Take in one depth image without the robot in it; returns how many cells it measured."""
        points, sigma = points_in_world(depth, world_from_camera, config=self.config)
        return self.fuse_points(points, sigma)

    def fuse_points(self, points: Points3, sigma_z: np.ndarray) -> int:
        """Take in the points of one view with one sigma of their heights [m]; returns how many cells they measured."""
        cells = measure_cells(points, sigma_z, layout=self.layout, config=self.config.elevation)
        self._update(cells)
        return len(cells.index)

    def set_known(self, xy: Points2, heights: np.ndarray, *, radius: float, variance: float) -> None:
        """Heights known otherwise than by sight, such as under a planted wheel: they replace what was seen there.

        Args:
            xy: places, shape (n, 2) [m].
            heights: of the ground there, shape (n,) [m].
            radius: cells whose centre is this near take the height; at least the nearest one does [m].
            variance: of the heights [m2].
        """
        xs = self.layout.origin_x + self.layout.cell * np.arange(self.layout.nx)
        ys = self.layout.origin_y + self.layout.cell * np.arange(self.layout.ny)
        for (x, y), height in zip(np.asarray(xy), np.asarray(heights), strict=True):
            near = (xs[:, None] - x) ** 2 + (ys[None, :] - y) ** 2 <= radius**2
            flat, inside = self.layout.flat_index(np.array([[x, y]]))
            touched = near.ravel()
            touched[flat[inside]] = True
            self._height[touched] = height
            self._variance[touched] = variance
            self._count[touched] += 1
            self._trust[touched] = self.config.trust_limit

    def fused(self) -> FusedTerrain:
        """Snapshot of the map as it is now; it does not change when the map does."""
        shape = (self.layout.nx, self.layout.ny)
        heights, variance = self._height.copy().reshape(shape), self._variance.copy().reshape(shape)
        count = self._count.copy().reshape(shape)
        for array in (heights, variance, count):
            array.setflags(write=False)
        return FusedTerrain(grid=self.layout.grid(heights), variance=variance, count=count)

    def _update(self, cells: CellHeights) -> None:
        c, config = cells.index, self.config
        known = self._count[c] > 0
        height = np.where(known, self._height[c], 0.0)
        prior = np.where(known, self._variance[c], 0.0) + config.drift_sigma**2
        innovation = cells.height - height
        gate = np.maximum(config.gate_sigma * np.sqrt(prior + cells.variance), config.gate_floor)
        agrees = known & (np.abs(innovation) <= gate)
        trust = np.where(agrees, np.minimum(self._trust[c] + 1, config.trust_limit), self._trust[c] - 1)
        replaced = ~agrees & (trust <= 0)
        gain = np.where(agrees, prior / (prior + cells.variance), 0.0)
        new_height = np.where(replaced, cells.height, height + gain * innovation)
        new_variance = np.where(replaced, cells.variance, np.maximum((1.0 - gain) * prior, config.sigma_floor**2))
        self._height[c] = new_height
        self._variance[c] = new_variance
        self._trust[c] = np.where(replaced, 1, trust)
        self._count[c] += 1


def points_in_world(depth: DepthImage, world_from_camera: SE3, *, config: FusionConfig) -> tuple[Points3, np.ndarray]:
    """Terrain points of a depth image and one sigma of their heights [m]; far, vague and stray pixels are left out."""
    use = np.isfinite(depth.depth) & (depth.depth <= config.max_depth)
    use &= np.nan_to_num(depth.sigma, nan=np.inf) <= config.max_sigma
    if config.outliers == "neighbours":
        use &= _supported(depth)
    rays, inverse, sigma = _bridged(depth, use, config)
    z = 1.0 / inverse
    rays_in_world = world_from_camera.rotate(rays)
    points = rays_in_world * z[:, None] + world_from_camera.translation
    # A wrong depth moves the point along its ray; on ground seen at a slant that is mostly sideways.
    sigma_z = np.maximum(sigma * np.abs(rays_in_world[:, 2]), 1e-4)
    if config.outliers == "statistical":
        return _statistical(points, sigma_z, config)
    return points, sigma_z


def _bridged(depth: DepthImage, use: np.ndarray, config: FusionConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays, inverse depths and sigmas of the used pixels and of points between them and the pixels below.

    The inverse depth is linear along a plane's image, so the points between lie on the plane through both.
    """
    rays = depth.eye.rays()
    safe = np.where(use, depth.depth, 1.0)
    inverse = 1.0 / safe
    out = [(rays[use], inverse[use], depth.sigma[use])]
    shift = depth.eye.focal_px * depth.camera.baseline
    joined = use[:-1] & use[1:] & (np.abs(inverse[:-1] - inverse[1:]) * shift < config.bridge_step_px)
    upper, lower = rays[:-1][joined], rays[1:][joined]
    first, second = inverse[:-1][joined], inverse[1:][joined]
    sigma = np.maximum(depth.sigma[:-1], depth.sigma[1:])[joined]
    gap = np.linalg.norm(upper / first[:, None] - lower / second[:, None], axis=1)
    # Points half a cell apart leave no cell of the gap empty.
    pieces = np.minimum(np.ceil(gap / (0.5 * config.cell)), config.bridge)
    for k in range(1, config.bridge):
        some = pieces > k
        at = (k / pieces[some])[:, None]
        ray = (1.0 - at) * upper[some] + at * lower[some]
        between = (1.0 - at[:, 0]) * first[some] + at[:, 0] * second[some]
        out.append((ray, between, sigma[some]))
    return (
        np.concatenate([o[0] for o in out]),
        np.concatenate([o[1] for o in out]),
        np.concatenate([o[2] for o in out]),
    )


def _supported(depth: DepthImage) -> np.ndarray:
    """Pixels that lie within the noise of the median of their 5 x 5 neighbourhood: stray ones hang between surfaces."""
    inverse = np.where(np.isfinite(depth.depth), 1.0 / depth.depth, 0.0).astype(np.float32)
    known = (inverse > 0.0).astype(np.float32)
    neighbours = cv2.boxFilter(known, cv2.CV_32F, (5, 5), normalize=False)
    # Half of the window must be known, so that the median is of known pixels.
    median = cv2.medianBlur(inverse, 5)
    shift = depth.eye.focal_px * depth.camera.baseline
    return np.asarray((known > 0) & (neighbours >= 14.0) & (np.abs(inverse - median) * shift <= 1.0))


def _statistical(points: np.ndarray, sigma_z: np.ndarray, config: FusionConfig) -> tuple[np.ndarray, np.ndarray]:
    """Open3D's voxel filter at half a cell, then its statistical outlier filter. The sigma travels as a colour."""
    if len(points) == 0:
        return points, sigma_z
    o3d = open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(np.repeat(sigma_z[:, None], 3, axis=1))
    cloud = cloud.voxel_down_sample(0.5 * config.cell)
    cloud, _ = cloud.remove_statistical_outlier(8, 2.5)
    return np.asarray(cloud.points).copy(), np.asarray(cloud.colors)[:, 0].copy()


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
