import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from athlete_twin import assets
from athlete_twin.errors import RecordingError
from athlete_twin.model.spec import load_spec
from envs.build import ground_agent
from envs.recorder import Recorder
from envs.replay import replay, same_proposal
from planner.decisions import Decision

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "rock_field_trial.py"


@pytest.mark.slow
@pytest.mark.ci
def test_a_scripted_ground_proposes_the_same_from_the_recording(tmp_path, scripted, make_mission):
    path = tmp_path / "trial.mcap"
    with Recorder(path) as recorder:
        m = make_mission(scripted(steps=2), delay=2.0, recorder=recorder)
        while not m.finished:
            m.advance(m.t + 10.0)
            if m.wants_answer:
                m.answer(Decision(kind="approve"))
    fresh = scripted(steps=2)
    fresh.next(0.0)
    replayed = list(replay(path, fresh))
    assert len(replayed) == 2 and all(same_proposal(r) and r.uplink is not None for r in replayed)


def test_a_ground_that_does_something_else_is_noticed(tmp_path, scripted, make_mission):
    path = tmp_path / "trial.mcap"
    with Recorder(path) as recorder:
        m = make_mission(scripted(), delay=2.0, recorder=recorder)
        while not m.wants_answer:
            m.advance(m.t + 10.0)
        m.answer(Decision(kind="approve"))
    with pytest.raises(RecordingError, match="planned again the ground says Uplink"):
        list(replay(path, scripted()))


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("variant", ["integrated", "blind"])
def test_planning_from_the_downlink_alone_gives_the_same_proposals_without_the_truth(tmp_path, monkeypatch, variant):
    arguments = ["--scenario", "rock_field", "--variant", variant, "--time-limit", "260", "--out", str(tmp_path)]
    subprocess.run([sys.executable, str(SCRIPT), *arguments], check=True, capture_output=True, timeout=400)
    bare = tmp_path / "assets"
    shutil.copytree(assets.assets_root(), bare, ignore=shutil.ignore_patterns("truth.toml"))
    monkeypatch.setattr(assets, "_CHECKOUT", bare)
    load_spec.cache_clear()
    agent = ground_agent(load_spec("sdm_b"), variant, goal=(3.0, 0.0), seed=0)
    replayed = list(replay(tmp_path / "trial.mcap", agent))
    assert len(replayed) >= 2
    assert all(same_proposal(r) for r in replayed)
