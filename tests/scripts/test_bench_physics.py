"""Every row of the physics benchmark says what it measured, against whom, and whether that is enough."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
KEYS = {"name", "ours", "unit", "peer_name", "peer", "ratio", "target", "met"}


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(SCRIPTS))
    try:
        spec = importlib.util.spec_from_file_location("bench_physics", SCRIPTS / "bench_physics.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["bench_physics"] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCRIPTS))
    return module


def test_a_row_with_a_peer_is_judged_by_its_ratio(bench):
    assert bench._against("swing", 20.0, "naive PyBullet", 2.0, 5.0)["met"] is True
    row = bench._against("swing", 20.0, "naive PyBullet", 5.0, 5.0)
    assert (row["ratio"], row["target"], row["met"]) == (4.0, ">= 5.0", False)
    assert set(row) == KEYS


def test_a_peer_that_is_not_installed_is_null_and_says_so(bench, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    spec = bench.load_spec("sdm_b")
    assert bench.mujoco_speed(spec, None) is None
    row = bench._against("physics alone", 20.0, "MuJoCo, not measured", None, 0.5)
    assert row["peer"] is None and row["ratio"] is None and row["met"] is None
    assert "not measured" in row["peer_name"]


def test_a_row_without_a_peer_is_judged_by_our_figure(bench):
    assert bench._by_itself("held still", 2000.0, 1000.0)["met"] is True
    assert bench._by_itself("held still", 999.0, 1000.0)["met"] is False


def test_an_unknown_robot_is_one_line_and_exit_status_2(bench, capsys):
    assert bench.main(["--robots", "sdm_x"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.ci
def test_the_benchmark_prints_a_row_for_each_state_and_peer(bench, capsys):
    assert bench.main(["--robots", "sdm_b", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert all(set(row) == KEYS and row["ours"] > 0.0 for row in printed["rows"])
    names = " ".join(row["name"] for row in printed["rows"])
    assert all(word in names for word in ("leg swing", "body shift", "held still", "physics alone", "MuJoCo"))
    assert printed["provenance"]
