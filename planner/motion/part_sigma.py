"""How far two parts of the drawn robot may be from where the drawings put them, relative to each other.

Model: every joint between two parts is off by a small angle of its own, independent of the others'. It moves a point of the part
it carries by the angle times the point's distance from its axis; the moves of all joints add up as squares, and that of the
part's worst point counts, so that what comes out bounds the sigma along any one direction. Distances are those of one stance.
"""

from __future__ import annotations

from typing import Any

import coal
import numpy as np
import pinocchio as pin
from jaxtyping import Float

RIM_POINTS = 16
"""on each rim of a cylinder: chords this short leave out 1 % of its radius"""


def relative_sigmas(
    model: Any, geometry: Any, q: Float[np.ndarray, " nq"], joint_sigmas: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, "n n"]:
    """One sigma of the place of each solid relative to each other one, shape (n, n) [m].

    Args:
        model: pinocchio's, all joints with one degree of freedom.
        geometry: its solids, boxes and cylinders.
        q: the stance whose distances from the axes are taken.
        joint_sigmas: of each joint's angle, in the order of the model's velocities, shape (nv,) [rad].
    """
    scratch, state = model.createData(), geometry.createData()
    columns = pin.computeJointJacobians(model, scratch, q)
    pin.updateGeometryPlacements(model, scratch, geometry, state)
    chains = [_chain(model, solid.parentJoint) for solid in geometry.geometryObjects]
    longest = max(len(chain) for chain in chains)
    joint_at = np.array([chain + [-1] * (longest - len(chain)) for chain in chains])
    behind = np.zeros((len(chains), longest + 1))
    for i, (chain, solid) in enumerate(zip(chains, geometry.geometryObjects, strict=True)):
        placed = state.oMg[i]
        points = _extreme_points(solid.geometry) @ placed.rotation.T + placed.translation
        axes = [model.joints[joint].idx_v for joint in chain]
        turning, moving = columns[3:, axes].T, columns[:3, axes].T
        per_rad = moving[:, None] + np.cross(turning[:, None], points[None])
        squares = (joint_sigmas[axes, None] * np.linalg.norm(per_rad, axis=-1)) ** 2
        # Of the joints from a place along the chain on, summed for each point; then the worst point.
        behind[i, : len(chain)] = np.cumsum(squares[::-1], axis=0)[::-1].max(axis=1)
    same = (joint_at[:, None] == joint_at[None]) & (joint_at[:, None] >= 0)
    shared = np.cumprod(same, axis=-1).sum(axis=-1)
    rows = np.arange(len(chains))
    return np.asarray(np.sqrt(behind[rows[:, None], shared] + behind[rows[None], shared]))


def _chain(model: Any, joint: int) -> list[int]:
    """Joints from the root to a solid's own."""
    return [int(k) for k in model.supports[joint] if k > 0]


def _extreme_points(shape: Any) -> np.ndarray:
    """Points whose hull is the solid, in its frame, shape (n, 3) [m]; a point's way is convex in its place, so no other is worse."""
    if isinstance(shape, coal.Box):
        return np.stack(np.meshgrid(*([-h, h] for h in shape.halfSide), indexing="ij"), axis=-1).reshape(-1, 3)
    angle = np.linspace(0.0, 2 * np.pi, RIM_POINTS, endpoint=False)
    rim = np.column_stack([shape.radius * np.cos(angle), shape.radius * np.sin(angle), np.zeros(RIM_POINTS)])
    return np.concatenate([rim + [0.0, 0.0, end * shape.halfLength] for end in (-1.0, 1.0)])
