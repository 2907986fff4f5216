"""What the ground foresaw of sag in each step of a trial, and what the chassis truly did while the leg was in the air."""

from __future__ import annotations

from typing import Any

import numpy as np
from report_style import LEG_COLOURS, MUTED, leg_legend, png, subplots
from trial_recording import Shown, TrialRecording

from athlete_twin.geometry.se3 import SE3


def measured_sags(trial: TrialRecording) -> np.ndarray:
    """Of each proposal's step, truly, shape (n,) [m]; NaN where none was taken or its leg is never seen standing before.

    As the prediction is defined: by how much the chassis drops at its origin, or turns at the hip of the leg, whichever is
    more, from where it was when the leg last stood. That is when the step was decided, unless the leg was in the air already:
    lifted for pictures, or led back from what it struck. The median over the time that the leg swings.
    """
    return np.array([_measured(trial, number) for number in range(len(trial.proposals))])


def _measured(trial: TrialRecording, number: int) -> float:
    shown = trial.proposals[number]
    if shown.kind != "step" or shown.decision != "approve":
        return float("nan")
    end = trial.proposals[number + 1].t if number + 1 < len(trial.proposals) else np.inf
    phases_by_time = list(zip(trial.states.t, trial.states.phases, strict=True))
    stood_at = [t for t, phases in phases_by_time if t <= shown.decided and phases[shown.leg] == "stance"]
    swings = [
        t
        for t, phases in phases_by_time
        if shown.decided <= t < end and phases[shown.leg] == "swing"
    ]
    if not (swings and stood_at):
        return float("nan")
    stood = _pose(trial, stood_at[-1])
    hip = float(np.linalg.norm(trial.spec.hips_in_hex[shown.leg]))
    sags = []
    for t in swings:
        moved = stood.inverse().compose(_pose(trial, t))
        drop = stood.translation[2] - _pose(trial, t).translation[2]
        sags.append(max(abs(drop), hip * float(np.linalg.norm(moved.rotvec()))))
    return float(np.median(sags))


def _pose(trial: TrialRecording, t: float) -> SE3:
    """The chassis, truly, at the last sample before a time."""
    return trial.track.world_from_hex[max(int(np.searchsorted(trial.track.t, t, side="right")) - 1, 0)]


def sag_figure(trial: TrialRecording) -> bytes | None:
    """Foreseen against measured sag, a point a step, and both over the trial; None of a trial without steps."""
    measured = measured_sags(trial)
    steps = [(p, m) for p, m in zip(trial.proposals, measured, strict=True) if np.isfinite(m) and p.sag is not None]
    if not steps:
        return None
    figure, (pairs, series) = subplots(1, 2, figsize=(13, 3.6), width_ratios=(1.0, 2.2))
    foreseen = 100 * np.array([_foreseen(p) for p, _ in steps])
    true = 100 * np.array([m for _, m in steps])
    colours = [LEG_COLOURS[p.leg] for p, _ in steps]
    top = 1.15 * float(max(foreseen.max(), true.max(), 0.1))
    pairs.plot([0.0, top], [0.0, top], color=MUTED, lw=0.9, ls=(0, (4, 2)))
    pairs.scatter(foreseen, true, c=colours, s=26)
    pairs.set(title="Sag of each step", xlabel="foreseen [cm]", ylabel="measured [cm]", xlim=(0.0, top), ylim=(0.0, top))
    _over_steps(series, foreseen, true, colours)
    error = np.abs(foreseen - true)
    series.set(title=f"Sag by step: mean error {error.mean():.1f} cm, largest {error.max():.1f} cm")
    leg_legend(series, loc="upper left", bbox_to_anchor=(1.002, 1.02))
    return png(figure)


def _foreseen(shown: Shown) -> float:
    return float(shown.sag or 0.0)


def _over_steps(axes: Any, foreseen: np.ndarray, true: np.ndarray, colours: list[str]) -> None:
    numbers = np.arange(1, len(foreseen) + 1)
    axes.bar(numbers, true, color=colours, width=0.7)
    axes.plot(numbers, foreseen, "_", color="black", markersize=9, markeredgewidth=1.8)
    axes.set(xlabel="step; bars are measured, black lines foreseen", ylabel="cm", xlim=(0.3, len(foreseen) + 0.7), ylim=(0.0, None))
    axes.grid(True, axis="y")
