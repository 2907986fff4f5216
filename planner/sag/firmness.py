"""Whether a balance of hinged pieces on springs is a stable one: every small motion costs energy.

A small motion shifts the robot by t, turns it by w about a point and twists each dock by s about its axis a through c. A point
at q, r from that point and p from c, goes by t + w x r + s a x p, and to second order by half of w x (w x r), s w x (a x p)
and half of s s a x (a x p) besides. Springs are strained by the first; the second works against the force on the point. As
`spring_equations` does for one rigid body, the onset of the horizontal springs is taken as it stands.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.geometry.arrays import Mat3, Points3, Vec3


@dataclass(frozen=True, eq=False, kw_only=True)
class Hinge:
    """A dock as the robot stands."""

    axis: Vec3
    through: Vec3
    """[m]"""
    stiffness: float
    """[N m/rad]"""


def is_firm(
    points: Points3, forces: Points3, springs: np.ndarray, hung: np.ndarray, hinges: tuple[Hinge, ...], size: float
) -> bool:
    """Whether the second derivative of the energy by all motions is positive definite.

    Args:
        points: feet and centres of mass as the robot stands, shape (n, 3) [m].
        forces: on them, shape (n, 3) [N].
        springs: stiffness at each point, zero where no spring bears, shape (n, 3, 3) [N/m].
        hung: index of the hinge that each point hangs on, -1 for none, shape (n,).
        hinges: the docks.
        size: of the robot, by which turns are compared with shifts [m].
    """
    unknowns = 6 + len(hinges)
    energy = np.zeros((unknowns, unknowns))
    about = points.mean(axis=0)
    for point, force, spring, number in zip(points, forces, springs, hung, strict=True):
        r = point - about
        motion = np.zeros((3, unknowns))
        motion[:, :3], motion[:, 3:6] = np.eye(3), -_cross_matrix(r)
        energy[3:6, 3:6] += float(force @ r) * np.eye(3) - 0.5 * (np.outer(force, r) + np.outer(r, force))
        if number >= 0:
            place, axis = 6 + number, hinges[number].axis
            swung = _cross_matrix(axis) @ (point - hinges[number].through)
            motion[:, place] = swung
            coupled = _cross_matrix(swung) @ force
            energy[3:6, place] -= coupled
            energy[place, 3:6] -= coupled
            energy[place, place] -= float(force @ (_cross_matrix(axis) @ swung))
        energy += motion.T @ spring @ motion
    for number, hinge in enumerate(hinges):
        energy[6 + number, 6 + number] += hinge.stiffness
    scale = np.append(np.ones(3), np.full(unknowns - 3, 1.0 / size))
    return bool(np.linalg.eigvalsh(scale[:, None] * energy * scale)[0] > 0.0)


def _cross_matrix(v: Vec3) -> Mat3:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
