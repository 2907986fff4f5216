"""Figures of a trial seen from above: what the ground believed beside what was so, and how far the two heights differ."""

from __future__ import annotations

from typing import Any

import numpy as np
from report_style import BELIEVED, INK, LEG_COLOURS, LIMIT, MUTED, TRUE, png, subplots
from trial_recording import TrialRecording

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.world.terrain import Rock

BORDER = 1.0
"""shown beyond the outermost wheels and the goal [m]"""
RELIEF = (-0.30, 0.60)
"""heights over the start's ground between which the tint runs [m]"""
TINTS = ("#8d8780", "#c9c1b4", "#e2dacb", "#f1eadc", "#fffaf0")
"""of the ground from low to high: greys of regolith, so that marks in colour stand out"""
SUN = (315.0, 38.0)
"""azimuth and elevation of the light in the maps, not the scenario's: relief reads best lit from the upper left [deg]"""
NUMBER_SPACING = 0.16
"""footfalls nearer to a later one are dots without a number [m]"""
NOTABLE_ERROR = 0.10
"""end of the error's colour scale [m]"""
NEAR_PATH = 2.5
"""errors are counted that near to the true path, as in trial.json [m]"""


def maps_figure(trial: TrialRecording) -> bytes:
    """Believed and true map side by side, with footfalls, paths, goal and the robot at the end."""
    x_range, y_range = _window(trial)
    figure, (left, right) = subplots(1, 2, figsize=_size(x_range, y_range, columns=2), sharey=True)
    footfalls = trial.footfalls()
    steps = [p for p in trial.proposals if p.kind == "step" and p.decision == "approve"]
    if trial.believed is None:
        left.text(0.5, 0.5, "no map was made", transform=left.transAxes, ha="center", color=MUTED)
    else:
        _ground(left, trial.believed.grid, datum=0.0)
        _refused(left, trial)
    _ground(right, trial.surface, datum=trial.datum)
    _rocks(right, trial)
    believed_path = np.array([p.world_from_hex.translation[:2] for p in trial.proposals]).reshape(-1, 2)
    true_path = trial.track.places[:, :2]
    for axes, path, end in (
        (left, believed_path, trial.proposals[-1].world_from_hex if trial.proposals else None),
        (right, true_path, trial.track.world_from_hex[-1]),
    ):
        _paths(axes, believed_path, true_path, ours=path is true_path)
        if end is not None:
            _chassis(axes, trial, end, colour=TRUE if path is true_path else BELIEVED)
    _marks(left, [(leg, k + 1, place[:2]) for k, p in enumerate(steps) for leg, place in p.footfalls])
    _marks(right, [(f.leg, f.number, f.contact[:2]) for f in footfalls])
    for axes, title in ((left, "What the ground believed"), (right, "What was true")):
        axes.set(xlim=x_range, ylim=y_range, title=title, xlabel="x [m]")
        axes.set_aspect("equal")
        _goal(axes, trial)
        _dress(axes)
    left.set_ylabel("y [m]")
    _legend(figure)
    return png(figure)


