"""The stability map: for one leg and many places on the ground, could the leg step there, and would the robot stand?

[SunSpiral2012] s3.3: where inverse kinematics finds a leg configuration, the centre of mass and the margins are
computed with it. Green is `ok`; red carries the first reason that refused it. A place is judged twice: with the wheel in
the air above it, standing on the others, and with all wheels down. The point above it through which the step comes down
must be within reach too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import SupportError
from athlete_twin.geometry.arrays import Joints, PerLegFlag, Points3
from athlete_twin.geometry.polygon import conservative_distances, signed_distances
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.leg_coms import leg_coms_in_hex
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS
from planner.stability.margin import MARGINS, cps_tip_over_energy

REASONS = ("ok", "unknown", "unreachable", "unreachable_above", "swing_margin", "landed_margin")
"""names of the codes in `StabilityMap.reason`"""
OK, UNKNOWN, UNREACHABLE, UNREACHABLE_ABOVE, SWING_MARGIN, LANDED_MARGIN = range(len(REASONS))


@dataclass(frozen=True, kw_only=True)
class StabilityConfig:
    """What a footfall must keep."""

    min_margin: float
    """of the CPS with all wheels down, of the plain polygon during the swing [m]"""
    all_down: str = "cps"
    """margin that counts with all wheels down: "cps", "support" or "energy" """
    min_energy: float = 0.10
    """of the CPS tip-over energy, when that counts [m]; about what 0.3 m of margin are worth at SDM-B's height"""

    def __post_init__(self) -> None:
        if self.all_down not in MARGINS:
            raise SupportError(f"margin {self.all_down!r} is not one of {', '.join(MARGINS)}")
        if not (np.isfinite(self.min_margin) and np.isfinite(self.min_energy)):
            raise SupportError(f"least margin {self.min_margin} m and energy {self.min_energy} m must be finite")


@dataclass(frozen=True, eq=False, kw_only=True)
class StabilityMap:
    """One leg's candidate footfalls, judged."""

    leg: int
    """index 0 to 5"""
    reachable: np.ndarray
    """inverse kinematics exists within limits, on the ground and lifted above it, shape (n,)"""
    joints: np.ndarray
    """of the leg with the wheel on the ground, shape (n, dof), NaN where it does not reach [rad]"""
    lifted: np.ndarray
    """of the leg at the way-point above it, the same [rad]"""
    margin: np.ndarray
    """plain support margin with all wheels down, shape (n,), NaN where the leg does not reach [m]"""
    cps_margin: np.ndarray
    """the same to the conservative polygon [m]"""
    swing_margin: np.ndarray
    """plain margin of the other wheels, the leg in the air above the place [m]"""
    energy: np.ndarray
    """CPS tip-over energy with all wheels down, NaN unless it was asked for [m]"""
    ok: np.ndarray
    """nothing refused it, shape (n,)"""
    reason: np.ndarray
    """code into `REASONS`, shape (n,)"""

    def counts(self) -> dict[str, int]:
        """How many candidates each reason refused, and how many none did."""
        return {name: int(np.sum(self.reason == code)) for code, name in enumerate(REASONS)}


