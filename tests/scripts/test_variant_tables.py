"""Tables of a comparison against counting by hand, against SciPy's own tests, and against labels that mean nothing."""

import ast
import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from athlete_twin.errors import ConfigError, RecordingError

sys.path.insert(0, str(Path(__file__).parent))
made_up = importlib.import_module("comparison_rows")
sys.path.pop(0)


@pytest.fixture(scope="module")
def metrics(script):
    return script("variant_metrics")


@pytest.fixture(scope="module")
def reading(script):
    return script("variant_rows")


@pytest.fixture(scope="module")
def tables(script):
    return script("variant_tables")


@pytest.fixture(scope="module")
def rows():
    return made_up.comparison(seeds=8)


@pytest.fixture(scope="module")
def compared(rows, tables):
    """All of SDM-B's differences."""
    return tables.comparisons(rows, tables.Place(robot="sdm_b", delay_s=5.0))


def only(comparisons, variant, metric):
    (found,) = [c for c in comparisons if (c.variant, c.metric.name) == (variant, metric)]
    return found


def test_rates_count_the_rows_that_reached_their_goal(rows, tables):
    place = tables.Place(robot="sdm_b", delay_s=5.0)
    for found in tables.successes(rows, place, ["integrated", "blind"]):
        mine = [r["outcome"] for r in rows if r["robot"] == "sdm_b" and r["variant"] == found.variant]
        assert (found.rate.successes, found.rate.trials) == (mine.count("goal_reached"), 16)


def test_pairs_are_trials_of_one_case(rows, tables, metrics):
    place = tables.Place(robot="t12", delay_s=5.0)
    found = only(tables.comparisons(rows, place, metrics=metrics.metrics_named(["progress_m"])), "blind", "progress_m")
    by_hand = [
        b["progress_m"] - a["progress_m"]
        for a in rows for b in rows
        if a["robot"] == "t12" and (a["variant"], b["variant"]) == ("integrated", "blind") and a["case"] == b["case"]
    ]  # fmt: skip
    assert found.difference.pairs == len(by_hand) == 16
    assert found.difference.mean == pytest.approx(np.mean(by_hand), abs=1e-8)
    assert found.unpaired == 0 and not found.better


def test_robots_and_delays_are_never_pooled(tables, metrics):
    rows = made_up.comparison(seeds=3, delays=(0.0, 5.0), variants=("integrated", "blind"))
    rows = [r for r in rows if not (r["robot"] == "t12" and r["seed"] == 2)]
    places = tables.places_of(rows)
    assert [(p.robot, p.delay_s) for p in places] == [("sdm_b", 0.0), ("sdm_b", 5.0), ("t12", 0.0), ("t12", 5.0)]
    pairs = [only(tables.comparisons(rows, p, metrics=[metrics.SUCCESS]), "blind", "success").difference.pairs for p in places]
    assert pairs == [6, 6, 4, 4]


def test_mission_time_is_compared_only_where_both_succeeded(rows, compared):
    found = only(compared, "moses_lake_2008", "mission_time_s")
    reached = {v: {r["case"] for r in rows if r["robot"] == "sdm_b" and r["variant"] == v and r["outcome"] == "goal_reached"}
               for v in ("integrated", "moses_lake_2008")}  # fmt: skip
    both = reached["integrated"] & reached["moses_lake_2008"]
    assert 0 < len(both) < 16 and found.difference.pairs == len(both) and found.difference.missing == 16 - len(both)


