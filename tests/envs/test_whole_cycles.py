"""Whole gait cycles of both robots among rocks, everything real: eyes, planner, link, executive, physics."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "rock_field_trial.py"


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize(("robot", "scenario"), [("sdm_b", "rock_field"), ("t12", "black_point")])
def test_a_gait_cycle_among_rocks_tips_nothing_and_is_commanded_over_the_link(tmp_path, robot, scenario):
    arguments = ["--robot", robot, "--scenario", scenario, "--cycles", "1", "--out", str(tmp_path)]
    subprocess.run([sys.executable, str(SCRIPT), *arguments], check=True, capture_output=True, timeout=900)
    result = json.loads((tmp_path / "trial.json").read_text())
    assert result["outcome"] == "cycles_done", result["reason"]
    assert result["gait_cycles"] == 1
    # One uplink a step and one for the survey: each costs a round trip of two delays at least.
    assert result["link_s"] >= 6 * 2 * 5.0
    assert result["peak_torque_fraction"] < 1.05
    assert result["min_support_margin_m"] > 0.0
    assert result["localisation_error_m"]["max"] < 0.15
    assert result["map_error_m"]["median"] < 0.05
