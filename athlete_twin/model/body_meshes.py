"""What the chassis looks like: SDM-B's truss ring, T12's pallet and decks, and the camera housings.

Cameras decide the clearances. Whatever is drawn near a camera lies behind its image plane by `BEHIND` or more, which is five
sigma of a trial's camera displacement; the ring's outer faces and the decks' slanted sides stay inside the NavCams.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.arrays import Points2, Vec3
from athlete_twin.model.camera import StereoCamera
from athlete_twin.model.leg_meshes import Look
from athlete_twin.model.link_solids import deck_outline
from athlete_twin.model.proportions import proportions
from athlete_twin.model.solids import Mesh, beam, box, cylinder, join, prism
from athlete_twin.model.spec import BodyPart, DeckSpec, RobotSpec

BEHIND = 0.028
"""of a camera's image plane, where its housing begins [m]"""
RAIL = 0.040
"""edge of a square truss rail [m]; EST"""
BRACE = 0.022
"""edge of a truss brace [m]; EST"""
BAYS = 4
"""of the truss along a side of the ring"""


def body_looks(spec: RobotSpec) -> dict[str, Look]:
    """Meshes by kind of link: `hex`, and T12's decks and docks."""
    part = spec.body_parts[0]
    look = _ring(spec, part) if part.shape == "hexagon_ring" else _pallet(part)
    cameras = [c for c in spec.cameras if c.on_chassis]
    look["lens"] = join(*(_lenses(c) for c in cameras))
    look["actuator"] = join(*(_housing(c) for c in cameras))
    look["aluminium"] = join(look["aluminium"], *(m for c in cameras for m in _stalk(spec, c)))
    out = {"hex": look}
    for deck in spec.decks:
        out[deck.name] = _deck(spec, deck)
        out[deck.name.replace("deck", "dock")] = {"aluminium": cylinder(0.05, -0.55, 0.55, axis="x")}
    return out


def leg_camera_looks(spec: RobotSpec) -> dict[str, Look]:
    """Meshes of the cameras that ride on legs, by the URDF name of their link."""
    return {
        c.link: {"lens": _lenses(c), "actuator": join(_housing(c), _arm(c))} for c in spec.cameras if not c.on_chassis
    }


def _ring(spec: RobotSpec, part: BodyPart) -> Look:
    """Six truss sides between six hip collars, a white panel on each outer face, equipment inside three of them."""
    top = float(part.centre[2] + 0.5 * part.size[2])
    bottom = float(part.centre[2] - 0.5 * part.size[2])
    outer = float(part.size[0]) * np.cos(np.pi / 6) - BEHIND
    inner = float(part.size[1]) * np.cos(np.pi / 6)
    metal, white, gold = [], [], []
    for number, azimuth in enumerate(np.deg2rad(np.arange(30.0, 360.0, 60.0))):
        turn = np.array([[np.cos(azimuth), -np.sin(azimuth), 0], [np.sin(azimuth), np.cos(azimuth), 0], [0, 0, 1.0]])
        sides = {"metal": _truss(outer, inner, top, bottom), "white": _panels(outer, inner, top, bottom)}
        metal.append(sides["metal"].moved(turn, np.zeros(3)))
        white.append(sides["white"].moved(turn, np.zeros(3)))
        if number % 2 == 0:
            middle, height = 0.5 * (outer + inner), top - bottom - 2 * RAIL
            store = box((0.6 * (outer - inner), 0.42, height), (middle, 0.0, 0.5 * (top + bottom)))
            gold.append(store.moved(turn, np.zeros(3)))
    radius = proportions(spec.name).hip_drum_radius
    for hip in spec.hips_in_hex:
        x, y = float(hip[0]), float(hip[1])
        metal.append(cylinder(radius + 0.040, bottom, top - 0.005, axis="z", segments=14).shifted(x, y))
        metal.append(cylinder(radius + 0.052, top - 0.045, top - 0.015, axis="z", segments=14).shifted(x, y))
    return {"aluminium": join(*metal), "white": join(*white), "gold": join(*gold)}


