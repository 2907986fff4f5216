"""The figures of `view_analysis.py`: ground seen and hidden, the gap by radius, and how many pairs see each cell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from report_style import INK, LIMIT, MUTED, png, subplots
from view_sight import Sight

from athlete_twin.geometry.arrays import Joints
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.stance import regular_stance

SEEN = {"navcam": "#7fb2e5", "hazcam": "#86c79a", "toolcam": "#e9c46a"}
HIDDEN, UNSEEN = "#5b6470", "#f4d7d4"


def draw(out: Path, spec: RobotSpec, down: Sight, lifted: Sight, rings: tuple[np.ndarray, np.ndarray]) -> list[Path]:
    """Write the robot's figures to a folder; their paths.

    Args:
        out: folder that exists.
        spec: the drawings.
        down: sight with all legs down.
        lifted: sight with leg 1 in the air.
        rings: inner radii [m] and the share seen of each ring.
    """
    files = {"views": _views(spec, down, lifted), "rings": _rings(spec, down, rings), "overlap": _overlap(spec, down)}
    paths = []
    for name, figure in files.items():
        path = out / f"{spec.name}_{name}.png"
        path.write_bytes(png(figure))
        paths.append(path)
    return paths


def _views(spec: RobotSpec, down: Sight, lifted: Sight) -> Any:
    """Seen and hidden ground, legs down and leg 1 up."""
    figure, axes = subplots(1, 2, figsize=(11.0, 6.0), sharey=True)
    for ax, view, title in ((axes[0], down, "all legs down"), (axes[1], lifted, "leg 1 lifted")):
        picture = np.empty((*view.framed.shape[1:], 3))
        picture[:] = _rgb(UNSEEN)
        picture[view.framed_by("navcam", "hazcam")] = _rgb(HIDDEN)
        for group in ("navcam", "hazcam", "toolcam"):
            if group in view.groups:
                picture[view.by(group)] = _rgb(SEEN[group])
        _ground(ax, view, picture)
        _robot(ax, spec)
        ax.set_title(f"{spec.title}: {title}")
        ax.set_xlabel("y in hex [m]")
    axes[0].set_ylabel("x in hex [m]")
    named = [(SEEN[g], f"seen by {g[:-3].capitalize()}Cams") for g in ("navcam", "hazcam", "toolcam") if g in down.groups]
    _legend(figure, [*named, (HIDDEN, "in a picture, hidden by the robot"), (UNSEEN, "in no picture")])
    return figure


def _rings(spec: RobotSpec, down: Sight, rings: tuple[np.ndarray, np.ndarray]) -> Any:
    """Share of ground seen over the distance from the axis."""
    figure, ax = subplots(figsize=(7.5, 3.6))
    edges, share = rings
    width = float(edges[1] - edges[0])
    middle = edges + 0.5 * width
    index = np.floor(down.radius() / width).astype(int)
    inside = index < len(edges)
    total = np.maximum(np.bincount(index[inside], minlength=len(edges)), 1)
    for group in ("navcam", "hazcam"):
        part = np.bincount(index[inside], weights=down.by(group)[inside], minlength=len(edges)) / total
        ax.fill_between(middle, 100 * part, color=SEEN[group], alpha=0.6, lw=0, label=f"{group[:-3].capitalize()}Cams")
    ax.plot(middle, 100 * share, color=INK, lw=1.4, label="together")
    ax.axhline(30, color=LIMIT, lw=0.9, ls="--")
    ax.text(float(middle[-1]), 32, "30 %", color=LIMIT, ha="right", va="bottom", fontsize=8)
    ax.axvline(spec.foot_radius, color=MUTED, lw=0.9, ls=":")
    ax.text(spec.foot_radius + 0.05, 3, "wheels", color=MUTED, fontsize=8)
    ax.set(xlabel="distance from the chassis' axis [m]", ylabel="ground seen by both eyes [%]", ylim=(0, 103), xlim=(0, middle[-1]))
    ax.set_title(f"{spec.title}: where the views gap")
    ax.legend(loc="lower right")
    return figure


def _overlap(spec: RobotSpec, down: Sight) -> Any:
    """How many pairs of the chassis see each cell."""
    figure, ax = subplots(figsize=(6.4, 5.6))
    chassis = np.array([g != "toolcam" for g in down.groups])
    count = down.seen[chassis].sum(axis=0)
    from matplotlib import colormaps
    from matplotlib.colors import BoundaryNorm

    most = max(int(count.max()), 2)
    shades = colormaps["YlGnBu"].resampled(most + 1)
    shown = ax.imshow(
        count, origin="lower", extent=_extent(down), cmap=shades, norm=BoundaryNorm(np.arange(most + 2) - 0.5, most + 1)
    )
    _robot(ax, spec)
    bar = figure.colorbar(shown, ax=ax, shrink=0.85, ticks=range(most + 1))
    bar.set_label("pairs that see it")
    ax.set(xlabel="y in hex [m]", ylabel="x in hex [m]", title=f"{spec.title}: overlap of the views")
    ax.invert_xaxis()
    return figure


def _ground(ax: Any, view: Sight, picture: np.ndarray) -> None:
    ax.imshow(picture, origin="lower", extent=_extent(view), interpolation="nearest")
    ax.invert_xaxis()


def _extent(view: Sight) -> tuple[float, float, float, float]:
    half = 0.5 * float(view.x[1] - view.x[0])
    return (view.y[0] - half, view.y[-1] + half, view.x[0] - half, view.x[-1] + half)


def _robot(ax: Any, spec: RobotSpec) -> None:
    """Hips, legs in plan and wheels with their numbers; x is drawn up, y to the left."""
    from matplotlib import patheffects

    joints: Joints = regular_stance(spec)
    links = kinematics(spec.name).link_poses(joints)
    hips = np.vstack([spec.hips_in_hex, spec.hips_in_hex[:1]])
    ax.plot(hips[:, 1], hips[:, 0], color=INK, lw=1.2)
    for leg in range(LEGS):
        names = [f"leg{leg + 1}_{j.name}" for j in spec.joints] + [f"wheel{leg + 1}"]
        chain = np.array([links[n].translation for n in names])
        ax.plot(chain[:, 1], chain[:, 0], color=INK, lw=1.6, solid_capstyle="round")
        out = chain[-1, :2] * (1.0 + 0.35 / np.linalg.norm(chain[-1, :2]))
        ax.plot(chain[-1, 1], chain[-1, 0], "o", color=INK, ms=5)
        label = ax.text(out[1], out[0], str(leg + 1), color=INK, ha="center", va="center", fontsize=9, fontweight="bold")
        label.set_path_effects([patheffects.withStroke(linewidth=2.5, foreground="white")])


def _legend(figure: Any, entries: list[tuple[str, str]]) -> None:
    from matplotlib.patches import Patch

    figure.legend(
        handles=[Patch(facecolor=c, label=name) for c, name in entries], loc="outside lower center", ncols=len(entries)
    )


def _rgb(colour: str) -> tuple[float, float, float]:
    return tuple(int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))  # type: ignore[return-value]
