"""Every trial of a comparison is a row, once, whatever happens to the runner, and rows that do not compare are refused.

Most of this runs with a crew that only pretends, so that thousands of interruptions take seconds; the slow tests at the end run the
mock in real processes and kill these and the runner for real.
"""

import contextlib
import fcntl
import io
import itertools
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from athlete_twin.assets import named_toml
from athlete_twin.errors import ConfigError, RecordingError
from athlete_twin.world.scenario import load_scenario
from envs.provenance import provenance
from envs.suite import suite_of
from envs.suite_trial import CHANGED, Asked, changed_from, code_now, reason_of, variant_sha256
from envs.trial import OUTCOMES, TrialResult

ROOT = Path(__file__).parents[2]
TIMINGS = ("wall_time_s", "stage_times_s", "provenance")
"""what may differ between two runs"""
SUITE = suite_of(robots=["sdm_b", "t12"], scenarios=["rock_field"], seeds=[0, 1], delays=[5.0], cycles=1)
MOCK = ["--scenarios", "rock_field", "--body", "mock", "--no-films"]

EXAMPLE = (ROOT / "docs/outside_planner.md").read_text().partition("```python\n")[2].partition("```")[0]
"""a planner from outside"""


def asked(*, variants=("blind", "sway"), suite=SUITE, code="c0", variant_sha256="v0"):
    return [
        Asked(
            case=c,
            variant=v,
            body="mock",
            suite_sha256=suite.sha256,
            code_sha256=code,
            variant_sha256=variant_sha256,
            scenario_sha256=suite.scenarios["rock_field"],
        )
        for c in suite.cases
        for v in variants
    ]


class Killed(BaseException):
    """The runner is no more."""


class PretendedCrew:
    """Runs nothing: a trial ends in time with figures made of its name, or leaves what a killed one leaves."""

    def __init__(self, size=2, *, life=10**9, order=0, fails=(), changed=(), git_sha="g"):
        self.size, self.life, self.fails, self.changed, self.git_sha = size, life, fails, changed, git_sha
        self.ran, self.running, self.stopped = [], [], False
        self.dice = random.Random(order)

    def start(self, asked, folder, *, lock):
        self._age()
        assert list(folder.iterdir()) == [] and os.fstat(lock)
        (folder / "asked.json").write_text(asked.text())
        (folder / "trial.mcap").write_bytes(b"half")
        self.running.append((asked, folder))
        self.ran.append(asked.key)

    def ended(self):
        self._age()
        asked, folder = self.running.pop(self.dice.randrange(len(self.running)))
        if asked.key in self.fails:
            (folder / "log.txt").write_text("Traceback ...\n  in a file\nathlete_twin.errors.PlanningError: no way out\n")
            return [(asked, 1)]
        if asked.key in self.changed:
            (folder / "log.txt").write_text("variant sway\n")
            return [(asked, CHANGED)]
        (folder / "trial.json").write_text(json.dumps(pretended(asked, git_sha=self.git_sha)))
        self._age()
        return [(asked, 0)]

    def stop(self):
        self.stopped = True

    def _age(self):
        self.life -= 1
        if self.life < 0:
            raise Killed


class Nobody:
    def __init__(self):
        self.told = []

    def begins(self, asked, rows, *, workers):
        self.told.append(("begins", len(asked), len(rows), workers))

    def started(self, asked):
        self.told.append(("started", asked.key))

    def row(self, asked, row):
        self.told.append(("row", asked.key))

    def waits(self):
        self.told.append(("waits",))


def pretended(one, *, git_sha="g"):
    figures = dict.fromkeys((f.name for f in fields(TrialResult)), 0.0)
    known = {"robot": one.case.robot, "scenario": one.case.scenario, "variant": one.variant, "seed": one.case.seed}
    return figures | known | {"outcome": "cycles_done", "reason": one.folder, "provenance": {"version": "0", "git_sha": git_sha}}


@pytest.fixture(scope="module", autouse=True)
def runs(script):
    script("trial_crews"), script("run_progress")  # which the script imports when it needs them
    return script("variant_runs")


@pytest.fixture(scope="module")
def undisturbed(runs, tmp_path_factory):
    """Folder and rows of a run that nothing happened to."""
    out = tmp_path_factory.mktemp("undisturbed")
    return out, runs.run_all(asked(), out, crew=PretendedCrew(), onlooker=Nobody())


def rows_in(out):
    return [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]


