import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from athlete_twin.errors import SagError
from athlete_twin.geometry.polygon import signed_distance
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import load_spec
from planner.sag.sag_model import AIRBORNE, SOFT_CONTACT, FootSprings, solve_loaded, solve_sag
from planner.sag.spring_equations import spring_equations

R, K, W = 1.95, 25e3, 850.0 * 9.81
ANGLES = np.deg2rad(60.0 * np.arange(6))
FEET = np.column_stack([R * np.cos(ANGLES), R * np.sin(ANGLES), np.full(6, -1.5)])
COM = np.array([0.0, 0.0, -0.85])
LOW_COM = np.array([0.0, 0.0, -1.49])
"""a centimetre over the feet: there the closed forms hold, and the equations are not yet singular"""
MICROMETRE = 1e-6
NO_LIFT = np.zeros(6)
EVEN = np.full(6, K)


def _lifted(*legs: int) -> np.ndarray:
    lifts = np.zeros(6)
    lifts[list(legs)] = AIRBORNE
    return lifts


def _solve(feet=FEET, com=COM, weight=W, *, stiffness=EVEN, ratio=0.5, lifts=NO_LIFT, **more):
    return solve_sag(feet, com, weight, stiffness_z=stiffness, lateral_ratio=ratio, lifts=lifts, **more)


def _rigid_balance(pose, feet, com, stiffness, ratio, lifts, down):
    """Forces and moments left over when the chassis is moved rigidly: six numbers of a pose's six."""
    up = -down / np.linalg.norm(down)
    turn = Rotation.from_rotvec(pose[3:])
    moved = turn.apply(feet) + pose[:3] - feet
    compression = np.maximum(-(moved @ up) - lifts, 0.0)
    s = np.clip(compression / SOFT_CONTACT, 0.0, 1.0)
    side = moved - np.outer(moved @ up, up)
    forces = np.outer(stiffness * compression, up) - (ratio * stiffness * s**2 * (3 - 2 * s))[:, None] * side
    at = feet + moved
    com_at = turn.apply(com) + pose[:3]
    left = forces.sum(axis=0) - W * up
    moment = np.cross(at, forces).sum(axis=0) - W * np.cross(com_at, up)
    return np.concatenate([left, moment / R]) / W


def _left_of_the_papers_equations(feet, com, solution, stiffness, ratio, lifts, loaded):
    """What is left of [SunSpiral2012] eqs 4-8, with forces by 9-12, as printed: +z down, the mass times g along +z."""
    down = np.array([1.0, -1.0, -1.0])
    r0, cg0 = feet * down, com * down
    dr = solution.displacements * down
    rf, cgf = r0 + dr, cg0 + solution.com_displacement * down
    contact_height = r0[:, 2] + np.where(np.isfinite(lifts), lifts, 0.0)
    dh = contact_height - r0[:, 2]
    f = np.column_stack(
        [-ratio * stiffness * dr[:, 0], -ratio * stiffness * dr[:, 1], -stiffness * (dr[:, 2] - dh)]
    )
    f[~loaded] = 0.0
    mg = np.array([0.0, 0.0, W])
    left = [(f.sum(axis=0) + mg) / W, (np.cross(rf, f).sum(axis=0) + np.cross(cgf, mg)) / (W * R)]
    on = np.flatnonzero(loaded)
    for step in (1, 2):
        a, b = on, np.roll(on, -step)
        left.append(np.linalg.norm(r0[a] - r0[b], axis=1) - np.linalg.norm(rf[a] - rf[b], axis=1))
    left.append(np.linalg.norm(cg0 - r0[on], axis=1) - np.linalg.norm(cgf - rf[on], axis=1))
    return np.concatenate(left), f * down


