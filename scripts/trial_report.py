"""A trial's report for people: one HTML file with its pictures inside, made from `trial.json` and `trial.mcap` alone.

    python scripts/trial_report.py results/trial

Writes `report.html` into the trial's folder. Exit status 0 when it was written, 2 and one line when the folder holds no trial.
"""

from __future__ import annotations

import html
import math
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro
from report_eyes import eyes_figure
from report_maps import map_error_figure, maps_figure
from report_sag import measured_sags, sag_figure
from report_series import series_figure, timeline_figure
from report_style import BIN_COLOURS, LEG_COLOURS, page, picture
from trial_recording import BINS, TrialRecording, load_recording

from athlete_twin.errors import AthleteError

MANY_PROPOSALS = 24
"""a longer list is folded away at first"""
OUTCOMES = {
    "goal_reached": ("Goal reached", "good"),
    "cycles_done": ("Gait cycles done", "good"),
    "time_limit": ("Time limit", "fair"),
    "operator_abort": ("Stopped by the operator", "fair"),
    "no_step": ("No step found", "bad"),
    "fault": ("Fault", "bad"),
    "tip_over": ("Tipped over", "bad"),
}


def write_report(out_dir: Path) -> Path:
    """Writes `report.html` into a trial's folder; its path."""
    trial = load_recording(out_dir)
    path = out_dir / "report.html"
    path.write_text(report_html(trial))
    return path


def report_html(trial: TrialRecording) -> str:
    """The report as one page that needs nothing else."""
    f = trial.figures
    title = f"{trial.spec.title} in {f['scenario']}, seed {f['seed']}"
    parts = [
        _header(trial, title),
        _tiles(f),
        _mission_time(f),
        picture(
            "Seen from above",
            "Left the map that the ground made from the robot's pictures, right the true terrain. Discs are footfalls in "
            "the order of the steps, lines join those of one leg; the outline is the chassis at the end.",
            maps_figure(trial),
        ),
        picture("How good the map is", "", map_error_figure(trial)),
        picture(
            "How a pair of pictures becomes terrain",
            "One stereo pair of this trial, matched again, and what the ground took for the robot itself and kept out of "
            "the map; pixels without a depth never get there anyway.",
            eyes_figure(trial),
            narrow=True,
        ),
        picture(
            "Sag, torque, stability and loads",
            "Sampled twice a second while the robot moves; the time axis includes the waiting. Stability counts loaded "
            "wheels only, so the margin drops whenever a leg swings; the rule holds for the support margin then, and for "
            "the conservative polygon with all wheels down." + _collision_note(trial),
            series_figure(trial),
        ),
        picture(
            "Sag, foreseen and measured",
            "By how much the chassis drops at its origin, or turns at the hip, while a leg is in the air: what the ground "
            "told the operator before each step, and what the robot did.",
            sag_figure(trial),
        ),
        picture("Who waited for whom", "", timeline_figure(trial)),
        _all_figures(f),
        _proposals(trial),
        _collisions(trial),
        _footer(f),
    ]
    return page(title, "".join(parts))


def _header(trial: TrialRecording, title: str) -> str:
    f = trial.figures
    name, kind = OUTCOMES.get(f["outcome"], (f["outcome"], "fair"))
    payload = f", {f['payload_kg']:.0f} kg of payload" if f["payload_kg"] else ""
    return (
        f"<header><h1>{html.escape(title)}</h1>"
        f"<p>planner variant {html.escape(str(f['variant']))}, {f['link']['delay_s']:g} s of delay each way, "
        f"operator {html.escape(str(f['operator']))}{payload}</p>"
        f'<p><span class="badge {kind}">{html.escape(name)}</span>'
        f'<span class="reason">{html.escape(str(f["reason"]))}</span></p></header>'
    )


def _tiles(f: dict[str, Any]) -> str:
    tiles = [
        (_metres(f["progress_m"]), "progress towards the goal"),
        (_metres(f["goal_distance_m"]), "left to the goal"),
        (str(f["steps_taken"]), f"steps, {f['gait_cycles']} gait cycles"),
        (str(f["collisions"]), "collisions"),
        (_metres(f["min_support_margin_m"]), "least support margin"),
        (_percent(f["peak_torque_fraction"]), "peak torque of its limit"),
        (_clock(f["mission_time_s"]), "mission time"),
    ]
    shown = "".join(f'<div class="tile"><b>{value}</b><span>{text}</span></div>' for value, text in tiles)
    return f'<div class="tiles">{shown}</div>'


def _mission_time(f: dict[str, Any]) -> str:
    whole = max(f["mission_time_s"], 1e-9)
    text = {"motion": "robot moves", "link": "everybody waits for the link", "ground": "ground computes", "operator": "operator decides"}
    bar = "".join(
        f'<div style="width:{100 * f[f"{name}_s"] / whole:.3f}%;background:{BIN_COLOURS[name]}"></div>' for name in BINS
    )
    key = "".join(
        f'<span><i style="background:{BIN_COLOURS[name]}"></i>{text[name]}: {_clock(f[f"{name}_s"])} '
        f"({100 * f[f'{name}_s'] / whole:.0f} %)</span>"
        for name in BINS
    )
    return f'<section><h2>Mission time</h2><div class="bar">{bar}</div><div class="key">{key}</div></section>'


