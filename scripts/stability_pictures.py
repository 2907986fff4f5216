"""The stability map as a picture: for each leg the ground in green and red, by the first reason that refused a cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from stability_scene import StabilityScene

from athlete_twin.model.spec import LEGS
from planner.stability.ground_map import REASONS, GroundMap

COLOURS = ("#2e9e4f", "#d1d5db", "#f3f4f6", "#fbcfe8", "#7f1d1d", "#f59e0b", "#7c3aed", "#dc2626")
"""of the reasons, in their order"""
WORDS = {
    "ok": "may step here", "unknown": "unknown ground", "unreachable": "out of reach", "last_link": "last link not plumb",
    "collision": "collision", "margin": "support margin", "torque": "joint torque", "ground": "ground: steep, rough, uncertain",
}  # fmt: skip


def draw(scene: StabilityScene, maps: tuple[GroundMap, ...], title: str, path: Path) -> Path:
    """Six panels, a leg each, over the hill-shaded terrain; the path."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.colors import LightSource, to_rgb
    from matplotlib.patches import Patch

    grid, spec = scene.terrain, scene.kinematics.spec
    x, y = grid.centres()
    half = 0.5 * grid.cell
    extent = (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half)
    light = LightSource(azdeg=315.0, altdeg=40.0).hillshade(grid.heights.T, vert_exag=1.5, dx=grid.cell, dy=grid.cell)
    palette = np.array([to_rgb(colour) for colour in COLOURS])
    wheels = scene.world_from_hex.apply(scene.kinematics.wheels_in_hex(scene.joints))
    hips = scene.world_from_hex.apply(np.array(spec.hips_in_hex))
    figure, axes = plt.subplots(2, 3, figsize=(12.5, 8.8), constrained_layout=True)
    for leg, axis in zip(range(LEGS), axes.flat, strict=True):
        picture = palette[maps[leg].reason.T] * (0.55 + 0.45 * light[..., None])
        axis.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
        axis.fill(hips[:, 0], hips[:, 1], facecolor="none", edgecolor="black", linewidth=1.2)
        others = [other for other in range(LEGS) if other != leg]
        axis.plot(*hips[others].T[:2], "k.", markersize=4)
        axis.plot(*wheels[others].T[:2], "o", color="white", markeredgecolor="black", markersize=7)
        axis.plot([hips[leg, 0], wheels[leg, 0]], [hips[leg, 1], wheels[leg, 1]], color="black", linewidth=2)
        axis.plot(*wheels[leg, :2], "o", color="black", markersize=9)
        share = 100.0 * maps[leg].ok.mean()
        axis.set(title=f"leg {leg + 1}: {share:.0f} % of the map is green", xlabel="x [m]", ylabel="y [m]")
    named = [Patch(facecolor=colour, edgecolor="0.5", label=WORDS[name]) for colour, name in zip(COLOURS, REASONS, strict=True)]
    figure.legend(handles=named, loc="outside lower center", ncols=len(named) // 2)
    figure.suptitle(title)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=85)
    plt.close(figure)
    return path
