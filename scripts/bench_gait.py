"""What the regular gait can do, planned and executed: strides, sway, two legs at once, slopes, stepping onto and over.

    python scripts/bench_gait.py [--robots sdm_b t12] [--parts strides sway slopes steps twin ...] [--out DIR] [--json]

`strides`: the longest cycle by heading, one leg at a time and opposite legs together. `sway`: the margin to saturation with the
chassis displaced in three dimensions, beside the same footfalls without displacement and beside the best constant chassis height
and foot radius; and the peak torque with one leg and with two opposite legs in the air. `slopes`: the steepest even slope with
the deck level and with the deck parallel to the ground, as drawn and in the best stance. `steps`: the largest ledge, ditch and
wall (`--obstacles`). These are planned: rigid, loads by zero interaction.

`twin` executes a cycle of the plain gait, the sway gait and the opposite pairs on level concrete, a minute or two each: tyres,
wind-up, servos and interaction included. `strides_twin` walks the longest stride, `slopes_twin` slopes of 7 and 14 deg and the
steepest, `steps_twin` crosses the largest obstacles: the planned one first, and where the twin does not finish, lesser ones.
`swings_twin` leads legs through the air, as the executive does it and at constant speed, and tells what their wheels feel.

SDM-B's reference is a hex at 1.75 m over feet at 1.793 m and a stride of 0.6 m; T12's is the stance and stride of its drawings.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import gait_figures
import gait_steps
import gait_twin
import swing_twin
import tyro
from bench_table import Row, figure, show
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from athlete_twin.errors import AthleteError
from athlete_twin.model.spec import load_spec

ROWS = {
    "steps": gait_steps.step_rows, "strides_twin": gait_twin.stride_rows, "slopes_twin": gait_twin.slope_rows,
    "steps_twin": gait_steps.step_twin_rows, "swings_twin": swing_twin.swing_rows,
}  # fmt: skip
"""parts that have their own files"""
PARTS = ("strides", "sway", "slopes", "steps", "twin", "strides_twin", "slopes_twin", "steps_twin", "swings_twin")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures and prints the rows of each part."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    parts: tuple[str, ...] = ("strides", "sway", "slopes", "twin")
    """any of strides, sway, slopes, steps, twin, strides_twin, slopes_twin, steps_twin and swings_twin, or all"""
    obstacles: tuple[str, ...] = ("ledge", "ditch", "wall")
    """of `steps` and `steps_twin`"""
    seed: int = 0
    """of the individual that walks in `twin`"""
    out: Path | None = None
    """folder for pictures; none are drawn without it"""
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    parts = PARTS if options.parts == ("all",) else options.parts
    unknown = [p for p in parts if p not in PARTS]
    strange = [o for o in options.obstacles if o not in gait_steps.OBSTACLES]
    if strange:
        sys.stderr.write(f"bench_gait: obstacle {strange[0]!r} is not one of {', '.join(gait_steps.OBSTACLES)}\n")
        return 2
    if unknown or options.seed < 0:
        wrong = f"part {unknown[0]!r} is not one of {', '.join(PARTS)}, or all" if unknown else f"--seed {options.seed} is negative"
        sys.stderr.write(f"bench_gait: {wrong}\n")
        return 2
    rows: list[Row] = []
    columns = (TextColumn("{task.description:24}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        for robot in options.robots:
            load_spec(robot)
        with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("", total=len(options.robots) * len(parts))
            for robot in options.robots:
                gaits = gait_figures.Gaits(robot)
                gaits.obstacles = options.obstacles
                for part in parts:
                    progress.update(task, description=f"{part} {robot}")
                    if part in ROWS:
                        made = ROWS[part](gaits, options.seed)
                    else:
                        made = gaits.twin(options.seed) if part == "twin" else getattr(gaits, part)()
                    for one in made:  # a part may take half an hour: told as they come
                        progress.console.print(f"{one['name']}: {figure(one['ours'])} {one['unit']}", highlight=False, soft_wrap=True)
                        rows.append(one)
                    progress.advance(task)
                if options.out is not None:
                    import gait_pictures
                    import terrain_pictures

                    gait_pictures.draw(gaits, options.out / f"gait_{robot}.png")
                    terrain_pictures.draw(gaits, options.out / f"terrain_{robot}.png")
    except AthleteError as e:
        sys.stderr.write(f"bench_gait: {' '.join(str(e).split())}\n")
        return 2
    show(rows, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