def test_every_trial_is_a_row_with_every_key_in_the_order_asked_for(runs, tmp_path):
    crew, onlooker = PretendedCrew(order=3), Nobody()
    rows = runs.run_all(asked(), tmp_path, crew=crew, onlooker=onlooker)
    assert rows_in(tmp_path) == sorted(rows, key=lambda r: r["variant"] == "sway") and crew.stopped
    assert [(r["case"], r["variant"]) for r in rows] == [a.key for a in asked()]
    keys = {f.name for f in fields(TrialResult)} | {"case", "delay_s", "folder", "cycles", "time_limit_s", "capped"}
    assert all(set(r) == keys for r in rows)
    assert all(r["suite_sha256"] == SUITE.sha256 and r["delay_s"] == 5.0 for r in rows)
    assert all((r["cycles"], r["time_limit_s"], r["capped"]) == (1, load_scenario("rock_field").time_limit, True) for r in rows)
    assert all(json.loads((tmp_path / r["folder"] / "trial.json").read_text())["reason"] in r["folder"] for r in rows)
    assert onlooker.told[0] == ("begins", 8, 0, 2) and sum(t[0] == "row" for t in onlooker.told) == 8


def test_variants_on_one_case_run_before_the_next_case(runs, tmp_path):
    crew = PretendedCrew(size=1)
    runs.run_all(runs.asked_for(SUITE, SUITE.cases, ["blind", "sway"], body="mock"), tmp_path, crew=crew, onlooker=Nobody())
    cases = [case for case, _ in crew.ran]
    assert cases == [c.id for c in SUITE.cases for _ in range(2)]


@settings(max_examples=25)
@given(seconds=st.integers(0, 9), order=st.integers(0, 9), life=st.integers(0, 20), again=st.integers(0, 3))
def test_when_time_is_up_cases_that_were_begun_are_whole_and_the_same_command_goes_on(
    runs, undisturbed, tmp_path_factory, seconds, order, life, again
):
    """A clock that ticks whenever it is read: no other case begins, no variant of one that did is missing; killed before or not."""
    out = tmp_path_factory.mktemp("timed")
    whole_out, expected = undisturbed
    with contextlib.suppress(Killed):
        runs.run_all(asked(), out, crew=PretendedCrew(order=order, life=life), onlooker=Nobody(), seconds=seconds, clock=ticking())
    rows = runs.run_all(asked(), out, crew=PretendedCrew(order=order), onlooker=Nobody(), seconds=again, clock=ticking())
    assert rows and rows == [r for r in expected if r["case"] in {row["case"] for row in rows}]
    assert (out / "asked.txt").read_text().splitlines() == [f"{a.case.id} {a.variant}" for a in asked()]
    before = {(r["case"], r["variant"]) for r in rows_in(out)}
    crew = PretendedCrew(order=order)
    assert runs.run_all(asked(), out, crew=crew, onlooker=Nobody()) == expected
    assert len(crew.ran) == len(expected) - len(before)
    assert (out / "results.jsonl").read_bytes() == (whole_out / "results.jsonl").read_bytes()


def ticking():
    ticks = itertools.count()
    return lambda: next(ticks)


def test_a_variant_that_joins_in_little_time_walks_few_of_the_cases_that_others_walked(runs, tmp_path):
    runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    crew = PretendedCrew(size=1)
    rows = runs.run_all(
        asked(variants=["blind", "sway", "late"]), tmp_path, crew=crew, onlooker=Nobody(), seconds=0, clock=ticking()
    )  # fmt: skip
    assert [key[1] for key in crew.ran] == ["late"] and len(rows) == 9


def test_what_was_asked_for_before_there_was_a_row_is_not_missed(runs, tmp_path):
    with pytest.raises(Killed):
        runs.run_all(asked(variants=["wrong"]), tmp_path, crew=PretendedCrew(life=0), onlooker=Nobody())
    assert (tmp_path / "asked.txt").read_text().count("wrong") == 4
    runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    assert "wrong" not in (tmp_path / "asked.txt").read_text() + (tmp_path / "variants.txt").read_text()


def test_an_error_that_is_not_run_again_for_want_of_time_stays_a_row(runs, tmp_path):
    keys = [a.key for a in asked()]
    runs.run_all(asked(), tmp_path, crew=PretendedCrew(fails=keys), onlooker=Nobody())
    crew = PretendedCrew()
    rows = runs.run_all(asked(), tmp_path, crew=crew, onlooker=Nobody(), retry_errors=True, seconds=0, clock=ticking())
    assert len(rows) == len(rows_in(tmp_path)) == len(keys)
    assert {r["outcome"] == "error" for r in rows if (r["case"], r["variant"]) in crew.ran} == {False}
    assert sum(r["outcome"] == "error" for r in rows) == len(keys) - len(crew.ran) > 0