def _all_figures(f: dict[str, Any]) -> str:
    error, mask = f["map_error_m"], f["leg_mask"]
    tables = {
        "Way": [
            ("progress", _metres(f["progress_m"])),
            ("distance from the goal", _metres(f["goal_distance_m"])),
            ("gait cycles", f["gait_cycles"]),
            ("steps", f["steps_taken"]),
        ],
        "Safety": [
            ("collisions", f["collisions"]),
            ("faults", f["faults"]),
            ("emergency stops", f["e_stops"]),
            ("least support margin", _metres(f["min_support_margin_m"])),
            ("least margin to the conservative polygon", _metres(f["min_cps_margin_m"])),
            ("least tip-over energy per weight", _metres(f["min_tip_over_energy_m"])),
            ("peak torque of its limit", _percent(f["peak_torque_fraction"])),
        ],
        "True against believed": [
            ("chassis height, mean and largest error", _pair(f["sag_error_m"])),
            ("touch-down, mean and largest miss", _pair(f["touchdown_error_m"])),
            ("place of the chassis, mean and largest error", _pair(f["localisation_error_m"])),
            ("map, median and 95 % of the error", f"{_millimetres(error['median'])}, {_millimetres(error['p95'])}"),
            ("map, share of the terrain near the path seen", _percent(error["coverage"])),
            ("leg mask, part of the legs found", _percent(mask["recall"])),
        ],
        "Command": [
            ("uplinks", f["uplinks"]),
            ("command cycles", f["command_cycles"]),
            ("decisions, of them rejections", f"{f['decisions']}, {f['rejections']}"),
            ("sent down", f"{f['downlink_bytes'] / 1e6:.1f} MB"),
            ("mission time", _clock(f["mission_time_s"])),
            ("computed in", _clock(f["wall_time_s"])),
        ],
    }
    out = []
    for caption, rows in tables.items():
        body = "".join(f'<tr><td>{name}</td><td class="n">{value}</td></tr>' for name, value in rows)
        out.append(f"<div><table><caption>{caption}</caption>{body}</table></div>")
    return f'<section><h2>All figures</h2><div class="tables">{"".join(out)}</div></section>'


def _proposals(trial: TrialRecording) -> str:
    rows = []
    for p, measured in zip(trial.proposals, measured_sags(trial), strict=True):
        colour = LEG_COLOURS[p.leg] if p.leg >= 0 else "#6b7280"
        disc = f'<span class="disc" style="background:{colour}">{p.leg + 1 if p.leg >= 0 else "–"}</span>'
        kind = ' class="rejected"' if p.decision not in ("approve", "") else ""
        rows.append(
            f'<tr{kind}><td class="n">{p.index}</td><td class="n">{_stamp(p.t)}</td><td>{disc}</td><td>{html.escape(p.text)}</td>'
            f'<td class="n">{_metres(p.margin)}</td><td class="n">{_millimetres(p.sag)}</td>'
            f'<td class="n">{_millimetres(float(measured) if math.isfinite(measured) else None)}</td>'
            f"<td>{html.escape(p.decision.replace('_', ' ')) or 'none'}</td></tr>"
        )
    table = (
        '<div class="scroll"><table><tr><th class="n">no.</th><th class="n">time</th><th>leg</th><th>what was proposed</th>'
        '<th class="n">least margin</th><th class="n">sag</th><th class="n">measured</th><th>decision</th></tr>'
        f'{"".join(rows)}</table></div>'
    )
    if len(rows) > MANY_PROPOSALS:
        table = f"<details><summary>{len(rows)} proposals</summary>{table}</details>"
    words = "Margin and sag are the ground's predictions; beside the sag stands what was measured." if rows else "Nothing."
    return f"<section><h2>What was proposed and decided</h2><p>{words}</p>{table if rows else ''}</section>"


def _collisions(trial: TrialRecording) -> str:
    if not trial.collisions:
        return ""
    rows = "".join(
        f'<tr><td class="n">{_stamp(c["t"])}</td><td>{html.escape(c["part"])}</td><td>{html.escape(c["other"])}</td>'
        f'<td class="n">({c["place_in_world"][0]:.2f}, {c["place_in_world"][1]:.2f}, {c["place_in_world"][2]:.2f}) m</td>'
        f'<td class="n">{c["force"]:.0f} N</td></tr>'
        for c in trial.collisions
    )
    head = '<tr><th class="n">time</th><th>part</th><th>touched</th><th class="n">at</th><th class="n">force</th></tr>'
    return f'<section><h2>Collisions</h2><div class="scroll"><table>{head}{rows}</table></div></section>'


def _collision_note(trial: TrialRecording) -> str:
    return " Red upright lines are collisions." if trial.collisions else ""


def _footer(f: dict[str, Any]) -> str:
    p = f["provenance"]
    return (
        f"<footer>athlete_twin {html.escape(str(p.get('version', '')))}, commit {html.escape(str(p.get('git_sha', ''))[:12])}, "
        f"Python {html.escape(str(p.get('python', '')))}, {html.escape(str(p.get('platform', '')))}. "
        f"Trajectory {f['trajectory_sha256'][:16]}. A dash is a figure that was not measured.</footer>"
    )


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} m"


def _millimetres(value: float | None) -> str:
    return "–" if value is None else f"{1000 * value:.0f} mm"


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _pair(summary: dict[str, float | None]) -> str:
    return f"{_millimetres(summary['mean'])}, {_millimetres(summary['max'])}"


def _clock(seconds: float) -> str:
    """Seconds below two minutes, else minutes, else hours."""
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


def _stamp(seconds: float) -> str:
    """Mission time as minutes and seconds, or with hours."""
    whole = int(seconds)
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    folder = tyro.cli(Annotated[Path, tyro.conf.arg(name="folder", help="a trial's folder")], args=arguments, description=__doc__)
    try:
        path = write_report(folder)
    except AthleteError as e:
        sys.stderr.write(f"trial_report: {' '.join(str(e).split())}\n")
        return 2
    sys.stdout.write(f"written: {path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
