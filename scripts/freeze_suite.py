"""Writes into a suite's file what the suite is now, so that a later change of its cases or scenarios is noticed.

    python scripts/freeze_suite.py my_suite.toml

Replaces the table [frozen] at the end of the file. A frozen suite that people have results of gets another name instead.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

from athlete_twin.errors import AthleteError
from envs.suite import Suite, frozen_table, unfrozen_suite


@dataclass(frozen=True, kw_only=True)
class Options:
    """Freezes one suite."""

    path: tyro.conf.Positional[Path]
    """its file, ending in .toml"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        suite = freeze(options.path)
    except AthleteError as e:
        sys.stderr.write(f"freeze_suite: {' '.join(str(e).split())}\n")
        return 2
    sys.stdout.write(f"{options.path}: {len(suite.cases)} cases, sha256 {suite.sha256}\n")
    return 0


def freeze(path: Path) -> Suite:
    """Writes the table; the suite that is now frozen."""
    suite = unfrozen_suite(path)
    text = path.read_text().partition("\n[frozen]")[0].rstrip("\n")
    path.write_text(f"{text}\n\n{frozen_table(suite)}")
    return suite


if __name__ == "__main__":
    sys.exit(main())
