"""What the legs and wheels look like: meshes by kind of link and material, one set for all six legs.

A pitch joint is a dark actuator drum between two cheek plates. Who owns the drum: the hip's belongs to the hip-yaw
bracket, the others to the link behind the joint. Nothing here touches kinematics or collision.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.model.link_solids import link_end, rim_at
from athlete_twin.model.proportions import Proportions, proportions
from athlete_twin.model.solids import Mesh, box, cylinder, join, lathe, prism
from athlete_twin.model.spec import RobotSpec, WheelSpec

Look = dict[str, Mesh]
"""by material"""

DRUM = 0.93
"""radius of an actuator drum over its cheeks'"""
LUGS = 16
"""of a row around a tyre; two rows"""
LUG_HEIGHT = 0.018
"""of a tread lug [m]"""
TYRE_SEGMENTS = 28
HUB_SEGMENTS = 16


def leg_looks(spec: RobotSpec) -> dict[str, Look]:
    """Meshes by kind of link of a leg, the wheel included."""
    shape = proportions(spec.name)
    out: dict[str, Look] = {}
    for index, joint in enumerate(spec.joints):
        if joint.name == "hip_yaw":
            out[joint.name] = _hip(spec, shape)
        elif joint.name in ("knee_pitch", "ankle_pitch"):
            out[joint.name] = _block(shape, rim_at(shape, joint.name))
        elif joint.name == "ankle_roll":
            out[joint.name] = _fork(spec.wheel, shape)
        else:
            out[joint.name] = _tube(spec, shape, index)
    out["wheel"] = _wheel(spec.wheel)
    return out


def _hip(spec: RobotSpec, shape: Proportions) -> Look:
    low, high = shape.hip_drum_z
    end = link_end(spec, 0)
    x, z = float(end[0]), float(end[2])
    radius = shape.hip_drum_radius
    arm = box(
        (x - 0.4 * shape.hip_rim, shape.hip_arm_width, shape.hip_arm_height), (0.5 * (x - 0.4 * shape.hip_rim), 0.0, z)
    )
    ribs = [
        box(
            (0.5 * x, 0.02, 0.4 * shape.hip_arm_height),
            (0.3 * x, side * 0.35 * shape.hip_arm_width, z + 0.6 * shape.hip_arm_height),
        )
        for side in (1, -1)
    ]
    cap = cylinder(0.6 * radius, high - 0.02, high, axis="z")
    drum = cylinder(radius, low + 0.02, high - 0.02, axis="z", segments=16)
    return {
        "aluminium": join(arm, *ribs, cylinder(0.97 * radius, low, low + 0.02, axis="z", segments=16), cap),
        "actuator": join(drum, _drum(shape, shape.hip_rim).shifted(x, 0.0, z)),
    }


def _block(shape: Proportions, rim: float) -> Look:
    stub = cylinder(shape.roll_radius, 0.3 * rim, rim + 1.8 * shape.clearance, axis="x")
    collar = cylinder(1.02 * shape.roll_radius, rim + 0.2 * shape.clearance, rim + shape.clearance, axis="x")
    return {"actuator": join(_drum(shape, rim), stub), "aluminium": collar}


def _tube(spec: RobotSpec, shape: Proportions, index: int) -> Look:
    name, after = spec.joints[index].name, spec.joints[index + 1].name
    length = float(link_end(spec, index)[0])
    far_rim = rim_at(shape, after)
    far = length - far_rim - _yoke_depth(shape, far_rim)
    parts = [_yoke(shape, far_rim, length, -1.0)]
    look: Look = {}
    if name == "knee_roll":
        start = shape.knee_rim + 2 * shape.clearance
        radius = shape.shank_radius
        parts.append(cylinder(shape.roll_radius, start, start + 0.035, axis="x"))
    else:
        rim = rim_at(shape, name)
        radius = shape.thigh_radius
        if name == "hip_pitch":
            start = rim + _yoke_depth(shape, rim)
            parts.append(_yoke(shape, rim, 0.0, 1.0))
        else:
            start = 0.6 * rim
            look["actuator"] = _drum(shape, rim)
            parts.append(cylinder(1.12 * radius, start, rim + 0.06, axis="x"))
    parts.append(cylinder(radius, start, far, axis="x", segments=16))
    middle = 0.5 * (start + far)
    band = min(0.05, 0.2 * (far - start))
    parts += [cylinder(1.07 * radius, c - 0.2 * band, c + 0.2 * band, axis="x") for c in (start + band, far - band)]
    if name != "knee_roll":
        # Cable tray along the tube.
        parts.append(box((0.7 * (far - start), 0.5 * radius, 0.03), (middle, 0.0, radius)))
    look["aluminium"] = join(*parts)
    return look


