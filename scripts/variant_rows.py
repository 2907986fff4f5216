"""Reads the rows of a comparison: one trial a line of `results.jsonl`, all of one suite and one version.

The last line may be torn, since a run that is killed dies while it writes; whatever else does not fit is refused with its line's number.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from variant_fields import PARTS, misfit
from variant_metrics import METRICS, Row, succeeded

from athlete_twin.errors import ConfigError, RecordingError

FILE, VARIANTS, ASKED_FOR = "results.jsonl", "variants.txt", "asked.txt"
"""rows, and what was asked for: variants in their order, trials by case and variant"""
ERROR = "error"
"""outcome of a trial that could not be run"""
RECOMMENDED = "integrated"
"""the variant of which something is wanted"""
IDENTIFYING = ("robot", "scenario", "variant", "seed", "delay_s", "case", "folder", "outcome", "reason", "suite_sha256", "provenance")
STAGES = (
    "self_mask", "fusion", "localisation", "sag", "margin", "footfall", "leg_planner", "smoothing", "gait", "body_motion", "touchdown",
    "unknown_terrain", "level_deck",
)  # fmt: skip
"""of a planner, as the keys of a variant name them"""
REQUIRED = (*IDENTIFYING, "gait_cycles", *PARTS, *dict.fromkeys(m.name.split(".")[0] for m in METRICS if m.name != "success"))


def lacking(folder: Path, rows: Sequence[Row]) -> str:
    """Says how many of the trials that the folder was asked for have no row; empty where all have, or where nobody noted what was asked."""
    asked = set(_noted(folder / ASKED_FOR))
    missing = len(asked - {f"{row['case']} {row['variant']}" for row in rows})
    return f"A part only: {missing} of the {len(asked)} trials asked for have not been run." if missing else ""


def _noted(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:  # results.jsonl may be all that there is
        return []
    except (OSError, UnicodeDecodeError) as e:
        raise RecordingError(f"{path} cannot be read ({e}); name a folder written by benchmark_variants.py") from e


def read_rows(folder: Path) -> list[Row]:
    """Rows of the folder's `results.jsonl`: variants in the order of its `variants.txt`, or as they first stand; of each its cases by name.

    Raises:
        RecordingError: the file is missing, empty or broken, or mixes suites or versions.
    """
    path = folder / FILE
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as e:
        raise RecordingError(f"{path} cannot be read ({e}); name a folder written by benchmark_variants.py") from e
    rows: dict[tuple[str, str], tuple[int, Row]] = {}  # by case and variant, with the number of the line
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        row = _parsed(path, number, line, last=number == len(lines))
        if row is None:
            continue
        key = (row["case"], row["variant"])
        if key in rows and rows[key][1]["outcome"] != ERROR:
            raise RecordingError(
                f"{path} line {number}: {row['variant']} on {row['case']} stands in line {rows[key][0]} already; delete one of both"
            )
        rows[key] = (number, row)  # what could not be run at first may have been run again
    if not rows:
        raise RecordingError(f"{path} holds no whole row yet; run benchmark_variants.py --out {folder} until a trial has ended")
    _of_one_kind(path, list(rows.values()))
    order = {variant: i for i, variant in enumerate(dict.fromkeys([*_noted(folder / VARIANTS), *(variant for _, variant in rows)]))}
    return sorted((row for _, row in rows.values()), key=lambda row: (order[row["variant"]], row["case"]))


def variants_of(rows: list[Row], baseline: str | None = None) -> tuple[str, ...]:
    """Names of the variants in the order of the rows, but for the baseline, which is the first.

    Args:
        rows: of a comparison.
        baseline: the variant that others are held against; None for the first of the rows.
    """
    names = list(dict.fromkeys(str(row["variant"]) for row in rows))
    if baseline is not None and baseline not in names:
        raise ConfigError(f"baseline {baseline!r} was not run; the variants are {', '.join(names)}")
    first = baseline or names[0]
    return (first, *(name for name in names if name != first))


def partners_of(variants: Sequence[str], *, all_against_first: bool = False) -> dict[str, str]:
    """What each variant but the first is held against.

    That is the first, but for a variant which differs from another in one stage and is named so: `drats_2010_sag` is held against
    `drats_2010` where that takes part, which tells what the stage contributes.

    Args:
        variants: the baseline first.
        all_against_first: leave no exception.
    """
    first, *others = variants
    partners = dict.fromkeys(others, first)
    for variant in () if all_against_first else others:
        for stage in STAGES:
            base = variant.removesuffix(f"_{stage}")
            if base != variant and base in variants:
                partners[variant] = base
    return partners


def picked_trials(rows: list[Row]) -> dict[tuple[str, str], dict[str, Row]]:
    """Trials worth a film: the `best`, `median` and `worst` of each robot and variant.

    Ranked over all cases by success, then progress, then the shorter mission time; ties by the case's name, so that the same rows
    always pick the same trials. The median of an even number is the better of the middle two. Trials that could not be run have
    nothing to show and are left out; of a single trial all three are the same.

    Returns:
        By (robot, variant), in order of name; a key is missing where no trial was run.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row["outcome"] != ERROR:
            groups.setdefault((row["robot"], row["variant"]), []).append(row)
    picked = {}
    for key in sorted(groups):
        ranked = sorted(groups[key], key=_rank)
        picked[key] = {"best": ranked[0], "median": ranked[(len(ranked) - 1) // 2], "worst": ranked[-1]}
    return picked


def _rank(row: Row) -> tuple[bool, float, float, str]:
    progress, mission_time = row.get("progress_m"), row.get("mission_time_s")
    return (
        not succeeded(row),
        -float(progress) if progress is not None else float("inf"),
        float(mission_time) if mission_time is not None else float("inf"),
        str(row["case"]),
    )


def _parsed(path: Path, number: int, line: str, *, last: bool) -> Row | None:
    """A line's row; None of a last line that was torn while being written."""
    try:
        row: Any = json.loads(line)
    except json.JSONDecodeError as e:
        if last:
            return None
        raise RecordingError(f"{path} line {number}: no JSON ({e}); delete the line and run the benchmark again to fill it") from e
    if not isinstance(row, dict):
        raise RecordingError(f"{path} line {number}: {type(row).__name__} instead of an object; a row is what trial.json holds")
    missing = [key for key in REQUIRED if key not in row]
    if missing:
        raise RecordingError(
            f"{path} line {number}: no {', '.join(missing)}; a row holds all of trial.json, and delay_s, case and folder"
        )
    wrong = misfit(row)
    if wrong:
        raise RecordingError(f"{path} line {number}: {wrong}")
    for metric in METRICS:
        try:
            metric.read(row)
        except RecordingError as e:
            raise RecordingError(f"{path} line {number}: {e}") from e
    return row


def _of_one_kind(path: Path, numbered: list[tuple[int, Row]]) -> None:
    """Refuses rows whose figures do not compare: of two suites, or computed by two versions."""
    _one(path, "suites", [(n, row["suite_sha256"]) for n, row in numbered])
    origins = [(n, row["provenance"]) for n, row in numbered if row["provenance"]]
    for key in ("version", "git_sha", "packages", "code_sha256"):
        _one(path, f"versions ({key})", [(n, origin.get(key)) for n, origin in origins])


def _one(path: Path, what: str, found: list[tuple[int, Any]]) -> None:
    for number, value in found:
        if value != found[0][1]:
            raise RecordingError(
                f"{path} line {number}: mixes {what}: {_short(value)} here, {_short(found[0][1])} in line {found[0][0]}; "
                "run each comparison into a folder of its own"
            )


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} {v}" for k, v in sorted(value.items())) + "}"
    return str(value)[:16] if value is not None else "none"
