"""Closed-form inverse kinematics of a leg: axle positions to joint angles, the last link along a given direction.

The yaw turns the leg's plane through the wheel; in the plane the last link's direction is given (near vertical when it
bears load, [SunSpiral2012] s7.1), so that thigh and shank remain: a two-link arm, knee up. The roll joints stay at zero.
T12 has one pitch joint more: its first thigh follows the drawings' rule, steeper the nearer the wheel is to the hip, and
the second one is the arm's first link.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.arrays import Joints, PerLegFlag, Points3, Vec3, Wheels
from athlete_twin.model.spec import LEGS, RobotSpec

DOWN = np.array([0.0, 0.0, -1.0])
THIGH_MARGIN = float(np.deg2rad(2.0))
"""kept from the first thigh's limit [rad]"""
STRETCH = 0.985
"""of its length that the leg behind the first thigh is stretched at most"""
MAX_THIGH = float(np.deg2rad(60.0))
"""lowest first thigh [rad]"""
STRAIGHT_MARGIN = 0.9995
"""cosine beyond which the knee counts as straight: at full stretch the joint speeds of a straight move diverge"""


def leg_ik(
    spec: RobotSpec,
    leg: int,
    wheels_in_hex: Points3,
    *,
    last_link_in_hex: Vec3 | Points3 = DOWN,
    hip_pitch: float | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles that put the axle of one leg at each of n points, shape (n, dof) [rad], and which of them exist (n,).

    Args:
        spec: the drawings.
        leg: index 0 to 5.
        wheels_in_hex: wanted axle centres, shape (n, 3) [m].
        last_link_in_hex: direction the last link shall point to, projected into the leg's plane; down in world for a
            chassis that is not level. One for all points, (3,), or one for each, (n, 3).
        hip_pitch: of a leg with two thighs [rad]; by the drawings' rule when None.

    Rows that do not exist (out of reach, or beyond a joint's limit) are NaN.
    """
    points = np.asarray(wheels_in_hex, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise KinematicsError(f"wheel positions have shape {points.shape}, need (n, 3)")
    d = points - spec.hips_in_hex[leg]
    return _solve(spec, d, spec.hip_azimuths[leg], np.asarray(last_link_in_hex).T, hip_pitch)


def all_legs_ik(
    spec: RobotSpec, wheels_in_hex: Wheels, *, last_link_in_hex: Vec3 | Wheels = DOWN, hip_pitch: float | None = None
) -> tuple[Joints, PerLegFlag]:
    """Joint angles (6, dof) [rad] that put all six axles at the given points (6, 3), and which legs reach theirs (6,).

    The last links' direction is one for all legs, (3,), or one for each, (6, 3). One evaluation for the six of them:
    an executive that moves its chassis asks for this at every control tick.
    """
    last_links = np.broadcast_to(np.asarray(last_link_in_hex, dtype=float), (LEGS, 3)).T
    return _solve(spec, np.asarray(wheels_in_hex) - spec.hips_in_hex, spec.hip_azimuths, last_links, hip_pitch)


def _solve(
    spec: RobotSpec, d: np.ndarray, azimuth: float | np.ndarray, last_link: np.ndarray, hip_pitch: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Angles (n, dof) of n wheels, each at `d` (n, 3) [m] from the hip of its leg, and which exist (n,).

    Args:
        spec: the drawings.
        d: wheel less hip, in hex [m].
        azimuth: of the hip, one or (n,) [rad].
        last_link: its components in hex, each one or (n,).
        hip_pitch: of a leg with two thighs [rad]; by the drawings' rule when None.
    """
    pitch = [i for i, j in enumerate(spec.joints) if j.axis[1] == 1.0]
    c, s = np.cos(azimuth), np.sin(azimuth)
    x, y = c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]
    yaw = np.arctan2(y, x)
    hip = spec.joints[pitch[0]].offset
    out, down = np.hypot(x, y) - hip[0], -(d[:, 2] - hip[2])

    reach = out.copy()

    heading = azimuth + yaw
    radial = np.cos(heading) * last_link[0] + np.sin(heading) * last_link[1]
    last_angle = np.arctan2(-last_link[2], radial)
    last = float(spec.wheel.offset[0])
    out, down = out - last * np.cos(last_angle), down - last * np.sin(last_angle)

    q = np.zeros((len(d), spec.dof))
    q[:, 0] = yaw
    base = np.zeros(len(d))
    upper_length = float(spec.joints[pitch[1]].offset[0])
    if len(pitch) == 4:
        by_rule = hip_pitch is None
        first = _first_thigh(spec, reach, out, down, upper_length, pitch) if by_rule else np.full(len(d), hip_pitch)
        base += first
        out, down = out - upper_length * np.cos(first), down - upper_length * np.sin(first)
        q[:, pitch[0]] = first
        upper_length = float(spec.joints[pitch[2]].offset[0])
    lower_length = float(sum(j.offset[0] for j in spec.joints[pitch[-2] + 1 :]))
    cosine = (out**2 + down**2 - upper_length**2 - lower_length**2) / (2 * upper_length * lower_length)
    ok = np.abs(cosine) <= STRAIGHT_MARGIN
    knee = np.arccos(np.clip(cosine, -1.0, 1.0))
    thigh = np.arctan2(down, out) - np.arctan2(lower_length * np.sin(knee), upper_length + lower_length * np.cos(knee))
    q[:, pitch[-3]] = thigh - base
    q[:, pitch[-2]] = knee
    q[:, pitch[-1]] = last_angle - thigh - knee
    q = np.where(np.abs(q) > np.pi, (q + np.pi) % (2 * np.pi) - np.pi, q)
    ok &= ((q >= spec.lower) & (q <= spec.upper)).all(axis=1) & np.isfinite(q).all(axis=1)
    q[~ok] = np.nan
    return q, ok


def _first_thigh(
    spec: RobotSpec, reach: np.ndarray, out: np.ndarray, down: np.ndarray, thigh: float, pitch: list[int]
) -> np.ndarray:
    """Hip pitch of a leg with two thighs [rad]: by the drawings' rule, or as much lower as the rest of the leg needs.

    Args:
        spec: the drawings.
        reach: of the wheel outside the hip-pitch axis [m].
        out: of the ankle outside that axis [m].
        down: of the ankle below it [m].
        thigh: length of the first thigh [m].
        pitch: indices of the pitch joints.
    """
    if spec.hip_pitch_rule is None:
        raise KinematicsError(f"{spec.name} has two thighs: its drawings need a rule for the hip pitch")
    at_axis, slope = spec.hip_pitch_rule
    wanted = at_axis + slope * reach
    rest = STRETCH * sum(float(j.offset[0]) for j in spec.joints[pitch[2] :])
    distance = np.maximum(np.hypot(out, down), 1e-9)
    # The thigh's end must be within `rest` of the ankle: by the law of cosines, at most this far from its direction.
    cosine = (thigh**2 + distance**2 - rest**2) / (2 * thigh * distance)
    lowest = np.arctan2(down, out) - np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.asarray(np.clip(np.maximum(wanted, lowest), spec.joints[1].lower + THIGH_MARGIN, MAX_THIGH))
