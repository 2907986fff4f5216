"""Where the chassis is: from the planted wheels and the inertial attitude, then corrected by aligning depth to the map.

Model: a planted wheel stays where it was put, so the axles' believed places in hex (joints, sag) and their anchors in
the world give the pose by a weighted rigid fit; roll and pitch are measured by the inertial unit and enter as two
more residuals. What drifts that way (slip, sag errors) shows as a misfit between new depth and the fused map: a
robust Gauss-Newton on the height differences finds the small motion that removes it. A motion that the ground's shape
does not show (sideways on a plane) stays where the prior puts it, at zero, and a correction is only accepted when
enough cells overlap, the fit is good and the motion is small: alignment may fail to help but must not harm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from athlete_twin.errors import ConfigError, SupportError
from athlete_twin.geometry.arrays import PerLeg, PerLegFlag, Points3, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from planner.terrain.elevation import ElevationConfig, GridLayout, measure_cells
from planner.terrain.fusion import FusedTerrain


@dataclass(frozen=True, kw_only=True)
class WheelFitConfig:
    """How far wheels and inertial unit are trusted against each other."""

    anchor_sigma: float = 0.015
    """of a planted wheel's place: sag, encoder zeros, slip [m]"""
    attitude_sigma: float = 0.004
    """of measured roll and pitch [rad]"""
    outlier_sigma: float = 2.5
    """a wheel that misses its anchor by more counts less (Huber): it slipped"""
    iterations: int = 8
    sink: float = 0.015
    """by which the wheels stand deeper than the tyres' belief says, before pictures tell more: soil, and a deck that
    bends; a robot's drawings say its own (`RobotSpec.believed_sink`), of walks on loose soil. On hard ground it is about
    none for SDM-B [m]"""
    sink_sigma: float = 0.03
    """of it, from ground to ground and robot to robot: nobody knows the soil before the wheels stand on it [m]"""

    def __post_init__(self) -> None:
        for name in ("anchor_sigma", "attitude_sigma", "outlier_sigma", "sink_sigma"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be positive")


@dataclass(frozen=True, eq=False, kw_only=True)
class WheelFit:
    """The pose that wheels and attitude agree on."""

    world_from_hex: SE3
    misfit: Wheels
    """anchor minus axle in the world at this pose, NaN for wheels that are not planted [m]"""
    rmse: float
    """of the planted wheels' misfit [m]"""


@dataclass(frozen=True, kw_only=True)
class AlignConfig:
    """How depth is aligned to the map, and when the result is believed."""

    iterations: int = 12
    sigma_xy: float = 0.03
    """how far off the pose is expected to be, one sigma [m]"""
    sigma_z: float = 0.02
    """[m]"""
    sigma_tilt: float = 0.004
    """roll and pitch [rad]"""
    sigma_yaw: float = 0.01
    """[rad]"""
    correlated_cells: float = 9.0
    """neighbouring cells err together: this many carry the information of one"""
    max_cells: int = 12000
    """that the fit runs over; more cost time only"""
    mixed_allowance: float = 1.0
    """more scatter than the map's statistics expect, since the points may come from several cameras [sigma]"""
    min_overlap_cells: int = 300
    """cells seen now and known before"""
    min_inlier_fraction: float = 0.6
    """of the overlapping cells, within `inlier_limit` after the fit"""
    inlier_limit: float = 0.05
    """[m]"""
    max_rmse: float = 0.03
    """of the inliers [m]"""
    max_shift: float = 0.15
    """length of the correction at the middle of the points: a larger one is a false fit [m]"""
    max_angle: float = 0.035
    """[rad]"""
    least_relief: float = 0.010
    """of the ground about a plane (1.48 times the median), so that its shape shows place and yaw; on smoother ground what repeats from
    view to view are the cameras' own errors, some millimetres that go along with the robot, and would hold it where it was. EST: twice
    the map's error [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Alignment:
    """What aligning one view to the map gave."""

    correction: SE3
    """`world_from_believed`: compose it before the believed pose; the identity when not accepted"""
    rmse: float
    """of the inliers' height differences after the fit, NaN without overlap [m]"""
    rmse_before: float
    """of the same cells before the fit [m]"""
    inliers: int
    """cells"""
    overlap: int
    """cells seen now and known before"""
    accepted: bool
    reason: str
    """why it was not accepted; empty when it was"""
    middle: Vec3
    """of the points, about which turn and shift are given, in world [m]"""
    information: np.ndarray
    """of turn (3) and shift (3) of the correction, from the cells alone, shape (6, 6): directions that the ground's shape
    does not show hold nearly none"""


def pose_from_wheels(
    wheels_in_hex: Wheels,
    anchors_in_world: Wheels,
    *,
    planted: PerLegFlag,
    attitude_rpy: Vec3,
    weights: PerLeg | None = None,
    config: WheelFitConfig | None = None,
) -> SE3:
    """`world_from_hex` that puts the planted axles on their anchors with the measured roll and pitch."""
    return fit_wheels(
        wheels_in_hex, anchors_in_world, planted=planted, attitude_rpy=attitude_rpy, weights=weights, config=config
    ).world_from_hex


def fit_wheels(
    wheels_in_hex: Wheels,
    anchors_in_world: Wheels,
    *,
    planted: PerLegFlag,
    attitude_rpy: Vec3,
    weights: PerLeg | None = None,
    config: WheelFitConfig | None = None,
) -> WheelFit:
    """The pose of `pose_from_wheels`, with what each wheel misses its anchor by.

    Args:
        wheels_in_hex: believed axle centres, shape (6, 3) [m].
        anchors_in_world: where each axle was planted, shape (6, 3); rows of wheels in the air are ignored [m].
        planted: which wheels stand, shape (6,). At least three.
        attitude_rpy: measured roll, pitch, yaw; the yaw drifts and only starts the fit [rad].
        weights: relative trust in each wheel, shape (6,); such as its load.
        config: the sigmas.
    """
    config = WheelFitConfig() if config is None else config
    if int(planted.sum()) < 3:
        raise SupportError(f"{int(planted.sum())} planted wheels fix no pose, need at least 3")
    trust = np.ones(6) if weights is None else np.asarray(weights, dtype=float)
    wheels, anchors, trust = wheels_in_hex[planted], anchors_in_world[planted], trust[planted]
    trust = trust / trust.mean()
    rotation = _kabsch(wheels, anchors, trust)
    measured_up = Rotation.from_euler("xyz", attitude_rpy).as_matrix()[2]
    translation = np.average(anchors - wheels @ rotation.T, axis=0, weights=trust)
    centre = np.average(anchors, axis=0, weights=trust)
    for _ in range(config.iterations):
        at = wheels @ rotation.T + translation
        miss = anchors - at
        length = np.linalg.norm(miss, axis=1) / config.anchor_sigma
        robust = trust * np.minimum(1.0, config.outlier_sigma / np.maximum(length, 1e-12)) / config.anchor_sigma**2
        hessian, gradient = np.zeros((6, 6)), np.zeros(6)
        for p, r, w in zip(at - centre, miss, robust, strict=True):
            jacobian = np.hstack([-_skew(p), np.eye(3)])
            hessian += w * jacobian.T @ jacobian
            gradient += w * jacobian.T @ r
        # World up seen in hex, rotated back, must be world up: its x and y are the errors of the two tilts.
        up_in_world = rotation @ measured_up
        tilt = np.array([[0.0, up_in_world[2], 0.0, 0.0, 0.0, 0.0], [-up_in_world[2], 0.0, 0.0, 0.0, 0.0, 0.0]])
        hessian += tilt.T @ tilt / config.attitude_sigma**2
        gradient += tilt.T @ (-up_in_world[:2]) / config.attitude_sigma**2
        # Tiny damping: three wheels in a row leave one direction to the attitude alone.
        step = np.linalg.solve(hessian + 1e-9 * np.trace(hessian) * np.eye(6), gradient)
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        rotation = turn @ rotation
        translation = turn @ (translation - centre) + centre + step[3:]
    misfit = np.full((6, 3), np.nan)
    misfit[planted] = anchors - (wheels @ rotation.T + translation)
    rmse = float(np.sqrt(np.mean(np.sum(misfit[planted] ** 2, axis=1))))
    u, _, vt = np.linalg.svd(rotation)
    return WheelFit(world_from_hex=SE3(u @ vt, translation), misfit=misfit, rmse=rmse)


def align_to_map(
    points_in_world: Points3,
    terrain: FusedTerrain,
    *,
    sigma_z: np.ndarray | None = None,
    config: AlignConfig | None = None,
    elevation: ElevationConfig | None = None,
) -> Alignment:
    """The small motion of the view that makes it agree with the map.

    The points are first reduced to cells by the statistics the map was made with: both sides then have the same bias at
    rocks' edges, and what is compared is not the noise.

    Args:
        points_in_world: terrain points of the new view at the believed pose, shape (n, 3) [m].
        terrain: the map before this view was fused.
        sigma_z: one sigma of each point's height, shape (n,) [m]; 1 cm when not given.
        config: prior and gates.
        elevation: statistics of the map's cells.
    """
    config = AlignConfig() if config is None else config
    places, variance = overlapping_cells(points_in_world, terrain, sigma_z=sigma_z, config=config, elevation=elevation)
    if len(places) < config.min_overlap_cells:
        return refused_alignment(f"overlap of {len(places)} cells, need {config.min_overlap_cells}", overlap=len(places))
    # Neighbours say nearly the same: every k-th cell carries as much, less what correlation it had.
    stride = int(np.ceil(len(places) / config.max_cells))
    thinned = replace(config, correlated_cells=max(config.correlated_cells / stride, 1.0))
    rotation, shift, centre, information = _fit_to_grid(places[::stride], variance[::stride], terrain, thinned)
    return judged(places, terrain, rotation, shift, centre, information=information, config=config)


def overlapping_cells(
    points_in_world: Points3,
    terrain: FusedTerrain,
    *,
    sigma_z: np.ndarray | None,
    config: AlignConfig,
    elevation: ElevationConfig | None = None,
) -> tuple[Points3, np.ndarray]:
    """Cells of a view on ground that the map knows: points (n, 3) [m] and variances of their misfit (n,) [m2]."""
    grid = terrain.grid
    nx, ny = grid.shape
    layout = GridLayout(origin_x=grid.origin_x, origin_y=grid.origin_y, cell=grid.cell, nx=nx, ny=ny)
    statistics = ElevationConfig() if elevation is None else elevation
    # Cameras that err by a centimetre against each other make a flat cell look steep when their points are mixed, and
    # the map, made camera by camera, has no such excess: without the wider allowance the pose would sink with each view.
    statistics = replace(statistics, noise_allowance=statistics.noise_allowance + config.mixed_allowance)
    sigma = np.full(len(points_in_world), 0.01) if sigma_z is None else sigma_z
    cells = measure_cells(points_in_world, sigma, layout=layout, config=statistics)
    places = np.column_stack([cells.centroid, cells.height])
    known = np.isfinite(grid.sample(cells.centroid))
    places, variance = places[known], cells.variance[known] + terrain.variance.ravel()[cells.index[known]]
    return places, variance


def judged(
    places: Points3,
    terrain: FusedTerrain,
    rotation: np.ndarray,
    shift: Vec3,
    centre: Vec3,
    *,
    information: np.ndarray,
    config: AlignConfig,
) -> Alignment:
    """An alignment with the gates' verdict: shared by every way to find the motion.

    Args:
        places: cells of the view before the motion, on known ground, shape (n, 3) [m].
        terrain: the map.
        rotation: of the motion, about `centre`.
        shift: of the centre [m].
        centre: in world [m].
        information: of turn and shift, shape (6, 6).
        config: the gates.
    """
    grid = terrain.grid
    before = places[:, 2] - grid.sample(places[:, :2])
    moved = (places - centre) @ rotation.T + centre + shift
    after = moved[:, 2] - grid.sample(moved[:, :2])
    inlier = np.abs(after) <= config.inlier_limit
    inliers = int(inlier.sum())
    rmse = float(np.sqrt(np.mean(after[inlier] ** 2))) if inliers else float("inf")
    rmse_before = float(np.sqrt(np.mean(before[inlier] ** 2))) if inliers else float("inf")
    angle = float(np.linalg.norm(Rotation.from_matrix(rotation).as_rotvec()))
    length = float(np.linalg.norm(shift))
    reason = ""
    if inliers < config.min_inlier_fraction * len(places):
        need = f"need {config.min_inlier_fraction:.0%}"
        reason = f"{inliers} of {len(places)} cells fit within {config.inlier_limit} m, {need}"
    elif rmse > config.max_rmse:
        reason = f"rmse {rmse:.3f} m over the limit of {config.max_rmse} m"
    elif length > config.max_shift or angle > config.max_angle:
        reason = f"correction of {length:.3f} m, {angle:.4f} rad over {config.max_shift} m, {config.max_angle} rad"
    elif np.median(np.abs(after)) > np.median(np.abs(before)):
        reason = f"median misfit grew from {np.median(np.abs(before)):.4f} m to {np.median(np.abs(after)):.4f} m"
    if _relief(places) < config.least_relief:
        tilt = Rotation.from_matrix(rotation).as_rotvec() * [1.0, 1.0, 0.0]
        rotation, shift = Rotation.from_rotvec(tilt).as_matrix(), shift * [0.0, 0.0, 1.0]
        shown = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
        information = information * np.outer(shown, shown)
    correction = SE3.identity() if reason else SE3(rotation, centre + shift - rotation @ centre)
    return Alignment(
        correction=correction,
        rmse=rmse,
        rmse_before=rmse_before,
        inliers=inliers,
        overlap=len(places),
        accepted=not reason,
        reason=reason,
        middle=centre,
        information=information,
    )


def _relief(places: Points3) -> float:
    """How far ground lies from its plane, robustly: a few stones on a smooth yard leave it smooth [m]."""
    design = np.column_stack([places[:, :2], np.ones(len(places))])
    plane = np.linalg.lstsq(design, places[:, 2], rcond=None)[0]
    return 1.4826 * float(np.median(np.abs(places[:, 2] - design @ plane)))


def _fit_to_grid(
    places: np.ndarray, variance: np.ndarray, terrain: FusedTerrain, config: AlignConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Gauss-Newton with Tukey weights: rotation and shift about the places' middle, and the cells' information of them."""
    centre = places.mean(axis=0)
    rotation, shift = np.eye(3), np.zeros(3)
    slope_x, slope_y = _slopes(terrain)
    turns = [config.sigma_tilt, config.sigma_tilt, config.sigma_yaw]
    sigmas = np.array([*turns, config.sigma_xy, config.sigma_xy, config.sigma_z])
    prior = np.diag(1.0 / sigmas**2)
    seen = np.zeros((6, 6))
    for iteration in range(config.iterations):
        moved = (places - centre) @ rotation.T + centre + shift
        ix, iy, inside = terrain.grid.index(moved[:, :2])
        residual = moved[:, 2] - terrain.grid.sample(moved[:, :2])
        gx, gy = slope_x[ix, iy], slope_y[ix, iy]
        use = inside & np.isfinite(residual) & np.isfinite(gx) & np.isfinite(gy)
        gx, gy = np.where(use, gx, 0.0), np.where(use, gy, 0.0)
        # Residuals along the surface normal: on a steep flank a height difference is mostly a shift.
        normal = 1.0 / np.sqrt(1.0 + gx**2 + gy**2)
        scale = np.sqrt(variance * normal**2)
        # The first rounds forgive more, so that a shift of several centimetres is not all outlier.
        width = max(6.0 - iteration, 3.0)
        ratio = np.where(use, residual * normal, 0.0) / (width * np.maximum(scale, 0.01))
        weight = np.where(use & (np.abs(ratio) < 1.0), (1.0 - ratio**2) ** 2, 0.0)
        weight /= np.maximum(scale, 0.005) ** 2 * config.correlated_cells
        arm = moved - centre - shift
        direction = np.column_stack([-gx, -gy, np.ones_like(gx)]) * normal[:, None]
        jacobian = np.hstack([np.cross(arm, direction), direction])
        value = np.where(use, residual * normal, 0.0)
        now = np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), shift])
        seen = jacobian.T @ (jacobian * weight[:, None])
        step = np.linalg.solve(seen + prior, -(jacobian.T @ (weight * value)) - prior @ now)
        rotation = Rotation.from_rotvec(step[:3]).as_matrix() @ rotation
        shift = shift + step[3:]
        if np.abs(step).max() < 1e-6:
            break
    return rotation, shift, centre, seen


def _slopes(terrain: FusedTerrain) -> tuple[np.ndarray, np.ndarray]:
    """dz/dx and dz/dy of the map by central differences, NaN beside unknown cells."""
    gx, gy = np.gradient(terrain.grid.heights, terrain.grid.cell)
    return np.asarray(gx), np.asarray(gy)


def refused_alignment(reason: str, *, overlap: int) -> Alignment:
    """No correction, and why."""
    return Alignment(
        correction=SE3.identity(),
        rmse=float("nan"),
        rmse_before=float("nan"),
        inliers=0,
        overlap=overlap,
        accepted=False,
        reason=reason,
        middle=np.zeros(3),
        information=np.zeros((6, 6)),
    )


def _kabsch(points: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rotation that best takes weighted points onto targets about their centroids."""
    p = points - np.average(points, axis=0, weights=weights)
    q = targets - np.average(targets, axis=0, weights=weights)
    u, _, vt = np.linalg.svd((p * weights[:, None]).T @ q)
    handed = np.sign(np.linalg.det(vt.T @ u.T))
    return np.asarray(vt.T @ np.diag([1.0, 1.0, handed]) @ u.T)


def _skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
