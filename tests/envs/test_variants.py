"""Which planner a name means, what each shipped variant is, and how a planner from outside joins."""

import re
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from athlete_twin.assets import assets_root
from athlete_twin.errors import ConfigError
from athlete_twin.link import uplink
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from envs import variants
from envs.build import check_variant, ground_agent, variant_content
from envs.charged import ChargedGround
from envs.origin import changed_since, recorded_origin
from envs.prepare import Wanted, again, prepared
from envs.rerun import rerun
from envs.variants import OutsidePlanner, TomlVariant, variant_named, variant_names
from planner.agent import SECONDS_PER_PLAN
from planner.config import CHOICES, OPTIONAL, planner_config
from planner.decisions import Proposal
from planner.eyes import Look

ROBOTS = ("sdm_b", "t12")
GROUNDS = {"sdm_b": "rock_field", "t12": "black_point"}
DOCS = Path(__file__).resolve().parents[2] / "docs"
PRESETS = ("moses_lake_2008", "drats_2010", "integrated", "blind")
SINGLE = sorted(name for name in variant_names() if name.startswith("drats_2010_"))
SETTINGS_OF = {"self_mask": {"self_mask", "self_clearance"}, "fusion": {"fusion", "survey", "look"}, "body_motion": {"sway"}}
"""tables of settings that belong to a stage, where not the one of its name alone"""


def content(name: str) -> dict:
    return variant_content(name)[1]


# --- what is shipped ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", variant_names())
def test_the_first_line_of_a_variant_says_what_it_is(name):
    first = (assets_root() / "variants" / f"{name}.toml").read_text().splitlines()[0]
    assert first.startswith("# ") and first.endswith((".", ".)")) and len(first) > 30


def test_the_historical_variants_are_what_the_papers_tell():
    then, later = content("moses_lake_2008"), content("drats_2010")
    assert (then["self_mask"], then["fusion"], then["sag"], then["leg_planner"]) == ("flatten", "single_view", "raise_terrain", "sbl")
    assert (then["gait"], then["settings"]["sag"]["terrain_raise"]) == ("single_steps", 0.15)
    assert (later["self_mask"], later["fusion"], later["sag"]) == ("watershed", "lift_and_image", "springs")
    assert (later["gait"], later["touchdown"], then["touchdown"]) == ("reverse_wave", "planned", "planned")


def test_each_stage_has_a_variant_that_changes_it_alone():
    assert {name.removeprefix("drats_2010_") for name in SINGLE} == set(CHOICES)


@pytest.mark.parametrize("name", SINGLE)
def test_it_differs_from_drats_2010_in_that_stage_and_in_nothing_else(name):
    stage, mine, base = name.removeprefix("drats_2010_"), content(name), content("drats_2010")
    assert {key for key in {*CHOICES, *OPTIONAL, "level_deck_deg"} if mine.get(key) != base.get(key)} == {stage}
    tables, others = mine["settings"], base["settings"]
    changed = {table for table in tables.keys() | others.keys() if tables.get(table) != others.get(table)}
    assert changed <= SETTINGS_OF.get(stage, {stage})


@pytest.mark.parametrize("stage", sorted(CHOICES))
def test_it_goes_towards_integrated_wherever_that_has_another_method(stage):
    best, base = content("integrated")[stage], content("drats_2010")[stage]
    assert base == best or content(f"drats_2010_{stage}")[stage] == best


@pytest.mark.parametrize("name", variant_names())
def test_every_shipped_variant_is_taken_for_both_robots(name):
    check_variant(name)
    content = variant_content(name)[1]
    for robot in ROBOTS:
        config = planner_config(content, load_spec(robot), name=name)
        assert (config.step.leg_planner, config.fusion_method) == (content["leg_planner"], content["fusion"])


def table(columns, names):
    """Markdown of the methods of variants: a row a stage."""
    rows = [f"| stage | {' | '.join(f'`{name}`' for name in names)} |", "|---" * (1 + len(names)) + "|"]
    for stage in CHOICES:
        rows.append(f"| {stage} | {' | '.join(columns[name][stage] for name in names)} |")
    return "\n".join(rows)


def test_the_documented_tables_are_those_of_the_files():
    told = (DOCS / "variants.md").read_text()
    columns = {name: content(name) for name in variant_names()}
    assert table(columns, PRESETS) in told, table(columns, PRESETS)
    for stage in CHOICES:
        assert f"| `drats_2010_{stage}` | {columns['drats_2010'][stage]} | {columns[f'drats_2010_{stage}'][stage]} |" in told
    for name in set(columns) - set(PRESETS) - set(SINGLE):
        assert f"| `{name}` |" in told


