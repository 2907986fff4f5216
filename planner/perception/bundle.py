"""Overlapping pictures of one instant -> small corrections of the cameras' poses that make them agree.

Cameras are mounted 5 mm and 0.2 deg off their drawings, constant for a trial: at 4 m that is 1.4 cm of height, the largest
part of the map's error once the chassis is known. Views of the same ground show it: a cell's height seen by two
cameras differs by what both their errors do to it, r = n . (dp_a - dp_b) + n_z (z_a - z_b), dp = turn x arm + shift.
All cells that two views share are residuals, linear in the corrections, solved as one sparse robust least-squares problem
(scipy, trf with lsmr). The mountings' own scatter is the prior; it fixes the gauge (all views moving together is no
correction) and holds views without overlap at zero: SDM-B's hardly overlap ([SunSpiral2012] s4.2), and stay.

What one set says is kept as information for the next (`MountCalibration`): the errors are constant in the camera's frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Points3
from athlete_twin.geometry.se3 import SE3
from planner.terrain.elevation import CellHeights, ElevationConfig, GridLayout, measure_cells

REFINEMENTS = ("mountings", "none")
MAX_SLOPE = 1.0
"""steeper cells tell of edges, not of planes"""


@dataclass(frozen=True, kw_only=True)
class BundleConfig:
    """How far mountings are off, and which overlaps count."""

    refine: str = "mountings"
    """"mountings", or "none": cameras are where the drawings say"""
    mount_shift: float = 0.005
    """one sigma along each axis: the truth's own scatter of camera poses, which the drawings state [m]"""
    mount_turn_deg: float = 0.2
    """about each axis [deg]"""
    cell: float = 0.05
    """[m]"""
    reach: float = 7.0
    """cells so far from the views' middle are compared [m]"""
    min_overlap_cells: int = 80
    """pairs of views that share fewer say nothing"""
    correlated_cells: float = 40.0
    """neighbouring cells err together, and two looks of one rock's flank err alike: so many carry one's information"""
    max_difference: float = 0.12
    """cells that differ by more show different things: a leg, a shadow [m]"""
    soft: float = 2.0
    """residuals beyond so many sigma count less (soft L1)"""
    memory: float = 0.8
    """share of what was learned that is kept at the next set: pictures of the same ground are not new evidence"""

    def __post_init__(self) -> None:
        if self.refine not in REFINEMENTS:
            raise ConfigError(f"refine {self.refine!r} is not one of {', '.join(REFINEMENTS)}")
        if not (self.mount_shift > 0.0 and self.mount_turn_deg > 0.0):
            raise ConfigError(f"mount_shift and mount_turn_deg are {self.mount_shift} and {self.mount_turn_deg}, must be positive")
        if not 0.0 <= self.memory <= 1.0:
            raise ConfigError(f"memory is {self.memory}, must be within 0 to 1")


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """The points of one picture at its believed pose."""

    camera: str
    world_from_camera: SE3
    points_in_world: Points3
    """[m]"""
    sigma_z: np.ndarray
    """one sigma of each point's height [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Refinement:
    """What one set of views gave."""

    corrections: dict[str, SE3]
    """`drawn_camera_from_true_camera` of each view's camera"""
    cells: int
    """shared cells"""
    rms_before: float
    """of the shared cells' differences along their normals, NaN without any [m]"""
    rms_after: float
    """[m]"""


class MountCalibration:
    """What is known of the cameras' mountings; grows with every set of overlapping views."""

    def __init__(self, cameras: tuple[str, ...], *, config: BundleConfig) -> None:
        self._names, self._config = cameras, config
        sigma = np.array([np.deg2rad(config.mount_turn_deg)] * 3 + [config.mount_shift] * 3)
        self._prior = np.diag(np.tile(1.0 / sigma**2, len(cameras)))
        self._learned = np.zeros_like(self._prior)
        self._weighted = np.zeros(6 * len(cameras))
        self._mean = np.zeros(6 * len(cameras))

    def correction(self, camera: str) -> SE3:
        """`drawn_camera_from_true_camera` as now believed; the identity for a camera that was never compared."""
        if camera not in self._names:
            return SE3.identity()
        at = 6 * self._names.index(camera)
        return SE3.from_rotvec(self._mean[at : at + 3], self._mean[at + 3 : at + 6])

    def refine(self, views: list[View]) -> Refinement:
        """Take in one set of views, whose poses hold the corrections believed so far."""
        known = [v for v in views if v.camera in self._names]
        rows, values, weights = _shared_cells(known, self._names, self._config)
        before = float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
        if len(values) == 0:
            return self._refinement(known, 0, before, before)
        # What is remembered, as a Gaussian; the views stand at the mean of the last set, which is not quite its middle.
        information = self._prior + self._config.memory * self._learned
        remembered = np.linalg.solve(information, self._config.memory * self._weighted)
        root = np.linalg.cholesky(information).T
        scaled = sparse.diags(np.sqrt(weights)) @ rows
        target = np.sqrt(weights) * values
        jacobian = sparse.vstack([scaled, sparse.csr_matrix(root)]).tocsr()
        fixed = root @ (self._mean - remembered)

        def residuals(step: np.ndarray) -> np.ndarray:
            return np.concatenate([_softened(scaled @ step + target, self._config.soft), root @ step + fixed])

        def slopes(step: np.ndarray) -> sparse.csr_matrix:
            down = _softening(scaled @ step + target, self._config.soft)
            return sparse.diags(np.concatenate([down, np.ones(root.shape[0])])) @ jacobian

        found = least_squares(residuals, np.zeros(len(self._mean)), jac=slopes, method="trf", tr_solver="lsmr", max_nfev=30)
        after = float(np.sqrt(np.mean((rows @ found.x + values) ** 2)))
        down = _softening(scaled @ found.x + target, self._config.soft)
        seen = (sparse.diags(down) @ scaled).toarray()
        self._learned = self._config.memory * self._learned + seen.T @ seen
        self._mean = self._mean + found.x
        self._weighted = (self._prior + self._learned) @ self._mean
        return self._refinement(known, len(values), before, after)

    def _refinement(self, views: list[View], cells: int, before: float, after: float) -> Refinement:
        return Refinement(
            corrections={v.camera: self.correction(v.camera) for v in views}, cells=cells, rms_before=before, rms_after=after
        )


