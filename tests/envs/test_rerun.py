import dataclasses
import json

import numpy as np
import pytest

from athlete_twin import assets
from athlete_twin.errors import RecordingError
from athlete_twin.link import LinkConfig, downlink, uplink
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from envs.events import by_clock, events
from envs.origin import changed_since, recorded_origin
from envs.prepare import Wanted, operator_named, prepared
from envs.recorder import Recorder
from envs.recording import link_sha256, read_recording, recorded_attachments, recorded_metadata
from envs.rerun import Ending, RecordedOperator, Rerun, compared, ending_of, first_difference, rerun
from envs.trial import Trial, TrialSetup
from planner.decisions import Decision
from planner.operators import SCRIPTED_OPERATORS

SHORT = 16.0
"""mission time of a trial that need not come to its end: the robot has begun to step [s]"""
SETUP = TrialSetup(
    robot="sdm_b", scenario="flat", variant="scripted", seed=0, operator="approve_all", up=uplink(1.0), down=downlink(1.0),
    goal=(0.05, 0.0), cycles=9, time_limit=SHORT,
)  # fmt: skip


def short(seed, operator, delay):
    way = LinkConfig(delay=delay, bandwidth=64e3, jitter=0.5, outages=((4.0, 7.0),))
    return dataclasses.replace(SETUP, seed=seed, operator=operator, up=way, down=way, time_limit=900.0)


@pytest.fixture
def run(tmp_path, scripted, flat):
    """Makes a trial of the mock with a ground that follows a script, in a folder of its own."""
    spec, count = load_spec("sdm_b"), iter(range(1000))

    def make(setup=SETUP, *, operator=None, steps=2, body=MockAthlete):
        out = tmp_path / str(next(count))
        out.mkdir()
        answers = operator or operator_named(setup.operator, setup.seed)
        return Trial(
            setup=setup, spec=spec, robot=body(spec), agent=scripted(steps=steps), operator=answers, grid=flat, out=out
        )

    return make


@pytest.mark.slow
def test_a_hundred_of_a_hundred_short_trials_come_again(run):
    for seed in range(100):
        setup = short(seed, SCRIPTED_OPERATORS[seed % len(SCRIPTED_OPERATORS)], 0.5 * (seed % 7))
        setup = dataclasses.replace(setup, time_limit=12.0 + seed % 5)
        first = run(setup)
        first.run()
        done = compared(first.out / "trial.mcap", run(setup))
        assert done.equal and done.ending.natural and done.messages > 10, (seed, done)


@pytest.mark.parametrize("name", SCRIPTED_OPERATORS)
@pytest.mark.slow
def test_each_operator_brings_a_trial_to_an_outcome_which_comes_again(run, name):
    setup = short(5, name, 1.0)
    trial = run(setup, steps=1)
    result = trial.run()
    assert result.outcome == "goal_reached" and result.steps_taken == 1
    assert compared(trial.out / "trial.mcap", run(setup, steps=1)).equal
    decided = [r.content for r in read_recording(trial.out / "trial.mcap") if r.topic == "/operator/decision"]
    assert result.decisions == len(decided) and result.rejections == sum(d["kind"] == "reject" for d in decided)
    assert result.operator_s >= sum(d["seconds"] for d in decided) - 1e-3
    assert result.link_s > 0.0 and result.uplinks >= 2 and result.e_stops == 0


class Nudged(MockAthlete):
    """Stands a nanometre elsewhere from 10 s on, as far as its truth says."""

    def truth(self):
        truth = super().truth()
        return dataclasses.replace(truth, com_in_world=truth.com_in_world + (1e-9 if self.t > 10.0 else 0.0))


@pytest.mark.slow
@pytest.mark.ci
def test_the_first_difference_is_told_with_topic_and_time(run):
    first = run()
    first.run()
    done = compared(first.out / "trial.mcap", run(body=Nudged))
    assert not done.equal and done.difference is not None
    assert done.difference.topic == "/truth/state" and 10.0 < done.difference.t < 12.0
    assert done.difference.text.startswith("com_in_world[0] was ")


@pytest.mark.slow
@pytest.mark.ci
def test_a_message_more_or_less_is_a_difference(run):
    first, longer = run(), run(dataclasses.replace(SETUP, time_limit=SHORT - 1.0))
    first.run()
    longer.run()
    less = first_difference(first.out / "trial.mcap", longer.out / "trial.mcap", whole=True)[1]
    more = first_difference(longer.out / "trial.mcap", first.out / "trial.mcap", whole=True)[1]
    assert less is not None and more is not None and min(less.t, more.t) > 10.0


class Person:
    """Rejects, edits, waits, approves: what no script does."""

    def __init__(self):
        self.answers = [
            Decision(kind="reject", reason="the rock"),
            Decision(kind="wait", duration=7.0),
            Decision(kind="edit_footfall", footfall_in_world=np.array([1 / 3, 0.1, 0.0])),
        ]

    def decide(self, _proposal, _t):
        return (self.answers.pop(0) if self.answers else Decision(kind="approve")), 3.3


