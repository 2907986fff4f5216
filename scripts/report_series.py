"""Figures of a trial over mission time: what the time was spent on, chassis height, torques, margins and wheel loads."""

from __future__ import annotations

from typing import Any

import numpy as np
from report_style import BELIEVED, BIN_COLOURS, INK, LEG_COLOURS, LIMIT, MUTED, TRUE, leg_legend, png, subplots
from trial_recording import BINS, TrialRecording

MINUTE = 60.0
DETAIL_STEPS = 2
"""steps in the timeline's detail"""


def series_figure(trial: TrialRecording) -> bytes:
    """Chassis height, torque, margins and wheel loads, one above the other over the same time."""
    s, limit = trial.states, trial.spec.min_support_margin
    minutes = s.t / MINUTE
    figure, axes = subplots(4, 1, figsize=(13, 10.2), sharex=True, height_ratios=(1.0, 1.0, 1.25, 1.25))
    height, torque, margin, loads = axes
    _height(height, trial)

    torque.plot(minutes, 100 * s.torque_fraction, color=BELIEVED, lw=0.8, label="largest of all joints")
    torque.plot(minutes, 100 * s.peak_torque_fraction, color=INK, lw=1.2, ls=(0, (4, 2)), label="largest so far, low-passed at 0.1 s")
    _limit(torque, 100.0, "limit of the joint")
    torque.set(title="Joint torque", ylabel="% of the limit", ylim=(0, max(115.0, 108 * float(np.max(s.torque_fraction)))))

    margin.plot(minutes, s.support_margin, color=BELIEVED, lw=1.1, label="support margin of the loaded wheels")
    margin.plot(minutes, s.cps_margin, color="#7c3aed", lw=0.8, alpha=0.85, label="margin to the conservative polygon (CPS)")
    margin.plot(minutes, s.tip_over_energy, color="#0f766e", lw=0.9, label="tip-over energy per weight")
    _limit(margin, limit, f"rule: {limit:.2f} m")
    margin.axhline(0.0, color=MUTED, lw=0.8)
    margin.set(title="Stability, from true loads", ylabel="m")

    for leg, colour in enumerate(LEG_COLOURS):
        loads.plot(minutes, s.loads[:, leg] / 1000.0, color=colour, lw=1.1)
    loads.set(title="Wheel loads", ylabel="kN", xlabel="mission time [min]", ylim=(0, None))
    leg_legend(loads, loc="upper left", bbox_to_anchor=(1.002, 1.02))
    for ax in (height, torque, margin):
        ax.legend(loc="upper left", bbox_to_anchor=(1.002, 1.02), handlelength=1.4)
    for ax in axes:
        ax.grid(True, axis="y")
        ax.set_xlim(0.0, max(float(minutes[-1]), 1e-3))
        for c in trial.collisions:
            ax.axvline(c["t"] / MINUTE, color=LIMIT, lw=0.9, alpha=0.6)
    return png(figure)


def timeline_figure(trial: TrialRecording) -> bytes | None:
    """What waited for what: the whole trial, and two steps of it in detail; None of a recording without accounts."""
    if not trial.spans:
        return None
    figure, (whole, detail) = subplots(2, 1, figsize=(13, 5.0))
    end = trial.spans[-1][2]
    _bars(whole, trial, 0.0, end, unit=MINUTE)
    whole.set(title="Where the mission time went", xlabel="mission time [min]", xlim=(0.0, end / MINUTE))
    begin, stop = _detail(trial)
    _bars(detail, trial, begin, stop, unit=1.0)
    inside = [t for t in trial.sent if begin <= t <= stop]
    detail.plot(inside, np.full(len(inside), -0.75), marker="^", ls="", color=INK, ms=7, label="uplink leaves", clip_on=False)
    inside = [t for t in trial.arrived if begin <= t <= stop]
    detail.plot(inside, np.full(len(inside), -0.75), marker="|", ls="", color=MUTED, ms=8, label="telemetry or pictures arrive")
    for p in trial.proposals:
        if begin <= p.t <= stop and p.kind == "step":
            detail.axvline(p.t, color=INK, lw=0.8, ls=":")
            detail.annotate(
                f"leg {p.leg + 1} proposed", (p.t, -1.15), xytext=(3, 0), textcoords="offset points", fontsize=7.5, va="bottom",
                annotation_clip=True,
            )  # fmt: skip
    detail.set(title="A part of it in detail", xlabel="mission time [s]", xlim=(begin, stop), ylim=(len(BINS) - 0.4, -1.5))
    detail.legend(loc="upper left", bbox_to_anchor=(1.002, 1.02))
    whole.axvspan(begin / MINUTE, stop / MINUTE, color=INK, alpha=0.07, lw=0)
    return png(figure)


def _height(axes: Any, trial: TrialRecording) -> None:
    times = trial.track.t / MINUTE
    axes.plot(times, trial.track.places[:, 2] - trial.datum, color=TRUE, lw=1.2, label="true")
    asked = [p for p in trial.proposals]
    axes.plot(
        [p.t / MINUTE for p in asked], [p.world_from_hex.translation[2] for p in asked], "o", ms=4, color=BELIEVED,
        label="believed when a step was proposed",
    )  # fmt: skip
    unsagged = trial.spec.chassis_height
    axes.axhline(unsagged, color=MUTED, lw=0.9, ls=(0, (4, 2)), label="stance as drawn, without sag")
    axes.set(title="Height of the chassis over the ground of the start: it sags when a leg is lifted", ylabel="m")


def _limit(axes: Any, value: float, text: str) -> None:
    axes.axhline(value, color=LIMIT, lw=1.1, label=text)


def _bars(axes: Any, trial: TrialRecording, begin: float, end: float, *, unit: float) -> None:
    totals = {name: sum(b - a for kind, a, b in trial.spans if kind == name) for name in BINS}
    for row, name in enumerate(BINS):
        bars = [(max(a, begin), min(b, end)) for kind, a, b in trial.spans if kind == name and b > begin and a < end]
        axes.broken_barh([(a / unit, (b - a) / unit) for a, b in bars], (row - 0.36, 0.72), color=BIN_COLOURS[name], lw=0)
    whole = max(sum(totals.values()), 1e-9)
    axes.set_yticks(range(len(BINS)), [f"{name}  {100 * totals[name] / whole:.0f} %" if unit > 1 else name for name in BINS])
    axes.set_ylim(len(BINS) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0, labelcolor=INK)
    axes.spines["left"].set_visible(False)
    axes.grid(True, axis="x")


def _detail(trial: TrialRecording) -> tuple[float, float]:
    """From shortly before a proposal in the middle until some steps later."""
    begun = [p.t for p in trial.proposals if p.kind == "step"]
    end = trial.spans[-1][2]
    if not begun:
        return 0.0, min(end, 120.0)
    first = min(len(begun) // 2, max(len(begun) - DETAIL_STEPS - 1, 0))
    last = begun[first + DETAIL_STEPS] + 8.0 if first + DETAIL_STEPS < len(begun) else end
    return max(begun[first] - 8.0, 0.0), min(last, end)