@pytest.mark.parametrize("legs", [(), (0,), (2,), (0, 3), (1, 3, 5)])
def test_both_forms_fulfil_the_equations_as_printed_with_z_down(legs):
    rng = np.random.default_rng(7)
    feet, com = FEET + rng.normal(0.0, 0.1, (6, 3)), COM + rng.normal(0.0, 0.05, 3)
    stiffness = rng.uniform(18e3, 30e3, 6)
    loaded = ~np.isin(np.arange(6), legs)
    stepped = solve_loaded(feet, com, W, stiffness_z=stiffness, lateral_ratio=0.6, loaded=loaded)
    gradual_lifts = np.where(loaded, rng.uniform(-0.01, 0.02, 6), AIRBORNE)
    gradual = _solve(feet, com, stiffness=stiffness, ratio=0.6, lifts=gradual_lifts)
    for solution, lifts in ((stepped, np.where(loaded, 0.0, AIRBORNE)), (gradual, gradual_lifts)):
        assert solution.converged and np.array_equal(solution.loaded, loaded)
        left, forces = _left_of_the_papers_equations(feet, com, solution, stiffness, 0.6, lifts, loaded)
        assert np.abs(left).max() < 1e-8
        assert solution.forces == pytest.approx(forces, abs=1e-6 * W)


@pytest.mark.parametrize("unilateral", [True, False])
def test_analytic_derivatives_are_those_of_finite_differences(unilateral):
    rng = np.random.default_rng(11)
    r0 = np.vstack([FEET, COM]) - FEET.mean(axis=0) + rng.normal(0.0, 0.1, (7, 3))
    stiffness, lifts = rng.uniform(15e3, 30e3, 6), rng.uniform(-0.03, 0.03, 6)
    scale = W / stiffness.sum()
    x = np.tile([0.0, 0.0, -0.7], (7, 1)) + rng.normal(0.0, 0.2, (7, 3))
    lifts[4] = -scale * x[4, 2] - 0.4 * SOFT_CONTACT  # this foot's contact is just coming in
    lifts[5] = 0.2  # this one is in the air

    def evaluate(x):
        res, jac = np.empty(24), np.empty((24, 21))
        spring_equations(x, r0, W, stiffness, 0.5, lifts, unilateral, SOFT_CONTACT, R, scale, res, jac)
        return res, jac

    numeric, step = np.empty((24, 21)), 1e-6
    for k in range(21):
        nudge = np.zeros(21)
        nudge[k] = step
        nudge = nudge.reshape(7, 3)
        numeric[:, k] = (evaluate(x + nudge)[0] - evaluate(x - nudge)[0]) / (2 * step)
    assert evaluate(x)[1] == pytest.approx(numeric, abs=1e-7)


def test_six_even_feet_sink_by_a_sixth_of_the_weight_over_the_constant():
    solution = _solve()
    assert solution.status == "converged"
    assert solution.displacements[:, 2] == pytest.approx(np.full(6, -W / (6 * K)), abs=MICROMETRE)
    assert solution.unsagged_from_sagged.translation[2] == pytest.approx(-W / (6 * K), abs=MICROMETRE)
    assert solution.forces[:, 2] == pytest.approx(np.full(6, W / 6))
    stepped = solve_loaded(FEET, COM, W, stiffness_z=EVEN, lateral_ratio=0.5, loaded=np.ones(6, dtype=bool))
    assert stepped.displacements[:, 2] == pytest.approx(np.full(6, -W / (6 * K)), abs=MICROMETRE)


def test_with_one_leg_up_feet_carry_two_ninths_and_a_ninth_of_the_cosine():
    solution = _solve(com=LOW_COM, ratio=50.0, lifts=_lifted(0))
    assert solution.converged
    expected = 2 / 9 - np.cos(np.deg2rad(180.0) - ANGLES[1:]) / 9
    assert solution.forces[1:, 2] / W == pytest.approx(expected, abs=2e-3)
    assert not solution.forces[0].any()


def test_at_the_real_height_of_the_com_neighbours_carry_more():
    solution = _solve(lifts=_lifted(0))
    assert 0.2800 < solution.forces[1, 2] / W < 0.2860


