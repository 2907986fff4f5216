from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from athlete_twin.errors import CommandError, MessageError
from athlete_twin.messages import (
    BodyMove,
    CommandSequence,
    Drive,
    Fault,
    ImageRequest,
    JointMove,
    LegMove,
    Receipt,
    StereoPair,
    Stop,
    Telemetry,
    Wait,
    decode,
    encode,
    plain,
)

SETTINGS = settings(max_examples=40, deadline=None)
numbers = st.floats(-1e3, 1e3, allow_nan=False)
legs = st.integers(0, 5)


def vectors(*shape):
    return hnp.arrays(float, shape, elements=numbers)


commands = st.one_of(
    st.builds(JointMove, leg=legs, waypoints=vectors(2, 7), speed_scale=st.floats(0.1, 1.0), corner_tolerance=st.floats(0.0, 0.1)),
    st.builds(LegMove, leg=legs, wheel_in_hex=vectors(3), guard=st.sampled_from(["none", "break_contact"])),
    st.builds(
        LegMove, leg=legs, wheel_in_hex=vectors(3), guard=st.just("contact"), contact_load=st.floats(1.0, 5000.0)
    ),
    st.builds(Drive, translation_in_hex=vectors(2), speed=st.floats(0.01, 1.0)),
    st.builds(BodyMove, translation_in_hex=vectors(3), rotvec_in_hex=vectors(3), wheel_offsets_in_hex=vectors(6, 3)),
    st.builds(ImageRequest, cameras=st.tuples(st.text(max_size=9)), binning=st.sampled_from([1, 2, 4])),
    st.builds(Wait, duration=st.floats(0.0, 3600.0)),
)
head = {"seq": st.integers(0, 10**6), "robot_id": st.text(max_size=8), "t": st.floats(0.0, 1e6)}
telemetries = st.builds(
    Telemetry, **head, joints=vectors(6, 6), motors=vectors(6, 6), torques=vectors(6, 6), attitude_rpy=vectors(3),
    rates=vectors(3), acceleration=vectors(3), executive_state=st.sampled_from(["idle", "executing"]),
    sequence_id=st.integers(-1, 99), command_index=st.integers(0, 99),
)  # fmt: skip
pictures = hnp.arrays(np.uint8, (9, 12))
messages = st.one_of(
    st.builds(
        CommandSequence, **head, sequence_id=st.integers(0, 99), commands=st.lists(commands, max_size=4).map(tuple),
        max_torque_fraction=st.floats(0.1, 1.0),
    ),
    st.builds(Stop, **head, reason=st.text(max_size=20)),
    telemetries,
    st.builds(
        StereoPair, **head, camera=st.text(max_size=9), binning=st.just(4), left=pictures, right=pictures,
        exposure=st.floats(0.0, 1.0), state=telemetries,
    ),
    st.builds(
        Receipt, **head, sequence_id=st.integers(0, 9), command_index=st.integers(-1, 9), status=st.just("failed"),
        text=st.text(max_size=30),
    ),
    st.builds(
        Fault, **head, code=st.just("tilt"), text=st.text(max_size=30), sequence_id=st.integers(0, 9),
        command_index=st.integers(-1, 9), leg=st.integers(-1, 5),
    ),
)  # fmt: skip


def same(a, b):
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    return a == b


@SETTINGS
@given(messages)
def test_decoding_gives_back_every_bit(message):
    raw = encode(message)
    assert same(decode(raw), message)
    assert encode(decode(raw)) == raw


@SETTINGS
@given(messages, messages)
def test_messages_are_equal_by_content(message, other):
    again = decode(encode(message))
    assert again == message and hash(again) == hash(message)
    assert (message == other) is (type(message) is type(other) and encode(message) == encode(other))
    assert message != replace(message, seq=message.seq + 1) and message != "message"


@SETTINGS
@given(messages, st.data())
def test_a_damaged_byte_is_noticed(message, data):
    raw = bytearray(encode(message))
    start = raw.index(b"\n") + 1
    at = data.draw(st.integers(start, len(raw) - 1))
    raw[at] ^= data.draw(st.integers(1, 255))
    with pytest.raises(MessageError):
        decode(bytes(raw))


@SETTINGS
@given(messages, st.data())
def test_a_truncated_message_is_refused(message, data):
    raw = encode(message)
    with pytest.raises(MessageError):
        decode(raw[: data.draw(st.integers(0, len(raw) - 1))])


