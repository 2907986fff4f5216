import numpy as np
import pytest
from scipy.optimize import minimize

from athlete_twin.errors import SagError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance
from planner.sag.compensate import SagConfig, lift_to_break_contact, predict_sag
from planner.sag.docked import Docks, docked_pieces, lift_off, solve_docked
from planner.sag.identify import MeasuredStance
from planner.sag.identify_docks import identify_docks, predict_docked_heights
from planner.sag.sag_model import AIRBORNE, FootSprings, solve_sag

SPEC = load_spec("t12")
KIN = kinematics("t12")
JOINTS = regular_stance(SPEC)
FEET = KIN.wheels_in_hex(JOINTS) - [0.0, 0.0, SPEC.wheel.radius]
COM = KIN.com_in_hex(JOINTS)
WEIGHT = SPEC.mass * GRAVITY
PIECES = docked_pieces(KIN, JOINTS)
K, RATIO, TWIST = np.full(6, 60e3), 0.5, 4e5
DOCKS = Docks(pieces=PIECES, twist_stiffness=TWIST)
CORNERS = np.array(SPEC.hips_in_hex)
LEGS = np.arange(6)


def _lifted(*legs):
    lifts = np.zeros(6)
    lifts[list(legs)] = AIRBORNE
    return lifts


def _solve(lifts, twist=TWIST, pieces=PIECES):
    return solve_docked(
        FEET, COM, WEIGHT, pieces=pieces, twist_stiffness=twist, stiffness_z=K, lateral_ratio=RATIO, lifts=lifts
    )


def test_pieces_and_pallet_weigh_what_the_robot_weighs():
    assert sum(p.mass for p in PIECES) + SPEC.body_mass == pytest.approx(SPEC.mass)
    moment = sum(p.mass * p.com_in_hex for p in PIECES) + SPEC.body_mass * SPEC.body_com
    np.testing.assert_allclose(moment / SPEC.mass, COM, atol=1e-9)
    assert docked_pieces(kinematics("sdm_b"), regular_stance(load_spec("sdm_b"))) == ()


@pytest.mark.parametrize("legs", [(), (0,), (1,), (2, 5)])
def test_rigid_docks_give_the_rigid_robots_sag(legs):
    docked = _solve(_lifted(*legs), twist=1e12)
    rigid = solve_sag(FEET, COM, WEIGHT, stiffness_z=K, lateral_ratio=RATIO, lifts=_lifted(*legs))
    assert docked.converged
    np.testing.assert_allclose(docked.place(CORNERS, LEGS), rigid.unsagged_from_sagged.apply(CORNERS), atol=1e-6)
    np.testing.assert_allclose(docked.forces, rigid.forces, atol=0.01)


def _energy(lifts, twist=TWIST):
    """Springs of feet and docks and the weight's height, by all unknowns in centimetres and hundredths of radians, over 100."""
    masses = np.array([p.mass for p in PIECES])
    pallet = (SPEC.mass * COM - sum(p.mass * p.com_in_hex for p in PIECES)) / (SPEC.mass - masses.sum())

    def energy(x):
        pose = SE3.from_rotvec(0.01 * x[3:6], 0.01 * x[:3])
        hinges = []
        for p, turned in zip(PIECES, 0.01 * x[6:], strict=True):
            turn = SE3.from_rotvec(turned * p.axis_in_hex, np.zeros(3))
            hinges.append(SE3(turn.rotation, p.place_in_hex - turn.rotation @ p.place_in_hex))
        feet = np.array([pose.apply(hinges[0 if leg < 3 else 1].apply(FEET[leg])) for leg in range(6)])
        moved = feet - FEET
        compression = np.maximum(-moved[:, 2] - lifts, 0.0)
        out = 0.5 * np.sum(K * compression**2) + 0.5 * twist * np.sum((0.01 * x[6:]) ** 2)
        out += 0.5 * np.sum((RATIO * K * (compression > 0.0))[:, None] * moved[:, :2] ** 2)
        for p, hinge in zip(PIECES, hinges, strict=True):
            out += p.mass * GRAVITY * pose.apply(hinge.apply(p.com_in_hex))[2]
        return (out + (SPEC.mass - masses.sum()) * GRAVITY * pose.apply(pallet)[2]) / 100.0

    return energy