@pytest.mark.slow
def test_a_persons_trial_comes_again_with_the_recorded_answers(run):
    setup = dataclasses.replace(SETUP, operator="human", time_limit=45.0)
    first = run(setup, operator=Person())
    assert first.run().decisions >= 4
    path = first.out / "trial.mcap"
    assert next(r.content["reason"] for r in read_recording(path) if r.topic == "/operator/decision") == "the rock"
    done = compared(path, run(setup, operator=RecordedOperator(path)))
    assert done.equal and done.ending.natural


@pytest.mark.slow
@pytest.mark.ci
def test_an_interrupted_trial_comes_again_as_far_as_it_went(run):
    first = run()
    first.progress = lambda state: setattr(first, "interrupted", state.mission.t > 10.0)
    assert first.run().outcome == "operator_abort"
    done = compared(first.out / "trial.mcap", run())
    assert done.equal and not done.ending.natural and done.messages > 10


def test_a_recording_that_holds_nothing_to_compare_is_not_equal():
    cut = Rerun(messages=0, ending=Ending(t=0.0, outcome="", reason=""), difference=None, then={}, now={})
    assert not cut.equal and dataclasses.replace(cut, messages=1).equal


@pytest.mark.parametrize("share", [0.35, 0.6])
@pytest.mark.slow
def test_a_cut_recording_comes_again_as_far_as_it_goes(run, tmp_path, share):
    first = run()
    first.run()
    raw = (first.out / "trial.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(raw[: int(share * len(raw))])
    assert ending_of(cut).outcome == ""
    done = compared(cut, run())
    assert done.equal and 0 < done.messages < len(list(read_recording(first.out / "trial.mcap")))


@pytest.mark.slow
@pytest.mark.ci
def test_a_rerun_writes_over_no_recording(run):
    first = run()
    first.run()
    with pytest.raises(RecordingError, match="would write over it"):
        compared(first.out / "trial.mcap", first)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A recording of this project's own ground on the mock, put together from names."""
    wanted = Wanted(
        robot="sdm_b", scenario="rock_field", variant="blind", seed=1, operator="slow", up=uplink(2.0), down=downlink(1.0),
        time_limit=12.0, body="mock",
    )  # fmt: skip
    out = tmp_path_factory.mktemp("whole")
    prepared(wanted, out).run()
    return out / "trial.mcap"


def test_a_recording_says_all_that_is_needed_to_run_it_again(whole, tmp_path):
    origin = recorded_origin(whole)
    assert origin.setup.down.delay == 1.0 and origin.body == "mock" and "[ground]" in origin.scenario_toml
    assert changed_since(origin, map_file=None) == ([], [])
    assert set(recorded_attachments(whole)) == {"robot.urdf"}
    done = rerun(whole, origin, tmp_path / "again")
    assert done.equal and done.then["trajectory_sha256"] == done.now["trajectory_sha256"]
    assert done.then["trajectory_sha256"] == json.loads((whole.parent / "trial.json").read_text())["trajectory_sha256"]
    assert done.then["link_sha256"] == link_sha256(whole)


def test_changed_drawings_libraries_and_code_are_named(whole, tmp_path, monkeypatch):
    import shutil

    root = tmp_path / "assets"
    shutil.copytree(assets.assets_root(), root)
    truth = root / "robots" / "sdm_b" / "truth.toml"
    truth.write_text(truth.read_text() + "# changed\n")
    (root / "robots" / "sdm_b" / "new.obj").write_text("")
    monkeypatch.setattr(assets, "_CHECKOUT", root)
    origin = recorded_origin(whole)
    versions = dict(origin.versions) | {"packages": dict(origin.versions["packages"]) | {"numpy": "1.0"}}
    firm, loose = changed_since(dataclasses.replace(origin, versions=versions, code="0"), map_file=None)
    assert "robots/sdm_b/truth.toml has changed" in firm and "robots/sdm_b/new.obj is new" in firm
    assert any(line.startswith("numpy was 1.0, is ") for line in firm) and loose == ["the code has changed"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda e: e.pop("format"), "does not say where it comes from"),
        (lambda e: e.update(format="99"), "has format '99'"),
        (lambda e: e.update(body="twin"), "do not match their sha256"),
    ],
)
def test_a_recording_of_another_kind_is_refused(whole, tmp_path, change, said):
    entries = recorded_metadata(whole, "trial")
    change(entries)
    path = tmp_path / "a.mcap"
    Recorder(path, metadata=entries).close()
    with pytest.raises(RecordingError, match=said):
        recorded_origin(path)


@pytest.mark.slow
@pytest.mark.ci
def test_on_the_operators_clock_stands_what_was_known_and_no_truth(run):
    trial = run()
    trial.run()
    every = events(trial.out / "trial.mcap")
    theirs, ours = by_clock(every, "robot"), by_clock(every, "operator")
    assert not any(e.topic.startswith("/truth/") for e in ours)
    assert not any(e.topic.startswith(("/operator/", "/ground/")) for e in theirs)
    for e in every:
        if e.topic.startswith("/downlink/"):
            assert e.at_operator >= e.at_robot + 1.0 - 1e-6
        if e.topic == "/uplink/command_sequence":
            assert e.at_robot >= e.at_operator + 1.0 - 1e-6
    assert [e.t("robot") for e in theirs] == sorted(e.t("robot") for e in theirs)
    assert by_clock(every, "operator", begin=5.0, end=6.0) == [e for e in ours if 5.0 <= e.at_operator <= 6.0]
