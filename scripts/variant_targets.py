"""What is wanted of the recommended variant, each wish beside what was measured.

Trials that ended after as many gait cycles as their case allows tell of a failure, never that there would have been none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

from variant_export import counted, p_text, share, title_of
from variant_metrics import BY_NAME, Row, cut_short, limit_of
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
    found, best = rate([_arrived(r) for r in mine]), rate([_arrived(r) or cut_short(r) for r in mine])
    measured = f"{found.successes} of {found.trials}, {100 * found.share:.0f} % ({share(found)})"
    if found.share < SHARES[robot] <= best.share:
        return Target(robot=robot, wanted=wanted, measured=measured, met=None, note=f"not measured: {_cut(mine)}")
    met = found.share >= SHARES[robot]
    settled = found.low >= SHARES[robot] if met else best.high < SHARES[robot]
    doubt = "" if settled else "the interval holds the target too: these trials cannot settle it"
    return Target(robot=robot, wanted=wanted, measured=measured, met=met, note="; ".join(n for n in (_cut(mine), doubt) if n))


def _never(robot: str, mine: list[Row], wanted: str, is_so: Callable[[Row], bool | None], words: str, *, note: str = "") -> Target:
    known = [flag for flag in map(is_so, mine) if flag is not None]
    if not known:
        return _unknown(robot, wanted)
    cut = _cut(mine)
    sure = "" if any(known) else f"up to {100 * rate(known).high:.0f} % of trials may, by the interval"
    met = False if any(known) else None if cut else True
    return Target(
        robot=robot, wanted=wanted, measured=f"{sum(known)} of {len(known)} trials {words}", met=met,
        note="; ".join(n for n in (f"not measured: {cut}" if met is None else cut, note, sure) if n),
    )  # fmt: skip


def _arrived(row: Row) -> bool:
    return bool(row["outcome"] == "goal_reached")


def _cut(rows: list[Row]) -> str:
    """How many trials ended after how many gait cycles; empty where none was cut short."""
    cut = [r for r in rows if cut_short(r)]
    if not cut:
        return ""
    limits = sorted({n for n in map(limit_of, cut) if n is not None})
    after = " or ".join(map(str, limits)) + (" gait cycle" if limits == [1] else " gait cycles")
    return f"{counted(len(cut), 'trial')} of {len(rows)} ended after {after.lstrip()}, as their case asks, short of any goal"


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
        for t, d in ((r["mission_time_s"], r["progress_m"]) for r in mine if _arrived(r))
        if t is not None and d is not None and d > 0.0
    ]
    if not known:
        return _unknown(robot, wanted, _cut(mine))
    times = [t * WAY / d for t, d in known]
    farthest = max(d for _, d in known)
    note = f"{sum(t < HOUR for t in times)} of {len(times)} trials that reached their goal are as fast"
    if farthest < WAY:
        note += f"; reckoned at their pace, since none walked farther than {farthest:.1f} m"
    measured = f"{median(times) / 60:.0f} min by the median, {max(times) / 60:.0f} min by the slowest"
    return Target(robot=robot, wanted=wanted, measured=measured, met=median(times) < HOUR, note=note)


def _fewer_cycles(robot: str, rows: list[Row]) -> Target:
    wanted = f"fewer command cycles than {RIVAL} at {DELAY:g} s delay"
    place, metric = Place(robot=robot, delay_s=DELAY), BY_NAME["command_cycles"]
    both = [r for r in rows if place.has(r) and r["variant"] in (RECOMMENDED, RIVAL)]
    if {r["variant"] for r in both} != {RECOMMENDED, RIVAL}:
        return _unknown(robot, wanted)
    two = [r for r in both if not cut_short(r)]
    if {r["variant"] for r in two} != {RECOMMENDED, RIVAL}:
        return _unknown(robot, wanted, _cut(both))
    compared = comparisons(two, place, metrics=(metric,), baseline=RIVAL)
    if not compared or not compared[0].difference.pairs:
        return _unknown(robot, wanted, "; ".join(n for n in ("no case whose goal both reached", _cut(both)) if n))
    d = compared[0].difference
    evidence = f"{'significant' if d.p < SIGNIFICANCE else 'not significant'}, {p_text(d.p)} by itself"
    return Target(
        robot=robot, wanted=wanted, met=d.mean < 0.0,
        measured=f"{metric.number(d.mean, sign=True)} by the mean of {d.pairs} pairs in which both reached the goal",
        note="; ".join(n for n in (evidence, _cut(both)) if n),
    )  # fmt: skip


def _unknown(robot: str, wanted: str, note: str = "") -> Target:
    return Target(robot=robot, wanted=wanted, measured=f"no trial of {title_of(robot)} tells", met=None, note=note)
