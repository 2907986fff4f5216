"""Collision checks of the drawn robot against the believed terrain and itself, with a clearance for each pair of parts.

Place in the flow: fused terrain, joints and pose -> `LegCollision` (one leg moves, all else stands) for swing planning,
`BodyCollision` (all move) for body shifts. Shapes are the URDF's collision solids, checked by coal; the terrain is a
height field, solid below. One clearance holds against the terrain; between parts it grows with their distance along
the chain, since compliance and encoder noise add up on the way ([SunSpiral2012] s3.4.1). Pairs that are closer than
that by construction, in the drawings' stance, are left out, and so are links that share a pivot.

The terrain ends where its map ends: beyond it nothing collides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
from athlete_twin.model.spec import LEGS, RobotSpec, load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.model.urdf import urdf_text

TERRAIN = "terrain"
OWN, OTHER_LEG = "own_leg_or_body", "other_leg"
FOUNDATION = 2.0
"""how far the terrain's solid reaches below its lowest point: a leg deep inside still collides [m]"""


@dataclass(frozen=True, kw_only=True)
class CollisionConfig:
    """Clearances, as in a table by hand ([SunSpiral2012] s3.4.1; the paper's values are not published)."""

    terrain_clearance: float = 0.05
    """of every part of a swinging leg from the terrain: the map's error is centimetres [m]"""
    near_ground_clearance: float = 0.01
    """of all parts but wheels, on the vertical ways from and to the ground and in body shifts: they are where they
    are, and rocks may stand close [m]"""
    max_wheel_sink: float = 0.08
    """deepest that the wheel's hull may reach into the terrain when it stands: tyre deflection and map error [m]"""
    same_leg_clearance: tuple[float, ...] = (0.02, 0.03)
    """between segments of one leg that are 2, 3 or more pivots apart [m]; how far neighbouring segments fold is what
    the joints' limits say"""
    body_clearance: float = 0.04
    """of a leg from the chassis and payload [m]"""
    neighbour_clearance: float = 0.06
    """of a leg from its neighbour, the longest chain between two parts [m]"""
    payload_size: tuple[float, float, float] | None = None
    """box of the payload along x, y, z, standing on the middle of the deck plane [m]; None without payload"""

    def __post_init__(self) -> None:
        lengths = (
            self.terrain_clearance,
            self.near_ground_clearance,
            self.max_wheel_sink,
            self.body_clearance,
            self.neighbour_clearance,
            *self.same_leg_clearance,
            *(self.payload_size or ()),
        )
        if not self.same_leg_clearance or not all(np.isfinite(v) and v >= 0.0 for v in lengths):
            raise PlanningError(f"clearances and payload sizes must be finite and not negative, got {lengths}")


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
        parts = _parts(spec.name, config)
        self._model, geometry, moved = _with_one_leg(parts, joints, leg)
        self._scratch = self._model.createData()
        mine = [(i, j, margin) for i, j, margin in parts.pairs if moved[i] or moved[j]]
        # Close ones first, always checked; then those with the neighbours, most of them far apart.
        mine.sort(key=lambda pair: parts.neighbours(*pair[:2]))
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
        self._cull_neighbours(parts, mine, moved)
        for k in (*self._neighbour_pairs, *self._terrain_pairs):
            self._state.deactivateCollisionPair(k)

    def _cull_neighbours(self, parts: _Parts, mine: list[tuple[int, int, float]], moved: list[bool]) -> None:
        """Bounding spheres of the pairs with standing legs, for a quick look before the exact check."""
        q = np.zeros(self.spec.dof)
        self._place(q)
        far = [(k, i, j, margin) for k, (i, j, margin) in enumerate(mine) if parts.neighbours(i, j)]
        rows = {solid: row for row, solid in enumerate(i for i, moves in enumerate(moved) if moves)}
        self._moving = list(rows)
        self._ground_rows = np.array([rows[i] for i in self._grounded])
        self._neighbour_pairs = [k for k, *_ in far]
        self._mover = np.array([rows[i if moved[i] else j] for _, i, j, _ in far])
        standing = [j if moved[i] else i for _, i, j, _ in far]
        self._standing_in_hex = np.array([self._state.oMg[s].translation for s in standing])
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
            if pin.computeCollision(self._geometry, self._state, self._neighbour_pairs[n]):
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
        self._parts = _parts(spec.name, config)
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
            self._state.deactivateCollisionPair(k)

    def is_free(self, joints: Joints, world_from_hex: SE3) -> bool:
        """Whether all parts keep their clearance, wheels against terrain excepted: they are planted."""
        return self.first_collision(joints, world_from_hex) is None

    def first_collision(self, joints: Joints, world_from_hex: SE3) -> str | None:
        """Names of a pair that is too close; None where all is free."""
        self._geometry.geometryObjects[self._field].placement = self._ground.placement_in_hex(world_from_hex)
        q = self._parts.configuration(joints)
        pin.updateGeometryPlacements(self._parts.model, self._scratch, self._geometry, self._state, q)
        if pin.computeCollisions(self._geometry, self._state, True):
            hits = (k for k in range(len(self._parts.pairs)) if pin.computeCollision(self._geometry, self._state, k))
            return _named(self._geometry, next(hits))
        placed = self._state.oMg
        centres = world_from_hex.apply(np.array([placed[i].translation for i in self._grounded]))
        for k, close in zip(self._terrain_pairs, self._bound.may_touch(centres), strict=True):
            if close and pin.computeCollision(self._geometry, self._state, k):
                return _named(self._geometry, k)
        return None


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