# --- a base -------------------------------------------------------------------------------------------------------------


def written(tmp_path, text, name="mine.toml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_a_base_gives_what_a_file_leaves_out_and_settings_meet_key_by_key(tmp_path):
    mine = 'base = "moses_lake_2008"\nfusion = "flat"\n[settings.survey]\nturn_deg = 9.0\n[settings.sag]\nterrain_raise = 0.1\n'
    found = variant_named(str(written(tmp_path, mine)))
    base = content("moses_lake_2008")
    assert found.content == base | {"fusion": "flat", "settings": found.content["settings"]}
    assert found.content["settings"] == {
        "survey": {"each_step": 12, "turn_deg": 9.0}, "sag": {"terrain_raise": 0.1}, "footfall": {"deviations": 0.0},
    }  # fmt: skip


@pytest.mark.parametrize("name", variant_names())
def test_the_text_that_is_recorded_holds_the_whole_variant(name):
    found = variant_named(name)
    assert isinstance(found, TomlVariant)
    assert tomllib.loads(found.text) == found.content and "base" not in found.content
    if not name.startswith("drats_2010_"):
        assert found.text == found.path.read_text()


def test_infinity_and_lists_survive_and_what_no_variant_holds_is_refused(tmp_path):
    text = 'base = "drats_2010"\n[settings.search]\nfootfall_torque_fraction = inf\n[settings.collision]\npayload_above = [2.2, 1.6, 1.5]\n'
    found = variant_named(str(written(tmp_path, text)))
    assert tomllib.loads(found.text)["settings"]["search"] == {"footfall_torque_fraction": float("inf")}
    path = written(tmp_path, 'base = "drats_2010"\nfusion = 1979-05-27\n')
    with pytest.raises(ConfigError, match=re.escape(f"{path}: holds what no variant holds; keys with texts, numbers, lists")):
        variant_named(str(path))


def test_a_base_must_be_a_whole_variant_of_this_project(tmp_path):
    path = written(tmp_path, 'base = "drats_2011"\n')
    with pytest.raises(ConfigError, match=re.escape(f"{path}: base = 'drats_2011' is no variant of this project; known: blind, ")):
        variant_named(str(path))
    path = written(tmp_path, 'base = "drats_2010_sag"\n')
    with pytest.raises(ConfigError, match=r"base = 'drats_2010_sag' has a base itself; 'drats_2010' would have worked"):
        variant_named(str(path))


# --- names --------------------------------------------------------------------------------------------------------------


def test_an_unknown_name_is_answered_in_one_line_with_all_that_would_have_worked():
    with pytest.raises(ConfigError) as told:
        check_variant("drats_2011")
    text = str(told.value)
    assert text.startswith("variant 'drats_2011' is not known; did you mean 'drats_2010'?; known: blind, ")
    for said in ("moses_lake_2008", "a path ending in .toml", "module:factory", "an entry point of group athlete_twin.planners"):
        assert said in text
    assert len(text.splitlines()) == 1


def test_a_variant_that_no_robot_could_use_is_refused_by_its_file(tmp_path):
    path = written(tmp_path, 'base = "blind"\ngait = "gallop"\n')
    refused = f"{path}: variant mine: gait = 'gallop' is not one of reverse_wave, opposite_pairs, single_steps"
    with pytest.raises(ConfigError, match=re.escape(refused)):
        check_variant(str(path))


PLANNER = '''
from planner.decisions import Waiting

class Idle:
    ground_s, unusable_pairs = 0.0, ()
    def __init__(self, *, spec, goal_in_world, seed, payload_kg, timer):
        self.made_with = (spec, goal_in_world, seed, payload_kg, timer)
    def observe(self, message, t): pass
    def next(self, t): return Waiting(reason="nothing")
    def decide(self, decision, t): return None

class Deaf(Idle):
    observe = None
    def __init__(self, **_): del _

class Shelf:
    idle = Idle

def nothing(**_): return object()
def narrow(spec, seed): return Idle
number = 3
'''


OWN = """
from envs.build import variant_content
from planner.agent import GroundAgent
from planner.config import planner_config

def make(*, spec, **rest):
    return GroundAgent(spec, planner_config(variant_content("blind")[1], spec, name="own"), **rest)
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The folder Python was started in, which forgets what was imported from it."""
    before = set(sys.modules)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]


