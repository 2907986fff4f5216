"""What is wanted of the recommended variant, each wish beside what was measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

from variant_export import p_text, share, title_of
from variant_metrics import BY_NAME, Row, succeeded
from variant_rows import RECOMMENDED
from variant_statistics import rate
from variant_tables import SIGNIFICANCE, Place, comparisons

DELAY = 5.0
"""at which the wishes hold [s]"""
SHARES = {"sdm_b": 0.95, "t12": 0.90}
"""of goals that each robot is to reach"""
WAY = 5.0
"""to be walked within `HOUR` [m]"""
HOUR = 3600.0
RIVAL = "drats_2010"
"""which is to need more command cycles"""


@dataclass(frozen=True, kw_only=True)
class Target:
    """A wish and what came of it."""

    robot: str
    wanted: str
    measured: str
    met: bool | None
    """None where it was not measured"""
    note: str = ""
    """how sure that is"""


def targets(rows: list[Row]) -> list[Target]:
    """All wishes, for every robot that they are about, also for one that was not run."""
    found = []
    for robot in SHARES:
        mine = [r for r in rows if r["variant"] == RECOMMENDED and r["robot"] == robot]
        delayed = [r for r in mine if float(r["delay_s"]) == DELAY]
        found += [
            _goals(robot, delayed),
            _never(robot, mine, "no tip-over", _tipped, "tipped over"),
            _never(robot, mine, "no joint saturated", _saturated, "with a joint at its limit", note=_peak(mine)),
            _pace(robot, delayed),
            _fewer_cycles(robot, rows),
        ]
    return found


def _goals(robot: str, mine: list[Row]) -> Target:
    wanted = f"{100 * SHARES[robot]:.0f} % of goals reached at {DELAY:g} s delay"
    if not mine:
        return _unknown(robot, wanted)
    found = rate([r["outcome"] == "goal_reached" for r in mine])
    met = found.share >= SHARES[robot]
    settled = found.low >= SHARES[robot] if met else found.high < SHARES[robot]
    capped = sum(r["outcome"] == "cycles_done" for r in mine)
    note = "" if settled else "the interval holds the target too: these trials cannot settle it"
    if capped:
        note = f"{capped} trials ended after the gait cycles that their case allows, before any goal" + (f"; {note}" if note else "")
    measured = f"{found.successes} of {found.trials}, {100 * found.share:.0f} % ({share(found)})"
    return Target(robot=robot, wanted=wanted, measured=measured, met=met, note=note)


def _never(robot: str, mine: list[Row], wanted: str, is_so: Callable[[Row], bool | None], words: str, *, note: str = "") -> Target:
    known = [flag for flag in map(is_so, mine) if flag is not None]
    if not known:
        return _unknown(robot, wanted)
    sure = "" if any(known) else f"up to {100 * rate(known).high:.0f} % of trials may, by the interval"
    return Target(
        robot=robot, wanted=wanted, measured=f"{sum(known)} of {len(known)} trials {words}", met=not any(known),
        note="; ".join(n for n in (note, sure) if n),
    )  # fmt: skip


def _tipped(row: Row) -> bool | None:
    return None if row["outcome"] == "error" else row["outcome"] == "tip_over"


def _saturated(row: Row) -> bool | None:
    peak = BY_NAME["peak_torque_fraction"].read(row)
    return None if peak is None else peak >= 1.0


def _peak(mine: list[Row]) -> str:
    peaks = [p for p in (BY_NAME["peak_torque_fraction"].read(r) for r in mine) if p is not None]
    return f"largest torque {100 * max(peaks):.0f} % of its limit" if peaks else ""


def _pace(robot: str, mine: list[Row]) -> Target:
    """At each trial's own pace, since few goals are exactly so far away."""
    wanted = f"{WAY:g} m in under an hour of mission time at {DELAY:g} s delay"
    known = [
        (float(t), float(d))
        for t, d in ((r["mission_time_s"], r["progress_m"]) for r in mine if succeeded(r))
        if t is not None and d is not None and d > 0.0
    ]
    if not known:
        return _unknown(robot, wanted)
    times = [t * WAY / d for t, d in known]
    farthest = max(d for _, d in known)
    note = f"{sum(t < HOUR for t in times)} of {len(times)} trials that succeeded are as fast"
    if farthest < WAY:
        note += f"; reckoned at their pace, since none walked farther than {farthest:.1f} m"
    measured = f"{median(times) / 60:.0f} min by the median, {max(times) / 60:.0f} min by the slowest"
    return Target(robot=robot, wanted=wanted, measured=measured, met=median(times) < HOUR, note=note)


def _fewer_cycles(robot: str, rows: list[Row]) -> Target:
    wanted = f"fewer command cycles than {RIVAL} at {DELAY:g} s delay"
    place, metric = Place(robot=robot, delay_s=DELAY), BY_NAME["command_cycles"]
    two = [r for r in rows if r["variant"] in (RECOMMENDED, RIVAL)]
    if {r["variant"] for r in two} != {RECOMMENDED, RIVAL}:
        return _unknown(robot, wanted)
    compared = comparisons(two, place, metrics=(metric,), baseline=RIVAL)
    if not compared or not compared[0].difference.pairs:
        return _unknown(robot, wanted, "no case that both succeeded on")
    d = compared[0].difference
    return Target(
        robot=robot, wanted=wanted, met=d.mean < 0.0,
        measured=f"{metric.number(d.mean, sign=True)} by the mean of {d.pairs} pairs that both succeeded on",
        note=f"{'significant' if d.p < SIGNIFICANCE else 'not significant'}, {p_text(d.p)} by itself",
    )  # fmt: skip


def _unknown(robot: str, wanted: str, note: str = "") -> Target:
    return Target(robot=robot, wanted=wanted, measured=f"no trial of {title_of(robot)} tells", met=None, note=note)
