"""Collision checks of the drawn robot against the believed terrain and itself, with a clearance for each pair of parts.

Place in the flow: fused terrain, joints and pose -> `LegCollision` (one leg moves, all else stands) for swing planning,
`BodyCollision` (all move) for body shifts. Shapes are the URDF's collision solids and the payload's boxes, checked by coal;
the terrain is a height field, solid below. One clearance holds against the terrain; between parts it grows with the
uncertainty of where they are, see `collision_parts`.

The terrain ends where its map ends: beyond it nothing collides.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from scipy.ndimage import maximum_filter

from athlete_twin.errors import PlanningError, TerrainError
from athlete_twin.geometry.arrays import Joints, LegJoints, Vec3
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.motion.collision_parts import ClearanceTable, CollisionConfig, Parts, link_name, robot_parts

__all__ = ["BodyCollision", "ClearanceTable", "CollisionConfig", "LegCollision", "terrain_shape"]

TERRAIN = "terrain"
OWN, OTHER_LEG = "own_leg_or_body", "other_leg"
FOUNDATION = 2.0
"""how far the terrain's solid reaches below its lowest point: a leg deep inside still collides [m]"""
STILL = 5e-4
"""by which parts that are too near already may come nearer: distances are computed to a tenth of it [m]"""


class LegCollision:
    """What one moving leg hits, the rest of the robot standing still. Holds scratch memory: one object a thread."""

    def __init__(
        self,
        spec: RobotSpec,
        heights: HeightGrid,
        world_from_hex: SE3,
        joints: Joints,
        leg: int,
        config: CollisionConfig,
    ) -> None:
        """Place everything but one leg.

        Args:
            spec: the drawings.
            heights: believed terrain, without NaN.
            world_from_hex: pose of the standing robot.
            joints: of all legs, shape (6, dof) [rad]; the moving leg's row does not matter.
            leg: index of the moving leg, 0 to 5.
            config: clearances.
        """
        self.spec, self.leg, self.config = spec, leg, config
        self.heights, self.world_from_hex = heights, world_from_hex
        parts = robot_parts(spec.name, config)
        self._model, geometry, moved = _with_one_leg(parts, joints, leg)
        self._scratch = self._model.createData()
        mine = self._pairs_that_may_meet(parts, geometry, np.array(moved))
        # Close ones first, always checked; then those with other legs, most of them far apart.
        mine.sort(key=lambda pair: parts.between_legs(*pair[:2]))
        for i, j, _ in mine:
            geometry.addCollisionPair(pin.CollisionPair(i, j))
        self._grounded = [i for i, moves in enumerate(moved) if moves and parts.order[i] > 0]
        field_of = _Ground(heights)
        field = geometry.addGeometryObject(field_of.object_in_hex(world_from_hex))
        for i in self._grounded:
            geometry.addCollisionPair(pin.CollisionPair(i, field))
        self._geometry, self._state = geometry, geometry.createData()
        for k, (_, _, margin) in enumerate(mine):
            self._state.collisionRequests[k].security_margin = margin
        self._self_pairs = range(len(mine))
        self._terrain_pairs = range(len(mine), len(mine) + len(self._grounded))
        self._is_wheel = [parts.order[i] == spec.dof for i in self._grounded]
        self._wheel_object = self._grounded[self._is_wheel.index(True)]
        radii = parts.radii[self._grounded]
        self._bounds = {c: field_of.bound(radii + c) for c in (config.terrain_clearance, config.near_ground_clearance)}
        self._cull_other_legs(parts, mine, moved)
        for k in (*self._other_leg_pairs, *self._terrain_pairs):
            self._state.deactivateCollisionPair(k)

    def _pairs_that_may_meet(self, parts: Parts, geometry: Any, moved: np.ndarray) -> list[tuple[int, int, float]]:
        """Those of the moving leg; of them with other legs, which any angles of it bring as near as their clearance."""
        first, second, clearances, leg = parts.first, parts.second, parts.clearances, np.array(parts.leg)
        mover, other = np.where(moved[first], first, second), np.where(moved[first], second, first)
        placed = np.array([solid.placement.translation for solid in geometry.geometryObjects])
        away = np.linalg.norm(placed[other] - self.spec.hips_in_hex[self.leg], axis=1)
        near = away < parts.reach[mover] + parts.radii[other] + clearances
        stands = (leg[other] >= 0) & (leg[other] != self.leg)
        chosen = np.flatnonzero((moved[first] | moved[second]) & (near | ~stands))
        return [parts.pairs[k] for k in chosen.tolist()]

    def _cull_other_legs(self, parts: Parts, mine: list[tuple[int, int, float]], moved: list[bool]) -> None:
        """Bounding spheres of the pairs with standing legs, for a quick look before the exact check."""
        q = np.zeros(self.spec.dof)
        self._place(q)
        far = [(k, i, j, margin) for k, (i, j, margin) in enumerate(mine) if parts.between_legs(i, j)]
        rows = {solid: row for row, solid in enumerate(i for i, moves in enumerate(moved) if moves)}
        self._moving = list(rows)
        self._ground_rows = np.array([rows[i] for i in self._grounded])
        self._other_leg_pairs = [k for k, *_ in far]
        self._mover = np.array([rows[i if moved[i] else j] for _, i, j, _ in far], dtype=int)
        standing = [j if moved[i] else i for _, i, j, _ in far]
        self._standing_in_hex = np.array([self._state.oMg[s].translation for s in standing]).reshape(-1, 3)
        self._reach2 = np.array([(parts.radii[i] + parts.radii[j] + margin) ** 2 for _, i, j, margin in far])

    def is_free(self, q: LegJoints) -> bool:
        """Whether the leg at angles q keeps every clearance."""
        return self.refusal(q) is None

    def refusal(self, q: LegJoints) -> str | None:
        """Which kind of check refuses angles q: "own_leg_or_body", "other_leg" or "terrain"; None where the leg is free."""
        return self._refusal(q, self.config.terrain_clearance, wheels_too=True)

    def is_free_near_ground(self, q: LegJoints) -> bool:
        """The same on the way straight from or to the ground: the wheel may touch, other parts keep a smaller distance."""
        return self._refusal(q, self.config.near_ground_clearance, wheels_too=False) is None

    def first_collision(self, q: LegJoints) -> str | None:
        """Names of a pair that is too close, such as "leg1_knee_roll against terrain"; None where all is free."""
        self._place(q)
        return self._self_hit() or self._terrain_hit(self._centres(), self.config.terrain_clearance, wheels_too=True)

    def first_collision_near_ground(self, q: LegJoints) -> str | None:
        """The same for `is_free_near_ground`."""
        self._place(q)
        clearance = self.config.near_ground_clearance
        return self._self_hit() or self._terrain_hit(self._centres(), clearance, wheels_too=False)

    def wheel_sink(self, q: LegJoints) -> float:
        """Deepest point of the drawn wheel's lower half in the terrain, along gravity [m]; negative above it."""
        self._place(q)
        placed = self._state.oMg[self._wheel_object]
        wheel = self.spec.wheel
        # The cylinder's own axis is z: rings across the width, the whole circle since the wheel may lean.
        angle, across = np.meshgrid(np.linspace(0, 2 * np.pi, 48, endpoint=False), np.linspace(-0.5, 0.5, 7))
        rim = np.stack([wheel.radius * np.cos(angle), wheel.radius * np.sin(angle), wheel.width * across], axis=-1)
        points = self.world_from_hex.apply(rim.reshape(-1, 3) @ placed.rotation.T + placed.translation)
        centre = self.world_from_hex.apply(placed.translation)
        points = points[points[:, 2] <= centre[2]]
        return float(np.max(self.heights.sample(points[:, :2]) - points[:, 2]))

    def wheel_in_hex(self, q: LegJoints) -> Vec3:
        """Axle of the moving leg [m]."""
        self._place(q)
        return np.array(self._state.oMg[self._wheel_object].translation)

    def last_link_in_hex(self, q: LegJoints) -> Vec3:
        """Direction of the moving leg's last link, from ankle to axle."""
        self._place(q)
        return np.array(self._scratch.oMi[self._model.njoints - 1].rotation[:, 0])

    def _place(self, q: np.ndarray) -> None:
        q = np.asarray(q, dtype=float)
        pin.updateGeometryPlacements(self._model, self._scratch, self._geometry, self._state, q)

    def _refusal(self, q: np.ndarray, clearance: float, *, wheels_too: bool) -> str | None:
        self._place(q)
        if pin.computeCollisions(self._geometry, self._state, True):
            return OWN
        centres = self._centres()
        gaps = np.square(centres[self._mover] - self._standing_in_hex).sum(axis=1)
        for n in np.flatnonzero(gaps < self._reach2):
            if pin.computeCollision(self._geometry, self._state, self._other_leg_pairs[n]):
                return OTHER_LEG
        return TERRAIN if self._terrain_hit(centres, clearance, wheels_too=wheels_too) is not None else None

    def _centres(self) -> np.ndarray:
        placed = self._state.oMg
        return np.array([placed[i].translation for i in self._moving])

    def _self_hit(self) -> str | None:
        for k in self._self_pairs:
            if pin.computeCollision(self._geometry, self._state, k):
                return _named(self._geometry, k)
        return None

    def _terrain_hit(self, centres: np.ndarray, clearance: float, *, wheels_too: bool) -> str | None:
        near = self._bounds[clearance].may_touch(self.world_from_hex.apply(centres[self._ground_rows]))
        for n in np.flatnonzero(near):
            if self._is_wheel[n] and not wheels_too:
                continue
            k = self._terrain_pairs[n]
            self._state.collisionRequests[k].security_margin = clearance
            if pin.computeCollision(self._geometry, self._state, k):
                return _named(self._geometry, k)
        return None


