"""Collision solids and inertias of every kind of link, from the drawings: boxes, cylinders, spheres, no meshes.

A kind is a link's name without its leg's number: `hex`, `deck_left`, `hip_yaw`, `wheel`. All legs are alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.geometry.arrays import Vec3
from athlete_twin.model.proportions import Proportions, proportions
from athlete_twin.model.spec import BodyPart, DeckSpec, RobotSpec

DOCK_MASS = 2.0
"""of the link between a dock's two joints, taken out of its deck's mass [kg]; EST, a hinge bracket"""
MIN_INERTIA = 0.05
"""of a principal axis [kg m2]. Blocks of zero length (knee, ankle, dock) would come out at a few 1e-3, and a servo of
1e5 N m/rad on that rings at 1 kHz; gears and motor rotors, which the drawings do not list, bring it up anyway."""
X_AXIS = (0.0, 0.5 * np.pi, 0.0)
"""roll, pitch, yaw of a URDF cylinder (drawn along z) that is to lie along x"""
Y_AXIS = (0.5 * np.pi, 0.0, 0.0)
"""the same along y"""
DECK_EDGE_APOTHEM = 1.66
"""of a deck's slanted sides from the hex's z axis [m]; EST, just inside the NavCams at 1.70"""


@dataclass(frozen=True, kw_only=True)
class Solid:
    """One collision primitive in its link's frame."""

    shape: str
    """"box", "cylinder" (along its own z) or "sphere" """
    size: tuple[float, ...]
    """box: x, y, z; cylinder: radius, length; sphere: radius [m]"""
    xyz: tuple[float, float, float]
    """centre [m]"""
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[rad]"""


def deck_outline(deck: DeckSpec) -> np.ndarray:
    """Corners of a deck seen from above, counter-clockwise, hex frame, shape (6, 2) [m].

    The drawings give the bounding box. Its outer corners are cut along the lines between the hips, as a Tri-ATHLETE's deck
    is half a hexagon; the NavCams at 1.70 m look outward from those slanted sides.
    """
    half = 0.5 * deck.part.size[0]
    side = float(np.sign(deck.part.centre[1]))
    near = abs(deck.part.centre[1]) - 0.5 * deck.part.size[1]
    far = abs(deck.part.centre[1]) + 0.5 * deck.part.size[1]
    shoulder = (DECK_EDGE_APOTHEM - half * np.cos(np.pi / 3)) / np.sin(np.pi / 3)
    tip = (DECK_EDGE_APOTHEM - far * np.sin(np.pi / 3)) / np.cos(np.pi / 3)
    corners = np.array([[half, near], [half, shoulder], [tip, far], [-tip, far], [-half, shoulder], [-half, near]])
    return corners if side > 0 else np.column_stack([corners[::-1, 0], -corners[::-1, 1]])


def solids(spec: RobotSpec) -> dict[str, tuple[Solid, ...]]:
    """Collision primitives by kind of link."""
    shape = proportions(spec.name)
    out: dict[str, tuple[Solid, ...]] = {"hex": tuple(s for part in spec.body_parts for s in _body_solids(part))}
    for deck in spec.decks:
        out[deck.name] = _deck_solids(deck)
        out[deck.name.replace("deck", "dock")] = ()
    for index, joint in enumerate(spec.joints):
        out[joint.name] = _leg_solids(spec, shape, index)
    w = spec.wheel
    out["wheel"] = (Solid(shape="cylinder", size=(w.radius, w.width), xyz=(0.0, 0.0, 0.0), rpy=Y_AXIS),)
    return out


def inertias(spec: RobotSpec) -> dict[str, Vec3]:
    """Principal moments about the centre of mass, along the link's axes, by kind of link [kg m2]."""
    shape = proportions(spec.name)
    out = {"hex": _body_inertia(spec.body_mass, spec.body_parts[0])}
    for deck in spec.decks:
        out[deck.name] = box_inertia(deck.mass - DOCK_MASS, deck.part.size)
        out[deck.name.replace("deck", "dock")] = np.full(3, MIN_INERTIA)
    for index, joint in enumerate(spec.joints):
        out[joint.name] = np.maximum(_leg_inertia(spec, shape, index), MIN_INERTIA)
    w = spec.wheel
    spin = 0.6 * w.mass * w.radius**2  # JPL's CAD of T12's wheel: 1.051 of 13.9 kg and 0.3555 m
    across = 0.5 * spin + w.mass * w.width**2 / 12
    out["wheel"] = np.array([across, spin, across])
    return out


