"""The sag benchmark: what it makes of readings whose springs are known, a real robot on the yard, bad usage."""

import json

import numpy as np
import pytest

from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from planner.sag.docked import docked_pieces
from planner.sag.identify import MeasuredStance, predict_heights
from planner.sag.identify_docks import predict_docked_heights
from planner.sag.sag_model import AIRBORNE, solve_sag

KEYS = {"name", "ours", "unit", "peer_name", "peer", "ratio", "target", "met"}
SPRINGS = {"sdm_b": 24e3 * np.array([1.1, 0.9, 1.0, 1.05, 0.95, 1.0]), "t12": np.full(6, 60e3)}
TYRE = {"sdm_b": 30e3, "t12": 80e3}
TWIST = 5e5


@pytest.fixture(scope="module")
def bench(script):
    return script("bench_sag")


@pytest.fixture(scope="module")
def figures(script):
    return script("sag_figures")


def reading(script, robot, lifted, rng):
    """A stance on springs of known constants, docks that twist, read without error."""
    spec, kin = load_spec(robot), kinematics(robot)
    joints = regular_stance(spec) + rng.normal(0.0, 0.01, (6, spec.dof))
    feet = kin.wheels_in_hex(joints) - [0.0, 0.0, spec.wheel.radius]
    lifts = feet[:, 2] + spec.chassis_height
    lifts[list(lifted)] = AIRBORNE

    def stance(heights):
        return MeasuredStance(
            feet_in_hex=feet, com_in_hex=kin.com_in_hex(joints), weight=spec.mass * GRAVITY, lifts=lifts,
            corners_in_hex=np.array(spec.hips_in_hex), heights=heights, origin_height=spec.chassis_height,
        )  # fmt: skip

    blank = stance(np.zeros(6))
    if spec.decks:
        pieces = docked_pieces(kin, joints)
        heights = predict_docked_heights(
            blank, pieces, stiffness=float(SPRINGS[robot][0]), twist_stiffness=TWIST, lateral_ratio=0.5
        )
    else:
        heights = predict_heights(blank, stiffness_z=SPRINGS[robot], lateral_ratio=0.5)
    sag = solve_sag(feet, blank.com_in_hex, blank.weight, stiffness_z=SPRINGS[robot], lateral_ratio=0.5, lifts=lifts)
    axles = spec.wheel.radius - np.linalg.norm(sag.forces, axis=1) / TYRE[robot]
    return script("sag_yard").Reading(stance=stance(heights), lifted=lifted, motors=joints, axle_heights=axles)


@pytest.fixture(scope="module", params=["sdm_b", "t12"])
def individual(script, request):
    stances = script("sag_stances")
    rng = np.random.default_rng(2)
    known = tuple(reading(script, request.param, lifted, rng) for lifted in stances.CALIBRATION)
    random = tuple(reading(script, request.param, lifted, rng) for lifted in ((), (1,), (0, 3)))
    rising = np.linspace(0.0, 0.4, 50)
    curves = tuple(
        script("sag_lifts").LiftCurve(leg=leg, commanded=rising, clearance=rising - 0.12, leaves_at=0.12, touches_at=0.12)
        for leg in range(6)
    )
    return stances.Individual(robot=request.param, seed=0, calibration=known, random=random, refused=(), curves=curves)


@pytest.fixture(scope="module")
def found(figures, individual):
    return figures.calibrated(individual)


def test_springs_that_made_the_readings_are_found(found):
    robot = found.individual.robot
    assert found.tyre == pytest.approx(TYRE[robot], rel=0.02)
    if robot == "sdm_b":
        np.testing.assert_allclose(found.wheels.stiffness_z, SPRINGS[robot], rtol=0.02)
        assert np.abs(found.errors["wheels"]).max() < 1e-3 < np.abs(found.errors["one"]).max()
        assert found.docks is None
    else:
        assert found.docks.stiffness == pytest.approx(60e3, rel=0.02)
        assert found.docks.twist_stiffness == pytest.approx(TWIST, rel=0.05)
        assert np.abs(found.errors["docks"]).max() < 1e-3 < np.abs(found.errors["one"]).max()


def test_rows_have_the_benchmarks_shape_and_lifts_are_scored(figures, found):
    rows = {r["name"]: r for r in figures.rows([found])}
    assert all(set(r) == KEYS for r in rows.values())
    none = next(r for name, r in rows.items() if name.endswith("none: lift-off height, mean error"))
    assert none["ours"] == pytest.approx(0.12)
    raised = next(r for name, r in rows.items() if "raise_terrain: true clearance" in name)
    assert raised["ours"] == pytest.approx(0.13)  # 0.10 m wanted and 0.15 m of raise, less the 0.12 m that contact takes


def test_picture_is_drawn(script, found, tmp_path):
    path = script("sag_pictures").draw(found, tmp_path / "deep" / "sag.png")
    assert path.stat().st_size > 20_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robots", "sdm_x"], "sdm_x"),
        (["--individuals", "0"], "--individuals and --stances must be at least 1"),
        (["--parts", "ears"], "part 'ears' is not one of sag, pose, speed"),
    ],
)
def test_bad_usage_is_one_line_and_exit_status_2(bench, capsys, arguments, message):
    assert bench.main(arguments) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1


@pytest.mark.slow
@pytest.mark.ci
def test_a_robot_on_the_yard_is_read_as_it_stands(script):
    """Three stances of one individual: what is read is the truth within the instrument's error, refusals are told."""
    yards = script("sag_yard")
    yard = yards.SagYard("sdm_b", 7)
    try:
        standing = yard.read()
        assert standing.standing.all()
        truth = np.array([yard.robot.link_poses()[f"leg{k + 1}_hip_yaw"].translation[2] for k in range(6)])
        assert np.abs(standing.stance.heights - truth).max() < 5.0 * yards.INSTRUMENT_SIGMA
        assert (yard.robot.truth().wheel_loads > 500.0).all()
        yard.raise_leg(2, 0.35)
        lifted = yard.read()
        assert lifted.lifted == (2,) and yard.robot.truth().wheel_loads[2] == 0.0
        assert lifted.stance.lifts[2] == pytest.approx(0.35, abs=0.01)
        assert lifted.stance.heights[2] < standing.stance.heights[2] - 0.03
        yard.put_down(2)
        assert (yard.robot.truth().wheel_loads > 300.0).all()
        with pytest.raises(yards.StanceRefusedError, match="cannot put its wheel"):
            yard.raise_leg(0, 3.0)
    finally:
        yard.close()


@pytest.mark.slow
def test_the_script_prints_json(bench, capsys):
    assert bench.main(["--robots", "sdm_b", "--individuals", "1", "--stances", "2", "--parts", "sag", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["rows"] and all(set(r) == KEYS for r in printed["rows"])
