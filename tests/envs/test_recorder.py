import json
import os
import signal
import struct
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from foxglove import messages as foxglove_messages
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader

from athlete_twin.errors import RecordingError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import encode
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from envs.recorder import Recorder, cropped, joint_names
from envs.recording import read_recording, recorded_attachments, recorded_downlinks, recorded_metadata
from envs.schemas import (
    WELL_KNOWN,
    grid_from_message,
    grid_message,
    joint_angles,
    joint_states,
    nanoseconds,
    point_cloud,
    points_from_message,
    schema,
)
from planner.decisions import Decision


@pytest.fixture(scope="module")
def recorded(tmp_path_factory, scripted, make_mission):
    """A whole mission's recording and the agent that saw it; read, never written to."""
    agent = scripted()
    path = tmp_path_factory.mktemp("recorded") / "trial.mcap"
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
    whole = [r.data for r in read_recording(path)]
    for share in (0.3, 0.6, 0.95):
        part = tmp_path / "part.mcap"
        part.write_bytes(raw[: int(share * len(raw))])
        kept = [r.data for r in read_recording(part)]
        assert kept == whole[: len(kept)] and len(kept) > 0


def test_killed_writer_loses_nothing_it_was_given(tmp_path):
    """Even what it was given just before it worked for long on something else."""
    path = tmp_path / "killed.mcap"
    code = (
        "import sys, time, pathlib; from envs.recorder import Recorder\n"
        f"r = Recorder(pathlib.Path({str(path)!r}))\n"
        "for k in range(100000):\n    r.write('/truth/state', {'k': k, 'x': 'y' * 500}, 0.5 * k)\n"
        "    if k == 3000: print('go', flush=True); time.sleep(60.0)\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"go\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert [r.content["k"] for r in read_recording(path)] == list(range(3001))


def test_a_public_reader_reads_a_file_that_was_cut(recorded, tmp_path):
    path, _, _ = recorded
    part = tmp_path / "part.mcap"
    part.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])
    seen = []
    with part.open("rb") as file, pytest.raises((McapError, struct.error)):  # its own end of file
        for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            seen.append((channel.topic, message.data))
    assert seen == [(r.topic, r.data) for r in read_recording(part)]


@pytest.mark.parametrize("name", sorted(WELL_KNOWN))
def test_well_known_schemas_have_the_fields_that_foxglove_gives_them(name):
    """Against Foxglove's own library, whose message classes take each field as a keyword."""
    kind = getattr(foxglove_messages, name.removeprefix("foxglove."))
    fields = kind.__text_signature__.removeprefix("(*, ").removesuffix(")").split(", ")
    assert set(schema(name)["properties"]) == {field.split("=")[0] for field in fields}
    assert kind.get_schema().name == name


def test_foxglove_takes_the_joint_states_of_a_robot():
    names = joint_names(load_spec("t12"))
    assert len(names) == len(set(names)) == 46
    content = joint_states(1.25, names, np.linspace(-1.0, 1.0, 46))
    joints = [foxglove_messages.JointState(**joint) for joint in content["joints"]]
    stamp = foxglove_messages.Timestamp(**content["timestamp"])
    assert len(foxglove_messages.JointStates(timestamp=stamp, joints=joints).encode()) > 46 * 8
    assert joint_angles(content)["dock_right_twist"] == 1.0


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_recorded_joints_are_those_of_the_urdf(robot, tmp_path):
    """So that a viewer which is given the attached URDF moves it."""
    from xml.etree import ElementTree

    from athlete_twin.assets import robot_dir

    urdf = ElementTree.parse(robot_dir(robot) / "robot.urdf")
    moving = {j.get("name") for j in urdf.iter("joint") if j.get("type") == "revolute"}
    assert set(joint_names(load_spec(robot))) == moving
    body = MockAthlete(load_spec(robot))
    with Recorder(tmp_path / "a.mcap", spec=body.spec) as recorder:
        recorder.track(body.track[0])
    lines = {r.topic: r.content for r in read_recording(tmp_path / "a.mcap")}
    angles = joint_angles(lines["/truth/joints"])
    assert [angles[n] for n in joint_names(body.spec)[: body.truth().joints.size]] == body.truth().joints.ravel().tolist()


def test_points_survive_their_message():
    points = np.random.default_rng(0).normal(size=(7, 3)).astype(np.float32).astype(float)
    assert np.array_equal(points_from_message(point_cloud(2.0, "world", points)), points)


def test_files_and_results_are_kept_inside(tmp_path):
    path = tmp_path / "a.mcap"
    with Recorder(path, metadata={"seed": "3"}) as recorder:
        recorder.attach("robot.urdf", b"<robot/>", media_type="application/xml")
        recorder.write("/truth/state", {"x": float("nan"), "y": [np.float64(1.0), float("inf")]}, 0.0)
        recorder.result({"outcome": "goal_reached"})
    assert recorded_attachments(path) == {"robot.urdf": b"<robot/>"}
    assert recorded_metadata(path, "trial") == {"seed": "3"}
    assert recorded_metadata(path, "result") == {"outcome": "goal_reached"}
    # Viewers take no NaN.
    assert [r.data for r in read_recording(path)] == [b'{"x":null,"y":[1.0,null]}']


def test_whole_files_open_in_a_public_reader_and_every_message_fits_its_schema(recorded):
    jsonschema = pytest.importorskip("jsonschema")

    path, _, _ = recorded
    with path.open("rb") as file:
        for kind, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            jsonschema.validate(json.loads(message.data), json.loads(kind.data))
            assert channel.message_encoding == "json"


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


def test_mission_time_is_written_by_the_second_so_that_a_kill_takes_no_more(tmp_path):
    path = tmp_path / "a.mcap"
    with Recorder(path) as recorder:
        edges = np.arange(0.0, 3.3, 0.3)
        for begin, end in pairwise(edges):
            recorder.booked("link", float(begin), float(end))
        recorder.booked("motion", 3.0, 3.1)
    spans = [r.content for r in read_recording(path) if r.topic == "/truth/mission_time"]
    assert [s["begin"] for s in spans[1:]] == [s["end"] for s in spans[:-1]]
    assert max(s["end"] - s["begin"] for s in spans) <= 1.2 + 1e-9
    assert sum(s["end"] - s["begin"] for s in spans if s["bin"] == "link") == pytest.approx(3.0)
