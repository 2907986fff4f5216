import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

from athlete_twin.link import downlink, uplink
from envs.origin import recorded_origin
from envs.prepare import Wanted, prepared
from envs.recorder import Recorder
from envs.recording import read_recording

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    wanted = Wanted(
        robot="sdm_b", scenario="rock_field", variant="blind", seed=2, operator="distracted", up=uplink(0.5),
        down=downlink(0.5), time_limit=8.0, body="mock",
    )  # fmt: skip
    out = tmp_path_factory.mktemp("trial")
    prepared(wanted, out).run()
    return out / "trial.mcap"


@pytest.mark.slow
def test_a_walk_of_the_planners_comes_again_in_fresh_processes(tmp_path):
    """From the seed alone: nothing that a process keeps, such as caches or the order of its hashes, decides anything."""
    wanted = Wanted(
        robot="sdm_b", scenario="rock_field", variant="blind", seed=3, operator="approve_all", up=uplink(0.5),
        down=downlink(0.5), time_limit=120.0, body="mock",
    )  # fmt: skip
    assert prepared(wanted, tmp_path).run().steps_taken >= 1
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    for hash_seed in ("1", "2"):
        done = subprocess.run(
            [sys.executable, str(ROOT / "scripts" / "replay_trial.py"), str(tmp_path / "trial.mcap")],
            capture_output=True, text=True, env=environment | {"PYTHONHASHSEED": hash_seed}, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert ": equal: " in done.stdout and done.stdout.endswith("1 of 1 equal\n")


@pytest.fixture
def replay_trial(script, monkeypatch):
    module = script("replay_trial")
    # It imports its neighbours when it needs them.
    monkeypatch.syspath_prepend(str(Path(module.__file__).parent))
    return module


def test_a_recording_comes_again(replay_trial, recording, capsys):
    assert replay_trial.main([str(recording), str(recording)]) == 0
    said = capsys.readouterr().out
    assert "equal: " in said and said.endswith("2 of 2 equal\n")


@pytest.mark.slow
@pytest.mark.ci
def test_a_recording_cut_before_its_first_message_is_not_called_equal(replay_trial, recording, tmp_path, capsys):
    path = tmp_path / "empty.mcap"
    Recorder(path, metadata=recorded_origin(recording).metadata()).close()
    assert list(read_recording(path)) == []
    assert replay_trial.main([str(path)]) == 1
    said = capsys.readouterr().out
    assert "NOTHING COMPARED: the recording was cut before its first message" in said and said.endswith("0 of 1 equal\n")


def test_what_differs_first_is_told_with_status_one(replay_trial, recording, tmp_path, capsys):
    """A recording with one figure of one message changed, all checksums right."""
    path, changed = tmp_path / "changed.mcap", []
    with Recorder(path, metadata=recorded_origin(recording).metadata()) as recorder:
        for line in read_recording(recording):
            content = line.content
            if line.topic == "/truth/state" and not changed:
                content["com_in_world"][2] += 1e-12
                changed.append(line.t)
            recorder.write(line.topic, content, line.t, made=line.made)
    assert replay_trial.main([str(path)]) == 1
    said = capsys.readouterr().out
    assert f"DIFFERENT, first at {changed[0]:.3f} s on /truth/state: com_in_world[2] was " in said and "0 of 1 equal" in said


def test_a_recording_of_other_versions_is_refused_unless_told(replay_trial, recording, monkeypatch, capsys):
    from envs import origin

    now = origin.provenance()
    other = dict(now) | {"packages": dict(now["packages"]) | {"numpy": "9.9"}}
    monkeypatch.setattr(origin, "provenance", lambda: other)
    assert replay_trial.main([str(recording)]) == 2
    said = capsys.readouterr().err
    assert "numpy was" in said and "is 9.9" in said and "--anyway" in said and len(said.splitlines()) == 1
    assert replay_trial.main([str(recording), "--anyway"]) == 0


def test_walk_and_table_tell_the_same_events(replay_trial, recording, tmp_path, capsys):
    table = tmp_path / "a.csv"
    assert replay_trial.main([str(recording), "--no-rerun", "--clock", "operator", "--walk", "--table", str(table)]) == 0
    lines = capsys.readouterr().out.splitlines()
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(lines) == len(rows) + 1 and "s old  /downlink/telemetry" in lines[0]
    assert {"t_s", "at_robot_s", "at_operator_s", "age_s", "x_m", "predicted_margin_m", "decision_s"} <= set(rows[0])
    assert not any(row["topic"].startswith("/truth/") for row in rows)
    ages = [float(row["age_s"]) for row in rows if row["topic"] == "/downlink/telemetry"]
    assert min(ages) >= 0.5


def test_by_the_robots_clock_the_table_tells_its_stability_in_metres(replay_trial, recording, tmp_path):
    """DESIGN: tip-over energy is per weight, the height by which the centre of mass must rise."""
    table = tmp_path / "a.csv"
    assert replay_trial.main([str(recording), "--no-rerun", "--table", str(table)]) == 0
    with table.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["topic"] == "/truth/state"]
    recorded = [r.content["tip_over_energy"] for r in read_recording(recording) if r.topic == "/truth/state"]
    assert [float(row["tip_over_energy_m"]) for row in rows] == recorded
    assert not any(name.endswith("_j") for name in rows[0])


