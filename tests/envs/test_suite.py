"""Suites are what they were frozen as, and say so when they are not."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.assets import named_toml
from athlete_twin.errors import ConfigError, LinkError
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from athlete_twin.world.rocks import scatter_rocks
from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import generator
from envs.suite import Case, Suite, frozen_table, load_suite, seeds_of, suite_of, unfrozen_suite

CASE = {"robot": "sdm_b", "scenario": "rock_field", "seed": 3, "delay": 5.0, "cycles": 2, "time_limit": 600.0, "capped": True}
DENSITIES = (0.03, 0.05, 0.10, 0.15)


def suite(*cases, **scenarios):
    return Suite(name="x", description="", cases=cases, scenarios=scenarios or {"rock_field": "0"})


def written(folder, *, seeds='"0:2"', frozen=True, more=""):
    """A suite of one scenario of its own, in a folder."""
    (folder / "field.toml").write_text(named_toml("scenarios", "rock_field").read_text())
    path = folder / "mine.toml"
    path.write_text(
        f'name = "mine"\ndescription = ""\n[[fields]]\nrobots = ["t12"]\nscenario = "{folder}/field.toml"\nseeds = {seeds}\n'
        f"delays = [0, 5.0]\n{more}"
    )
    if frozen:
        path.write_text(f"{path.read_text()}\n{frozen_table(unfrozen_suite(path))}")
    return path


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_full_has_a_hundred_fields_a_robot_and_a_sweep_of_delays_on_ten_of_them(robot):
    cases = load_suite("full").of_robots([robot])
    at_5 = [c for c in cases if c.delay == 5.0]
    assert sorted(c.seed for c in at_5) == list(range(100))
    densities = Counter(load_scenario(c.scenario).rocks.k for c in at_5)
    assert densities == dict.fromkeys(DENSITIES, 25)
    swept = {seed: {c.delay for c in cases if c.seed == seed} for seed in range(100)}
    assert sorted(s for s, delays in swept.items() if delays == {0.0, 2.0, 5.0, 10.0}) == list(range(0, 100, 10))
    assert all(delays == {5.0} for seed, delays in swept.items() if seed % 10)


def test_both_robots_get_the_same_fields_with_goals_5_m_away_slopes_and_low_sun():
    cases = load_suite("full").cases
    by_robot = [{replace(c, robot="") for c in cases if c.robot == robot} for robot in ("sdm_b", "t12")]
    assert by_robot[0] == by_robot[1] and len(cases) == 260
    scenarios = [load_scenario(name) for name in {c.scenario for c in cases}]
    assert {s.goal_distance for s in scenarios} == {5.0}
    for k in DENSITIES:
        of_density = [s for s in scenarios if s.rocks.k == k]
        assert sorted(s.parameters.get("heading_deg", -1.0) for s in of_density) == [-1.0, -1.0, 0.0, 90.0]
        assert {s.parameters["angle_deg"] for s in of_density if s.kind == "slope"} == {7.0}
        assert sum(np.rad2deg(s.sun_elevation) < 15.0 for s in of_density) == 1


def test_small_is_24_trials_of_three_variants_out_of_the_fields_of_full():
    small = load_suite("small")
    assert 3 * len(small.cases) == 24 and {c.robot for c in small.cases} == {"sdm_b", "t12"}
    assert sorted(load_scenario(c.scenario).rocks.k for c in small.of_robots(["t12"])) == list(DENSITIES)
    fields = {(c.robot, c.scenario, c.seed, c.delay) for c in load_suite("full").cases}
    assert {(c.robot, c.scenario, c.seed, c.delay) for c in small.cases} <= fields
    assert {c.cycles for c in small.cases} == {1} and all(c.capped for c in small.cases)
    assert not any(c.capped for c in load_suite("full").cases)


@pytest.mark.parametrize(("robot", "k", "seed"), [("sdm_b", 0.15, 75), ("t12", 0.15, 91), ("sdm_b", 0.10, 66), ("t12", 0.05, 38)])
def test_only_the_first_patches_of_a_field_are_cleared(robot, k, seed):
    case = next(c for c in load_suite("full").of_robots([robot]) if c.seed == seed)
    scenario, spec = load_scenario(case.scenario), load_spec(robot)
    assert scenario.rocks.k == k
    feet = Kinematics(spec).wheels_in_hex(regular_stance(spec))[:, :2]
    radius = 0.3
    cleared, wild = (
        scatter_rocks(scenario, generator(seed, "rocks"), clear_xy=xy, clear_radius=radius) for xy in (feet, np.zeros((0, 2)))
    )
    gone = set(wild) - set(cleared)
    assert set(cleared) <= set(wild)
    assert all(min(np.hypot(*(feet - [r.x, r.y]).T)) < 0.5 * r.diameter + radius for r in gone)
    # Area of the discs against the cumulative area fraction; a Poisson number of rocks, the largest of which count most.
    share = sum(0.25 * np.pi * r.diameter**2 for r in wild) / np.prod(scenario.size)
    assert share == pytest.approx(float(scenario.rocks.area_fraction(0.15)), rel=0.35)


@pytest.mark.parametrize(
    "change", [{"robot": "t12"}, {"seed": 4}, {"delay": 2.0}, {"cycles": 3}, {"time_limit": 601.0}, {"scenario": "slope_7"}]
)
def test_the_hash_covers_every_part_of_a_case(change):
    assert suite(Case(**CASE)).sha256 != suite(Case(**CASE | change)).sha256


def test_the_hash_covers_scenarios_and_neither_order_nor_name():
    cases = [Case(**CASE | {"seed": seed}) for seed in range(3)]
    known = suite(*cases).sha256
    assert suite(*cases, rock_field="1").sha256 != known
    assert replace(suite(*reversed(cases)), name="y", description="other words").sha256 == known


def test_a_changed_letter_of_a_scenario_is_noticed(tmp_path):
    path = written(tmp_path)
    assert len(load_suite(str(path)).cases) == 4
    field = tmp_path / "field.toml"
    field.write_text(field.read_text().replace("k = 0.10", "k = 0.11"))
    with pytest.raises(ConfigError, match="suite mine: its scenario field has changed since it was frozen; restore the file, or"):
        load_suite(str(path))


def test_changed_cases_are_noticed(tmp_path):
    path = written(tmp_path)
    path.write_text(path.read_text().replace("0:2", "0:3"))
    with pytest.raises(ConfigError, match="suite mine: its cases have changed since it was frozen"):
        load_suite(str(path))


def test_a_suite_by_path_need_not_be_frozen_but_one_of_the_assets_must(tmp_path, monkeypatch):
    path = written(tmp_path, frozen=False)
    assert len(load_suite(str(path)).cases) == 4
    monkeypatch.setattr("envs.suite.named_toml", lambda kind, name: path if kind == "suites" else Path(name))
    with pytest.raises(ConfigError, match="does not say what it was frozen as"):
        load_suite("mine")


@pytest.mark.parametrize("robots", [(), ("t12",)])
@pytest.mark.parametrize("share", [0.02, 0.04, 0.1, 0.3, 0.5, 0.8, 1.0])
def test_any_first_part_of_a_suite_has_its_share_of_every_kind(robots, share):
    """As many fields of every robot and scenario, and cases at every delay, as the share says, but for less than two."""
    full = load_suite("full")
    whole = full.of_robots(robots)
    assert sorted(c.id for c in whole) == sorted(c.id for c in full.cases if c.robot in (robots or ("sdm_b", "t12")))
    first = whole[: round(share * len(whole))]
    kinds = [(c.robot, c.scenario) for c in whole if c.delay == 5.0], [(c.robot, c.delay) for c in whole]
    parts = [(c.robot, c.scenario) for c in first if c.delay == 5.0], [(c.robot, c.delay) for c in first]
    for every, some in zip(kinds, parts, strict=True):
        got = Counter(some)
        for name, n in Counter(every).items():
            assert abs(got[name] - share * n) < 2.0, (name, got[name], share * n)
    # Who walked a field at another delay walked it at 5 s, or does next.
    fields = [(c.robot, c.seed) for c in first]
    for robot, seed in {(c.robot, c.seed) for c in first if c.delay != 5.0}:
        delays = [c.delay for c in first if (c.robot, c.seed) == (robot, seed)]
        assert 5.0 in delays or (robot, seed) in fields[-6:]


def test_all_of_a_field_comes_before_the_next_field():
    made = suite_of(robots=["sdm_b", "t12"], scenarios=["rock_field"], seeds=[5, 6], delays=[0.0, 5.0])
    assert not any(case.capped for case in made.cases)
    assert [(c.seed, c.delay, c.robot) for c in made.cases] == [(s, d, r) for s in (5, 6) for d in (0, 5) for r in ("sdm_b", "t12")]
    scenario = load_scenario("rock_field")
    assert {(c.cycles, c.time_limit) for c in made.cases} == {(scenario.cycles, scenario.time_limit)}


@settings(max_examples=15)
@given(st.lists(st.integers(0, 99_999), min_size=1, max_size=8))
def test_seeds_are_read_back(seeds):
    assert list(seeds_of(", ".join(map(str, seeds)))) == seeds
    first, last = min(seeds), max(seeds) + 1
    assert seeds_of(f"{first}:{last}") == tuple(range(first, last))


@pytest.mark.parametrize("text", ["", "x", "1:2:3", "3:3", "5:2", "-1", "1.5", "0:9999999", "1,,2", ":4", "²"])
def test_what_are_no_seeds_is_refused(text):
    with pytest.raises(ConfigError, match="seeds"):
        seeds_of(text)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"seed": -1}, "seed is -1"),
        ({"cycles": 0}, "cycles is 0"),
        ({"time_limit": float("nan")}, "time limit is nan"),
    ],
)
def test_impossible_cases_are_refused(bad, message):
    with pytest.raises(ConfigError, match=message):
        Case(**CASE | bad)


def test_an_impossible_delay_is_refused():
    with pytest.raises(LinkError, match="link delay is -1"):
        Case(**CASE | {"delay": -1.0})


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("unknown robot", {"robots": ["r2"]}, "robot 'r2' is not known; known robots: sdm_b, t12"),
        ("unknown scenario", {"scenarios": ["rock_feld"]}, "scenario 'rock_feld' is not known; known: .*rock_field"),
        ("nothing", {"seeds": []}, "it has no cases"),
        ("twice", {"seeds": [1, 1]}, "sdm_b-rock_field-1-5 is there twice"),
        ("one name", {"scenarios": ["rock_field", "rock_field"]}, "rock_field is there twice"),
    ],
)
def test_what_makes_no_suite_is_refused(name, options, message):
    whole = {"robots": ["sdm_b"], "scenarios": ["rock_field"], "seeds": [0], "delays": [5.0]}
    with pytest.raises(ConfigError, match=message):
        suite_of(**whole | options)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "mine"', "", "name = None is not usable; it must be a text"),
        ("description", "decsription", "key decsription is not known; did you mean 'description'"),
        ("seeds = ", "sedes = ", r"key fields\[0\].sedes is not known; did you mean 'seeds'"),
        ('seeds = "0:2"', "seeds = [1.5]", r"fields\[0\].seeds = \[1.5\] is not usable; it must be a list with one whole number"),
        ("delays = [0, 5.0]", "delays = []", r"fields\[0\].delays = \[\] is not usable"),
        ("delays = [0, 5.0]", "delays = [0]\ncycles = true", r"fields\[0\].cycles = True is not usable; it must be a whole number"),
        ('robots = ["t12"]', 'robots = ["t13"]', r"fields\[0\]: robot 't13' is not known"),
        ("delays = [0, 5.0]", "delays = [-1]", r"fields\[0\]: link delay is -1.0 s"),
        ("[[fields]]", "[fields]", r"fields must be tables \[\[fields\]\]"),
    ],
)
def test_a_suites_file_is_read_strictly(tmp_path, old, new, message):
    path = written(tmp_path, frozen=False)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError, match=message):
        load_suite(str(path))


def test_unknown_suites_and_robots_are_refused():
    with pytest.raises(ConfigError, match=r"suite 'tiny' is not known; known: full, small, or a path ending in \.toml"):
        load_suite("tiny")
    with pytest.raises(ConfigError, match="suite small has no cases for robot 't11'; did you mean 't12'"):
        load_suite("small").of_robots(["t11"])
