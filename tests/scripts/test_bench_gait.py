"""The gait benchmark: the paper's figure 16, rows of one shape, the picture, bad usage, and a cycle that the twin walks."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def figures(script):
    return script("gait_figures")


@pytest.fixture(scope="module")
def bench(script):
    return script("bench_gait")


def test_two_opposite_legs_in_the_air_ask_less_of_the_joints_than_one_as_in_figure_16(figures):
    """[SunSpiral2012] figure 16: 50.28 % of the limit with the front leg up, 43.43 % with the front and the back leg."""
    gaits = figures.Gaits("sdm_b")
    assert 100.0 * gaits.lifted((0,)) == pytest.approx(50.28, abs=1.0)
    assert 100.0 * gaits.lifted((0, 3)) == pytest.approx(43.43, abs=1.0)
    for legs in ((0,), (0, 3)):
        assert gaits.loads(legs).sum() == pytest.approx(gaits.spec.mass * 9.80665, rel=1e-3)
        assert (gaits.loads(legs)[list(legs)] == 0.0).all()


@pytest.mark.slow
def test_rows_say_what_ended_a_stride(figures):
    rows = figures.Gaits("sdm_b").strides()
    assert len(rows) == 8 and all("ended by: leg" in r["name"] and 0.5 < r["ours"] < 1.5 for r in rows)


@pytest.mark.slow
def test_picture_is_drawn(script, figures, tmp_path):
    path = script("gait_pictures").draw(figures.Gaits("sdm_b"), tmp_path / "deep" / "gait.png")
    assert path.stat().st_size > 30_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robots", "sdm_x"], "sdm_x"),
        (["--parts", "ears"], "part 'ears' is not one of strides, sway, slopes, steps, twin, strides_twin, slopes_twin, steps_twin"),
        (["--obstacles", "river"], "obstacle 'river' is not one of ledge, ditch, wall"),
        (["--seed", "-1"], "--seed -1 is negative"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(bench, capsys, arguments, message):
    assert bench.main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.strip().splitlines()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_the_twin_walks_a_cycle_of_opposite_pairs_as_planned(script, figures, robot):
    gaits, yard = figures.Gaits(robot), script("gait_yard").GaitYard(robot, 0)
    try:
        walked = yard.walk(gaits.pairs)
    finally:
        yard.close()
    assert walked.ended_by == ""
    assert walked.advance == pytest.approx(gaits.stride, rel=0.1)
    assert np.isfinite(walked.torques).all() and walked.peak < 1.0


@pytest.mark.slow
def test_the_twin_climbs_14_degrees_with_the_deck_level_and_slides_less_than_the_paper_saw(script, figures):
    """[SunSpiral2012] s5.3.4: SDM-B slid by less than 5 cm at times."""
    twin = script("gait_twin")
    found = twin.walk_slope(figures.Gaits("sdm_b"), 0, 14.0, "level", twin.SAND, 0.6)
    assert found.walked.ended_by == "" and found.walked.struck == ()
    assert found.walked.advance == pytest.approx(0.6, rel=0.15)
    assert found.walked.peak < 1.0 and found.walked.slip < 0.05


@pytest.mark.slow
def test_the_twin_climbs_onto_a_ledge(script, figures):
    steps, gaits = script("gait_steps"), figures.Gaits("sdm_b")
    crossing = steps.planned_crossing(gaits, steps.ledge(0.4))
    walked = steps.walk_crossing(gaits, "ledge", crossing, 0)
    assert walked.ended_by == "" and walked.struck == () and walked.steps == len(crossing.steps)
    # The chassis is higher by the ledge, and no joint saturates.
    assert walked.poses[-1].translation[2] - crossing.begin.translation[2] > 0.2
    assert np.nanmax(walked.torques) < 1.0


@pytest.mark.slow
def test_a_wheel_feels_less_in_a_swing_without_jumps_and_the_guard_is_far(script, figures):
    most, mean, duration = script("swing_twin").swing_rows(figures.Gaits("sdm_b"), 0)
    assert most["ratio"] < 1.0 and most["ours"] < 2.0  # of 3 % at which the guard stops
    assert mean["ours"] < most["ours"] and 1.0 < duration["ratio"] < 1.1
