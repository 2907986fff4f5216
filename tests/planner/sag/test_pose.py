import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from athlete_twin.errors import SagError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.reach import all_legs_ik
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from athlete_twin.moves import body_move
from planner.sag.compensate import SagConfig, predict_sag
from planner.sag.lift_pose import LiftPose, NoPose, PoseConfig
from planner.sag.pose import optimise_pose
from planner.sag.sag_model import AIRBORNE, FootSprings, solve_sag

ROBOTS = ["sdm_b", "t12"]
TENTH_OF_A_MILLIMETRE, MICROMETRE, TEN_MICRORADIANS = 1e-4, 1e-6, 1e-5
STILL = PoseConfig(max_shift=0.0)
CLEARANCE = 0.20


def _uneven(robot: str, seed: int = 5) -> FootSprings:
    drawn = FootSprings.from_spec(kinematics(robot).spec)
    stiffness = drawn.stiffness_z * (1.0 + np.random.default_rng(seed).normal(0.0, 0.125, 6))
    return FootSprings(stiffness_z=stiffness, lateral_ratio=drawn.lateral_ratio)


def _optimise(robot, leg, *, springs=None, config=STILL, **more):
    kin = kinematics(robot)
    springs = FootSprings.from_spec(kin.spec) if springs is None else springs
    more = {"motors": regular_stance(kin.spec), "clearance": CLEARANCE, **more}
    return optimise_pose(kin, more.pop("motors"), leg, springs=springs, config=config, **more)


def _carried_out(robot, motors, pose, *, springs, lifts=None, down=None):
    """Move and lift as the executive does them, then the springs: pose of the sagged chassis before the move, and loads."""
    kin = kinematics(robot)
    down = np.array([0.0, 0.0, -1.0]) if down is None else down / np.linalg.norm(down)
    *_, moved = body_move(kin, pose.move, motors, 0.1)
    start_from_hex = SE3.from_rotvec(pose.move.rotvec_in_hex, pose.move.translation_in_hex)
    down_in_hex = start_from_hex.rotation.T @ down
    axles = kin.wheels_in_hex(moved)
    up_by = -(pose.move.wheel_offsets_in_hex @ down_in_hex)
    lifts = up_by + (np.zeros(6) if lifts is None else lifts)
    lifts[pose.leg] = AIRBORNE
    sag = solve_sag(
        axles, kin.com_in_hex(pose.motors), kin.spec.mass * GRAVITY,
        stiffness_z=springs.stiffness_z, lateral_ratio=springs.lateral_ratio, lifts=lifts, gravity_in_hex=down_in_hex,
    )  # fmt: skip
    assert sag.converged
    return start_from_hex.compose(sag.unsagged_from_sagged), -(sag.forces @ down_in_hex)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("leg", range(6))
@pytest.mark.parametrize("even", [True, False])
def test_the_forward_model_finds_the_chassis_where_it_is_wanted(robot, leg, even):
    kin = kinematics(robot)
    springs = FootSprings.from_spec(kin.spec) if even else _uneven(robot)
    motors = regular_stance(kin.spec)
    pose = _optimise(robot, leg, springs=springs)
    assert isinstance(pose, LiftPose)
    chassis, loads = _carried_out(robot, motors, pose, springs=springs)
    assert np.abs(chassis.translation).max() < TENTH_OF_A_MILLIMETRE
    assert np.linalg.norm(chassis.rotvec()) < TEN_MICRORADIANS
    assert np.abs(pose.sagged_from_wanted.translation).max() < TENTH_OF_A_MILLIMETRE
    assert loads == pytest.approx(pose.airborne.forces @ [0.0, 0.0, 1.0], abs=0.02 * kin.spec.mass * GRAVITY)
    assert loads[leg] == 0.0
    # The wheel that is commanded up clears its place by what was asked, without extra lift.
    over = chassis.apply(pose.lift_in_hex) - kin.wheels_in_hex(motors)[leg]
    assert over == pytest.approx([0.0, 0.0, CLEARANCE], abs=TENTH_OF_A_MILLIMETRE)