def test_who_stands_still_is_significantly_better_in_nothing(tables, metrics):
    """What a robot that never starts would show: nothing struck, no torque, all margins, no error."""
    still = {
        "outcome": "no_step", "progress_m": 0.0, "collisions": 0, "faults": 0, "peak_torque_fraction": 0.1, "min_support_margin_m": 0.9,
        "min_cps_margin_m": 0.9, "min_tip_over_energy_m": 0.9, "map_error_m": {"median": 0.0}, "localisation_error_m": {"mean": 0.0},
        "command_cycles": 1, "mission_time_s": 10.0, "sag_error_m": None, "touchdown_error_m": None, "stage_times_s": {},
        "wall_time_s": 1.0,
    }  # fmt: skip
    walks = [made_up.walked("t12", "rock_field", seed, 5.0, "a", share=2.0) | {"collisions": 3, "faults": 1} for seed in range(20)]
    rows = walks + [row | {"variant": "b", "folder": "b", **still} for row in walks]
    found = tables.comparisons(rows, tables.Place(robot="t12", delay_s=5.0))
    assert only(found, "b", "success").significant and not any(c.better for c in found if c.significant)
    # Who walks and strikes less is better all the same.
    rows = walks + [row | {"variant": "b", "folder": "b", "collisions": 1} for row in walks]
    found = only(tables.comparisons(rows, tables.Place(robot="t12", delay_s=5.0)), "b", "collisions")
    assert found.significant and found.better and found.difference.pairs == 20


def test_other_timings_change_only_what_is_said_of_timings(rows, compared, tables):
    timed = [
        r | {"wall_time_s": 9.0 * i, "stage_times_s": {"plan": {"median": 1.0 + i % 2, "p95": 2.0 + i, "count": 1}}}
        for i, r in enumerate(rows)
    ]
    again = tables.comparisons(timed, tables.Place(robot="sdm_b", delay_s=5.0))
    others = [c for c in compared if not c.metric.timing]
    assert {c.metric.name for c in compared if c.metric.timing} == {
        "stage_times_s.plan.median", "stage_times_s.plan.p95", "wall_time_s"
    }  # fmt: skip
    # By their text, for NaN is not equal to itself.
    assert others and [repr(c) for c in again if not c.metric.timing] == [repr(c) for c in others]
    assert [c.p_holm for c in again if c.metric.timing] != [c.p_holm for c in compared if c.metric.timing]


def test_success_is_judged_by_mcnemars_exact_test(tables, metrics):
    rows = []
    for seed in range(14):
        for variant, reached in (("a", seed < 3), ("b", seed >= 2)):
            outcome = "goal_reached" if reached else "fault"
            rows.append(made_up.case_row("sdm_b", "rock_field", seed, 5.0, variant, outcome=outcome))
    place = tables.Place(robot="sdm_b", delay_s=5.0)
    found = only(tables.comparisons(rows, place, baseline="a", metrics=[metrics.SUCCESS]), "b", "success").difference
    # 2 only under a, 11 only under b, 1 under both
    assert found.p == pytest.approx(stats.binomtest(2, 13).pvalue, abs=0.006)


def test_holm_runs_over_the_metrics_that_were_measured(rows, compared, tables, metrics):
    place = tables.Place(robot="sdm_b", delay_s=5.0)
    found = [c for c in compared if c.variant == "blind"]
    tested = [c for c in found if c.difference.pairs and not c.metric.timing]
    p = sorted(c.difference.p for c in tested)
    first = min(tested, key=lambda c: c.difference.p)
    assert first.p_holm == pytest.approx(min(len(tested) * p[0], 1.0))
    alone = tables.comparisons(rows, place, metrics=metrics.metrics_named(["success"]))
    assert only(alone, "blind", "success").p_holm == only(alone, "blind", "success").difference.p
    empty = [r | {"min_cps_margin_m": None} for r in rows if r["variant"] in ("integrated", "blind")]
    fewer = [c for c in tables.comparisons(empty, place) if c.variant == "blind"]
    assert np.isnan(only(fewer, "blind", "min_cps_margin_m").p_holm)
    assert min(c.p_holm for c in fewer if c.difference.pairs and not c.metric.timing) == pytest.approx((len(tested) - 1) * p[0])


def test_a_figure_does_not_depend_on_which_others_are_asked_for(rows, compared, tables, metrics):
    place = tables.Place(robot="sdm_b", delay_s=5.0)
    whole = only(compared, "blind", "sag_error_m.mean").difference
    alone = tables.comparisons(rows, place, metrics=metrics.metrics_named(["sag_error_m.mean"]))
    assert only(alone, "blind", "sag_error_m.mean").difference == whole