def _unknowns(found):
    return np.concatenate([found.unsagged_from_sagged.translation, found.unsagged_from_sagged.rotvec(), found.twists]) / 0.01


@pytest.mark.parametrize("legs", [(), (0,), (1,), (0, 3)])
def test_the_solution_has_the_least_energy(legs):
    """Minimised without any equation of balance."""
    lifts = _lifted(*legs)
    at = _unknowns(_solve(lifts))
    best = minimize(_energy(lifts), at + 0.05, method="BFGS", options={"gtol": 1e-7})
    np.testing.assert_allclose(0.01 * best.x, 0.01 * at, atol=5e-5)


@pytest.mark.parametrize("legs", [(), (0,), (0, 2)])
@pytest.mark.parametrize("twist", [1e2, 3e3, 1e4, 3e4, 1e5, TWIST])
def test_what_its_docks_do_not_hold_upright_tips(legs, twist):
    """On soft docks the pallet turns over between the decks: what is no minimum of the energy holds nothing; the rest does."""
    found, energy = _solve(_lifted(*legs), twist=twist), _energy(_lifted(*legs), twist)
    at, step = _unknowns(found), 0.02 * np.eye(8)
    curvature = np.array(
        [[energy(at + a + b) - energy(at + a - b) - energy(at - a + b) + energy(at - a - b) for b in step] for a in step]
    )
    least = np.linalg.eigvalsh(curvature)[0] / 0.04**2
    assert abs(least) > 1e-5
    assert found.status == ("converged" if least > 0.0 else "tips")


def test_a_pallet_corners_leg_drops_its_corner_more_than_a_rigid_deck_can():
    """[SunSpiral2012] s5.1.3, figure 12 C against B."""
    drop = {}
    for leg in (1, 2):
        rigid = solve_sag(FEET, COM, WEIGHT, stiffness_z=K, lateral_ratio=RATIO, lifts=_lifted(leg))
        docked = _solve(_lifted(leg))
        drop[leg] = (rigid.unsagged_from_sagged.apply(CORNERS) - docked.place(CORNERS, LEGS))[leg, 2]
    assert drop[2] > 0.01
    assert abs(drop[1]) < 0.2 * drop[2]


@pytest.mark.parametrize("leg", [0, 1, 2])
def test_lift_off_is_where_the_gradual_model_lets_the_foot_go(leg):
    """Raised by a little less the foot still bears, by a little more it does not."""
    springs = FootSprings(stiffness_z=K, lateral_ratio=RATIO)
    found = lift_off(FEET, COM, WEIGHT, leg, docks=DOCKS, springs=springs).lift
    rigid = lift_to_break_contact(FEET, COM, WEIGHT, leg=leg, springs=springs).lift
    assert found > rigid + (0.02 if leg != 1 else -0.002)
    for more, bears in ((-0.004, True), (0.004, False)):
        feet, lifts = FEET.copy(), np.zeros(6)
        feet[leg, 2] += found + more
        lifts[leg] = found + more
        sag = solve_docked(
            feet, COM, WEIGHT, pieces=PIECES, twist_stiffness=TWIST, stiffness_z=K, lateral_ratio=RATIO, lifts=lifts
        )
        assert sag.converged and (sag.forces[leg, 2] > 0.0) == bears


