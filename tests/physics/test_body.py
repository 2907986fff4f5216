"""The true robot against closed forms and the published figures (robot facts, section 10)."""

import numpy as np
import pytest

from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.physics.body import Body, settled

ROBOTS = ("sdm_b", "t12")
SETTLING_TICKS = 2400


def rest(body: Body, commands: np.ndarray, *, ticks: int = SETTLING_TICKS) -> None:
    limits = np.full(commands.shape, 0.2)
    for k in range(ticks):
        body.step(commands, limits)
        if k > 240 and k % 60 == 0 and settled(body):
            return


@pytest.mark.parametrize("robot", ROBOTS)
def test_mass_is_that_of_the_drawings(make_body, robot):
    assert make_body(robot).mass == pytest.approx(load_spec(robot).mass, abs=1e-6)


@pytest.mark.parametrize("robot", ROBOTS)
def test_centre_of_mass_of_twin_and_drawings_agree(make_body, robot):
    body = make_body(robot)
    believed = kinematics(robot).com_in_hex(body.joints)
    true = body.world_from_hex().inverse().apply(body.com_in_world())
    assert np.linalg.norm(true - believed) < 1e-6


def test_sdm_b_sags_by_the_root_of_its_tyres_quadratic(make_body):
    body = make_body("sdm_b")
    rest(body, body.joints.copy())
    truth, load = body.trial.truth, body.mass * GRAVITY / 6
    deflection = (np.sqrt(truth.tyre_k1**2 + 4 * truth.tyre_k2 * load) - truth.tyre_k1) / (2 * truth.tyre_k2)
    assert body.tyre.deflections == pytest.approx(np.full(6, deflection), abs=1e-3)
    assert deflection == pytest.approx(0.061, abs=1e-3)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.slow
@pytest.mark.ci
def test_ground_carries_the_weight_and_nothing_sideways(make_body, robot):
    body = make_body(robot)
    commands = body.joints.copy()
    rest(body, commands)
    for _ in range(960):  # the last tenth of a millimetre of T12's slow bounce
        body.step(commands, np.full(commands.shape, 0.1))
    total = body.tyre.forces_in_world.sum(axis=0)
    assert total == pytest.approx([0.0, 0.0, body.mass * GRAVITY], abs=2e-3 * body.mass * GRAVITY)


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.slow
@pytest.mark.ci
def test_a_robot_at_rest_stays_where_it_is(make_body, robot):
    body = make_body(robot)
    commands = body.joints.copy()
    rest(body, commands)
    before = body.world_from_hex()
    for _ in range(480):
        body.step(commands, np.full(commands.shape, 0.1))
    after = body.world_from_hex()
    assert np.linalg.norm(after.translation - before.translation) < 1e-3
    assert not body.hull_contacts()


@pytest.mark.slow
@pytest.mark.ci
def test_lifting_one_leg_loads_its_neighbours_as_published(make_body):
    """0.2778 / 0.1667 / 0.1111 of the weight with one leg up, within 0.01, equal tyres (robot facts 10, item 2)."""
    body = make_body("sdm_b", foot_radius=1.793)
    commands = body.joints.copy()
    rest(body, commands, ticks=960)
    wheel = kinematics("sdm_b").leg_wheel(0, commands[0]).translation
    lifted, ok = leg_ik(body.spec, 0, (wheel + [0.0, 0.0, 0.30])[None])
    assert ok[0]
    commands[0] = lifted[0]
    rest(body, commands, ticks=4800)
    share = body.tyre.loads / (body.mass * GRAVITY)
    assert share[0] == 0.0
    # At real CoM height and finite lateral stiffness the neighbours carry 0.2825-0.2852 (robot facts 10).
    assert share[[1, 5]] == pytest.approx([0.2778, 0.2778], abs=0.01)
    assert share[[2, 4]] == pytest.approx([0.1667, 0.1667], abs=0.01)
    assert share[3] == pytest.approx(0.1111, abs=0.01)


