"""Every row of the environment benchmark says what a step costs, beside a bare environment, and where the time goes."""

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
        spec = importlib.util.spec_from_file_location("bench_env", SCRIPTS / "bench_env.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["bench_env"] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCRIPTS))
    return module


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.slow
def test_a_row_for_each_kind_of_step_and_shares_that_make_a_whole(bench, capsys, robot):
    assert bench.main(["--robots", robot, "--steps", "40", "--repeats", "1", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    steps, shares = [r for r in rows if r["unit"] == "us"], [r for r in rows if r["unit"] == "%"]
    assert [r["name"].split(", ", 1)[1] for r in steps] == [
        "nothing sent, no cameras", "random actions, no cameras", "nothing sent, all cameras", "random actions, all cameras",
    ]  # fmt: skip
    assert all(0.0 < r["peer"] < r["ours"] for r in steps)
    assert [r["target"] for r in steps] == ["<= 200", "<= 200", "", ""]
    assert sum(r["ours"] for r in shares) == pytest.approx(100.0) and all(r["ours"] >= 0.0 for r in shares)


def test_an_unknown_robot_is_one_line_and_exit_status_2(bench, capsys):
    assert bench.main(["--robots", "sdm_x"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "sdm_b, t12" in said
