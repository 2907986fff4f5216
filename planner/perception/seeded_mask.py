"""The drawn robot as seed, the watershed for its edge: what [SunSpiral2012] s5.2 recommends and did not have.

The drawing is first moved onto the picture (`drawing_fit`). Well inside it all is robot, well outside all is terrain; how
wide the band between is, the fit says itself. In the band a pixel behind the leg is terrain, a pixel beside the leg's edge
at the leg's depth is matching's fattening of it, and what remains is flooded from both sides, lowest edge first: edges of
the depth where it is known, edges of the image where depth fails. Low ground beside a tyre is left to the map: it cannot
make a ghost.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import DepthMap, Mask
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import VisualPart
from athlete_twin.model.camera import Pinhole
from planner.perception.drawing_fit import DrawingFit, DrawingFitConfig, fit_drawing
from planner.perception.ground_surface import GroundSurface
from planner.perception.robot_drawing import DrawnView, RobotDrawing, beside_drawn
from planner.perception.stereo import DepthImage
from planner.perception.watershed import depth_edges, flood, image_edges

COARSE_WIDTH = 256
"""of the picture in which the drawing is placed, at least [px]"""
THIN = 0.6
"""of a part's half thickness: farther in it is core, however wide the band"""
NEAREST = 0.5
"""parts drawn nearer than that are at the lens: no pair measures there, and their motion in the picture says nothing [m]"""
NEAREST_STEP_PX = 4
"""of the sparse grid on which the nearest measured depth is looked for"""
GUARD_PX = 3.0
"""width of the rim of sure terrain that the flood meets outside the band"""
ROBOT, TERRAIN = 2, 3
"""markers of the flood"""


@dataclass(frozen=True, kw_only=True)
class SeedConfig:
    """How the drawing becomes a mask."""

    fit: DrawingFitConfig = field(default_factory=DrawingFitConfig)
    sigmas: float = 2.0
    """of the fitted drawing's place that the band covers"""
    own_px: float = 1.0
    """the band's least half width: pixels, links that are not where the fit of all of them says"""
    fattening_px: float = 3.0
    """by which matching carries a leg's depth beyond its outline: half the matched window and the rounding"""
    depth_tolerance: float = 0.15
    """what lies farther behind the drawn leg is terrain [m]"""
    rim_px: int = 4
    """round the mask, what is not low ground goes too: matching leaves depths between the leg's and the terrain's there [px]"""
    low: float = 0.04
    """outside the drawing, what rises less above the ground stays: less than a ghost [m]"""
    edge_px: float = 1.5
    """Laplacian of the disparity that counts as an edge [px]"""
    edge_grey: float = 40.0
    """step of the image that counts as an edge where depth fails [grey levels]"""

    def __post_init__(self) -> None:
        if min(self.sigmas, self.own_px, self.fattening_px, self.depth_tolerance, self.edge_px, self.edge_grey) <= 0.0:
            raise ConfigError(f"widths, tolerances and edges must be positive, got {self}")


@dataclass(frozen=True, eq=False, kw_only=True)
class SeededMask:
    """The mask and how it came about."""

    mask: Mask
    """shape (h, w)"""
    labels: np.ndarray
    """2 flooded from the robot, 3 from the terrain, 0 where nothing was flooded, shape (h, w), int32"""
    expected: DepthMap
    """of the robot as drawn at the fitted pose, NaN elsewhere [m]"""
    fit: DrawingFit