@settings(max_examples=25)
@given(lives=st.lists(st.integers(0, 30), max_size=4), torn=st.integers(0, 400), order=st.integers(0, 9))
def test_killed_anywhere_no_trial_is_lost_and_no_row_repeated(runs, undisturbed, tmp_path_factory, lives, torn, order):
    out = tmp_path_factory.mktemp("killed")
    whole_out, expected = undisturbed
    for life in lives:
        try:
            runs.run_all(asked(), out, crew=PretendedCrew(life=life, order=order), onlooker=Nobody())
        except Killed:
            # The row that was being written when it happened, the first of all among others.
            with (out / "results.jsonl").open("ab") as file:
                file.write((whole_out / "results.jsonl").read_bytes().split(b"\n")[0][:torn])
    before = {(r["case"], r["variant"]) for r in map(json.loads, whole_lines(out))}
    crew = PretendedCrew(order=order)
    assert runs.run_all(asked(), out, crew=crew, onlooker=Nobody()) == expected
    assert (out / "results.jsonl").read_bytes() == (whole_out / "results.jsonl").read_bytes()
    assert len(crew.ran) == len(set(crew.ran)) and not before & set(crew.ran)


def whole_lines(out):
    raw = (out / "results.jsonl").read_bytes() if (out / "results.jsonl").exists() else b""
    return raw[: raw.rfind(b"\n") + 1].splitlines()


def test_a_trial_that_was_complete_but_had_no_row_gets_it_without_running_again(runs, tmp_path):
    runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    lines = (tmp_path / "results.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "results.jsonl").write_bytes(b"".join(lines[:5]) + lines[5][:40])
    crew = PretendedCrew()
    runs.run_all(asked(), tmp_path, crew=crew, onlooker=Nobody())
    assert crew.ran == [] and (tmp_path / "results.jsonl").read_bytes() == b"".join(lines)


@pytest.mark.parametrize("torn", [b"", b'{"schema_version": 1, "rob', b"\0" * 4096, b"\xff\xfe"])
@pytest.mark.parametrize("name", ["trial.json", "asked.json"])
def test_a_trial_whose_result_a_power_cut_tore_is_run_again(runs, undisturbed, tmp_path, name, torn):
    whole, rows = undisturbed
    runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    lines = (tmp_path / "results.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "results.jsonl").write_bytes(b"".join(lines[1:]))
    (tmp_path / rows[0]["folder"] / name).write_bytes(torn)
    crew = PretendedCrew()
    assert runs.run_all(asked(), tmp_path, crew=crew, onlooker=Nobody()) == rows and crew.ran == [asked()[0].key]
    assert (tmp_path / "results.jsonl").read_bytes() == (whole / "results.jsonl").read_bytes()


@pytest.mark.parametrize("change", [{"code": "c1"}, {"variant_sha256": "v1"}, {"suite": replace(SUITE, scenarios={"rock_field": "1"})}])
def test_a_complete_trial_of_something_else_is_run_again(runs, tmp_path, change):
    runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    (tmp_path / "results.jsonl").unlink()
    crew = PretendedCrew()
    runs.run_all(asked(**change), tmp_path, crew=crew, onlooker=Nobody())
    assert sorted(crew.ran) == sorted(a.key for a in asked())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"suite": replace(SUITE, scenarios={"rock_field": "1"})}, "8 of its trials are of another suite .*; name another --out, or"),
        ({"code": "c1"}, r"8 of its trials were run by another version .* \(version 0, commit g\); name another --out, or delete"),
        ({"variant_sha256": "v1"}, "variant blind has changed since its trials were run; name another --out, or delete"),
    ],
)
def test_rows_that_do_not_compare_are_refused_and_left_alone(runs, tmp_path, change, message):
    runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    before = (tmp_path / "results.jsonl").read_bytes()
    crew = PretendedCrew()
    with pytest.raises(ConfigError, match=message):
        runs.run_all(asked(**change), tmp_path, crew=crew, onlooker=Nobody())
    assert crew.ran == [] and (tmp_path / "results.jsonl").read_bytes() == before
    with pytest.raises(ConfigError, match="run with another body than 'twin'"):
        runs.run_all([replace(a, body="twin") for a in asked()], tmp_path, crew=crew, onlooker=Nobody())