def test_densities_by_themselves_are_corrected_over_the_densities(rows, tables):
    found = [c for c in tables.effects_by_ground(rows, tables.Place(robot="t12", delay_s=5.0)) if c.variant == "blind"]
    assert [c.place.ground for c in found] == ["rock_field, k = 0.10", "black_point, k = 0.15"]
    assert all(c.difference.pairs == 8 for c in found)
    assert min(c.p_holm for c in found) == pytest.approx(min(2 * min(c.difference.p for c in found), 1.0))


def test_scenarios_of_one_density_are_one_ground(tables, tmp_path):
    dense = tmp_path / "dense.toml"
    dense.write_text("[rocks]\nk = 0.10\n")
    scenarios = ("black_point", "rock_field", str(dense), "on_another_machine")
    rows = [made_up.walked("t12", name, 0, 5.0, "a") for name in scenarios]
    found = tables.grounds_of(rows, tables.Place(robot="t12", delay_s=5.0))
    assert [p.ground for p in found] == ["k = 0.10", "black_point, k = 0.15", "on_another_machine"]
    assert [sum(p.has(r) for r in rows) for p in found] == [2, 1, 1]


@pytest.mark.parametrize(
    ("scenario", "cycles", "success"), [("rock_field", 2, True), ("rock_field", 30, False), ("on_another_machine", 30, True)]
)
def test_of_a_row_that_does_not_say_the_scenario_here_tells_whether_cycles_were_capped(scenario, cycles, success, metrics):
    row = made_up.case_row("t12", scenario, 0, 5.0, "a", outcome="cycles_done", gait_cycles=cycles, cycles=None, capped=None)
    assert metrics.succeeded(row) == success
    assert metrics.succeeded({k: v for k, v in row.items() if k not in ("cycles", "time_limit_s", "capped")}) == success


@pytest.mark.parametrize("scenario", ["rock_field", "on_another_machine"])
@pytest.mark.parametrize("capped", [True, False])
def test_cycles_done_is_success_where_the_row_says_that_its_case_capped_them(scenario, capped, metrics):
    row = made_up.case_row("t12", scenario, 0, 5.0, "a", outcome="cycles_done", gait_cycles=30, cycles=30, capped=capped)
    assert metrics.succeeded(row) == metrics.cut_short(row) == capped
    assert metrics.succeeded(row | {"outcome": "goal_reached"}) and not metrics.cut_short(row | {"outcome": "goal_reached"})
    assert not metrics.succeeded(row | {"outcome": "time_limit"})


def test_a_variant_of_another_stage_is_held_against_what_it_is_one_of(reading, tables, metrics):
    names = ("integrated", "drats_2010", "drats_2010_sag", "drats_2010_mine", "blind_sag", "integrated_leg_planner")
    assert reading.partners_of(names) == {
        "drats_2010": "integrated", "drats_2010_sag": "drats_2010", "drats_2010_mine": "integrated", "blind_sag": "integrated",
        "integrated_leg_planner": "integrated",
    }  # fmt: skip
    assert set(reading.partners_of(names, all_against_first=True).values()) == {"integrated"}
    rows = made_up.comparison(robots=("t12",), seeds=2, variants=names[:3])
    place = tables.Place(robot="t12", delay_s=5.0)
    found = {c.variant: c.baseline for c in tables.comparisons(rows, place, metrics=[metrics.SUCCESS])}
    assert found == {"drats_2010": "integrated", "drats_2010_sag": "drats_2010"}
    found = {c.variant: c.baseline for c in tables.comparisons(rows, place, metrics=[metrics.SUCCESS], baseline="integrated")}
    assert set(found.values()) == {"integrated"}