def box_inertia(mass: float, size: Vec3) -> Vec3:
    """Principal moments of a solid box [kg m2]."""
    square = np.asarray(size, dtype=float) ** 2
    return np.asarray(mass * (square.sum() - square) / 12)


def tube_inertia(mass: float, radius: float, length: float) -> Vec3:
    """Principal moments of a thin tube along x [kg m2]."""
    across = mass * (0.5 * radius**2 + length**2 / 12)
    return np.array([mass * radius**2, across, across])


def _body_inertia(mass: float, part: BodyPart) -> Vec3:
    if part.shape == "box":
        return box_inertia(mass, part.size)
    vertex = 0.5 * (part.size[0] + part.size[1])  # hoop of six straight sides: apothem^2 + side^2 / 12 = 5/6 vertex^2
    spin = mass * 5 / 6 * vertex**2
    across = 0.5 * spin + mass * part.size[2] ** 2 / 12
    return np.array([across, across, spin])


def _body_solids(part: BodyPart) -> list[Solid]:
    if part.shape == "box":
        return [_box(part.centre, part.size)]
    outer, inner = part.size[0] * np.cos(np.pi / 6), part.size[1] * np.cos(np.pi / 6)
    # A box as long as the ring's outer side fills its sixth exactly and stays inside the outline.
    out = []
    for azimuth in np.deg2rad(np.arange(30.0, 360.0, 60.0)):
        middle = 0.5 * (outer + inner)
        centre = np.array([middle * np.cos(azimuth), middle * np.sin(azimuth), part.centre[2]])
        out.append(_box(centre, np.array([outer - inner, part.size[0], part.size[2]]), yaw=float(azimuth)))
    return out


def _deck_solids(deck: DeckSpec) -> tuple[Solid, ...]:
    """Five boxes that fill the deck's outline and nothing outside it, in the deck's frame (at its dock)."""
    outline = deck_outline(deck)
    side = float(np.sign(deck.part.centre[1]))
    half = 0.5 * deck.part.size[0]
    ys = np.sort(np.unique(np.round(np.abs(outline[:, 1]), 9)))
    near, shoulder, far = ys
    z, height = deck.part.centre[2], deck.part.size[2]
    belly = 0.5 * half  # half-width at which a middle box still lies inside the slanted sides
    reach = (DECK_EDGE_APOTHEM - belly * np.cos(np.pi / 3)) / np.sin(np.pi / 3)
    tip = float(np.abs(outline[:, 0]).min())
    spans = [(half, near, shoulder), (belly, shoulder, reach), (tip, reach, far)]
    boxes = [
        _box(np.array([0.0, side * 0.5 * (a + b), z]) - deck.dock, np.array([2 * x, b - a, height]))
        for x, a, b in spans
    ]
    depth = shoulder - near
    length = float(np.hypot(half - tip, far - shoulder))
    for forward in (1.0, -1.0):
        normal = np.array([forward * 0.5, side * np.sqrt(0.75)])
        middle = np.array([forward * 0.5 * (half + tip), side * 0.5 * (shoulder + far)]) - 0.5 * depth * normal
        yaw = float(np.arctan2(normal[1], normal[0]))
        boxes.append(_box(np.array([*middle, z]) - deck.dock, np.array([depth, length, height]), yaw=yaw))
    return tuple(boxes)


