import numpy as np
import pytest

from athlete_twin.errors import SagError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.stance import regular_stance
from planner.sag.compensate import SagConfig, lift_to_break_contact, predict_sag
from planner.sag.sag_model import FootSprings, solve_sag

R, K, W = 1.95, 25e3, 850.0 * GRAVITY
ANGLES = np.deg2rad(60.0 * np.arange(6))
FEET = np.column_stack([R * np.cos(ANGLES), R * np.sin(ANGLES), np.full(6, -1.5)])
COM = np.array([0.0, 0.0, -0.85])
LOW_COM = np.array([0.0, 0.0, -1.49])
SPRINGS = FootSprings(stiffness_z=np.full(6, K), lateral_ratio=0.5)
MICROMETRE = 1e-6
MILLIMETRE = 1e-3


def _predict(method="springs", *, leg=0, clearance=0.10, **more):
    return predict_sag(
        FEET,
        leg,
        com_planted=COM,
        com_airborne=COM,
        weight=W,
        clearance=clearance,
        springs=SPRINGS,
        config=SagConfig(method=method),
        **more,
    )


def test_contact_breaks_at_a_third_of_the_weight_over_the_constant():
    stiff_sideways = FootSprings(stiffness_z=np.full(6, K), lateral_ratio=50.0)
    for leg in range(6):
        off = lift_to_break_contact(FEET, LOW_COM, W, leg=leg, springs=stiff_sideways)
        assert off.lift == pytest.approx(W / (3 * K), abs=MILLIMETRE)


def test_the_gradual_model_lets_go_exactly_at_the_predicted_lift():
    off = lift_to_break_contact(FEET, COM, W, leg=2, springs=SPRINGS)
    for extra, carries in ((-MILLIMETRE, True), (MILLIMETRE, False)):
        lifts = np.zeros(6)
        lifts[2] = off.lift + extra
        solution = solve_sag(FEET, COM, W, stiffness_z=SPRINGS.stiffness_z, lateral_ratio=0.5, lifts=lifts)
        assert bool(solution.loaded[2]) is carries


def test_a_foot_pressed_in_already_needs_that_much_more():
    pressed = np.zeros(6)
    pressed[3] = -0.02
    plain = lift_to_break_contact(FEET, COM, W, leg=3, springs=SPRINGS)
    more = lift_to_break_contact(FEET, COM, W, leg=3, springs=SPRINGS, lifts=pressed)
    assert more.lift - plain.lift == pytest.approx(0.02, abs=1e-4)


def test_the_commanded_lift_leaves_the_wanted_clearance():
    prediction = _predict(clearance=0.12, leg=1)
    lifted = FEET[1] + [0.0, 0.0, prediction.commanded_lift]
    over_contact = prediction.unsagged_from_swinging.apply(lifted)[2] - FEET[1, 2]
    assert prediction.status == "converged"
    assert over_contact == pytest.approx(0.12, abs=MICROMETRE)
    assert prediction.commanded_lift > 0.12 + 0.10


def test_the_chassis_sinks_towards_the_lifted_leg():
    prediction = _predict(leg=0)
    hips = 1.229 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(6)])
    moved = prediction.standing_from_swinging.apply(hips)[:, 2]
    assert moved[0] < moved[1] < 0.0 < moved[3]
    assert prediction.tilt > 0.01


def test_a_lifted_foot_carries_nothing_and_the_others_the_weight():
    prediction = _predict(leg=4)
    assert not prediction.forces_swinging[4].any()
    assert prediction.forces_swinging[:, 2].sum() == pytest.approx(W)
    assert prediction.forces_standing[4, 2] == pytest.approx(W / 6)


def test_two_methods_know_no_springs():
    none, raised = _predict("none"), _predict("raise_terrain")
    assert none.commanded_lift == pytest.approx(0.10)
    assert none.terrain_raise == 0.0
    assert raised.commanded_lift == pytest.approx(0.25)
    assert raised.terrain_raise == pytest.approx(0.15)
    for prediction in (none, raised):
        assert np.array_equal(prediction.standing_from_swinging.matrix(), SE3.identity().matrix())
        assert prediction.reload == 0.0


def test_at_full_payload_the_lift_to_break_contact_is_the_heuristic_of_2008():
    """Robot facts 2.6: 25 kN/m and 1,150 kg give 15 cm, closed form; the CoM's height adds some millimetres."""
    off = lift_to_break_contact(FEET, LOW_COM, 1150.0 * GRAVITY, leg=0, springs=SPRINGS)
    assert off.lift == pytest.approx(0.15, abs=2 * MILLIMETRE)


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_drawn_robots_have_a_prediction_for_every_leg(robot):
    model = kinematics(robot)
    spec, joints = model.spec, regular_stance(model.spec)
    for leg in range(6):
        prediction = predict_sag(
            model.wheels_in_hex(joints),
            leg,
            com_planted=model.com_in_hex(joints),
            com_airborne=model.com_in_hex(joints),
            weight=spec.mass * GRAVITY,
            clearance=0.1,
            springs=FootSprings.from_spec(spec),
            config=SagConfig(),
        )
        assert prediction.status == "converged"
        assert 0.05 < prediction.lift_to_break < 0.4


def test_a_stance_that_falls_says_so_instead_of_a_number_to_believe():
    prediction = predict_sag(
        FEET,
        0,
        com_planted=COM,
        com_airborne=COM + [1.4, 0.0, 0.0],
        weight=W,
        clearance=0.1,
        springs=SPRINGS,
        config=SagConfig(),
    )
    assert prediction.status == "tips"


def test_wrong_use_is_refused():
    with pytest.raises(SagError, match="none, raise_terrain, springs"):
        SagConfig(method="magic")
    with pytest.raises(SagError, match="raised by 3"):
        SagConfig(terrain_raise=3.0)
    for bad in (np.nan, np.inf, -K, 0.0):
        with pytest.raises(SagError, match=r"stiffness_z is .*(nan|inf|-25000|0\.0).*, need six finite positive"):
            SagConfig(stiffness_z=(K, K, bad, K, K, K))
    with pytest.raises(SagError, match="need six finite positive"):
        SagConfig(stiffness_z=(K,) * 5)
    with pytest.raises(SagError, match="leg index 6"):
        _predict(leg=6)
    with pytest.raises(SagError, match="leg index -1"):
        lift_to_break_contact(FEET, COM, W, leg=-1, springs=SPRINGS)
    with pytest.raises(SagError, match="clearance is -0"):
        _predict(clearance=-0.1)
