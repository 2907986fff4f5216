"""Do the footfall methods of 1989 agree with each other as their authors found? And what does height error change?

    python scripts/footfall_agreement.py [--seed 0] [--seeds 20] [--ground sandbox] [--error 0.0] [--json] [--out DIR]

Repeats the experiment of [Caillas1989] s3.2.2 on seeded ground (`footfall_experiment.py` says how) and prints

- one experiment of 16 regions, that of `--seed`, beside the paper's table: who chose by who judged, 0 for the judge's own
  best and 100 for its worst, and each row's mean as eq. 11 has it and over those who judged;
- the same over `--seeds` experiments: mean and standard deviation, and in how many the paper's order holds (Max-Min, Free
  Volume and Equilibrium agree with the others, Plane Fit less, Support Area least);
- the same where every cell's height is off by 1, 5 and 10 cm (one sigma, each cell by itself), and what the choices made on
  such a map cost on the true ground.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from footfall_experiment import (
    BESIDE,
    CHOOSERS,
    GROUNDS,
    JUDGES,
    NAMES,
    PAPER,
    elevation,
    loss,
    order_holds,
    regions,
    row_means,
    table,
    with_error,
)
from rich.console import Console
from rich.table import Table

from athlete_twin.errors import AthleteError
from envs.provenance import provenance
from planner.footfall_scores import SHAPES

ERRORS = (0.0, 0.01, 0.05, 0.10)
"""of the heights, one sigma [m]"""
ALL = (*CHOOSERS, *BESIDE)


@dataclass(frozen=True, kw_only=True)
class Options:
    """Prints the tables and draws them."""

    seed: int = 0
    """of the one experiment, and the first of several"""
    seeds: int = 20
    """experiments over which mean and spread are taken"""
    ground: str = "sandbox"
    """sandbox (flat to very rough), rock_field, black_point or moses_lake"""
    error: float = 0.0
    """of the heights in the first two tables, one sigma [m]"""
    support: float = 0.5
    """of the foot: what must bear, for Support Area. The paper reckons with one half and does not say what its experiment had"""
    shape: str = "square"
    """of the foot: the paper's square of 30 cm, or a disc"""
    out: Path | None = None
    """folder for a picture; none is drawn without it"""
    json: bool = False
    """print one JSON object instead of the tables"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        wrong = _wrong(options)
        if wrong:
            sys.stderr.write(f"footfall_agreement: {wrong}\n")
            return 2
        found = results(options)
    except AthleteError as e:
        sys.stderr.write(f"footfall_agreement: {' '.join(str(e).split())}\n")
        return 2
    if options.out is not None:
        from footfall_picture import draw

        options.out.mkdir(parents=True, exist_ok=True)
        path = options.out / "footfall_agreement.png"
        heights = with_error(elevation(options.ground, options.seed), options.error, options.seed)
        chosen = regions(heights, shape=options.shape, support=options.support)
        path.write_bytes(draw(found, chosen))
        sys.stderr.write(f"figure: {path}\n")
    if options.json:
        sys.stdout.write(json.dumps({**found, "provenance": provenance()}) + "\n")
    else:
        _print(found)
    return 0


def results(options: Options) -> dict[str, Any]:
    """All figures, as they stand in the JSON; percentages, and metres where the key says `_m`."""
    range_of_seeds = range(options.seed, options.seed + options.seeds)
    grounds = {seed: elevation(options.ground, seed) for seed in range_of_seeds}
    true = {seed: regions(heights, shape=options.shape, support=options.support) for seed, heights in grounds.items()}

    def noisy(error: float) -> dict[int, Any]:
        if error == 0.0:
            return true
        return {s: regions(with_error(h, error, s), shape=options.shape, support=options.support) for s, h in grounds.items()}

    maps = {error: noisy(error) for error in dict.fromkeys((options.error, *ERRORS))}
    tables = {error: np.array([table(r, r, ALL) for r in by_seed.values()]) for error, by_seed in maps.items()}
    return {
        "ground": options.ground,
        "shape": options.shape,
        "support": options.support,
        "seed": options.seed,
        "seeds": options.seeds,
        "error_m": options.error,
        "judges": list(JUDGES),
        "paper": _summary(PAPER[None], CHOOSERS),
        "one": _summary(tables[options.error][:1], ALL),
        "all": _summary(tables[options.error], ALL),
        "errors": [
            {
                "error_m": error,
                **_summary(tables[error], CHOOSERS),
                "loss": _losses([loss(maps[error][s], true[s]) for s in range_of_seeds]),
            }
            for error in ERRORS
        ],
    }


def _summary(values: np.ndarray, choosers: Sequence[str]) -> dict[str, Any]:
    """Of tables, shape (seeds, rows, judges): mean, standard deviation, and whether the paper's order holds."""
    values = values[:, : len(choosers)]
    means = {over: np.array([row_means(v, choosers, over=over) for v in values]) for over in ("printed", "judges")}
    order = [order_holds(m[: len(CHOOSERS)]) for m in means["printed"]]
    return {
        "choosers": list(choosers),
        "table": _rounded(values.mean(axis=0)),
        "table_deviation": _rounded(values.std(axis=0)),
        "row_means": {over: _rounded(m.mean(axis=0)) for over, m in means.items()},
        "row_means_deviation": {over: _rounded(m.std(axis=0)) for over, m in means.items()},
        "order_of_the_mean": order_holds(means["printed"].mean(axis=0)[: len(CHOOSERS)]),
        "order_held_in": {key: sum(one[key] for one in order) for key in order[0]},
        "experiments": len(values),
    }


