"""Sag compensation of a step: how high to command a lift, where the chassis is meanwhile, how far to lower again.

When a leg unloads, the robot sinks and tilts towards it: a lift of 10 cm may leave the wheel on the ground
([SunSpiral2012] s4.1). Three methods: `none` believes the robot rigid; `raise_terrain` is the heuristic of 2008, the
terrain lifted by 15 cm; `springs` solves the contact-spring model with the leg planted and with the leg in the air.

A step needs two predictions, one for the stance it leaves and one for the stance it makes. Of the first it takes
`commanded_lift` and `standing_from_swinging`; of the second, `reload`: how far the wheel must go on downward after it
touches, until it carries its share and the chassis is back up.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import SagError
from athlete_twin.geometry.arrays import PerLeg, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec
from planner.sag.docked import DockedLiftOff, DockedSag, Docks, lift_off, solve_docked
from planner.sag.sag_model import AIRBORNE, DOWN, FootSprings, SagSolution, solve_sag

METHODS = ("none", "raise_terrain", "springs")
TERRAIN_RAISE = 0.15
"""[m], [SunSpiral2012] s4.1: what the 2008 field test used"""


@dataclass(frozen=True, kw_only=True)
class SagConfig:
    """How a step is compensated for sag."""

    method: str = "springs"
    """"none", "raise_terrain" or "springs" """
    terrain_raise: float = TERRAIN_RAISE
    """by how much "raise_terrain" lifts the map and the commanded lift [m]"""
    docks: bool = True
    """whether "springs" knows that a deck twists on its dock, so that the leg's own corner drops more; of a robot with docks"""
    stiffness_z: tuple[float, ...] | None = None
    """constant of each foot as it was measured on this robot (`identify_per_wheel`), six [N/m]; the drawings' when None"""

    def springs(self, spec: RobotSpec) -> FootSprings:
        """What the ground believes of the feet."""
        if self.stiffness_z is None:
            return FootSprings.from_spec(spec)
        return FootSprings(stiffness_z=np.array(self.stiffness_z), lateral_ratio=spec.believed_lateral_ratio)

    def __post_init__(self) -> None:
        constants = self.stiffness_z
        if constants is not None and not (len(constants) == LEGS and all(0.0 < k < np.inf for k in constants)):
            raise SagError(f"stiffness_z is {list(constants)} N/m, need six finite positive constants")
        if self.method not in METHODS:
            raise SagError(f"sag method {self.method!r} is not one of {', '.join(METHODS)}")
        if not 0.0 <= self.terrain_raise <= 1.0:
            raise SagError(f"terrain is raised by {self.terrain_raise} m, must be within 0 to 1 m")


@dataclass(frozen=True, eq=False, kw_only=True)
class LiftOff:
    """Where a foot's believed force reaches zero."""

    lift: float
    """commanded height of the wheel over its planted place at which contact breaks [m]"""
    airborne: SagSolution
    """the robot standing on the others"""


@dataclass(frozen=True, eq=False, kw_only=True)
class SagPrediction:
    """What one leg's unloading does to the robot, as far as the method knows."""

    method: str
    leg: int
    """index 0 to 5 of the leg that unloads"""
    status: str
    """"converged", or why the springs hold no such stance: see `SagSolution.status`"""
    lift_to_break: float
    """commanded height at which the wheel leaves the ground [m]"""
    commanded_lift: float
    """height to command so that the wheel clears the ground by what was asked [m]"""
    reload: float
    """how far the wheel must be commanded on, past the first touch, to carry its share again [m]"""
    terrain_raise: float
    """by how much the map is lifted for collision checks instead [m]"""
    unsagged_from_standing: SE3
    """pose of the chassis with the leg planted, in the hex frame it would have without weight"""
    unsagged_from_swinging: SE3
    """pose of the chassis with the leg in the air, in the same frame; of the pallet, of a robot with docks"""
    unsagged_from_leg: SE3
    """pose of what carries the leg in the air, in the same frame: of its deck, twisted on its dock, else of the chassis"""
    forces_standing: Wheels
    """of the ground on the wheels with the leg planted, in hex, shape (6, 3) [N]; zero where the method knows none"""
    forces_swinging: Wheels
    """the same with the leg in the air"""

    @property
    def standing_from_swinging(self) -> SE3:
        """Pose of the chassis during the swing, in the frame of the chassis that stands on all wheels."""
        return self.unsagged_from_standing.inverse().compose(self.unsagged_from_swinging)

    @property
    def swinging_from_leg(self) -> SE3:
        """What carries the leg in the air, in the frame of the chassis meanwhile; the identity of a rigid chassis."""
        return self.unsagged_from_swinging.inverse().compose(self.unsagged_from_leg)

    @property
    def tilt(self) -> float:
        """Angle by which the chassis turns when the leg unloads [rad]."""
        return float(np.linalg.norm(self.standing_from_swinging.rotvec()))


