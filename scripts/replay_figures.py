"""Figures of a recording on its two clocks: what was true against what was known, and what crossed the link."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from report_style import BELIEVED, BIN_COLOURS, INK, MUTED, TRUE, png, subplots

from envs.events import Clock, Event

LINK_SECONDS = 90.0
"""shown of the link, from the first proposal on: more would be a smear [s]"""
WORDS = {
    "/uplink/command_sequence": ("commands", INK),
    "/uplink/stop": ("stop", "#b91c1c"),
    "/downlink/telemetry": ("telemetry", BIN_COLOURS["motion"]),
    "/downlink/receipt": ("receipt", BIN_COLOURS["ground"]),
    "/downlink/stereo_pair": ("pictures", BIN_COLOURS["link"]),
    "/downlink/fault": ("fault", "#b91c1c"),
}
"""what crosses the link, by topic: name and colour"""


def clock_figure(every: list[Event], clock: Clock) -> bytes:
    """Way, stability and events by one clock, as PNG."""
    figure, (way, margin, lanes) = subplots(3, 1, figsize=(10.5, 8.0), sharex=True, height_ratios=(3, 3, 2))
    whose = "robot's clock: what was true, when" if clock == "robot" else "operator's clock: what was known, when"
    figure.suptitle(f"By the {whose}", x=0.01, ha="left", fontweight="bold")
    true, known = (_of(every, topic) for topic in ("/truth/chassis", "/ground/chassis"))
    shown, state = _of(every, "/operator/shown"), _of(every, "/truth/state")
    if clock == "robot":
        way.plot(*_series(true, "robot", "x_m"), color=TRUE, lw=1.3, label="true")
        margin.plot(*_series(state, "robot", "support_margin_m"), color=TRUE, lw=1.1, label="support margin, true")
        margin.plot(*_series(state, "robot", "cps_margin_m"), color=TRUE, lw=0.9, ls=":", label="conservative, true")
    else:
        way.plot(*_series(true, "robot", "x_m"), color=TRUE, lw=0.8, alpha=0.5, label="true, not known here")
        way.plot(
            *_series(known, "operator", "x_m"), color=BELIEVED, lw=1.3, drawstyle="steps-post", marker="o", ms=3.5,
            label="believed when shown",
        )  # fmt: skip
        margin.plot(
            *_series(shown, "operator", "predicted_margin_m"), color=BELIEVED, lw=1.1, drawstyle="steps-post", marker="o", ms=3.5,
            label="least margin of the\nmotion shown, foreseen",
        )  # fmt: skip
    way.set(title="Way of the chassis", ylabel="x [m]")
    margin.set(title="Stability", ylabel="m")
    for axes in (way, margin):
        axes.grid(True)
        if axes.lines:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    low, high = margin.get_ylim()
    margin.set_ylim(min(0.0, low), high + 0.05 * abs(high))
    _lanes(lanes, every, clock)
    return png(figure)


def link_figure(every: list[Event]) -> bytes:
    """Each message as a line from the side and moment it left to those it arrived at, as PNG."""
    from matplotlib.lines import Line2D

    crossed = [e for e in every if e.topic in WORDS and np.isfinite(e.age)]
    asked = [e.at_operator for e in every if e.topic == "/operator/decision"]
    begin = max(0.0, (asked[0] if asked else 0.0) - 5.0)
    latest = max((max(e.at_robot, e.at_operator) for e in crossed), default=begin)
    end = min(begin + LINK_SECONDS, max(latest, begin + 1.0))
    figure, axes = subplots(figsize=(10.5, 4.2))
    used = {}
    for e in crossed:
        if max(e.at_robot, e.at_operator) < begin or min(e.at_robot, e.at_operator) > end:
            continue
        name, colour = WORDS[e.topic]
        used[name] = colour
        axes.plot([e.at_robot, e.at_operator], [0.0, 1.0], color=colour, lw=1.6 if e.topic.startswith("/uplink") else 0.9)
    for e in every:
        if e.topic in ("/operator/shown", "/operator/decision") and begin <= e.at_operator <= end:
            axes.plot(e.at_operator, 1.0, "v" if e.topic.endswith("shown") else "o", color=BIN_COLOURS["operator"], ms=7, clip_on=False)
    handles = [Line2D([], [], color=c, lw=2, label=n) for n, c in used.items()]
    handles += [
        Line2D([], [], color=BIN_COLOURS["operator"], marker=m, ls="", label=n) for m, n in (("v", "proposal shown"), ("o", "decision"))
    ]
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes.set_yticks([0.0, 1.0], ["robot", "operator"])
    axes.set(title="What crossed the link: a slanted line is a message under way", xlabel="mission time [s]", xlim=(begin, end))
    axes.set_ylim(-0.08, 1.08)
    axes.grid(True, axis="x")
    return png(figure)


def report_figures(folder: Path) -> dict[str, bytes]:
    """The pictures of a trial's report, from its folder, as PNG by file name."""
    from report_eyes import eyes_figure
    from report_maps import map_error_figure, maps_figure
    from report_sag import sag_figure
    from report_series import series_figure, timeline_figure
    from trial_recording import load_recording

    trial = load_recording(folder)
    makers = {
        "maps": maps_figure, "map_error": map_error_figure, "eyes": eyes_figure, "series": series_figure, "sag": sag_figure,
        "timeline": timeline_figure,
    }  # fmt: skip
    made = {f"{name}.png": make(trial) for name, make in makers.items()}
    return {name: picture for name, picture in made.items() if picture is not None}


def _lanes(axes: Any, every: list[Event], clock: Clock) -> None:
    """A row of marks for each kind of message, by the clock."""
    topics = [*WORDS, *(["/operator/shown", "/operator/decision"] if clock == "operator" else ["/truth/collision"])]
    topics = [t for t in topics if any(e.topic == t and np.isfinite(e.t(clock)) for e in every)]
    for row, topic in enumerate(topics):
        times = [e.t(clock) for e in every if e.topic == topic]
        axes.plot(times, np.full(len(times), row), "|", ms=11, mew=1.0, color=WORDS.get(topic, ("", MUTED))[1])
    axes.set_yticks(range(len(topics)), [t.removeprefix("/").replace("_", " ") for t in topics])
    axes.set_ylim(len(topics) - 0.4, -0.6)
    axes.set(title="Messages: made or arrived there" if clock == "robot" else "Messages: arrived or sent here", xlabel="mission time [s]")
    axes.grid(True, axis="x")


def _of(every: list[Event], topic: str) -> list[Event]:
    return [e for e in every if e.topic == topic]


def _series(chosen: list[Event], clock: Clock, name: str) -> tuple[list[float], list[float]]:
    return [e.t(clock) for e in chosen], [float(e.figures[name]) for e in chosen]