def test_a_foot_lifted_by_a_third_of_the_weight_over_the_constant_breaks_contact():
    exact = W / (3 * K)
    for lift, carries in ((0.98 * exact, True), (1.02 * exact, False)):
        lifts = NO_LIFT.copy()
        lifts[0] = lift
        solution = _solve(com=LOW_COM, ratio=50.0, lifts=lifts)
        assert solution.converged
        assert bool(solution.loaded[0]) is carries
        assert (solution.forces[0] != 0.0).any() == carries


def test_load_leaves_a_foot_gradually_as_it_is_lifted():
    loads = []
    for lift in np.linspace(0.0, 0.13, 27):
        lifts = NO_LIFT.copy()
        lifts[2] = lift
        solution = _solve(lifts=lifts)
        assert solution.converged
        loads.append(solution.forces[2, 2])
    assert loads[0] == pytest.approx(W / 6)
    assert loads[-1] == 0.0
    assert (np.diff(loads) <= 1e-6).all()
    assert np.abs(np.diff(loads)).max() < 0.1 * loads[0]


def test_with_every_set_of_feet_in_the_air_the_robot_stands_or_is_said_to_fall():
    """All 64. The CoM is off the diagonals, so that no set leaves it on an edge; near one, sag may push it over."""
    com = COM + [0.11, 0.07, 0.0]
    for count in range(7):
        for legs in itertools.combinations(range(6), count):
            on = ~np.isin(np.arange(6), legs)
            solution = _solve(com=com, lifts=_lifted(*legs))
            if on.sum() < 3:
                assert solution.status == "too_few_feet"
                continue
            margin = signed_distance(com[:2].copy(), FEET[on, :2].copy())
            if margin < 0.0:
                assert solution.status == "tips"
            elif margin > 0.1 or solution.converged:
                assert solution.status == "converged"
                assert not solution.forces[~on].any()
                assert solution.forces[on].sum(axis=0) == pytest.approx([0.0, 0.0, W], abs=1e-5 * W)
            else:
                # 6 cm from an edge, and sag moves the CoM by more: a search over rigid poses finds no stand either.
                assert solution.status == "not_converged"
                arguments = (FEET, com, EVEN, 0.5, _lifted(*legs), np.array([0.0, 0.0, -9.81]))
                found = least_squares(_rigid_balance, [0.0, 0.0, -0.1, 0.0, 0.0, 0.0], args=arguments)
                assert np.abs(found.fun).max() > 1e-4


@given(seed=st.integers(0, 10_000), airborne=st.sets(st.integers(0, 5), max_size=2))
def test_any_set_of_feet_in_the_air_agrees_with_a_rigid_solve_of_six_unknowns(seed, airborne):
    rng = np.random.default_rng(seed)
    feet = FEET + rng.normal(0.0, 0.15, (6, 3))
    com = COM + rng.normal(0.0, 0.05, 3)
    stiffness = rng.uniform(15e3, 30e3, 6)
    lifts = rng.uniform(-0.02, 0.06, 6)
    lifts[list(airborne)] = AIRBORNE
    down = np.array([0.1, -0.05, -1.0]) * 9.81
    solution = _solve(feet, com, stiffness=stiffness, lifts=lifts, gravity_in_hex=down)
    if not solution.converged:
        # Two feet beside each other in the air: then a robot may really fall.
        assert len(airborne) == 2
        return
    pose = solution.unsagged_from_sagged
    begin = np.concatenate([pose.translation, pose.rotvec()])
    arguments = (feet, com, stiffness, 0.5, lifts, down)
    assert np.abs(_rigid_balance(begin, *arguments)).max() < 1e-7
    cold = least_squares(_rigid_balance, [0.0, 0.0, -0.07, 0.0, 0.0, 0.0], args=arguments, xtol=1e-14, ftol=1e-14)
    if np.abs(cold.fun).max() < 1e-9 and np.linalg.norm(cold.x[3:]) < 0.3:
        moved = Rotation.from_rotvec(cold.x[3:]).apply(feet) + cold.x[:3]
        assert feet + solution.displacements == pytest.approx(moved, abs=0.1e-3)