def test_an_even_hexagon_has_the_closed_form():
    """2/9 + cos/9 of the weight on each wheel, and a chassis that is commanded up by the compressions these make."""
    kin = kinematics("sdm_b")
    springs = FootSprings(stiffness_z=np.full(6, 25e3), lateral_ratio=0.5)
    motors, weight = regular_stance(kin.spec), kin.spec.mass * GRAVITY
    pose = _optimise("sdm_b", 0, springs=springs, clearance=0.0)
    at = np.deg2rad([60.0, 120.0, 180.0, 240.0, 300.0])
    # Legs that reach further down move the CoM by a centimetre, which is worth a thousandth of the weight.
    assert pose.airborne.forces[1:, 2] / weight == pytest.approx(2.0 / 9.0 + np.cos(at) / 9.0, abs=2e-3)
    com = pose.airborne.unsagged_from_sagged.apply(kin.com_in_hex(pose.motors))
    com = SE3.from_rotvec(pose.move.rotvec_in_hex, pose.move.translation_in_hex).apply(com)
    balance = np.vstack([np.ones(5), 1.95 * np.cos(at), 1.95 * np.sin(at)])
    exact = np.linalg.pinv(balance) @ [1.0, com[0], com[1]]
    assert pose.airborne.forces[1:, 2] / weight == pytest.approx(exact, abs=2e-4)
    assert np.abs(pose.move.wheel_offsets_in_hex).max() < TENTH_OF_A_MILLIMETRE
    # The commanded chassis stands over the wanted one by what the springs give way: a plane through the compressions.
    commanded = SE3.from_rotvec(pose.move.rotvec_in_hex, pose.move.translation_in_hex)
    raised = commanded.inverse().apply(kin.wheels_in_hex(motors)) - kin.wheels_in_hex(motors)
    expected = weight / 25e3 * (2.0 / 9.0 + np.cos(np.deg2rad(60.0 * np.arange(6))) / 9.0)
    assert -raised[:, 2] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("robot", ROBOTS)
def test_mirrored_legs_have_mirrored_poses(robot):
    kin = kinematics(robot)
    feet = kin.wheels_in_hex(regular_stance(kin.spec))
    for leg in range(6):
        other = int(np.argmin(np.linalg.norm(feet - feet[leg] * [1.0, -1.0, 1.0], axis=1)))
        one, two = (_optimise(robot, j, config=PoseConfig(max_shift=0.05)) for j in (leg, other))
        assert one.move.translation_in_hex == pytest.approx(two.move.translation_in_hex * [1, -1, 1], abs=2e-3)
        assert one.move.rotvec_in_hex == pytest.approx(two.move.rotvec_in_hex * [-1, 1, -1], abs=1e-3)


def _levelled_loads(robot, motors, leg, offsets, *, springs):
    """Loads with given offsets, the chassis commanded so that it sags to where it was commanded first."""
    kin, lifts = kinematics(robot), offsets.copy()
    lifts[leg] = AIRBORNE
    stood, start_from_hex, up = kin.wheels_in_hex(motors), SE3.identity(), np.array([0.0, 0.0, 1.0])
    for _ in range(6):
        hex_from_start = start_from_hex.inverse()
        axles = hex_from_start.apply(stood + offsets[:, None] * up)
        axles[leg] = stood[leg] + CLEARANCE * up
        joints, reached = all_legs_ik(kin.spec, axles, last_link_in_hex=hex_from_start.rotate(-up))
        assert reached.all()
        sag = solve_sag(
            axles, kin.com_in_hex(joints), kin.spec.mass * GRAVITY, stiffness_z=springs.stiffness_z,
            lateral_ratio=springs.lateral_ratio, lifts=lifts, gravity_in_hex=hex_from_start.rotate(-up),
        )  # fmt: skip
        assert sag.converged
        if np.abs(start_from_hex.compose(sag.unsagged_from_sagged).matrix() - np.eye(4)).max() < MICROMETRE:
            break
        start_from_hex = sag.unsagged_from_sagged.inverse()
    return sag.forces @ hex_from_start.rotate(up)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(("max_offset", "seed"), [(0.003, 3), (0.05, 3), (0.003, 5), (0.05, 5)])