class BodyCollision:
    """What the whole robot hits while the chassis moves over planted wheels. Holds scratch memory: one a thread."""

    def __init__(self, spec: RobotSpec, heights: HeightGrid, config: CollisionConfig) -> None:
        self.spec, self.config = spec, config
        self._parts = robot_parts(spec.name, config)
        self._ground = _Ground(heights)
        geometry = pin.GeometryModel(self._parts.geometry)
        for i, j, _ in self._parts.pairs:
            geometry.addCollisionPair(pin.CollisionPair(i, j))
        self._field = geometry.addGeometryObject(self._ground.object_in_hex(SE3.identity()))
        self._grounded = [i for i, order in enumerate(self._parts.order) if order < spec.dof]
        for i in self._grounded:
            geometry.addCollisionPair(pin.CollisionPair(i, self._field))
        self._geometry = geometry
        self._bound = self._ground.bound(self._parts.radii[self._grounded] + config.near_ground_clearance)
        self._scratch = self._parts.model.createData()
        self._state = geometry.createData()
        n = len(self._parts.pairs)
        self._terrain_pairs = range(n, n + len(self._grounded))
        for k, (_, _, margin) in enumerate(self._parts.pairs):
            self._state.collisionRequests[k].security_margin = margin
        for k in self._terrain_pairs:
            self._state.collisionRequests[k].security_margin = config.near_ground_clearance
        parts = self._parts
        self._reach2 = (parts.radii[parts.first] + parts.radii[parts.second] + parts.clearances) ** 2

    def come_no_nearer(self, joints: Joints) -> None:
        """Parts of the robot that are nearer to each other than their clearance already may stay so, and come no nearer.

        A stance that sagged a millimetre into a clearance would otherwise forbid every move, those out of it as well. Half of
        the clearance stays, however often a stance is asked of.
        """
        placed = self._placed(joints)
        for k in self._suspects(placed):
            request = self._state.collisionRequests[k]
            if pin.computeCollision(self._geometry, self._state, k):
                apart = pin.computeDistance(self._geometry, self._state, k).min_distance
                whole = self._parts.pairs[k][2]
                request.security_margin = max(0.5 * whole, min(whole, apart - STILL))

    def is_free(self, joints: Joints, world_from_hex: SE3) -> bool:
        """Whether all parts keep their clearance, wheels against terrain excepted: they are planted."""
        return self.first_collision(joints, world_from_hex) is None

    def first_collision(self, joints: Joints, world_from_hex: SE3) -> str | None:
        """Names of a pair that is too close; None where all is free."""
        self._geometry.geometryObjects[self._field].placement = self._ground.placement_in_hex(world_from_hex)
        centres_in_hex = self._placed(joints)
        for k in self._suspects(centres_in_hex):
            if pin.computeCollision(self._geometry, self._state, k):
                return _named(self._geometry, k)
        centres = world_from_hex.apply(centres_in_hex[self._grounded])
        for k, close in zip(self._terrain_pairs, self._bound.may_touch(centres), strict=True):
            if close and pin.computeCollision(self._geometry, self._state, k):
                return _named(self._geometry, k)
        return None

    def _placed(self, joints: Joints) -> np.ndarray:
        """Puts the parts where the joints have them; their centres in hex, shape (n, 3) [m]."""
        q = self._parts.configuration(joints)
        pin.updateGeometryPlacements(self._parts.model, self._scratch, self._geometry, self._state, q)
        return np.array([self._state.oMg[i].translation for i in range(len(self._parts.leg))])

    def _suspects(self, centres_in_hex: np.ndarray) -> list[int]:
        """Pairs of parts whose bounding spheres come near enough for an exact look."""
        gaps = np.square(centres_in_hex[self._parts.first] - centres_in_hex[self._parts.second]).sum(axis=1)
        return [int(k) for k in np.flatnonzero(gaps < self._reach2)]


