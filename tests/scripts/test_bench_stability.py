"""The stability benchmark: brute force knows what it says, rows of one shape, the picture, bad usage."""

import numpy as np
import pytest

from athlete_twin.errors import SupportError
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


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_a_last_link_that_may_lean_is_a_search_between_plumb_and_any(script, robot):
    """Within a few degrees of plumb a leg reaches a little farther; the angle it is found with is within them."""
    oracle, spec = script("stability_oracle"), load_spec(robot)
    kin, azimuth = Kinematics(spec), spec.hip_azimuths[2]
    outward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    middle = spec.hips_in_hex[2] - [0.0, 0.0, 0.8 * spec.chassis_height]
    far = next(d for d in np.arange(0.5, 9.0, 0.02) if not leg_ik(spec, 2, (middle + d * outward)[None])[1][0])
    rng = np.random.default_rng(1)
    asked = {lean: oracle.reaches(kin, 2, middle + (far + 0.03) * outward, DOWN, rng=rng, lean_deg=lean) for lean in (0.0, 10.0)}
    assert asked == {0.0: False, 10.0: True}


def test_the_legs_of_the_search_are_the_robots(script):
    """The slopes it hands to the search are those of the residual, by finite differences of the whole robot."""
    oracle = script("stability_oracle")
    for robot in ("sdm_b", "t12"):
        spec, kin = load_spec(robot), Kinematics(load_spec(robot))
        q = np.random.default_rng(2).uniform(spec.lower, spec.upper)
        for leg in range(6):
            model, data, frame = oracle._one_leg(kin, leg)
            jacobian = oracle.pin.computeFrameJacobian(model, data, q, frame, oracle.pin.LOCAL_WORLD_ALIGNED)
            steps = 1e-6 * np.eye(spec.dof)
            slopes = [(kin.leg_wheel(leg, q + d).translation - kin.leg_wheel(leg, q - d).translation) / 2e-6 for d in steps]
            np.testing.assert_allclose(jacobian[:3].T, slopes, atol=1e-6)


def test_whatever_the_first_search_denies_is_searched_again_whoever_claims_what(script, monkeypatch):
    figures, scenes = script("stability_figures"), script("stability_scene")
    scene = scenes.stability_scene("sdm_b", 0)
    maps = figures.ground_maps(
        scene.kinematics, scene.joints, terrain=scene.terrain, world_from_hex=scene.world_from_hex,
        config=scene.config(collision=False), footfalls=scene.footfalls,
    )  # fmt: skip
    monkeypatch.setattr(figures, "reaches", lambda *_, starts, **__: starts == figures.PATIENT_STARTS)
    found = figures.against_oracle(scene, maps, cells=40, seed=0)
    assert found.plumb.all() and found.again.all()
    assert 0 < found.ours.sum() < 40


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.slow
@pytest.mark.ci
def test_a_tilted_scene_stands_on_the_same_ground(script, robot):
    scenes = script("stability_scene")
    level, tilted = (scenes.stability_scene(robot, 0, roll_deg=r, pitch_deg=p) for r, p in ((0.0, 0.0), (4.0, 3.0)))
    wheels = [s.world_from_hex.apply(s.kinematics.wheels_in_hex(s.joints)) for s in (level, tilted)]
    np.testing.assert_allclose(*wheels, atol=1e-6)
    assert (level.tilt_deg, tilted.tilt_deg) == pytest.approx((0.0, 5.0), abs=0.01)
    with pytest.raises(SupportError, match=r"of (sdm_b|t12) does not reach its place on a chassis tilted so far; tilt it less"):
        scenes.stability_scene(robot, 0, roll_deg=60.0)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_the_map_calls_reachable_what_brute_force_reaches_and_little_less(script, robot):
    """Its two bounds, on a level chassis: 0.5 % of what it claims, 3 % of what there is."""
    figures = script("stability_figures")
    scene = script("stability_scene").stability_scene(robot, 1)
    maps = figures.ground_maps(
        scene.kinematics, scene.joints, terrain=scene.terrain, world_from_hex=scene.world_from_hex,
        config=scene.config(collision=False), footfalls=scene.footfalls,
    )  # fmt: skip
    found = figures.against_oracle(scene, maps, cells=150, seed=1)
    assert min(found.ours.sum(), found.plumb.sum()) > 60
    assert (found.ours & ~found.plumb).sum() <= 0.005 * found.ours.sum()
    assert (found.plumb & ~found.ours).sum() <= 0.03 * found.plumb.sum()


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.ci
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
