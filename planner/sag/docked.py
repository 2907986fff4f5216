"""Sag of a deck in three parts: rigid pieces joined by docks that twist, on the springs of the feet.

T12's two Tri-ATHLETEs hang on a pallet by docks ([SunSpiral2012] s5.1.3). When a leg at a pallet corner is lifted, its deck twists
against the pallet and its corner drops more than springs under the feet of one rigid body can say. Here each dock is a
hinge with a spring: to the six unknowns of the pallet's pose comes one angle a dock. Solved is the balance of
generalised forces: the derivative of the springs' and the weight's energy by all unknowns is zero.

The feet's springs are those of `sag_model`, eqs 9-12, its smooth onset of the horizontal ones included; with rigid docks
both models agree.

Belief and truth have one form here. The twin's dock twists about the same axis as a linear spring with a linear damper, without
play or friction, so at rest its law is this one and only the constant is learned: what the docks gain on the twin is more than
they would on a robot. The twin's dock also bends, as a second linear spring, which this model leaves out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import root

from athlete_twin.errors import SagError
from athlete_twin.geometry.arrays import Joints, PerLeg, Points3, Vec3, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.leg_coms import leg_coms_in_hex
from athlete_twin.model.spec import LEGS
from planner.sag.docked_equations import balance, derivative
from planner.sag.firmness import Hinge, is_firm
from planner.sag.sag_model import AIRBORNE, DOWN, MAX_TILT, SOFT_CONTACT, FootSprings, levelling, solve_sag
from planner.sag.spring_equations import spring_forces

TWIST = np.array([0.0, 1.0, 0.0])
"""axis of a dock's twist in hex: across its plane, the Tri-ATHLETEs lying left and right of the pallet"""
BALANCED = 1e-6
"""generalised force that is left, over weight and size, at a solution"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Piece:
    """What hangs on one dock: a deck with its legs, in a stance, unsagged."""

    place_in_hex: Vec3
    """a point of the dock's axis [m]"""
    axis_in_hex: Vec3
    """the dock twists about it"""
    legs: tuple[int, ...]
    """indices of the legs it carries"""
    mass: float
    """[kg]"""
    com_in_hex: Vec3
    """[m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class DockedSag:
    """The sagged robot. Believe it only where `converged`."""

    unsagged_from_sagged: SE3
    """pose of the sagged pallet in the unsagged hex frame"""
    twists: np.ndarray
    """angle of each dock [rad]"""
    forces: Wheels
    """of the ground on the feet, in the unsagged hex frame, shape (6, 3) [N]"""
    status: str
    """as of `SagSolution`; that of the rigid robot where it does not stand. It also tips where a deck or the pallet turns by
    more than `MAX_TILT`, or over on a dock that does not hold it upright"""
    pieces: tuple[Piece, ...]

    @property
    def converged(self) -> bool:
        """Whether the solution may be believed."""
        return self.status == "converged"

    def unsagged_from_leg(self, leg: int) -> SE3:
        """Where what carries a leg has gone, the pallet or a deck twisted on its dock, in the unsagged hex frame."""
        for piece, twist in zip(self.pieces, self.twists, strict=True):
            if leg in piece.legs:
                return self.unsagged_from_sagged.compose(_hinge(piece, float(twist)))
        return self.unsagged_from_sagged

    def place(self, points_in_hex: Points3, legs: np.ndarray) -> np.ndarray:
        """Where points of the unsagged robot go, shape (n, 3), in the unsagged hex frame [m].

        Args:
            points_in_hex: unsagged, shape (n, 3) [m].
            legs: index of the leg whose deck each point belongs to, -1 for the pallet, shape (n,).
        """
        return _placed(points_in_hex, legs, self.unsagged_from_sagged, self.pieces, self.twists)


@dataclass(frozen=True, eq=False, kw_only=True)
class Docks:
    """The believed docks of a robot in a stance."""

    pieces: tuple[Piece, ...]
    twist_stiffness: float
    """of a dock [N m/rad]"""

    @staticmethod
    def of(kinematics: Kinematics, joints: Joints) -> Docks | None:
        """By the drawings; None for a robot whose chassis is believed rigid.

        Args:
            kinematics: of the robot.
            joints: of all legs, shape (6, dof) [rad].
        """
        twist = kinematics.spec.believed_dock_twist
        if not kinematics.spec.decks or twist is None:
            return None
        return Docks(pieces=docked_pieces(kinematics, joints), twist_stiffness=twist)


@dataclass(frozen=True, eq=False, kw_only=True)
class DockedLiftOff:
    """Where a foot's believed force reaches zero, its deck twisting."""

    lift: float
    """commanded height of the wheel over its planted place at which contact breaks [m]; NaN where nothing holds"""
    airborne: DockedSag
    """the robot standing on the others"""