def terrain_shape(heights: HeightGrid) -> Any:
    """The terrain as coal's height field, its local origin in the grid's middle and at height 0."""
    if not np.isfinite(heights.heights).all():
        unknown = int((~np.isfinite(heights.heights)).sum())
        raise TerrainError(f"{unknown} cells of the terrain are unknown; fill them before collision checks")
    nx, ny = heights.shape
    # coal's rows run against y and its columns along x.
    rows = np.ascontiguousarray(heights.heights.T[::-1])
    floor = float(heights.heights.min()) - FOUNDATION
    return coal.HeightFieldOBBRSS((nx - 1) * heights.cell, (ny - 1) * heights.cell, rows, floor)


class _Ground:
    """The terrain's shape, its place, and an upper bound that tells quickly what is far above it."""

    def __init__(self, heights: HeightGrid) -> None:
        self._heights = heights
        self._shape = _cached_shape(heights)
        nx, ny = heights.shape
        half = 0.5 * heights.cell * (np.array([nx, ny]) - 1)
        middle = np.array([heights.origin_x + half[0], heights.origin_y + half[1], 0.0])
        self._world_from_field = SE3.from_translation(middle)
        self._roofs: dict[int, np.ndarray] = {}

    def placement_in_hex(self, world_from_hex: SE3) -> Any:
        return _pin_se3(world_from_hex.inverse().compose(self._world_from_field))

    def object_in_hex(self, world_from_hex: SE3) -> Any:
        return pin.GeometryObject(TERRAIN, 0, self.placement_in_hex(world_from_hex), self._shape)

    def bound(self, radii: np.ndarray) -> _Bound:
        """A quick test for spheres of these radii."""
        heights = self._heights
        # Classes of four cells keep the number of filtered maps small.
        cells = 4 * np.ceil((radii / heights.cell + 1.0) / 4.0).astype(int)
        kinds, kind_of = np.unique(cells, return_inverse=True)
        for n in kinds:
            if int(n) not in self._roofs:
                self._roofs[int(n)] = maximum_filter(heights.heights, size=2 * int(n) + 1, mode="nearest")
        return _Bound(heights, radii, kind_of, np.array([self._roofs[int(n)] for n in kinds]))


