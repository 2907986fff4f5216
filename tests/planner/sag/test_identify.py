import numpy as np
import pytest

from athlete_twin.errors import SagError
from planner.sag.identify import MeasuredStance, identify_per_wheel, identify_stiffness, identify_tyre, predict_heights
from planner.sag.sag_model import AIRBORNE

R, W = 1.95, 850.0 * 9.81
ANGLES = np.deg2rad(60.0 * np.arange(6))
FEET = np.column_stack([R * np.cos(ANGLES), R * np.sin(ANGLES), np.full(6, -1.5)])
CORNERS = 1.375 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros(6)])
MILLIMETRE = 1e-3
UNEQUAL = 18e3 * (1.0 + 0.125 * np.array([1.0, -1.0, 0.5, -0.5, 0.8, -0.9]))
EACH_LIFTED = tuple((leg,) for leg in range(6))


def _stances(stiffness, noise=0.0, seed=0, lifted=((), (4,), (0, 3), (2,))):
    """All wheels down, one leg lifted, two legs lifted, as the paper's; heights from the model, plus an instrument's error."""
    rng = np.random.default_rng(seed)
    out = []
    for legs in lifted:
        lifts = np.zeros(6)
        lifts[list(legs)] = AIRBORNE
        blank = MeasuredStance(
            feet_in_hex=FEET,
            com_in_hex=np.array([0.0, 0.0, -0.85]),
            weight=W,
            lifts=lifts,
            corners_in_hex=CORNERS,
            heights=np.zeros(6),
            origin_height=1.75,
        )
        heights = predict_heights(blank, stiffness_z=stiffness, lateral_ratio=0.5) + rng.normal(0.0, noise, 6)
        out.append(
            MeasuredStance(
                feet_in_hex=FEET,
                com_in_hex=blank.com_in_hex,
                weight=W,
                lifts=lifts,
                corners_in_hex=CORNERS,
                heights=heights,
                origin_height=1.75,
            )
        )
    return out


def test_search_finds_the_constant_that_made_the_heights():
    fit = identify_stiffness(_stances(np.full(6, 18e3)), upper=43e3)
    assert fit.stiffness == pytest.approx(18e3)
    assert fit.max_error < 1e-6


def test_errors_of_the_instrument_move_the_constant_little():
    fit = identify_stiffness(_stances(np.full(6, 18e3), noise=3 * MILLIMETRE), upper=43e3)
    assert fit.stiffness == pytest.approx(18e3, rel=0.06)
    assert fit.mean_error == pytest.approx(0.8 * 3 * MILLIMETRE, rel=0.4)


def test_unequal_tyres_leave_centimetres_as_the_paper_found():
    fit = identify_stiffness(_stances(UNEQUAL), upper=43e3)
    assert fit.stiffness == pytest.approx(18e3, rel=0.1)
    assert MILLIMETRE < fit.mean_error < 12 * MILLIMETRE
    assert fit.max_error < 0.05


def test_the_best_candidate_stays_below_the_bound():
    fit = identify_stiffness(_stances(np.full(6, 30e3)), upper=20e3)
    assert fit.stiffness == pytest.approx(20e3)
    assert fit.mean_errors[-1] == fit.mean_errors.min()


def test_constants_that_hold_no_stance_count_as_infinitely_wrong():
    fit = identify_stiffness(_stances(np.full(6, 18e3)), lower=500.0, upper=20e3, step=500.0)
    assert np.isinf(fit.mean_errors[0])
    assert fit.stiffness == pytest.approx(18e3)


def test_wrong_use_is_refused():
    stance = _stances(np.full(6, 18e3))[0]
    with pytest.raises(SagError, match="no stance was measured"):
        identify_stiffness([], upper=40e3)
    with pytest.raises(SagError, match="no candidate"):
        identify_stiffness([stance], upper=1000.0)
    with pytest.raises(SagError, match="as many heights"):
        MeasuredStance(
            feet_in_hex=FEET,
            com_in_hex=stance.com_in_hex,
            weight=W,
            lifts=np.zeros(6),
            corners_in_hex=CORNERS,
            heights=np.zeros(4),
            origin_height=1.75,
        )
    with pytest.raises(SagError, match="finite"):
        MeasuredStance(
            feet_in_hex=FEET,
            com_in_hex=stance.com_in_hex,
            weight=W,
            lifts=np.zeros(6),
            corners_in_hex=CORNERS,
            heights=np.full(6, np.nan),
            origin_height=1.75,
        )
    falling = MeasuredStance(
        feet_in_hex=FEET,
        com_in_hex=np.array([3.0, 0.0, -0.8]),
        weight=W,
        lifts=np.zeros(6),
        corners_in_hex=CORNERS,
        heights=np.zeros(6),
        origin_height=1.75,
    )
    with pytest.raises(SagError, match="holds all 1 stances"):
        identify_stiffness([falling], upper=20e3, step=6000.0)


def test_six_poses_tell_the_constant_of_each_wheel():
    fit = identify_per_wheel(_stances(UNEQUAL, lifted=EACH_LIFTED), start=18e3, instrument_sigma=3 * MILLIMETRE)
    np.testing.assert_allclose(fit.stiffness_z, UNEQUAL, rtol=1e-4)
    assert fit.max_error < 1e-6


@pytest.mark.slow
def test_stated_sigma_of_a_constant_is_what_instruments_errors_scatter_it_by():
    found = [
        identify_per_wheel(
            _stances(UNEQUAL, noise=3 * MILLIMETRE, seed=seed, lifted=EACH_LIFTED), start=18e3, instrument_sigma=3 * MILLIMETRE
        )
        for seed in range(40)
    ]
    scatter = np.std([fit.stiffness_z / UNEQUAL for fit in found], axis=0)
    stated = np.mean([fit.relative_sigma for fit in found], axis=0)
    np.testing.assert_allclose(scatter, stated, rtol=0.4)  # forty samples tell a sigma to 11 %; six wheels, 3.5 of these


def test_the_tyre_is_told_from_its_axles_alone():
    loads = np.linspace(800.0, 3000.0, 12)
    rng = np.random.default_rng(5)
    heights = 0.375 - loads / 25e3 + rng.normal(0.0, 3 * MILLIMETRE, 12)
    assert identify_tyre(loads, heights, wheel_radius=0.375) == pytest.approx(25e3, rel=0.04)


def test_wrong_use_of_the_finer_calibrations_is_refused():
    stances = _stances(UNEQUAL, lifted=EACH_LIFTED)
    with pytest.raises(SagError, match="at least 2 stances"):
        identify_per_wheel(stances[:1], start=18e3, instrument_sigma=MILLIMETRE)
    with pytest.raises(SagError, match=r"-1.0 N/m, must be positive"):
        identify_per_wheel(stances, start=-1.0, instrument_sigma=MILLIMETRE)
    with pytest.raises(SagError, match=r"sigma is 0.0 m"):
        identify_per_wheel(stances, start=18e3, instrument_sigma=0.0)
    with pytest.raises(SagError, match="do not tell the constant of wheel 5"):
        identify_per_wheel(_stances(UNEQUAL, lifted=((4,), (4, 1), (4,))), start=18e3, instrument_sigma=MILLIMETRE)
    with pytest.raises(SagError, match="as many"):
        identify_tyre(np.ones(3), np.ones(2), wheel_radius=0.375)
    with pytest.raises(SagError, match="no tyre is so stiff"):
        identify_tyre(np.full(3, 1000.0), np.full(3, 0.5), wheel_radius=0.375)
