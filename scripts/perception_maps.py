"""How true the fused map is after ten steps, where the legs could stand; and whether a leg left a ghost after twenty.

Real walks: the twin in `rock_field`, scene = seed, the sun at 15, 35 and 70 degrees in turn, no link delay, the variant
`integrated`, each proposal approved. Judged are 5 cm cells inside the union of the legs' load-bearing workspaces round the
final pose (`map_scores`). `rows` gives the table's rows, `pictures` maps of both robots; `bench_perception.py` calls both.
"""

from __future__ import annotations

import math
import multiprocessing
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bench_table import Row, row
from map_scores import GHOST_RADIUS, MapScore, score_map
from map_walks import Walk, highest_leg_ghost, walk

STEPS = 10
GHOST_STEPS = 20
GHOST_SHARE = 4
"""of so many scenes one is walked on to `GHOST_STEPS`: a walk costs a minute or two"""
MEDIAN, RMS, COVERAGE, BAND, GHOST = "<= 0.010", "<= 0.03", ">= 0.90", "0.85 - 0.95", "<= 0.05"
"""targets [m], [m], share, share, [m]"""


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Of one walk."""

    robot: str
    scene: int
    steps: int
    ended: str
    median: float
    rms: float
    coverage: float
    band: float
    ghost: float
    localisation: float


def rows(*, robots: tuple[str, ...] = ("sdm_b", "t12"), scenes: int = 20) -> list[Row]:
    """The map's rows of the perception benchmark, in DESIGN.md's format.

    Args:
        robots: by name.
        scenes: number of walks of each robot; every `GHOST_SHARE`-th is walked once more, further, for ghosts.
    """
    jobs = [(robot, scene, STEPS) for robot in robots for scene in range(scenes)]
    jobs += [(robot, scene, GHOST_STEPS) for robot in robots for scene in range(0, scenes, GHOST_SHARE)]
    done = list(measured(jobs))
    out = []
    for robot in robots:
        short = [f for f, job in zip(done, jobs, strict=True) if job[0] == robot and job[2] == STEPS]
        long = [f for f, job in zip(done, jobs, strict=True) if job[0] == robot and job[2] == GHOST_STEPS]
        out += _rows(robot, short, long)
    return out


def measured(jobs: list[tuple[str, int, int]]) -> Iterable[Figures]:
    """The walks' figures in the order of the jobs, on as many processes as there are cores, at most two."""
    workers = min(2, len(os.sched_getaffinity(0)), len(jobs))
    if workers < 2:
        yield from map(figures, jobs)
        return
    with multiprocessing.get_context("spawn").Pool(workers, maxtasksperchild=4) as pool:
        yield from pool.imap(figures, jobs)


def figures(job: tuple[str, int, int]) -> Figures:
    """Walk and judge: robot, scene, steps."""
    robot, scene, steps = job
    done = walk(robot, scene, steps=steps)
    score = scored(done)
    return Figures(
        robot=robot, scene=scene, steps=done.steps, ended=done.ended, median=score.median, rms=score.rms,
        coverage=score.coverage, band=score.band, ghost=highest_leg_ghost(done, score.reach, radius=GHOST_RADIUS),
        localisation=float(done.localisation_errors.mean()),
    )  # fmt: skip


def scored(done: Walk) -> MapScore:
    """The map at the end of a walk against the truth."""
    return score_map(done.terrain, done.truth, datum=done.datum, spec=done.spec, world_from_hex=done.world_from_hex)


def _rows(robot: str, short: list[Figures], long: list[Figures]) -> list[Row]:
    name, further = f"{robot} map, {STEPS} steps, {len(short)} scenes", f"{robot} map, {GHOST_STEPS} steps, {len(long)} scenes"
    return [
        # A walk that ends early is judged where it ended; how many did stands beside.
        row(f"{name}: walks that end before", float(sum(f.steps < STEPS for f in short)), "1"),
        row(f"{name}: median height error", _mean(short, "median"), "m", target=MEDIAN),
        row(f"{name}: RMS height error", _mean(short, "rms"), "m", target=RMS),
        row(f"{name}: coverage", _mean(short, "coverage"), "share", target=COVERAGE),
        row(f"{name}: truth in the 90 % band", _mean(short, "band"), "share", target=BAND),
        row(f"{name}: localisation error, mean", _mean(short, "localisation"), "m"),
        row(f"{further}: walks that end before", float(sum(f.steps < GHOST_STEPS for f in long)), "1"),
        row(f"{further}: highest ghost of a leg", max((f.ghost for f in long), default=math.nan), "m", target=GHOST),
    ]


def _mean(walks: list[Figures], key: str) -> float:
    return float(np.mean([getattr(f, key) for f in walks])) if walks else math.nan


def pictures(out: Path, *, scene: int = 1) -> list[Path]:
    """Height, error, sigma and age of both robots' maps after ten steps, one PNG a robot; their paths."""
    out.mkdir(parents=True, exist_ok=True)
    paths = []
    for robot in ("sdm_b", "t12"):
        path = out / f"map_{robot}.png"
        _draw(walk(robot, scene, steps=STEPS), f"{robot}, scene {scene}, after {STEPS} steps", path)
        paths.append(path)
    return paths


def _draw(done: Walk, title: str, path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    score, grid = scored(done), done.terrain.grid
    x, y = grid.centres()
    edges = (x[0] - grid.cell / 2, x[-1] + grid.cell / 2, y[0] - grid.cell / 2, y[-1] + grid.cell / 2)
    shown = score.reach | np.isfinite(grid.heights)
    hex_x, hex_y = done.world_from_hex.translation[:2]
    span = 1.25 * float(np.max(np.hypot(*(np.argwhere(score.reach) * grid.cell + [x[0] - hex_x, y[0] - hex_y]).T)))
    known = np.isfinite(grid.heights)
    layers = (
        ("height [cm]", 100 * grid.heights, "terrain", None),
        (f"error in reach [cm], median {100 * score.median:.1f}", 100 * score.error, "RdBu_r", (-5.0, 5.0)),
        (f"stated sigma [cm], band holds {score.band:.0%}", 100 * np.where(known, done.terrain.sigma, np.nan), "viridis", (0.0, 5.0)),
        ("age [min]", np.where(known, done.terrain.age(done.t), np.nan) / 60.0, "magma_r", None),
    )
    figure, axes = plt.subplots(2, 2, figsize=(11, 9.6), constrained_layout=True)
    for axis, (label, values, colours, limits) in zip(axes.flat, layers, strict=True):
        low, high = limits or tuple(np.nanpercentile(values[shown & np.isfinite(values)], [1, 99]))
        image = axis.imshow(values.T, origin="lower", extent=edges, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
        axis.contour(x, y, score.reach.T, levels=[0.5], colors="black", linewidths=0.7)
        axis.plot(hex_x, hex_y, "k+", markersize=10)
        axis.set(xlim=(hex_x - span, hex_x + span), ylim=(hex_y - span, hex_y + span), xlabel="x [m]", ylabel="y [m]", title=label)
        axis.set_aspect("equal")
        axis.set_facecolor("0.85")
        figure.colorbar(image, ax=axis, shrink=0.85)
    figure.suptitle(f"{title}; black line: where a leg could stand and carry load; grey: unknown")
    figure.savefig(path, dpi=90)
    plt.close(figure)