def test_more_variants_and_robots_join_the_same_folder(runs, tmp_path):
    runs.run_all(asked(variants=["blind"])[:2], tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    crew = PretendedCrew()
    rows = runs.run_all(asked(), tmp_path, crew=crew, onlooker=Nobody())
    assert len(rows) == 8 and len(crew.ran) == 6 and len(rows_in(tmp_path)) == 8


def first_seen(out):
    return list(dict.fromkeys(r["variant"] for r in rows_in(out)))


def test_a_variant_that_joins_later_does_not_become_the_first(runs, tmp_path):
    sdm_b, t12 = ([a for a in asked(variants="cba") if a.case.robot == robot] for robot in ("sdm_b", "t12"))
    with pytest.raises(Killed):  # after the first row, which is not of the first variant
        runs.run_all([a for a in sdm_b if a.variant in "ac"], tmp_path, crew=PretendedCrew(life=4), onlooker=Nobody())
    assert first_seen(tmp_path) == ["a"]
    for one, order in (("a", ["c", "a"]), ("b", ["c", "a", "b"])):
        runs.run_all([a for a in sdm_b if a.variant in ("c", one)], tmp_path, crew=PretendedCrew(), onlooker=Nobody())
        assert first_seen(tmp_path) == order
    runs.run_all([a for a in t12 if a.variant == "b"], tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    runs.run_all([a for a in sdm_b if a.variant in "ba"], tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    assert first_seen(tmp_path) == ["c", "a", "b"] and len(rows_in(tmp_path)) == 8


def test_the_report_is_told_of_the_baseline_and_metrics_that_were_asked_for(script, runs, tmp_path, monkeypatch):
    script("comparison_films")
    main, told = script("benchmark_variants"), []
    report = SimpleNamespace(write_report=lambda folder, **options: told.append(options), __spec__=SimpleNamespace())
    monkeypatch.setitem(sys.modules, "variant_report", report)
    for more in ({}, {"baseline": "sway", "metrics": ("success",)}):
        main._after(main.Options(variants=("blind",), out=tmp_path, films=False, **more), [], wanted=0)
    assert told == [{"metrics": None, "baseline": None}, {"metrics": ("success",), "baseline": "sway"}]
    runs.run_all(asked(variants=["sway"]), tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    main.check_baseline("sway", ["blind"], tmp_path)

def test_what_cannot_be_run_is_a_row_with_its_reason_and_run_again_when_asked(runs, tmp_path):
    bad = asked()[3].key
    rows = runs.run_all(asked(), tmp_path, crew=PretendedCrew(fails=[bad]), onlooker=Nobody())
    row = rows[3]
    assert (row["outcome"], row["reason"]) == ("error", "PlanningError: no way out")
    assert set(row) == set(rows[0]) and row["outcome"] not in OUTCOMES
    named = {"robot": "t12", "scenario": "rock_field", "variant": "sway", "seed": 0, "case": bad[0], "delay_s": 5.0}
    assert named.items() <= row.items() and row["suite_sha256"] == SUITE.sha256 and row["folder"].endswith("sway")
    assert row["progress_m"] is row["collisions"] is row["mission_time_s"] is row["sag_error_m"]["mean"] is None
    assert row["provenance"]["version"]
    again = PretendedCrew()
    assert runs.run_all(asked(), tmp_path, crew=again, onlooker=Nobody()) == rows and again.ran == []
    healed = runs.run_all(asked(), tmp_path, crew=again, onlooker=Nobody(), retry_errors=True)
    assert again.ran == [bad] and healed[3]["outcome"] == "cycles_done" and len(rows_in(tmp_path)) == 8


def test_what_changes_under_a_run_stops_it_without_a_row_and_restored_it_goes_on(runs, undisturbed, tmp_path, monkeypatch):
    whole, rows = undisturbed
    crew = PretendedCrew(size=1, changed=[asked()[3].key])
    message = "stopped before t12-rock_field-0-5 sway, which has no row: .* variant sway changed under the run; restore that, or name"
    with pytest.raises(ConfigError, match=message):
        runs.run_all(asked(), tmp_path, crew=crew, onlooker=Nobody())
    assert len(rows_in(tmp_path)) == 3 and crew.stopped
    # A trial that breaks off at a file of ours that is being edited says nothing of that itself.
    edited = PretendedCrew(size=1, fails=[asked()[4].key])
    with monkeypatch.context() as during, pytest.raises(ConfigError, match="the code, the drawings or the libraries changed under the"):
        during.setattr(runs, "code_now", lambda: "edited")
        runs.run_all(asked(), tmp_path, crew=edited, onlooker=Nobody())
    assert len(rows_in(tmp_path)) == 4
    assert runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody()) == rows
    assert (tmp_path / "results.jsonl").read_bytes() == (whole / "results.jsonl").read_bytes()


def test_a_commit_that_changes_no_source_does_not_end_a_comparison(runs, undisturbed, tmp_path, monkeypatch):
    runs.run_all(asked()[:3], tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    rows = runs.run_all(asked(), tmp_path, crew=PretendedCrew(git_sha="later"), onlooker=Nobody())
    assert rows == undisturbed[1] and {r["provenance"]["git_sha"] for r in rows} == {"g"}
    before, now = code_now(), provenance()
    monkeypatch.setattr("envs.suite_trial.provenance", lambda: now | {"git_sha": "later"})
    assert code_now() == before
    monkeypatch.setattr("envs.suite_trial.provenance", lambda: now | {"packages": {}})
    assert code_now() != before


def test_a_trial_tells_what_is_not_as_it_was_asked_for(runs, tmp_path):
    scenario, variant = tmp_path / "field.toml", tmp_path / "mine.toml"
    scenario.write_text(named_toml("scenarios", "rock_field").read_text())
    variant.write_text('base = "integrated"\n')
    suite = suite_of(robots=["t12"], scenarios=[str(scenario)], seeds=[0], delays=[5.0])
    (one,) = runs.asked_for(suite, suite.cases, [str(variant)], body="mock")
    assert changed_from(one) == ""
    assert changed_from(replace(one, code_sha256="other")) == "the code, the drawings or the libraries"
    for path, what in ((scenario, "scenario"), (variant, "variant")):
        text = path.read_text()
        path.write_text(f"{text}\nlevel_deck_deg = 0.1\n" if path == variant else text.replace("cycles = 30", "cycles = 29"))
        assert changed_from(one) == f"{what} {path}"
        path.write_text(f"{text}\nhalf a li")
        assert changed_from(one).startswith("a file that can no longer be used (") and path.name in changed_from(one)
        path.write_text(text)
    assert changed_from(one) == "" and variant_sha256("integrated") == variant_sha256(str(variant))


def test_unwanted_files_go_once_the_row_is_there(runs, tmp_path):
    rows = runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody(), unwanted=["trial.mcap"])
    assert not any((tmp_path / r["folder"] / "trial.mcap").exists() for r in rows)


def test_a_folder_that_another_run_writes_is_refused(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "PATIENCE", 0.2)
    with (tmp_path / ".lock").open("w") as held:
        held.write("4711\n")
        held.flush()
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(ConfigError, match=r"is being written by another run \(process 4711\); wait for it, end it, or name another"):
            runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())


def test_a_damaged_line_in_the_middle_is_refused(runs, tmp_path):
    runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    (tmp_path / "results.jsonl").write_text("\n".join([lines[0], "{oops", *lines[2:]]) + "\n")
    with pytest.raises(ConfigError, match="line 2 is no row of a comparison; delete that line"):
        runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())


def full_after(writes):
    yield from [None] * writes
    raise OSError(28, "No space left on device")


def test_a_full_disk_is_one_line(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda _fd: next(room))
    for writes, name in ((0, "variants.txt.part"), (1, "asked.txt.part"), (2, "results.jsonl")):
        room = full_after(writes)
        with pytest.raises(RecordingError, match=rf"{name} cannot be written: No space left on device; make room"):
            runs.run_all(asked(), tmp_path, crew=PretendedCrew(), onlooker=Nobody())


def test_folders_are_named_for_the_trial_and_never_shared():
    names = ["integrated", "/a/mine.toml", "/b/mine.toml", "mine.toml", "my_planner:make", "my_planner_make", "a/b:c"]
    one = asked()[0]
    folders = [replace(one, variant=name).folder for name in names]
    assert folders[0] == "sdm_b-rock_field-0-5-integrated" and folders[1].startswith("sdm_b-rock_field-0-5-mine_")
    assert len(set(folders)) == len(names) and not any(set("/: ") & set(name) for name in folders)


@pytest.mark.parametrize(
    ("status", "log", "reason"),
    [
        (-9, "", "its process was ended by SIGKILL; memory may have run out"),
        (-11, "Fatal Python error", "its process was ended by SIGSEGV"),
        (1, "", "its process ended with status 1 and said nothing"),
        (1, "x\nValueError: a\t b \n\n", "ValueError: a b"),
        (1, "athlete_twin.errors.ConfigError: athlete_twin.errors is no name", "ConfigError: athlete_twin.errors is no name"),
        (1, "MemoryError", "MemoryError"),
    ],
)
def test_why_a_process_left_no_result_is_one_line(tmp_path, status, log, reason):
    (tmp_path / "log.txt").write_text(log)
    assert reason_of(status, tmp_path / "log.txt") == reason


def test_time_left_is_what_the_like_took_shared_among_workers(script):
    progress = script("run_progress")
    sdm_b, t12 = asked(variants=["blind"])[:2]
    left = progress.TimeLeft(workers=2)
    guessed = left.left([sdm_b, t12], [])
    assert guessed == pytest.approx(max(progress.guess(t12), 0.5 * (progress.guess(sdm_b) + progress.guess(t12))))
    left.took(sdm_b, 40.0)
    left.took(sdm_b, 60.0)
    left.took(t12, 200.0)
    assert left.left([sdm_b] * 4, []) == pytest.approx(100.0)
    # Another variant of the robot is taken for alike until one of it was measured; a trial that runs counts for its rest.
    assert left.of_trial(replace(t12, variant="sway")) == 200.0
    assert left.left([], [(t12, 150.0), (sdm_b, 80.0)]) == pytest.approx(50.0)
    assert left.left([], []) == 0.0
    assert [progress.duration(s) for s in (5.0, 600.0, 12000.0)] == ["5 s", "10 min", "3 h 20 min"]


def shown(script, runs, out, *, terminal, seconds_a_trial):
    """What a run's bar writes when a trial ends every so many seconds."""

    class TimedCrew(PretendedCrew):
        now = 0.0

        def ended(self):
            self.now += seconds_a_trial
            return super().ended()

    screen, crew = io.StringIO(), TimedCrew(size=1, fails=[asked()[0].key])
    with script("run_progress").Bar(Console(file=screen, force_terminal=terminal, width=150), clock=lambda: crew.now) as bar:
        runs.run_all(asked(), out, crew=crew, onlooker=bar)
    return screen.getvalue()


def test_a_terminal_shows_trials_errors_and_time(script, runs, tmp_path):
    told = shown(script, runs, tmp_path, terminal=True, seconds_a_trial=1.0)
    assert "8/8" in told and "1 errors" in told and "left" in told and "trials done" not in told


@pytest.mark.parametrize(("seconds", "done"), [(5.0, []), (25.0, [3, 6]), (300.0, [1, 2, 3, 4, 5, 6, 7, 8])])
def test_off_a_terminal_a_plain_line_follows_a_trial_once_a_minute_at_most(script, runs, tmp_path, seconds, done):
    lines = shown(script, runs, tmp_path, terminal=False, seconds_a_trial=seconds).splitlines()
    assert [re.sub(r"about .* left", "", line) for line in lines] == [f"{n} of 8 trials done, 1 errors, " for n in done]
    assert all(re.search(r"about \d+ (s|min) left$", line) for line in lines)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--variants nope --suite small", "variant 'nope' is not known"),
        ("--variants blind blind --suite small", "variant blind is there twice; name each once"),
        ("--variants blind --suite tiny", "suite 'tiny' is not known; known: full, small"),
        ("--variants blind --suite small --robots t13", "suite small has no cases for robot 't13'; did you mean 't12'?"),
        ("--variants blind --suite small --seeds 0:2 --delays 1", "suite small says itself what --seeds, --delays would"),
        ("--variants blind", "nothing to run on: name --suite small or --suite full, or --scenarios and --seeds"),
        ("--variants blind --scenarios rock_field", "nothing to run on"),
        ("--variants blind --scenarios nope --seeds 0", "scenario 'nope' is not known"),
        ("--variants blind --scenarios rock_field --seeds 5:2", "seeds '5:2'"),
        ("--variants blind --scenarios rock_field --seeds 0 --delays -1", "link delay is -1.0 s, must be 0 or more"),
        ("--variants blind --suite small --hours 0", "hours is 0, must be positive and finite; leave it out to run every case"),
        ("--variants blind --suite small --hours nan", "hours is nan, must be positive"),
        ("--variants blind --suite small --workers 0", "workers is 0, must be 1 to"),
        ("--variants blind --suite small --workers 9999", "--ray takes it to others"),
        ("--variants blind --suite small --workers 0 --ray local", "workers is 0, must be 1 or more"),
        ("--variants blind --suite small --metrics speeed", "metric"),
        ("--variants blind sway --suite small --baseline swaay", "baseline 'swaay' is not among the variants: blind, sway"),
    ],
)
def test_bad_usage_is_one_line_and_touches_nothing(script, capsys, tmp_path, options, message):
    out = tmp_path / "out"
    assert script("benchmark_variants").main([*options.split(), "--out", str(out)]) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1 and told.startswith("benchmark_variants: ")
    assert not out.exists()


