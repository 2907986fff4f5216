import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from planner.sag.spread import bounded_least_squares, shift_towards_even, spread_loads

K, W, R = 25e3, 8000.0, 1.95
ANGLES = np.deg2rad([60.0, 120.0, 180.0, 240.0, 300.0])
PLACES = R * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
"""five of a regular hexagon; the one ahead is lifted"""
NINTHS = W * (2.0 / 9.0 - np.cos(np.pi - ANGLES) / 9.0)
NEWTON, MICROMETRE = 1.0, 1e-6


def _spread(stiffness=None, *, loads=None, offsets=None, max_offset=1.0, min_load=0.0, places=PLACES):
    stiffness = np.full(len(places), K) if stiffness is None else stiffness
    loads = NINTHS if loads is None else loads
    return spread_loads(
        places, loads, compressions=loads / stiffness, stiffness=stiffness,
        offsets=np.zeros(len(places)) if offsets is None else offsets, max_offset=max_offset, min_load=min_load,
    )  # fmt: skip


def test_even_springs_under_a_hexagon_need_no_offset():
    spread = _spread()
    assert spread.loads == pytest.approx([5 / 18 * W, W / 6, W / 9, W / 6, 5 / 18 * W])
    assert spread.offsets == pytest.approx(np.zeros(5), abs=MICROMETRE)


def test_an_internal_load_is_taken_out_with_the_offsets_of_its_compressions():
    balance = np.column_stack([np.ones(5), PLACES]).T
    internal = 300.0 * np.linalg.svd(balance)[2][4]
    spread = _spread(loads=NINTHS + internal)
    assert spread.loads == pytest.approx(NINTHS, abs=1e-3 * NEWTON)
    assert spread.offsets == pytest.approx(internal / K, abs=MICROMETRE)


def test_three_wheels_have_no_choice():
    places = PLACES[[0, 2, 4]]
    loads = np.array([W / 4, W / 2, W / 4])
    spread = _spread(np.array([K, 2 * K, K]), loads=loads, places=places)
    assert spread.loads == pytest.approx(loads)
    assert not spread.offsets.any()
    assert _spread(loads=loads, places=places, min_load=0.3 * W) is None


@given(seed=st.integers(0, 10_000), max_offset=st.sampled_from([0.004, 0.02, 1.0]))
def test_no_offsets_within_the_bound_spread_better(seed, max_offset):
    """SciPy's SLSQP and random offsets, with the chassis free to follow as a plane: springs solved as linear equations."""
    rng = np.random.default_rng(seed)
    places, stiffness = PLACES + rng.normal(0.0, 0.1, (5, 2)), rng.uniform(15e3, 35e3, 5)
    ground = rng.normal(0.0, 0.005, 5)
    plane = np.column_stack([np.ones(5), places])
    weight = plane[:, 0:1].T @ NINTHS
    wanted = np.array([weight[0], *(0.05 * rng.normal(size=2) * weight[0])])

    def loads(offsets):
        # compression = plane q - ground - offsets, balance plane' K compression = wanted
        normal = plane.T @ (stiffness[:, None] * plane)
        q = np.linalg.solve(normal, wanted + plane.T @ (stiffness * (ground + offsets)))
        return stiffness * (plane @ q - ground - offsets)

    start = np.zeros(5)
    f = loads(start)
    spread = spread_loads(
        places, f, compressions=f / stiffness, stiffness=stiffness, offsets=start, max_offset=max_offset, min_load=-1e9
    )
    assert np.abs(spread.offsets).max() <= max_offset + MICROMETRE
    assert spread.loads == pytest.approx(loads(spread.offsets), abs=1e-3 * NEWTON)
    best = float(np.sum(spread.loads**2))
    for _ in range(200):
        assert np.sum(loads(rng.uniform(-max_offset, max_offset, 5)) ** 2) >= best * (1.0 - 1e-6)
    peer = minimize(
        lambda x: np.sum((loads(0.01 * x) / W) ** 2), start, method="SLSQP", bounds=[(-100 * max_offset, 100 * max_offset)] * 5,
        options={"ftol": 1e-14, "maxiter": 300},
    )
    assert best / W**2 <= peer.fun * (1.0 + 1e-6)


def test_a_least_load_is_kept_or_refused():
    loads = W * np.array([0.42, 0.09, -0.02, 0.09, 0.42])
    free, kept = _spread(loads=loads, min_load=-W), _spread(loads=loads, min_load=0.02 * W)
    assert free.loads.min() < 0.02 * W
    assert kept.loads.min() == pytest.approx(0.02 * W, abs=NEWTON)
    assert np.sum(kept.loads**2) > np.sum(free.loads**2)
    assert kept.loads.sum() == pytest.approx(W) and kept.loads @ PLACES == pytest.approx(loads @ PLACES, abs=NEWTON)
    assert _spread(loads=loads, min_load=0.02 * W, max_offset=1e-4) is None
    assert _spread(loads=loads, min_load=0.19 * W) is None


@given(seed=st.integers(0, 10_000))
def test_bounded_least_squares_agrees_with_slsqp(seed):
    rng = np.random.default_rng(seed)
    matrix, wanted = rng.normal(size=(6, 3)), rng.normal(size=6)
    bounds, inside = rng.normal(size=(4, 3)), rng.normal(size=3)
    least = bounds @ inside - rng.uniform(0.0, 0.5, 4)
    x = bounded_least_squares(matrix, wanted, bounds, least)
    peer = minimize(
        lambda v: np.sum((matrix @ v - wanted) ** 2), inside, method="SLSQP", options={"ftol": 1e-14, "maxiter": 500},
        constraints={"type": "ineq", "fun": lambda v: bounds @ v - least, "jac": lambda v: bounds},
    )
    assert (bounds @ x >= least - 1e-6).all()
    assert np.sum((matrix @ x - wanted) ** 2) <= peer.fun + 1e-6


def test_bounds_that_exclude_each_other_leave_nothing():
    bounds = np.array([[1.0, 0.0], [-1.0, 0.0]])
    assert bounded_least_squares(np.eye(2), np.zeros(2), bounds, np.array([1.0, 1.0])) is None


def test_the_shift_ends_over_the_wheels_middle_or_on_its_bound():
    by_shift = 0.3 * np.eye(2)
    middle = PLACES.mean(axis=0)
    assert shift_towards_even(np.zeros(2), PLACES, by_shift, 5.0) == pytest.approx(middle / 0.3)
    assert shift_towards_even(np.zeros(2), PLACES, by_shift, 0.1) == pytest.approx([-0.1, 0.0], abs=MICROMETRE)
    assert not shift_towards_even(np.zeros(2), PLACES, by_shift, 0.0).any()


def test_no_other_shift_within_the_bound_makes_balance_more_even():
    com, by_shift, radius = np.array([0.1, 0.15]), np.array([[0.3, 0.02], [-0.01, 0.5]]), 0.2
    balance = np.column_stack([np.ones(5), PLACES]).T

    def squares(shift):
        at = com + by_shift @ shift
        return float(np.sum((np.linalg.pinv(balance) @ np.array([1.0, *at])) ** 2))

    best = squares(shift_towards_even(com, PLACES, by_shift, radius))
    for angle in np.linspace(0.0, 2 * np.pi, 721):
        for r in (radius, 0.7 * radius):
            assert squares(r * np.array([np.cos(angle), np.sin(angle)])) >= best - 1e-12
