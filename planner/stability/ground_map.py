"""The stability map of [SunSpiral2012] s3.3: for each leg, every cell of the ground, green, or red with its reason.

Reasons are looked for in a fixed order and the first one that applies is kept: unknown ground; out of the leg's reach;
within reach only with the last link farther from vertical than a leg that bears load may have it (s7.1); a part of the leg too
close to the robot or the ground; a support margin; a static joint torque; the ground itself, as the footfall scores
veto it.

The last link is placed as plumb as the leg's plane allows, rolls at zero, as the planner places it: plumb on a level chassis,
on a tilted one leaning out of that plane by up to the tilt. Beyond `max_lean_deg` the cell is refused for it.

Cost: inverse kinematics, margins and torques are vectorised over cells, some 10 us a cell that the leg reaches; the collision
check places the leg cell by cell, 0.1-0.2 ms each, and may be left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import Joints
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.footfall import FootfallMap
from planner.motion.collision import CollisionConfig, LegCollision
from planner.stability import stability_map as candidates
from planner.stability.stability_map import StabilityConfig, StabilityMap, stability_map
from planner.stability.stance_torque import peak_torques

REASONS = ("ok", "unknown", "unreachable", "last_link", "collision", "margin", "torque", "ground")
"""names of the codes in `GroundMap.reason`"""
OK, UNKNOWN, UNREACHABLE, LAST_LINK, COLLISION, MARGIN, TORQUE, GROUND = range(len(REASONS))
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class GroundMapConfig:
    """What a cell must allow."""

    stability: StabilityConfig
    lift: float = 0.20
    """height above the ground through which the step comes down [m]"""
    max_torque_fraction: float = 1.0
    """of the static joint torques, standing on all wheels with this one on the cell, and on the others before"""
    max_lean_deg: float = 10.0
    """of the last link from vertical while its wheel stands [deg]; "near vertical" has no figure in the paper, and this is the
    least of `tilts_deg`, so that a lean counts the same out of the leg's plane as in it"""
    tilts_deg: tuple[float, ...] = (10.0, 20.0, 30.0)
    """of the last link in the leg's plane, in and out, that tell a cell out of reach from one that a plumb last link alone
    cannot reach [deg]"""
    collision: CollisionConfig | None = field(default_factory=CollisionConfig)
    """None leaves the collision check out"""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.lift) and self.lift >= 0.0):
            raise SupportError(f"lift is {self.lift} m, must be 0 or more")
        if not self.max_torque_fraction > 0.0:
            raise SupportError(f"max_torque_fraction is {self.max_torque_fraction}, must be positive; 1.0 is the joints' limit")
        if not 0.0 < self.max_lean_deg <= 90.0:
            raise SupportError(f"max_lean_deg is {self.max_lean_deg} deg, must be above 0 and at most 90; 90 refuses nothing")
        if not all(0.0 < tilt < 90.0 for tilt in self.tilts_deg):
            raise SupportError(f"tilts of the last link are {self.tilts_deg} deg, must lie between 0 and 90")


@dataclass(frozen=True, eq=False, kw_only=True)
class GroundMap:
    """One leg's verdict on every cell."""

    leg: int
    """index 0 to 5"""
    reason: np.ndarray
    """code into `REASONS`, uint8, shape (nx, ny)"""
    joints: np.ndarray
    """of the leg with its wheel on the cell, shape (nx, ny, dof), NaN where it does not reach with the last link upright [rad]"""

    @property
    def ok(self) -> np.ndarray:
        """Green cells, shape (nx, ny)."""
        return np.asarray(self.reason == OK)

    def counts(self) -> dict[str, int]:
        """How many cells each reason refused, and how many none did."""
        return {name: int(np.sum(self.reason == code)) for code, name in enumerate(REASONS)}