def test_trials_without_a_partner_are_counted(rows, tables, metrics):
    short = [r for r in rows if not (r["variant"] == "blind" and r["seed"] < 2)]
    place = tables.Place(robot="sdm_b", delay_s=5.0)
    found = only(tables.comparisons(short, place, metrics=[metrics.SUCCESS]), "blind", "success")
    assert (found.difference.pairs, found.unpaired) == (12, 4)
    apart = [r for r in rows if (r["variant"] == "blind") == (r["seed"] < 4)]
    found = tables.comparisons(apart, place, metrics=[metrics.SUCCESS], baseline="integrated")
    assert {c.variant for c in found} == {"drats_2010", "moses_lake_2008"}


def test_the_last_bits_of_a_sum_are_no_difference(tables):
    times = (0.1 + 0.2, 0.3)
    rows = [
        made_up.walked("t12", "rock_field", seed, 5.0, variant, share=2.0) | {"mission_time_s": t}
        for seed in range(5) for variant, t in zip("ab", times, strict=True)
    ]  # fmt: skip
    found = only(tables.comparisons(rows, tables.Place(robot="t12", delay_s=5.0)), "b", "mission_time_s")
    assert found.difference.mean == 0.0 and found.difference.p == 1.0


@settings(max_examples=30)
@given(st.integers(1, 40))
def test_fewest_pairs_are_those_with_which_all_signs_alike_stay_below_the_level(script, tests):
    n = script("variant_tables").fewest_pairs(tests)
    assert tests * 2.0 ** (1 - n) <= 0.05 < tests * 2.0 ** (2 - n)


@pytest.mark.slow
@pytest.mark.parametrize(
    "metric",
    [
        pytest.param("success", marks=pytest.mark.ci), pytest.param("progress_m", marks=pytest.mark.ci), "sag_error_m.mean",
        "mission_time_s",
    ],
)  # fmt: skip
def test_labels_swapped_at_random_within_pairs_flag_one_in_twenty(metric, tables, metrics):
    """Two variants that truly differ, and then may not: before Holm's correction, as each metric is judged."""
    chosen, place = metrics.metrics_named([metric]), tables.Place(robot="sdm_b", delay_s=5.0)
    rows = made_up.comparison(robots=("sdm_b",), seeds=20, variants=("integrated", "moses_lake_2008"))
    assert only(tables.comparisons(rows, place, metrics=chosen), "moses_lake_2008", metric).difference.p < 0.01
    cases = sorted({r["case"] for r in rows})
    other = {"integrated": "moses_lake_2008", "moses_lake_2008": "integrated"}
    draws, flagged = np.random.default_rng(2), 0
    for _ in range(200):
        swapped = dict(zip(cases, draws.random(len(cases)) < 0.5, strict=True))
        relabelled = [r | {"variant": other[r["variant"]]} if swapped[r["case"]] else r for r in rows]
        found = tables.comparisons(relabelled, place, metrics=chosen, baseline="integrated")
        flagged += only(found, "moses_lake_2008", metric).difference.p < 0.05
    # Success is counted, so that its p-values come in steps: those of as many coins as there are pairs that differ.
    coins = sum(metrics.succeeded(a) != metrics.succeeded(b) for a, b in zip(*_sides(rows), strict=True))
    level = sum(stats.binom.pmf(k, coins, 0.5) for k in range(coins + 1) if stats.binomtest(k, coins).pvalue < 0.05)
    low, high = stats.binom.interval(0.998, 200, level) if metric == "success" else (4, 18)
    assert low <= flagged <= high


