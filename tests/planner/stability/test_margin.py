import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from athlete_twin.errors import SupportError
from athlete_twin.geometry.polygon import convex_hull, signed_distance
from planner.stability.margin import (
    conservative_polygon,
    cps_margin,
    cps_tip_over_energy,
    stability_rule,
    support_margin,
    tip_over_energy,
)

R = 1.95
ANGLES = np.deg2rad(60.0 * np.arange(6))
HEXAGON = np.column_stack([R * np.cos(ANGLES), R * np.sin(ANGLES), np.zeros(6)])
COM = np.array([0.0, 0.0, 0.85])
NANOMETRE = 1e-9
ALL = np.ones(6, dtype=bool)


def _without(leg: int) -> np.ndarray:
    flags = ALL.copy()
    flags[leg] = False
    return flags


def _rise_by_turning(com: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Highest point of the CoM turned about the edge in small steps, less where it is."""
    axis = (b - a) / np.linalg.norm(b - a)
    turns = Rotation.from_rotvec(np.linspace(-np.pi, np.pi, 200001)[:, None] * axis)
    return float((turns.apply(com - a)[:, 2] + a[2]).max() - com[2])


def test_a_regular_hexagon_has_the_known_margins():
    assert support_margin(COM, HEXAGON) == pytest.approx(np.sqrt(0.75) * R)
    assert cps_margin(COM, HEXAGON) == pytest.approx(0.5 * R)


def test_with_one_leg_lifted_the_plain_margin_is_half_a_radius_and_the_cps_margin_zero():
    assert support_margin(COM, HEXAGON[1:]) == pytest.approx(0.5 * R)
    assert cps_margin(COM, HEXAGON[1:]) == pytest.approx(0.0, abs=NANOMETRE)


def test_with_one_leg_lifted_the_best_cps_margin_lies_away_from_it():
    shifts = np.linspace(-0.6, 0.2, 801) * R
    margins = [cps_margin(COM + [shift, 0.0, 0.0], HEXAGON[1:]) for shift in shifts]
    best = int(np.argmax(margins))
    # Where the lines through legs 3-6 and 3-5, leg 1 being lifted, are equally far: 0.232 R at 0.268 R.
    away = 0.5 / (1.0 + np.sqrt(0.75))
    assert margins[best] == pytest.approx(np.sqrt(0.75) * away * R, abs=0.001 * R)
    assert shifts[best] == pytest.approx(-away * R, abs=0.001 * R)


def test_two_opposite_legs_lifted_leave_a_single_point():
    four = HEXAGON[[1, 2, 4, 5]]
    assert cps_margin(COM, four) == pytest.approx(0.0, abs=NANOMETRE)
    for angle in np.linspace(0.0, 2 * np.pi, 12):
        assert cps_margin(COM + 0.1 * np.array([np.cos(angle), np.sin(angle), 0.0]), four) < -0.01
    assert len(conservative_polygon(four)) == 0 or np.ptp(conservative_polygon(four), axis=0).max() < NANOMETRE


def test_three_wheels_have_no_conservative_polygon():
    assert cps_margin(COM, HEXAGON[[0, 2, 4]]) < 0.0
    assert len(conservative_polygon(HEXAGON[[0, 2, 4]])) == 0


def test_conservative_polygon_of_the_hexagon_is_the_inner_hexagon():
    polygon = conservative_polygon(HEXAGON)
    assert len(polygon) == 6
    assert np.linalg.norm(polygon, axis=1) == pytest.approx(np.full(6, R / np.sqrt(3.0)))


def test_cps_margin_equals_a_search_over_the_clipped_polygon():
    rng = np.random.default_rng(5)
    for _ in range(30):
        wheels = HEXAGON + rng.normal(0.0, 0.25, (6, 3))
        com = COM + rng.normal(0.0, 0.2, 3)
        polygon = conservative_polygon(wheels)
        margin = cps_margin(com, wheels)
        if margin > 0.0:
            assert signed_distance(com[:2], polygon) == pytest.approx(margin, abs=1e-9)
        elif len(polygon) >= 3:
            assert signed_distance(com[:2], polygon) <= 1e-9


def test_tip_over_energy_on_flat_ground_is_the_closed_form():
    half_width = np.sqrt(0.75) * R
    expected = np.hypot(COM[2], half_width) - COM[2]
    assert tip_over_energy(COM, HEXAGON) == pytest.approx(expected)
    assert cps_tip_over_energy(COM, HEXAGON) == pytest.approx(np.hypot(COM[2], 0.5 * R) - COM[2])


def test_tip_over_energy_on_rough_ground_equals_turning_the_robot_over_each_edge():
    rng = np.random.default_rng(6)
    for _ in range(5):
        wheels = HEXAGON + np.column_stack([np.zeros((6, 2)), rng.normal(0.0, 0.2, 6)])
        com = COM + rng.normal(0.0, 0.1, 3)
        least = min(_rise_by_turning(com, wheels[i], wheels[(i + 1) % 6]) for i in range(6))
        assert tip_over_energy(com, wheels) == pytest.approx(least, rel=1e-3)


@pytest.mark.parametrize("slope_deg", [0.0, 7.0, 14.0])
@pytest.mark.parametrize("azimuth_deg", [0.0, 20.0, 90.0])
@pytest.mark.slow
@pytest.mark.ci
def test_tip_over_energy_on_a_slope_is_gravitys_work_integrated(slope_deg, azimuth_deg):
    """The robot turned about each edge in small steps until gravity helps, the moment summed up: no circle, no closed form."""
    turn = Rotation.from_euler("zx", [azimuth_deg, slope_deg], degrees=True).as_matrix()
    wheels, com = HEXAGON @ turn.T, turn @ (COM + [0.1, -0.15, 0.0])
    least = np.inf
    for i in range(6):
        start, edge = wheels[i], wheels[(i + 1) % 6] - wheels[i]
        edge /= np.linalg.norm(edge)
        arm, work, step = com - start, 0.0, 1e-4
        outward = Rotation.from_rotvec(step * edge).as_matrix()
        while True:
            resisting = float(np.cross(arm, [0.0, 0.0, 1.0]) @ edge)  # rise by angle: the moment over the weight
            if resisting <= 0.0:
                break
            work, arm = work + resisting * step, outward @ arm
        least = min(least, work)
    assert tip_over_energy(com, wheels) == pytest.approx(least, rel=0.01)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(3, 6), slope_deg=st.floats(0.0, 14.0))
def test_tip_over_energy_of_any_stance_on_a_slope_is_gravitys_work_integrated(seed, count, slope_deg):
    """Feet at any place and height around a centre of mass; the robot turned about each edge until gravity helps."""
    rng = np.random.default_rng(seed)
    angles = 2.0 * np.pi * (np.arange(count) + rng.uniform(-0.3, 0.3, count)) / count
    radii = rng.uniform(1.4, 2.6, count)
    wheels = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), rng.normal(0.0, 0.15, count)])
    turn = Rotation.from_euler("zx", [rng.uniform(0.0, 360.0), slope_deg], degrees=True).as_matrix()
    wheels, com = wheels @ turn.T, turn @ np.array([*rng.normal(0.0, 0.1, 2), rng.uniform(0.7, 2.5)])
    assume(support_margin(com, wheels) > 0.05)
    hull = convex_hull(wheels[:, :2])
    least = min(_work_over(com, wheels[a], wheels[b]) for a, b in zip(hull, np.roll(hull, -1), strict=True))
    assert tip_over_energy(com, wheels) == pytest.approx(least, rel=0.01)


def _work_over(com: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Gravity's moment about an edge over the weight, summed over the angle until it changes its sign."""
    edge = (b - a) / np.linalg.norm(b - a)
    angles = np.linspace(0.0, np.pi, 8001)
    resisting = np.cross(Rotation.from_rotvec(angles[:, None] * edge).apply(com - a), [0.0, 0.0, 1.0]) @ edge
    until = int(np.argmax(resisting <= 0.0))
    return float(np.trapezoid(resisting[:until], angles[:until]))


def test_tip_over_energy_falls_downhill_and_vanishes_above_an_edge():
    edge = HEXAGON.copy()
    level = tip_over_energy(COM, edge)
    tilted = _tilt(0.25)
    assert tip_over_energy(tilted @ COM, edge @ tilted.T) < level
    above = np.array([0.0, np.sqrt(0.75) * R, 0.85])
    assert tip_over_energy(above, HEXAGON) == pytest.approx(0.0, abs=NANOMETRE)
    assert tip_over_energy(above + [0.0, 0.1, 0.0], HEXAGON) < 0.0


def _tilt(angle: float) -> np.ndarray:
    return np.asarray(Rotation.from_euler("x", angle).as_matrix())


@settings(max_examples=40, deadline=None)
@given(st.floats(0.0, 6.28), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_margins_and_energies_are_invariant_under_heading(heading, x, y):
    turn = np.asarray(Rotation.from_euler("z", heading).as_matrix())
    wheels = HEXAGON + np.array([[0.1, -0.2, 0.1], [0, 0.1, 0], [0, 0, -0.1], [0.2, 0, 0], [0, -0.1, 0.2], [0, 0, 0]])
    com = COM + [x, y, 0.0]
    for measure in (support_margin, cps_margin, tip_over_energy, cps_tip_over_energy):
        assert measure(turn @ com, wheels @ turn.T) == pytest.approx(measure(com, wheels), abs=1e-9)


def test_order_of_the_wheels_does_not_matter():
    order = np.array([3, 0, 5, 1, 4, 2])
    com = COM + [0.2, 0.1, 0.0]
    for measure in (support_margin, cps_margin, tip_over_energy, cps_tip_over_energy):
        assert measure(com, HEXAGON[order]) == pytest.approx(measure(com, HEXAGON))


def test_rule_asks_for_the_cps_with_all_wheels_down_and_the_plain_margin_in_a_swing():
    off = COM + [0.8, 0.0, 0.0]
    down = stability_rule(off, HEXAGON, supporting=ALL, min_margin=0.30)
    assert not down.ok
    assert "CPS margin" in down.reason
    assert stability_rule(off, HEXAGON, supporting=ALL, min_margin=0.30, all_down_margin="support").ok
    swing = stability_rule(COM, HEXAGON, supporting=_without(0), min_margin=0.30)
    assert swing.ok
    assert swing.cps_margin == pytest.approx(0.0, abs=NANOMETRE)
    towards = stability_rule(off, HEXAGON, supporting=_without(0), min_margin=0.30)
    assert not towards.ok
    assert "support margin 0.175 m is below 0.300 m on 5 wheels" in towards.reason


def test_rule_can_ask_for_energy():
    verdict = stability_rule(COM, HEXAGON, supporting=ALL, min_margin=0.3, all_down_margin="energy", min_energy=2.0)
    assert not verdict.ok
    assert "tip-over energy" in verdict.reason


def test_fewer_than_three_wheels_and_unknown_margins_are_refused():
    with pytest.raises(SupportError, match="2 loaded wheels span no polygon"):
        support_margin(COM, HEXAGON[:2])
    with pytest.raises(SupportError, match="cps, support, energy"):
        stability_rule(COM, HEXAGON, supporting=ALL, min_margin=0.3, all_down_margin="best")


@pytest.mark.parametrize("measure", [support_margin, cps_margin, tip_over_energy, cps_tip_over_energy])
def test_what_is_not_a_number_has_no_margin(measure):
    wheels = HEXAGON.copy()
    wheels[4, 1] = np.nan
    with pytest.raises(SupportError, match="1 values of wheels are not"):
        measure(COM, wheels)
    with pytest.raises(SupportError, match=r"centre of mass \[ ?nan"):
        measure(np.array([np.nan, 0.0, 1.0]), HEXAGON)


@pytest.mark.parametrize("wheels", [np.zeros((4, 3)), np.outer(np.arange(4.0), [1.0, 0.0, 0.0])], ids=["one place", "one line"])
def test_wheels_that_span_nothing_have_no_energy_to_tip(wheels):
    for com in (COM, COM + [0.3, -0.2, 0.0]):
        assert tip_over_energy(com, wheels) <= 0.0
        assert cps_tip_over_energy(com, wheels) <= 0.0
