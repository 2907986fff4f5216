"""The stability benchmark: brute force knows what it says, rows of one shape, the picture, bad usage."""

import numpy as np
import pytest

from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance

KEYS = {"name", "ours", "unit", "peer_name", "peer", "ratio", "target", "met"}
DOWN = np.array([0.0, 0.0, -1.0])


@pytest.fixture(scope="module")
def bench(script):
    return script("bench_stability")


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_brute_force_reaches_what_the_closed_form_puts_there_and_nothing_beyond(script, robot):
    oracle, spec = script("stability_oracle"), load_spec(robot)
    kin, rng = Kinematics(spec), np.random.default_rng(0)
    hip = spec.hips_in_hex[4]
    outward = np.array([np.cos(spec.hip_azimuths[4]), np.sin(spec.hip_azimuths[4]), 0.0])
    place = hip + 0.5 * spec.foot_radius * outward - [0.0, 0.0, 0.8 * spec.chassis_height]
    assert leg_ik(spec, 4, place[None])[1][0]
    assert oracle.reaches(kin, 4, place, DOWN, rng=rng)
    assert not oracle.reaches(kin, 4, hip + 20.0 * outward, DOWN, rng=rng)


def test_a_patient_search_finds_a_leg_that_is_turned_back_under_the_chassis(script):
    """Pinocchio has the wheel there within limits: a search that denies it errs, and more starts mend that."""
    oracle, spec = script("stability_oracle"), load_spec("sdm_b")
    kin, azimuth = Kinematics(spec), spec.hip_azimuths[0] + np.deg2rad(-166.0)
    place = spec.hips_in_hex[0] + np.array([0.9 * np.cos(azimuth), 0.9 * np.sin(azimuth), 0.2 - 0.8 * spec.chassis_height])
    angles, there = leg_ik(spec, 0, place[None])
    assert there[0] and ((angles >= spec.lower) & (angles <= spec.upper)).all()
    np.testing.assert_allclose(kin.leg_wheel(0, angles[0]).translation, place, atol=1e-6)
    assert oracle.reaches(kin, 0, place, DOWN, rng=np.random.default_rng(0), starts=oracle.PATIENT_STARTS)


def test_rows_have_the_benchmarks_shape(script):
    rows = script("stability_figures").rows(robots=("sdm_b",), cells=4)
    assert all(set(r) == KEYS for r in rows)
    assert sum(r["ours"] for r in rows if "share of cells" in r["name"]) == pytest.approx(1.0)


def test_a_stance_that_nothing_holds_is_a_no_with_its_reason(script):
    """Three neighbouring wheels have the centre of mass outside: forces that only push cannot hold it."""
    figures, spec = script("stability_figures"), load_spec("sdm_b")
    kin, joints = Kinematics(spec), regular_stance(spec)
    refused, held = (
        figures._best_forces("sdm_b", kin, joints, np.isin(np.arange(6), legs), "three legs up") for legs in ((0, 1, 2), (0, 2, 4))
    )
    assert set(refused) == KEYS
    assert refused["ours"] is None and refused["met"] is False and "no pushing forces within friction 0.5 on 3 wheels" in refused["name"]
    assert 0.0 < held["ours"] <= held["peer"] and held["met"] is True


def test_picture_is_drawn(bench, tmp_path):
    bench._draw("sdm_b", 1, tmp_path / "deep")
    assert (tmp_path / "deep" / "stability_sdm_b.png").stat().st_size > 30_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robots", "sdm_x"], "sdm_x"),
        (["--cells", "0"], "--cells must be at least 1"),
        (["--parts", "ears"], "part 'ears' is not one of map, footfalls"),
    ],
)
def test_bad_usage_is_one_line_and_exit_status_2(bench, capsys, arguments, message):
    assert bench.main(arguments) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1
