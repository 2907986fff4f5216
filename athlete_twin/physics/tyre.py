"""Tyres and hulls against the height field, as forces of our own: no constraint rows, so no solver, and sag of the right size.

A tyre is a cylinder sampled on its tread: angles about the axle, stations across the width. Where samples lie below
the ground the tyre is pressed in; the deepest one gives the deflection d along the ground's normal, the depth-weighted
mean gives the patch, and the force is F = k1 d + k2 d^2 plus a damper. Along the ground a bristle at the patch stretches
with the patch's velocity and slips at Coulomb's limit, so a robot at rest stays where it is.

Cost: constant per wheel and tick, about 3 us a wheel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np

from athlete_twin.geometry.arrays import PerLeg, Wheels
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.model.spec import LEGS, WheelSpec
from athlete_twin.physics.truth import TrialTruth

ANGLES = np.deg2rad(np.linspace(-84.0, 84.0, 15))
"""tread samples from straight below the axle; beyond them it is the hull's business"""
STATIONS = np.array([-0.42, 0.0, 0.42])
"""across the width, as fractions of it"""
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


class Tyres:
    """Six tyres on one ground. Holds the bristles' state between ticks."""

    def __init__(self, wheel: WheelSpec, trial: TrialTruth, ground: HeightGrid, *, friction: float, sprung_mass: float) -> None:
        truth = trial.truth
        self._radius, self._width = wheel.radius, wheel.width
        self._k1 = truth.tyre_k1 * trial.tyre_scale
        self._k2 = truth.tyre_k2 * trial.tyre_scale
        self._kt = truth.tyre_lateral_stiffness * trial.tyre_scale
        share = sprung_mass / LEGS
        self._c = 2.0 * truth.tyre_damping_ratio * np.sqrt(1.5 * self._k1 * share)
        self._ct = 2.0 * truth.tyre_damping_ratio * np.sqrt(self._kt * share)
        self._friction = friction
        self._heights = np.ascontiguousarray(ground.heights, dtype=np.float64)
        self._grid = np.array([ground.origin_x, ground.origin_y, ground.cell])
        self._bristles = np.zeros((LEGS, 3))

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
            self._friction, self._heights, self._grid, self._bristles, dt, ANGLES, STATIONS,
        )  # fmt: skip
        return TyreForces(forces_in_world=forces, patches_in_world=patches, deflections=deflections, loads=loads)

    def state(self) -> dict[str, np.ndarray]:
        """Copies of all that changes from tick to tick, for `set_state`."""
        return {
            "bristles": self._bristles.copy(),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Back to what `state` gave."""
        self._bristles = state["bristles"].copy()

    def hull_depths(self, axles: np.ndarray, axes: np.ndarray) -> tuple[PerLeg, Wheels]:
        """How deep each unloaded wheel's hull is inside the ground, along its normal [m], and where, (6, 3) [m]."""
        depths, places = _hull_kernel(axles, axes, self._radius, self._width, self._heights, self._grid, HULL_ANGLES)
        return depths, places


@no_type_check
@numba.njit(cache=True)
def _height_and_normal(x, y, heights, grid):  # type: ignore[no-untyped-def]
    nx, ny = heights.shape
    u = min(max((x - grid[0]) / grid[2], 0.0), nx - 1.000001)
    v = min(max((y - grid[1]) / grid[2], 0.0), ny - 1.000001)
    i, j = int(u), int(v)
    a, b = u - i, v - j
    h00, h10, h01, h11 = heights[i, j], heights[i + 1, j], heights[i, j + 1], heights[i + 1, j + 1]
    h = (h00 * (1 - a) + h10 * a) * (1 - b) + (h01 * (1 - a) + h11 * a) * b
    gx = ((h10 - h00) * (1 - b) + (h11 - h01) * b) / grid[2]
    gy = ((h01 - h00) * (1 - a) + (h11 - h10) * a) / grid[2]
    n = 1.0 / np.sqrt(gx * gx + gy * gy + 1.0)
    return h, -gx * n, -gy * n, n


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
    axles, axes, velocities, spins, radius, width, k1, k2, kt, c, ct, mu, heights, grid, bristles, dt, angles, stations
):
    n_wheels = axles.shape[0]
    forces = np.zeros((n_wheels, 3))
    patches = axles.copy()
    deflections = np.zeros(n_wheels)
    loads = np.zeros(n_wheels)
    for w in range(n_wheels):
        below, along = _frame(axes[w])
        deepest, total = 0.0, 0.0
        patch = np.zeros(3)
        normal = np.zeros(3)
        for s in range(stations.shape[0]):
            for k in range(angles.shape[0]):
                ca, sa = np.cos(angles[k]), np.sin(angles[k])
                px = axles[w, 0] + stations[s] * width * axes[w, 0] + radius * (ca * below[0] + sa * along[0])
                py = axles[w, 1] + stations[s] * width * axes[w, 1] + radius * (ca * below[1] + sa * along[1])
                pz = axles[w, 2] + stations[s] * width * axes[w, 2] + radius * (ca * below[2] + sa * along[2])
                h, nx, ny, nz = _height_and_normal(px, py, heights, grid)
                depth = (h - pz) * nz
                if depth > 0.0:
                    deepest = max(deepest, depth)
                    total += depth
                    patch += depth * np.array([px, py, pz])
                    normal += depth * np.array([nx, ny, nz])
        if total <= 0.0:
            bristles[w] = 0.0
            continue
        patch /= total
        normal /= np.sqrt(np.sum(normal * normal))
        arm = patch - axles[w]
        v = velocities[w] + np.cross(spins[w], arm)
        vn = np.sum(v * normal)
        # The damper fades in with the spring, so that touching the ground is not a knock.
        load = k1[w] * deepest + k2[w] * deepest * deepest - c[w] * vn * min(1.0, deepest / 0.01)
        load = max(load, 0.0)
        bristles[w] -= np.sum(bristles[w] * normal) * normal
        vt = v - vn * normal
        bristles[w] += vt * dt
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
def _hull_kernel(axles, axes, radius, width, heights, grid, angles):  # type: ignore[no-untyped-def]
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
                    h, _, _, nz = _height_and_normal(p[0], p[1], heights, grid)
                    depth = (h - p[2]) * nz
                    if depth > depths[w]:
                        depths[w] = depth
                        places[w] = p
    return depths, places