@pytest.mark.parametrize(
    ("variant", "why"),
    [
        ("driving", "a planner that drives takes no steps meanwhile"),
        ("capless:Driver", "a planner from outside need propose no steps"),
    ],
)
def test_what_a_limit_of_cycles_does_not_stop_is_refused_where_there_is_one(script, capsys, tmp_path, monkeypatch, variant, why):
    (tmp_path / "capless.py").write_text(EXAMPLE)
    monkeypatch.syspath_prepend(tmp_path)
    out = ["--out", str(tmp_path / "out"), "--dry-run", "--variants", "blind", variant]
    main = script("benchmark_variants").main
    free = ["--scenarios", "rock_field", "--seeds", "0"]
    for options in (["--suite", "small"], [*free, "--cycles", "29"]):
        assert main([*out, *options]) == 2
        told = capsys.readouterr().err
        assert f"variant {variant} cannot be compared where trials end after" in told and told.count("\n") == 1
        assert f"{why}; take --suite full, or --scenarios and --seeds without --cycles" in told
    for options in (free, [*free, "--cycles", "30"]):
        assert main([*out, *options]) == 0


def test_a_cluster_that_nobody_runs_is_one_line_at_once(script, capsys, tmp_path):
    pytest.importorskip("ray", reason="Ray is not installed")
    began = time.monotonic()
    args = ["--variants", "blind", "--suite", "small", "--out", str(tmp_path), "--ray", "127.0.0.1:1"]
    assert script("benchmark_variants").main(args) == 2
    assert "no Ray cluster at '127.0.0.1:1'" in capsys.readouterr().err and time.monotonic() - began < 20.0


