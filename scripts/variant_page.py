"""The page of a comparison: the answer in words, the wishes, the pictures, and every trial."""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from report_style import image
from variant_details import compared_table, films_section, provenance_footer, reasons_table, stage_table, trials_section
from variant_export import counted, median_cell, p_value, share, title_of, total_cell
from variant_figures import Look, delay_figure, looks_of, outcome_figure, success_figure, time_figure
from variant_metrics import BY_NAME, Row, succeeded
from variant_rows import ERROR, RECOMMENDED, lacking
from variant_spreads import difference_figure, spread_figure, stage_figure
from variant_statistics import FEWEST_PAIRS
from variant_tables import Comparison, Place, effects_by_ground, fewest_pairs, successes
from variant_targets import DELAY, targets
from variant_words import answer, interval, needed, place_title, rates, undecided

JITTER = 0
"""seed of the dots' places in the spreads"""


@dataclass(frozen=True, kw_only=True)
class Study:
    """What the page is about."""

    folder: Path
    rows: list[Row]
    places: list[Place]
    """every robot at every delay"""
    variants: tuple[str, ...]
    """the baseline first"""
    partners: dict[str, str]
    """what each other variant is held against"""
    compared: list[Comparison]
    baseline: str | None
    """as it was asked for"""

    @property
    def looks(self) -> dict[str, Look]:
        """The variants' colours, the same in every picture."""
        return looks_of(self.variants)

    def shown_first(self, place: Place) -> bool:
        """Whether a place is seen without unfolding: 5 s of delay, or the robot's least where that was not run."""
        delays = [p.delay_s for p in self.places if p.robot == place.robot]
        return place.delay_s == (DELAY if DELAY in delays else delays[0])


def body(study: Study) -> str:
    """HTML of the whole page."""
    looks, rows = study.looks, study.rows

    parts = [
        _header(study),
        _answers(study),
        _wishes(study),
        _gallery(
            study,
            "Success",
            "Trials that reached their goal, or walked all the gait cycles to which their case caps the way, with Wilson's 95 % interval. "
            "k is the share of ground under rocks.",
            lambda p: success_figure(rows, p, looks),
            below=lambda p: _by_ground(study, p),
        ),
        _gallery(
            study,
            "How trials ended",
            "Every trial, also those that could not be run.",
            lambda p: outcome_figure(rows, p, looks),
            below=lambda p: reasons_table(rows, p, study.variants),
        ),
        _gallery(
            study,
            "Mission time",
            "As the model charges it: the robot moves, everybody waits for the link, the ground computes (2 s a plan and 1 s a "
            "stereo pair, whatever the machine), the operator decides. Only trials that succeeded, which for a weak variant are the "
            "easier ones; the paired differences below take cases on which both succeeded.",
            lambda p: time_figure(rows, p, looks),
        ),
        *(_differences(study, partner) for partner in dict.fromkeys(study.partners.values())),
        _delays(study),
        _gallery(
            study,
            "How trials spread",
            "A dot a trial, boxes are quartiles, whiskers 5 and 95 %; numbers count the trials. All trials, failed ones too. The red line "
            "is a joint's limit.",
            lambda p: spread_figure(rows, p, looks, draws=np.random.default_rng(JITTER)),
        ),
        _gallery(
            study,
            "What planning takes",
            "Measured on this machine and in no mission time: of each trial the median and the 95th percentile of a stage's calls, of "
            "these the medians over the trials.",
            lambda p: stage_figure(rows, p, looks),
            below=lambda p: stage_table(rows, p, study.variants),
        ),
        films_section(study.folder, rows),
        trials_section(study.folder, rows),
        _method(study),
        provenance_footer(rows),
    ]
    return "".join(parts)


def _header(study: Study) -> str:
    rows = study.rows
    broken = sum(r["outcome"] == ERROR for r in rows)
    robots = " and ".join(title_of(r) for r in dict.fromkeys(p.robot for p in study.places))
    delays = ", ".join(f"{d:g}" for d in sorted({p.delay_s for p in study.places}))
    scenarios = ", ".join(sorted({r["scenario"] for r in rows}))
    mock = any((r["provenance"] or {}).get("body") == "mock" for r in rows)
    hollow = " <b>Walked by the mock, without physics on flat ground: these figures say nothing of the robots.</b>" if mock else ""
    lost = f" {broken} of them could not be run and count as not reached." if broken else ""
    part = f" <b>{words}</b>" if (words := lacking(study.folder, rows)) else ""
    trials, cases = counted(len(rows), "trial"), counted(len({r["case"] for r in rows}), "case")
    keys = "".join(f'<span><i style="background:{look.colour}"></i>{html.escape(v)}</span>' for v, look in study.looks.items())
    return (
        f"<header><h1>Planner variants compared</h1><p>{html.escape(robots)} in {html.escape(scenarios)}; {delays} s of delay each way; "
        f'{trials}, {cases}.{part}{lost}{hollow}</p><div class="key">{keys}</div></header>'
    )


