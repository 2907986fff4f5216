"""The sag benchmark: what it makes of readings whose springs are known, a real robot on the yard, bad usage."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from athlete_twin.errors import SagError
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from planner.sag.docked import docked_pieces
from planner.sag.identify import MeasuredStance, predict_heights
from planner.sag.identify_docks import predict_docked_heights
from planner.sag.lift_pose import NoPose
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


@pytest.fixture(scope="module", params=["sdm_b", pytest.param("t12", marks=pytest.mark.slow)])
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


class Refusing:
    """A yard on which nothing is measured; it does not lift one leg, for one way of being asked."""

    def __init__(self, spec, seed, *, leg, slowly, stances):
        self.spec, self.seed, self.lifted, self._refuses = spec, seed, (), (leg, slowly)
        self._stances, self._refused = stances, stances.StanceRefusedError

    def raise_leg(self, leg, by, *, slow=1.0, watch=None):
        if (leg, slow < 1.0) == self._refuses:
            raise self._refused(f"leg {leg + 1} asks 112 % of its knee")

    def put_down(self, leg, **_):
        pass

    def level(self, **_):
        pass

    def close(self):
        pass


@pytest.fixture
def refusing(script, individual, monkeypatch):
    """Makes robots of the script refuse to lift a leg; what they do is read from another individual."""
    stances = script("sag_stances")

    def make(*, leg, slowly):
        def yard(robot, seed):
            return Refusing(load_spec(robot), seed, leg=leg, slowly=slowly, stances=stances)

        def read_lifted(yard, legs):
            for lifted in legs:
                yard.raise_leg(lifted, 0.3)
            return individual.calibration[stances.CALIBRATION.index(legs)]

        def curve(yard, lifted, *, by):
            yard.raise_leg(lifted, by, slow=0.1)
            return individual.curves[lifted]

        monkeypatch.setattr(stances, "SagYard", yard)
        monkeypatch.setattr(stances, "_read_lifted", read_lifted)
        monkeypatch.setattr(stances, "lift_curve", curve)
        monkeypatch.setattr(stances, "_random_readings", lambda yard, count: (individual.random, ()))

    return make


def _printed(bench, capsys, *arguments):
    assert bench.main([*arguments, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert all(set(r) == KEYS for r in rows)
    return rows, [r for r in rows if r["met"] is False and "112 % of its knee" in r["name"]]


def test_an_individual_that_refuses_a_calibration_stance_is_a_row_and_costs_no_others(bench, individual, refusing, capsys, monkeypatch):
    refusing(leg=2, slowly=False)
    monkeypatch.setattr(bench.sag_speed, "rows", lambda robots: [bench.sag_figures.row("speed of the rest", 1.0, "ms")])
    rows, refused = _printed(
        bench, capsys, "--robots", individual.robot, "--individuals", "1", "--parts", "sag", "speed"
    )
    (no,) = refused
    assert no["name"].startswith(f"{individual.robot}, individual 0: calibrated: no, stance with legs lifted: 3")
    assert any(r["name"] == "speed of the rest" for r in rows)


def test_a_leg_that_does_not_lift_slowly_is_a_row_and_the_others_are_scored(bench, individual, refusing, capsys):
    refusing(leg=4, slowly=True)
    rows, refused = _printed(bench, capsys, "--robots", individual.robot, "--individuals", "1", "--parts", "sag")
    (no,) = refused
    assert "lifted slowly: no, leg 5: leg 5 asks 112 %" in no["name"]
    assert any(r["name"].startswith(f"{individual.robot}, 5 lifts, springs") for r in rows)


def test_springs_that_cannot_be_found_are_a_row(bench, individual, refusing, capsys, monkeypatch):
    refusing(leg=0, slowly=None)

    def lost(_):
        raise SagError("no constant holds all 10 stances: 112 % of its knee")

    monkeypatch.setattr(bench.sag_figures, "calibrated", lost)
    _, refused = _printed(bench, capsys, "--robots", individual.robot, "--individuals", "1", "--parts", "sag")
    assert "springs found: no, no constant holds" in refused[0]["name"]


def test_a_leg_without_a_pose_before_its_lift_is_a_row_and_the_others_are_compared(script, monkeypatch):
    pose = script("sag_pose")

    def lifted(robot, seed, leg, *, optimise):
        if leg == 1 and optimise:
            raise pose.NoPoseError("no pose from the normal stance: reach of leg 2")
        if leg == 3 and not optimise:
            raise pose.StanceRefusedError("leg 4 asks 112 % of its knee")
        return pose.Lifted(tilt=0.01 * (leg + 1), sink=0.0, clearance=0.0, peak_load=1000.0)

    monkeypatch.setattr(pose, "_lifted", lifted)
    rows = pose.rows(robots=("sdm_b",))
    assert [r["met"] for r in rows[:2]] == [False, False]
    assert "leg 2 lifted" in rows[0]["name"] and "reach of leg 2" in rows[0]["name"] and "112 %" in rows[1]["name"]
    tilt = next(r for r in rows if "tilt" in r["name"])
    assert tilt["ours"] == pytest.approx((0.01 + 0.03 + 0.05 + 0.06) / 4) and "one of 4 legs up" in tilt["name"]


def test_a_pose_that_is_not_found_is_a_named_error(script, monkeypatch):
    pose = script("sag_pose")
    spec = load_spec("sdm_b")

    class Yard:
        kin, motors = kinematics("sdm_b"), regular_stance(spec)

        def __init__(self, robot, seed):
            self.spec = load_spec(robot)

        def close(self):
            pass

    monkeypatch.setattr(pose, "SagYard", Yard)
    monkeypatch.setattr(pose, "optimise_pose", lambda *_, **__: NoPose(reason="reach of leg 1"))
    with pytest.raises(pose.NoPoseError, match="no pose from the normal stance: reach of leg 1"):
        pose._lifted("sdm_b", 0, 0, optimise=True)


def test_a_wheel_that_never_bears_is_refused_by_name(script):
    lifts = script("sag_lifts")

    class Robot:
        def truth(self):
            return SimpleNamespace(
                motors=regular_stance(load_spec("sdm_b")), wheels_in_world=np.ones((6, 3)), wheel_loads=np.zeros(6)
            )

        terrain = SimpleNamespace(grid=SimpleNamespace(sample=lambda xy: np.zeros(len(xy))))

    class Yard:
        spec, kin, robot, up_in_hex = load_spec("sdm_b"), kinematics("sdm_b"), Robot(), np.array([0.0, 0.0, 1.0])

        def raise_leg(self, leg, by, *, slow, watch):
            watch(self.robot.truth())

        def put_down(self, leg, *, slow, watch):
            watch(self.robot.truth())

    with pytest.raises(lifts.StanceRefusedError, match="bore no load on its way up"):
        lifts.lift_curve(Yard(), 0, by=0.35)


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