def _losses(found: list[dict[str, tuple[float, float]]]) -> dict[str, dict[str, float]]:
    return {
        method: {
            "own_judgement": round(float(np.mean([f[method][0] for f in found])), 4),
            "height_range_m": round(float(np.mean([f[method][1] for f in found])), 6),
        }
        for method in JUDGES
    }


def _rounded(values: np.ndarray) -> list[Any]:
    return list(np.round(values, 4).tolist())


def _wrong(options: Options) -> str:
    if options.ground not in GROUNDS:
        return f"--ground {options.ground!r} is not one of {', '.join(GROUNDS)}"
    if options.shape not in SHAPES:
        return f"--shape {options.shape!r} is not one of {', '.join(SHAPES)}"
    if options.seed < 0 or options.seeds < 1:
        return f"--seed {options.seed} must be 0 or more and --seeds {options.seeds} at least 1"
    if not 0.0 < options.support <= 1.0:
        return f"--support {options.support} is not above 0 and at most 1"
    if not 0.0 <= options.error <= 1.0:
        return f"--error {options.error} m is outside 0 to 1 m"
    return ""


def _print(found: dict[str, Any]) -> None:
    console = Console() if sys.stdout.isatty() else Console(width=150)
    where = f"{found['ground']}, heights off by {100 * found['error_m']:.0f} cm"
    console.print(_beside_paper(found, found["one"], f"one experiment, seed {found['seed']}: {where}"))
    last = found["seed"] + found["seeds"] - 1
    console.print(_beside_paper(found, found["all"], f"mean and deviation of seeds {found['seed']} to {last}: {where}"))
    console.print(_by_error(found))
    console.print(_lost(found))


def _beside_paper(found: dict[str, Any], ours: dict[str, Any], title: str) -> Table:
    """Ours, and the paper's in brackets."""
    paper, several = found["paper"], ours["experiments"] > 1
    shown = Table("chosen by, judged", *(f"by {NAMES[j]}" for j in JUDGES), "mean, eq. 11", "over its judges", title=f"{title} [%]")
    for row, method in enumerate(ours["choosers"]):
        cells = [*ours["table"][row], ours["row_means"]["printed"][row], ours["row_means"]["judges"][row]]
        spread = [*ours["table_deviation"][row], *(ours["row_means_deviation"][over][row] for over in ("printed", "judges"))]
        texts = [f"{value:.1f} ± {by:.1f}" if several else f"{value:.1f}" for value, by in zip(cells, spread, strict=True)]
        if method in CHOOSERS:
            known = [*paper["table"][row], *(paper["row_means"][over][row] for over in ("printed", "judges"))]
            texts = [f"{text} ({value:.1f})" for text, value in zip(texts, known, strict=True)]
        else:
            texts[4] = "-"
        shown.add_row(NAMES[method], *texts)
    shown.caption = f"in brackets: the paper's. {_verdict(ours)}"
    return shown


def _by_error(found: dict[str, Any]) -> Table:
    """Means of rows, and whether their order is the paper's."""
    title = f"eq. 11 [%] of {found['seeds']} experiments by height error: {found['ground']}"
    shown = Table("height error", *(NAMES[m] for m in CHOOSERS), "order of the means", "in experiments", title=title)
    for one in found["errors"]:
        pairs = zip(one["row_means"]["printed"], one["row_means_deviation"]["printed"], strict=True)
        held = "holds" if one["order_of_the_mean"]["all"] else "does not hold"
        shown.add_row(
            f"{100 * one['error_m']:.0f} cm", *(f"{value:.1f} ± {by:.1f}" for value, by in pairs), held,
            f"{one['order_held_in']['all']} of {one['experiments']}",
        )  # fmt: skip
    return shown


def _lost(found: dict[str, Any]) -> Table:
    """What choices made on a map with errors are worth on the true ground."""
    title = "choices on such a map, on the true ground: own best missed by [%], height range under the foot [cm]"
    shown = Table("height error", *(NAMES[j] for j in JUDGES), title=title)
    for one in found["errors"]:
        lost = [one["loss"][judge] for judge in JUDGES]
        cells = (f"{v['own_judgement']:.0f} %, {100 * v['height_range_m']:.1f} cm" for v in lost)
        shown.add_row(f"{100 * one['error_m']:.0f} cm", *cells)
    return shown


def _verdict(one: dict[str, Any]) -> str:
    whole = "holds" if one["order_of_the_mean"]["all"] else "does not hold"
    if one["experiments"] == 1:
        return f"The paper's order {whole}"
    return f"The paper's order {whole} of the means, and in {one['order_held_in']['all']} of {one['experiments']} experiments"


if __name__ == "__main__":
    sys.exit(main())
