"""Belief against picture: the small motion that puts the drawn robot where this depth image shows it.

Camera poses, encoder zeros and sag put the drawing a few centimetres and a degree beside the legs ([SunSpiral2012] s4.3:
"even under the best of circumstances the forward projected image mask would never perfectly match"). Most of that is one
rigid motion, since the camera's error moves all legs together. It is estimated by point-to-plane registration of the drawn
surface to the measured depth along each ray, with a redescending weight, and with the belief as prior: where little of the
robot has depth, the drawing stays where it was believed and says that it may be off.

The ground sees only pictures and drawings: nothing here is known of the truth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.se3 import SE3
from planner.perception.outline_search import drawn_outline, search
from planner.perception.robot_drawing import DrawnView
from planner.perception.stereo import DepthImage


@dataclass(frozen=True, kw_only=True)
class DrawingFitConfig:
    """How the drawing is moved onto the picture."""

    enabled: bool = True
    """else the drawing stays at the believed pose"""
    position: float = 0.03
    """by which the believed place of camera and legs may be off [m]"""
    angle: float = 0.02
    """by which the believed direction may be off: a little over 1 deg [rad]"""
    gates: tuple[float, ...] = (0.12, 0.12, 0.10, 0.08, 0.06, 0.05, 0.04, 0.04)
    """a round of registration each: residuals beyond it have no say [m]"""
    noise: float = 0.015
    """of a residual, one sigma: matching on a leg, and the leg's own deviation from the others [m]"""
    correlation: float = 12.0
    """so many neighbouring residuals say no more than one"""
    points: int = 3000
    """of the drawn surface at most"""
    outline_points: int = 500
    """of the drawn outline at most"""
    outline_noise_px: float = 1.5
    """of where the outline is found, one sigma, in pixels of a picture 512 wide"""
    fattening_px: float = 1.0
    """by which matching pushes a leg's outline outward [px]"""

    def __post_init__(self) -> None:
        if min(self.position, self.angle, self.noise) <= 0.0 or self.correlation < 1.0 or self.points < 6 or not self.gates:
            raise ConfigError(f"sigmas must be positive, correlation at least 1, points at least 6, one gate or more, got {self}")


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawingFit:
    """The motion found, and how sure it is."""

    true_from_drawn: SE3
    """in the camera's frame: takes drawn points to where the picture shows them"""
    covariance: np.ndarray
    """of its rotation vector and shift about the camera, shape (6, 6)"""
    points: int
    """residuals that had a say"""

    def spread_px(self, points_in_camera: np.ndarray, focal_px: float) -> np.ndarray:
        """One sigma of where drawn points appear in the picture, the larger of both axes, shape (n,) [px]."""
        p = points_in_camera
        z = np.maximum(p[:, 2], 1e-3)
        # d(pixel)/d(point), times d(point)/d(motion) = [-[p]x, I].
        zero = np.zeros(len(p))
        out = np.zeros(len(p))
        for gradient in (np.column_stack([1.0 / z, zero, -p[:, 0] / z**2]), np.column_stack([zero, 1.0 / z, -p[:, 1] / z**2])):
            row = np.concatenate([np.cross(p, gradient), gradient], axis=1) * focal_px
            out = np.maximum(out, np.einsum("ij,jk,ik->i", row, self.covariance, row))
        return np.sqrt(out)


def fit_drawing(depth: DepthImage, view: DrawnView, *, step: int, config: DrawingFitConfig) -> DrawingFit:
    """The motion of the drawn robot that fits the measured depth best.

    Args:
        depth: as matched, with the robot in it.
        view: the drawing at the believed pose, `step` times coarser than the depth image.
        step: pixels of the depth image per pixel of the drawing.
        config: prior and weights.
    """
    precision = np.diag([1.0 / config.angle**2] * 3 + [1.0 / config.position**2] * 3)
    motion, information, used = SE3.identity(), precision, 0
    drawn, surface, outline, outward = _evidence(depth, view, step, config)
    if not config.enabled or len(drawn) == 0:
        return DrawingFit(true_from_drawn=motion, covariance=np.linalg.inv(precision), points=0)
    for gate in config.gates:
        rows, residuals, weights = [], [], []
        for jacobian, residual, weight in (
            _surface_rows(depth, motion.apply(drawn), motion.rotate(surface), gate, config),
            _outline_rows(depth, motion.apply(outline), outward, gate / config.gates[0], step, config),
        ):
            rows.append(jacobian)
            residuals.append(residual)
            weights.append(weight)
        jacobian, residual, weight = np.concatenate(rows), np.concatenate(residuals), np.concatenate(weights)
        used = len(residual)
        information = precision + jacobian.T @ (jacobian * weight[:, None])
        so_far = np.concatenate([motion.rotvec(), motion.translation])
        move = np.linalg.solve(information, jacobian.T @ (weight * residual) - precision @ so_far)
        motion = SE3.from_rotvec(move[:3], move[3:]).compose(motion)
    return DrawingFit(true_from_drawn=motion, covariance=np.linalg.inv(information), points=used)


