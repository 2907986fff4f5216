"""A benchmark's rows judge what they say they judge."""

import importlib.util
import json
from pathlib import Path

import pytest

SPEC = importlib.util.spec_from_file_location("bench_table", Path(__file__).parents[2] / "scripts" / "bench_table.py")
table = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(table)
KEYS = {"name", "ours", "unit", "peer_name", "peer", "ratio", "target", "met"}


@pytest.mark.parametrize(
    ("value", "target", "met"),
    [(1.0, "<= 1.0", True), (1.1, "<= 1.0", False), (2.0, "> 2", False), (0.9, "0.85 - 0.95", True), (0.96, "0.85 - 0.95", False)],
)
def test_a_target_is_met_or_not(value, target, met):
    assert table.row("x", value, "s", target=target)["met"] is met


def test_a_target_for_the_ratio_judges_the_ratio():
    r = table.row("x", 10.0, "s", target=">= 5", of="ratio", peer_name="other", peer=4.0)
    assert (r["ratio"], r["met"]) == (2.5, False)
    assert set(r) == KEYS


@pytest.mark.parametrize("ours", [None, float("nan")])
def test_what_was_not_measured_is_null_and_judged_by_nobody(ours):
    r = table.row("x", ours, "s", target="<= 1")
    assert r["ours"] is None and r["met"] is None


@pytest.mark.parametrize(("ours", "target"), [(float("-inf"), ">= 0.30"), (float("inf"), "<= 1.0")])
def test_a_figure_beyond_all_numbers_was_measured_and_misses(ours, target):
    r = table.row("margin of a stance that nothing holds", ours, "m", target=target)
    assert r["met"] is False and r["ours"] is None
    json.dumps(r, allow_nan=False)


def test_a_no_stands_with_its_reason(capsys):
    r = table.row("peak torque", float("nan"), "of the limit", peer_name="other", peer=0.4, no="no pushing forces hold the stance")
    assert (r["name"], r["ours"], r["ratio"], r["met"]) == ("peak torque: no, no pushing forces hold the stance", None, None, False)
    assert set(r) == KEYS
    table.show([r], as_json=False)
    assert "no pushing forces" in " ".join(capsys.readouterr().out.split())


def test_a_target_that_cannot_be_read_is_refused():
    with pytest.raises(ValueError, match="neither a comparison"):
        table.row("x", 1.0, "s", target="about 3")


def test_rows_are_one_json_object(capsys):
    table.show([table.row("x", 1.0, "s", target="<= 2")], as_json=True)
    printed = json.loads(capsys.readouterr().out)
    assert printed["rows"][0]["met"] is True and printed["provenance"]


def test_rows_are_a_table_for_people(capsys):
    table.show([table.row("pair", 1.0, "s", target="<= 2")], as_json=False)
    out = capsys.readouterr().out
    assert "pair [s]" in out and "yes" in out