def test_brute_force_over_offsets_spreads_nothing_better(robot, max_offset, seed):
    kin = kinematics(robot)
    springs, motors, leg = _uneven(robot, seed), regular_stance(kin.spec), 0
    pose = _optimise(robot, leg, springs=springs, config=PoseConfig(max_shift=0.0, max_offset=max_offset))
    assert any(why.startswith("offset of leg") for why in pose.limited_by) == (max_offset < 0.01)
    start_from_hex = SE3.from_rotvec(pose.move.rotvec_in_hex, pose.move.translation_in_hex)
    chosen = start_from_hex.rotate(pose.move.wheel_offsets_in_hex)[:, 2]
    assert np.abs(chosen).max() <= max_offset * (1.0 + 1e-6)
    best = np.sum(_levelled_loads(robot, motors, leg, chosen, springs=springs) ** 2)
    assert best == pytest.approx(np.sum(pose.airborne.forces[:, 2] ** 2), rel=2e-3)
    rng = np.random.default_rng(2)
    for size in (1.0, 0.1):
        for _ in range(60):
            tried = np.clip(chosen + size * rng.uniform(-max_offset, max_offset, 6), -max_offset, max_offset)
            other = np.sum(_levelled_loads(robot, motors, leg, tried, springs=springs) ** 2)
            assert other >= best * (1.0 - 5e-4)  # legs that stand otherwise move the CoM, by a millimetre at most


def test_offsets_pay_on_uneven_springs():
    springs = _uneven("sdm_b")
    rigid = _optimise("sdm_b", 0, springs=springs, config=PoseConfig(max_shift=0.0, max_offset=0.0))
    free = _optimise("sdm_b", 0, springs=springs)
    assert not rigid.move.wheel_offsets_in_hex.any()
    assert np.sum(free.airborne.forces[:, 2] ** 2) < np.sum(rigid.airborne.forces[:, 2] ** 2)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_shift_goes_away_from_the_leg_and_lowers_the_peak(robot):
    for leg in range(6):
        still, shifted = _optimise(robot, leg), _optimise(robot, leg, config=PoseConfig(max_shift=0.1))
        spot = kinematics(robot).wheels_in_hex(regular_stance(kinematics(robot).spec))[leg]
        assert shifted.move.translation_in_hex[:2] @ spot[:2] < still.move.translation_in_hex[:2] @ spot[:2]
        assert shifted.peak_load < still.peak_load
        assert "shift of 0.1 m" in shifted.limited_by and not still.limited_by


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_other_shift_within_the_bound_spreads_better(robot):
    bound, springs = 0.1, _uneven(robot)
    chosen = _optimise(robot, 1, springs=springs, config=PoseConfig(max_shift=bound))
    best = np.sum(chosen.airborne.forces**2)
    for angle in np.linspace(0.0, 2.0 * np.pi, 36, endpoint=False):
        for radius in (0.5 * bound, bound):
            place = SE3.from_translation(radius * np.array([np.cos(angle), np.sin(angle), 0.0]))
            other = _optimise(robot, 1, springs=springs, wanted_in_hex=place)
            assert np.sum(other.airborne.forces**2) >= best * (1.0 - 1e-5)


def test_three_wheels_on_a_line_are_refused():
    lifts = np.full(6, AIRBORNE)
    lifts[[0, 1, 2, 4]] = 0.0
    kin = kinematics("sdm_b")
    motors = regular_stance(kin.spec)
    axles = kin.wheels_in_hex(motors)
    axles[[0, 1, 2], :2] = np.array([[1.826, 0.562], [0.7, 1.212], [-0.426, 1.862]])
    joints, reached = all_legs_ik(kin.spec, axles)
    assert reached.all()
    answer = _optimise("sdm_b", 4, motors=joints, lifts=lifts)
    assert isinstance(answer, NoPose)
    assert re.search(r"span 0.000 m across, a line", answer.reason), answer.reason


def test_wheels_that_stand_unevenly_are_evened_out():
    lifts = np.array([0.0, 0.012, -0.008, 0.004, -0.015, 0.009])
    kin, springs = kinematics("sdm_b"), FootSprings.from_spec(kinematics("sdm_b").spec)
    pose = _optimise("sdm_b", 0, lifts=lifts)
    even = _optimise("sdm_b", 0)
    assert pose.airborne.forces[:, 2] == pytest.approx(even.airborne.forces[:, 2], abs=0.003 * kin.spec.mass * GRAVITY)
    chassis, _ = _carried_out("sdm_b", regular_stance(kin.spec), pose, springs=springs, lifts=lifts)
    assert np.abs(chassis.translation).max() < TENTH_OF_A_MILLIMETRE