def _fork(wheel: WheelSpec, shape: Proportions) -> Look:
    axle = float(wheel.offset[0])
    neck = shape.ankle_rim + 2 * shape.clearance
    crown_end = axle - wheel.radius - shape.crown_gap
    crown_start = crown_end - shape.crown_depth
    tine = 0.5 * wheel.width + shape.tine_gap + 0.5 * shape.tine_thickness
    span = 2 * tine + shape.tine_thickness
    top = 0.5 * shape.tine_width
    parts = [
        cylinder(shape.roll_radius, neck, neck + 0.025, axis="x"),
        cylinder(shape.shank_radius, neck, crown_start + 0.01, axis="x"),
        box((shape.crown_depth, span, shape.tine_width), (crown_end - 0.5 * shape.crown_depth, 0.0, 0.0)),
    ]
    drives = []
    for side in (1.0, -1.0):
        inner, outer = side * (tine - 0.5 * shape.tine_thickness), side * (tine + 0.5 * shape.tine_thickness)
        # A tine tapers towards the axle and ends round.
        outline = np.array([[top, crown_start], [-top, crown_start], [-0.62 * top, axle], [0.62 * top, axle]])
        parts.append(_flat(outline, *sorted((inner, outer))))
        parts.append(cylinder(0.8 * top, *sorted((inner, outer)), axis="y").shifted(axle))
        drives.append(cylinder(0.6 * top, *sorted((inner, outer + side * 0.03)), axis="y").shifted(axle))
    return {"aluminium": join(*parts), "actuator": join(*drives)}


def _wheel(wheel: WheelSpec) -> Look:
    half, top = 0.5 * wheel.width, wheel.radius - LUG_HEIGHT
    rim = 0.58 * wheel.radius
    bulge = 0.96 * half
    tyre = lathe(
        np.array(
            [
                [-0.80 * bulge, rim],
                [0.80 * bulge, rim],
                [bulge, rim + 0.45 * (top - rim)],
                [0.86 * bulge, top - 0.10 * (top - rim)],
                [0.55 * bulge, top],
                [-0.55 * bulge, top],
                [-0.86 * bulge, top - 0.10 * (top - rim)],
                [-bulge, rim + 0.45 * (top - rim)],
            ]
        ),
        axis="y",
        segments=TYRE_SEGMENTS,
    )
    lugs = []
    size = (0.42 * 2 * np.pi * wheel.radius / LUGS, 0.50 * wheel.width, 2 * LUG_HEIGHT)
    slant = np.deg2rad(24.0)
    # The lug's outermost corners lie at the drawn radius.
    reach = 0.5 * (size[0] * np.cos(slant) + size[1] * np.sin(slant))
    height = float(np.sqrt(wheel.radius**2 - reach**2)) - LUG_HEIGHT
    for row in (1.0, -1.0):
        tilt = np.array(
            [[np.cos(slant), -row * np.sin(slant), 0], [row * np.sin(slant), np.cos(slant), 0], [0, 0, 1.0]]
        )
        block = box(size).moved(tilt, np.array([0.0, row * 0.235 * wheel.width, height]))
        for i in range(LUGS):
            a = 2 * np.pi * (i + 0.25 * row) / LUGS
            turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
            lugs.append(block.moved(turn, np.zeros(3)))
    web = 0.35 * half
    hub = lathe(
        np.array(
            [
                [-0.35 * half, 0.012],
                [0.35 * half, 0.012],
                [web, 0.45 * rim],
                [0.82 * half, 0.92 * rim],
                [0.82 * half, 1.03 * rim],
                [-0.82 * half, 1.03 * rim],
                [-0.82 * half, 0.92 * rim],
                [-web, 0.45 * rim],
            ]
        ),
        axis="y",
        segments=HUB_SEGMENTS,
    )
    axle = cylinder(0.3 * rim, -half - 0.01, half + 0.01, axis="y", segments=12)
    return {"tyre": join(tyre, *lugs), "aluminium": join(hub, axle)}


def _drum(shape: Proportions, rim: float) -> Mesh:
    body = cylinder(DRUM * rim, -shape.cheek_inner + 0.002, shape.cheek_inner - 0.002, axis="y", segments=16)
    caps = [
        cylinder(0.55 * rim, *sorted((s * 0.5 * shape.cheek_inner, s * (shape.cheek_outer + 0.01))), axis="y")
        for s in (1, -1)
    ]
    return join(body, *caps)


def _yoke_depth(shape: Proportions, rim: float) -> float:
    return shape.clearance + 0.25 * rim


def _yoke(shape: Proportions, rim: float, x: float, direction: float) -> Mesh:
    """Two cheeks about a pitch axis at `x` and the bridge that joins them on the side of the tube."""
    parts = []
    bridge_end = rim + _yoke_depth(shape, rim)
    bridge_start = rim + shape.clearance
    for side in (1.0, -1.0):
        span = sorted((side * shape.cheek_inner, side * shape.cheek_outer))
        parts.append(cylinder(rim, *span, axis="y", segments=16))
        wide, narrow = 0.86 * rim, 0.50 * rim
        outline = np.array([[wide, 0.2 * rim], [-wide, 0.2 * rim], [-narrow, bridge_end], [narrow, bridge_end]])
        parts.append(_flat(outline, *span))
    depth = bridge_end - bridge_start
    parts.append(box((depth, 2 * shape.cheek_inner + 0.01, 1.1 * rim), (bridge_start + 0.5 * depth, 0.0, 0.0)))
    yoke = join(*parts)
    flip = np.diag([direction, direction, 1.0])  # half a turn about z keeps faces outward
    return yoke.moved(flip, np.array([x, 0.0, 0.0]))


def _flat(outline_zx: np.ndarray, low: float, high: float) -> Mesh:
    """A plate across y from an outline of (z, x) in either sense of turning."""
    z, x = outline_zx[:, 0], outline_zx[:, 1]
    area = float(np.sum(z * np.roll(x, -1) - np.roll(z, -1) * x))
    return prism(outline_zx if area > 0 else outline_zx[::-1], low, high, axis="y")
