"""The table counts what the trials say, failures included."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "results_table.py"


@pytest.fixture(scope="module")
def results_table():
    spec = importlib.util.spec_from_file_location("results_table", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["results_table"] = module
    spec.loader.exec_module(module)
    return module


def trial(outcome: str, collisions: int, progress: float) -> dict:
    return {
        "robot": "sdm_b", "scenario": "rock_field", "variant": "integrated", "outcome": outcome, "collisions": collisions,
        "progress_m": progress, "mission_time_s": 100.0, "wall_time_s": 10.0, "peak_torque_fraction": 0.5,
    }  # fmt: skip


def test_failures_stand_beside_successes(results_table):
    text = results_table.table([trial("goal_reached", 0, 3.0), trial("goal_reached", 2, 2.9), trial("fault", 1, 0.4)])
    row = [cell.strip() for cell in text.splitlines()[2].strip("|").split("|")]
    assert row[3:10] == ["3", "2", "2", "1", "0", "3", "1 fault"]
    assert row[10] == "2.90"


def test_a_folder_without_a_trial_is_named(results_table, tmp_path, capsys):
    assert results_table.main([str(tmp_path)]) == 2
    assert "trial.json: no readable trial" in capsys.readouterr().err


def test_the_command_prints_the_table(results_table, tmp_path, capsys):
    (tmp_path / "trial.json").write_text(json.dumps(trial("goal_reached", 0, 3.0)))
    assert results_table.main([str(tmp_path)]) == 0
    assert "| sdm_b | rock_field | integrated | 1 | 1 |" in capsys.readouterr().out