def test_module_and_factory_make_a_ground_with_all_that_a_trial_knows(here):
    written(here, PLANNER, "idle_one.py")
    spec = load_spec("t12")
    for name in ("idle_one:Idle", "idle_one:Shelf.idle"):
        agent = ground_agent(spec, name, goal=(3.0, 1.0), seed=4, payload_kg=10.0, on_look=print)
        drawn, goal, seed, payload, timer = agent.ground.made_with
        assert (drawn, goal.tolist(), payload) == (spec, [3.0, 1.0], 10.0)
        again = ground_agent(spec, name, goal=(3.0, 1.0), seed=4).ground.made_with[2]
        assert seed == again != 4  # of the trial's, and not the trial's, which draws ground and robot
        with timer("plan"):
            pass


def test_an_entry_point_of_the_group_is_a_name_and_a_shipped_variant_goes_before_it(here, monkeypatch):
    written(here, PLANNER, "idle_two.py")
    declared = [EntryPoint(name, "idle_two:Idle", variants.GROUP) for name in ("idler", "blind")]
    monkeypatch.setattr(variants, "entry_points", lambda *, group: [e for e in declared if e.group == group])
    found = variant_named("idler")
    assert isinstance(found, OutsidePlanner) and found.reference == "idler" and len(found.sha256) == 64
    assert isinstance(variant_named("blind"), TomlVariant)
    check_variant("idler")
    with pytest.raises(ConfigError, match=r"'idle' is not known; did you mean 'idler'\?; known: blind, .*, idler, or a path"):
        variant_named("idle")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("nowhere_at_all:make", r"no module 'nowhere_at_all', neither installed nor in .*, where Python was started"),
        ("idle_three.deeper:make", r"no module 'idle_three.deeper'|'idle_three' is not a package"),
        ("idle_three:Idel", r"module 'idle_three' has no 'Idel'; it defines Idle, Deaf, Shelf, nothing, narrow"),
        ("idle_three:number", r"'number' is of type int; a function or class would have worked"),
        ("idle_three:narrow", r"'narrow' must take the keywords spec, goal_in_world, seed, payload_kg, timer: got an unexpected"),
        ("idle_three:", r"'idle_three:' is not module:factory, such as my_planner:make"),
        ("broken_one:make", r"module 'broken_one' cannot be imported: ZeroDivisionError: division by zero \(.*broken_one.py:2\)"),
        ("broken_two:make", r"module 'broken_two' cannot be imported: ModuleNotFoundError: No module named 'no_such_dependency'"),
        ("broken_three:make", r"module 'broken_three' cannot be imported: SyntaxError: "),
    ],
)
def test_what_is_wrong_with_a_planner_from_outside_is_told_in_one_line(here, name, said):
    written(here, PLANNER, "idle_three.py")
    written(here, "\n1 / 0\n", "broken_one.py")
    written(here, "import no_such_dependency\n", "broken_two.py")
    written(here, "def make(:\n", "broken_three.py")
    with pytest.raises(ConfigError, match=said) as told:
        check_variant(name)
    assert str(told.value).startswith(f"variant {name!r}: ") and len(str(told.value).splitlines()) == 1


def test_what_a_factory_returns_must_be_a_ground(here):
    written(here, PLANNER, "idle_four.py")
    with pytest.raises(ConfigError, match=r"its factory returned a object without ground_s, unusable_pairs, observe\(\), next\(\), decide"):
        ground_agent(load_spec("sdm_b"), "idle_four:nothing", goal=(1.0, 0.0), seed=0)
    with pytest.raises(ConfigError, match=r"returned a Deaf without observe\(\); a planner.decisions.GroundAgent has ground_s"):
        ground_agent(load_spec("sdm_b"), "idle_four:Deaf", goal=(1.0, 0.0), seed=0)


def test_a_file_here_shadows_nothing_that_is_installed(here):
    written(here, "raise RuntimeError\n", "colorsys.py")
    with pytest.raises(ConfigError, match=r"must take the keywords"):
        check_variant("colorsys:rgb_to_hsv")
    assert sys.path[-1] == str(here)


def test_a_planner_from_outside_has_no_toml(here):
    written(here, PLANNER, "idle_five.py")
    with pytest.raises(ConfigError, match=r"'idle_five:Idle' is a planner from outside and has no TOML file"):
        variant_content("idle_five:Idle")