def _evidence(
    depth: DepthImage, view: DrawnView, step: int, config: DrawingFitConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Drawn points with their normals, and drawn outline points with their outward directions, in the camera's frame."""
    rows, columns = np.nonzero(view.drawn)
    keep = np.unique(np.linspace(0, max(len(rows) - 1, 0), min(config.points, len(rows))).astype(np.int64))
    rows, columns = rows[keep], columns[keep]
    outline = drawn_outline(view, limit=config.outline_points)
    at = outline.pixels.astype(np.int64)

    def lifted(rows: np.ndarray, columns: np.ndarray, out: np.ndarray | float) -> np.ndarray:
        z = view.depth[rows, columns]
        eye, shift = depth.eye, np.atleast_2d(out)
        u, v = (columns + 0.5 + shift[:, 0]) * step - 0.5, (rows + 0.5 + shift[:, -1]) * step - 0.5
        return np.column_stack([(u - eye.cx_px) / eye.focal_px * z, (v - eye.cy_px) / eye.focal_px * z, z])

    # The outline runs half a coarse pixel outside the centres of the outermost drawn pixels.
    return lifted(rows, columns, 0.0), view.normals[keep], lifted(at[:, 1], at[:, 0], 0.5 * outline.outward), outline.outward


Rows = tuple[np.ndarray, np.ndarray, np.ndarray]
"""jacobian (n, 6), residual (n,), weight (n,)"""


def _surface_rows(depth: DepthImage, moved: np.ndarray, normals: np.ndarray, gate: float, config: DrawingFitConfig) -> Rows:
    """Point-to-plane residuals [m] of the drawn surface against the measured depth along each ray."""
    eye = depth.eye
    height, width = depth.depth.shape
    pixel, ahead = eye.project(moved)
    column, row = np.rint(pixel[:, 0]).astype(np.int64), np.rint(pixel[:, 1]).astype(np.int64)
    seen = (ahead > 0.05) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    p, n, column, row = moved[seen], normals[seen], column[seen], row[seen]
    measured = depth.depth[row, column]
    ray = np.column_stack([(column - eye.cx_px) / eye.focal_px, (row - eye.cy_px) / eye.focal_px, np.ones(len(p))])
    residual = np.einsum("ij,ij->i", n, ray * measured[:, None] - p)
    # Surfaces seen at a flat angle change depth by much from pixel to pixel.
    cosine = -np.einsum("ij,ij->i", n, ray) / np.linalg.norm(ray, axis=1)
    with np.errstate(invalid="ignore"):
        near = (np.abs(residual) < gate) & (np.abs(measured - p[:, 2]) < 2.0 * gate) & (cosine > 0.2)
    r, n, p = residual[near], n[near], p[near]
    weight = (1.0 - (r / gate) ** 2) ** 2 / (config.noise**2 * config.correlation)
    return np.concatenate([np.cross(p, n), n], axis=1), r, weight


def _outline_rows(
    depth: DepthImage, moved: np.ndarray, outward: np.ndarray, share: float, step: int, config: DrawingFitConfig
) -> Rows:
    """Residuals [px] of the drawn outline against where depth leaves the leg; the search narrows to `share` of its reach."""
    empty = np.zeros((0, 6)), np.zeros(0), np.zeros(0)
    if len(moved) == 0:
        return empty
    pixel, z = depth.eye.project(moved)
    stride = max(step / 2.0, 1.0)
    farthest = depth.eye.focal_px * (config.position / float(np.median(z)) + config.angle)
    reach = max(int(np.ceil(1.2 * share * farthest / stride)), 3)
    offset = search(depth.depth, pixel, outward, z, reach=reach, stride=stride) - config.fattening_px
    told = np.isfinite(offset)
    if not told.any():
        return empty
    r, p, d = offset[told], moved[told], outward[told]
    gate = (reach + 1) * stride + config.fattening_px
    weight = (1.0 - np.minimum(r / gate, 1.0) ** 2) ** 2 / ((config.outline_noise_px * stride) ** 2 * config.correlation)
    # d(pixel along outward)/d(point), then d(point)/d(motion) = [-[p]x, I].
    f, zz = depth.eye.focal_px, p[:, 2]
    gradient = np.column_stack([d[:, 0] / zz, d[:, 1] / zz, -(d[:, 0] * p[:, 0] + d[:, 1] * p[:, 1]) / zz**2]) * f
    return np.concatenate([np.cross(p, gradient), gradient], axis=1), r, weight
