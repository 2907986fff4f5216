"""What the cameras of a robot see of the ground round it, what its own legs hide, and where views gap or overlap.

    python scripts/view_analysis.py [--robots sdm_b t12] [--out out/views] [--json]

Flat ground, the robot of the drawings in its regular stance; a cell is seen when both eyes of a pair see it
(`view_sight.py`). [SunSpiral2012] figure 7 shows what this does to SDM-B: a gap between HazCams and NavCams, and legs that
hide the ground they must step on; figure 13 is about the overlap that T12's cameras were given.

Rows
- ring: over rings of 0.1 m, the least share of ground that NavCams and HazCams together see.
- next step: ground 0.25 to 0.7 m ahead of a wheel's contact along the heading, as wide as the wheel; the share seen
  with all legs down, and with that leg lifted. The heading is that of the leg's own hip.
- overlap, three ways, since outward pairs stand apart and share more of the horizon than of the ground at their feet:
  in azimuth, of two neighbouring pairs of a group, the angle that both see over that of one; on the ground within reach,
  what is in the pictures of both over that of the one which has less; and of each pair's ground within reach, what any
  other pair of the chassis has in its picture too, which is what links all views when they are adjusted together.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from bench_table import Row, row, show
from view_figures import draw
from view_sight import Sight, sight

from athlete_twin.errors import AthleteError
from athlete_twin.model.spec import LEGS, RobotSpec, load_spec

STEP = (0.25, 0.70)
"""ahead of the wheel's contact: robot facts' next step [m]"""
RING = 0.1
"""[m]"""
GAP_SHARE = 0.30
"""a ring less seen than this is blind"""
ON_CHASSIS = ("navcam", "hazcam")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Prints what is seen in per cent and draws it."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    cell: float = 0.05
    """edge of a cell of ground [m]"""
    out: Path = Path("out/views")
    """folder for the figures"""
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    if not 0.01 <= options.cell <= 0.25:
        sys.stderr.write(f"view_analysis: --cell {options.cell} m is outside 0.01 to 0.25 m\n")
        return 2
    rows: list[Row] = []
    try:
        specs = [load_spec(robot) for robot in options.robots]
        for spec in specs:
            down = sight(spec, cell=options.cell, size=size_of(spec))
            lifted = [sight(spec, cell=options.cell, size=size_of(spec), lifted=leg) for leg in range(LEGS)]
            rows += rows_of(spec, down, lifted)
            options.out.mkdir(parents=True, exist_ok=True)
            for path in draw(options.out, spec, down, lifted[0], rings(down)):
                sys.stderr.write(f"figure: {path}\n")
    except AthleteError as e:
        sys.stderr.write(f"view_analysis: {' '.join(str(e).split())}\n")
        return 2
    show(rows, as_json=options.json)
    return 0


def size_of(spec: RobotSpec) -> float:
    """Edge of the square of ground that is looked at: twice the reach of the legs and half as much again [m]."""
    return 3.0 * reach(spec)


def reach(spec: RobotSpec) -> float:
    """Of a stretched leg from the hex's axis, in plan [m]."""
    hip = float(np.linalg.norm(spec.hips_in_hex, axis=1).max())
    return hip + sum(float(j.offset[0]) for j in spec.joints) + float(spec.wheel.offset[0])