@pytest.mark.parametrize("leg", [0, 1, 2])
def test_a_foreseen_lift_clears_the_ground_by_what_was_asked_once_the_deck_has_twisted(leg):
    springs = FootSprings(stiffness_z=K, lateral_ratio=RATIO)
    foreseen = predict_sag(
        FEET, leg, com_planted=COM, com_airborne=COM, weight=WEIGHT, clearance=0.1, config=SagConfig(), springs=springs, docks=DOCKS
    )
    lifted = FEET[leg] + [0.0, 0.0, foreseen.commanded_lift]
    assert (foreseen.unsagged_from_leg.apply(lifted) - FEET[leg])[2] == pytest.approx(0.1, abs=1e-9)
    sag = _solve(_lifted(leg))
    np.testing.assert_allclose(
        foreseen.unsagged_from_leg.apply(FEET[leg]), sag.place(FEET[leg : leg + 1], np.array([leg]))[0], atol=1e-9
    )
    np.testing.assert_allclose(foreseen.forces_swinging, sag.forces, atol=1e-6)
    rigid = predict_sag(
        FEET, leg, com_planted=COM, com_airborne=COM, weight=WEIGHT, clearance=0.1, config=SagConfig(), springs=springs
    )
    np.testing.assert_allclose(rigid.swinging_from_leg.matrix(), np.eye(4), atol=1e-12)


def _measured(legs, stiffness, twist, noise=0.0, seed=0):
    lifts = _lifted(*legs)
    blank = MeasuredStance(
        feet_in_hex=FEET, com_in_hex=COM, weight=WEIGHT, lifts=lifts, corners_in_hex=CORNERS, heights=np.zeros(6),
        origin_height=SPEC.chassis_height,
    )  # fmt: skip
    heights = predict_docked_heights(blank, PIECES, stiffness=stiffness, twist_stiffness=twist, lateral_ratio=RATIO)
    heights = heights + np.random.default_rng(seed).normal(0.0, noise, 6)
    return MeasuredStance(
        feet_in_hex=FEET, com_in_hex=COM, weight=WEIGHT, lifts=lifts, corners_in_hex=CORNERS, heights=heights,
        origin_height=SPEC.chassis_height,
    )  # fmt: skip


@pytest.mark.slow
def test_both_constants_are_found_again_from_noisy_heights():
    stances = [_measured(legs, 55e3, 5e5, noise=0.003, seed=k) for k, legs in enumerate([(), (0,), (1,), (2,), (0, 3)])]
    fit = identify_docks(stances, [PIECES] * 5, start=40e3)
    assert fit.stiffness == pytest.approx(55e3, rel=0.04)
    assert fit.twist_stiffness == pytest.approx(5e5, rel=0.2)
    assert fit.mean_error < 0.003


def test_wrong_use_is_refused():
    with pytest.raises(SagError, match=r"0.0 N m/rad, must be positive"):
        _solve(np.zeros(6), twist=0.0)
    with pytest.raises(SagError, match="the whole robot"):
        solve_docked(
            FEET, COM, 1000.0, pieces=PIECES, twist_stiffness=TWIST, stiffness_z=K, lateral_ratio=RATIO, lifts=np.zeros(6)
        )
    with pytest.raises(SagError, match="needs its own"):
        identify_docks([_measured((), 55e3, 5e5)], [()], start=40e3)
    for bad in (np.nan, 0.0, -1.0, np.inf):
        with pytest.raises(SagError, match=r"begins at (nan|0\.0|-1\.0|inf) N/m, must be positive and finite"):
            identify_docks([_measured((), 55e3, 5e5)], [PIECES], start=bad)
    for bad in (np.nan, 1e3, 1e9):
        with pytest.raises(SagError, match=r"docks from .* N m/rad, must be within 20000 to 20000000"):
            identify_docks([_measured((), 55e3, 5e5)], [PIECES], start=40e3, start_twist=bad)


def test_what_cannot_stand_says_why():
    assert _solve(_lifted(0, 1, 2, 5)).status == "too_few_feet"
    aside = COM + [5.0, 0.0, 0.0]
    arguments = dict(pieces=PIECES, twist_stiffness=TWIST, stiffness_z=K, lateral_ratio=RATIO, lifts=_lifted())
    assert solve_docked(FEET, aside, WEIGHT, **arguments).status == "tips"