def test_ray_is_named_where_it_is_missing(script, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"--ray needs Ray: pip install 'athlete-twin\[cluster\]', or leave --ray out"):
        script("trial_crews").RayCrew("local", 1)


def test_a_dry_run_lists_cases_and_touches_nothing(script, capsys, tmp_path):
    args = ["--variants", "blind", "sway", "integrated", "--suite", "small", "--out", str(tmp_path / "out"), "--dry-run"]
    assert script("benchmark_variants").main(args) == 0
    told = capsys.readouterr().out
    assert "8 cases x 3 variants (blind, sway, integrated) = 24 trials" in told and "t12-suite_k015-75-5" in told
    assert script("benchmark_variants").main([*args, "--hours", "0.05", "--workers", "1"]) == 0
    assert re.search(r"in 0.05 h roughly the first (3|6) of them", capsys.readouterr().out)
    assert not (tmp_path / "out").exists()


def test_a_disk_that_recordings_would_fill_is_refused(script, runs, tmp_path, monkeypatch):
    from shutil import disk_usage

    main, twins = script("benchmark_variants"), [replace(a, body="twin") for a in asked()]
    script("benchmark_variants").check_room(asked(), tmp_path / "not" / "there" / "yet")
    monkeypatch.setattr("shutil.disk_usage", lambda path: disk_usage(path)._replace(free=10**7))
    with pytest.raises(ConfigError, match=r"roughly 0 GB, and .* has 0 GB left; another --out, or without recordings by --keep none"):
        main.check_room(twins, tmp_path)