def _truss(outer: float, inner: float, top: float, bottom: float) -> Mesh:
    """One side of the ring in a frame with x along its outward normal: four rails, uprights and braces."""
    half = 0.5 * RAIL
    a, b = outer - half, inner + half
    high, low = top - half, bottom + half
    parts = []
    for n, reach in ((a, 0.56), (b, (b + half) * np.tan(np.pi / 6))):
        parts += [box((RAIL, 2 * reach, RAIL), (n, 0.0, z)) for z in (high, low)]
    reach = 0.50
    stations = np.linspace(-reach, reach, BAYS + 1)
    for k in range(BAYS):
        s, e = (stations[k], stations[k + 1]) if k % 2 == 0 else (stations[k + 1], stations[k])
        for z in (high, low):
            parts.append(beam(np.array([a, s, z]), np.array([b, e, z]), BRACE, BRACE))
        for n in (a, b):
            parts.append(beam(np.array([n, s, low]), np.array([n, e, high]), BRACE, BRACE, up=(1.0, 0.0, 0.0)))
    for s in stations[1:-1:2]:
        parts += [beam(np.array([n, s, low]), np.array([n, s, high]), BRACE, BRACE, up=(1.0, 0.0, 0.0)) for n in (a, b)]
    return join(*parts)


def _panels(outer: float, inner: float, top: float, bottom: float) -> Mesh:
    """Face panel on the outer side and a half-width cover on top, in the frame of `_truss`."""
    face = box((0.012, 0.78, top - bottom - 1.1 * RAIL), (outer - 0.008, 0.0, 0.5 * (top + bottom)))
    cover = box((0.5 * (outer - inner), 0.30, 0.010), (inner + 0.5 * (outer - inner), 0.0, top - 0.005))
    return join(face, cover)


def _pallet(part: BodyPart) -> Look:
    """A framed box: rails on its edges, white side panels set in, a deck of planks on top."""
    x, y, z = (0.5 * float(s) for s in part.size)
    edge = 0.07
    metal, white = [], []
    for sy in (1, -1):
        for sz in (1, -1):
            metal.append(box((2 * x, edge, edge), (0.0, sy * (y - 0.5 * edge), sz * (z - 0.5 * edge))))
    for sx in (1, -1):
        for sz in (1, -1):
            metal.append(box((edge, 2 * y, edge), (sx * (x - 0.5 * edge), 0.0, sz * (z - 0.5 * edge))))
        metal += [box((edge, edge, 2 * z), (sx * (x - 0.5 * edge), sy * (y - 0.5 * edge), 0.0)) for sy in (1, -1)]
    for k in (-1.0, 0.0, 1.0):
        metal.append(box((0.05, 2 * y, 0.05), (k * 0.5 * x, 0.0, -z + 0.025)))
        metal += [box((0.05, 0.05, 2 * z), (k * 0.5 * x, sy * (y - 0.025), 0.0)) for sy in (1, -1)]
    for sy in (1, -1):
        white.append(box((2 * x - 2 * edge, 0.01, 2 * z - 2 * edge), (0.0, sy * (y - 0.045), 0.0)))
    for sx in (1, -1):
        white.append(box((0.01, 2 * y - 2 * edge, 2 * z - 2 * edge), (sx * (x - 0.045), 0.0, 0.0)))
    planks = [box((0.21, 2 * y - 2 * edge, 0.02), (k * 0.235, 0.0, z - 0.02)) for k in np.arange(-4.5, 5.0)]
    belly = box((2 * x - 0.5, 2 * y - 0.5, 0.10), (0.0, 0.0, -z + 0.10))
    look = {"aluminium": join(*metal, *planks), "white": join(*white), "gold": belly}
    centre = [float(c) for c in part.centre]
    return {material: mesh.shifted(*centre) for material, mesh in look.items()}


