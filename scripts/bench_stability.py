"""How fast and how true the ground's judgement of footfalls is: stability maps for all legs, and the footfall scores.

    python scripts/bench_stability.py [--robots sdm_b t12] [--cells 400] [--parts map footfalls] [--out DIR] [--json]

A stability map tells for each leg and each cell whether the leg may step there, and if not, the first reason. It is timed
over a seeded rock field with and without its collision check, and its reach is held against inverse kinematics by brute force:
every joint free, scipy's bounded least squares from thirteen starts, half a second a cell. Timings want the machine to themselves.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import footfall_speed
import stability_figures
import stability_pictures
import tyro
from bench_table import Row, show
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from stability_scene import stability_scene

from athlete_twin.errors import AthleteError
from athlete_twin.model.spec import load_spec
from planner.stability.ground_map import ground_maps

PARTS = ("map", "footfalls")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures and prints the rows of each part, and draws the map of each robot."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    cells: int = 400
    """drawn near a leg, that the brute force is asked about, of each robot"""
    seed: int = 0
    """of the rock field and of the cells"""
    parts: tuple[str, ...] = PARTS
    """any of map and footfalls"""
    out: Path | None = None
    """folder for pictures; none are drawn without it"""
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    unknown = [p for p in options.parts if p not in PARTS]
    if unknown or options.cells < 1 or options.seed < 0:
        wrong = f"part {unknown[0]!r} is not one of {', '.join(PARTS)}" if unknown else "--cells must be at least 1, --seed at least 0"
        sys.stderr.write(f"bench_stability: {wrong}\n")
        return 2
    rows: list[Row] = []
    columns = (TextColumn("{task.description:28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        for robot in options.robots:
            load_spec(robot)
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            work = [(part, robot) for part in options.parts for robot in (options.robots if part == "map" else ("",))]
            task = progress.add_task("", total=len(work))
            for part, robot in work:
                progress.update(task, description=f"{part} {robot}")
                if part == "map":
                    rows += stability_figures.rows(robots=(robot,), cells=options.cells, seed=options.seed)
                else:
                    rows += footfall_speed.rows()
                progress.advance(task)
        if options.out is not None:
            for robot in options.robots:
                _draw(robot, options.seed, options.out)
    except AthleteError as e:
        sys.stderr.write(f"bench_stability: {' '.join(str(e).split())}\n")
        return 2
    show(rows, as_json=options.json)
    return 0


def _draw(robot: str, seed: int, out: Path) -> None:
    scene = stability_scene(robot, seed)
    maps = ground_maps(
        scene.kinematics, scene.joints, terrain=scene.terrain, world_from_hex=scene.world_from_hex,
        config=scene.config(collision=True), footfalls=scene.footfalls,
    )  # fmt: skip
    stability_pictures.draw(scene, maps, f"{robot} in rock_field, seed {seed}", out / f"stability_{robot}.png")


if __name__ == "__main__":
    sys.exit(main())