def _shared_cells(
    views: list[View], names: tuple[str, ...], config: BundleConfig
) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray]:
    """Rows of the linear problem (m, 6 n), differences along the normals (m,) [m], and their weights (m,)."""
    wide = 6 * len(names)
    empty = sparse.csr_matrix((0, wide)), np.zeros(0), np.zeros(0)
    if len(views) < 2:
        return empty
    middle = np.mean([v.world_from_camera.translation for v in views], axis=0)
    layout = GridLayout.centred(
        float(middle[0]), float(middle[1]), size_x=2 * config.reach, size_y=2 * config.reach, cell=config.cell
    )
    statistics = ElevationConfig(upper_quantile=0.5)
    seen = [measure_cells(v.points_in_world, v.sigma_z, layout=layout, config=statistics) for v in views]
    blocks, values, weights = [], [], []
    for a in range(len(views)):
        for b in range(a + 1, len(views)):
            _, ia, ib = np.intersect1d(seen[a].index, seen[b].index, assume_unique=True, return_indices=True)
            pair = _compare(seen[a], seen[b], ia, ib, layout)
            places, normal, difference, variance = pair
            use = (np.abs(difference) <= config.max_difference) & np.isfinite(normal).all(axis=1)
            if use.sum() < config.min_overlap_cells:
                continue
            rows = np.zeros((int(use.sum()), wide))
            for view, sign in ((views[a], 1.0), (views[b], -1.0)):
                arm = places[use] - view.world_from_camera.translation
                at = 6 * names.index(view.camera)
                # Corrections live in the camera's frame, where they are constant.
                turn = np.cross(arm, normal[use]) @ view.world_from_camera.rotation
                shift = normal[use] @ view.world_from_camera.rotation
                rows[:, at : at + 6] += sign * np.hstack([turn, shift])
            blocks.append(sparse.csr_matrix(rows))
            values.append(difference[use])
            weights.append(1.0 / (variance[use] * config.correlated_cells))
    if not blocks:
        return empty
    return sparse.vstack(blocks).tocsr(), np.concatenate(values), np.concatenate(weights)


def _compare(
    first: CellHeights, second: CellHeights, ia: np.ndarray, ib: np.ndarray, layout: GridLayout
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Middles of shared cells, their normals, the difference along the normal [m] and its variance [m2].

    The slope comes from the mean of both views; it also takes out that their points lie elsewhere in the cell.
    """
    index = first.index[ia]
    heights = np.full(layout.nx * layout.ny, np.nan)
    heights[index] = 0.5 * (first.height[ia] + second.height[ib])
    gx, gy = np.gradient(heights.reshape(layout.nx, layout.ny), layout.cell)
    slope = np.column_stack([gx.ravel()[index], gy.ravel()[index]])
    slope[np.abs(slope).max(axis=1) > MAX_SLOPE] = np.nan
    length = np.sqrt(1.0 + np.sum(slope**2, axis=1))
    normal = np.column_stack([-slope, np.ones(len(slope))]) / length[:, None]
    offset = np.sum(slope * (first.centroid[ia] - second.centroid[ib]), axis=1)
    difference = (first.height[ia] - second.height[ib] - offset) / length
    middle = 0.5 * (first.centroid[ia] + second.centroid[ib])
    variance = (first.variance[ia] + second.variance[ib]) / length**2
    return np.column_stack([middle, heights[index]]), normal, difference, variance


def _softened(residual: np.ndarray, soft: float) -> np.ndarray:
    """Soft L1: like the residual when small, its square root's growth beyond `soft`."""
    ratio = (residual / soft) ** 2
    return np.asarray(np.sign(residual) * soft * np.sqrt(2.0 * (np.sqrt(1.0 + ratio) - 1.0)))


def _softening(residual: np.ndarray, soft: float) -> np.ndarray:
    """Derivative of `_softened`."""
    ratio = (residual / soft) ** 2
    root = np.sqrt(1.0 + ratio)
    inner = np.sqrt(np.maximum(2.0 * (root - 1.0), 1e-12))
    return np.where(ratio < 1e-5, 1.0, np.abs(residual) / (soft * inner * root))
