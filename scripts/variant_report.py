"""The report of a comparison of planner variants: one HTML page that begins with the answer, and the same figures for other programs.

    python scripts/variant_report.py out/comparison [--metrics success progress_m] [--baseline drats_2010]

Reads `results.jsonl` of the folder, with what it was asked for (`variants.txt`, `asked.txt`), and looks which trials have a report and
a film. Writes `report.html`, `results.csv`, `results.md` and, where pyarrow is installed, `results.parquet`. Exit status 0 when they were
written, 2 and one line when the folder's rows do not compare or a name is unknown.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from report_style import page
from variant_export import markdown, write_csv, write_parquet
from variant_metrics import metrics_named
from variant_page import Study, body
from variant_rows import lacking, partners_of, picked_trials, read_rows, variants_of
from variant_tables import comparisons, places_of

from athlete_twin.errors import AthleteError, RecordingError

__all__ = ["main", "picked_trials", "write_report"]

PAGE = "report.html"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Writes a comparison's report."""

    folder: Annotated[Path, tyro.conf.Positional]
    """with the results.jsonl of benchmark_variants.py"""
    metrics: tuple[str, ...] | None = None
    """figures to compare and to correct for, such as success or sag_error_m.mean; all of them unless given"""
    baseline: str | None = None
    """variant that others are held against; unless given the first that was asked for, or what a variant differs from in one stage"""


def write_report(folder: Path, *, metrics: Sequence[str] | None = None, baseline: str | None = None) -> Path:
    """Writes the page and the tables of a comparison into its folder; the page's path.

    Args:
        folder: holds `results.jsonl`.
        metrics: names of what is compared and corrected for, as `variant_metrics` knows them; None for all.
        baseline: the variant that others are held against; None for the first, or where a variant differs
            from another in one stage for that one.

    Raises:
        ConfigError: a metric or the baseline is unknown.
        RecordingError: the rows cannot be read or do not compare, or the folder cannot be written.
    """
    chosen = metrics_named(metrics)
    rows = read_rows(folder)
    variants = variants_of(rows, baseline)
    places = places_of(rows)
    compared = [c for place in places for c in comparisons(rows, place, metrics=chosen, baseline=baseline)]
    study = Study(
        folder=folder, rows=rows, places=places, variants=variants, compared=compared, baseline=baseline,
        partners=partners_of(variants, all_against_first=baseline is not None),
    )  # fmt: skip
    path = folder / PAGE
    try:
        write_csv(folder / "results.csv", rows)
        write_parquet(folder / "results.parquet", rows)
        (folder / "results.md").write_text(markdown(rows, places, variants, compared, lacking(folder, rows)), encoding="utf-8")
        path.write_text(page("Planner variants compared", body(study)), encoding="utf-8")
    except OSError as e:
        raise RecordingError(f"{folder} cannot be written: {e.strerror}; name a folder you may write to") from e
    return path


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        path = write_report(options.folder, metrics=options.metrics, baseline=options.baseline)
    except AthleteError as e:
        sys.stderr.write(f"variant_report: {' '.join(str(e).split())}\n")
        return 2
    sys.stdout.write(f"written: {path}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