def map_error_figure(trial: TrialRecording) -> bytes | None:
    """Believed height less true, as a map and as a distribution; None where nothing was mapped."""
    error = trial.map_error()
    if error is None:
        return None
    x_range, y_range = _window(trial)
    width, height = _size(x_range, y_range, columns=2)
    figure, (left, right) = subplots(1, 2, figsize=(width, height - 0.5), width_ratios=(1.25, 1.0))
    x, y = error.centres()
    shown = left.imshow(
        1000.0 * error.heights.T, origin="lower", extent=_extent(error), cmap="RdBu_r",
        vmin=-1000 * NOTABLE_ERROR, vmax=1000 * NOTABLE_ERROR, interpolation="nearest",
    )  # fmt: skip
    left.set_facecolor("#d9dbde")
    path = trial.track.places[:, :2]
    left.plot(path[:, 0], path[:, 1], color=INK, lw=1.2)
    _rocks(left, trial)
    left.set(
        xlim=x_range, ylim=y_range, xlabel="x [m]", ylabel="y [m]", title="Believed height less true (grey: never seen)"
    )
    left.set_aspect("equal")
    bar = figure.colorbar(shown, ax=left, shrink=0.8, pad=0.015, extend="both")
    bar.set_label("mm")
    bar.outline.set_visible(False)
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    thinned = path[:: max(1, len(path) // 60)]
    near = np.min(np.linalg.norm(xy[:, :, None] - thinned, axis=-1), axis=2) <= NEAR_PATH
    values = 1000.0 * error.heights[near & np.isfinite(error.heights)]
    right.hist(np.clip(values, -100, 100), bins=np.linspace(-100, 100, 81), color=BELIEVED, alpha=0.8)
    right.set_yticks([])
    right.spines["left"].set_visible(False)
    right.set(xlabel="error within 2.5 m of the path [mm], ends gathered", title="How the errors spread")
    if len(values):
        said = (
            f"median of |error|  {np.median(np.abs(values)):.0f} mm\n"
            f"95 %  {np.percentile(np.abs(values), 95):.0f} mm\nmean  {np.mean(values):+.0f} mm"
        )
        right.text(0.98, 0.96, said, transform=right.transAxes, ha="right", va="top", linespacing=1.5)
    return png(figure)


def _window(trial: TrialRecording) -> tuple[tuple[float, float], tuple[float, float]]:
    places = [trial.states.wheels_in_world[..., :2].reshape(-1, 2)]
    if trial.goal is not None:
        places.append(trial.goal[None])
    every = np.concatenate(places)
    low, high = every.min(axis=0) - BORDER, every.max(axis=0) + BORDER
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))


def _size(x_range: tuple[float, float], y_range: tuple[float, float], *, columns: int) -> tuple[float, float]:
    width = 13.0
    panel = (width - 1.0) / columns
    return width, float(np.clip(panel * (y_range[1] - y_range[0]) / (x_range[1] - x_range[0]), 2.5, 7.5)) + 1.0


def _extent(grid: HeightGrid) -> tuple[float, float, float, float]:
    x, y = grid.centres()
    half = 0.5 * grid.cell
    return float(x[0]) - half, float(x[-1]) + half, float(y[0]) - half, float(y[-1]) + half


def _ground(axes: Any, grid: HeightGrid, *, datum: float) -> None:
    """Shaded relief; unseen cells grey."""
    from matplotlib.colors import LightSource, LinearSegmentedColormap, Normalize

    heights = grid.heights.T - datum
    known = np.isfinite(heights)
    # Next to unknown cells the slope is taken as level, or each border would look like a cliff.
    filled = np.where(known, heights, np.median(heights[known]) if known.any() else 0.0)
    shade = LightSource(*SUN).hillshade(filled, vert_exag=1.6, dx=grid.cell, dy=grid.cell)
    tint = LinearSegmentedColormap.from_list("regolith", TINTS)(Normalize(*RELIEF)(filled))[..., :3]
    picture = np.clip(tint * (0.42 + 0.85 * shade[..., None]), 0.0, 1.0)
    picture[~known] = (0.85, 0.86, 0.87)
    axes.imshow(picture, origin="lower", extent=_extent(grid), interpolation="bilinear" if known.all() else "nearest")


def _refused(axes: Any, trial: TrialRecording) -> None:
    """A veil of red where no wheel may stand."""
    if trial.believed is None:
        return
    grid = trial.believed.grid
    veil = np.zeros((*grid.shape[::-1], 4))
    veil[(~trial.believed.allowed & np.isfinite(grid.heights)).T] = (0.83, 0.18, 0.13, 0.30)
    axes.imshow(veil, origin="lower", extent=_extent(grid), interpolation="nearest")


