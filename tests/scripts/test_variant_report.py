"""The page of a comparison: that it answers, that it stands by itself, that nothing from the rows gets into it as code."""

import csv
import importlib
import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
made_up = importlib.import_module("comparison_rows")
sys.path.pop(0)

HOSTILE = '<script>alert("x")</script>$\\frac{a}$|'
VOID = {"meta", "img", "br", "link"}


@pytest.fixture(scope="module")
def report(script):
    return script("variant_report")


@pytest.fixture(scope="module")
def targets(script):
    return script("variant_targets")


@pytest.fixture(scope="module")
def study(tmp_path_factory, report):
    """A comparison, one trial of which has a report and a film."""
    rows = made_up.comparison(robots=("sdm_b",), scenarios=("rock_field",), seeds=12, variants=("integrated", "drats_2010", "blind"))
    folder = made_up.write(tmp_path_factory.mktemp("study"), rows)
    trial = folder / rows[0]["folder"]
    trial.mkdir(parents=True)
    for name in ("report.html", "film.webm"):
        (trial / name).write_text("")
    path = report.write_report(folder, metrics=("success", "progress_m", "mission_time_s", "command_cycles", "map_error_m.median"))
    return folder, rows, path.read_text()


class Balance(HTMLParser):
    """That every element is closed where it was opened."""

    def __init__(self):
        super().__init__()
        self.open, self.seen = [], set()

    def handle_starttag(self, tag, attrs):
        self.seen.add(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()


def parsed(page):
    found = Balance()
    found.feed(page)
    assert not found.open
    return found


def words(page):
    return re.sub(r"<[^>]+>", " ", page)


def test_page_is_one_file_without_outside_addresses(study):
    _, _, page = study
    assert "http" not in page and parsed(page).seen.isdisjoint({"script", "link", "iframe"})
    assert all(source.startswith("data:image/png;base64,") for source in re.findall(r'src="([^"]*)"', page))
    assert page.count("<img") == 6  # one delay makes no sweep


def test_page_begins_with_the_answer(study):
    _, rows, page = study
    n = sum(r["outcome"] == "goal_reached" for r in rows if (r["robot"], r["variant"]) == ("sdm_b", "blind"))
    text = words(page)
    assert f"blind {n} of 12" in text and "blind against integrated: succeeds significantly less often" in text
    assert re.search(r"drats_2010 against integrated: success not significantly (better|worse) .* would take \d+ pairs", text)
    order = [page.index(f"<h2>{t}") for t in ("The answer", "What is wanted", "Success", "Mission time", "Differences", "Every trial")]
    assert order == sorted(order)


def test_every_figure_says_of_how_many_trials_it_is(script):
    export, metrics = script("variant_export"), script("variant_metrics")
    rows = [made_up.case_row("t12", "rock_field", s, 5.0, "a", outcome="fault", progress_m=float(s), faults=2) for s in range(3)]
    rows.append(made_up.case_row("t12", "rock_field", 3, 5.0, "a"))  # could not be run
    assert export.median_cell(rows, metrics.BY_NAME["progress_m"]) == "1.00 m of 3 trials"
    assert export.median_cell(rows[:1], metrics.BY_NAME["progress_m"], unit=False) == "0.00 of 1 trial"
    assert export.total_cell(rows, metrics.BY_NAME["faults"]) == "6 in 3 trials"
    assert export.median_cell(rows, metrics.BY_NAME["mission_time_s"]) == export.total_cell(rows, metrics.BY_NAME["collisions"]) == "–"


def test_page_and_table_count_their_trials_and_name_the_baseline(study):
    folder, _, page = study
    assert re.search(r"<td class=\"n\">\S+ m of 12 trials</td>", page) and re.search(r">\d+ in 12 trials</td>", page)
    assert "The baseline is <b>integrated</b>, the variant that this folder was first asked for" in page
    table = (folder / "results.md").read_text()
    assert " of 12 trials | " in table and "Baseline: integrated." in table


def test_the_baseline_that_is_asked_for_is_named(report, tmp_path):
    rows = made_up.comparison(robots=("t12",), scenarios=("rock_field",), seeds=2, variants=("integrated", "blind"))
    page = report.write_report(made_up.write(tmp_path, rows), metrics=["success"], baseline="blind").read_text()
    assert "The baseline is <b>blind</b>, as asked for" in page and "Baseline: blind." in (tmp_path / "results.md").read_text()


def test_a_part_of_what_was_asked_for_says_so_and_keeps_the_first_variant(report, tmp_path):
    rows = made_up.comparison(robots=("sdm_b",), scenarios=("rock_field",), seeds=3, variants=("integrated", "blind"))
    folder = made_up.write(tmp_path, rows)
    asked = [f"{r['case']} {r['variant']}" for r in rows]
    (folder / "asked.txt").write_text("\n".join([*asked, "sdm_b-rock_field-8-5 blind", "sdm_b-rock_field-0-5 sway"]))
    (folder / "variants.txt").write_text("blind\nintegrated\n")
    page = words(report.write_report(folder, metrics=("success",)).read_text())
    part = f"A part only: 2 of the {len(rows) + 2} trials asked for have not been run."
    assert part in page and part in (folder / "results.md").read_text()
    assert "The baseline is  blind , the variant that this folder was first asked for" in page


def test_links_go_to_the_trials_that_have_something(study):
    _, rows, page = study
    folder = rows[0]["folder"]
    assert set(re.findall(r'href="([^"]*)"', page)) == {f"{folder}/report.html", f"{folder}/film.webm"}


def test_page_names_where_it_comes_from(study):
    _, _, page = study
    footer = page[page.index("<footer>") :]
    for text in ("athlete_twin 0.1.0", made_up.PROVENANCE["git_sha"], "Some Processor", "Seeds 0 to 11", made_up.SUITE, "pybullet 3.2.7"):
        assert text in footer


def test_csv_holds_every_row_flat(study):
    folder, rows, _ = study
    with (folder / "results.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == len(rows)
    by_case = {(r["case"], r["variant"]): r for r in rows}
    for line in table:
        row = by_case[line["case"], line["variant"]]
        assert float(line["map_error_m.median"]) == row["map_error_m"]["median"]
        assert line["success"] == str(row["outcome"] == "goal_reached")
        assert float(line["stage_times_s.plan.p95"]) == row["stage_times_s"]["plan"]["p95"]


def test_trials_that_could_not_be_run_leave_their_figures_empty(script, tmp_path):
    export = script("variant_export")
    rows = [made_up.walked("t12", "rock_field", 0, 5.0, "a"), made_up.case_row("t12", "rock_field", 1, 5.0, "a")]
    flat, columns = export.flattened(rows)
    assert "sag_error_m.mean" in columns and "sag_error_m" not in columns
    assert flat[1]["sag_error_m.mean"] is None and flat[1]["success"] is False
    export.write_csv(tmp_path / "x.csv", rows)
    with (tmp_path / "x.csv").open() as file:
        assert [line["sag_error_m.mean"] == "" for line in csv.DictReader(file)] == [False, True]
    parquet = pytest.importorskip("pyarrow.parquet")
    assert export.write_parquet(tmp_path / "x.parquet", rows)
    assert parquet.read_table(tmp_path / "x.parquet")["progress_m"].to_pylist() == [rows[0]["progress_m"], None]


def test_columns_of_several_kinds_become_text(script):
    alike = script("variant_export")._alike
    assert alike([1, None, "a"]) == ["1", None, "a"] and alike([1, 2.5, None]) == [1.0, 2.5, None] and alike([True, False]) == [True, False]


def test_without_pyarrow_there_is_no_parquet(script, tmp_path, monkeypatch):
    export = script("variant_export")
    (tmp_path / "x.parquet").write_text("of an earlier run")
    monkeypatch.setattr(export.importlib.util, "find_spec", lambda name: None)
    assert not export.write_parquet(tmp_path / "x.parquet", [made_up.walked("t12", "rock_field", 0, 5.0, "a")])
    assert not (tmp_path / "x.parquet").exists()


def test_parquet_holds_what_csv_holds(study):
    parquet = pytest.importorskip("pyarrow.parquet")
    folder, rows, _ = study
    table = parquet.read_table(folder / "results.parquet")
    with (folder / "results.csv").open() as file:
        assert table.column_names == next(csv.reader(file))
    assert table.num_rows == len(rows)
    assert sorted(table["progress_m"].to_pylist()) == sorted(r["progress_m"] for r in rows)


def test_markdown_has_a_row_for_each_robot_and_variant(study):
    folder, _, _ = study
    lines = (folder / "results.md").read_text().splitlines()
    cells = [line.split(" | ") for line in lines if line.startswith("| ")]
    assert len(cells) == 1 + 3 and len({len(c) for c in cells}) == 1
    assert "| difference | from |" in lines[0] and lines[3].count("| integrated |") == 1


@pytest.mark.slow
@pytest.mark.ci
def test_same_rows_give_the_same_bytes(report, tmp_path):
    rows = made_up.comparison(robots=("t12",), scenarios=("rock_field",), seeds=3, variants=("integrated", "blind"))
    late = sorted(rows, key=lambda r: -r["seed"])
    a, b = (report.write_report(made_up.write(tmp_path / name, r), metrics=["success"]) for name, r in (("a", rows), ("b", late)))
    assert a.read_bytes() == b.read_bytes()


def test_names_from_outside_are_text_wherever_they_show(report, tmp_path):
    rows = [
        r | {"variant": HOSTILE if r["variant"] == "blind" else "integrated", "reason": HOSTILE, "scenario": HOSTILE,
             "operator": HOSTILE, "provenance": made_up.PROVENANCE | {"cpu": HOSTILE}, "folder": f"../{HOSTILE}"}
        for r in made_up.comparison(robots=("sdm_b",), seeds=2, variants=("integrated", "blind"))
    ]  # fmt: skip
    page = report.write_report(made_up.write(tmp_path, rows), metrics=["success", "progress_m"]).read_text()
    assert "<script" not in page and "&lt;script&gt;" in page and "script" not in parsed(page).seen
    assert "<script" not in (tmp_path / "results.md").read_text()


def nulls(outcome):
    return [
        made_up.case_row(robot, "rock_field", seed, 5.0, variant, outcome=outcome)
        for robot in ("sdm_b", "t12") for seed in range(3) for variant in ("integrated", "blind")
    ]  # fmt: skip


def uneven():
    rows = made_up.comparison(scenarios=("rock_field",), seeds=6, variants=("integrated", "blind"))
    return [r for r in rows if r["robot"] == "sdm_b" or r["seed"] < 2]


DEGENERATE = {
    "one variant": (made_up.comparison(scenarios=("rock_field",), seeds=2, variants=("blind",)), "one variant only"),
    "one trial": ([made_up.walked("t12", "rock_field", 0, 0.0, "integrated")], "integrated 1 of 1"),
    "nothing measured": (nulls("fault"), "integrated 0 of 3"),
    "only errors": (nulls("error"), "12 of them could not be run"),
    "two robots, other counts": (uneven(), "With 2 pairs nothing can be significant"),
    "no case in common": (
        [made_up.walked("t12", "rock_field", i, 5.0, v) for i, v in enumerate(("integrated", "blind"))],
        "blind and integrated share no case",
    ),
    "baseline on one robot only": (
        [made_up.walked(r, "rock_field", 0, 5.0, v) for r, v in (("sdm_b", "integrated"), ("t12", "blind"), ("t12", "sway"))],
        "blind: integrated was not run here",
    ),
    "stages": (
        made_up.comparison(scenarios=("rock_field",), seeds=3, variants=("integrated", "drats_2010", "drats_2010_sag")),
        "What stages contribute: differences from drats_2010",
    ),
    "mock": (
        [made_up.walked("t12", "rock_field", 0, 5.0, "a") | {"provenance": made_up.PROVENANCE | {"body": "mock"}}],
        "these figures say nothing of the robots",
    ),
    "an outcome of tomorrow": ([made_up.walked("t12", "x", 0, 5.0, "a") | {"outcome": "lost", "provenance": None}], "lost"),
}


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("name", DEGENERATE)
def test_little_makes_a_page_all_the_same(name, report, tmp_path):
    rows, expected = DEGENERATE[name]
    page = report.write_report(made_up.write(tmp_path, rows)).read_text()
    assert expected in words(page) and not re.search(r"\bnan\b", words(page), re.I)
    parsed(page)
    assert (tmp_path / "results.csv").exists() and "nan" not in (tmp_path / "results.md").read_text()


def test_delays_make_a_sweep(script):
    figures = script("variant_figures")
    rows = made_up.comparison(robots=("t12",), scenarios=("rock_field",), seeds=2, delays=(0.0, 5.0), variants=("integrated",))
    looks = figures.looks_of(("integrated",))
    assert figures.delay_figure(rows, "t12", looks).startswith(b"\x89PNG")
    assert figures.delay_figure([r for r in rows if r["delay_s"] == 0.0], "t12", looks) is None


def test_variants_keep_colours_and_marks_apart(script):
    looks = script("variant_figures").looks_of([f"v{i}" for i in range(20)])
    assert len({(look.colour, look.marker) for look in looks.values()}) == 20


def wished(targets, rows):
    return {(t.robot, t.wanted.split(" at ")[0].split(" in ")[0]): t for t in targets.targets(rows)}


def test_wishes_are_judged_by_what_was_measured(targets):
    walk = {"outcome": "goal_reached", "progress_m": 2.5, "mission_time_s": 1500.0, "command_cycles": 100, "peak_torque_fraction": 0.9}
    rows = [made_up.case_row("sdm_b", "rock_field", s, 5.0, "integrated", **walk) for s in range(20)]
    rows[0] |= {"outcome": "tip_over", "peak_torque_fraction": 1.02}
    rows += [made_up.case_row("sdm_b", "rock_field", s, 5.0, "drats_2010", **walk | {"command_cycles": 110 + s % 3}) for s in range(20)]
    found = wished(targets, rows)
    goals = found["sdm_b", "95 % of goals reached"]
    assert goals.met and goals.measured.startswith("19 of 20, 95 %") and "cannot settle it" in goals.note
    assert found["sdm_b", "no tip-over"].met is False and found["sdm_b", "no tip-over"].measured == "1 of 20 trials tipped over"
    assert found["sdm_b", "no joint saturated"].met is False and "102 %" in found["sdm_b", "no joint saturated"].note
    pace = found["sdm_b", "5 m"]
    assert pace.met and pace.measured.startswith("50 min by the median") and "none walked farther than 2.5 m" in pace.note
    cycles = found["sdm_b", "fewer command cycles than drats_2010"]
    assert cycles.met and "of 19 pairs" in cycles.measured and cycles.note.startswith("significant")
    assert all(t.met is None for (robot, _), t in found.items() if robot == "t12")


def test_wishes_hold_at_five_seconds_and_for_goals_only(targets):
    cut = {"outcome": "cycles_done", "gait_cycles": 2, "cycles": 2, "capped": True}
    rows = [made_up.case_row("t12", "rock_field", s, 5.0, "integrated", **cut) for s in range(4)]
    rows += [made_up.case_row("t12", "rock_field", s, 0.0, "integrated", outcome="goal_reached") for s in range(9)]
    goals = wished(targets, rows)["t12", "90 % of goals reached"]
    assert goals.met is None and goals.measured.startswith("0 of 4")
    assert goals.note.startswith("not measured: 4 trials of 4 ended after 2 gait cycles")


def capped_walks(variant, seeds, **changes):
    walk = {
        "outcome": "cycles_done", "gait_cycles": 2, "cycles": 2, "capped": True, "progress_m": 0.5, "mission_time_s": 100.0,
        "command_cycles": 10, "peak_torque_fraction": 0.7,
    }  # fmt: skip
    return [made_up.case_row("t12", "rock_field", s, 5.0, variant, **walk | changes) for s in seeds]


def test_trials_cut_short_grant_no_wish(targets):
    rows = capped_walks("integrated", range(8)) + capped_walks("drats_2010", range(8), command_cycles=20)
    found = [t for t in targets.targets(rows) if t.robot == "t12"]
    assert len(found) == 5
    for target in found:
        assert target.met is None and "ended after 2 gait cycles" in target.note, target.wanted


def test_failures_of_trials_cut_short_count(targets):
    rows = capped_walks("integrated", range(7)) + capped_walks("integrated", [7, 8], outcome="tip_over", peak_torque_fraction=1.0)
    found = wished(targets, rows)
    for wanted in ("no tip-over", "no joint saturated", "90 % of goals reached"):  # at best 7 of 9
        assert found["t12", wanted].met is False
    assert found["t12", "90 % of goals reached"].note.startswith("7 trials of 9 ended after 2 gait cycles")


def test_the_pace_is_that_of_trials_which_arrived(targets):
    slow = {"outcome": "goal_reached", "capped": False, "progress_m": 5.0, "mission_time_s": 7200.0}
    rows = capped_walks("integrated", range(8)) + capped_walks("integrated", [8], **slow)
    pace = wished(targets, rows)["t12", "5 m"]
    assert pace.met is False and pace.measured.startswith("120 min by the median") and pace.note.startswith("0 of 1 trials")


def test_runs_of_numbers_are_shortened(script):
    assert script("variant_details").spans([0, 1, 2, 3, 7, 9, 10]) == "0 to 3, 7, 9, 10"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--metrics", "speed"), "metric 'speed' is unknown; known are success"),
        (("--baseline", "best"), "baseline 'best' was not run; the variants are integrated"),
    ],
)
def test_unknown_names_are_one_line_and_status_two(arguments, line, report, tmp_path, capsys):
    made_up.write(tmp_path, [made_up.walked("t12", "rock_field", 0, 5.0, "integrated")])
    assert report.main([str(tmp_path), *arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and line in lines[0]


def test_folder_without_a_comparison_is_one_line_and_status_two(report, tmp_path, capsys):
    assert report.main([str(tmp_path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and "results.jsonl cannot be read" in lines[0]
