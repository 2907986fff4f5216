"""Tyres and hulls against the height field, as forces of our own: no constraint rows, so no solver, and sag of the right size.

A tyre is a cylinder sampled on its tread: angles about the axle, stations across the width. Where samples lie below
the ground the tyre is pressed in; the deepest one gives the deflection d along the ground's normal, the depth-weighted
mean gives the patch, and the force is F = k1 d + k2 d^2 plus a damper. Along the ground a bristle at the patch stretches
with the patch's velocity and slips at Coulomb's limit, so a robot at rest stays where it is; a rolling wheel leaves its
bristles behind within a patch's length, which is what makes it slip a little under load.

Soil gives in series with the tyre, pressure-sinkage P = k delta^n [Caillas1989] eq. 5, and stays down: a wheel that is
unloaded stands in its rut until it lifts, drags or rolls out of it. Rocks are hard. The patch of a tyre grows with its
load until its pressure is the tyre's own.

Cost: constant per wheel and tick, about 3 us a wheel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, no_type_check, runtime_checkable

import numba
import numpy as np

from athlete_twin.geometry.arrays import CellFlags, PerLeg, Wheels
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.model.spec import LEGS, WheelSpec
from athlete_twin.physics.truth import TrialTruth
from athlete_twin.world.terrain import Terrain

ANGLES = np.deg2rad(np.linspace(-84.0, 84.0, 15))
"""tread samples from straight below the axle; beyond them it is the hull's business"""
STATIONS = np.array([-0.42, 0.0, 0.42])
"""across the width, as fractions of it"""
FIRST_PATCH = 5e-3
"""area of a tyre's patch at its first touch [m2]; it grows by load over pressure"""
SINKAGE_STEP = 2e-3
"""of the sinkage tables [m]"""
SINKAGE_POINTS = 200
HULL_ANGLES = np.deg2rad(np.arange(-180.0, 180.0, 15.0))


@dataclass(frozen=True, kw_only=True)
class TyreForces:
    """What the ground does to the six wheels at one tick."""

    forces_in_world: Wheels
    """[N]"""
    patches_in_world: Wheels
    """where they act [m]"""
    deflections: PerLeg
    """along the ground's normal, 0 in the air [m]"""
    loads: PerLeg
    """normal forces [N]"""


@runtime_checkable
class Soil(Protocol):
    """A ground that gives, as `world.soil.SoilMaterial`."""

    def sinkage(self, pressure: np.ndarray | float) -> np.ndarray:
        """Depth at which it carries a pressure [Pa] [m]."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Footing:
    """What the wheels stand on, besides its shape."""

    friction: float
    """Coulomb's coefficient between the rocks"""
    rock_friction: float
    """and on them"""
    soil: Soil | None = None
    """between the rocks; None for ground that does not give"""
    is_rock: CellFlags | None = None
    """cells of hard rock, shape of the ground's grid; None for none"""

    @staticmethod
    def hard(friction: float) -> Footing:
        """Ground of one friction that does not give."""
        return Footing(friction=friction, rock_friction=friction)

    @staticmethod
    def of(terrain: Terrain) -> Footing:
        """The soil of a trial's ground between its rocks."""
        return Footing(
            friction=terrain.friction,
            rock_friction=terrain.rock_material.friction,
            soil=terrain.soil,
            is_rock=terrain.rock_index >= 0,
        )