def _answers(study: Study) -> str:
    first = "".join(_answer(study, p) for p in study.places if study.shown_first(p))
    rest = "".join(_answer(study, p) for p in study.places if not study.shown_first(p))
    folded = f"<details><summary>The same at other delays</summary>{rest}</details>" if rest else ""
    base, partners = html.escape(study.variants[0]), dict.fromkeys(study.partners.values())
    against = ""
    if study.partners:
        chosen = "as asked for" if study.baseline is not None else "the variant that this folder was first asked for"
        against = f"The baseline is <b>{base}</b>, {chosen}: variants are held against it, a difference is their figure less {base}'s. "
    for partner in (html.escape(p) for p in partners if p != study.variants[0]):
        against += f"Those that differ from {partner} in one stage are held against {partner}. "
    level = "Significant means at 5 % after Holm's correction over the metrics, computing times by themselves."
    return f"<section><h2>The answer</h2><p>{against}{level}</p>{first}{folded}</section>"


def _answer(study: Study, place: Place) -> str:
    tested = {c.variant: c for c in study.compared if c.place == place and c.metric.name == "success"}
    lines = []
    for found in successes(study.rows, place, study.variants):
        mine = [r for r in study.rows if place.has(r) and r["variant"] == found.variant]
        if not mine:
            continue
        well, c, r = [x for x in mine if succeeded(x)], tested.get(found.variant), found.rate
        figures = (
            f"{r.successes} of {r.trials}, {100 * r.share:.0f} %",
            share(r),
            "" if c is None else interval(c),
            "" if c is None else p_value(c.p_holm),
            *(median_cell(mine, BY_NAME[name]) for name in ("progress_m", "peak_torque_fraction")),
            *(median_cell(well, BY_NAME[name]) for name in ("mission_time_s", "command_cycles")),
            *(total_cell(mine, BY_NAME[name]) for name in ("collisions", "faults")),
        )
        cells = "".join(f'<td class="n">{html.escape(v)}</td>' for v in figures)
        lines.append(f"<tr><td>{_named(study, found.variant)}</td>{cells}</tr>")
    head = "".join(
        f'<th class="n">{t}</th>'
        for t in (
            "succeeded", "95 % interval", "difference", "p (Holm)", "progress", "peak torque", "mission time*", "command cycles*",
            "collisions", "faults",
        )
    )  # fmt: skip
    alone = ["Nothing to hold against each other: one variant only."] if not study.partners else []
    against = answer(study.rows, place, study.partners, study.compared)
    said = _list([rates(study.rows, place, study.variants), *alone, *against])
    open_questions = _list(undecided(place, study.partners, study.compared))
    if open_questions:
        said += f"<details><summary>Not significant in other figures</summary>{open_questions}</details>"
    return (
        f'<h3>{html.escape(place_title(place))}</h3><div class="scroll"><table class="wrap"><tr><th>variant</th>{head}</tr>'
        f"{''.join(lines)}</table></div>"
        f'<p class="small">Medians, collisions and faults in all, each of the trials that measured it; * of those that succeeded.</p>{said}'
    )


def _wishes(study: Study) -> str:
    if RECOMMENDED not in study.variants:
        return ""
    words = {True: ("met", "good"), False: ("not met", "bad"), None: ("not measured", "fair")}
    lines = "".join(
        f"<tr><td>{html.escape(title_of(t.robot))}: {html.escape(t.wanted)}</td><td>{html.escape(t.measured)}"
        f'<p class="small">{html.escape(t.note)}</p></td><td><span class="badge small {words[t.met][1]}">{words[t.met][0]}</span></td></tr>'
        for t in targets(study.rows)
    )
    return (
        f'<section><h2>What is wanted of {RECOMMENDED}</h2><div class="scroll"><table>'
        f"<tr><th>wanted</th><th>measured</th><th></th></tr>{lines}</table></div></section>"
    )


def _gallery(
    study: Study,
    title: str,
    text: str,
    draw: Callable[[Place], bytes | None],
    *,
    below: Callable[[Place], str] | None = None,
) -> str:
    """A section with a picture for each robot, those of other delays folded away; nothing where there is nothing to draw."""

    def figures(places: Sequence[Place]) -> str:
        out = []
        for place in places:
            data = draw(place)
            if data is not None:
                name, more = html.escape(place_title(place)), below(place) if below else ""
                out.append(f"<figure><figcaption>{name}</figcaption>{image(f'{title}: {place_title(place)}', data)}{more}</figure>")
        return f'<div class="pair">{"".join(out)}</div>' if out else ""

    first = figures([p for p in study.places if study.shown_first(p)])
    rest = figures([p for p in study.places if not study.shown_first(p)])
    folded = f"<details><summary>Other delays</summary>{rest}</details>" if rest else ""
    return f"<section><h2>{title}</h2><p>{text}</p>{first}{folded}</section>" if first or rest else ""


