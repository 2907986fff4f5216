"""Looks that the figures of all reports share: colours, type, and PNG bytes out of a matplotlib figure."""

from __future__ import annotations

import io
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

INK = "#24292f"
MUTED = "#6b7280"
GRID = "#e5e7eb"
TRUE, BELIEVED = "#c2410c", "#1d4ed8"
"""colours of what was and of what the ground believed"""
LEG_COLOURS = ("#1f77b4", "#e69f00", "#1b9e77", "#cc5fa0", "#5b4bb0", "#c0392b")
"""of legs 1 to 6, also told apart in print by the numbers beside them"""
BIN_COLOURS = {"motion": "#3b6fb5", "link": "#e0a63a", "ground": "#5c9e78", "operator": "#8c62a8"}
LIMIT = "#b91c1c"
DPI = 150

_STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#9ca3af",
    "axes.linewidth": 0.8,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


def subplots(*args: Any, **kwargs: Any) -> Any:
    """`matplotlib.pyplot.subplots` in the house's looks, laid out so that nothing overlaps."""
    from matplotlib import pyplot as plt

    mpl.rcParams.update(_STYLE)
    return plt.subplots(*args, layout="constrained", **kwargs)


def png(figure: Any, *, dpi: int = DPI) -> bytes:
    """The figure as PNG; it is closed."""
    from matplotlib import pyplot as plt

    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=dpi, metadata={"Software": None})
    plt.close(figure)
    return out.getvalue()


def leg_legend(axes: Any, **kwargs: Any) -> None:
    """Names the colours of the legs."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=c, lw=3, label=f"leg {n + 1}") for n, c in enumerate(LEG_COLOURS)]
    axes.legend(handles=handles, **kwargs)