def lift_to_break_contact(
    feet_in_hex: Wheels,
    com_in_hex: Vec3,
    weight: float,
    *,
    leg: int,
    springs: FootSprings,
    lifts: PerLeg | None = None,
    gravity_in_hex: Vec3 = DOWN,
) -> LiftOff:
    """The commanded height of one wheel over its planted place at which its believed force reaches zero.

    The leg in the air carries nothing, so one solution without it tells how far its place has sunk: that is the lift.
    Closed forms: W/3k for a regular hexagon of springs k with the CoM in the middle at foot height.

    Args:
        feet_in_hex: planted feet without sag, shape (6, 3) [m].
        com_in_hex: centre of mass with the leg lifted [m].
        weight: of the robot with payload [N].
        leg: index 0 to 5.
        springs: the believed springs.
        lifts: heights of all feet over their contact points, shape (6,) [m]; zero by default. The leg's own is what its
            planted place has.
        gravity_in_hex: where gravity points.
    """
    if not 0 <= leg < 6:
        raise SagError(f"leg index {leg} is outside 0 to 5")
    planted = np.zeros(6) if lifts is None else np.asarray(lifts, dtype=float)
    without = planted.copy()
    without[leg] = AIRBORNE
    airborne = _solve(feet_in_hex, com_in_hex, weight, springs, without, gravity_in_hex)
    up = -np.asarray(gravity_in_hex, dtype=float) / np.linalg.norm(gravity_in_hex)
    # The foot at p + lift * up goes to T(p + lift * up); it breaks contact where that stands at its contact height.
    sunk = float(up @ (airborne.unsagged_from_sagged.apply(feet_in_hex[leg]) - feet_in_hex[leg]))
    along = float(up @ airborne.unsagged_from_sagged.rotation @ up)
    return LiftOff(lift=-(sunk + float(planted[leg])) / along, airborne=airborne)


def predict_sag(
    feet_in_hex: Wheels,
    leg: int,
    *,
    com_planted: Vec3,
    com_airborne: Vec3,
    weight: float,
    clearance: float,
    springs: FootSprings,
    config: SagConfig,
    lifts: PerLeg | None = None,
    gravity_in_hex: Vec3 = DOWN,
    docks: Docks | None = None,
) -> SagPrediction:
    """What unloading one leg of a six-wheel stance does, and what to command for a true clearance.

    Args:
        feet_in_hex: planted wheels without sag, shape (6, 3) [m].
        leg: index 0 to 5 of the leg that unloads.
        com_planted: centre of mass with the leg planted [m].
        com_airborne: centre of mass with the leg lifted [m].
        weight: of the robot with payload [N].
        clearance: wanted between wheel and ground once the robot has sagged [m].
        springs: the believed springs.
        config: the method.
        lifts: heights of all feet over their contact points in this stance, shape (6,) [m]; zero by default.
        gravity_in_hex: where gravity points.
        docks: that the decks twist on; None for a rigid chassis. Only "springs" knows of them.
    """
    if not 0 <= leg < 6:
        raise SagError(f"leg index {leg} is outside 0 to 5")
    if not (np.isfinite(clearance) and clearance >= 0.0):
        raise SagError(f"clearance is {clearance} m, must not be negative")
    if config.method != "springs":
        raised = config.terrain_raise if config.method == "raise_terrain" else 0.0
        return SagPrediction(
            method=config.method,
            leg=leg,
            status="converged",
            lift_to_break=0.0,
            commanded_lift=clearance + raised,
            reload=0.0,
            terrain_raise=raised,
            unsagged_from_standing=SE3.identity(),
            unsagged_from_swinging=SE3.identity(),
            unsagged_from_leg=SE3.identity(),
            forces_standing=np.zeros((6, 3)),
            forces_swinging=np.zeros((6, 3)),
        )
    planted = np.zeros(LEGS) if lifts is None else np.asarray(lifts, dtype=float)
    standing = stand_on(feet_in_hex, com_planted, weight, springs, planted, gravity_in_hex, docks)
    off: LiftOff | DockedLiftOff
    if docks is None:
        off = lift_to_break_contact(
            feet_in_hex, com_airborne, weight, leg=leg, springs=springs, lifts=planted, gravity_in_hex=gravity_in_hex
        )
        carried = off.airborne.unsagged_from_sagged
    else:
        off = lift_off(
            feet_in_hex,
            com_airborne,
            weight,
            leg,
            docks=docks,
            springs=springs,
            lifts=planted,
            gravity_in_hex=gravity_in_hex,
        )
        carried = off.airborne.unsagged_from_leg(leg)
    up = -np.asarray(gravity_in_hex, dtype=float) / np.linalg.norm(gravity_in_hex)
    return SagPrediction(
        method=config.method,
        leg=leg,
        status=standing.status if not standing.converged else off.airborne.status,
        lift_to_break=off.lift,
        commanded_lift=off.lift + clearance / float(up @ carried.rotation @ up),
        reload=max(0.0, off.lift),
        terrain_raise=0.0,
        unsagged_from_standing=standing.unsagged_from_sagged,
        unsagged_from_swinging=off.airborne.unsagged_from_sagged,
        unsagged_from_leg=carried,
        forces_standing=standing.forces,
        forces_swinging=off.airborne.forces,
    )


def stand_on(
    feet: Wheels, com: Vec3, weight: float, springs: FootSprings, lifts: PerLeg, gravity: Vec3, docks: Docks | None
) -> SagSolution | DockedSag:
    """The sagged robot, its decks twisted where it has docks; arguments as of `predict_sag`."""
    if docks is None:
        return _solve(feet, com, weight, springs, lifts, gravity)
    return solve_docked(
        feet,
        com,
        weight,
        pieces=docks.pieces,
        twist_stiffness=docks.twist_stiffness,
        stiffness_z=springs.stiffness_z,
        lateral_ratio=springs.lateral_ratio,
        lifts=lifts,
        gravity_in_hex=gravity,
    )


def _solve(feet: Wheels, com: Vec3, weight: float, springs: FootSprings, lifts: PerLeg, gravity: Vec3) -> SagSolution:
    return solve_sag(
        feet,
        com,
        weight,
        stiffness_z=springs.stiffness_z,
        lateral_ratio=springs.lateral_ratio,
        lifts=lifts,
        gravity_in_hex=gravity,
    )
