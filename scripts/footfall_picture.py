"""The agreement experiment as one picture: the paper's table and ours, what height error changes, and one region."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from footfall_experiment import CELL, CHOOSERS, FOOT, JUDGES, NAMES, REGION_CELLS, SIDE, Region
from matplotlib.colors import PowerNorm
from matplotlib.patches import Rectangle
from report_style import INK, png, subplots

COLOURS = {
    "max_min": "#1f77b4", "plane_fit": "#e69f00", "support_area": "#c0392b", "free_volume": "#1b9e77", "equilibrium": "#5b4bb0",
}  # fmt: skip


def draw(found: dict[str, Any], chosen: Sequence[Region]) -> bytes:
    """Picture of `footfall_agreement.results`, as PNG.

    Args:
        found: the results.
        chosen: regions of the first seed.
    """
    figure, axes = subplots(2, 3, figsize=(15.0, 8.4), gridspec_kw={"width_ratios": [1.0, 1.0, 1.15]})
    _heat(axes[0, 0], found["paper"], "paper, 1989")
    _heat(axes[0, 1], found["one"], f"seed {found['seed']}, {100 * found['error_m']:.0f} cm of error")
    _by_error(axes[0, 2], found)
    _heat(axes[1, 0], found["errors"][0], f"{found['seeds']} seeds, no error")
    _heat(axes[1, 1], found["errors"][2], f"{found['seeds']} seeds, 5 cm of error")
    apart = [len({one.best(method) for method in CHOOSERS}) for one in chosen]
    _region(axes[1, 2], chosen[int(np.argmax(apart))], int(np.argmax(apart)) + 1)
    return png(figure)


def _heat(axes: Any, one: dict[str, Any], title: str) -> None:
    values = np.array(one["table"])[: len(CHOOSERS)]
    means = one["row_means"]["printed"][: len(CHOOSERS)]
    axes.imshow(values, cmap="YlOrRd", norm=PowerNorm(0.5, vmin=0.0, vmax=45.0), aspect="auto")
    for (row, column), value in np.ndenumerate(values):
        if CHOOSERS[row] != JUDGES[column]:
            axes.text(column, row, f"{value:.1f}", ha="center", va="center", color="white" if value > 22 else INK)
    for row, mean in enumerate(means):
        axes.text(len(JUDGES) - 0.35, row, f"{mean:.1f}", ha="left", va="center", fontweight="bold")
    axes.text(len(JUDGES) - 0.35, len(CHOOSERS) - 0.33, "mean", ha="left", va="center", fontweight="bold")
    axes.set_xticks(range(len(JUDGES)), [NAMES[j].replace(" ", "\n") for j in JUDGES])
    axes.set_yticks(range(len(CHOOSERS)), [NAMES[m] for m in CHOOSERS])
    axes.tick_params(length=0)
    axes.set_xlabel("judged by")
    axes.set_ylabel("chosen by")
    axes.set_title(f"{title} [%]")
    for side in axes.spines.values():
        side.set_visible(False)


def _by_error(axes: Any, found: dict[str, Any]) -> None:
    """Lines over the four errors; the paper's means beside them."""
    places = np.arange(len(found["errors"]))
    for k, method in enumerate(CHOOSERS):
        means = [one["row_means"]["printed"][k] for one in found["errors"]]
        spread = [one["row_means_deviation"]["printed"][k] for one in found["errors"]]
        at = places + 0.06 * (k - 2)
        axes.errorbar(at, means, yerr=spread, color=COLOURS[method], marker="o", ms=4, lw=1.4, capsize=2, label=NAMES[method])
        axes.plot(len(places) + 0.06 * (k - 2), found["paper"]["row_means"]["printed"][k], "D", color=COLOURS[method], ms=6)
    axes.set_xticks([*places, len(places)], [*(f"{100 * one['error_m']:.0f} cm" for one in found["errors"]), "paper"])
    axes.set_xlabel("height error, one sigma")
    axes.set_ylabel("mean disagreement of a row, eq. 11 [%]")
    axes.set_ylim(bottom=0.0)
    axes.grid(axis="y")
    axes.legend(loc="upper left")
    axes.set_title(f"{found['ground']}, {found['seeds']} seeds")


def _region(axes: Any, region: Region, number: int) -> None:
    """Elevations of one region and each method's choice, each a little smaller, so that equal ones stay visible."""
    edge = 100 * REGION_CELLS * CELL
    relative = 100 * (region.heights - region.heights.min())
    image = axes.imshow(relative.T, origin="lower", cmap="Greys_r", extent=(0, edge, 0, edge))
    axes.figure.colorbar(image, ax=axes, label="height [cm]", shrink=0.9)
    for k, method in enumerate(CHOOSERS):
        i, j = region.best(method)
        inset = 0.5 + 0.9 * k
        side = 100 * FOOT - 2 * inset
        corner = (100 * CELL * i + inset, 100 * CELL * j + inset)
        axes.add_patch(Rectangle(corner, side, side, fill=False, lw=1.8, ec=COLOURS[method], label=NAMES[method]))
    axes.set_xlabel("x [cm]")
    axes.set_ylabel("y [cm]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)
    axes.set_title(f"region {number} of {SIDE * SIDE}, where most choices differ")
