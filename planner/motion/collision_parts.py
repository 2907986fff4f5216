"""The solids of the drawn robot with its payload, and the clearance of every pair of them.

Place in the flow: drawings -> solids and pairs -> `collision`. A pair's clearance is one length for all, and so many sigma of where
the two parts are relative to each other (`part_sigma`): encoders read a little beside zero, gears wind up under the weight of a leg
in the air, docks twist, and all this adds up along the chain from one part to the other ([SunSpiral2012] s3.4.1: components far
from each other need more). The paper's own way, a table by hand, is `ClearanceTable`.

Checked is every leg against every other, the chassis, the payload, and its own segments that are two pivots or more apart. Pairs
that are close by construction, in the drawings' stance, keep half of their distance there instead of more; none is left out for
that. Left out are parts that touch in that stance, links that share a pivot, a hip's housing with the chassis it turns in, and
parts of two legs that no angles of their joints bring together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from athlete_twin.errors import PlanningError
from athlete_twin.model.spec import LEGS, RobotSpec, load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.model.urdf import urdf_text
from planner.motion.part_sigma import relative_sigmas

STANCE_SHARE = 0.5
"""of two parts' distance in the drawings' stance that their clearance takes at most: the stance itself is free, and moves"""
PAYLOAD = "payload"


@dataclass(frozen=True, kw_only=True)
class ClearanceTable:
    """Clearances by kind of pair, by hand as [SunSpiral2012] s3.4.1 had them; the paper's values are not published."""

    same_leg: tuple[float, ...]
    """between segments of one leg that are 2, 3 or more pivots apart [m]"""
    body: float
    """of a leg from the chassis and payload [m]"""
    other_leg: float
    """of two legs, the longest chain between two parts [m]"""

    def __post_init__(self) -> None:
        lengths = (*self.same_leg, self.body, self.other_leg)
        if not self.same_leg or not all(np.isfinite(v) and v >= 0.0 for v in lengths):
            raise PlanningError(f"a table of clearances needs finite lengths of 0 m or more for each kind of pair, got {lengths}")


