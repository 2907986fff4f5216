"""The frozen set of leg problems: what one leg has to pass between two places in the air, the robot standing among rocks.

Kept in `assets/leg_problems.npz`, its SHA-256 beside it; made by `scripts/build_leg_problems.py`. A problem is the stance, the
leg, where it begins and ends, and the rocks; the terrain is computed from these, to the millimetre.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from athlete_twin.errors import AssetError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import load_spec
from planner.motion.collision import ClearanceTable, CollisionConfig, LegCollision
from planner.motion.swing import SwingConfig, sampling_box

FOLDER = Path(__file__).resolve().parents[1] / "assets"
FILE, HASH_FILE = "leg_problems.npz", "leg_problems.sha256"
ROBOTS = ("sdm_b", "t12")
HALF = {"sdm_b": 3.0, "t12": 4.5}
"""half the side of the terrain about the leg [m]"""
CELL = 0.05
MOST_JOINTS, MOST_ROCKS = 7, 12
DIGITS = 3
"""of a height in metres"""
CERTIFIED = CollisionConfig(
    terrain_clearance=0.05, near_ground_clearance=0.01, table=ClearanceTable(same_leg=(0.02, 0.03), body=0.04, other_leg=0.06)
)
"""clearances that every problem was solved under when the set was made: they belong to the set, whatever the planner's are now"""


@dataclass(frozen=True, eq=False, kw_only=True)
class LegProblem:
    """One leg's way from one place in the air to another."""

    robot: str
    leg: int
    """index 0 to 5"""
    level: int
    """0 open ground, 1 rocks about, 2 a rock on the way, 3 that and rocks about, 4 that and a rock beside the leg"""
    joints: np.ndarray
    """of all legs, shape (6, dof) [rad]"""
    start: np.ndarray
    """shape (dof,) [rad]"""
    goal: np.ndarray
    world_from_hex: SE3
    middle: np.ndarray
    """of the terrain, shape (2,) [m]"""
    rocks: np.ndarray
    """x, y, radius, height of each, shape (n, 4) [m]"""

    def terrain(self) -> HeightGrid:
        """Level ground with the rocks, domes with steep flanks."""
        half = HALF[self.robot]
        n = 2 * round(half / CELL) + 1
        x, y = (self.middle[i] - half + CELL * np.arange(n) for i in (0, 1))
        heights = np.zeros((n, n))
        for rx, ry, radius, height in self.rocks:
            inside = np.maximum(1.0 - ((x[:, None] - rx) ** 2 + (y[None, :] - ry) ** 2) / radius**2, 0.0)
            heights = np.maximum(heights, height * np.sqrt(inside))
        return HeightGrid(origin_x=float(x[0]), origin_y=float(y[0]), cell=CELL, heights=np.round(heights, DIGITS))

    def collision(self, config: CollisionConfig | None = None) -> LegCollision:
        """What the leg hits, by the clearances that the set was certified under or by others."""
        spec = load_spec(self.robot)
        return LegCollision(spec, self.terrain(), self.world_from_hex, self.joints, self.leg, config or CERTIFIED)

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of where a planner samples [rad]: that of the planner's own steps."""
        return sampling_box(load_spec(self.robot), self.start, self.goal, SwingConfig())


def save_problems(problems: Sequence[LegProblem], folder: Path) -> str:
    """Write the set and its hash; the hash."""
    n = len(problems)
    joints, ends = np.full((n, 6, MOST_JOINTS), np.nan), np.full((n, 2, MOST_JOINTS), np.nan)
    rocks = np.full((n, MOST_ROCKS, 4), np.nan)
    for k, p in enumerate(problems):
        dof = len(p.start)
        joints[k, :, :dof], ends[k, 0, :dof], ends[k, 1, :dof] = p.joints, p.start, p.goal
        rocks[k, : len(p.rocks)] = p.rocks
    arrays = {
        "robot": np.array([ROBOTS.index(p.robot) for p in problems], dtype=np.int8),
        "leg": np.array([p.leg for p in problems], dtype=np.int8),
        "level": np.array([p.level for p in problems], dtype=np.int8),
        "joints": joints,
        "ends": ends,
        "pose": np.array([[*p.world_from_hex.translation, *p.world_from_hex.rotvec()] for p in problems]),
        "middle": np.array([p.middle for p in problems]),
        "rocks": rocks,
    }
    np.savez_compressed(folder / FILE, allow_pickle=False, **arrays)
    digest = content_hash(arrays)
    (folder / HASH_FILE).write_text(digest + "\n")
    return digest


def load_problems(folder: Path = FOLDER) -> list[LegProblem]:
    """The set as it was frozen; an error when it is not."""
    path = folder / FILE
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        wanted = (folder / HASH_FILE).read_text().strip()
    except FileNotFoundError as e:
        raise AssetError(f"{path.name} or {HASH_FILE} is missing; run scripts/build_leg_problems.py") from e
    found = content_hash(arrays)
    if found != wanted:
        raise AssetError(f"{path.name} has the hash {found[:12]}, frozen was {wanted[:12]}: results on it are no one else's")
    out = []
    for k, robot in enumerate(arrays["robot"]):
        name = ROBOTS[int(robot)]
        dof, rocks = load_spec(name).dof, arrays["rocks"][k]
        out.append(
            LegProblem(
                robot=name,
                leg=int(arrays["leg"][k]),
                level=int(arrays["level"][k]),
                joints=arrays["joints"][k, :, :dof],
                start=arrays["ends"][k, 0, :dof],
                goal=arrays["ends"][k, 1, :dof],
                world_from_hex=SE3.from_rotvec(arrays["pose"][k, 3:], arrays["pose"][k, :3]),
                middle=arrays["middle"][k],
                rocks=rocks[np.isfinite(rocks[:, 0])],
            )
        )
    return out


def content_hash(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of the arrays' names, shapes and bytes, whatever the archive's own bytes are."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


