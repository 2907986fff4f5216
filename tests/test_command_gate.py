"""What the executive lets in and how it stops: damaged, stale, repeated, misaddressed commands; stops at any tick; random bytes."""

import copy
import json
import zlib

import numpy as np
import pytest

from athlete_twin.executive import CONTROL_PERIOD, LARGEST_SEQ_STEP, QUEUE_LIMIT, Executive
from athlete_twin.messages import (
    LEAST_SPEED_SCALE,
    REFUSALS,
    BodyMove,
    CommandSequence,
    Drive,
    ImageRequest,
    JointMove,
    LegMove,
    Receipt,
    Stop,
    Telemetry,
    Wait,
    encode,
)
from athlete_twin.mock import MockAthlete
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import LEGS, load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from athlete_twin.moves import Sensed
from planner.underway import Underway

ROBOTS = ("sdm_b", "t12")


def executive(robot="sdm_b"):
    return Executive(kin=kinematics(robot), setpoint=regular_stance(load_spec(robot)))


def sequence(*commands, number, robot="sdm_b"):
    return CommandSequence(seq=number, robot_id=robot, t=0.0, sequence_id=number, commands=commands)


def tick(e):
    return e.tick(Sensed(joints=e.setpoint, torques=np.zeros_like(e.setpoint), attitude_rpy=np.zeros(3)))


def statuses(events):
    return [(e.sequence_id, e.status, e.cause) for e in events if e.kind == "receipt"]


def test_repeated_and_stale_sequences_are_refused_and_change_nothing():
    e = executive()
    e.accept(sequence(Wait(duration=1.0), number=4))
    assert statuses(e.accept(sequence(Wait(duration=1.0), number=4))) == [(4, "refused", "repeated")]
    assert statuses(e.accept(sequence(Wait(duration=1.0), number=3))) == [(3, "refused", "stale")]
    told = []
    for _ in range(100):
        told += statuses(tick(e))
    assert told == [(4, "completed", ""), (4, "completed", "")]  # the wait, then the sequence: once each
    assert statuses(e.accept(sequence(Wait(duration=1.0), number=4))) == [(4, "refused", "repeated")]
    assert statuses(e.accept(sequence(Wait(duration=1.0), number=9))) == [(9, "queued", "")]


def test_a_wild_number_is_refused_and_the_next_sequence_taken():
    e = executive()
    (event,) = e.accept(sequence(Wait(duration=1.0), number=10**30))
    assert (event.status, event.cause) == ("refused", "stale") and "more than 1000 after -1" in event.text
    assert statuses(e.accept(sequence(Wait(duration=1.0), number=0))) == [(0, "queued", "")]


def test_a_stop_of_the_future_shuts_the_robot_no_longer_than_until_it_arrived():
    mock = MockAthlete(load_spec("sdm_b"))
    mock.advance(2.0)
    mock.receive(Stop(seq=0, robot_id="sdm_b", t=1e12, reason="a clock gone wild"))
    mock.receive_raw(encode(Stop(seq=1, robot_id="sdm_b", t=1e15, reason="another")))
    mock.advance(3.0)
    answers = mock.receive(CommandSequence(seq=0, robot_id="sdm_b", t=2.5, sequence_id=0, commands=(Wait(duration=1.0),)))
    assert [(a.status, a.cause) for a in answers if isinstance(a, Receipt)] == [("queued", "")]


def test_sequences_that_the_queue_has_no_room_for_count_as_heard():
    e = executive()
    for number in range(LARGEST_SEQ_STEP + 100):
        e.accept(sequence(Wait(duration=1.0), number=number))
    assert e.newest_seq == QUEUE_LIMIT - 1
    while e.busy:
        tick(e)
    assert statuses(e.accept(sequence(Wait(duration=1.0), number=LARGEST_SEQ_STEP + 100))) == [(LARGEST_SEQ_STEP + 100, "queued", "")]


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_a_copy_that_is_refused_does_not_tell_of_an_idle_robot(robot):
    """Both copies arrive at once, before the robot begins: it has the sequence, so it executes."""
    mock = MockAthlete(load_spec(robot))
    mock.advance(1.0)
    message = CommandSequence(seq=0, robot_id=robot, t=1.0, sequence_id=0, commands=(Wait(duration=5.0),))
    told = [*mock.receive(message), *mock.receive(message)]
    assert [(m.status, m.cause) for m in told if isinstance(m, Receipt)] == [("queued", ""), ("refused", "repeated")]
    assert [m.executive_state for m in told if isinstance(m, Telemetry)] == ["executing"]
    sent = Underway(sequence=message, pairs_awaited=0)
    for answer in told:
        sent.take(answer, 6.0)
    assert sent.outcome == "" and sent.fault is None


