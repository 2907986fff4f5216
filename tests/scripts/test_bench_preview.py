"""The benchmark of previews has its rows, and each fault that it puts in is one by another reckoning."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(SCRIPTS))
    try:
        spec = importlib.util.spec_from_file_location("bench_preview", SCRIPTS / "bench_preview.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["bench_preview"] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCRIPTS))
    return module


@pytest.mark.slow
def test_every_kind_of_fault_is_put_in_and_found_and_sound_motions_raise_no_alarm(bench, capsys):
    arguments = ["--robots", "sdm_b", "--scenario", "calibration_yard", "--motions", "3", "--mock-motions", "3", "--faults", "10", "--json"]
    assert bench.main(arguments) == 0
    rows = {row["name"].split(": ", 1)[1]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    found = {name: row for name, row in rows.items() if "found" in name}
    assert set(found) == {f"{kind} found, of 2" for kind in bench.KINDS}
    assert all(row["ours"] == 2.0 and row["met"] for row in found.values())
    assert rows["false alarms in 6 sound sequences"]["ours"] == 0.0
    assert rows["wheels, 95th percentile over 3 motions, from the true chassis"]["met"]


def test_counts_that_make_no_sense_are_one_line_and_exit_status_2(bench, capsys):
    assert bench.main(["--motions", "0"]) == 2
    assert "must be 1 or more" in capsys.readouterr().err
