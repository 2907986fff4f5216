"""A trial killed at any moment (SIGKILL) leaves a recording that opens and holds all but the last second."""

import json
import subprocess
import sys

import pytest

from envs.recording import read_recording, recorded_attachments
from envs.rerun import ending_of

PROGRAM = """
import json, os, random, signal, sys, time
from pathlib import Path
from athlete_twin.link import downlink, uplink
from envs import recorder
from envs.prepare import Wanted, prepared

folder, kills, body = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
dice = random.Random(7)

def trial(out, log):
    count, put = [0], recorder.Recorder._put
    def noted(self, *args, **more):
        put(self, *args, **more)
        count[0] += 1
        os.write(log, f"{count[0]} {time.monotonic()}\\n".encode())
    recorder.Recorder._put = noted
    way = {"up": uplink(0.5), "down": downlink(0.5)}
    prepared(Wanted(robot="sdm_b", scenario="rock_field", variant="blind", seed=0, operator="approve_all", body=body, **way), out).run()

for k in range(kills):
    out = folder / str(k)
    out.mkdir()
    log = os.open(out / "log", os.O_CREAT | os.O_WRONLY)
    child = os.fork()
    if child == 0:
        trial(out, log)
        os._exit(0)
    while not (out / "trial.mcap").exists():
        time.sleep(0.001)
    time.sleep(dice.uniform(0.0, 4.0))
    os.kill(child, signal.SIGKILL)
    killed = time.monotonic()
    os.waitpid(child, 0)
    (out / "killed").write_text(json.dumps(killed))
"""


def killed_trials(folder, kills, body):
    """Of each killed trial: records that were due a second before the kill, those begun, those kept, ending, attachments."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, str(folder), str(kills), body], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for k in range(kills):
        out = folder / str(k)
        killed = json.loads((out / "killed").read_text())
        notes = [line.split() for line in (out / "log").read_text().splitlines()]
        due = max((int(count) for count, at in notes if float(at) < killed - 1.0), default=0)
        recording = out / "trial.mcap"
        kept = len(list(read_recording(recording)))
        yield due, len(notes), kept, ending_of(recording).outcome, recorded_attachments(recording)


@pytest.mark.parametrize(
    ("body", "kills"),
    [
        pytest.param("mock", 5, marks=[pytest.mark.slow, pytest.mark.ci]),
        *(pytest.param(body, kills, marks=pytest.mark.slow) for body, kills in (("mock", 40), ("twin", 4))),
    ],
)
def test_a_killed_trial_keeps_all_but_the_last_second(tmp_path, body, kills):
    most = 0
    for due, begun, kept, outcome, attachments in killed_trials(tmp_path, kills, body):
        assert kept >= due
        # Stronger than asked: what is lost is what was being written.
        assert kept >= begun - 5
        assert outcome == "" and (kept == 0 or "robot.urdf" in attachments)
        most = max(most, kept)
    assert most > 20
