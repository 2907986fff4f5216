import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from athlete_twin.errors import RecordingError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import encode
from envs.recorder import Recorder, cropped, read_recording, recorded_downlinks
from envs.schemas import grid_from_message, grid_message, nanoseconds
from planner.decisions import Decision


@pytest.fixture
def recorded(tmp_path, scripted, make_mission):
    """A whole mission's recording and the agent that saw it."""
    agent = scripted()
    path = tmp_path / "trial.mcap"
    with Recorder(path, metadata={"seed": "0"}) as recorder:
        m = make_mission(agent, delay=2.0, recorder=recorder)
        while not m.finished:
            m.advance(m.t + 10.0)
            if m.wants_answer:
                m.answer(Decision(kind="approve"), seconds=3.0)
    return path, agent, m


def test_recorded_downlinks_are_what_the_ground_saw(recorded):
    path, agent, _ = recorded
    replayed = recorded_downlinks(path)
    assert len(replayed) >= len(agent.seen) > 5
    for (t, message), (_, seen) in zip(replayed, agent.seen, strict=False):
        assert encode(message) == encode(seen)
        assert t >= seen.t + 2.0 - 1e-9


def test_replayed_downlinks_lead_to_the_same_decisions(recorded, scripted):
    path, agent, _ = recorded
    fresh, texts = scripted(), []
    for t, message in recorded_downlinks(path):
        fresh.next(t)
        fresh.observe(message, t)
        action = fresh.next(t)
        if hasattr(action, "sequence") and hasattr(action, "leg"):
            texts.append(encode(action.sequence))
            fresh.decide(Decision(kind="approve"), t)
    assert len(texts) == len(agent.decided)


def test_all_sides_have_their_topics_with_schemas(recorded):
    path, _, _ = recorded
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    kinds = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert {t.split("/")[1] for t in kinds} >= {"uplink", "downlink", "ground", "operator"}
    assert kinds["/downlink/stereo_pair/left"] == "foxglove.CompressedImage"
    assert kinds["/ground/chassis"] == "foxglove.FrameTransform"
    assert kinds["/ground/preview"] == "foxglove.PosesInFrame"
    assert kinds["/ground/terrain"] == "foxglove.Grid"
    assert {s.encoding for s in summary.schemas.values()} == {"jsonschema"}


def test_operator_topics_say_what_was_shown_and_when_it_was_decided(recorded):
    path, _, _ = recorded
    shown = [r for r in read_recording(path) if r.topic == "/operator/shown"]
    decided = [r for r in read_recording(path) if r.topic == "/operator/decision"]
    assert [r.content["text"] for r in shown] == ["leg 1 in place"]
    assert decided[0].t == pytest.approx(shown[0].t + 3.0) and decided[0].content["kind"] == "approve"


def test_uplinks_are_logged_when_they_leave(recorded):
    path, _, m = recorded
    up = [r for r in read_recording(path) if r.topic.startswith("/uplink/")]
    assert len(up) == m.counts.uplinks and up[0].t == 0.0
    assert all("crc32" in r.content and "robot_id" in r.content for r in up)


def test_recording_cut_anywhere_is_readable_up_to_there(recorded, tmp_path):
    path, _, _ = recorded
    raw = path.read_bytes()
    whole = [r.topic for r in read_recording(path)]
    for share in (0.3, 0.6, 0.95):
        part = tmp_path / "part.mcap"
        part.write_bytes(raw[: int(share * len(raw))])
        kept = [r.topic for r in read_recording(part)]
        assert kept == whole[: len(kept)]
    assert len(kept) > 0


def test_killed_writer_leaves_a_readable_file(tmp_path):
    path = tmp_path / "killed.mcap"
    code = (
        "import sys, time, pathlib; from envs.recorder import Recorder\n"
        f"r = Recorder(pathlib.Path({str(path)!r}))\n"
        "for k in range(100000):\n    r.write('/truth/state', {'k': k, 'x': 'y' * 500}, 0.5 * k)\n"
        "    if k == 5000: print('go', flush=True)\n    time.sleep(1e-5)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"go\n"
    time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    kept = [r.content["k"] for r in read_recording(path)]
    assert kept == list(range(len(kept))) and len(kept) > 4000


def test_grid_survives_its_message():
    heights = np.random.default_rng(0).normal(size=(7, 5)).astype(np.float32).astype(float)
    heights[2, 3] = np.nan
    ok = heights > 0.0
    grid = HeightGrid(origin_x=-1.0, origin_y=2.0, cell=0.25, heights=heights)
    back, flags = grid_from_message(grid_message(3.0, grid, {"footfall_ok": ok}))
    assert (back.origin_x, back.origin_y, back.cell) == pytest.approx((-1.0, 2.0, 0.25))
    assert np.array_equal(back.heights, heights, equal_nan=True)
    assert np.array_equal(flags["footfall_ok"], ok)


def test_cropped_map_keeps_heights_at_their_places(scripted):
    agent = scripted()
    agent.next(0.0)
    agent._waiting = ""
    proposal = agent.next(1.0)
    x, y = proposal.terrain.centres()
    proposal.terrain.heights[:] = x[:, None] + 2.0 * y[None, :]
    part, ok = cropped(proposal, 1.0)
    assert part.shape == ok.shape == (41, 41)
    assert part.sample(np.array([0.3, -0.4])) == pytest.approx(0.3 - 0.8)


def test_time_is_kept_in_nanoseconds():
    assert nanoseconds(1234.000000001) == 1_234_000_000_001


def test_unwritable_and_missing_recordings_are_refused(tmp_path):
    with pytest.raises(RecordingError, match="cannot be written"):
        Recorder(Path("/proc/nowhere/trial.mcap"))
    with pytest.raises(RecordingError, match="no such recording"):
        list(read_recording(tmp_path / "none.mcap"))
