"""The frozen set of leg problems, and the bench of planners on it."""

import json

import numpy as np
import pytest
from ompl import tools as ompl_tools

from athlete_twin.errors import AssetError
from planner.motion.checker import CountingChecker
from planner.motion.planners import plan
from planner.motion.sbl import NoPath, SblConfig


@pytest.fixture(scope="module")
def problems(script):
    return script("leg_problems").load_problems()


def test_the_set_is_the_one_that_was_frozen(problems):
    assert [sum(p.robot == robot for p in problems) for robot in ("sdm_b", "t12")] == [250, 250]
    assert {p.level for p in problems} == {0, 1, 2, 3, 4} and {p.leg for p in problems} == set(range(6))


def test_a_set_that_was_touched_is_refused(script, problems, tmp_path):
    module = script("leg_problems")
    module.save_problems(problems[:3], tmp_path)
    again = module.load_problems(tmp_path)
    for one, other in zip(problems[:3], again, strict=True):
        assert one.start.tobytes() == other.start.tobytes() and one.rocks.tobytes() == other.rocks.tobytes()
        assert one.terrain().heights.tobytes() == other.terrain().heights.tobytes()
        np.testing.assert_allclose(one.world_from_hex.matrix(), other.world_from_hex.matrix(), atol=1e-15)
    (tmp_path / module.HASH_FILE).write_text("0" * 64 + "\n")
    with pytest.raises(AssetError, match="frozen was 000000000000"):
        module.load_problems(tmp_path)
    with pytest.raises(AssetError, match=r"is missing; run scripts/build_leg_problems\.py"):
        module.load_problems(tmp_path / "nowhere")


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.slow
@pytest.mark.ci
def test_ends_are_free_simple_ways_fail_on_most_and_another_planner_solves_them(script, problems, robot):
    """Every tenth; the shares have the set's own bound within the spread of so few."""
    build = script("build_leg_problems")
    own = [p for p in problems if p.robot == robot]
    simple = []
    for k, p in enumerate(own[::10]):
        collision, (lower, upper) = p.collision(), p.box()
        assert collision.is_free(p.start) and collision.is_free(p.goal)
        simple.append((build.passes_straight(p, collision), build.passes_over(p, collision)))
        if k % 10 == 0:
            found = plan("rrtconnect", p.start, p.goal, lower, upper, collision.is_free, np.random.default_rng(k), SblConfig())
            assert not isinstance(found, NoPath)
    assert np.mean(simple, axis=0).max() <= 0.40 + 2.0 * np.sqrt(0.4 * 0.6 / len(simple))


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_sbl_solves_the_set_and_the_simple_ways_fail_on_sixty_percent(script, problems, robot):
    build = script("build_leg_problems")
    own = [p for p in problems if p.robot == robot]
    simple, solved = [], 0
    for k, p in enumerate(own):
        collision, (lower, upper) = p.collision(), p.box()
        simple.append((build.passes_straight(p, collision), build.passes_over(p, collision)))
        found = plan("sbl", p.start, p.goal, lower, upper, CountingChecker(collision.is_free), np.random.default_rng([0, k]), SblConfig())
        solved += not isinstance(found, NoPath)
    assert np.mean(simple, axis=0).max() <= 0.40
    assert solved >= 0.99 * len(own)


@pytest.mark.slow
def test_the_generator_makes_the_sets_first_problems_again(script, problems):
    from rich.progress import Progress

    with Progress(disable=True) as progress:
        made = script("build_leg_problems").collect("t12", 4, 0, progress)
    for one, frozen in zip(made, [p for p in problems if p.robot == "t12"], strict=False):
        assert one.leg == frozen.leg and one.level == frozen.level
        np.testing.assert_allclose(one.goal, frozen.goal, atol=1e-9)


@pytest.mark.slow
def test_the_bench_prints_its_rows_and_a_log_that_ompl_reads(script, tmp_path, capsys):
    log = tmp_path / "motion.log"
    assert script("bench_motion").main(["--problems", "1", "--planners", "sbl", "rrtconnect", "--log", str(log), "--json"]) == 0
    table = json.loads(capsys.readouterr().out)
    rows = {r["name"]: r for r in table["rows"]}
    assert rows["sbl, 2 problems: solved"]["ours"] == 1.0
    assert rows["sbl: time to plan, median"]["peer_name"] == "rrtconnect"
    for robot in ("sdm_b", "t12"):
        swing = rows[f"{robot}, 1 swings: duration, mean"]
        assert 0.9 < swing["ratio"] < 1.5 and swing["peer_name"] == "constant speed, with jumps"
        assert rows[f"{robot}, 1 swings: acceleration commanded, largest"]["met"]
        assert rows[f"{robot}, 1 swings: duration where toppra finds one (1), mean"]["met"]
    database = tmp_path / "motion.db"
    ompl_tools.readBenchmarkLog(str(database), [str(log)], False)
    import sqlite3

    with sqlite3.connect(database) as read:
        planners = {name for (name,) in read.execute("SELECT name FROM plannerConfigs")}
        solved, length = read.execute("SELECT SUM(solved), AVG(solution_length) FROM runs").fetchone()
    assert planners == {"geometric_SBL_ours", "geometric_RRTConnect"}
    assert solved == 4 and length > 0.0


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--planners", "prm"], "known: sbl, rrtconnect"),
        (["--problems", "0"], "need 1 or more"),
        (["--robots", "spot"], "known: sdm_b, t12"),
    ],
)
def test_wrong_use_is_one_line(script, capsys, arguments, told):
    assert script("bench_motion").main(arguments) == 2
    err = capsys.readouterr().err
    assert told in err and err.count("\n") == 1