def _leg_solids(spec: RobotSpec, shape: Proportions, index: int) -> tuple[Solid, ...]:
    joint = spec.joints[index]
    end = link_end(spec, index)
    if joint.name == "hip_yaw":
        low, high = shape.hip_drum_z
        arm = float(np.hypot(end[0], 0.0)) - shape.hip_rim
        return (
            Solid(shape="cylinder", size=(shape.hip_drum_radius, high - low), xyz=(0.0, 0.0, 0.5 * (low + high))),
            Solid(
                shape="box",
                size=(arm, shape.hip_arm_width, shape.hip_arm_height),
                xyz=(0.5 * arm, 0.0, float(end[2])),
            ),
        )
    if joint.name in ("knee_pitch", "ankle_pitch"):
        rim = rim_at(shape, joint.name)
        length = rim + 2 * shape.clearance
        return (_along_x(shape.roll_radius, 0.0, length),)
    if joint.name == "ankle_roll":
        return _fork_solids(spec, shape)
    start = shape.knee_rim + 2 * shape.clearance if joint.name == "knee_roll" else 0.0
    radius = shape.shank_radius if joint.name == "knee_roll" else shape.thigh_radius
    after = spec.joints[index + 1].name
    tube = _along_x(radius, start, float(end[0]) - rim_at(shape, after))
    far = _along_y(rim_at(shape, after), 2 * shape.cheek_outer, float(end[0]))
    if joint.name == "knee_roll":
        return (tube, far)
    return (_along_y(rim_at(shape, joint.name), 2 * shape.cheek_outer, 0.0), tube, far)


def _fork_solids(spec: RobotSpec, shape: Proportions) -> tuple[Solid, ...]:
    axle = float(spec.wheel.offset[0])
    neck = shape.ankle_rim + 2 * shape.clearance
    crown_end = axle - spec.wheel.radius - shape.crown_gap
    crown_start = crown_end - shape.crown_depth
    tine = 0.5 * spec.wheel.width + shape.tine_gap + 0.5 * shape.tine_thickness
    length = axle + 0.5 * shape.tine_width - crown_start
    span = 2 * tine + shape.tine_thickness
    out = [
        Solid(
            shape="box",
            size=(shape.crown_depth, span, shape.tine_width),
            xyz=(crown_end - 0.5 * shape.crown_depth, 0.0, 0.0),
        )
    ]
    if crown_start - neck > 0.01:
        out.append(_along_x(shape.shank_radius, neck, crown_start))
    for side in (1.0, -1.0):
        size = (length, shape.tine_thickness, shape.tine_width)
        out.append(Solid(shape="box", size=size, xyz=(crown_start + 0.5 * length, side * tine, 0.0)))
    return tuple(out)


def _leg_inertia(spec: RobotSpec, shape: Proportions, index: int) -> Vec3:
    joint = spec.joints[index]
    end = link_end(spec, index)
    mass = joint.link_mass
    if joint.name == "hip_yaw":
        low, high = shape.hip_drum_z
        return box_inertia(mass, np.array([end[0] + shape.hip_drum_radius, 2 * shape.cheek_outer, high - low]))
    if joint.name in ("knee_pitch", "ankle_pitch"):
        rim = rim_at(shape, joint.name)
        return box_inertia(mass, np.array([2 * rim, 2 * shape.cheek_outer, 2 * rim]))
    if joint.name == "ankle_roll":
        span = spec.wheel.width + 2 * (shape.tine_gap + shape.tine_thickness)
        return box_inertia(mass, np.array([spec.wheel.offset[0], span, shape.tine_width]))
    radius = shape.shank_radius if joint.name == "knee_roll" else shape.thigh_radius
    return tube_inertia(mass, radius, float(end[0]))


def link_end(spec: RobotSpec, index: int) -> Vec3:
    """Where the next joint, or the axle, sits in the frame of a leg's link at zero pose [m]."""
    following: Vec3 = spec.joints[index + 1].offset if index + 1 < spec.dof else spec.wheel.offset
    return following


def rim_at(shape: Proportions, joint: str) -> float:
    """Radius of the cheeks at a pitch joint [m]."""
    rims = {
        "hip_pitch": shape.hip_rim,
        "thigh_pitch": shape.thigh_rim,
        "knee_pitch": shape.knee_rim,
        "ankle_pitch": shape.ankle_rim,
    }
    return rims[joint]


def _box(centre: Vec3, size: Vec3, *, yaw: float = 0.0) -> Solid:
    x, y, z = (float(v) for v in centre)
    return Solid(shape="box", size=tuple(float(v) for v in size), xyz=(x, y, z), rpy=(0.0, 0.0, yaw))


def _along_x(radius: float, start: float, stop: float) -> Solid:
    return Solid(shape="cylinder", size=(radius, stop - start), xyz=(0.5 * (start + stop), 0.0, 0.0), rpy=X_AXIS)


def _along_y(radius: float, length: float, x: float) -> Solid:
    return Solid(shape="cylinder", size=(radius, length), xyz=(x, 0.0, 0.0), rpy=Y_AXIS)