@given(seed=st.integers(0, 10_000))
def test_forces_carry_the_weight_and_unloaded_feet_exactly_nothing(seed):
    rng = np.random.default_rng(seed)
    lifts = rng.uniform(0.0, 0.15, 6) * (rng.random(6) < 0.4)
    solution = _solve(FEET + rng.normal(0.0, 0.1, (6, 3)), lifts=lifts)
    if solution.converged:
        assert solution.forces.sum(axis=0) == pytest.approx([0.0, 0.0, W], abs=1e-5 * W)
        up = -(solution.displacements[:, 2] + lifts)
        assert (solution.forces[up <= 0.0] == 0.0).all()
        assert (solution.forces[up > 0.0, 2] > 0.0).all()
        assert np.array_equal(solution.loaded, up > 0.0)
        assert solution.deflections[~solution.loaded] == pytest.approx(0.0)


def test_the_robot_stays_rigid():
    solution = _solve(FEET + np.random.default_rng(1).normal(0.0, 0.1, (6, 3)), lifts=_lifted(4))
    feet = FEET + np.random.default_rng(1).normal(0.0, 0.1, (6, 3))
    pose = solution.unsagged_from_sagged
    assert pose.apply(feet) == pytest.approx(feet + solution.displacements, abs=MICROMETRE)
    assert pose.apply(COM) == pytest.approx(COM + solution.com_displacement, abs=MICROMETRE)


def test_the_solution_has_the_least_energy_of_all_nearby_poses():
    stiffness = np.linspace(18e3, 30e3, 6)
    solution = _solve(stiffness=stiffness)
    feet, com = FEET, COM

    def energy(pose: SE3) -> float:
        moved = pose.apply(feet) - feet
        springs = 0.5 * stiffness @ (moved[:, 2] ** 2 + 0.5 * (moved[:, 0] ** 2 + moved[:, 1] ** 2))
        return float(springs + W * pose.apply(com)[2])

    rng = np.random.default_rng(4)
    least = energy(solution.unsagged_from_sagged)
    for _ in range(200):
        nudge = SE3.from_rotvec(rng.normal(0.0, 1e-3, 3), rng.normal(0.0, 1e-3, 3))
        assert energy(nudge.compose(solution.unsagged_from_sagged)) > least


@pytest.mark.parametrize("lift", [0.03, 0.06, AIRBORNE])
def test_the_energy_is_least_too_while_a_leg_unloads(lift):
    lifts = np.array([0.0, lift, -0.01, 0.0, 0.0, 0.005])
    stiffness = np.linspace(18e3, 30e3, 6)
    solution = _solve(stiffness=stiffness, lifts=lifts)

    def energy(pose: SE3) -> float:
        moved = pose.apply(FEET) - FEET
        pressed = np.maximum(-moved[:, 2] - lifts, 0.0)
        side = (moved[:, 0] ** 2 + moved[:, 1] ** 2) * (pressed > 0.0)
        return float(0.5 * stiffness @ (pressed**2 + 0.5 * side) + W * pose.apply(COM)[2])

    assert (solution.deflections[solution.loaded, 2] < -2 * SOFT_CONTACT).all()  # beyond the softening
    rng = np.random.default_rng(4)
    least = energy(solution.unsagged_from_sagged)
    for _ in range(200):
        nudge = SE3.from_rotvec(rng.normal(0.0, 2e-4, 3), rng.normal(0.0, 2e-4, 3))
        assert energy(nudge.compose(solution.unsagged_from_sagged)) > least


def test_either_loaded_or_not_agrees_with_gradual_unloading_where_every_foot_presses():
    for legs in ((), (0,), (0, 3), (1, 3, 5)):
        loaded = np.ones(6, dtype=bool)
        loaded[list(legs)] = False
        gradual = _solve(lifts=_lifted(*legs))
        stepped = solve_loaded(FEET, COM, W, stiffness_z=EVEN, lateral_ratio=0.5, loaded=loaded)
        assert gradual.converged and stepped.converged
        assert stepped.forces == pytest.approx(gradual.forces, abs=1e-4 * W)
        assert stepped.displacements == pytest.approx(gradual.displacements, abs=MICROMETRE)