def test_unknown_topic_is_refused():
    with pytest.raises(MessageError, match="are not a message"):
        decode(b'{"topic": "/uplink/hello", "crc32": 0, "length": 0}\n')


@given(messages)
@settings(max_examples=15, deadline=None)
def test_log_content_carries_the_header(message):
    content = plain(message)
    assert content["crc32"] == message.crc32
    assert (content["seq"], content["robot_id"], content["t"]) == (message.seq, message.robot_id, message.t)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: JointMove(leg=6, waypoints=np.zeros((1, 6))), "leg index 6 is not a whole number from 0 to 5"),
        (lambda: JointMove(leg=0, waypoints=np.zeros((0, 6))), r"way-points have shape \(0, 6\)"),
        (lambda: JointMove(leg=0, waypoints=np.full((1, 6), np.nan)), "need finite"),
        (lambda: JointMove(leg=0, waypoints=np.zeros((1, 6)), speed_scale=0.0), "speed_scale is 0.0"),
        (lambda: JointMove(leg=0, waypoints=np.zeros((1, 6)), speed_scale=1e-9), "speed_scale is 1e-09"),
        (lambda: JointMove(leg=0, waypoints=np.zeros((1, 6)), corner_tolerance=0.2), "corner_tolerance 0.2 rad is outside 0 to 0.1"),
        (lambda: JointMove(leg=0, waypoints=np.zeros((1, 6)), corner_tolerance=float("nan")), "is outside 0 to 0.1"),
        (lambda: LegMove(leg=0, wheel_in_hex=np.full(3, np.inf)), "must be a finite point"),
        (lambda: LegMove(leg=0, wheel_in_hex=np.zeros(3), guard="soft"), "guard 'soft' is not one of"),
        (lambda: LegMove(leg=0, wheel_in_hex=np.zeros(3), guard="contact"), "needs a positive contact_load"),
        (lambda: BodyMove(translation_in_hex=np.full(3, np.nan)), "translation_in_hex must be finite"),
        (lambda: Drive(translation_in_hex=np.array([1.0, np.inf]), speed=0.5), "two finite lengths"),
        (lambda: Drive(translation_in_hex=np.array([1.0, 0.0]), speed=-0.5), "speed -0.5 m/s must be positive"),
        (lambda: ImageRequest(cameras=()), "names no camera"),
        (lambda: ImageRequest(cameras=("navcam_1",), binning=3), "binning 3 is not one of"),
        (lambda: Wait(duration=-1.0), "wait of -1.0 s is outside"),
    ],
)
def test_malformed_commands_are_refused(make, said):
    with pytest.raises(CommandError, match=said):
        make()



@given(telemetries, hnp.arrays(np.uint16, (9, 12), elements=st.integers(0, 4095)))
@SETTINGS
def test_a_12_bit_pair_comes_out_as_it_went_in(state, picture):
    pair = StereoPair(
        seq=1, robot_id="sdm_b", t=2.0, camera="hazcam_1", binning=2, left=picture, right=picture[::-1].copy(),
        exposure=0.01, state=state, bits=12, bracket=1,
    )  # fmt: skip
    again = decode(encode(pair))
    assert isinstance(again, StereoPair)
    assert np.array_equal(again.left, picture) and again.left.dtype == np.uint16
    assert np.array_equal(again.right, pair.right)
    assert (again.bits, again.bracket, again.white) == (12, 1, 4095)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"bits": 10}, "10 bits a grey value is not one of 8, 12"),
        ({"brackets": ()}, "0 exposures make no bracket, need 1 to 5"),
        ({"brackets": (1.0, float("nan"))}, "between 1/64 and 64"),
        ({"brackets": (100.0,)}, "between 1/64 and 64"),
    ],
)
def test_an_image_request_refuses_a_wrong_bracket(wrong, message):
    with pytest.raises(CommandError, match=message):
        ImageRequest(cameras=("hazcam_1",), **wrong)


def test_no_message_can_carry_what_is_true():
    """The truth of a view (labels, legs, depth) has no place in anything that crosses the link."""
    carried = {f.name for kind in (StereoPair, Telemetry, Receipt, Fault) for f in fields(kind)}
    assert not carried & {"label", "leg_label", "depth", "points_in_world", "wheels_in_world", "world_from_hex", "seen"}
