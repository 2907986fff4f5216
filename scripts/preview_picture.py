"""A picture of a proposal: top view with green and red cells, the footfall and the chassis' path; side view of the motion."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np

from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import LEGS
from envs.recorder import cropped
from planner.decisions import Proposal

mpl.use("Agg")

DRAWN_POSES = 6
"""of the preview in the side view: more blur into each other"""


def save_preview(proposal: Proposal, robot: str, path: Path) -> None:
    """Writes the picture of a proposal as PNG."""
    from matplotlib import pyplot as plt

    kin = kinematics(robot)
    figure, (top, side) = plt.subplots(1, 2, figsize=(13, 6.2), width_ratios=(1.0, 1.1), layout="constrained")
    _top_view(top, proposal)
    preview, count = proposal.preview, len(proposal.preview.times)
    for shade, k in enumerate(np.unique(np.linspace(0, count - 1, min(count, DRAWN_POSES)).astype(int))):
        world_from_hex = preview.world_from_hex[k]
        poses = kin.link_poses(preview.joints[k])
        for leg in range(LEGS):
            names = [f"leg{leg + 1}_{joint}" for joint in kin.spec.joint_names] + [f"wheel{leg + 1}"]
            line = world_from_hex.apply(np.array([poses[n].translation for n in names]))
            moving = leg == proposal.leg
            strength = 0.25 + 0.7 * (shade + 1) / DRAWN_POSES
            colour = "tab:orange" if moving else "0.35"
            side.plot(
                line[:, 0],
                line[:, 2],
                color=colour,
                alpha=strength if moving else 0.3 * strength,
                lw=2 if moving else 1,
            )
            top.plot(line[:, 0], line[:, 1], color=colour, alpha=strength if moving else 0.3 * strength, lw=1.5)
        ring = world_from_hex.apply(np.vstack([kin.spec.hips_in_hex, kin.spec.hips_in_hex[:1]]))
        side.plot(ring[:, 0], ring[:, 2], color="0.35", alpha=0.3, lw=2)
        top.plot(ring[:, 0], ring[:, 1], color="0.35", alpha=0.3, lw=1)
    _ground_line(side, proposal)
    side.set(xlabel="x [m]", ylabel="z [m]", title="from the right side, orange: the leg that swings")
    side.set_aspect("equal")
    margin = "unknown" if not np.isfinite(proposal.predicted_margin) else f"{proposal.predicted_margin:.2f} m"
    faults = "".join(f"\n{fault.code} after {fault.t:.0f} s: {fault.text}" for fault in preview.faults)
    figure.suptitle(
        f"Proposal {proposal.index}: {proposal.text}\n{preview.duration:.0f} s, least margin {margin}, "
        f"sag {proposal.predicted_sag:.3f} m{faults}",
        color="tab:red" if faults else "black",
    )
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _top_view(axes: object, proposal: Proposal) -> None:
    from matplotlib.axes import Axes

    if not isinstance(axes, Axes):
        return
    grid, ok = cropped(proposal)
    x, y = grid.centres()
    known = np.isfinite(grid.heights)
    colours = np.full((*grid.shape, 3), 0.85)
    # Percentiles: a single spike in the map must not turn everything else dark.
    low, high = np.percentile(grid.heights[known], [2, 98]) if known.any() else (0.0, 1.0)
    relief = np.where(known, grid.heights, low)
    shade = 0.6 + 0.4 * np.clip((relief - low) / max(float(high - low), 1e-3), 0.0, 1.0)
    green, red = np.array([0.45, 0.8, 0.45]), np.array([0.9, 0.45, 0.4])
    colours[known] = (np.where(ok[..., None], green, red) * shade[..., None])[known]
    extent = (float(x[0]), float(x[-1]), float(y[0]), float(y[-1]))
    axes.imshow(np.clip(colours, 0, 1).transpose(1, 0, 2), origin="lower", extent=extent)
    path = np.array([p.translation for p in proposal.preview.world_from_hex])
    axes.plot(path[:, 0], path[:, 1], "k.-", lw=1, ms=3)
    axes.plot(*proposal.footfall_in_world[:2], "*", color="gold", mec="k", ms=16)
    axes.set(xlabel="x [m]", ylabel="y [m]", title="green: a wheel may stand; red: not; grey: unseen")
    axes.set_xlim(extent[0], extent[1])
    axes.set_ylim(extent[2], extent[3])


def _ground_line(axes: object, proposal: Proposal) -> None:
    """Believed ground along x through the footfall."""
    from matplotlib.axes import Axes

    if isinstance(axes, Axes):
        x, _ = proposal.terrain.centres()
        y = float(proposal.footfall_in_world[1])
        heights = proposal.terrain.sample(np.column_stack([x, np.full(len(x), y)]))
        near = np.abs(x - proposal.world_from_hex.translation[0]) < 4.0
        axes.plot(x[near], heights[near], color="saddlebrown", lw=1.5)