def ground_map(
    kinematics: Kinematics,
    joints: Joints,
    leg: int,
    *,
    terrain: HeightGrid,
    world_from_hex: SE3,
    config: GroundMapConfig,
    footfalls: FootfallMap | None = None,
    payload_kg: float = 0.0,
) -> GroundMap:
    """Judge every cell as a footfall of one leg, the other five staying where they are.

    Args:
        kinematics: of the drawings.
        joints: of all legs now, shape (6, dof) [rad]; the leg's own row does not matter.
        leg: index 0 to 5.
        terrain: believed, NaN where unknown.
        world_from_hex: the chassis as it will stand, sag included.
        config: limits.
        footfalls: scores of the same terrain; the ground refuses nothing without them.
        payload_kg: [kg]
    """
    if not 0 <= leg < LEGS:
        raise SupportError(f"leg index {leg} is outside 0 to 5")
    if footfalls is not None and footfalls.veto.shape != terrain.shape:
        raise SupportError(f"footfall scores have shape {footfalls.veto.shape}, the terrain {terrain.shape}")
    spec = kinematics.spec
    x, y = terrain.centres()
    places = np.stack([*np.meshgrid(x, y, indexing="ij"), terrain.heights], axis=-1).reshape(-1, 3)
    known = np.isfinite(places[:, 2])
    reason = np.where(known, UNREACHABLE, UNKNOWN).astype(np.uint8)
    dof = len(spec.joints)
    q, lifted = np.full((2, len(places), dof), np.nan)

    near = np.flatnonzero(known & _near(spec, leg, places, world_from_hex))
    judged = stability_map(
        kinematics, joints, leg=leg, footfalls_in_world=places[near], world_from_hex=world_from_hex, config=config.stability,
        lift=config.lift, payload_kg=payload_kg,
    )  # fmt: skip
    q[near], lifted[near] = judged.joints, judged.lifted
    reason[near] = _stability_reason(judged)
    out = near[~judged.reachable]
    tilted = _reached_tilted(spec, leg, places[out], world_from_hex, config)
    reason[out[tilted]] = LAST_LINK
    reached, lifted = near[judged.reachable], judged.lifted[judged.reachable]
    upright = _lean(spec, leg, q[reached], world_from_hex) <= np.deg2rad(config.max_lean_deg)
    reason[reached[~upright]] = LAST_LINK
    q[reached[~upright]] = np.nan
    reached, lifted = reached[upright], lifted[upright]
    if config.max_torque_fraction < np.inf and len(reached):
        peaks = peak_torques(
            kinematics, joints, leg, q[reached], lifted=lifted, places=places[reached], world_from_hex=world_from_hex,
            payload_kg=payload_kg,
        )  # fmt: skip
        heavy = reached[~(peaks <= config.max_torque_fraction)]
        reason[heavy[reason[heavy] == OK]] = TORQUE
    if footfalls is not None:
        refused = reached[~footfalls.allowed.ravel()[reached]]
        reason[refused[reason[refused] == OK]] = GROUND
    if config.collision is not None and len(reached):
        # The check needs a ground everywhere: what is unknown is as low as the lowest known cell, and refused as a footfall.
        filled = np.where(np.isfinite(terrain.heights), terrain.heights, np.nanmin(terrain.heights))
        legs_way = LegCollision(
            spec, HeightGrid(origin_x=terrain.origin_x, origin_y=terrain.origin_y, cell=terrain.cell, heights=filled),
            world_from_hex, joints, leg, config.collision,
        )  # fmt: skip
        hit = np.array([not legs_way.is_free_near_ground(angles) for angles in q[reached]])
        reason[reached[hit]] = COLLISION
    return GroundMap(leg=leg, reason=reason.reshape(terrain.shape), joints=q.reshape(*terrain.shape, dof))


def ground_maps(
    kinematics: Kinematics,
    joints: Joints,
    *,
    terrain: HeightGrid,
    world_from_hex: SE3,
    config: GroundMapConfig,
    footfalls: FootfallMap | None = None,
    payload_kg: float = 0.0,
) -> tuple[GroundMap, ...]:
    """The same for all six legs."""
    return tuple(
        ground_map(
            kinematics, joints, leg, terrain=terrain, world_from_hex=world_from_hex, config=config, footfalls=footfalls,
            payload_kg=payload_kg,
        )
        for leg in range(LEGS)
    )  # fmt: skip


def _near(spec: RobotSpec, leg: int, places: np.ndarray, world_from_hex: SE3) -> np.ndarray:
    """Whether the stretched leg could come near a place at all: the sum of its lengths about the hip."""
    length = sum(float(np.linalg.norm(joint.offset)) for joint in spec.joints) + float(np.linalg.norm(spec.wheel.offset))
    hip = world_from_hex.apply(spec.hips_in_hex[leg])
    return np.asarray(np.linalg.norm(places + spec.wheel.radius * UP - hip, axis=1) <= length)


def _stability_reason(judged: StabilityMap) -> np.ndarray:
    code = np.zeros(len(candidates.REASONS), dtype=np.uint8)
    code[[candidates.UNKNOWN]] = UNKNOWN
    code[[candidates.UNREACHABLE, candidates.UNREACHABLE_ABOVE]] = UNREACHABLE
    code[[candidates.SWING_MARGIN, candidates.LANDED_MARGIN]] = MARGIN
    return np.asarray(code[judged.reason])


def _lean(spec: RobotSpec, leg: int, q: np.ndarray, world_from_hex: SE3) -> np.ndarray:
    """Angle of the last link from vertical, as `leg_ik` places it: that between plumb and the leg's plane, shape (n,) [rad]."""
    heading = spec.hip_azimuths[leg] + q[:, 0]
    across = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(len(q))])
    return np.asarray(np.arcsin(np.clip(np.abs(across @ world_from_hex.inverse().rotate(-UP)), 0.0, 1.0)))


def _reached_tilted(
    spec: RobotSpec, leg: int, places: np.ndarray, world_from_hex: SE3, config: GroundMapConfig
) -> np.ndarray:
    """Whether the leg reaches places on the ground and above them with a last link that is not plumb, shape (n,)."""
    hex_from_world = world_from_hex.inverse()
    plumb = hex_from_world.rotate(-UP)
    wheels = places + spec.wheel.radius * UP
    on_ground, above = hex_from_world.apply(wheels), hex_from_world.apply(wheels + config.lift * UP)
    outward = on_ground - spec.hips_in_hex[leg]
    outward -= (outward @ plumb)[:, None] * plumb
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    reached = np.zeros(len(places), dtype=bool)
    for tilt in np.deg2rad([sign * t for t in config.tilts_deg for sign in (1.0, -1.0)]):
        left = np.flatnonzero(~reached)
        direction = np.cos(tilt) * plumb + np.sin(tilt) * outward[left]
        # Both with the same tilt: a straight descent keeps it.
        down, up = (leg_ik(spec, leg, p[left], last_link_in_hex=direction)[1] for p in (on_ground, above))
        reached[left] = down & up
    return reached
