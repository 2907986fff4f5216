"""Previews: what a sequence does by another reckoning, by the mock that carries it out, and each fault by its name."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from athlete_twin.errors import ConfigError, PlanningError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import (
    BodyMove,
    CommandSequence,
    Drive,
    ImageRequest,
    JointMove,
    LegMove,
    Receipt,
    Telemetry,
    Wait,
)
from athlete_twin.mock import MockAthlete
from athlete_twin.model.kinematics import GRAVITY, kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.straight_moves import WHEEL_SPEED
from planner.belief import BeliefFilter
from planner.motion.collision import BodyCollision
from planner.motion.collision_parts import CollisionConfig
from planner.perception.localise import WheelFitConfig
from planner.preview.foresee import PreviewConfig, foresee, known_ground, posing
from planner.preview.preview import FAULTS
from planner.preview.standing import Stance
from planner.preview.ways import SETTLING_TIME, stretch
from planner.sag.sag_model import FootSprings

FLAT = HeightGrid(origin_x=-6.0, origin_y=-6.0, cell=0.05, heights=np.zeros((241, 241)))
ROBOTS = ("sdm_b", "t12")
UP = np.array([0.0, 0.0, 1.0])
MILLIMETRE = 1e-3


@pytest.fixture(params=ROBOTS)
def robot(request) -> SimpleNamespace:
    return standing(request.param)


def standing(name: str) -> SimpleNamespace:
    """The mock after its first telemetry, and what is believed of it."""
    spec, kin = load_spec(name), kinematics(name)
    mock = MockAthlete(spec)
    (hello,) = mock.advance(1.0)
    assert isinstance(hello, Telemetry)
    springs = FootSprings.from_spec(spec)
    belief = BeliefFilter(kin, springs, payload_kg=0.0, config=WheelFitConfig()).update(hello)
    return SimpleNamespace(spec=spec, kin=kin, mock=mock, springs=springs, belief=belief)


def sequence(robot, *commands, **limits) -> CommandSequence:
    return CommandSequence(seq=0, robot_id=robot.spec.name, t=0.0, sequence_id=0, commands=commands, **limits)


def seen(robot, *commands, terrain=FLAT, docks=True, **limits):
    return foresee(robot.kin, robot.belief, sequence(robot, *commands, **limits), terrain=terrain, springs=robot.springs, docks=docks)


def lifted(robot, leg: int, by: float) -> LegMove:
    axle = robot.kin.leg_wheel(leg, robot.belief.motors[leg]).translation
    return LegMove(leg=leg, wheel_in_hex=axle + by * UP, guard="break_contact")


def a_step(robot, leg: int = 0) -> tuple:
    """Up, a little outwards through the air, down until half of the share is carried, the chassis ahead, a picture."""
    high = {"sdm_b": 0.25, "t12": 0.42}[robot.spec.name]
    up = lifted(robot, leg, high)
    share = float(0.5 * robot.belief.loads[leg])
    axle, out = up.wheel_in_hex, np.append(robot.spec.hips_in_hex[leg, :2], 0.0)
    above = LegMove(leg=leg, wheel_in_hex=axle + 0.1 * out / np.linalg.norm(out), guard="none")
    swung = stretch(robot.kin, above, stretch(robot.kin, up, robot.belief.motors).motors[-1]).motors[-1, leg]
    return (
        up,
        JointMove(leg=leg, waypoints=swung[None]),
        LegMove(leg=leg, wheel_in_hex=above.wheel_in_hex - (high + 0.3) * UP, guard="contact", contact_load=share),
        BodyMove(translation_in_hex=np.array([0.08, 0.0, 0.0])),
        ImageRequest(cameras=(robot.spec.cameras[0].name,)),
    )  # fmt: skip


def carried_out(robot, *commands) -> list[float]:
    """When the mock has completed each command, and the sequence [s]."""
    mock = robot.mock
    begun = mock.t
    mock.receive(sequence(robot, *commands))
    ends = []
    while mock.busy:
        ends += [m.t - begun for m in mock.advance(mock.t + 0.05) if isinstance(m, Receipt) and m.status == "completed"]
    return ends


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("leg", [0, 1, 3])
def test_the_mock_carries_out_what_was_foreseen(robot, leg):
    commands = a_step(robot, leg)
    preview = seen(robot, *commands, docks=False)
    assert not preview.faults
    ends = carried_out(robot, *commands)
    assert len(ends) == len(commands) + 1
    foreseen = [*preview.begins[1:], preview.duration - SETTLING_TIME, preview.duration]
    # The mock's springs are vertical, its decks rigid: what remains is when its wheels leave the ground and meet it.
    assert np.abs(np.diff(foreseen, prepend=0.0) - np.diff(ends, prepend=0.0)).max() < 1.0
    truth = robot.mock.truth()
    there = truth.wheels_in_world - preview.wheels_in_world[-1]
    others = np.arange(6) != leg
    assert np.linalg.norm(there[others, :2], axis=1).max() < 0.01
    assert np.linalg.norm(there[leg, :2]) < 0.03
    turned = truth.world_from_hex.translation - preview.world_from_hex[-1].translation
    assert np.linalg.norm(turned[:2]) < 0.01


def test_a_chassis_that_moves_leaves_its_wheels_where_they_are(robot):
    way = np.array([0.06, -0.04, 0.03])
    preview = seen(robot, BodyMove(translation_in_hex=way))
    first, last = preview.world_from_hex[0], preview.world_from_hex[-1]
    # Loads go from wheel to wheel, and the springs with them.
    assert np.linalg.norm(last.translation - first.translation - first.rotate(way)) < 0.02
    # Wheels are locked to their forks: by what the chassis tilts on its springs they roll, about patches that stay.
    radius = robot.spec.wheel.radius
    tilts = np.array([(pose.rotation @ first.rotation.T)[:2, 2] for pose in preview.world_from_hex])
    beside = preview.wheels_in_world[:, :, :2] - preview.wheels_in_world[0, :, :2]
    assert np.abs(beside - radius * tilts[:, None]).max() < 1e-5
    assert preview.duration >= np.linalg.norm(way) / WHEEL_SPEED + SETTLING_TIME - 1e-9


def test_it_begins_at_what_is_known(robot):
    preview = seen(robot, Wait(duration=2.0))
    belief = robot.belief
    assert np.allclose(preview.world_from_hex[0].matrix(), belief.world_from_hex.matrix(), atol=1e-9)
    assert np.abs(preview.wheels_in_world[0] - belief.world_from_hex.apply(robot.kin.wheels_in_hex(belief.joints))).max() < 1e-9
    assert preview.duration == pytest.approx(2.0 + SETTLING_TIME)
    assert not preview.faults


def test_a_drive_leads_along_its_way(robot):
    preview = seen(robot, Drive(translation_in_hex=np.array([0.8, 0.3]), speed=0.5 * robot.spec.drive_speed))
    moved = preview.wheels_in_world[-1] - preview.wheels_in_world[0]
    assert np.abs(moved - np.array([0.8, 0.3, 0.0])).max() < 5e-3  # the belief's small yaw
    assert (np.diff(preview.times) > 0.0).all() and not preview.faults


@given(t=st.floats(-5.0, 80.0))
def test_it_is_scrubbed_at_will(t):
    preview = scrubbed()
    moment = preview.at(t)
    held = float(np.clip(t, 0.0, preview.duration))
    assert moment.t == held
    k = int(np.searchsorted(preview.times, held))
    low, high = max(k - 1, 0), min(k, len(preview.times) - 1)
    between = np.sort(preview.wheels_in_world[[low, high]], axis=0)
    assert (between[0] - 1e-9 <= moment.wheels_in_world).all() and (moment.wheels_in_world <= between[1] + 1e-9).all()


@lru_cache(maxsize=1)
def scrubbed():
    robot = standing("sdm_b")
    return seen(robot, *a_step(robot))


def test_samples_are_met_and_time_must_be_finite(robot):
    preview = seen(robot, *a_step(robot))
    for k in range(len(preview.times) - 1):
        if preview.times[k + 1] > preview.times[k]:
            assert np.array_equal(preview.at(float(preview.times[k])).joints, preview.joints[k])
    with pytest.raises(PlanningError, match="must be finite"):
        preview.at(float("nan"))


def codes(preview) -> list[str]:
    return [fault.code for fault in preview.faults]


def test_each_fault_is_named_with_command_leg_and_figure(robot):
    step = a_step(robot)
    spec, other = robot.spec, "t12" if robot.spec.name == "sdm_b" else "sdm_b"
    wrong = foresee(
        robot.kin, robot.belief, replace(sequence(robot, *step), robot_id=other), terrain=FLAT, springs=robot.springs
    )
    assert codes(wrong) == ["wrong_robot"] and other in wrong.faults[0].text

    beyond = step[1].waypoints.copy()
    beyond[0, 2] = spec.upper[2] + 0.01
    fault = seen(robot, step[0], replace(step[1], waypoints=beyond)).faults[0]
    assert (fault.code, fault.command_index, fault.leg) == ("joint_limit", 1, 0) and spec.joint_names[2] in fault.text

    assert codes(seen(robot, BodyMove(translation_in_hex=np.array([0.0, 0.0, 3.0])))) == ["joint_limit"]
    assert codes(seen(robot, Drive(translation_in_hex=np.array([1.0, 0.0]), speed=9.0))) == ["bad_command"]
    assert codes(seen(robot, ImageRequest(cameras=("nowhere",)))) == ["bad_command"]
    assert codes(seen(robot, *step, max_torque_fraction=0.1))[0] == "torque"
    assert codes(seen(robot, step[1])) == ["dragging"]
    assert codes(seen(robot, lifted(robot, 0, 0.03))) == ["contact_not_broken"]
    tipped = seen(robot, *(lifted(robot, leg, 0.45) for leg in np.argsort(np.abs(spec.hip_azimuths))[:3].tolist()))
    assert "tip_over" in codes(tipped)
    tilted = seen(robot, BodyMove(translation_in_hex=np.zeros(3), rotvec_in_hex=np.array([0.0, 0.06, 0.0])), max_tilt=0.03)
    assert codes(tilted) == ["tilt"]


def test_ground_that_is_missing_or_in_the_way_is_a_fault(robot):
    step = a_step(robot)
    hole = HeightGrid(origin_x=-6.0, origin_y=-6.0, cell=0.05, heights=np.where(np.hypot(*_offsets(robot, 0)) < 0.5, -1.5, 0.0))
    assert codes(seen(robot, *step, terrain=hole)) == ["no_contact"]
    wall = HeightGrid(origin_x=-6.0, origin_y=-6.0, cell=0.05, heights=np.where(np.hypot(*_offsets(robot, 0)) < 0.5, 0.9, 0.0))
    assert "terrain_collision" in codes(seen(robot, *step, terrain=wall))


def _offsets(robot, leg):
    xs, ys = FLAT.centres()
    x, y = robot.belief.contacts_in_world[leg, :2]
    return np.broadcast_arrays(xs[:, None] - x, ys[None, :] - y)


def test_a_leg_led_into_another_part_is_a_self_collision_and_just_before_it_is_not(robot):
    up, swing = a_step(robot)[:2]
    bare = BodyCollision(robot.spec, FLAT, CollisionConfig(part_clearance=0.0, deviations=0.0))

    def hits(joint: int, angle: float) -> bool:
        joints = robot.belief.joints.copy()
        joints[0], joints[0, joint] = swing.waypoints[0], angle
        hit = bare.first_collision(joints, robot.belief.world_from_hex)
        return hit is not None and not hit.endswith("terrain")

    for joint, end in [(j, end) for j in range(robot.spec.dof) for end in (robot.spec.lower[j], robot.spec.upper[j])]:
        angles = np.linspace(swing.waypoints[0, joint], end, 200)
        into = np.array([hits(joint, angle) for angle in angles])
        if not into.any():
            continue
        first = int(np.argmax(into))
        for k, expected in ((first + 3, True), (max(first - 12, 0), False)):
            waypoints = swing.waypoints.copy()
            waypoints[0, joint] = angles[min(k, 199)]
            assert ("self_collision" in codes(seen(robot, up, JointMove(leg=0, waypoints=waypoints)))) == expected
        return
    raise AssertionError("the leg meets nothing as it turns")


def test_codes_are_documented_and_bad_settings_refused():
    assert set(FAULTS) >= {"wrong_robot", "joint_limit", "self_collision", "tip_over", "torque"}
    with pytest.raises(ConfigError, match="min_margin is -1"):
        PreviewConfig(min_margin=-1.0)


def test_unknown_ground_is_as_the_nearest_known_and_level_where_none_is(robot):
    heights = np.full((9, 9), np.nan)
    grid = HeightGrid(origin_x=0.0, origin_y=0.0, cell=0.1, heights=heights)
    contacts = robot.belief.contacts_in_world[:, 2].mean()
    assert known_ground(grid, robot.belief).heights == pytest.approx(np.full((9, 9), contacts))
    heights = heights.copy()
    heights[0, 0], heights[8, 8] = 1.0, 2.0
    filled = known_ground(HeightGrid(origin_x=0.0, origin_y=0.0, cell=0.1, heights=heights), robot.belief).heights
    assert filled[1, 2] == 1.0 and filled[7, 7] == 2.0


def test_a_ground_without_springs_shows_poses_alone():
    kin = kinematics("sdm_b")
    joints = np.zeros((3, 6, 6))
    poses = tuple(SE3.from_translation(np.array([x, 0.0, 1.5])) for x in (0.0, 0.5, 1.0))
    preview = posing(kin, joints, poses, seconds=4.0)
    assert preview.at(3.0).world_from_hex.translation[0] == pytest.approx(0.75)
    assert np.isnan(preview.margins).all() and preview.faults == ()


@pytest.mark.slow
@pytest.mark.ci
def test_any_sequence_that_can_be_sent_has_a_preview(robot):
    rng = np.random.default_rng(5)
    cameras = tuple(c.name for c in robot.spec.cameras)

    def command():
        leg, size = int(rng.integers(6)), float(10.0 ** rng.uniform(-3.0, 2.5))
        axle = robot.kin.leg_wheel(leg, robot.belief.motors[leg]).translation
        match int(rng.integers(6)):
            case 0:
                near = robot.belief.motors[leg] + rng.normal(size=(int(rng.integers(1, 4)), robot.spec.dof)) * min(size, 4.0)
                return JointMove(leg=leg, waypoints=near, speed_scale=float(rng.uniform(0.001, 1.0)), corner_tolerance=0.0)
            case 1:
                guard = str(rng.choice(["none", "break_contact", "contact"]))
                return LegMove(leg=leg, wheel_in_hex=axle + size * rng.normal(size=3), guard=guard, contact_load=size)
            case 2:
                return BodyMove(translation_in_hex=min(size, 1.0) * rng.normal(size=3), rotvec_in_hex=0.1 * rng.normal(size=3))
            case 3:
                return Drive(translation_in_hex=size * rng.normal(size=2) * float(rng.random() < 0.9), speed=float(rng.uniform(0.01, 3.0)))
            case 4:
                return ImageRequest(cameras=(str(rng.choice([*cameras, "nowhere"])),))
        return Wait(duration=size)

    for _ in range(30):
        preview = seen(robot, *(command() for _ in range(int(rng.integers(0, 5)))))
        assert np.isfinite(preview.wheels_in_world).all() and np.isfinite(preview.times).all()
        assert (np.diff(preview.times) >= 0.0).all() and set(codes(preview)) <= set(FAULTS)
        assert all(fault.text and 0.0 <= fault.t <= preview.duration + 1e-9 for fault in preview.faults)


def test_wheels_locked_to_forks_roll_as_these_incline(robot):
    nod = BodyMove(translation_in_hex=np.array([0.0, 0.0, -0.05]), rotvec_in_hex=np.array([0.0, 0.1, 0.0]))
    preview = seen(robot, nod)
    ends = [(preview.world_from_hex[k], preview.joints[k]) for k in (0, -1)]
    links = [[pose.rotate(robot.kin.leg_wheel(leg, q[leg]).rotation[:, 0]) for leg in range(6)] for pose, q in ends]
    rolled = (preview.wheels_in_world[-1] - preview.wheels_in_world[0])[:, :2]
    # A link that hangs points down: where its lower end swings back, the axle above the patch goes forward. Legs that do not give
    # way, as the mock's, go by the mean of what their wheels would roll.
    swung = (np.array(links[1]) - np.array(links[0]))[:, :2]
    assert np.abs(swung).max() > 0.05
    assert np.abs(rolled.mean(axis=0) + robot.spec.wheel.radius * swung.mean(axis=0)).max() < MILLIMETRE
    assert np.abs(rolled - rolled.mean(axis=0)).max() < MILLIMETRE


@pytest.mark.parametrize("friction", [0.2, 0.8])
def test_a_wheel_that_leaves_is_held_within_its_friction_and_gives_way_as_its_leg_does(robot, friction):
    leg, told = 1, robot.belief.forces.copy()
    told[leg] += [300.0, -200.0, 0.0]
    stiff = np.full(robot.spec.dof, 4e4)
    belief = replace(robot.belief, forces=told, joint_stiffness=stiff)
    stance = Stance(robot.kin, belief, springs=robot.springs)
    loads, lifts = stance.unloading(leg, 0.05, friction)
    forces = np.array([stance.leaving_force(leg, float(load), friction) for load in loads])
    assert forces[0] == pytest.approx(told[leg], rel=1e-9)
    grip = max(friction, float(np.hypot(*told[leg, :2]) / told[leg, 2]))
    assert (np.linalg.norm(forces[:, :2], axis=1) <= grip * forces[:, 2] + 1e-6).all()
    assert (np.diff(loads) < 0.0).all() and (np.diff(lifts) >= 0.0).all() and loads[-1] == lifts[0] == 0.0
    # In all, the leg rises by what the whole force bent it, and by what came down with it.
    gravity = np.array([0.0, 0.0, -GRAVITY])
    jacobian = robot.kin.patch_jacobian(leg, belief.joints, gravity)
    bent = float((jacobian / stiff @ jacobian.T @ told[leg])[2] + told[leg, 2] / robot.spec.believed_tyre_stiffness)
    assert lifts[-1] == pytest.approx(0.05 + bent, rel=1e-3)


def test_friction_that_is_none_is_refused():
    with pytest.raises(ConfigError, match=r"friction is -0\.1, must be finite and not negative"):
        PreviewConfig(friction=-0.1)
