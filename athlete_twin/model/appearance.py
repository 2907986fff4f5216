"""What the robot looks like to a camera: the URDF's visual meshes with their colours, for the renderer and the films."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from athlete_twin.assets import robot_dir
from athlete_twin.errors import AssetError
from athlete_twin.geometry.arrays import Points3, Vec3
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.solids import Mesh, obj_mesh
from athlete_twin.model.spec import RobotSpec

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""weights of linear red, green, blue, ITU-R BT.709"""
CHASSIS = -1
"""instead of a leg's index: a link that belongs to none"""


@dataclass(frozen=True, eq=False, kw_only=True)
class VisualPart:
    """One mesh of one colour on one link. Parts of equal links share their arrays, which are read-only."""

    link: str
    """URDF name of the link that carries it"""
    link_from_part: SE3
    vertices: Points3
    """in the part's frame [m]"""
    triangles: np.ndarray
    """rows of `vertices`, counter-clockwise seen from outside, shape (m, 3)"""
    colour: Vec3
    """linear red, green, blue reflectance, 0 to 1"""
    albedo: float
    """grey reflectance, 0 to 1"""


def leg_of(link: str) -> int:
    """Index of the leg that a link belongs to, by its URDF name such as "leg3_hip_yaw" or "wheel3"; -1 for the chassis."""
    for prefix in ("leg", "wheel"):
        rest = link.removeprefix(prefix)
        if rest != link and rest[:1].isdigit():
            return int(rest[0]) - 1
    return CHASSIS


def visual_parts(spec: RobotSpec) -> tuple[VisualPart, ...]:
    """All parts of a robot, to be placed with `link_poses`; read once a process."""
    return _visual_parts(spec.name)


@lru_cache(maxsize=8)
def _visual_parts(robot: str) -> tuple[VisualPart, ...]:
    folder = robot_dir(robot)
    urdf = folder / "robot.urdf"
    try:
        root = ElementTree.parse(urdf).getroot()
    except (FileNotFoundError, ElementTree.ParseError) as e:
        raise AssetError(f"{urdf}: {e}; python scripts/build_assets.py writes it") from e
    colours = {}
    for material in root.findall("material"):
        rgba = material.find("color")
        if rgba is not None:
            colours[material.get("name", "")] = np.array([float(v) for v in rgba.get("rgba", "").split()[:3]])
    meshes: dict[str, Mesh] = {}
    parts = []
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            parts.append(_part(link.get("name", ""), visual, colours, meshes, folder))
    return tuple(parts)


def _part(
    link: str, visual: ElementTree.Element, colours: dict[str, Vec3], meshes: dict[str, Mesh], folder: Path
) -> VisualPart:
    origin, material, mesh = visual.find("origin"), visual.find("material"), visual.find("geometry/mesh")
    name = "" if material is None else material.get("name", "")
    if origin is None or mesh is None or name not in colours:
        raise AssetError(f"visual of link {link!r} lacks an origin, a mesh or a material out of {', '.join(colours)}")
    file = mesh.get("filename", "")
    if file not in meshes:
        meshes[file] = _read(folder / file)
    x, y, z = (float(v) for v in origin.get("xyz", "0 0 0").split())
    roll, pitch, yaw = (float(v) for v in origin.get("rpy", "0 0 0").split())
    return VisualPart(
        link=link,
        link_from_part=SE3.from_rpy(roll, pitch, yaw, np.array([x, y, z])),
        vertices=meshes[file].vertices,
        triangles=meshes[file].triangles,
        colour=colours[name],
        albedo=float(LUMINANCE @ colours[name]),
    )


def _read(path: Path) -> Mesh:
    try:
        mesh = obj_mesh(path.read_text())
    except FileNotFoundError as e:
        raise AssetError(f"{path} is missing; python scripts/build_assets.py writes it") from e
    mesh.vertices.setflags(write=False)
    mesh.triangles.setflags(write=False)
    return mesh