def _sides(rows):
    """Rows of both variants, case by case."""
    ordered = sorted(rows, key=lambda r: (r["variant"], r["case"]))
    return ordered[: len(ordered) // 2], ordered[len(ordered) // 2 :]


def test_the_first_variant_is_the_baseline_unless_told_otherwise(rows, reading):
    assert reading.variants_of(rows) == made_up.DEFAULTS
    assert reading.variants_of(rows, "blind") == ("blind", "integrated", "drats_2010", "moses_lake_2008")
    with pytest.raises(ConfigError, match=r"baseline 'x' was not run; the variants are integrated, drats_2010, moses_lake_2008"):
        reading.variants_of(rows, "x")


def test_unknown_metric_names_the_near_and_the_known(metrics):
    with pytest.raises(ConfigError, match=r"metric 'progress' is unknown; did you mean 'progress_m'\? known are success, progress_m"):
        metrics.metrics_named(["success", "progress"])
    with pytest.raises(ConfigError, match="no metric is named; known are success"):
        metrics.metrics_named([])
    assert [m.name for m in metrics.metrics_named(["faults", "success", "faults"])] == ["faults", "success"]


def test_every_metric_but_success_is_a_figure_of_a_trials_result(metrics):
    source = ast.parse((Path(__file__).parents[2] / "envs" / "trial.py").read_text())  # to import it takes seconds
    (result,) = (n for n in source.body if isinstance(n, ast.ClassDef) and n.name == "TrialResult")
    known = {n.target.id for n in result.body if isinstance(n, ast.AnnAssign)}
    assert len(known) > 40
    assert {m.name.split(".")[0] for m in metrics.METRICS} - {"success"} <= known
    row = made_up.walked("sdm_b", "rock_field", 0, 5.0, "integrated")
    assert known <= row.keys() and all(m.read(row) is not None for m in metrics.METRICS)


def test_rows_come_back_in_one_order_whatever_order_their_cases_were_written_in(rows, reading, tmp_path):
    late = sorted(rows, key=lambda r: -r["seed"])
    there, back = made_up.write(tmp_path / "a", rows), made_up.write(tmp_path / "b", late)
    assert reading.read_rows(there) == reading.read_rows(back)


def test_torn_last_line_is_dropped(rows, reading, tmp_path):
    folder = made_up.write(tmp_path, rows[:5], torn=json.dumps(rows[5])[:200])
    assert len(reading.read_rows(folder)) == 5


def test_trial_that_could_not_be_run_may_be_run_again(rows, reading, tmp_path):
    row = rows[0]
    folder = made_up.write(tmp_path, [row | {"outcome": "error"}, row])
    assert [r["outcome"] for r in reading.read_rows(folder)] == [row["outcome"]]


def test_not_a_number_is_not_measured(reading, metrics, rows, tmp_path):
    folder = made_up.write(tmp_path, [rows[0] | {"progress_m": float("nan")}])
    assert metrics.BY_NAME["progress_m"].read(reading.read_rows(folder)[0]) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: {"suite_sha256": "7" * 64}, r"line 3: mixes suites: 7{16} here, 5{16} in line 1; run each"),
        (lambda r: {"provenance": made_up.PROVENANCE | {"version": "9"}}, r"line 3: mixes versions \(version\): 9 here, 0.1.0 in"),
        (lambda r: {"provenance": made_up.PROVENANCE | {"git_sha": "f" * 40}}, r"line 3: mixes versions \(git_sha\)"),
        (lambda r: {"provenance": made_up.PROVENANCE | {"packages": {}}}, r"line 3: mixes versions \(packages\)"),
        (lambda r: {"provenance": made_up.PROVENANCE | {"code_sha256": "1f"}}, r"line 3: mixes versions \(code_sha256\)"),
        (lambda r: {"progress_m": "far"}, r"results.jsonl line 3: progress_m of trials/\S+ is 'far', must be a number or null"),
        (lambda r: {"sag_error_m": {"mean": [1]}}, r"line 3: sag_error_m.mean of \S+ is \[1\]"),
        (lambda r: {"variant": 3}, r"line 3: variant is 3, must be text"),
        (lambda r: {"delay_s": "5"}, r"line 3: delay_s is '5', must be a number of seconds"),
        (lambda r: {"delay_s": float("inf")}, r"line 3: delay_s is inf, must be a number of seconds"),
        (lambda r: {"seed": None}, r"line 3: seed is None, must be a whole number"),
        (lambda r: {"seed": True}, r"line 3: seed is True, must be a whole number"),
        (lambda r: {"reason": None}, r"line 3: reason is None, must be text"),
        (lambda r: {"gait_cycles": "3"}, r"line 3: gait_cycles is '3', must be a whole number or null"),
        (lambda r: {"provenance": "x"}, r"line 3: provenance is 'x', must be an object or null"),
        (lambda r: {"provenance": {"packages": ["numpy"]}}, r"line 3: provenance.packages is \['numpy'\], must be an object or null"),
        (lambda r: {"suite_sha256": 5}, r"line 3: suite_sha256 is 5, must be text or null"),
        (lambda r: {"link_s": "1"}, r"line 3: link_s is '1', must be a finite number or null"),
        (lambda r: {"motion_s": float("nan")}, r"line 3: motion_s is nan, must be a finite number or null"),
        (lambda r: {"stage_times_s": [1]}, r"line 3: stage_times_s is \[1\], must be an object or null"),
        (lambda r: {"stage_times_s": {"fuse": 1.0}}, r"line 3: stage_times_s.fuse is 1.0, must be an object or null"),
        (lambda r: {"stage_times_s": {"fuse": {"p95": "1"}}}, r"line 3: stage_times_s.fuse.p95 is '1', must be a finite number"),
        (lambda r: {"cycles": 2.5}, r"line 3: cycles is 2.5, must be a whole number or null"),
        (lambda r: {"time_limit_s": "1"}, r"line 3: time_limit_s is '1', must be a finite number or null"),
        (lambda r: {"capped": "no"}, r"line 3: capped is 'no', must be true, false or null"),
    ],
)
def test_rows_that_do_not_compare_are_refused_with_their_line(change, message, rows, reading, tmp_path):
    folder = made_up.write(tmp_path, [rows[0], rows[1], rows[2] | change(rows[2])])
    with pytest.raises(RecordingError, match=message):
        reading.read_rows(folder)


