"""Text of a robot's URDF, generated from the drawings: the one description that Bullet, Pinocchio and the renderer share.

Base link `hex`. T12's decks hang on two dock joints each (`dock_left_bend` about x, `dock_left_twist` about y), drawn at
0. Leg links and joints share their names, `leg3_knee_pitch`; `wheel3` is continuous about y. Zero pose: legs straight out.
Collision solids are boxes and cylinders (Pinocchio refuses capsules); visuals are the meshes beside the file. Every
element has its own line, since Bullet's reader gives up on lines beyond about 1 kB.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from athlete_twin.geometry.arrays import Vec3
from athlete_twin.model.link_solids import DOCK_MASS, Solid, inertias, solids
from athlete_twin.model.spec import LEGS, RobotSpec

DOCK_LIMIT = 0.2
"""of the dock joints [rad]; EST, far beyond what a stiff dock bends"""
DOCK_EFFORT = 1.0e5
"""of the dock joints [N m]; EST, beyond what the robot's weight can ask of them"""
DOCK_SPEED = 1.0
"""of the dock joints [rad/s]"""
WHEEL_EFFORT = 500.0
"""of the wheel drives [N m]; EST, walks with the wheels braked"""
WHEEL_SPEED = 3.5
"""of the wheel drives [rad/s]; EST, 3 km/h on SDM-B"""

Visuals = Mapping[str, Sequence[tuple[str, str]]]
"""by kind of link, or by a link's own name: mesh file beside the URDF, material"""
Materials = Mapping[str, tuple[float, float, float]]
"""red, green, blue in 0..1 by name"""

ZERO = (0.0, 0.0, 0.0)
X_UNIT = (1.0, 0.0, 0.0)
Y_UNIT = (0.0, 1.0, 0.0)


def urdf_text(spec: RobotSpec, *, visuals: Visuals, materials: Materials) -> str:
    """The whole URDF of a robot."""
    shapes, moments = solids(spec), inertias(spec)
    lines = [
        '<?xml version="1.0"?>',
        f"<!-- {spec.title}. Generated from spec.toml by scripts/build_assets.py: do not edit. -->",
    ]
    lines += [
        "<!-- Masses and centres of mass as drawn. Inertias of the links' primitive solids, at least 0.05 kg m2 an axis, so that",
        "     links of zero length (knee and ankle blocks, docks) stay well conditioned in simulation. -->",
        f'<robot name="{spec.name}">',
    ]
    for name, colour in materials.items():
        lines.append(f'  <material name="{name}"><color rgba="{_numbers((*colour, 1.0))}"/></material>')

    def link(name: str, kind: str, mass: float, com: Vec3) -> None:
        own = visuals.get(name, ()) if name != kind else ()
        lines.extend(_link(name, mass, com, moments[kind], shapes[kind], (*visuals.get(kind, ()), *own)))

    link("hex", "hex", spec.body_mass, spec.body_com)
    for deck in spec.decks:
        dock = deck.name.replace("deck", "dock")
        com = deck.part.centre - deck.dock
        link(dock, dock, DOCK_MASS, com)
        lines.extend(_joint(f"{dock}_bend", "revolute", "hex", dock, deck.dock, X_UNIT, _dock_limit()))
        link(deck.name, deck.name, deck.mass - DOCK_MASS, com)
        lines.extend(_joint(f"{dock}_twist", "revolute", dock, deck.name, np.zeros(3), Y_UNIT, _dock_limit()))
    for leg in range(LEGS):
        parent, origin = hip_mount(spec, leg)
        rpy: tuple[float, float, float] = (0.0, 0.0, float(spec.hip_azimuths[leg]))
        for joint in spec.joints:
            name = f"leg{leg + 1}_{joint.name}"
            link(name, joint.name, joint.link_mass, joint.link_com)
            limit = _limit(joint.torque, spec.speed_unloaded, joint.lower, joint.upper)
            lines.extend(_joint(name, "revolute", parent, name, origin + joint.offset, joint.axis, limit, rpy=rpy))
            parent, origin, rpy = name, np.zeros(3), ZERO
        name = f"wheel{leg + 1}"
        link(name, "wheel", spec.wheel.mass, np.zeros(3))
        lines.extend(
            _joint(name, "continuous", parent, name, spec.wheel.offset, Y_UNIT, _limit(WHEEL_EFFORT, WHEEL_SPEED))
        )
    lines.append("</robot>")
    return "\n".join(lines) + "\n"


def hip_mount(spec: RobotSpec, leg: int) -> tuple[str, Vec3]:
    """The link that carries a leg (0 to 5), and the hip's place in that link's frame at rest [m]."""
    for deck in spec.decks:
        if leg in deck.legs:
            return deck.name, spec.hips_in_hex[leg] - deck.dock
    return "hex", np.array(spec.hips_in_hex[leg])


def _link(
    name: str, mass: float, com: Vec3, moments: Vec3, shapes: Sequence[Solid], meshes: Sequence[tuple[str, str]]
) -> list[str]:
    ixx, iyy, izz = (_number(m) for m in moments)
    out = [
        f'  <link name="{name}">',
        "    <inertial>",
        f'      <origin xyz="{_numbers(com)}" rpy="0 0 0"/>',
        f'      <mass value="{_number(mass)}"/>',
        f'      <inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/>',
        "    </inertial>",
    ]
    for file, material in meshes:
        out += [
            "    <visual>",
            '      <origin xyz="0 0 0" rpy="0 0 0"/>',
            f'      <geometry><mesh filename="{file}"/></geometry>',
            f'      <material name="{material}"/>',
            "    </visual>",
        ]
    for solid in shapes:
        out += [
            "    <collision>",
            f'      <origin xyz="{_numbers(solid.xyz)}" rpy="{_numbers(solid.rpy)}"/>',
            f"      <geometry>{_geometry(solid)}</geometry>",
            "    </collision>",
        ]
    return [*out, "  </link>"]


def _geometry(solid: Solid) -> str:
    if solid.shape == "box":
        return f'<box size="{_numbers(solid.size)}"/>'
    if solid.shape == "cylinder":
        return f'<cylinder radius="{_number(solid.size[0])}" length="{_number(solid.size[1])}"/>'
    return f'<sphere radius="{_number(solid.size[0])}"/>'


def _joint(
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: Vec3,
    axis: Sequence[float] | Vec3,
    limit: str,
    *,
    rpy: tuple[float, float, float] = ZERO,
) -> list[str]:
    return [
        f'  <joint name="{name}" type="{kind}">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{child}"/>',
        f'    <origin xyz="{_numbers(xyz)}" rpy="{_numbers(rpy)}"/>',
        f'    <axis xyz="{_numbers(axis)}"/>',
        f"    {limit}",
        "  </joint>",
    ]


def _limit(effort: float, speed: float, lower: float | None = None, upper: float | None = None) -> str:
    span = "" if lower is None or upper is None else f' lower="{_number(lower)}" upper="{_number(upper)}"'
    return f'<limit{span} effort="{_number(effort)}" velocity="{_number(speed)}"/>'


def _dock_limit() -> str:
    return _limit(DOCK_EFFORT, DOCK_SPEED, -DOCK_LIMIT, DOCK_LIMIT)


def _number(value: float) -> str:
    return f"{round(float(value), 12) + 0.0:.12g}"


def _numbers(values: Sequence[float] | Vec3) -> str:
    return " ".join(_number(v) for v in values)