def stability_map(
    kinematics: Kinematics,
    joints: Joints,
    *,
    leg: int,
    footfalls_in_world: Points3,
    world_from_hex: SE3,
    config: StabilityConfig,
    lift: float = 0.0,
    payload_kg: float = 0.0,
    world_from_leg: SE3 | None = None,
    standing: PerLegFlag | None = None,
) -> StabilityMap:
    """Judges n footfalls of one leg while the other five stay where they are.

    Args:
        kinematics: of the drawings.
        joints: of all legs now, shape (6, dof) [rad]; the leg's own row does not matter.
        leg: index 0 to 5.
        footfalls_in_world: places of the contact, shape (n, 3) [m]; a NaN height is unknown ground.
        world_from_hex: the chassis as it will stand, sag included.
        config: limits.
        lift: height of the way-point above the footfall that must be within reach [m].
        payload_kg: [kg]
        world_from_leg: hex frame of what carries the leg, where its deck twists on a dock; the chassis when None. It says
            what is within reach; of the margins, centimetres of one leg's mass are left out.
        standing: which wheels are on the ground, the leg's own aside, shape (6,); all when None. While another one is in the air,
            the plain margin counts with the leg down, as in any swing.
    """
    spec = kinematics.spec
    n, radius = len(footfalls_in_world), spec.wheel.radius
    hex_from_world = (world_from_hex if world_from_leg is None else world_from_leg).inverse()
    up_in_world = np.array([0.0, 0.0, 1.0])
    down_in_hex = hex_from_world.rotate(-up_in_world)
    known = np.isfinite(footfalls_in_world).all(axis=1)
    places = np.where(known[:, None], footfalls_in_world, 0.0)

    q, on_ground = leg_ik(spec, leg, hex_from_world.apply(places + radius * up_in_world), last_link_in_hex=down_in_hex)
    lifted, above = leg_ik(
        spec, leg, hex_from_world.apply(places + (radius + lift) * up_in_world), last_link_in_hex=down_in_hex
    )
    reachable = known & on_ground & above

    contacts = world_from_hex.apply(kinematics.wheels_in_hex(joints)) - radius * up_in_world
    down = np.ones(LEGS, dtype=bool) if standing is None else standing.copy()
    down[leg] = True
    others = contacts[down & (np.arange(LEGS) != leg)]
    r = reachable
    com_landed = world_from_hex.apply(com_with_leg(kinematics, joints, leg, q[r], payload_kg))
    com_swing = world_from_hex.apply(com_with_leg(kinematics, joints, leg, lifted[r], payload_kg))
    landed = np.broadcast_to(contacts, (len(com_landed), LEGS, 3)).copy()
    landed[:, leg] = places[r]
    landed = landed[:, down]

    margin, cps, swing, energy = (np.full(n, np.nan) for _ in range(4))
    margin[r] = signed_distances(com_landed[:, :2], landed[:, :, :2])
    cps[r] = conservative_distances(com_landed[:, :2], landed[:, :, :2])
    swing[r] = signed_distances(com_swing[:, :2], np.broadcast_to(others[:, :2], (len(com_swing), len(others), 2)))
    if config.all_down == "energy":
        energy[r] = [cps_tip_over_energy(c, w) for c, w in zip(com_landed, landed, strict=True)]

    stands = {
        "cps": cps >= config.min_margin,
        "support": margin >= config.min_margin,
        "energy": energy >= config.min_energy,
    }[config.all_down if down.all() else "support"]
    reason = np.select(
        [~known, ~on_ground, ~above, ~(swing >= config.min_margin), ~stands],
        [UNKNOWN, UNREACHABLE, UNREACHABLE_ABOVE, SWING_MARGIN, LANDED_MARGIN],
        OK,
    ).astype(np.uint8)
    return StabilityMap(
        leg=leg,
        reachable=reachable,
        joints=np.where(reachable[:, None], q, np.nan),
        lifted=np.where(reachable[:, None], lifted, np.nan),
        margin=margin,
        cps_margin=cps,
        swing_margin=swing,
        energy=energy,
        ok=reason == OK,
        reason=reason,
    )


def com_with_leg(kinematics: Kinematics, joints: Joints, leg: int, q: np.ndarray, payload_kg: float) -> np.ndarray:
    """Centre of mass in hex with one leg in each of n configurations (n, dof), shape (n, 3) [m]."""
    spec = kinematics.spec
    mass = spec.mass + payload_kg
    now = leg_coms_in_hex(spec, leg, joints[leg : leg + 1])[0]
    rest = mass * kinematics.com_in_hex(joints, payload_kg) - spec.leg_mass * now
    return np.asarray((rest + spec.leg_mass * leg_coms_in_hex(spec, leg, q)) / mass)