def test_a_sequence_that_a_stop_overtook_on_the_way_is_refused():
    e = executive()
    e.accept(Stop(seq=0, robot_id="sdm_b", t=11.0))
    made_before = CommandSequence(seq=0, robot_id="sdm_b", t=10.0, sequence_id=0, commands=(Wait(duration=1.0),))
    (event,) = e.accept(made_before)
    assert (event.status, event.cause) == ("refused", "stale") and "11.000 s" in event.text and not e.busy
    made_after = CommandSequence(seq=1, robot_id="sdm_b", t=11.0, sequence_id=1, commands=(Wait(duration=1.0),))
    assert statuses(e.accept(made_after)) == [(1, "queued", "")]


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_slowest_joint_move_begins_at_once_and_moves(robot):
    e = executive(robot)
    ways = e.setpoint[:1] + 0.5
    e.accept(sequence(JointMove(leg=0, waypoints=ways, speed_scale=LEAST_SPEED_SCALE), number=0, robot=robot))
    before = e.setpoint[0].copy()
    for _ in range(50):
        tick(e)
    assert e.state == "executing" and (e.setpoint[0] > before).all() and (e.setpoint[0] < ways[0]).all()


@pytest.mark.parametrize("message", [sequence(Wait(duration=1.0), number=0), Stop(seq=0, robot_id="sdm_b", t=0.0)])
def test_what_is_for_the_other_robot_is_refused(message):
    e = executive("t12")
    e.accept(sequence(Wait(duration=1.0), number=0, robot="t12"))
    (event,) = e.accept(message)
    assert (event.status, event.cause) == ("refused", "misaddressed") and e.busy


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_single_changed_byte_is_refused(robot):
    e = executive(robot)
    raw = encode(sequence(Wait(duration=1.0), LegMove(leg=2, wheel_in_hex=np.zeros(3)), number=0, robot=robot))
    body = raw.index(b"\n") + 1
    for at in range(len(raw)):
        for flip in (1, 0x55, 0xFF):
            (event,) = e.accept_raw(raw[:at] + bytes([raw[at] ^ flip]) + raw[at + 1 :])
            if at >= body or event.status == "refused":
                assert (event.status, event.cause, event.sequence_id) == ("refused", "damaged", -1)
            else:  # a change of the head that says the same, such as of a letter's case in an escape
                e = executive(robot)
    assert statuses(e.accept_raw(raw)) == [(0, "queued", "")]


def test_telemetry_is_no_command():
    e, mock = executive(), MockAthlete(load_spec("sdm_b"))
    (telemetry,) = mock.advance(1.0)
    assert isinstance(telemetry, Telemetry)
    assert [x.cause for x in e.accept_raw(encode(telemetry))] == ["damaged"]
    receipt, telemetry = mock.receive_raw(b"hello")
    assert isinstance(receipt, Receipt)
    assert (receipt.status, receipt.cause, receipt.sequence_id) == ("refused", "damaged", -1)
    assert receipt.cause in REFUSALS