def compare(out, *options, variants=("blind",), seeds="0:2", limit="60", robots=("sdm_b",), cwd=ROOT):
    """The runner as a process."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "scripts/benchmark_variants.py"), "--variants", *variants, "--robots", *robots, "--seeds", seeds,
         "--time-limit", limit, *MOCK, "--out", str(out), *options],
        cwd=cwd, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def complaints(run):
    """What a run that ends says beside how far it is."""
    told = run.communicate()[1].splitlines()
    return [line for line in told if " trials done, " not in line]


def comparable(out):
    return [{k: v for k, v in row.items() if k not in TIMINGS} for row in rows_in(out)]


def trials_alive(out):
    found = subprocess.run(["pgrep", "-f", f"envs.suite_trial {out}"], capture_output=True, text=True)
    return found.stdout.split()


def awaited(condition, seconds=180.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.ci
def test_killed_for_real_nobody_writes_on_and_the_rest_is_run_once(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    done = compare(whole, "--workers", "1", variants=("blind", "sway"))
    assert complaints(done) == [] and done.returncode == 0
    dice = random.Random(5)
    for kill in range(4):
        run = compare(killed, variants=("blind", "sway"))
        awaited(lambda run=run: run.poll() is not None or trials_alive(killed))
        time.sleep(dice.uniform(0.0, 4.0))
        run.kill()
        run.wait()
        awaited(lambda: not trials_alive(killed), seconds=5.0)
        if kill == 1 and (killed / "results.jsonl").exists():
            with (killed / "results.jsonl").open("a") as file:
                file.write('{"schema_version": 1, "robot": "sd')
    kept = {(r["case"], r["variant"]): r["wall_time_s"] for r in map(json.loads, whole_lines(killed)) if "case" in r}
    last = compare(killed, variants=("blind", "sway"))
    assert complaints(last) == [] and last.returncode == 0
    assert comparable(killed) == comparable(whole) and len(rows_in(killed)) == 4
    # What had a row was not run again: its time is still the same.
    assert all(kept.get((r["case"], r["variant"]), r["wall_time_s"]) == r["wall_time_s"] for r in rows_in(killed))


@pytest.mark.slow
def test_two_runs_agree_but_for_timings_and_variants_are_paired(tmp_path):
    for name, workers in (("a", "1"), ("b", "2")):
        run = compare(tmp_path / name, "--workers", workers, variants=("blind", "sway"), robots=("sdm_b", "t12"), seeds="4")
        assert complaints(run) == [] and run.returncode == 0
    rows = comparable(tmp_path / "a")
    assert rows == comparable(tmp_path / "b")
    assert [(r["robot"], r["variant"]) for r in rows] == [(r, v) for v in ("blind", "sway") for r in ("sdm_b", "t12")]
    assert rows[0]["case"] == rows[2]["case"] == "sdm_b-rock_field-4-5"
    assert all(r["trajectory_sha256"] and r["suite_sha256"] for r in rows)


@pytest.mark.slow
@pytest.mark.parametrize("ask", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("crew", ["processes", "ray"])
def test_interrupted_it_ends_its_trials_and_leaves_nothing(tmp_path, monkeypatch, crew, ask):
    if crew == "ray":
        pytest.importorskip("ray", reason="Ray is not installed")
    remote = tmp_path / "remote"
    remote.mkdir()
    monkeypatch.setenv("TMPDIR", str(remote))  # where a cluster's tasks have their folders
    monkeypatch.setenv("RAY_TMPDIR", tempfile.gettempdir())  # its sockets need a short path
    out = tmp_path / "out"
    run = compare(out, *(("--ray", "local") if crew == "ray" else ()), limit="60000", seeds="0")
    where = remote / "athlete_trial_" if crew == "ray" else out
    try:
        awaited(lambda: run.poll() is not None or trials_alive(where))
        run.send_signal(ask)
        told = run.communicate(timeout=180)[1]
    finally:
        run.kill()
    assert run.returncode == 130 and "interrupted; what is done stays in" in told and told.count("\n") == 1
    assert not trials_alive(where) and whole_lines(out) == [] and not list(remote.glob("athlete_trial_*"))


@pytest.mark.slow
def test_a_process_that_is_killed_is_a_row_and_the_others_go_on(tmp_path):
    run = compare(tmp_path, limit="600")
    awaited(lambda: len(trials_alive(tmp_path)) == 2)
    os.kill(int(trials_alive(tmp_path)[0]), signal.SIGKILL)
    assert "1 of which could not be run" in run.communicate()[0] and run.returncode == 0
    outcomes = sorted(r["outcome"] for r in rows_in(tmp_path))
    assert outcomes == ["error", "time_limit"]
    assert {r["reason"] for r in rows_in(tmp_path) if r["outcome"] == "error"} == {
        "its process was ended by SIGKILL; memory may have run out"
    }


@pytest.mark.slow
def test_other_code_scenario_or_variant_than_asked_for_is_not_begun(script, tmp_path):
    (one,) = script("variant_runs").asked_for(SUITE, SUITE.cases[:1], ["blind"], body="mock")
    for change, what in (
        ({"code_sha256": "other"}, "the code, the drawings or the libraries"),
        ({"scenario_sha256": "other"}, "scenario rock_field"),
        ({"variant_sha256": "other"}, "variant blind"),
    ):
        assert script("trial_process").run_in_folder(replace(one, **change), tmp_path).wait() == CHANGED
        assert (tmp_path / "log.txt").read_text() == f"{what}\n" and not (tmp_path / "trial.json").exists()


@pytest.mark.slow
def test_a_ray_cluster_gives_the_same_rows_as_processes_do(tmp_path):
    pytest.importorskip("ray", reason="Ray is not installed")
    for name, options in (("local", ()), ("ray", ("--ray", "local", "--workers", "2"))):
        run = compare(tmp_path / name, *options)
        told = run.communicate()
        assert run.returncode == 0, told
    assert comparable(tmp_path / "ray") == comparable(tmp_path / "local")
    recorded = {p.relative_to(tmp_path / "ray") for p in (tmp_path / "ray").glob("trials/*/trial.mcap")}
    assert len(recorded) == 2 and all((tmp_path / "local" / p).stat().st_size > 0 for p in recorded)


@pytest.mark.slow
def test_a_planner_of_ones_own_is_compared_and_noticed_when_it_changes(tmp_path):
    own = tmp_path / "my_planner.py"
    own.write_text(EXAMPLE)
    run = compare(tmp_path / "out", variants=("blind", "my_planner:Driver"), seeds="0", cwd=tmp_path)
    assert complaints(run) == [] and run.returncode == 0
    rows = rows_in(tmp_path / "out")
    assert [r["variant"] for r in rows] == ["blind", "my_planner:Driver"] and rows[1]["outcome"] != "error", rows[1]["reason"]
    own.write_text(EXAMPLE + "# changed\n")
    again = compare(tmp_path / "out", variants=("blind", "my_planner:Driver"), seeds="0", cwd=tmp_path)
    assert "variant my_planner:Driver has changed since its trials were run" in again.communicate()[1] and again.returncode == 2