def rows_of(spec: RobotSpec, down: Sight, lifted: list[Sight]) -> list[Row]:
    """All rows of one robot; `lifted` has a view for each leg in the air."""
    name, radius = spec.name, down.radius()
    near = radius <= reach(spec)
    framed, seen = down.framed_by(*ON_CHASSIS), down.by(*ON_CHASSIS)
    rows = [
        row(f"{name} ground within reach seen", _percent(seen, near), "%"),
        row(f"{name} of that in pictures, hidden by the robot", _percent(framed & ~seen, near & framed), "%"),
    ]
    rows += [row(f"{name} ground within reach seen by {g}s", _percent(down.by(g), near), "%") for g in ON_CHASSIS]
    edges, share = rings(down)
    blind = np.flatnonzero(share < GAP_SHARE)
    strict = name == "sdm_b"
    rows.append(row(f"{name} least seen ring", 100 * float(share.min()), "%", target="< 30" if strict else ""))
    if len(blind):
        rows += [
            row(f"{name} blind ring from", float(edges[blind[0]]), "m"),
            row(f"{name} blind ring to", float(edges[blind[-1]] + RING), "m"),
        ]
    for leg in range(LEGS):
        ahead = next_step(spec, down, leg)
        # A HazCam looks across the body at every second leg of SDM-B: only these can walk with a leg on the heading.
        judged = strict and leg == 0
        rows += [
            row(f"{name} next step of leg {leg + 1} seen, legs down", _percent(seen, ahead), "%", target="<= 50" if judged else ""),
            row(
                f"{name} next step of leg {leg + 1} seen, leg lifted", _percent(lifted[leg].by(*ON_CHASSIS), ahead), "%",
                target=">= 70" if judged else "",
            ),
        ]  # fmt: skip
    target = ">= 20" if name == "t12" else ""
    for group in ON_CHASSIS:
        azimuth, on_ground, shared = overlaps(down, group, near)
        rows += [
            row(f"{name} least overlap of neighbouring {group}s in azimuth", 100 * azimuth, "%", target=target),
            row(f"{name} least overlap of neighbouring {group}s on the ground within reach", 100 * on_ground, "%", target=target),
            row(f"{name} least share of a {group}'s ground that another pair sees too", 100 * shared, "%", target=target),
        ]
    return rows


def rings(view: Sight) -> tuple[np.ndarray, np.ndarray]:
    """Inner radii of rings [m], and the share of each that the chassis' cameras see."""
    edges = np.arange(0.0, 0.5 * (view.x[-1] - view.x[0]) - RING, RING)
    seen, index = view.by(*ON_CHASSIS), np.floor(view.radius() / RING).astype(int)
    inside = index < len(edges)
    total = np.bincount(index[inside], minlength=len(edges))
    share = np.bincount(index[inside], weights=seen[inside], minlength=len(edges)) / np.maximum(total, 1)
    return edges, np.where(total > 0, share, 1.0)


def next_step(spec: RobotSpec, view: Sight, leg: int) -> np.ndarray:
    """Cells where a leg would step next, walking the way its hip points, shape (n, n)."""
    angle = spec.foot_azimuths[leg]
    foot = spec.foot_radius * np.array([np.cos(angle), np.sin(angle)])
    heading = spec.hip_azimuths[leg]
    dx, dy = view.x[:, None] - foot[0], view.y[None, :] - foot[1]
    along = np.cos(heading) * dx + np.sin(heading) * dy
    across = -np.sin(heading) * dx + np.cos(heading) * dy
    return np.asarray((along >= STEP[0]) & (along <= STEP[1]) & (np.abs(across) <= 0.5 * spec.wheel.width))


def overlaps(view: Sight, group: str, near: np.ndarray) -> tuple[float, float, float]:
    """Least overlap of neighbours of a group in azimuth and on the cells of `near`, and least share with any other pair."""
    chassis = [k for k, g in enumerate(view.groups) if g in ON_CHASSIS]
    members = [k for k in chassis if view.groups[k] == group]
    looks = np.array([view.cameras[k].hex_from_camera.rotation[:2, 2] for k in members])
    azimuths = np.arctan2(looks[:, 1], looks[:, 0])
    order = np.argsort(azimuths)
    gaps = np.diff(azimuths[order], append=azimuths[order[0]] + 2.0 * np.pi)
    eye = view.cameras[members[0]].eye
    width = 2.0 * np.arctan(0.5 * eye.width_px / eye.focal_px)
    on_ground = []
    for a, b in zip(order, np.roll(order, -1), strict=True):
        first, second = view.framed[members[a]] & near, view.framed[members[b]] & near
        on_ground.append(float((first & second).sum() / max(min(first.sum(), second.sum()), 1)))
    shared = []
    for k in members:
        mine = view.framed[k] & near
        others = view.framed[[other for other in chassis if other != k]].any(axis=0)
        shared.append(float((mine & others).sum() / max(mine.sum(), 1)))
    # Rounded, since 15 of 75 degrees must come out as a fifth.
    return round(float(max(0.0, 1.0 - gaps.max() / width)), 9), min(on_ground), min(shared)


def _percent(what: np.ndarray, where: np.ndarray) -> float:
    return 100.0 * float(what[where].mean()) if where.any() else float("nan")


if __name__ == "__main__":
    sys.exit(main())
