"""The figures of `validate_twin.py`: corner heights as in the paper's figures 11 and 12, wheel loads, torque, slopes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from report_style import BELIEVED, GRID, INK, LEG_COLOURS, LIMIT, MUTED, TRUE, png, subplots
from validate_rows import ALL, ONE, PUBLISHED_TORQUE, TWO, Measured, zero_interaction_torque

from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import LEGS
from athlete_twin.model.statics import stance_loads

PANELS = {
    "sdm_b": ((ALL, "six wheels down"), ((4,), "leg 5 lifted"), ((1, 4), "legs 2 and 5 lifted")),
    "t12": ((ALL, "six wheels down"), ((1,), "leg 2 lifted"), ((0,), "leg 1, at a pallet corner, lifted")),
}
NAMES = {ALL: "six wheels down", ONE: "leg 1 lifted", TWO: "legs 1 and 4 lifted"}
NUMBERS = np.arange(1, LEGS + 1)


def draw(out: Path, robots: Sequence[Measured]) -> list[Path]:
    """Writes the figures; their paths."""
    out.mkdir(parents=True, exist_ok=True)
    figures = {"corner_heights": _corner_heights(robots), "wheel_loads": _wheel_loads(robots), "torque": _torque(robots)}
    if any(m.slides for m in robots):
        figures["slope"] = _slope(next(m for m in robots if m.slides))
    paths = []
    for name, figure in figures.items():
        paths.append(out / f"{name}.png")
        paths[-1].write_bytes(png(figure))
    return paths


def _corner_heights(robots: Sequence[Measured]) -> Any:
    figure, grid = subplots(len(robots), 3, figsize=(10.5, 3.1 * len(robots)), squeeze=False, sharey="row")
    for row, measured in zip(grid, robots, strict=True):
        fit = measured.fit
        order = list(measured.stances)
        for letter, axes, (lifted, name) in zip("ABC", row, PANELS[measured.spec.name], strict=True):
            heights = measured.stances[lifted].corner_heights
            predicted = heights + fit.errors[order.index(lifted)]
            _shade_lifted(axes, lifted)
            axes.axhline(100.0 * measured.spec.chassis_height, color=MUTED, lw=0.8, ls=":", label="without sag")
            axes.plot(NUMBERS, 100.0 * heights, "o", color=TRUE, ms=6, label="measured on the twin")
            label = f"predicted, {fit.stiffness / 1e3:.1f} kN/m a foot"
            axes.plot(NUMBERS, 100.0 * predicted, "_-", color=BELIEVED, ms=11, mew=2, lw=1, label=label)
            axes.set_title(f"({letter}) {name}")
            axes.set_xlabel("corner, by its leg")
            axes.set_xticks(NUMBERS)
            axes.grid(axis="y")
        row[0].set_ylabel(f"{measured.spec.title}\ncorner height [cm]")
        row[0].legend(loc="lower left")
        low, high = row[0].get_ylim()
        row[0].set_ylim(low - 0.35 * (high - low), high)
    return figure


def _wheel_loads(robots: Sequence[Measured]) -> Any:
    figure, grid = subplots(len(robots), 3, figsize=(10.5, 3.0 * len(robots)), squeeze=False, sharey=True)
    for row, measured in zip(grid, robots, strict=True):
        for axes, lifted in zip(row, (ALL, ONE, TWO), strict=True):
            _shade_lifted(axes, lifted)
            loads = measured.stances[lifted].loads
            on = ~np.isin(np.arange(LEGS), lifted)
            if measured.sets:
                drawn = np.array([rests[lifted].loads for rests in measured.sets])
                low, high = np.percentile(drawn, [5.0, 95.0], axis=0)
                label = f"5-95 % of {len(drawn)} sets of tyres"
                axes.vlines(NUMBERS[on], low[on], high[on], color=TRUE, lw=7, alpha=0.25, label=label)
            axes.plot(NUMBERS[on], loads[on], "o", color=TRUE, ms=5, label="twin, equal tyres")
            # On SDM-B's hexagon these are the published shares.
            rigid = stance_loads(kinematics(measured.spec.name), measured.stances[lifted].commands, supporting=on)[0][:, 2]
            label = "published" if measured.spec.name == "sdm_b" else "drawings, zero interaction"
            axes.plot(NUMBERS[on], (rigid / rigid.sum())[on], "_", color=INK, ms=15, mew=1.4, label=label)
            axes.set_title(NAMES[lifted])
            axes.set_xlabel("wheel of leg")
            axes.set_xticks(NUMBERS)
            axes.set_ylim(0.0, 0.37)
            axes.grid(axis="y")
        row[0].set_ylabel(f"{measured.spec.title}\nload over weight")
        row[0].legend(loc="lower left")
    return figure


def _torque(robots: Sequence[Measured]) -> Any:
    figure, grid = subplots(1, len(robots), figsize=(1.2 + 4.2 * len(robots), 3.6), squeeze=False, sharey=True)
    for axes, measured in zip(grid[0], robots, strict=True):
        for place, lifted in enumerate((ALL, ONE, TWO)):
            first = place == 1
            if measured.sets:
                drawn = 100.0 * np.array([rests[lifted].torque for rests in measured.sets])
                beside = place - 0.18 + 0.08 * np.sin(2.4 * np.arange(len(drawn)))
                axes.plot(beside, drawn, ".", color=TRUE, ms=4, alpha=0.35, mew=0, label=_once(first, f"{len(drawn)} sets of tyres"))
            twin, ideal = 100.0 * measured.stances[lifted].torque, 100.0 * zero_interaction_torque(measured.spec, lifted)
            axes.plot(place, twin, "o", color=TRUE, ms=7, label=_once(first, "twin, equal tyres"))
            axes.plot(place + 0.18, ideal, "D", mfc="white", color=BELIEVED, ms=6, label=_once(first, "drawings, zero interaction"))
            axes.annotate(f"{twin:.1f}", (place, twin), xytext=(0, -13), textcoords="offset points", ha="center", color=TRUE, fontsize=8)
            if measured.spec.name == "sdm_b" and lifted in PUBLISHED_TORQUE:
                value = PUBLISHED_TORQUE[lifted]
                axes.fill_between([place - 0.36, place + 0.36], value - 2.0, value + 2.0, color=GRID, zorder=0)
                axes.hlines(value, place - 0.36, place + 0.36, color=INK, lw=1.4, label=_once(first, "published, 2 points each way"))
        axes.set_xticks(range(3), [NAMES[k].replace(" lifted", "\nlifted").replace("six wheels ", "six wheels\n") for k in (ALL, ONE, TWO)])
        axes.set_xlim(-0.5, 2.5)
        axes.set_title(measured.spec.title)
        axes.grid(axis="y")
        axes.legend(loc="upper left")
    grid[0, 0].set_ylabel("peak joint torque [% of limit]")
    top = max(axes.get_ylim()[1] for axes in grid[0])
    grid[0, 0].set_ylim(0.0, 1.38 * top)
    return figure


def _slope(measured: Measured) -> Any:
    figure, axes = subplots(figsize=(6.2, 3.8))
    angles = sorted(measured.slides)
    for leg in range(LEGS):
        slides = [100.0 * measured.slides[a].downhill[leg] for a in angles]
        axes.plot(np.array(angles) + 0.13 * (leg - 2.5), slides, "o", color=LEG_COLOURS[leg], ms=5, label=f"leg {leg + 1}")
    largest = [100.0 * measured.slides[a].downhill.max() for a in angles]
    axes.plot(angles, largest, color=MUTED, lw=1, zorder=1, label="largest")
    axes.axhline(5.0, color=LIMIT, lw=1.2, ls="--", zorder=1)
    axes.text(angles[0] - 0.4, 5.25, "5 cm: seen at most on 14 deg", color=LIMIT, fontsize=8, va="bottom")
    axes.set_yscale("symlog", linthresh=1.0)
    ticks = [0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0]
    axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.set_ylim(min(-0.1, min(measured.slides[a].downhill.min() for a in angles) * 100.0 - 0.1), 60.0)
    axes.set_xticks(angles)
    axes.set_xlabel("slope [deg]")
    axes.set_ylabel("slide of the chassis in one step [cm]")
    axes.set_title(f"{measured.spec.title}, level chassis, friction 0.45; leg 1 is uphill")
    axes.grid(axis="y")
    axes.legend(loc="upper left", ncols=2, bbox_to_anchor=(0.0, 0.98))
    return figure


def _shade_lifted(axes: Any, lifted: tuple[int, ...]) -> None:
    for leg in lifted:
        axes.axvspan(leg + 0.6, leg + 1.4, color=GRID, zorder=0)


def _once(first: bool, label: str) -> str | None:
    return label if first else None