def test_on_a_slope_the_chassis_is_level_while_the_leg_is_up():
    down = np.array([0.06, -0.03, -1.0])
    kin, springs = kinematics("sdm_b"), FootSprings.from_spec(kinematics("sdm_b").spec)
    pose = _optimise("sdm_b", 2, gravity_in_hex=down)
    assert isinstance(pose, LiftPose), pose
    chassis, _ = _carried_out("sdm_b", regular_stance(kin.spec), pose, springs=springs, down=down)
    up = -down / np.linalg.norm(down)
    assert chassis.rotation @ [0.0, 0.0, 1.0] == pytest.approx(up, abs=TEN_MICRORADIANS)
    assert np.abs(chassis.translation).max() < TENTH_OF_A_MILLIMETRE


def test_another_pose_can_be_wanted():
    wanted = SE3.from_rotvec(np.array([0.01, -0.02, 0.0]), np.array([0.02, 0.01, -0.05]))
    kin, springs = kinematics("t12"), FootSprings.from_spec(kinematics("t12").spec)
    pose = _optimise("t12", 4, wanted_in_hex=wanted)
    chassis, _ = _carried_out("t12", regular_stance(kin.spec), pose, springs=springs)
    assert np.abs(chassis.matrix() - wanted.matrix()).max() < TENTH_OF_A_MILLIMETRE


@pytest.mark.parametrize("robot", ROBOTS)
def test_it_undoes_the_sink_and_tilt_that_the_compensation_foresees(robot):
    kin = kinematics(robot)
    motors, springs = regular_stance(kin.spec), FootSprings.from_spec(kin.spec)
    com = kin.com_in_hex(motors)
    plain = predict_sag(
        kin.wheels_in_hex(motors), 0, com_planted=com, com_airborne=com, weight=kin.spec.mass * GRAVITY,
        clearance=CLEARANCE, springs=springs, config=SagConfig(),
    )  # fmt: skip
    assert np.linalg.norm(plain.unsagged_from_swinging.rotvec()) > 0.01
    assert plain.unsagged_from_swinging.translation[2] < -0.05
    pose = _optimise(robot, 0)
    assert np.linalg.norm(pose.sagged_from_wanted.rotvec()) < TEN_MICRORADIANS


def test_a_leg_out_of_reach_is_named():
    kin = kinematics("sdm_b")
    high = regular_stance(kin.spec, chassis_height=kin.spec.chassis_height + 0.28)
    answer = _optimise("sdm_b", 0, motors=high)
    assert isinstance(answer, NoPose)
    assert answer.reason.startswith("reach of leg ")


def test_a_shift_that_reach_cuts_short_says_so():
    kin = kinematics("sdm_b")
    wide = regular_stance(kin.spec, foot_radius=2.1)
    found = [_optimise("sdm_b", leg, motors=wide, config=PoseConfig(max_shift=0.3)) for leg in range(6)]
    assert any(isinstance(f, LiftPose) and any(why.startswith("reach of leg") for why in f.limited_by) for f in found), found


def test_every_bound_is_named_with_its_value():
    for config, says in (
        (PoseConfig(max_rise=0.02), r"commanded 0\.\d+ m up, the bound is 0.02 m"),
        (PoseConfig(max_tilt=0.01), r"commanded 0\.\d+ rad off, the bound is 0.01 rad"),
        (PoseConfig(min_margin=1.2), r"margin with leg 1 lifted is \d\.\d+ m, the least is 1.2 m"),
    ):
        answer = _optimise("sdm_b", 0, config=config)
        assert isinstance(answer, NoPose)
        assert re.search(says, answer.reason), answer.reason
    uneven = _optimise("sdm_b", 0, springs=_uneven("sdm_b"), config=PoseConfig(max_shift=0.0, max_offset=0.003))
    assert any(why.startswith("offset of leg") for why in uneven.limited_by)


