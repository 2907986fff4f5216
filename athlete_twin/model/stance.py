"""Regular stances: all wheels on a circle about the chassis, last links vertical."""

from __future__ import annotations

import numpy as np

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.arrays import Joints, Wheels
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.spec import RobotSpec


def stance_wheels_in_hex(spec: RobotSpec, foot_radius: float | None = None, chassis_height: float | None = None) -> Wheels:
    """Axle centres of the regular stance on flat ground, unloaded tyres, shape (6, 3) [m].

    Args:
        spec: the drawings.
        foot_radius: of the axles from the hex's z axis [m]; the drawings' by default.
        chassis_height: of the hex origin above the ground [m]; the drawings' by default.
    """
    radius = spec.foot_radius if foot_radius is None else foot_radius
    height = spec.chassis_height if chassis_height is None else chassis_height
    angles = spec.foot_azimuths
    z = np.full(6, spec.wheel.radius - height)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), z])


def regular_stance(spec: RobotSpec, foot_radius: float | None = None, chassis_height: float | None = None) -> Joints:
    """Joint angles of the regular stance, shape (6, dof) [rad]."""
    wheels = stance_wheels_in_hex(spec, foot_radius, chassis_height)
    joints, ok = all_legs_ik(spec, wheels)
    if not ok.all():
        radius = spec.foot_radius if foot_radius is None else foot_radius
        raise KinematicsError(
            f"{spec.name} cannot stand with foot radius {radius} m at height {-wheels[0, 2] + spec.wheel.radius:.3f} m; "
            f"the drawings' {spec.foot_radius} m at {spec.chassis_height} m works"
        )
    return joints