def some_commands(rng, spec):
    """A sequence of commands, most of them possible, with huge and tiny numbers among them."""
    stance, wheels = regular_stance(spec), stance_wheels_in_hex(spec)
    scale = float(rng.choice([0.01, 0.1, 0.3, 1.0, 30.0, 150.0], p=[0.2, 0.4, 0.2, 0.1, 0.05, 0.05]))
    leg = int(rng.integers(LEGS))
    made = [
        lambda: JointMove(
            leg=leg, waypoints=stance[leg] + scale * rng.normal(size=(int(rng.integers(1, 4)), spec.dof)),
            speed_scale=float(10.0 ** rng.uniform(np.log10(LEAST_SPEED_SCALE), 0.0)),
        ),
        lambda: LegMove(
            leg=leg, wheel_in_hex=wheels[leg] + scale * rng.normal(size=3), guard=str(rng.choice(["none", "break_contact", "contact"])),
            contact_load=500.0, speed_scale=float(rng.uniform(0.1, 1.0)),
        ),
        lambda: BodyMove(
            translation_in_hex=scale * rng.normal(size=3), rotvec_in_hex=0.3 * scale * rng.normal(size=3),
            wheel_offsets_in_hex=0.1 * scale * rng.normal(size=(6, 3)),
        ),
        lambda: Drive(translation_in_hex=scale * rng.normal(size=2), speed=float(rng.uniform(0.01, 1.2 * spec.drive_speed))),
        lambda: Wait(duration=float(rng.uniform(0.0, 2.0))),
        lambda: ImageRequest(cameras=(spec.cameras[0].name if rng.random() < 0.8 else "eye",)),
    ]  # fmt: skip
    return tuple(made[int(rng.integers(len(made)))]() for _ in range(int(rng.integers(1, 4))))


def stops_at_any_tick(e, rng, number):
    """One fuzzed round: some sequences, a stop at a random tick, and what must hold from then on."""
    spec = e.kin.spec
    for _ in range(int(rng.integers(1, 3))):
        e.accept(sequence(*some_commands(rng, spec), number=number, robot=spec.name))
        number += 1
    before = e.setpoint
    for _ in range(int(rng.choice([0, 1, rng.integers(2, 60)]))):
        tick(e)
        assert np.isfinite(e.setpoint).all()
        assert (np.abs(e.setpoint - before) <= spec.speed_unloaded * CONTROL_PERIOD * (1 + 1e-9)).all()
        before = e.setpoint
    waiting = len(e._queue) + (e._running is not None)
    told = e.accept(Stop(seq=0, robot_id=spec.name, t=0.0, reason="fuzz"))
    assert [x.status for x in told] == ["cancelled"] * waiting
    assert (e.state, e.busy, e.rolling) == ("stopped", False, False)
    for _ in range(3):
        assert tick(e) == [] and (e.setpoint == before).all()
    return number