@pytest.mark.slow
def test_t12_corner_leg_sags_more_than_a_middle_leg(make_body):
    """[SunSpiral2012] s5.1.3, fig. 12: a lifted pallet-corner leg (1, 3, 4, 6) drops its corner more than 2 or 5."""
    drops = {}
    for leg in (0, 1):
        body = make_body("t12")
        commands = body.joints.copy()
        rest(body, commands)
        hip = f"leg{leg + 1}_hip_yaw"
        before = body.link_poses()[hip].translation[2]
        wheel = kinematics("t12").leg_wheel(leg, commands[leg]).translation
        lifted, ok = leg_ik(body.spec, leg, (wheel + [0.0, 0.0, 0.35])[None])
        assert ok[0]
        commands[leg] = lifted[0]
        rest(body, commands, ticks=6000)
        assert body.tyre.loads[leg] == 0.0
        drops[leg] = before - body.link_poses()[hip].translation[2]
    assert drops[0] > drops[1] > 0.0


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.slow
@pytest.mark.ci
def test_rebuilt_worlds_give_the_same_bytes(make_body, robot):
    def run() -> bytes:
        body = make_body(robot)
        commands = body.joints.copy()
        commands[0, 1] += 0.05
        for _ in range(200):
            body.step(commands, np.full(commands.shape, 0.05))
        return body.joints.tobytes() + body.world_from_hex().matrix().tobytes()

    assert run() == run()


@pytest.mark.parametrize("robot", ROBOTS)
def test_motors_that_push_against_the_ground_stall_at_their_limits(make_body, robot):
    body = make_body(robot)
    commands = body.joints.copy()
    commands[:, body.spec.joint_names.index("knee_pitch")] += 1.0  # all knees at once
    rate = body.spec.speed_loaded
    for _ in range(480):
        body.step(commands, np.full(commands.shape, rate))
        # The load may swing beyond what the motors bring; no gear ratchets and no brake slips.
        assert (np.abs(body.torques()) <= 1.2 * body.spec.torque_limits).all()
    driven = np.abs(body.motors - commands) > 0.1
    assert driven[:, body.spec.joint_names.index("knee_pitch")].all()  # they stalled long before their command
    assert not body.slipped.any()


@pytest.mark.parametrize("robot, kmh", [("sdm_b", 3.0), ("t12", 2.0)])
@pytest.mark.slow
@pytest.mark.ci
def test_driven_wheels_carry_the_robot_at_its_published_speed(make_body, robot, kmh):
    """3 km/h and 2 km/h on flat ground (robot facts 1), wheels steered along x."""
    body = make_body(robot)
    body.place(body.world_from_hex(), steered(body))
    commands = body.joints.copy()
    rest(body, commands, ticks=1200)
    speed = kmh / 3.6
    # A tyre that gives way by d rolls on radius R - d / 5: the mean of its patch, weighted by depth.
    turn = np.sign(body.axes[:, 1]) * speed / (body.spec.wheel.radius - 0.2 * body.tyre.deflections)
    limits = np.full(commands.shape, 0.1)
    for k in range(480):
        body.step(commands, limits, turn * min(1.0, k / 240))
    before = body.world_from_hex().translation
    for _ in range(480):
        body.step(commands, limits, turn)
    moved = body.world_from_hex().translation - before
    assert moved[0] / (480 / 240) == pytest.approx(speed, rel=0.03)
    assert abs(moved[1]) < 0.05
    for k in range(480):
        body.step(commands, limits, turn * max(0.0, 1 - k / 240))
    stopped = body.world_from_hex().translation
    for _ in range(480):
        body.step(commands, limits)
    assert np.linalg.norm(body.world_from_hex().translation - stopped) < 0.02


def steered(body: Body) -> np.ndarray:
    """The stance with every ankle rolled so that its axle lies across x; at zero a wheel rolls outward."""
    joints = body.joints.copy()
    azimuth = np.arctan2(body.axes[:, 1], body.axes[:, 0]) - 0.5 * np.pi
    joints[:, -1] += (azimuth + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    return joints


@pytest.mark.parametrize("robot", ROBOTS)
def test_spread_draws_are_the_seeds_own(robot):
    from athlete_twin.physics.truth import draw_truth

    spec = load_spec(robot)
    a, b, c = (draw_truth(spec, seed, link_names=("hex",)) for seed in (3, 3, 4))
    assert np.array_equal(a.tyre_scale, b.tyre_scale)
    assert not np.array_equal(a.tyre_scale, c.tyre_scale)
    many = np.concatenate([draw_truth(spec, seed, link_names=()).tyre_scale for seed in range(200)])
    assert many.std() == pytest.approx(0.125, abs=0.01)