def test_what_cannot_stand_is_refused_with_a_reason():
    lifts = np.zeros(6)
    lifts[[1, 5]] = AIRBORNE
    assert re.fullmatch(r"margin with leg 1 lifted is -0\.\d+ m on the wanted pose", _optimise("sdm_b", 0, lifts=lifts).reason)
    lifts[5] = 0.0
    near_the_edge = _optimise("t12", 0, lifts=lifts, wanted_in_hex=SE3.from_translation(np.array([0.0, 0.0, 0.1])))
    assert isinstance(near_the_edge, NoPose), near_the_edge
    assert re.match("margin with leg 1|the springs say (tips|not_converged) with leg 1 lifted, margin -", near_the_edge.reason)
    lifts[[2, 4]] = AIRBORNE
    assert _optimise("sdm_b", 0, lifts=lifts).reason == "2 of 6 wheels stand once leg 1 is up, at least 3 carry a robot"
    floating = np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])
    answer = _optimise("sdm_b", 0, lifts=floating)
    assert isinstance(answer, NoPose) and "within offsets of 0.05 m" in answer.reason


def test_two_opposite_legs_in_the_air_leave_a_pose():
    lifts = np.zeros(6)
    lifts[3] = AIRBORNE
    pose = _optimise("sdm_b", 0, lifts=lifts)
    assert isinstance(pose, LiftPose), pose
    assert pose.airborne.forces[[1, 2, 4, 5], 2] == pytest.approx(np.full(4, pose.airborne.forces[:, 2].sum() / 4), rel=5e-3)


def test_wrong_use_is_refused():
    with pytest.raises(SagError, match="leg index 6"):
        _optimise("sdm_b", 6)
    with pytest.raises(SagError, match=r"clearance is -0\.1"):
        _optimise("sdm_b", 0, clearance=-0.1)
    with pytest.raises(SagError, match="six heights"):
        _optimise("sdm_b", 0, lifts=np.full(6, np.nan))
    with pytest.raises(SagError, match="gravity is"):
        _optimise("sdm_b", 0, gravity_in_hex=np.zeros(3))
    with pytest.raises(SagError, match="max_shift is -1"):
        PoseConfig(max_shift=-1.0)
    with pytest.raises(SagError, match=r"min_load_fraction is 0\.5"):
        PoseConfig(min_load_fraction=0.5)
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(SagError, match=r"min_margin is -?(nan|inf) m, must be finite, or None"):
            PoseConfig(min_margin=bad)
    with pytest.raises(SagError, match="max_rise is nan"):
        PoseConfig(max_rise=np.nan)
    with pytest.raises(SagError, match="six positive"):
        _optimise("sdm_b", 0, springs=FootSprings(stiffness_z=-np.ones(6), lateral_ratio=0.5))


@given(seed=st.integers(0, 10_000), robot=st.sampled_from(ROBOTS))
@pytest.mark.slow
def test_any_stance_has_a_pose_that_the_forward_model_confirms_or_a_reason(seed, robot):
    rng, kin = np.random.default_rng(seed), kinematics(robot)
    motors, reached = all_legs_ik(kin.spec, stance_wheels_in_hex(kin.spec) + rng.normal(0.0, 0.08, (6, 3)))
    if not reached.all():
        return
    springs = _uneven(robot, seed)
    lifts, down, leg = rng.normal(0.0, 0.01, 6), np.array([*rng.normal(0.0, 0.03, 2), -1.0]), int(rng.integers(6))
    config = PoseConfig(max_shift=0.0, max_offset=float(rng.choice([0.0, 0.02])))
    pose = _optimise(robot, leg, motors=motors, springs=springs, lifts=lifts, gravity_in_hex=down, config=config)
    if isinstance(pose, NoPose):
        assert re.match(r"reach of leg|(CPS )?margin|the springs say|no loads of|the chassis must be", pose.reason), pose.reason
        return
    chassis, loads = _carried_out(robot, motors, pose, springs=springs, lifts=lifts, down=down)
    up = -down / np.linalg.norm(down)
    assert chassis.rotation[:, 2] == pytest.approx(up, abs=TEN_MICRORADIANS)
    assert np.abs(chassis.translation).max() < TENTH_OF_A_MILLIMETRE
    assert loads[leg] == 0.0 and np.delete(loads, leg).min() > 0.019 * kin.spec.mass * GRAVITY