def seeded_mask(
    depth: DepthImage,
    parts: Sequence[VisualPart],
    hex_from_link: Mapping[str, SE3],
    surface: GroundSurface,
    *,
    config: SeedConfig,
) -> SeededMask:
    """Pixels of the robot, from the drawing at the believed pose and the depth image.

    Args:
        depth: as matched.
        parts: the drawn robot.
        hex_from_link: believed pose of every link that has a part.
        surface: the ground below, in hex.
        config: how wide, how near, how sharp.
    """
    drawing = RobotDrawing(parts, hex_from_link)
    step = next(n for n in (8, 4, 2, 1) if n == 1 or depth.eye.width_px >= n * COARSE_WIDTH)
    coarse_eye = depth.eye.binned(step) if step > 1 else depth.eye
    fit = fit_drawing(depth, drawing.view(depth.camera.hex_from_camera, coarse_eye), step=step, config=config.fit)
    hex_from_fitted = depth.camera.hex_from_camera.compose(fit.true_from_drawn.inverse())
    coarse = drawing.view(hex_from_fitted, coarse_eye)
    shape = depth.depth.shape
    mask, labels = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=np.int32)
    if not coarse.drawn.any():
        return SeededMask(mask=mask, labels=labels, expected=np.full(shape, np.nan), fit=fit)
    near = cv2.dilate(coarse.drawn.astype(np.uint8), np.ones((3, 3), np.uint8))
    only = cv2.resize(near, shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    fine = drawing.view(hex_from_fitted, depth.eye, only=only)
    spread = _spread(depth, coarse, coarse_eye, fit)
    if not fine.drawn.any():
        return SeededMask(mask=mask, labels=labels, expected=fine.depth, fit=fit)
    half = config.sigmas * float(spread[fine.drawn].max()) + config.own_px
    window = _window(fine.drawn, int(np.ceil(half + config.fattening_px + GUARD_PX)) + config.rim_px + 1)
    mask[window], labels[window] = _cut(depth, fine, spread, window, surface, config)
    return SeededMask(mask=mask, labels=labels, expected=fine.depth, fit=fit)


def _spread(depth: DepthImage, coarse: DrawnView, coarse_eye: Pinhole, fit: DrawingFit) -> np.ndarray:
    """One sigma of where each drawn pixel appears, shape (h, w) [px]; beside the drawing that of the nearest."""
    rows, columns = np.nonzero(coarse.drawn)
    points = coarse_eye.rays()[rows, columns] * np.maximum(coarse.depth[rows, columns], NEAREST)[:, None]
    out = np.zeros(coarse.depth.shape, dtype=np.float32)
    out[rows, columns] = fit.spread_px(points, depth.eye.focal_px)
    _, owner = cv2.distanceTransformWithLabels((out == 0.0).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of_owner = np.zeros(int(owner.max()) + 1, dtype=np.float32)
    of_owner[owner[rows, columns]] = out[rows, columns]
    return np.asarray(cv2.resize(of_owner[owner], depth.depth.shape[::-1], interpolation=cv2.INTER_NEAREST))


def _window(drawn: Mask, margin: int) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
    top, left = max(int(rows[0]) - margin, 0), max(int(columns[0]) - margin, 0)
    return slice(top, int(rows[-1]) + margin + 1), slice(left, int(columns[-1]) + margin + 1)


def _cut(
    depth: DepthImage, fine: DrawnView, spread: np.ndarray, window: tuple[slice, slice], surface: GroundSurface, config: SeedConfig
) -> tuple[Mask, np.ndarray]:
    drawn = fine.drawn[window]
    measured = depth.depth[window]
    known = np.isfinite(measured)
    expected = np.where(drawn, fine.depth[window], 0.0)
    outside, leg_depth = beside_drawn(np.where(drawn, expected, np.nan))
    inside = cv2.distanceTransform(drawn.astype(np.uint8), cv2.DIST_L2, 3)
    half = config.sigmas * spread[window] + config.own_px
    # Where a fork is drawn the wheel behind it may be seen: what counts is the farthest part drawn nearby.
    size = 2 * int(np.ceil(np.median(half[drawn]))) + 3
    farthest = np.maximum(cv2.dilate(expected, np.ones((size, size), np.uint8)), leg_depth)
    behind = known & (np.nan_to_num(measured) > farthest + config.depth_tolerance)
    # On a part that is drawn nearer than anything that was measured no depth can be true: there depth fails.
    sparse = depth.depth[::NEAREST_STEP_PX, ::NEAREST_STEP_PX]
    fails = leg_depth < float(np.min(sparse, initial=np.inf, where=np.isfinite(sparse)))
    behind &= ~fails
    # A part thinner than the band is wide has a core too: its middle.
    thick = cv2.dilate(inside, np.ones((size, size), np.uint8))
    core = drawn & (fails | (inside > np.minimum(half, THIN * thick)))
    edge = half + config.fattening_px
    band = (outside <= edge) & ~core
    ask = (outside <= edge + config.rim_px) & known & ~drawn
    height = np.full(drawn.shape, -np.inf)
    height[ask] = surface.height(_points(depth, window, ask))
    terrain = (behind & ~core) | (ask & ~fails & (height < config.low)) | ((outside > edge) & (outside <= edge + GUARD_PX))
    # Beside the outline and as near as the leg: carried there by matching.
    alike = known & ~behind & (np.abs(np.nan_to_num(measured) - leg_depth) < config.depth_tolerance)
    fattened = alike & band & ~terrain & (outside <= config.fattening_px)
    markers = np.zeros(drawn.shape, dtype=np.int32)
    markers[terrain] = TERRAIN
    markers[core | fattened] = ROBOT
    depth_level = depth_edges(depth, window, edge_px=config.edge_px)
    level = np.where(known & ~fails, depth_level, image_edges(depth.grey[window], edge_grey=config.edge_grey))
    labels = flood(markers, level, band)
    mask = labels == ROBOT
    size = 2 * config.rim_px + 1
    rim = cv2.dilate(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0
    return np.asarray(mask | (rim & (height > config.low))), labels


def _points(depth: DepthImage, window: tuple[slice, slice], at: Mask) -> np.ndarray:
    """Measured points of some pixels of a window, in hex, shape (n, 3) [m]."""
    rows, columns = np.nonzero(at)
    z = depth.depth[window][rows, columns]
    eye = depth.eye
    x = (columns + window[1].start - eye.cx_px) / eye.focal_px * z
    y = (rows + window[0].start - eye.cy_px) / eye.focal_px * z
    return np.asarray(depth.camera.hex_from_camera.apply(np.column_stack([x, y, z])))
