"""The gaits of one robot as figures 14, 15 and 16 of [SunSpiral2012] show them: the chassis' way, peak torques, wheel loads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from gait_figures import Gaits

from athlete_twin.model.spec import LEGS
from planner.gait.sway import SwayGait

BLUE, ORANGE, GREEN = "#2563eb", "#f59e0b", "#16a34a"


def draw(gaits: Gaits, path: Path) -> Path:
    """Three panels; what the twin did stands in the second once it has walked. Returns the path."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, (way, peaks, loads) = plt.subplots(1, 3, figsize=(15, 4.8), constrained_layout=True)
    _way(way, gaits)
    _peaks(peaks, gaits)
    _loads(loads, gaits)
    figure.suptitle(f"{gaits.spec.name}: one cycle of {gaits.stride:g} m, feet at {gaits.foot_radius:g} m, hex at {gaits.height:g} m")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path


def _way(axis: Any, gaits: Gaits) -> None:
    """Figure 14: the chassis seen from above, the height in numbers."""
    cycle, sway = gaits.wave, gaits.sway_of_wave
    straight = np.vstack([cycle.chassis, cycle.chassis[:1] + cycle.advance])
    axis.plot(straight[:, 0], straight[:, 1], "o-", color=BLUE, label="reference")
    if isinstance(sway, SwayGait):
        places = cycle.chassis + sway.displacements
        places = np.vstack([places, places[:1] + cycle.advance])
        axis.plot(places[:, 0], places[:, 1], "o-", color=ORANGE, label="sway")
        for k, place in enumerate(places[:-1]):
            up = sway.displacements[k, 2]
            axis.annotate(f"{k + 1}: {up:+.2f} m", place[:2], textcoords="offset points", xytext=(5, 6 if k % 2 else -13), fontsize=8)
    axis.set(title="way of the chassis; phase and height over the reference", xlabel="x [m]", ylabel="y [m]")
    axis.margins(0.15)
    axis.axis("equal")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)


def _peaks(axis: Any, gaits: Gaits) -> None:
    """Figure 15: the largest torque of each phase."""
    names = {"reference gait": BLUE, "sway gait": ORANGE, "pairs of opposite legs": GREEN}
    planned = {name: verdict.phase_peaks() for name, verdict in gaits.verdicts().items()}
    for name, values in planned.items():
        axis.plot(np.arange(1, len(values) + 1), values, "o-", color=names[name], label=f"{name}, planned")
    for name, walked in gaits.walked.items():
        phases = np.arange(1, len(walked.torques) + 1)
        axis.plot(phases, walked.torques, "s--", color=names[name], markerfacecolor="none", label=f"{name}, twin")
    axis.axhline(1.0, color="k", linewidth=0.8)
    axis.text(1.0, 1.01, "saturation", fontsize=8)
    axis.set(title="largest joint torque over its limit", xlabel="phase", ylim=(0.0, 1.5), xticks=range(1, LEGS + 1))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, ncols=2, loc="upper center")


def _loads(axis: Any, gaits: Gaits) -> None:
    """Figure 16: what the wheels carry with one leg and with two opposite legs in the air."""
    legs = np.arange(1, LEGS + 1)
    for shift, lifted, colour in ((-0.2, (0,), BLUE), (0.2, (0, 3), GREEN)):
        up = "leg 1" if len(lifted) == 1 else "legs 1 and 4"
        peak = 100.0 * gaits.lifted(lifted)
        axis.bar(legs + shift, gaits.loads(lifted) / 1e3, 0.38, color=colour, label=f"{up} in the air: joints at {peak:.0f} % at most")
    axis.set(title="wheel loads", xlabel="leg", ylabel="[kN]", xticks=legs)
    axis.set_ylim(top=1.3 * axis.get_ylim()[1])
    axis.grid(axis="y", alpha=0.3)
    axis.legend(fontsize=9, loc="upper right")