@dataclass(frozen=True, kw_only=True)
class CollisionConfig:
    """What is kept clear, and the payload."""

    terrain_clearance: float = 0.05
    """of every part of a swinging leg from the terrain, at least: the map's error is centimetres [m]"""
    near_ground_clearance: float = 0.01
    """of all parts but wheels, on the vertical ways from and to the ground and in body shifts: they are where they
    are, and rocks may stand close [m]"""
    max_wheel_sink: float = 0.08
    """deepest that the wheel's hull may reach into the terrain when it stands: tyre deflection and map error [m]"""
    part_clearance: float = 0.015
    """of any two parts were all angles known: paths are checked every 0.01 rad, so that a leg's end of 3 m is at most 15 mm from a
    checked place [m]"""
    deviations: float = 3.0
    """so many sigma of two parts' places are kept beside"""
    map_deviations: float = 3.0
    """so many sigma of a cell's height a swing keeps clear of over `part_clearance`, where that is more than `terrain_clearance`,
    while it finds a way; 0 for one clearance everywhere, as in the paper"""
    unknown_rise: float = 0.10
    """ground nobody saw is taken for so much higher than the highest beside it: with the swing's own clearance rocks of 0.17 m
    (SDM-B) hide there without harm [m]"""
    encoder_sigma_deg: float = 0.1
    """of a joint's zero [deg]; EST, as good as they are aligned"""
    wind_up_sigma_deg: float = 0.14
    """of a joint's angle by loads that the plan does not know [deg]: a leg in the air asks 12 % of its joints' torques in rms over
    joints and places (SDM-B; T12 10 %), and gears at their limit wind up 1.2 deg (EST)"""
    dock_sigma_deg: float = 0.5
    """of a dock's twist, drawn at zero [deg]: lifting a leg twists both of T12's by 0.5 in rms over the legs (`sag.docked`)"""
    table: ClearanceTable | None = None
    """clearances by hand instead of those"""
    payload_above: tuple[float, float, float] | None = None
    """box along x, y, z that stands on the middle of the chassis, as the habitat did [m]; None without one"""
    payload_below: tuple[float, float, float] | None = None
    """box that hangs below it, as the generators did at Moses Lake ([SunSpiral2012] s4.1) [m]; None without one"""

    def __post_init__(self) -> None:
        named = (
            "terrain_clearance", "near_ground_clearance", "max_wheel_sink", "part_clearance", "deviations", "map_deviations",
            "unknown_rise", "encoder_sigma_deg", "wind_up_sigma_deg", "dock_sigma_deg",
        )  # fmt: skip
        for name in named:
            if not 0.0 <= getattr(self, name) < np.inf:
                raise PlanningError(f"{name} is {getattr(self, name)}, must be finite and not negative")
        if not isinstance(self.table, ClearanceTable | None):
            raise PlanningError(f"table is {self.table!r}, must be a ClearanceTable; a variant's file sets the uncertainties instead")
        for name in ("payload_above", "payload_below"):
            box = getattr(self, name)
            if box is not None and not (len(box) == 3 and all(0.0 < v < np.inf for v in box)):
                raise PlanningError(f"{name} is {box}, must be three positive lengths, such as (1.0, 0.8, 0.4)")

    @property
    def map_error_covered(self) -> float:
        """Error of a cell's height that the one clearance from the terrain covers [m]."""
        return max(self.terrain_clearance - self.part_clearance, 0.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Parts:
    """All solids of one robot, in URDF order, and the pairs of them to check."""

    spec: RobotSpec
    model: Any
    """pinocchio's model with docks and wheels free"""
    geometry: Any
    """without pairs"""
    leg: tuple[int, ...]
    """index of the leg a solid belongs to, -1 for the chassis and payload"""
    order: tuple[int, ...]
    """place of a solid's link along its leg, 0 (hip yaw) to dof (the wheel); -1 for the chassis and payload"""
    radii: np.ndarray
    """of the bounding spheres about the solids' middles [m]"""
    reach: np.ndarray
    """of the ball about its hip that a leg's solid stays in, whatever the angles of the leg [m]; of the chassis' solids 0"""
    pairs: tuple[tuple[int, int, float], ...]
    """solids and their clearance [m]"""
    q_of: np.ndarray
    """places of the legs' joints in pinocchio's configuration, shape (6, dof)"""

    @cached_property
    def first(self) -> np.ndarray:
        """The first solid of each pair."""
        return np.array([i for i, _, _ in self.pairs])

    @cached_property
    def second(self) -> np.ndarray:
        """The second solid of each pair."""
        return np.array([j for _, j, _ in self.pairs])

    @cached_property
    def clearances(self) -> np.ndarray:
        """Of each pair [m]."""
        return np.array([clearance for _, _, clearance in self.pairs])

    def between_legs(self, i: int, j: int) -> bool:
        """Whether two solids belong to different legs."""
        return self.leg[i] >= 0 and self.leg[j] >= 0 and self.leg[i] != self.leg[j]

    def configuration(self, joints: np.ndarray) -> np.ndarray:
        """Pinocchio's configuration: docks and wheels at zero."""
        q = pin.neutral(self.model)
        q[self.q_of] = joints
        return np.asarray(q)


@lru_cache(maxsize=8)
def robot_parts(robot: str, config: CollisionConfig) -> Parts:
    """The solids of a robot and its payload with their pairs; an error where a payload reaches into a leg as drawn."""
    spec = load_spec(robot)
    urdf = urdf_text(spec, visuals={}, materials={})
    model = pin.buildModelFromXML(urdf)
    geometry = pin.buildGeomFromUrdfString(model, urdf, pin.COLLISION)
    _load(geometry, spec, config)
    leg, order = zip(*(_place_of(o.name, spec) for o in geometry.geometryObjects), strict=True)
    bare = Parts(
        spec=spec,
        model=model,
        geometry=geometry,
        leg=leg,
        order=order,
        radii=np.array([_bounding_radius(o.geometry) for o in geometry.geometryObjects]),
        reach=np.zeros(len(leg)),
        pairs=(),
        q_of=np.array(
            [[model.joints[model.getJointId(f"leg{n + 1}_{name}")].idx_q for name in spec.joint_names] for n in range(LEGS)]
        ),
    )
    bare = replace(bare, reach=_reach(bare))
    n = len(leg)
    candidates = np.array([(i, j) for i in range(n) for j in range(i + 1, n) if _is_checked(bare, i, j)])
    wanted = _clearances(bare, candidates, config)
    near = _may_meet(bare, candidates, wanted)
    candidates, wanted = candidates[near], wanted[near]
    drawn = _stance_distances(bare, candidates)
    for i, j in candidates[drawn <= 0.0].tolist():
        one, other = (link_name(geometry.geometryObjects[k].name) for k in (i, j))
        if other.startswith(PAYLOAD):
            raise PlanningError(f"{other} reaches into {one} in the drawings' stance of {robot}; a smaller box fits")
    pairs = tuple(
        (i, j, float(min(clearance, STANCE_SHARE * distance)))
        for (i, j), clearance, distance in zip(candidates.tolist(), wanted, drawn, strict=True)
        if distance > 0.0
    )
    return replace(bare, pairs=pairs)


def link_name(name: str) -> str:
    """The link that a solid belongs to, such as "leg1_knee_pitch" of "leg1_knee_pitch_0"."""
    return str(name).rsplit("_", 1)[0] if str(name).rsplit("_", 1)[-1].isdigit() else str(name)


def _load(geometry: Any, spec: RobotSpec, config: CollisionConfig) -> None:
    """Add the payload's boxes, above and below the chassis' middle: on T12 that is the pallet, higher than its decks."""
    ends = np.array([part.centre[2] + side * part.size[2] for part in spec.body_parts for side in (-0.5, 0.5)])
    places = (
        (f"{PAYLOAD}_above", config.payload_above, ends.max(), 0.5),
        (f"{PAYLOAD}_below", config.payload_below, ends.min(), -0.5),
    )
    for name, size, from_z, side in places:
        if size is not None:
            middle = np.array([0.0, 0.0, from_z + side * size[2]])
            geometry.addGeometryObject(pin.GeometryObject(f"{name}_0", 0, pin.SE3(np.eye(3), middle), coal.Box(*size)))


def _is_checked(parts: Parts, i: int, j: int) -> bool:
    a, b = parts.leg[i], parts.leg[j]
    if a < 0 and b < 0:
        return False
    if a < 0 or b < 0:
        # A hip's housing turns in the chassis that carries it.
        body, own = (i, j) if a < 0 else (j, i)
        return parts.order[own] > 0 or PAYLOAD in parts.geometry.geometryObjects[body].name
    return a != b or _segments_apart(parts, i, j) >= 2


def _clearances(parts: Parts, pairs: np.ndarray, config: CollisionConfig) -> np.ndarray:
    """Of each pair, whatever the drawings' stance [m]."""
    if config.table is not None:
        return np.array([_by_hand(parts, i, j, config.table) for i, j in pairs.tolist()])
    sigmas = np.zeros(parts.model.nv)
    for joint in range(1, parts.model.njoints):
        sigmas[parts.model.joints[joint].idx_v] = _joint_sigma(parts.model.names[joint], config)
    apart = relative_sigmas(parts.model, parts.geometry, parts.configuration(regular_stance(parts.spec)), sigmas)
    return np.asarray(config.part_clearance + config.deviations * apart[pairs[:, 0], pairs[:, 1]])


def _joint_sigma(name: str, config: CollisionConfig) -> float:
    """Of one joint's angle [rad]. A wheel's turn moves no part; a dock is believed to twist, not to bend."""
    if name.startswith("leg"):
        return float(np.deg2rad(np.hypot(config.encoder_sigma_deg, config.wind_up_sigma_deg)))
    return float(np.deg2rad(config.dock_sigma_deg)) if name.endswith("_twist") else 0.0


def _by_hand(parts: Parts, i: int, j: int, table: ClearanceTable) -> float:
    if parts.leg[i] < 0 or parts.leg[j] < 0:
        return table.body
    if parts.between_legs(i, j):
        return table.other_leg
    return table.same_leg[min(_segments_apart(parts, i, j) - 2, len(table.same_leg) - 1)]


def _reach(parts: Parts) -> np.ndarray:
    state, scratch = parts.geometry.createData(), parts.model.createData()
    pin.updateGeometryPlacements(parts.model, scratch, parts.geometry, state, pin.neutral(parts.model))
    reach = np.zeros(len(parts.leg))
    for i, (leg, solid) in enumerate(zip(parts.leg, parts.geometry.geometryObjects, strict=True)):
        if leg >= 0:
            own = [k for k in parts.model.supports[solid.parentJoint] if parts.model.names[k].startswith(("leg", "wheel"))]
            stops = [*(scratch.oMi[k].translation for k in own), state.oMg[i].translation]
            reach[i] = parts.radii[i] + np.linalg.norm(np.diff(stops, axis=0), axis=1).sum()
    return reach


def _may_meet(parts: Parts, pairs: np.ndarray, clearances: np.ndarray) -> np.ndarray:
    """Which pairs could come as near as their clearance; all pairs with the chassis and of one leg."""
    one, other = np.array(parts.leg)[pairs].T
    hips = parts.spec.hips_in_hex
    gap = np.linalg.norm(hips[one] - hips[other], axis=1) - parts.reach[pairs].sum(axis=1)
    return np.asarray((one < 0) | (other < 0) | (one == other) | (gap < clearances))


def _stance_distances(parts: Parts, pairs: np.ndarray) -> np.ndarray:
    """Of each pair in the drawings' stance [m]; not positive where they touch."""
    geometry = pin.GeometryModel(parts.geometry)
    for i, j in pairs.tolist():
        geometry.addCollisionPair(pin.CollisionPair(i, j))
    state = geometry.createData()
    q = parts.configuration(regular_stance(parts.spec))
    pin.updateGeometryPlacements(parts.model, parts.model.createData(), geometry, state, q)
    return np.array([pin.computeDistance(geometry, state, k).min_distance for k in range(len(pairs))])


def _place_of(name: str, spec: RobotSpec) -> tuple[int, int]:
    """Leg index and place along the leg of a solid by its URDF name ("leg1_knee_pitch_0", "wheel3_0", "hex_2")."""
    link = link_name(name)
    if link.startswith("wheel"):
        return int(link[5:]) - 1, spec.dof
    if link.startswith("leg"):
        number, joint = link[3:].split("_", 1)
        return int(number) - 1, spec.joint_names.index(joint)
    return -1, -1


def _segments_apart(parts: Parts, i: int, j: int) -> int:
    """Pivots between two solids of one leg; axes that meet are one."""
    joints = parts.spec.joints[1:]
    apart = [bool(np.any(joint.offset != 0.0)) for joint in joints]
    segment = [0, *(int(n) for n in np.cumsum(apart))]
    segment.append(segment[-1])  # the wheel turns in the last link
    return abs(segment[parts.order[i]] - segment[parts.order[j]])


def _bounding_radius(shape: Any) -> float:
    shape.computeLocalAABB()
    return float(shape.aabb_radius) + float(np.linalg.norm(shape.aabb_center))
