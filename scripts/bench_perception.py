"""How well the ground sees: stereo, removal of the robot's own legs, the map after a walk, and how long it takes.

    python scripts/bench_perception.py [--robots sdm_b t12] [--scenes 20] [--parts stereo masks maps speed] [--json]

Each part is measured on seeded scenes with the sun at 15, 35 and 70 degrees, against the truth that the vehicle's
renderer and body know and the ground does not. The parts stand in `perception_stereo.py`, `perception_masks.py`,
`perception_maps.py` and `perception_speed.py`, which say what their rows mean. Cost grows with scenes times robots; the
maps walk the real twin, about a minute a scene.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import perception_maps
import perception_masks
import perception_speed
import perception_stereo
import tyro
from bench_table import Row, show
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from athlete_twin.errors import AthleteError
from athlete_twin.model.spec import load_spec

PARTS = ("stereo", "masks", "maps", "speed")
PICTURES: dict[str, Callable[[Path], object]] = {
    "stereo": perception_stereo.pictures, "masks": perception_masks.pictures, "maps": perception_maps.pictures,
}  # fmt: skip
"""by part; there is nothing to see of a speed"""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures and prints the rows of each part, and draws what people would rather look at."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    scenes: int = 20
    """seeds 0 to this, less one, of each robot"""
    parts: tuple[str, ...] = PARTS
    """any of stereo, masks, maps and speed"""
    out: Path | None = None
    """folder for pictures; none are drawn without it"""
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    unknown = [p for p in options.parts if p not in PARTS]
    if unknown or options.scenes < 1:
        wrong = f"part {unknown[0]!r} is not one of {', '.join(PARTS)}" if unknown else "--scenes must be at least 1"
        sys.stderr.write(f"bench_perception: {wrong}\n")
        return 2
    rows: list[Row] = []
    columns = (TextColumn("{task.description:28}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        for robot in options.robots:
            load_spec(robot)
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("", total=len(options.parts))
            for part in options.parts:
                progress.update(task, description=part)
                rows += _rows(part, options)
                if options.out is not None and part in PICTURES:
                    PICTURES[part](options.out)
                progress.advance(task)
    except AthleteError as e:
        sys.stderr.write(f"bench_perception: {' '.join(str(e).split())}\n")
        return 2
    show(rows, as_json=options.json)
    return 0


def _rows(part: str, options: Options) -> list[Row]:
    if part == "speed":
        return perception_speed.rows(robots=options.robots)
    if part == "stereo":
        return perception_stereo.rows(robots=options.robots, scenes=options.scenes)
    if part == "masks":
        return perception_masks.rows(robots=options.robots, scenes=options.scenes)
    return perception_maps.rows(robots=options.robots, scenes=options.scenes)


if __name__ == "__main__":
    sys.exit(main())