def _rocks(axes: Any, trial: TrialRecording) -> None:
    from matplotlib.patches import Circle

    terrain = trial.terrain()
    rocks: tuple[Rock, ...] = terrain.rocks if terrain is not None else ()
    for rock in rocks:
        axes.add_patch(Circle((rock.x, rock.y), 0.5 * rock.diameter, fill=False, ec="#57534e", lw=0.8, alpha=0.9))


def _paths(axes: Any, believed: np.ndarray, true: np.ndarray, *, ours: bool) -> None:
    axes.plot(true[:, 0], true[:, 1], color=TRUE, lw=2.0 if ours else 1.2, alpha=1.0 if ours else 0.7, zorder=4)
    axes.plot(
        believed[:, 0], believed[:, 1], color=BELIEVED, lw=1.2 if ours else 2.0, ls=(0, (4, 2)), zorder=5,
        alpha=0.7 if ours else 1.0,
    )  # fmt: skip


def _chassis(axes: Any, trial: TrialRecording, world_from_hex: SE3, *, colour: str) -> None:
    """Outline of the hips, and a line towards the front."""
    corners = world_from_hex.apply(trial.spec.hips_in_hex)
    middle = world_from_hex.translation
    order = np.argsort(np.arctan2(corners[:, 1] - middle[1], corners[:, 0] - middle[0]))
    axes.fill(corners[order, 0], corners[order, 1], fc=(1, 1, 1, 0.35), ec=colour, lw=1.6, zorder=3)
    nose = world_from_hex.apply(np.array([0.55, 0.0, 0.0]))
    axes.annotate("", nose[:2], middle[:2], arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.4}, zorder=6)


def _marks(axes: Any, steps: list[tuple[int, int, np.ndarray]]) -> None:
    """Numbered discs in the legs' colours, joined leg by leg; under a later one an earlier one is only a dot."""
    for leg, colour in enumerate(LEG_COLOURS):
        places = np.array([xy for of, _, xy in steps if of == leg]).reshape(-1, 2)
        axes.plot(places[:, 0], places[:, 1], color=colour, lw=1.0, alpha=0.8, zorder=6)
    taken: list[np.ndarray] = []
    for leg, number, xy in reversed(steps):
        crowded = any(np.linalg.norm(xy - other) < NUMBER_SPACING for other in taken)
        colour = LEG_COLOURS[leg]
        if crowded:
            axes.plot(*xy, "o", ms=3.5, color=colour, mec="white", mew=0.4, zorder=7)
            continue
        taken.append(xy)
        axes.plot(*xy, "o", ms=11, color=colour, mec="white", mew=0.8, zorder=8)
        axes.text(*xy, str(number), color="white", fontsize=6.2, ha="center", va="center_baseline", zorder=9, weight="bold")


def _goal(axes: Any, trial: TrialRecording) -> None:
    from matplotlib.patches import Circle

    if trial.goal is None:
        return
    centre = (float(trial.goal[0]), float(trial.goal[1]))
    axes.add_patch(Circle(centre, 0.30, fc=(1, 1, 1, 0.5), ec=LIMIT, lw=1.4, ls=(0, (3, 2)), zorder=6))
    axes.plot(*trial.goal, marker="*", ms=13, color=LIMIT, mec="white", mew=0.8, zorder=6.5)


def _dress(axes: Any) -> None:
    axes.tick_params(length=3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)


def _legend(figure: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [
        Line2D([], [], color=TRUE, lw=2, label="true path of the chassis"),
        Line2D([], [], color=BELIEVED, lw=2, ls=(0, (4, 2)), label="believed path"),
        Patch(fc=(0.83, 0.18, 0.13, 0.35), label="no footfall allowed"),
        Line2D([], [], marker="o", ls="", mfc="none", mec="#57534e", label="rock"),
        Line2D([], [], marker="*", ls="", ms=11, color=LIMIT, label="goal"),
        *(Line2D([], [], marker="o", ls="", ms=8, color=c, label=f"leg {n + 1}") for n, c in enumerate(LEG_COLOURS)),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=11, columnspacing=1.2, handletextpad=0.4)
