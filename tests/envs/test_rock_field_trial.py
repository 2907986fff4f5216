import importlib.util
import io
import json
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from envs.recording import read_recording

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"
SCRIPT = SCRIPTS / "rock_field_trial.py"


def run(*arguments):
    return subprocess.run([sys.executable, str(SCRIPT), *arguments], capture_output=True, text=True, timeout=120)


def script(name):
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def trial_script():
    return script("rock_field_trial")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--robot", "spider"), "robot 'spider' is not known; known robots: sdm_b, t12"),
        (("--scenario", "moon"), "scenario 'moon' is not known"),
        (("--variant", "best"), "variant 'best' is not known"),
        (("--delay", "-1"), "link delay is -1.0 s, must be 0 or more"),
        (("--operator", "bob"), "operator 'bob' is not known; known: approve_all, cautious, slow, distracted, human"),
        (("--cycles", "0"), "cycles is 0, must be 1 or more"),
        (("--seed", "-3"), "seed is -3, must be 0 or more"),
        (("--payload-kg", "1e6"), "payload is 1000000.0 kg"),
        (("--out", "/proc/nowhere"), "output folder '/proc/nowhere' cannot be written"),
    ],
)
def test_bad_usage_is_one_line_and_status_two(trial_script, capsys, tmp_path, arguments, said):
    out = () if "--out" in arguments else ("--out", str(tmp_path))
    assert trial_script.main([*arguments, *out]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and said in lines[0]


def test_unknown_key_of_a_variant_names_file_and_key(trial_script, capsys, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('self_maks = "none"\n')
    assert trial_script.main(["--variant", str(path), "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert str(path) in said and "self_maks" in said and "'self_mask'" in said


def test_unknown_flag_is_status_two():
    done = run("--bogus")
    assert done.returncode == 2 and "--bogus" in done.stderr


def test_help_is_quick():
    code = (
        "import sys; sys.argv = ['x', '--help']; sys.path.insert(0, sys.argv.pop(0) and '.')\n"
        "import runpy\n"
        "sys.argv = ['rock_field_trial.py', '--help']\n"
        f"\ntry:\n    runpy.run_path({str(SCRIPT)!r}, run_name='__main__')\nexcept SystemExit: pass\n"
        "heavy = {'pybullet', 'open3d', 'ompl', 'pinocchio', 'cv2', 'matplotlib'} & set(sys.modules)\nassert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "--scenario" in done.stdout, done.stderr


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_trial_leaves_readable_files(tmp_path, number):
    arguments = ["--scenario", "calibration_yard", "--variant", "blind", "--out", str(tmp_path)]
    # A shell that runs tests in the background has them ignore Ctrl-C, and what they start inherits it.
    process = subprocess.Popen(
        [sys.executable, str(SCRIPT), *arguments],
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    recording = tmp_path / "trial.mcap"
    deadline = time.monotonic() + 240.0  # the first run on a machine compiles its kernels
    # The true ground alone is larger than that: wait until the walk has begun.
    while time.monotonic() < deadline and not any(
        r.topic == "/truth/joints" and r.t > 20.0 for r in recorded(recording)
    ):
        time.sleep(0.5)
    os.kill(process.pid, number)
    assert process.wait(timeout=60) == 0
    assert json.loads((tmp_path / "trial.json").read_text())["outcome"] == "operator_abort"
    assert any(r.topic == "/ground/action" and r.content["kind"] == "outcome" for r in recorded(recording))


def recorded(path):
    return list(read_recording(path)) if path.exists() else []


@pytest.mark.slow
@pytest.mark.ci
def test_same_command_twice_walks_the_same_way(tmp_path):
    hashes = set()
    for name in ("a", "b"):
        out = tmp_path / name
        arguments = ("--scenario", "calibration_yard", "--variant", "blind", "--time-limit", "150", "--out", str(out))
        assert run(*arguments).returncode == 0
        hashes.add(json.loads((out / "trial.json").read_text())["trajectory_sha256"])
    assert len(hashes) == 1


def test_typed_answers_become_decisions():
    parsed = script("terminal_operator").parsed
    assert parsed("a").kind == "approve" and parsed("r").kind == "reject" and parsed("s").kind == "stop"
    assert parsed("r too near the rock").reason == "too near the rock"
    assert parsed("l 3").leg == 2
    assert parsed("c navcam_1 hazcam_2").cameras == ("navcam_1", "hazcam_2")
    assert parsed("w 12.5").duration == 12.5
    assert np.array_equal(parsed("e 1.5 -0.25").footfall_in_world[:2], [1.5, -0.25])


@pytest.mark.parametrize("typed", ["", "x", "l 7", "l", "w -3", "w long", "e 1", "c"])
def test_answers_that_mean_nothing_are_refused(typed):
    with pytest.raises(ConfigError):
        script("terminal_operator").parsed(typed)


def test_terminal_asks_again_when_the_robot_has_no_such_camera(scripted, tmp_path, monkeypatch):
    from rich.console import Console

    terminal = script("terminal_operator")
    monkeypatch.setitem(sys.modules, "preview_picture", types.SimpleNamespace(save_preview=lambda *_: None))
    agent = scripted()
    agent.next(0.0)
    agent._waiting = ""
    console, typed = Console(file=io.StringIO(), width=200), iter(["c navcam_9", "c navcam_1"])
    monkeypatch.setattr(console, "input", lambda *_, **__: next(typed))
    decision, _ = terminal.TerminalOperator(robot="sdm_b", out=tmp_path, console=console).decide(agent.next(1.0), 1.0)
    assert decision.cameras == ("navcam_1",)
    assert "camera 'navcam_9' is not one of sdm_b's; known: " in console.file.getvalue()


@pytest.mark.slow
def test_preview_is_saved_as_a_picture(tmp_path, scripted):
    import cv2

    agent = scripted()
    agent.next(0.0)
    agent._waiting = ""
    path = tmp_path / "preview.png"
    script("preview_picture").save_preview(agent.next(1.0), "sdm_b", path)
    picture = cv2.imread(str(path))
    assert picture.shape[0] > 400 and picture.std() > 10.0
