"""Outer shapes of the links: what `spec.toml` leaves open and the URDF's solids and meshes need. All EST, from photographs.

The kinematics, masses and limits are in the drawings; nothing here changes where a wheel is. One rule of construction
runs through every leg: a pitch joint is a drum along y held between two cheek plates of the link before or behind it, and
nothing of the next-but-one link begins nearer to the axis than `clearance` outside the cheeks' rim. So links that are not
adjacent cannot overlap however the joint between them is bent, until the tubes themselves meet.
"""

from __future__ import annotations

from dataclasses import dataclass

from athlete_twin.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Proportions:
    """Radii, widths and lengths of a leg's parts [m]; x runs along the leg, y along the pitch axes."""

    hip_drum_radius: float
    """of the hip-yaw drum about z; at most 0.10 on SDM-B, whose HazCams sit 0.149 from the axis"""
    hip_drum_z: tuple[float, float]
    """bottom and top of the hip-yaw drum in the leg's frame"""
    hip_arm_width: float
    """of the bracket between hip yaw and hip pitch, along y"""
    hip_arm_height: float
    """of the bracket, along z"""
    hip_rim: float
    """radius of the cheeks at hip pitch"""
    thigh_rim: float
    """radius of the cheeks at thigh pitch, where there is one"""
    knee_rim: float
    """radius of the cheeks at knee pitch"""
    ankle_rim: float
    """radius of the cheeks at ankle pitch"""
    cheek_inner: float
    """|y| of the cheeks' inner faces"""
    cheek_outer: float
    """|y| of the cheeks' outer faces"""
    thigh_radius: float
    shank_radius: float
    """of the tubes"""
    clearance: float
    """between a cheek's rim and whatever else begins along the leg"""
    roll_radius: float
    """of the roll actuators' stubs along x at knee and ankle"""
    crown_depth: float
    """of the fork's crown along x"""
    crown_gap: float
    """between the tyre's tread and the fork's crown"""
    tine_gap: float
    """between the tyre's side and a tine"""
    tine_thickness: float
    """of a tine along y"""
    tine_width: float
    """of a tine along z"""


_PROPORTIONS = {
    "sdm_b": Proportions(
        hip_drum_radius=0.095,
        hip_drum_z=(-0.400, 0.010),
        hip_arm_width=0.130,
        hip_arm_height=0.130,
        hip_rim=0.095,
        thigh_rim=0.095,
        knee_rim=0.088,
        ankle_rim=0.078,
        cheek_inner=0.080,
        cheek_outer=0.100,
        thigh_radius=0.062,
        shank_radius=0.052,
        clearance=0.012,
        roll_radius=0.068,
        crown_depth=0.060,
        crown_gap=0.025,
        tine_gap=0.018,
        tine_thickness=0.030,
        tine_width=0.090,
    ),
    "t12": Proportions(
        hip_drum_radius=0.100,
        hip_drum_z=(-0.110, 0.390),
        hip_arm_width=0.170,
        hip_arm_height=0.170,
        hip_rim=0.120,
        thigh_rim=0.115,
        knee_rim=0.108,
        ankle_rim=0.096,
        cheek_inner=0.105,
        cheek_outer=0.130,
        thigh_radius=0.080,
        shank_radius=0.066,
        clearance=0.015,
        roll_radius=0.085,
        crown_depth=0.080,
        crown_gap=0.035,
        tine_gap=0.025,
        tine_thickness=0.040,
        tine_width=0.120,
    ),
}


def proportions(robot: str) -> Proportions:
    """Outer shapes of a robot by its name, such as "sdm_b"."""
    if robot not in _PROPORTIONS:
        raise ConfigError(f"robot {robot!r} has no proportions; robots that have: {', '.join(sorted(_PROPORTIONS))}")
    return _PROPORTIONS[robot]