class Tyres:
    """Six tyres on one ground. Holds bristles and ruts between ticks."""

    def __init__(
        self, wheel: WheelSpec, trial: TrialTruth, ground: HeightGrid, footing: Footing, *, sprung_mass: float
    ) -> None:
        truth = trial.truth
        self._pressure = wheel.pressure
        self._soil = footing.soil
        self._radius, self._width = wheel.radius, wheel.width
        self._k1 = truth.tyre_k1 * trial.tyre_scale
        self._k2 = truth.tyre_k2 * trial.tyre_scale
        self._kt = truth.tyre_lateral_stiffness * trial.tyre_scale
        share = sprung_mass / LEGS
        self._left = np.ones(LEGS)
        self._full = (self._k1.copy(), self._k2.copy(), self._kt.copy())
        self._c = 2.0 * truth.tyre_damping_ratio * np.sqrt(1.5 * self._k1 * share)
        self._ct = 2.0 * truth.tyre_damping_ratio * np.sqrt(self._kt * share)
        self._full_damping = (self._c.copy(), self._ct.copy())
        self._friction = np.array([footing.friction, footing.rock_friction])
        self._rock = np.zeros((1, 1), dtype=np.bool_) if footing.is_rock is None else np.ascontiguousarray(footing.is_rock)
        self._heights = np.ascontiguousarray(ground.heights, dtype=np.float64)
        self._slopes = np.stack(list(np.gradient(self._heights, ground.cell)), axis=-1)
        self._grid = np.array([ground.origin_x, ground.origin_y, ground.cell])
        self._bristles = np.zeros((LEGS, 3))
        self._ruts = np.zeros(LEGS)
        self._sinkage = np.zeros((LEGS, SINKAGE_POINTS))
        for leg in range(LEGS):
            self._tabulate(leg)

    @property
    def ruts(self) -> PerLeg:
        """How deep the soil under each wheel is pressed down [m]."""
        return self._ruts.copy()

    def lose_pressure(self, leg: int, left: float) -> None:
        """From now on one tyre has at most this part of the stiffness that it has when pumped up; air comes back never.

        Assumed: the air carries all, the rubber nothing, so that stiffness and contact pressure both go with the
        inflation; the damping ratio stays what it was, so that the dampers go with its root.
        """
        self._left[leg] = min(self._left[leg], left)
        for k, full in zip((self._k1, self._k2, self._kt), self._full, strict=True):
            k[leg] = self._left[leg] * full[leg]
        for c, full in zip((self._c, self._ct), self._full_damping, strict=True):
            c[leg] = np.sqrt(self._left[leg]) * full[leg]
        self._tabulate(leg)

    def _tabulate(self, leg: int) -> None:
        """Sinkage under one wheel over the sum of sinkage and deflection, at even steps of `SINKAGE_STEP`."""
        if self._soil is None:
            return
        deflection = np.linspace(0.0, SINKAGE_STEP * SINKAGE_POINTS, 4 * SINKAGE_POINTS)
        load = self._k1[leg] * deflection + self._k2[leg] * deflection**2
        sunk = self._soil.sinkage(load / (FIRST_PATCH + load / (self._left[leg] * self._pressure)))
        total = SINKAGE_STEP * np.arange(SINKAGE_POINTS)
        self._sinkage[leg] = np.interp(total, deflection + sunk, sunk)

    def step(self, axles: np.ndarray, axes: np.ndarray, velocities: np.ndarray, spins: np.ndarray, dt: float) -> TyreForces:
        """Forces on the wheels; advances the bristles by `dt` [s].

        Args:
            axles: axle centres in world, shape (6, 3) [m].
            axes: unit axle directions in world, shape (6, 3).
            velocities: of the axle centres in world, shape (6, 3) [m/s].
            spins: angular velocities in world, shape (6, 3) [rad/s].
            dt: the tick [s].
        """
        forces, patches, deflections, loads = _tyre_kernel(
            axles, axes, velocities, spins, self._radius, self._width, self._k1, self._k2, self._kt, self._c, self._ct,
            self._friction, self._rock, self._sinkage, self._heights, self._slopes, self._grid, self._bristles, self._ruts, dt,
            ANGLES, STATIONS,
        )  # fmt: skip
        return TyreForces(forces_in_world=forces, patches_in_world=patches, deflections=deflections, loads=loads)

    def state(self) -> dict[str, np.ndarray]:
        """Copies of all that changes from tick to tick, for `set_state`."""
        names = ("_bristles", "_ruts", "_left", "_k1", "_k2", "_kt", "_c", "_ct", "_sinkage")
        return {name: getattr(self, name).copy() for name in names}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Back to what `state` gave."""
        for name, value in state.items():
            setattr(self, name, value.copy())

    def hull_depths(self, axles: np.ndarray, axes: np.ndarray, *, standing: bool = False) -> tuple[PerLeg, Wheels]:
        """How deep each unloaded wheel's hull is inside the ground, along its normal [m], and where, (6, 3) [m].

        Of a wheel that is `standing`, the tread within 45 degrees of straight down is left out: what it stands on.
        """
        angles = HULL_ANGLES[np.abs(HULL_ANGLES) > np.deg2rad(46.0)] if standing else HULL_ANGLES
        depths, places = _hull_kernel(axles, axes, self._radius, self._width, self._heights, self._slopes, self._grid, angles)
        return depths, places


@no_type_check
@numba.njit(cache=True)
def _height_and_normal(x, y, heights, slopes, grid):  # type: ignore[no-untyped-def]
    """Both without jumps: the slopes are those at the nodes, interpolated, so that no tyre jitters on an edge."""
    nx, ny = heights.shape
    u = min(max((x - grid[0]) / grid[2], 0.0), nx - 1.000001)
    v = min(max((y - grid[1]) / grid[2], 0.0), ny - 1.000001)
    i, j = int(u), int(v)
    a, b = u - i, v - j
    w00, w10, w01, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    h = w00 * heights[i, j] + w10 * heights[i + 1, j] + w01 * heights[i, j + 1] + w11 * heights[i + 1, j + 1]
    s00, s10, s01, s11 = slopes[i, j], slopes[i + 1, j], slopes[i, j + 1], slopes[i + 1, j + 1]
    gx = w00 * s00[0] + w10 * s10[0] + w01 * s01[0] + w11 * s11[0]
    gy = w00 * s00[1] + w10 * s10[1] + w01 * s01[1] + w11 * s11[1]
    n = 1.0 / np.sqrt(gx * gx + gy * gy + 1.0)
    return h, -gx * n, -gy * n, n


@no_type_check
@numba.njit(cache=True)
def _is_rock(x, y, rock, grid):  # type: ignore[no-untyped-def]
    i = int(np.rint((x - grid[0]) / grid[2]))
    j = int(np.rint((y - grid[1]) / grid[2]))
    return rock[min(max(i, 0), rock.shape[0] - 1), min(max(j, 0), rock.shape[1] - 1)]


@no_type_check
@numba.njit(cache=True)
def _frame(axis):  # type: ignore[no-untyped-def]
    """Unit vectors across the axle: `below`, the lowest direction of the rim, and `along` the ground."""
    dot = -axis[2]
    below = np.array([-dot * axis[0], -dot * axis[1], -1.0 - dot * axis[2]])
    norm = np.sqrt(np.sum(below * below))
    if norm < 1e-6:
        below = np.array([1.0, 0.0, 0.0])
    else:
        below /= norm
    along = np.cross(axis, below)
    return below, along


@no_type_check
@numba.njit(cache=True)
def _tyre_kernel(  # type: ignore[no-untyped-def]
    axles, axes, velocities, spins, radius, width, k1, k2, kt, c, ct, frictions, rock, sinkage, heights, slopes, grid, bristles,
    ruts, dt, angles, stations,
):  # fmt: skip
    n_wheels = axles.shape[0]
    forces = np.zeros((n_wheels, 3))
    patches = axles.copy()
    deflections = np.zeros(n_wheels)
    loads = np.zeros(n_wheels)
    cosines, sines = np.cos(angles), np.sin(angles)
    for w in range(n_wheels):
        below, along = _frame(axes[w])
        deepest, total, on_rock = 0.0, 0.0, 0.0
        patch = np.zeros(3)
        normal = np.zeros(3)
        for s in range(stations.shape[0]):
            for k in range(angles.shape[0]):
                ca, sa = cosines[k], sines[k]
                px = axles[w, 0] + stations[s] * width * axes[w, 0] + radius * (ca * below[0] + sa * along[0])
                py = axles[w, 1] + stations[s] * width * axes[w, 1] + radius * (ca * below[1] + sa * along[1])
                pz = axles[w, 2] + stations[s] * width * axes[w, 2] + radius * (ca * below[2] + sa * along[2])
                h, nx, ny, nz = _height_and_normal(px, py, heights, slopes, grid)
                depth = (h - pz) * nz
                if depth > 0.0:
                    deepest = max(deepest, depth)
                    total += depth
                    if rock.size > 1 and _is_rock(px, py, rock, grid):
                        on_rock += depth
                    patch[0] += depth * px  # not as arrays: each would be made on the heap
                    patch[1] += depth * py
                    patch[2] += depth * pz
                    normal[0] += depth * nx
                    normal[1] += depth * ny
                    normal[2] += depth * nz
        if total <= 0.0:
            bristles[w] = 0.0
            ruts[w] = 0.0
            continue
        patch /= total
        on_rock /= total
        mu = frictions[0] + (frictions[1] - frictions[0]) * on_rock
        normal /= np.sqrt(np.sum(normal * normal))
        arm = patch - axles[w]
        v = velocities[w] + np.cross(spins[w], arm)
        vn = np.sum(v * normal)
        vt = v - vn * normal
        # How fast the patch wanders over the ground: dragged, or rolled onto fresh ground.
        rolled = abs(np.sum(spins[w] * axes[w])) * radius
        wandered = rolled + np.sqrt(np.sum(vt * vt))
        length = 2.0 * np.sqrt(max(2.0 * radius * deepest - deepest * deepest, 1e-6))
        fresh = min(1.0, wandered * dt / length)
        at = min(deepest / SINKAGE_STEP, sinkage.shape[1] - 1.000001)
        k = int(at)
        sunk = (1.0 - on_rock) * (sinkage[w, k] + (at - k) * (sinkage[w, k + 1] - sinkage[w, k]))
        ruts[w] = max(sunk, ruts[w] + fresh * (sunk - ruts[w]))
        deepest -= ruts[w]
        if deepest <= 0.0:
            bristles[w] = 0.0
            continue
        # The damper fades in with the spring, so that touching the ground is not a knock.
        load = k1[w] * deepest + k2[w] * deepest * deepest - c[w] * vn * min(1.0, deepest / 0.01)
        load = max(load, 0.0)
        bristles[w] -= np.sum(bristles[w] * normal) * normal
        bristles[w] += vt * dt - min(1.0, rolled * dt / length) * bristles[w]
        tangential = -kt[w] * bristles[w] - ct[w] * vt * min(1.0, deepest / 0.01)
        size, limit = np.sqrt(np.sum(tangential * tangential)), mu * load
        if size > limit:
            scale = limit / size
            tangential *= scale
            stretch = np.sqrt(np.sum(bristles[w] * bristles[w]))
            if stretch * kt[w] > limit:
                bristles[w] *= limit / (stretch * kt[w])
        forces[w] = load * normal + tangential
        patches[w] = patch
        deflections[w] = deepest
        loads[w] = load
    return forces, patches, deflections, loads


@no_type_check
@numba.njit(cache=True)
def _hull_kernel(axles, axes, radius, width, heights, slopes, grid, angles):  # type: ignore[no-untyped-def]
    n_wheels = axles.shape[0]
    depths = np.zeros(n_wheels)
    places = axles.copy()
    for w in range(n_wheels):
        below, along = _frame(axes[w])
        for s in range(-2, 3):
            side = 0.25 * s * width
            for k in range(angles.shape[0]):
                # On the two faces the hull is sampled at half radius as well: a rock may enter below the rim.
                for ring in range(2 if abs(s) == 2 else 1):
                    r = radius * (1.0 - 0.5 * ring)
                    ca, sa = np.cos(angles[k]), np.sin(angles[k])
                    p = axles[w] + side * axes[w] + r * (ca * below + sa * along)
                    h, _, _, nz = _height_and_normal(p[0], p[1], heights, slopes, grid)
                    depth = (h - p[2]) * nz
                    if depth > depths[w]:
                        depths[w] = depth
                        places[w] = p
    return depths, places