def _by_ground(study: Study, place: Place) -> str:
    effects = effects_by_ground(study.rows, place, baseline=study.baseline)
    if len({c.place.ground for c in effects}) < 2:
        return ""
    lines = "".join(
        f"<tr><td>{html.escape(c.place.ground)}</td><td>{_named(study, c.variant)}</td>"
        f'<td class="n">{html.escape(interval(c))}</td><td class="n">{c.difference.pairs}</td><td class="n">{p_value(c.p_holm)}</td>'
        f'<td class="n">{html.escape(needed(c)) if c.difference.mean and not c.significant else ""}</td></tr>'
        for c in effects
    )
    numbers = "".join(f'<th class="n">{t}</th>' for t in ("success", "pairs", "p (Holm)", "would take"))
    head = f"<th>ground</th><th>variant</th>{numbers}"
    return (
        f'<details><summary>Differences ground by ground</summary><div class="scroll"><table><tr>{head}</tr>{lines}</table></div>'
        '<p class="small">k is the share of ground under rocks. Holm\'s correction over the grounds.</p></details>'
    )


def _differences(study: Study, partner: str) -> str:
    def at(place: Place) -> list[Comparison]:
        return [c for c in study.compared if c.place == place and c.baseline == partner]

    stages = partner != study.variants[0]
    return _gallery(
        study,
        f"{'What stages contribute: differences' if stages else 'Differences'} from {html.escape(partner)}",
        "Mean of the paired differences with its bootstrap (BCa) 95 % interval. A full mark is significant after Holm's correction over "
        "the metrics, a hollow one is not. Arrows point to the better side. * over pairs in which both succeeded.",
        lambda p: difference_figure(at(p), study.looks),
        below=lambda p: compared_table(at(p)),
    )


def _delays(study: Study) -> str:
    out = []
    for robot in dict.fromkeys(p.robot for p in study.places):
        data = delay_figure(study.rows, robot, study.looks)
        if data is not None:
            title = html.escape(title_of(robot))
            out.append(f"<figure><figcaption>{title}</figcaption>{image(f'Over the delay: {title_of(robot)}', data)}</figure>")
    if not out:
        return ""
    text = (
        "Mission time is the median of the trials that succeeded, as many as the answer's tables say; lines upright are Wilson's 95 % "
        "intervals."
    )
    return f'<section><h2>Over the delay</h2><p>{text}</p><div class="pair">{"".join(out)}</div></section>'


def _method(study: Study) -> str:
    metrics = list({c.metric.name: c.metric for c in study.compared}.values())
    if not metrics:
        return ""
    only = ", ".join(m.title for m in metrics if m.reached_only)
    family = sum(not m.timing for m in metrics)
    notes = [
        "Trials of one case are a pair: the same ground, noise and delay under two variants. Robots are never pooled, nor are delays; "
        "scenarios of one robot are, except where they are named.",
        "A p-value is the chance that flipping signs within the pairs at random makes a mean as far from zero (for success that is "
        f"McNemar's exact test). Holm's correction runs over {counted(family, 'metric')} of one variant on one robot at one delay, as far "
        f"as they were measured; so many need {fewest_pairs(max(family, 1))} pairs before anything can be significant. Computing times "
        "are corrected by themselves: they change with the machine's load, which is to change nothing else. Intervals are not "
        "corrected, and those of rates are too narrow where few pairs differ: the p-value decides.",
        "The pairs that would be needed are those with which a paired t-test finds the effect seen at 5 % in 80 of 100 repetitions, by "
        f"itself: among many metrics it takes more. {FEWEST_PAIRS} are the least with which flipped signs reach 5 %. The "
        "effect is a mean over the standard deviation of the differences (d_z).",
        "What could not be measured is left out in pairs and shown as a dash, never as zero. A trial that could not be run did not "
        "succeed.",
    ]
    if only:
        notes.append(
            f"Compared only over pairs in which both succeeded: {only}. Who falls early is soon done, and who stands still strikes "
            "nothing. Totals and medians in the tables are of all trials unless they say otherwise."
        )
    return f"<section><h2>How this was reckoned</h2>{_list(notes)}</section>"


def _list(sentences: Sequence[str]) -> str:
    return f"<ul>{''.join(f'<li>{html.escape(s)}</li>' for s in sentences)}</ul>" if sentences else ""


def _named(study: Study, variant: str) -> str:
    return f'<span class="name"><i style="background:{study.looks[variant].colour}"></i>{html.escape(variant)}</span>'