def docked_pieces(kinematics: Kinematics, joints: Joints) -> tuple[Piece, ...]:
    """The pieces of a stance by the drawings; none for a robot without docks."""
    spec = kinematics.spec
    out = []
    for deck in spec.decks:
        coms = [leg_coms_in_hex(spec, leg, joints[leg : leg + 1])[0] for leg in deck.legs]
        mass = deck.mass + spec.leg_mass * len(deck.legs)
        com = (deck.mass * deck.part.centre + spec.leg_mass * np.sum(coms, axis=0)) / mass
        out.append(Piece(place_in_hex=deck.dock, axis_in_hex=TWIST, legs=deck.legs, mass=mass, com_in_hex=com))
    return tuple(out)


def solve_docked(
    feet_in_hex: Wheels,
    com_in_hex: Vec3,
    weight: float,
    *,
    pieces: tuple[Piece, ...],
    twist_stiffness: float,
    stiffness_z: PerLeg,
    lateral_ratio: float,
    lifts: PerLeg,
    gravity_in_hex: Vec3 = DOWN,
) -> DockedSag:
    """Sag with a spring under each foot and one in each dock.

    Args:
        feet_in_hex: where the springs hold the feet, unsagged, shape (6, 3) [m].
        com_in_hex: centre of mass of the whole robot, unsagged [m].
        weight: of the whole robot [N].
        pieces: what hangs on the docks; the rest is the pallet's.
        twist_stiffness: of a dock [N m/rad].
        stiffness_z: of the feet along gravity, shape (6,) [N/m].
        lateral_ratio: horizontal over vertical stiffness.
        lifts: of the unsagged feet above the ground, shape (6,) [m], as `solve_sag` takes them.
        gravity_in_hex: where gravity points.
    """
    if not (np.isfinite(twist_stiffness) and twist_stiffness > 0.0):
        raise SagError(f"twist stiffness is {twist_stiffness} N m/rad, must be positive; docks that do not twist are solve_sag's")
    # The rigid solution checks the arguments and is where the search begins.
    rigid = solve_sag(
        feet_in_hex, com_in_hex, weight, stiffness_z=stiffness_z, lateral_ratio=lateral_ratio, lifts=lifts,
        gravity_in_hex=gravity_in_hex,
    )  # fmt: skip
    level_from_hex, stiffness, above = levelling(gravity_in_hex), np.array(stiffness_z, dtype=float), np.array(lifts, dtype=float)
    down = np.asarray(gravity_in_hex, dtype=float) / np.linalg.norm(gravity_in_hex)
    hanging = GRAVITY * sum(piece.mass for piece in pieces)
    if hanging >= weight:
        raise SagError(f"the pieces on the docks weigh {hanging:.0f} N, the whole robot {weight:.0f} N")
    weights = np.array([*(GRAVITY * piece.mass for piece in pieces), weight - hanging])
    moments = sum((w * piece.com_in_hex for w, piece in zip(weights[:-1], pieces, strict=True)), np.zeros(3))
    coms = np.array([*(piece.com_in_hex for piece in pieces), (weight * com_in_hex - moments) / weights[-1]])
    owners, loads = np.array([*(piece.legs[0] for piece in pieces), -1]), weights[:, None] * down
    size = float(np.linalg.norm(feet_in_hex - feet_in_hex.mean(axis=0), axis=1).mean())

    hung = _hung(pieces)
    fixed = (
        np.array(feet_in_hex, dtype=float), hung[:LEGS], coms, hung[LEGS:], loads, np.array([p.place_in_hex for p in pieces], dtype=float),
        np.array([p.axis_in_hex for p in pieces], dtype=float), float(twist_stiffness), np.ascontiguousarray(level_from_hex), stiffness,
        float(lateral_ratio), above, SOFT_CONTACT, float(weight), size,
    )  # fmt: skip
    start = rigid.unsagged_from_sagged
    begin = np.concatenate([start.translation, start.rotvec(), np.zeros(len(pieces))])
    found = root(balance, begin, args=fixed, jac=derivative, method="hybr", options={"xtol": 1e-12})
    pose, twists = SE3.from_rotvec(found.x[3:6], found.x[:3]), found.x[6:]
    feet = _placed(feet_in_hex, np.arange(LEGS), pose, pieces, twists)
    forces, side, _, bears = spring_forces(
        (feet - feet_in_hex) @ level_from_hex.T, stiffness, lateral_ratio, above, True, SOFT_CONTACT
    )
    forces, along = forces @ level_from_hex, np.column_stack([side, side, np.where(bears, stiffness, 0.0)])
    bearing = level_from_hex.T @ (along[:, :, None] * level_from_hex)
    status = rigid.status
    if rigid.converged and not np.abs(found.fun).max() < BALANCED:
        status = "not_converged"
    elif rigid.converged and (forces != 0.0).any(axis=1).sum() < 3:
        status = "too_few_feet"
    elif rigid.converged:
        points = np.vstack([feet, _placed(coms, owners, pose, pieces, twists)])
        springs = np.concatenate([bearing, np.zeros((len(coms), 3, 3))])
        firm = is_firm(points, np.vstack([forces, loads]), springs, hung, _hinges(pose, pieces, twist_stiffness), size)
        turns = [pose.rotation, *(pose.compose(_hinge(p, float(t))).rotation for p, t in zip(pieces, twists, strict=True))]
        upright = min(float(down @ turn @ down) for turn in turns) >= np.cos(MAX_TILT)
        status = "converged" if upright and firm else "tips"
    return DockedSag(unsagged_from_sagged=pose, twists=twists, forces=forces, status=status, pieces=pieces)


