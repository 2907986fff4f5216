"""The ground round each planted wheel laid flat at its contact's height: the method of 2008.

[SunSpiral2012] s4.3 flattened "part of the image mesh used by the collision checker around the location of the foot". Here
the mesh is the depth image: what was measured in the upright column over a wheel's contact is put back along its ray onto
the contact's level where the ray meets it inside the column, and is unknown where it does not. After that every point inside
the radius has exactly the contact's height.

Its two limits are the paper's: what leg is seen outside the columns stays as terrain, a raised leg too; and a rock beside the
wheel is flattened away.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.arrays import DepthMap, Mask, Points3, Vec3
from planner.perception.stereo import DepthImage


def flattened(depth: DepthImage, up_in_hex: Vec3, ground_in_hex: Points3, *, radius: float) -> tuple[DepthMap, Mask]:
    """The depth with the columns round the contacts laid flat, and the pixels that this touched.

    Where columns overlap the nearest contact counts.

    Args:
        depth: as matched.
        up_in_hex: direction against gravity.
        ground_in_hex: contacts of the planted wheels, shape (n, 3) [m].
        radius: of a column [m].
    """
    out, mask = depth.depth.copy(), np.zeros(depth.depth.shape, dtype=bool)
    if len(ground_in_hex) == 0:
        return out, mask
    up = np.asarray(up_in_hex) / np.linalg.norm(up_in_hex)
    known = np.isfinite(depth.depth)
    hex_from_camera = depth.camera.hex_from_camera
    rays = hex_from_camera.rotate(depth.eye.rays()[known])
    origin = hex_from_camera.translation
    points = origin + rays * depth.depth[known][:, None]
    contact, away = _nearest(points, ground_in_hex, up)
    inside = away < radius
    rays, contact = rays[inside], contact[inside]
    slope = rays @ up
    with np.errstate(divide="ignore", invalid="ignore"):
        level = ((contact - origin) @ up) / slope
    met = origin + rays * level[:, None]
    stays = (level > 0.0) & np.isfinite(level)
    stays &= _horizontal(np.where(stays[:, None], met - contact, np.inf), up) < radius
    rows, columns = np.nonzero(known)
    at = rows[inside], columns[inside]
    out[at] = np.where(stays, level, np.nan)
    mask[at] = True
    return out, mask


def _nearest(points: np.ndarray, contacts: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The contact nearest to each point seen along gravity, shape (n, 3), and how far it is, shape (n,) [m]."""
    away = np.stack([_horizontal(points - c, up) for c in contacts])
    which = np.argmin(away, axis=0)
    return np.asarray(contacts)[which], away[which, np.arange(len(points))]


def _horizontal(vectors: np.ndarray, up: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        flat = vectors - (vectors @ up)[:, None] * up
    return np.asarray(np.where(np.isfinite(vectors).all(axis=1), np.linalg.norm(flat, axis=1), np.inf))