class _Bound:
    """Tells which of some spheres could reach the terrain: highest ground within each sphere's radius, by lookup."""

    def __init__(self, heights: HeightGrid, radii: np.ndarray, kind_of: np.ndarray, roofs: np.ndarray) -> None:
        self._origin = np.array([heights.origin_x, heights.origin_y])
        self._per_cell = 1.0 / heights.cell
        self._last = np.array(heights.shape) - 1
        self._radii, self._kind_of, self._roofs = radii, kind_of, roofs

    def may_touch(self, centres_in_world: np.ndarray) -> np.ndarray:
        """Flags per sphere; the others certainly do not touch."""
        cell = np.clip(((centres_in_world[:, :2] - self._origin) * self._per_cell + 0.5).astype(int), 0, self._last)
        roof = self._roofs[self._kind_of, cell[:, 0], cell[:, 1]]
        return np.asarray(centres_in_world[:, 2] - self._radii <= roof)


@lru_cache(maxsize=4)
def _cached_shape(heights: HeightGrid) -> Any:
    return terrain_shape(heights)


def _with_one_leg(parts: Parts, joints: np.ndarray, leg: int) -> tuple[Any, Any, list[bool]]:
    """A chain of one leg's joints, all solids hung on it or fixed in hex, and which of them move."""
    joints = np.asarray(joints, dtype=float)
    if joints.shape != (LEGS, parts.spec.dof) or not 0 <= leg < LEGS:
        raise PlanningError(f"joints have shape {joints.shape}, leg is {leg}; need (6, {parts.spec.dof}) and 0 to 5")
    full, scratch, state = parts.model, parts.model.createData(), parts.geometry.createData()
    standing = joints.copy()
    standing[leg] = np.where(np.isfinite(standing[leg]), standing[leg], 0.0)
    pin.updateGeometryPlacements(full, scratch, parts.geometry, state, parts.configuration(standing))
    chain, parent, new_of = pin.Model(), 0, {}
    for name in parts.spec.joint_names:
        old = full.getJointId(f"leg{leg + 1}_{name}")
        placement = full.jointPlacements[old]
        if parent == 0:
            placement = scratch.oMi[full.parents[old]] * placement
        parent = chain.addJoint(parent, full.joints[old], placement, full.names[old])
        new_of[old] = parent
    geometry, moved = pin.GeometryModel(), []
    for i, solid in enumerate(parts.geometry.geometryObjects):
        holder = solid.parentJoint
        if parts.leg[i] == leg and holder not in new_of:  # the wheel turns in place: it hangs on the last joint
            holder = full.parents[holder]
        moves = holder in new_of
        placement = scratch.oMi[holder].actInv(state.oMg[i]) if moves else state.oMg[i]
        geometry.addGeometryObject(pin.GeometryObject(solid.name, new_of.get(holder, 0), placement, solid.geometry))
        moved.append(moves)
    return chain, geometry, moved


def _named(geometry: Any, pair: int) -> str:
    ends: Sequence[int] = (geometry.collisionPairs[pair].first, geometry.collisionPairs[pair].second)
    return " against ".join(link_name(geometry.geometryObjects[i].name) for i in ends)


def _pin_se3(transform: SE3) -> Any:
    return pin.SE3(transform.rotation, transform.translation)
