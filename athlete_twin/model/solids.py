"""Triangle meshes of simple solids, closed and with outward faces, and the text form in which the assets keep them.

Enough for a machine made of tubes, boxes and plates; no boolean operations, so joined solids overlap where they meet.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from athlete_twin.errors import AssetError
from athlete_twin.geometry.arrays import Mat3, Points2, Points3, Vec3

Axis = Literal["x", "y", "z"]

# Cyclic permutations, so that a solid drawn along z lies along x or y without any rounding.
_ALONG: dict[str, np.ndarray] = {
    "x": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "y": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "z": np.eye(3),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Mesh:
    """Triangles over shared vertices."""

    vertices: Points3
    """[m]"""
    triangles: np.ndarray
    """rows of `vertices`, counter-clockwise seen from outside, shape (m, 3)"""

    def moved(self, rotation: Mat3, translation: Vec3) -> Mesh:
        """The mesh turned, then shifted [m]."""
        return Mesh(vertices=self.vertices @ np.asarray(rotation).T + translation, triangles=self.triangles)

    def shifted(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
        """The mesh shifted [m]."""
        return Mesh(vertices=self.vertices + np.array([x, y, z]), triangles=self.triangles)

    def volume(self) -> float:
        """Enclosed volume, positive when the faces look outward [m3]."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def join(*meshes: Mesh) -> Mesh:
    """One mesh of several, none of them cut."""
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        triangles=np.concatenate([m.triangles + o for m, o in zip(meshes, offsets, strict=False)]),
    )


def prism(outline: Points2, low: float, high: float, *, axis: Axis = "z") -> Mesh:
    """A convex outline (counter-clockwise about the axis) between two heights along the axis.

    The outline's two coordinates follow the axis cyclically: (x, y) about z, (y, z) about x, (z, x) about y.
    """
    n = len(outline)
    rim = np.asarray(outline, dtype=float)
    vertices = np.concatenate([np.column_stack([rim, np.full(n, h)]) for h in (low, high)])
    i = np.arange(n)
    j = (i + 1) % n
    sides = np.concatenate([np.column_stack([i, j, j + n]), np.column_stack([i, j + n, i + n])])
    fan = np.column_stack([np.zeros(n - 2, dtype=np.int64), i[1:-1], i[2:]])
    return Mesh(vertices=vertices @ _ALONG[axis].T, triangles=np.concatenate([sides, fan[:, ::-1], fan + n]))


def box(size: Vec3 | tuple[float, float, float], centre: Vec3 | tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A box along the axes [m]."""
    x, y, z = (0.5 * float(s) for s in size)
    outline = np.array([[x, y], [-x, y], [-x, -y], [x, -y]])
    return prism(outline, -z, z).shifted(*(float(c) for c in centre))


def cylinder(radius: float, low: float, high: float, *, axis: Axis, segments: int = 12) -> Mesh:
    """A cylinder about a coordinate axis between two heights along it [m]; a regular prism inside the round one."""
    angle = 2 * np.pi * (np.arange(segments) + 0.5) / segments
    return prism(radius * np.column_stack([np.cos(angle), np.sin(angle)]), low, high, axis=axis)


def lathe(profile: Points2, *, axis: Axis, segments: int) -> Mesh:
    """A closed profile turned about an axis.

    Args:
        profile: corners as (height along the axis, radius > 0) [m], counter-clockwise with the height to the right.
        axis: of the turning.
        segments: of a turn.
    """
    p = np.asarray(profile, dtype=float)
    k = len(p)
    angle = 2 * np.pi * np.arange(segments) / segments
    vertices = np.stack(
        [np.outer(np.cos(angle), p[:, 1]), np.outer(np.sin(angle), p[:, 1]), np.tile(p[:, 0], (segments, 1))], axis=-1
    ).reshape(-1, 3)
    ring, corner = (g.ravel() for g in np.meshgrid(np.arange(segments), np.arange(k), indexing="ij"))
    a, b = ring * k + corner, ring * k + (corner + 1) % k
    following = (ring + 1) % segments
    c, d = following * k + (corner + 1) % k, following * k + corner
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Mesh(vertices=vertices @ _ALONG[axis].T, triangles=triangles)


def beam(
    start: Vec3, stop: Vec3, width: float, height: float, *, up: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> Mesh:
    """A straight bar of rectangular section between two points [m]; `height` is along `up` as far as the bar allows."""
    start, stop = np.asarray(start, dtype=float), np.asarray(stop, dtype=float)
    along = stop - start
    length = float(np.linalg.norm(along))
    x = along / length
    y = np.cross(np.asarray(up, dtype=float), x)
    y /= np.linalg.norm(y)
    rotation = np.column_stack([x, y, np.cross(x, y)])
    return box((length, width, height)).moved(rotation, 0.5 * (start + stop))


def obj_text(mesh: Mesh) -> str:
    """The mesh as a Wavefront OBJ, to 0.01 mm."""
    rounded = np.round(mesh.vertices, 5) + 0.0  # no negative zeros: the bytes must not depend on their signs
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in rounded]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.triangles + 1]
    return "\n".join(lines) + "\n"


def obj_mesh(text: str) -> Mesh:
    """A mesh from the text that `obj_text` writes."""
    rows = [line.split() for line in text.splitlines() if line]
    vertices = [[float(v) for v in row[1:]] for row in rows if row[0] == "v"]
    triangles = [[int(v) - 1 for v in row[1:]] for row in rows if row[0] == "f"]
    if not vertices or not triangles or len(vertices) + len(triangles) != len(rows):
        raise AssetError("a mesh file holds something other than the lines 'v x y z' and 'f a b c'")
    return Mesh(vertices=np.array(vertices), triangles=np.array(triangles, dtype=np.int64))
