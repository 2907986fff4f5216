"""Predicted and measured heights of the chassis' corners, as figures 11 and 12 of [SunSpiral2012] show them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from sag_figures import Calibration
from sag_stances import CALIBRATION

from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import LEGS, load_spec
from planner.sag.docked import docked_pieces
from planner.sag.identify import predict_heights
from planner.sag.identify_docks import predict_docked_heights

SHOWN: tuple[tuple[int, ...], ...] = ((), (4,), (2,), (0, 3))
"""legs in the air: none, leg 5, the pallet corner's leg 3, and two at once"""


def draw(calibration: Calibration, path: Path) -> Path:
    """Corner heights of four calibration stances, and the errors on all random ones, of one individual; the path."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    robot, found = calibration.individual.robot, calibration
    spec, kin = load_spec(robot), kinematics(robot)
    legs = np.arange(1, LEGS + 1)
    figure, axes = plt.subplots(2, 3, figsize=(12, 6.6), constrained_layout=True)
    panels = list(axes.flat)
    for axis, lifted in zip(panels, SHOWN, strict=False):
        reading = found.individual.calibration[CALIBRATION.index(lifted)]
        stance = reading.stance
        one = predict_heights(stance, stiffness_z=np.full(LEGS, found.one.stiffness), lateral_ratio=spec.believed_lateral_ratio)
        each = predict_heights(stance, stiffness_z=found.wheels.stiffness_z, lateral_ratio=spec.believed_lateral_ratio)
        axis.plot(legs, stance.heights, "k_", markersize=22, markeredgewidth=2.5, label="measured")
        axis.plot(legs, one, "o", color="#2563eb", label="one constant")
        axis.plot(legs, each, "^", color="#f59e0b", markersize=5, label="a constant a wheel")
        if found.docks:
            docked = predict_docked_heights(
                stance, docked_pieces(kin, reading.motors), stiffness=found.docks.stiffness,
                twist_stiffness=found.docks.twist_stiffness, lateral_ratio=spec.believed_lateral_ratio,
            )  # fmt: skip
            axis.plot(legs, docked, "s", color="#16a34a", markersize=5, label="one constant, docks twist")
        axis.axhline(stance.origin_height, color="0.6", linewidth=0.8, label="without sag")
        up = "all wheels down" if not lifted else "lifted: " + ", ".join(f"leg {leg + 1}" for leg in lifted)
        axis.set(title=up, xlabel="corner at leg", ylabel="height [m]", xticks=legs)
        axis.grid(axis="y", alpha=0.3)
    levels = [axis.get_ylim() for axis in panels[: len(SHOWN)]]
    for axis in panels[: len(SHOWN)]:
        axis.set_ylim(min(low for low, _ in levels), max(high for _, high in levels))
    names = {"one": "one constant", "wheels": "a constant a wheel", "docks": "docks twist"}
    colours = {"one": "#2563eb", "wheels": "#f59e0b", "docks": "#16a34a"}
    bins = np.linspace(-5.0, 5.0, 51)
    for model, errors in found.errors.items():
        label = f"{names[model]}: mean {100 * np.abs(errors).mean():.2f} cm"
        panels[4].hist(100 * errors.ravel(), bins=bins, histtype="step", color=colours[model], label=label, linewidth=1.5)
    panels[4].set(title="random stances", xlabel="predicted less measured [cm]", ylabel="corners")
    panels[4].set_ylim(top=1.45 * panels[4].get_ylim()[1])
    panels[4].legend(fontsize=8, loc="upper left")
    candidates = found.one.candidates / 1e3
    panels[5].plot(candidates, 100 * found.one.mean_errors, color="#2563eb")
    panels[5].axvline(found.one.stiffness / 1e3, color="k", linewidth=0.8)
    least = 100 * found.one.mean_error
    panels[5].set(
        title="search of the one constant", xlabel="constant [kN/m]", ylabel="mean error [cm]", ylim=(0.0, 8.0 * least)
    )
    panels[5].grid(alpha=0.3)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9)
    figure.suptitle(f"{robot}, individual {found.individual.seed}: corners of the chassis")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path
