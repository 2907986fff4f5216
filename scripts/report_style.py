"""Looks that all reports share: the page with its style sheet, colours, type, and PNG bytes out of a matplotlib figure."""

from __future__ import annotations

import base64
import html
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
STYLE = """
:root { color-scheme: light; --ink: #24292f; --muted: #6b7280; --line: #e5e7eb; --paper: #ffffff; --back: #f6f7f9 }
* { box-sizing: border-box }
body { margin: 0; background: var(--back); color: var(--ink); line-height: 1.45;
  font: 15px/1.45 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif }
main { max-width: 1180px; margin: 0 auto; padding: 28px 20px 60px }
header h1 { font-size: 26px; margin: 0 0 2px; letter-spacing: -0.01em }
header p { margin: 4px 0; color: var(--muted) }
.badge { display: inline-block; border-radius: 999px; padding: 3px 14px; font-weight: 600; font-size: 15px; color: #fff }
.good { background: #15803d } .fair { background: #b45309 } .bad { background: #b91c1c }
.reason { margin-left: 10px; overflow-wrap: anywhere }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 10px;
  padding: 18px 20px; margin-top: 18px }
h2 { font-size: 17px; margin: 0 0 10px } section > p { margin: 0 0 12px; color: var(--muted); max-width: 85ch }
img { display: block; width: 100%; height: auto } img.narrow { max-width: 900px; margin: 0 auto }
.tiles { display: flex; flex-wrap: wrap; gap: 12px; margin-top: 18px } .tile { flex: 1 1 110px }
.tile { background: var(--paper); border: 1px solid var(--line); border-radius: 10px; padding: 12px 14px }
.tile b { display: block; font-size: 22px; font-weight: 650; font-variant-numeric: tabular-nums }
.tile span { color: var(--muted); font-size: 13px }
.bar { display: flex; height: 26px; border-radius: 6px; overflow: hidden }
.bar div { min-width: 0 }
.key { display: flex; flex-wrap: wrap; gap: 6px 22px; margin-top: 10px; font-variant-numeric: tabular-nums }
.key i { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 7px }
.tables { display: flex; flex-wrap: wrap; gap: 4px 36px } .tables > div { flex: 1 1 420px }
table { border-collapse: collapse; width: 100% }
td, th { padding: 5px 8px 5px 0; border-bottom: 1px solid var(--line); vertical-align: top; text-align: left }
th { color: var(--muted); font-weight: 500 }
td.n, th.n { text-align: right; padding-right: 14px; font-variant-numeric: tabular-nums; white-space: nowrap }
tr.rejected td { color: #b91c1c } caption { text-align: left; font-weight: 600; padding: 8px 0 4px }
.disc { display: inline-block; min-width: 20px;
  border-radius: 10px; color: #fff; text-align: center; font-size: 12px; font-weight: 600; padding: 0 6px }
summary { cursor: pointer; font-weight: 600 } footer { color: var(--muted); font-size: 13px; margin-top: 22px; overflow-wrap: anywhere }
.scroll { overflow-x: auto }
h3 { font-size: 15px; margin: 18px 0 6px } ul { margin: 8px 0; padding-left: 20px } li { margin: 4px 0; overflow-wrap: anywhere }
.pair { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 440px), 1fr)); gap: 18px 28px; align-items: start }
figure { margin: 0; min-width: 0; max-width: 680px } figcaption { font-weight: 600; margin-bottom: 6px } details { margin-top: 10px }
.name { white-space: nowrap } .name i { display: inline-block; width: 11px; height: 11px; border-radius: 3px; margin-right: 7px }
p.small { font-size: 13px; margin: 4px 0; color: var(--muted) }
table.wrap th.n { white-space: normal } .badge.small { font-size: 13px; padding: 1px 10px; white-space: nowrap }
tr.strong td { font-weight: 600 }
"""
"""of the pages"""

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


def page(title: str, body: str) -> str:
    """An HTML page that needs nothing else; the body is HTML, the title is text."""
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head>'
        f"<body><main>{body}</main></body></html>\n"
    )


def image(alt: str, data: bytes, *, kind: str = "") -> str:
    """A PNG inside the page.

    Args:
        alt: what it shows, as text.
        data: the PNG.
        kind: class of the style sheet.
    """
    size = f' class="{kind}"' if kind else ""
    return f'<img{size} alt="{html.escape(alt)}" src="data:image/png;base64,{base64.b64encode(data).decode()}">'


def picture(title: str, text: str, data: bytes | None, *, narrow: bool = False) -> str:
    """A section of one picture below a heading and a paragraph of HTML; nothing without a picture."""
    if data is None:
        return ""
    words = f"<p>{text}</p>" if text else ""
    return f"<section><h2>{title}</h2>{words}{image(title, data, kind='narrow' if narrow else '')}</section>"


def leg_legend(axes: Any, **kwargs: Any) -> None:
    """Names the colours of the legs."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=c, lw=3, label=f"leg {n + 1}") for n, c in enumerate(LEG_COLOURS)]
    axes.legend(handles=handles, **kwargs)