@pytest.mark.parametrize("rounds", [400, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_stop_at_a_random_tick_halts_whatever_runs_and_the_next_sequence_is_taken(robot, rounds):
    e, rng, number = executive(robot), np.random.default_rng(5), 0
    for k in range(rounds):
        if k % 50 == 0:
            e, number = executive(robot), 0
        number = stops_at_any_tick(e, rng, number)
    assert statuses(e.accept(sequence(Wait(duration=0.1), number=number, robot=robot))) == [(number, "queued", "")]
    told = [x for _ in range(40) for x in tick(e)]
    assert told[-1].status == "completed" and e.state == "idle"


def test_a_stop_works_in_every_state():
    for robot in ROBOTS:
        for prepare in ("idle", "queued", "executing", "fault", "stopped", "brown_out"):
            e = executive(robot)
            if prepare in ("queued", "executing"):
                e.accept(sequence(Wait(duration=9.0), number=0, robot=robot))
            if prepare == "executing":
                tick(e)
            if prepare == "fault":
                e.accept(sequence(LegMove(leg=0, wheel_in_hex=np.full(3, 9.0)), number=0, robot=robot))
                tick(e)
                assert e.state == "fault"
            if prepare == "stopped":
                e.accept(Stop(seq=0, robot_id=robot, t=0.0))
            if prepare == "brown_out":
                e.brown_out()
            e.accept(Stop(seq=0, robot_id=robot, t=0.0))
            assert e.state == "stopped" and not e.busy


def mutated(rng, raw):
    """Bytes that look like a command: cut, flipped, or with a value replaced and the checksum made anew."""
    kind = rng.integers(4)
    if kind == 0:
        return rng.bytes(int(rng.integers(0, 400)))
    if kind == 1:
        return raw[: int(rng.integers(0, len(raw)))]
    if kind == 2:
        at = int(rng.integers(len(raw)))
        return raw[:at] + rng.bytes(1) + raw[at + 1 :]
    head, body = raw.split(b"\n", 1)
    content = json.loads(body[4:])
    odd = [None, True, -1, 7, 2.5, 1e308, -1e308, float("nan"), float("inf"), 10**30, "x", "", [], [1, 2], {}, {"array": [1e300]},
           {"array": "x"}, {"png": 0}, {"commands": [1]}, {"commands": [{"kind": "wait"}]}, {"message": "/x", "fields": {}},
           {"tuple": 3}, {"array": [[float("nan")] * 6]}]  # fmt: skip
    spot = content
    while True:
        keys = list(spot) if isinstance(spot, dict) else list(range(len(spot)))
        key = keys[int(rng.integers(len(keys)))]
        deeper = spot[key]
        if isinstance(deeper, dict | list) and deeper and rng.random() < 0.8:
            spot = deeper
            continue
        spot[key] = odd[int(rng.integers(len(odd)))]
        break
    text = json.dumps(content).encode()
    body = len(text).to_bytes(4, "big") + text
    told = {"topic": json.loads(head)["topic"], "crc32": zlib.crc32(body), "length": len(body)}
    return json.dumps(told).encode() + b"\n" + body


@pytest.mark.parametrize("rounds", [1_500, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("robot", ROBOTS)
def test_random_bytes_crash_nothing_move_nothing_beyond_limits_and_leave_a_way_on(robot, rounds):
    spec = load_spec(robot)
    e, rng, refused, number = executive(robot), np.random.default_rng(6), 0, 0
    for k in range(rounds):
        raw = encode(sequence(*some_commands(rng, spec), number=number, robot=robot))
        events = e.accept_raw(mutated(rng, raw))
        refused += sum(x.status == "refused" for x in events)
        assert all(x.text for x in events if x.status == "refused")
        before = e.setpoint
        for _ in range(3 if e.busy else 0):
            tick(e)
            assert np.isfinite(e.setpoint).all()
            assert (np.abs(e.setpoint - before) <= spec.speed_unloaded * CONTROL_PERIOD * (1 + 1e-9)).all()
            before = e.setpoint
        if k % 10 == 0:
            e.accept(Stop(seq=k, robot_id=robot, t=0.0))
            # The sender counts on by itself; what a mangled number may have skipped is at most one step.
            number += LARGEST_SEQ_STEP // 2
            assert statuses(e.accept(sequence(Wait(duration=0.0), number=number, robot=robot)))[0][1] == "queued"
            e.accept(Stop(seq=k, robot_id=robot, t=0.0))
    assert refused > rounds / 2


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_branch_goes_on_as_its_original(robot):
    e, rng = executive(robot), np.random.default_rng(8)
    spec, wheels = e.kin.spec, stance_wheels_in_hex(load_spec(robot))
    e.accept(
        sequence(
            LegMove(leg=1, wheel_in_hex=wheels[1] + [0.0, 0.0, 0.1], guard="break_contact"),
            JointMove(leg=1, waypoints=e.setpoint[1] + 0.1 * rng.normal(size=(2, spec.dof))),
            BodyMove(translation_in_hex=np.array([0.1, 0.0, 0.0])), Drive(translation_in_hex=np.array([0.5, 0.2]), speed=0.3),
            Wait(duration=0.4), number=0, robot=robot,
        )
    )  # fmt: skip
    branch = None
    for k in range(2000):
        if k % 37 == 5:
            branch = copy.deepcopy(e, {id(e.kin): e.kin})
        assert statuses(tick(e)) == (statuses(tick(branch)) if branch else [])
        if branch:
            assert (e.setpoint == branch.setpoint).all() and (e.wheel_rates == branch.wheel_rates).all()
            assert (e.state, e.phases, e.command_index) == (branch.state, branch.phases, branch.command_index)
        if not e.busy:
            break
    assert e.state in ("idle", "fault") and k > 100