def test_turning_the_frame_turns_the_answer():
    turn = SE3.from_rpy(0.2, -0.1, 2.0)
    lifts = _lifted(1)
    plain = _solve(lifts=lifts)
    turned = _solve(turn.apply(FEET), turn.apply(COM), lifts=lifts, gravity_in_hex=turn.rotate(np.array([0, 0, -9.81])))
    assert turned.forces == pytest.approx(turn.rotate(plain.forces), abs=1e-4)
    assert turned.displacements == pytest.approx(turn.rotate(plain.displacements), abs=MICROMETRE)


def test_a_warm_start_gives_the_same_answer_in_fewer_iterations():
    lifts = NO_LIFT.copy()
    lifts[0] = 0.05
    before = _solve(lifts=lifts)
    lifts[0] = 0.051
    cold, warm = _solve(lifts=lifts), _solve(lifts=lifts, start=before)
    assert warm.displacements == pytest.approx(cold.displacements, abs=MICROMETRE)
    assert warm.iterations < cold.iterations
    assert _solve(lifts=lifts, start=cold).iterations == 0


def _random_stance(rng):
    """As a walking robot meets them, and now and then one that falls: the CoM up to 2 m off, up to two legs in the air."""
    lifts = rng.normal(0.0, 0.02, 6)
    lifts[rng.permutation(6)[: rng.integers(3)]] = AIRBORNE
    aside = rng.uniform(0.0, 2.0) * np.array([np.cos(turn := rng.uniform(0.0, 2 * np.pi)), np.sin(turn), 0.0])
    return {
        "feet": FEET + rng.normal(0.0, 0.15, (6, 3)), "com": COM + aside, "stiffness": rng.uniform(15e3, 30e3, 6), "lifts": lifts
    }  # fmt: skip


def test_a_warm_start_never_makes_a_solution_worse_or_another_one():
    """Each stance begun from the one before, whatever became of that, against the same begun cold."""
    rng = np.random.default_rng(8)
    before, kinds = None, []
    for _ in range(300):
        stance = _random_stance(rng)
        cold, warm = _solve(**stance), _solve(**stance, start=before)
        assert warm.status == cold.status
        if cold.converged:
            assert warm.displacements == pytest.approx(cold.displacements, abs=MICROMETRE)
        kinds.append((before is not None and before.converged, cold.converged))
        before = warm
    assert min(kinds.count(kind) for kind in itertools.product((True, False), repeat=2)) > 10


def test_a_start_that_is_no_solution_is_not_begun_from():
    fallen = _solve(com=COM + [2.5, 0.0, 0.0])
    assert not fallen.converged
    cold, warm = _solve(lifts=_lifted(1)), _solve(lifts=_lifted(1), start=fallen)
    assert warm.displacements == pytest.approx(cold.displacements, abs=0.0) and warm.iterations == cold.iterations


def test_a_soft_foot_sinks_its_corner():
    stiffness = EVEN.copy()
    stiffness[1] *= 0.7
    sunk = _solve(stiffness=stiffness).displacements[:, 2]
    assert sunk.argmin() == 1


def test_what_cannot_stand_says_so():
    assert _solve(com=COM + [2.5, 0.0, 0.0]).status == "tips"
    assert _solve(lifts=_lifted(0, 1, 5)).status in ("tips", "not_converged")
    assert _solve(lifts=_lifted(0, 1, 2, 3)).status == "too_few_feet"
    assert not _solve(lifts=_lifted(0, 1, 2, 3, 4, 5)).converged