def test_an_agent_of_ones_own_with_our_eyes_tells_of_its_looks(here):
    written(here, OWN, "own_one.py")
    seen: list[Look] = []
    agent = ground_agent(load_spec("sdm_b"), "own_one:make", goal=(3.0, 0.0), seed=0, on_look=seen.append)
    assert agent.ground.eyes.on_look == seen.append


def test_a_planner_from_outside_is_charged_by_the_same_table_as_ours(here):
    """2 s a proposal or uplink, 1 s a stereo pair, whatever it says of itself; more where it says more."""
    written(here, OWN, "own_two.py")
    spec = load_spec("sdm_b")
    agent = ground_agent(spec, "own_two:make", goal=(3.0, 0.0), seed=0)
    assert isinstance(agent, ChargedGround) and agent.ground_s == 0.0
    for message in MockAthlete(spec).advance(1.0):
        agent.observe(message, 1.0)
    proposal = agent.next(1.0)
    assert isinstance(proposal, Proposal) and agent.ground_s == SECONDS_PER_PLAN
    assert agent.next(2.0) is proposal and agent.ground_s == SECONDS_PER_PLAN
    agent.ground._ground_s = 50.0
    assert agent.ground_s == 50.0


# --- the worked example -------------------------------------------------------------------------------------------------


def example() -> str:
    (code,) = re.findall(r"```python\n(.*?)```", (DOCS / "outside_planner.md").read_text(), flags=re.DOTALL)
    return code


@pytest.fixture
def driver(here):
    written(here, example(), "my_planner.py")
    return "my_planner:Driver"


def test_the_example_is_short(driver):
    assert 25 <= len(example().splitlines()) <= 35


def wanted(robot, variant, **changes) -> Wanted:
    values = {
        "robot": robot, "scenario": GROUNDS[robot], "variant": variant, "seed": 0, "operator": "approve_all", "up": uplink(1.0),
        "down": uplink(1.0), "cycles": 1, "body": "mock",
    }  # fmt: skip
    return Wanted(**(values | changes))


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("robot", ROBOTS)
def test_the_example_reaches_the_goal_of_a_trial(driver, robot, tmp_path):
    result = prepared(wanted(robot, driver), tmp_path / "out").run()
    assert (result.outcome, result.variant, result.collisions) == ("goal_reached", driver, 0)
    assert result.map_error_m["median"] is None and result.leg_mask["recall"] is None


def test_a_recording_of_it_is_run_again_and_says_when_the_planner_is_not_the_same(driver, here):
    first = prepared(wanted("sdm_b", driver, time_limit=3.0), here / "first")
    first.run()
    recording = here / "first" / "trial.mcap"
    origin = recorded_origin(recording)
    assert (origin.planner, origin.variant_toml, origin.variant_path) == (driver, "", "")
    assert origin.planner_sha256 == variant_named(driver).sha256 and changed_since(origin, map_file=None)[0] == []
    assert rerun(recording, origin, here / "second").equal
    written(here, example() + "\n# another line\n", "my_planner.py")
    assert changed_since(origin, map_file=None)[0] == ["planner my_planner:Driver: its source has changed"]
    (here / "my_planner.py").unlink()
    del sys.modules["my_planner"]
    (line,) = changed_since(origin, map_file=None)[0]
    assert "no module 'my_planner', neither installed nor in" in line
    with pytest.raises(ConfigError, match="no module 'my_planner'"):
        again(origin, here / "third")


def test_a_recording_holds_a_variants_base_as_well(tmp_path):
    trial = prepared(wanted("sdm_b", "drats_2010_gait", time_limit=1.0), tmp_path)
    trial.run()
    origin = recorded_origin(tmp_path / "trial.mcap")
    assert tomllib.loads(origin.variant_toml) == content("drats_2010_gait")
    assert origin.planner == "" and "planner" not in origin.metadata()


# --- every variant walks ------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", ["moses_lake_2008", "drats_2010"])
def test_the_historical_variants_walk_the_mock_a_gait_cycle(name, robot, tmp_path):
    result = prepared(wanted(robot, name), tmp_path).run()
    assert (result.outcome, result.gait_cycles, result.steps_taken, result.faults) == ("cycles_done", 1, 6, 0), result.reason
    assert result.progress_m > 0.8 * load_spec(robot).stride


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("name", SINGLE)
def test_every_single_change_walks_the_mock(name, robot, tmp_path):
    result = prepared(wanted(robot, name, time_limit=400.0), tmp_path).run()
    assert result.outcome in ("time_limit", "cycles_done"), result.reason
    assert result.steps_taken >= 1 and result.progress_m > 0.05