@dataclass(frozen=True, eq=False, kw_only=True)
class _Parts:
    """All solids of one robot, in URDF order, and the pairs of them to check."""

    spec: RobotSpec
    model: Any
    """pinocchio's model with docks and wheels free"""
    geometry: Any
    """without pairs"""
    leg: tuple[int, ...]
    """index of the leg a solid belongs to, -1 for the chassis"""
    order: tuple[int, ...]
    """place of a solid's link along its leg, 0 (hip yaw) to dof (the wheel); -1 for the chassis"""
    radii: np.ndarray
    """of the bounding spheres about the solids' middles [m]"""
    pairs: tuple[tuple[int, int, float], ...]
    """solids and their clearance [m]"""
    q_of: np.ndarray
    """places of the legs' joints in pinocchio's configuration, shape (6, dof)"""

    def neighbours(self, i: int, j: int) -> bool:
        """Whether two solids belong to different legs."""
        return self.leg[i] >= 0 and self.leg[j] >= 0 and self.leg[i] != self.leg[j]

    def configuration(self, joints: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration: docks and wheels at zero."""
        q = pin.neutral(self.model)
        q[self.q_of] = joints
        return np.asarray(q)


@lru_cache(maxsize=8)
def _parts(robot: str, config: CollisionConfig) -> _Parts:
    spec = load_spec(robot)
    urdf = urdf_text(spec, visuals={}, materials={})
    model = pin.buildModelFromXML(urdf)
    geometry = pin.buildGeomFromUrdfString(model, urdf, pin.COLLISION)
    if config.payload_size is not None:
        box = coal.Box(*config.payload_size)
        middle = np.array([0.0, 0.0, spec.top_in_hex + 0.5 * config.payload_size[2]])
        geometry.addGeometryObject(pin.GeometryObject("payload_0", 0, pin.SE3(np.eye(3), middle), box))
    leg, order = zip(*(_place_of(o.name, spec) for o in geometry.geometryObjects), strict=True)
    q_of = np.array(
        [[model.joints[model.getJointId(f"leg{n + 1}_{name}")].idx_q for name in spec.joint_names] for n in range(LEGS)]
    )
    found = _Parts(
        spec=spec,
        model=model,
        geometry=geometry,
        leg=leg,
        order=order,
        radii=np.array([_bounding_radius(o.geometry) for o in geometry.geometryObjects]),
        pairs=(),
        q_of=q_of,
    )
    candidates = [
        (i, j, margin)
        for i in range(len(leg))
        for j in range(i + 1, len(leg))
        if (margin := _margin(found, i, j, config)) is not None
    ]
    pairs = _apart_in_stance(found, candidates)
    return _Parts(**{**found.__dict__, "pairs": pairs})


def _margin(parts: _Parts, i: int, j: int, config: CollisionConfig) -> float | None:
    """Clearance of two solids [m]; None when the pair is not checked."""
    a, b = parts.leg[i], parts.leg[j]
    if a < 0 and b < 0:
        return None
    if a < 0 or b < 0:
        # A hip's housing turns in the chassis that carries it.
        hip = parts.order[j if a < 0 else i] == 0
        return None if hip else config.body_clearance
    if a == b:
        segment = _segments(parts.spec)
        apart = abs(segment[parts.order[i]] - segment[parts.order[j]])
        table = config.same_leg_clearance
        return None if apart < 2 else table[min(apart - 2, len(table) - 1)]
    return config.neighbour_clearance if (a - b) % LEGS in (1, LEGS - 1) else None


def _apart_in_stance(parts: _Parts, candidates: list[tuple[int, int, float]]) -> tuple[tuple[int, int, float], ...]:
    """The candidates that keep their clearance in the drawings' stance: the others are close by construction."""
    geometry = pin.GeometryModel(parts.geometry)
    for i, j, _ in candidates:
        geometry.addCollisionPair(pin.CollisionPair(i, j))
    state = geometry.createData()
    q = parts.configuration(regular_stance(parts.spec))
    pin.updateGeometryPlacements(parts.model, parts.model.createData(), geometry, state, q)
    for k, (_, _, margin) in enumerate(candidates):
        state.collisionRequests[k].security_margin = margin
    return tuple(c for k, c in enumerate(candidates) if not pin.computeCollision(geometry, state, k))


def _with_one_leg(parts: _Parts, joints: np.ndarray, leg: int) -> tuple[Any, Any, list[bool]]:
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


def _place_of(name: str, spec: RobotSpec) -> tuple[int, int]:
    """Leg index and place along the leg of a solid by its URDF name ("leg1_knee_pitch_0", "wheel3_0", "hex_2")."""
    link = _link(name)
    if link.startswith("wheel"):
        return int(link[5:]) - 1, spec.dof
    if link.startswith("leg"):
        number, joint = link[3:].split("_", 1)
        return int(number) - 1, spec.joint_names.index(joint)
    return -1, -1


def _link(name: str) -> str:
    return str(name).rsplit("_", 1)[0] if str(name).rsplit("_", 1)[-1].isdigit() else str(name)


def _segments(spec: RobotSpec) -> list[int]:
    """Rigid segment between two pivots that each link of a leg is part of, the wheel last; axes that meet are one."""
    apart = [bool(np.any(joint.offset != 0.0)) for joint in spec.joints[1:]]
    links = [0, *(int(n) for n in np.cumsum(apart))]
    return [*links, links[-1]]


def _named(geometry: Any, pair: int) -> str:
    ends: Sequence[int] = (geometry.collisionPairs[pair].first, geometry.collisionPairs[pair].second)
    return " against ".join(_link(geometry.geometryObjects[i].name) for i in ends)


def _bounding_radius(shape: Any) -> float:
    shape.computeLocalAABB()
    return float(shape.aabb_radius) + float(np.linalg.norm(shape.aabb_center))


def _pin_se3(transform: SE3) -> Any:
    return pin.SE3(transform.rotation, transform.translation)