def test_feet_taken_as_loaded_that_would_have_to_pull_say_so():
    """On even vertical springs loads lie on a plane over the places: with the CoM near one side that plane dips below zero."""
    four, com = ~np.isin(np.arange(6), (1, 4)), LOW_COM + [0.72 * R, 0.0, 0.0]
    assert signed_distance(com[:2].copy(), FEET[four, :2].copy()) > 0.2
    plane = np.column_stack([np.ones(4), FEET[four, :2]])
    expected = W * plane @ np.linalg.solve(plane.T @ plane, [1.0, com[0], com[1]])
    pulling = solve_loaded(FEET, com, W, stiffness_z=EVEN, lateral_ratio=0.5, loaded=four)
    assert expected.min() < -0.05 * W
    assert pulling.forces[four, 2] == pytest.approx(expected, abs=0.02 * W)
    assert pulling.status == "pulls" and not pulling.converged
    outside = solve_loaded(FEET, LOW_COM + [0.3, 2.0, 0.0], W, stiffness_z=EVEN, lateral_ratio=0.5, loaded=four)
    assert outside.forces[:, 2].min() < 0.0 and outside.status == "tips"


def test_a_mass_higher_than_the_springs_can_hold_upright_tips():
    """Springs resist a roll by 3 k R^2, the weight helps it by W h: over h = 3 k R^2 / W the balance is a pencil's."""
    highest = 3.0 * K * R**2 / W
    for height, status in ((0.98 * highest, "converged"), (1.02 * highest, "tips")):
        assert _solve(com=np.array([0.0, 0.0, FEET[0, 2] + height])).status == status


def test_feet_on_a_line_or_in_a_point_hold_nothing():
    on_line = FEET * [1.0, 0.0, 1.0]
    for com in (COM, COM + [0.0, 0.1, 0.0]):
        assert _solve(on_line, com).status == "tips"
    in_line = solve_loaded(
        on_line, COM, W, stiffness_z=EVEN, lateral_ratio=0.5, loaded=np.array([True, True, True, False, False, False])
    )
    assert in_line.status == "tips"
    assert _solve(np.tile(FEET[0], (6, 1))).status == "tips"


def test_a_mass_at_foot_height_is_solved_or_refused_but_not_wrong():
    """There eqs 6-8 no longer hold the feet's heights together to first order."""
    solution = _solve(com=np.array([0.3, 0.1, FEET[0, 2]]), lifts=_lifted(0))
    assert solution.converged
    begin = np.concatenate([solution.unsagged_from_sagged.translation, solution.unsagged_from_sagged.rotvec()])
    arguments = (FEET, np.array([0.3, 0.1, FEET[0, 2]]), EVEN, 0.5, _lifted(0), np.array([0.0, 0.0, -9.81]))
    assert np.abs(_rigid_balance(begin, *arguments)).max() < 1e-4


def test_bad_constants_shapes_and_weights_are_refused():
    with pytest.raises(SagError, match="six positive"):
        _solve(stiffness=np.array([K, K, 0.0, K, K, K]))
    with pytest.raises(SagError, match="lateral ratio is -1"):
        _solve(ratio=-1.0)
    with pytest.raises(SagError, match="weight is 0"):
        _solve(weight=0.0)
    with pytest.raises(SagError, match="lifts"):
        _solve(lifts=np.full(6, np.nan))
    with pytest.raises(SagError, match="gravity"):
        _solve(gravity_in_hex=np.zeros(3))
    with pytest.raises(SagError, match="finite"):
        _solve(feet=np.full((6, 3), np.nan))
    with pytest.raises(SagError, match="2 loaded feet"):
        solve_loaded(FEET, COM, W, stiffness_z=EVEN, lateral_ratio=0.5, loaded=np.arange(6) < 2)
    with pytest.raises(SagError, match="six positive"):
        solve_loaded(FEET, COM, W, stiffness_z=-EVEN, lateral_ratio=0.5, loaded=np.arange(6) < 4)
    with pytest.raises(SagError, match="lateral ratio is 0"):
        _solve(ratio=0.0)


def test_drawn_springs_are_even():
    springs = FootSprings.from_spec(load_spec("sdm_b"))
    assert np.ptp(springs.stiffness_z) == 0.0
    assert springs.stiffness_z[0] == load_spec("sdm_b").believed_foot_stiffness