def test_broken_lines_and_files_are_refused(rows, reading, tmp_path):
    with pytest.raises(RecordingError, match=r"results.jsonl cannot be read .* name a folder written by benchmark_variants.py"):
        reading.read_rows(tmp_path)
    with pytest.raises(RecordingError, match=r"holds no whole row yet; run benchmark_variants.py"):
        reading.read_rows(made_up.write(tmp_path, [], torn="{"))
    with pytest.raises(RecordingError, match=r"line 2: .* stands in line 1 already; delete one of both"):
        reading.read_rows(made_up.write(tmp_path, [rows[0], rows[0]]))
    (tmp_path / "results.jsonl").write_text("{broken\n" + json.dumps(rows[0]) + "\n")
    with pytest.raises(RecordingError, match=r"results.jsonl line 1: no JSON"):
        reading.read_rows(tmp_path)
    (tmp_path / "results.jsonl").write_text("[]\n")
    with pytest.raises(RecordingError, match="line 1: list instead of an object"):
        reading.read_rows(tmp_path)
    less = {k: v for k, v in rows[0].items() if k not in ("case", "faults")}
    with pytest.raises(RecordingError, match=r"line 1: no case, faults; a row holds all of trial.json"):
        reading.read_rows(made_up.write(tmp_path, [less]))


def test_picked_trials_are_the_best_the_middle_and_the_worst(reading):
    def row(seed, outcome, progress, time):
        changes = {"outcome": outcome, "progress_m": progress, "mission_time_s": time}
        return made_up.case_row("t12", "rock_field", seed, 5.0, "a", **changes)

    rows = [
        row(0, "fault", 2.0, 100.0), row(1, "goal_reached", 3.0, 900.0), row(2, "goal_reached", 3.0, 800.0),
        row(3, "goal_reached", 2.9, 100.0), row(4, "fault", 0.5, 10.0), row(5, "error", None, None),
    ]  # fmt: skip
    picked = reading.picked_trials(rows[::-1])
    assert {kind: r["seed"] for kind, r in picked["t12", "a"].items()} == {"best": 2, "median": 3, "worst": 4}
    assert reading.picked_trials([rows[5]]) == {}
    assert {r["seed"] for r in reading.picked_trials(rows[:1])["t12", "a"].values()} == {0}