def test_parquet_holds_what_csv_holds(replay_trial, recording, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    for name in ("a.csv", "a.parquet"):
        assert replay_trial.main([str(recording), "--no-rerun", "--table", str(tmp_path / name)]) == 0
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    table = parquet.read_table(tmp_path / "a.parquet")
    assert table.num_rows == len(rows) and table.column_names == list(rows[0])
    assert table["t_s"].to_pylist() == [float(row["t_s"]) for row in rows]


@pytest.mark.slow
def test_pictures_are_made_for_either_clock(replay_trial, recording, tmp_path):
    import cv2

    for clock in ("robot", "operator"):
        arguments = [str(recording), "--no-rerun", "--clock", clock, "--figures", str(tmp_path)]
        assert replay_trial.main(arguments) == 0
    for name in ("robot_clock", "operator_clock", "link", "maps", "series"):
        picture = cv2.imread(str(tmp_path / f"{name}.png"))
        assert picture.shape[0] > 400 and picture.std() > 5.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "no recording is named"),
        (("nowhere.mcap",), "nowhere.mcap: no such recording"),
        (("FILE", "--table", "a.xls"), "--table a.xls: .csv or .parquet would have worked"),
        (("FILE", "--film", "a.mp4"), "--film a.mp4: a path ending in .webm would have worked"),
        (("FILE", "FILE", "--table", "a.csv"), "--table takes one recording, not 2"),
        (("FILE", "--begin", "9", "--end", "3"), "--begin 9.0 s is after --end 3.0 s"),
        (("FILE", "--no-rerun", "--table", "/proc/nowhere.csv"), "/proc/nowhere.csv: cannot be written"),
        (("FILE", "--keep", "FOLDER"), "would write over it"),
    ],
)
def test_bad_usage_is_one_line_and_status_two(replay_trial, recording, capsys, arguments, said):
    named = {"FILE": str(recording), "FOLDER": str(recording.parent)}
    assert replay_trial.main([named.get(a, a) for a in arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and said in lines[0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"robot": "sdm', "trial.json is damaged: Unterminated string"),
        ("[]", "trial.json is damaged: it holds a list, not the object that a trial writes"),
        ("{}", "trial.json is damaged: it does not say robot, scenario"),
    ],
)
@pytest.mark.parametrize("wanted", [("--film", "a.webm"), pytest.param(("--figures", "pictures"), marks=pytest.mark.slow)])
def test_a_damaged_trial_json_beside_a_recording_is_told_with_its_path(replay_trial, recording, tmp_path, capsys, wanted, text, said):
    (tmp_path / "trial.mcap").symlink_to(recording)
    (tmp_path / "trial.json").write_text(text)
    option, name = wanted
    assert replay_trial.main([str(tmp_path / "trial.mcap"), "--no-rerun", option, str(tmp_path / name)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and f"{tmp_path}/{said}" in lines[0]


def test_a_file_that_is_no_recording_is_refused_by_name(replay_trial, tmp_path, capsys):
    path = tmp_path / "a.mcap"
    path.write_text("nothing of the kind")
    assert replay_trial.main([str(path)]) == 2
    assert f"{path}: is no MCAP file" in capsys.readouterr().err
