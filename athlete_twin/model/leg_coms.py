"""Centre of mass of one leg in many configurations at once, by the drawings.

The same as Pinocchio's `Kinematics.com_in_hex`, which takes one configuration of the whole robot.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from athlete_twin.model.spec import RobotSpec


def leg_coms_in_hex(spec: RobotSpec, leg: int, q: np.ndarray) -> np.ndarray:
    """Centre of mass of one leg with its wheel in each of n configurations, shape (n, 3), in hex [m].

    Args:
        spec: the drawings.
        leg: index 0 to 5.
        q: shape (n, dof) [rad]; a row that is not finite gives NaN.
    """
    angles = np.where(np.isfinite(q), q, 0.0)
    turn = Rotation.from_euler("z", np.full((len(q), 1), spec.hip_azimuths[leg]))
    at = np.broadcast_to(spec.hips_in_hex[leg], (len(q), 3))
    moment, mass = np.zeros((len(q), 3)), 0.0
    for place, joint in enumerate(spec.joints):
        at = at + turn.apply(np.array(joint.offset))
        turn = turn * Rotation.from_rotvec(angles[:, place, None] * joint.axis)
        moment += joint.link_mass * (at + turn.apply(np.array(joint.link_com)))
        mass += joint.link_mass
    moment += spec.wheel.mass * (at + turn.apply(np.array(spec.wheel.offset)))
    out = moment / (mass + spec.wheel.mass)
    return np.where(np.isfinite(q).all(axis=1)[:, None], out, np.nan)
