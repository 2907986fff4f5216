import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest

from athlete_twin.errors import ConfigError, PhysicsError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.link import downlink, uplink
from athlete_twin.messages import Fault, Stop, decode
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from envs.recording import read_recording
from envs.scoring import Scorer, map_error, true_margins
from envs.trial import Trial, TrialSetup, trajectory_sha256, usable_folder, write_json
from planner.decisions import ApproveAll, Decision, NoStep, RejectSome
from planner.underway import SILENCE

KEYS = [
    *("schema_version", "robot", "payload_kg", "scenario", "variant", "seed", "link", "operator", "outcome", "reason"),
    *("progress_m", "goal_distance_m", "gait_cycles", "steps_taken", "mission_time_s", "motion_s", "link_s"),
    *(
        "operator_s",
        "ground_s",
        "wall_time_s",
        "uplinks",
        "command_cycles",
        "downlink_bytes",
        "decisions",
        "rejections",
    ),
    *("e_stops", "faults", "collisions", "min_support_margin_m", "min_cps_margin_m", "min_tip_over_energy_m"),
    *("peak_torque_fraction", "sag_error_m", "touchdown_error_m", "map_error_m", "localisation_error_m", "leg_mask"),
    *("stage_times_s", "trajectory_sha256", "suite_sha256", "provenance"),
]


def setup(**changes):
    values = {
        "robot": "sdm_b", "scenario": "flat", "variant": "scripted", "seed": 0, "operator": "approve_all",
        "up": uplink(2.0), "down": downlink(2.0), "goal": (0.05, 0.0), "cycles": 9, "time_limit": 500.0,
    }  # fmt: skip
    return TrialSetup(**(values | changes))


@pytest.fixture
def trial(tmp_path, scripted, flat):
    def make(agent=None, operator=None, robot=None, **changes):
        spec = load_spec("sdm_b")
        return Trial(
            setup=setup(**changes), spec=spec, robot=robot or MockAthlete(spec), agent=agent or scripted(steps=1),
            operator=operator or ApproveAll(), grid=flat, out=tmp_path,
        )  # fmt: skip

    return make


def content(tmp_path):
    return json.loads((tmp_path / "trial.json").read_text())


@pytest.mark.slow
@pytest.mark.ci
def test_result_has_exactly_the_promised_keys(trial, tmp_path):
    trial().run()
    written = content(tmp_path)
    assert list(written) == KEYS
    assert set(written["sag_error_m"]) == {"mean", "max"}
    assert set(written["map_error_m"]) == {"median", "rmse", "p95", "coverage"}
    assert set(written["leg_mask"]) == {"recall", "terrain_lost", "lost_near_wheels"}
    assert set(written["provenance"]) == {"version", "git_sha", "python", "platform", "cpu", "packages"}
    assert written["leg_mask"]["recall"] is None and written["suite_sha256"] is None
    assert written["collisions"] == 0 and written["faults"] == 0


@pytest.mark.slow
@pytest.mark.ci
def test_goal_is_reached_when_truth_and_ground_agree(trial):
    result = trial().run()
    assert result.outcome == "goal_reached" and result.steps_taken == 1
    assert result.goal_distance_m <= 0.30
    parts = result.motion_s + result.link_s + result.operator_s + result.ground_s
    assert result.mission_time_s == parts


@pytest.mark.slow
@pytest.mark.ci
def test_truth_overrules_a_ground_that_believes_to_have_arrived(trial):
    result = trial(goal=(3.0, 0.0)).run()
    assert result.outcome == "no_step" and "declared arrival 2.9" in result.reason


def test_wheels_that_carry_nothing_are_named():
    truth = MockAthlete(load_spec("t12")).truth()
    assert Scorer.unloaded(truth) == []
    loads = truth.wheel_loads * [1.0, 1.0, 0.0, 1.0, 1.0, 0.01]
    assert Scorer.unloaded(dataclasses.replace(truth, wheel_loads=loads)) == [3, 6]


@pytest.mark.slow
def test_same_trial_twice_has_the_same_trajectory(trial, scripted):
    assert trial().run().trajectory_sha256 == trial(agent=scripted()).run().trajectory_sha256