def _deck(spec: RobotSpec, deck: DeckSpec) -> Look:
    """Half a hexagon: framed outline, white top and sides, equipment below, a collar for each hip."""
    outline = deck_outline(deck)
    high = float(deck.part.centre[2] + 0.5 * deck.part.size[2])
    low = float(deck.part.centre[2] - 0.5 * deck.part.size[2])
    edge = 0.06
    inner = _inset(outline, 0.5 * edge)
    metal, white = [], []
    for a, b in zip(inner, np.roll(inner, -1, axis=0), strict=True):
        for z in (high - 0.5 * edge, low + 0.5 * edge):
            metal.append(beam(np.array([*a, z]), np.array([*b, z]), edge, edge))
        metal.append(beam(np.array([*a, low]), np.array([*a, high]), edge, edge, up=(1.0, 0.0, 0.0)))
        length = float(np.linalg.norm(b - a))
        s, e = a + (b - a) * 0.09 / length, b - (b - a) * 0.09 / length
        if length > 0.4:
            middle = 0.5 * (low + high)
            white.append(beam(np.array([*s, middle]), np.array([*e, middle]), 0.012, high - low - 2 * edge))
            third = (b - a) / 3
            for c in (a + third, a + 2 * third):
                metal.append(beam(np.array([*c, low]), np.array([*c, high]), 0.045, 0.045, up=(1.0, 0.0, 0.0)))
    white.append(prism(_inset(outline, 0.055), high - 0.022, high - 0.008))
    cx, cy = outline.mean(axis=0)
    gold = [
        box((0.55, 0.42, 0.20), (float(cx) + s * 0.62, float(cy) - 0.02 * np.sign(cy), high - 0.14))
        for s in (1.0, -1.0)
    ]
    actuator = box((0.40, 0.50, 0.16), (float(cx), float(cy), high - 0.12))
    radius = proportions(spec.name).hip_drum_radius
    for leg in deck.legs:
        hip = spec.hips_in_hex[leg]
        x, y = float(hip[0]), float(hip[1])
        metal.append(cylinder(radius + 0.035, low, high - 0.030, axis="z", segments=14).shifted(x, y))
        metal.append(cylinder(radius + 0.050, low, low + 0.03, axis="z", segments=14).shifted(x, y))
        corners = outline[np.argsort(np.linalg.norm(outline - hip[:2], axis=1))[:2]]
        corners = corners + 0.10 * (np.array([cx, cy]) - corners)
        for corner in corners:
            for z in (high - 0.07, low + 0.05):
                metal.append(beam(np.array([*corner, z]), np.array([x, y, z]), 0.07, 0.07))
    look = {"aluminium": join(*metal), "white": join(*white), "gold": join(*gold), "actuator": actuator}
    dock = [float(-d) for d in deck.dock]
    return {material: mesh.shifted(*dock) for material, mesh in look.items()}


def _inset(outline: Points2, depth: float) -> Points2:
    """A convex counter-clockwise outline drawn in by a distance [m]."""
    along = np.roll(outline, -1, axis=0) - outline
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    inward = np.column_stack([-along[:, 1], along[:, 0]])
    before = np.roll(inward, 1, axis=0)
    bisector = inward + before
    return np.asarray(outline + depth * bisector / (1 + np.sum(inward * before, axis=1, keepdims=True)))


def _housing(camera: StereoCamera) -> Mesh:
    """A box behind both eyes, in the frame of the link that carries them."""
    depth, height = 0.050, 0.056
    body = box((camera.baseline + 0.07, height, depth), (0.5 * camera.baseline, 0.0, -BEHIND - 0.012 - 0.5 * depth))
    return body.moved(camera.link_from_camera.rotation, camera.link_from_camera.translation)


def _lenses(camera: StereoCamera) -> Mesh:
    eyes = [cylinder(0.020, -BEHIND - 0.014, -BEHIND, axis="z", segments=10).shifted(x) for x in (0.0, camera.baseline)]
    return join(*eyes).moved(camera.link_from_camera.rotation, camera.link_from_camera.translation)


def _arm(camera: StereoCamera) -> Mesh:
    """From a housing beside a leg's last link to the link's axis."""
    back = camera.link_from_camera.apply(np.array([0.5 * camera.baseline, 0.0, -BEHIND - 0.040]))
    return beam(back, np.array([back[0], 0.0, 0.0]), 0.04, 0.04, up=(1.0, 0.0, 0.0))


def _stalk(spec: RobotSpec, camera: StereoCamera) -> list[Mesh]:
    """What holds a housing that would hang in the air: a boom to the pallet's end, a hanger from its belly."""
    if not spec.decks:
        return []
    back = camera.hex_from_camera.apply(np.array([0.5 * camera.baseline, 0.0, -BEHIND - 0.040]))
    part = spec.body_parts[0]
    low, high = part.centre - 0.5 * part.size, part.centre + 0.5 * part.size
    if abs(back[1]) < high[1] and abs(back[0]) < high[0]:
        return [_bar(back, np.array([back[0], back[1], low[2]]))]
    if abs(back[1]) < 0.1:
        return [_bar(back, np.array([np.sign(back[0]) * high[0], s * 0.35, back[2] + 0.04])) for s in (1.0, -1.0)]
    return []


def _bar(start: Vec3, stop: Vec3) -> Mesh:
    up = (1.0, 0.0, 0.0) if abs(stop[2] - start[2]) > 0.15 else (0.0, 0.0, 1.0)
    return beam(start, stop, 0.04, 0.04, up=up)