def lift_off(
    feet_in_hex: Wheels,
    com_in_hex: Vec3,
    weight: float,
    leg: int,
    *,
    docks: Docks,
    springs: FootSprings,
    lifts: PerLeg | None = None,
    gravity_in_hex: Vec3 = DOWN,
) -> DockedLiftOff:
    """The commanded height of one wheel over its planted place at which contact breaks, and the robot then.

    As `compensate.lift_to_break_contact`, its own deck sinking with the leg; other arguments as of `solve_docked`. `lifts`
    is zero by default; the leg's own is what its planted place has.
    """
    if not 0 <= leg < LEGS:
        raise SagError(f"leg index {leg} is outside 0 to 5")
    planted = np.zeros(LEGS) if lifts is None else np.asarray(lifts, dtype=float)
    without = planted.copy()
    without[leg] = AIRBORNE
    sag = solve_docked(
        feet_in_hex, com_in_hex, weight, pieces=docks.pieces, twist_stiffness=docks.twist_stiffness,
        stiffness_z=springs.stiffness_z, lateral_ratio=springs.lateral_ratio, lifts=without, gravity_in_hex=gravity_in_hex,
    )  # fmt: skip
    if not sag.converged:
        return DockedLiftOff(lift=float("nan"), airborne=sag)
    up = -np.asarray(gravity_in_hex, dtype=float) / np.linalg.norm(gravity_in_hex)
    carried = sag.unsagged_from_leg(leg)
    # The foot at p + lift * up goes to T(p + lift * up); it breaks contact where that stands at its contact height.
    sunk = float(up @ (carried.apply(feet_in_hex[leg]) - feet_in_hex[leg]))
    return DockedLiftOff(lift=-(sunk + float(planted[leg])) / float(up @ carried.rotation @ up), airborne=sag)


def _placed(points: np.ndarray, legs: np.ndarray, pose: SE3, pieces: tuple[Piece, ...], twists: np.ndarray) -> np.ndarray:
    """Unsagged points (n, 3), each of a leg's deck or (-1) of the pallet, turned by the docks and moved by the pose."""
    out = np.array(points, dtype=float)
    for piece, twist in zip(pieces, twists, strict=True):
        turned = np.isin(legs, piece.legs)
        out[turned] = _hinge(piece, float(twist)).apply(out[turned])
    return pose.apply(out)


def _hung(pieces: tuple[Piece, ...]) -> np.ndarray:
    """Index of the piece that each foot, each piece's centre of mass and the pallet's (-1) belongs to, shape (7 + n,)."""
    hung = np.full(LEGS + len(pieces) + 1, -1)
    for number, piece in enumerate(pieces):
        hung[[*piece.legs, LEGS + number]] = number
    return hung


def _hinges(pose: SE3, pieces: tuple[Piece, ...], stiffness: float) -> tuple[Hinge, ...]:
    """The docks of a robot that stands at a pose."""
    places = ((pose.rotate(p.axis_in_hex), pose.apply(p.place_in_hex)) for p in pieces)
    return tuple(Hinge(axis=axis, through=through, stiffness=stiffness) for axis, through in places)


def _hinge(piece: Piece, twist: float) -> SE3:
    """Turns points of a piece about its dock's axis."""
    turn = SE3.from_rotvec(twist * piece.axis_in_hex, np.zeros(3))
    return SE3(turn.rotation, piece.place_in_hex - turn.rotation @ piece.place_in_hex)