def test_trajectory_hash_notices_a_micrometre():
    robot = MockAthlete(load_spec("sdm_b"))
    point = robot.track[0]
    moved = dataclasses.replace(point, joints=point.joints + 1e-6)
    assert trajectory_sha256([point]) != trajectory_sha256([moved])
    assert trajectory_sha256([point]) == trajectory_sha256([dataclasses.replace(point, joints=point.joints + 1e-13)])


def test_time_limit_ends_the_trial(trial):
    result = trial(time_limit=15.0).run()
    assert result.outcome == "time_limit" and result.mission_time_s == pytest.approx(15.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.ci
def test_rejections_and_operator_time_are_counted(trial):
    result = trial(operator=RejectSome(rejected=frozenset({0, 1}), seconds=4.0)).run()
    assert (result.decisions, result.rejections) == (3, 2)
    assert result.operator_s == pytest.approx(12.0)


class Stopper:
    def decide(self, _proposal, _t):
        return Decision(kind="stop"), 2.0


def test_operators_stop_ends_the_trial_with_the_robot_stopped(trial):
    t = trial(operator=Stopper())
    result = t.run()
    assert result.outcome == "operator_abort" and result.e_stops == 1
    assert t.robot.executive.state == "stopped"


class HardOfHearing(MockAthlete):
    """The first so many stops do not come through."""

    def __init__(self, spec, missed):
        super().__init__(spec)
        self.missed = missed

    def receive_raw(self, raw):
        if isinstance(decode(raw), Stop) and self.missed > 0:
            self.missed -= 1
            return []
        return super().receive_raw(raw)


@pytest.mark.parametrize("missed", [1, 10**6])
def test_a_stopped_trial_ends_when_the_ground_knows_of_the_stop_or_after_two_silences(trial, missed):
    t = trial(operator=Stopper(), robot=HardOfHearing(load_spec("sdm_b"), missed))
    result = t.run()
    assert result.outcome == "operator_abort" and result.e_stops == 1
    assert (t.robot.executive.state == "stopped") == (missed == 1) == (not t.mission.stop_under_way)
    asked = next(r.t for r in read_recording(t.out / "trial.mcap") if r.topic == "/operator/decision")
    # Sent once more after a silence, heard a delay later, known a delay after that; what messages take on the link is little.
    assert result.mission_time_s - asked == pytest.approx(SILENCE + 4.0 if missed == 1 else 2 * SILENCE, abs=0.2)


class Interrupter:
    def decide(self, _proposal, _t):
        raise KeyboardInterrupt


def test_ctrl_c_leaves_a_result_and_a_readable_recording(trial, tmp_path):
    assert trial(operator=Interrupter()).run().outcome == "operator_abort"
    assert content(tmp_path)["outcome"] == "operator_abort"
    topics = {r.topic for r in read_recording(tmp_path / "trial.mcap")}
    assert {"/truth/state", "/truth/chassis", "/truth/terrain", "/operator/shown", "/downlink/telemetry"} <= topics


class Broken(MockAthlete):
    def advance(self, until):
        if self.t > 20.0:
            raise PhysicsError("a joint left its range")
        return super().advance(until)


@pytest.mark.slow
@pytest.mark.ci
def test_broken_simulation_is_a_fault_not_a_crash(trial):
    result = trial(robot=Broken(load_spec("sdm_b"))).run()
    assert result.outcome == "fault" and "left its range" in result.reason


class Tipping(MockAthlete):
    def truth(self):
        from athlete_twin.geometry.se3 import SE3

        truth = super().truth()
        tipped = SE3.from_rpy(0.6 if self.t > 20.0 else 0.0, 0.0, 0.0, truth.world_from_hex.translation)
        return dataclasses.replace(truth, world_from_hex=tipped)


@pytest.mark.slow
@pytest.mark.ci
def test_thirty_degrees_of_true_tilt_end_the_trial(trial):
    result = trial(robot=Tipping(load_spec("sdm_b"))).run()
    assert result.outcome == "tip_over" and "34 deg" in result.reason


def test_no_step_says_which_check_refused_how_many(trial, scripted):
    class Stuck(scripted):
        def next(self, t):
            return NoStep(reason="nothing allowed", refused={"steep": 7, "unknown": 2})

    result = trial(agent=Stuck()).run()
    assert (result.outcome, result.reason) == ("no_step", "nothing allowed (steep: 7, unknown: 2)")
    assert result.sag_error_m == {"mean": None, "max": None} and result.map_error_m["coverage"] is None


@pytest.mark.slow
@pytest.mark.ci
def test_giving_up_after_a_fault_is_a_fault(trial, scripted):
    class Faulty(MockAthlete):
        def advance(self, until):
            out = super().advance(until)
            if self.t > 20.0 and not self._counts.get("fault"):
                self.executive._running = None
                out.append(
                    Fault(
                        seq=self._next("fault"),
                        robot_id="sdm_b",
                        t=self.t,
                        code="torque_limit",
                        text="knee at 130 %",
                        sequence_id=1,
                        command_index=0,
                        leg=0,
                    )
                )
            return out

    result = trial(robot=Faulty(load_spec("sdm_b"))).run()
    assert result.outcome == "fault" and result.faults == 1 and "knee at 130 %" in result.reason


@pytest.mark.slow
@pytest.mark.ci
def test_scores_are_those_of_the_truth(trial):
    t = trial()
    result = t.run()
    assert result.min_support_margin_m is not None and 0.3 < result.min_support_margin_m < 2.0
    assert result.min_cps_margin_m < result.min_support_margin_m
    assert 0.0 < result.peak_torque_fraction < 1.0
    assert result.touchdown_error_m["max"] < 0.05
    assert result.sag_error_m["max"] < 0.05
    assert result.map_error_m == {"median": 0.0, "rmse": 0.0, "p95": 0.0, "coverage": 1.0}
    assert result.downlink_bytes > 10_000


def test_margins_of_fewer_than_three_wheels_are_zero():
    robot = MockAthlete(load_spec("sdm_b"))
    loads = np.array([3000.0, 0, 0, 5000.0, 0, 0])
    margins = true_margins(robot.spec, dataclasses.replace(robot.truth(), wheel_loads=loads))
    assert (margins.support, margins.cps, margins.energy) == (0.0, 0.0, 0.0)


def test_map_error_of_a_known_offset():
    true = HeightGrid(origin_x=-5.0, origin_y=-5.0, cell=0.1, heights=np.full((101, 101), 0.3))
    heights = np.full((101, 101), 0.02)
    heights[:, :50] = np.nan
    believed = HeightGrid(origin_x=-5.0, origin_y=-5.0, cell=0.1, heights=heights)
    error = map_error(believed, true, np.zeros((1, 2)), datum=0.3)
    assert [error[k] for k in ("median", "rmse", "p95")] == pytest.approx([0.02] * 3)
    assert error["coverage"] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"seed": -1}, "seed is -1"), ({"cycles": 0}, "cycles is 0"), ({"time_limit": 0.0}, "time limit is 0.0 s")],
)
def test_unusable_setups_are_refused(changes, said):
    with pytest.raises(ConfigError, match=said):
        setup(**changes)


def test_json_is_written_whole_and_knows_no_nan(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(Path(f"/proc/self/fd/{fd}").readlink().read_text()))
    write_json(tmp_path / "a.json", {"x": float("nan"), "y": np.float64(1.5), "z": (np.int64(2), float("inf"))})
    assert synced == [(tmp_path / "a.json").read_text()]  # on the disk before it has its name
    assert json.loads((tmp_path / "a.json").read_text()) == {"x": None, "y": 1.5, "z": [2, None]}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_output_folder_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        usable_folder(tmp_path / "file")
    assert usable_folder(tmp_path / "a" / "b").is_dir()


def test_a_trial_that_is_told_to_end_ends_within_a_second_and_writes_its_files(trial):
    """A signal's handler sets this: an exception of its own could come out of compiled code as another one."""
    made = trial()
    seen = []

    def after_three(state):
        seen.append(state.mission.t)
        made.interrupted = len(seen) >= 3

    made.progress = after_three
    result = made.run()
    assert result.outcome == "operator_abort" and result.reason == "interrupted at the console"
    assert len(seen) == 3 and (made.out / "trial.json").exists()
