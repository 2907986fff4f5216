"""Receipts and telemetry of a sequence, complete, late, doubled or missing."""

from itertools import permutations

import numpy as np
import pytest

from athlete_twin.messages import CommandSequence, Fault, LegMove, Receipt, StereoPair, Telemetry, Wait
from planner.underway import SILENCE, Inbox, Underway

COMMANDS = (Wait(duration=1.0), LegMove(leg=3, wheel_in_hex=np.zeros(3)), Wait(duration=1.0))


def underway(number=5):
    sequence = CommandSequence(seq=number, robot_id="sdm_b", t=10.0, sequence_id=number, commands=COMMANDS)
    return Underway(sequence=sequence, pairs_awaited=0)


def receipt(status, index=-1, *, number=5, cause="", seq=0):
    return Receipt(
        seq=seq, robot_id="sdm_b", t=11.0, sequence_id=number, command_index=index, status=status, text="", cause=cause
    )


def telemetry(state, index, *, number=5, seq=0):
    zeros = np.zeros((6, 6))
    return Telemetry(
        seq=seq, robot_id="sdm_b", t=12.0, joints=zeros, motors=zeros, torques=zeros, attitude_rpy=np.zeros(3), rates=np.zeros(3),
        acceleration=np.zeros(3), executive_state=state, sequence_id=number, command_index=index,
    )  # fmt: skip


def test_receipts_of_another_sequence_say_nothing():
    u = underway()
    for stale in (receipt("completed", number=4), receipt("failed", number=4), telemetry("idle", 3, number=4)):
        assert not u.take(stale, 20.0) and u.outcome == "" and not u.heard


def test_commands_are_completed_in_order_once_each():
    u, told = underway(), []
    for message in (receipt("queued"), receipt("completed", 0), telemetry("executing", 1), receipt("completed", 1),
                    receipt("completed", 2), receipt("completed"), telemetry("idle", 3)):  # fmt: skip
        told += u.take(message, 20.0)
    assert told == [0, 1, 2] and u.outcome == "completed" and u.fault is None


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_the_order_of_arrival_changes_no_outcome(order):
    messages = (receipt("completed", 0), receipt("completed", 1), receipt("completed", 2), receipt("completed"))
    u, told = underway(), []
    for k in order:
        told += u.take(messages[k], 20.0)
    assert told == [0, 1, 2] and u.outcome == "completed"


def test_telemetry_tells_what_lost_receipts_would_have():
    u = underway()
    assert list(u.take(telemetry("executing", 2), 20.0)) == [0, 1] and u.heard and not u.outcome
    assert list(u.take(telemetry("idle", 3), 21.0)) == [2] and u.outcome == "completed"


def test_a_lost_fault_is_known_from_the_executives_state():
    u = underway()
    assert list(u.take(telemetry("fault", 1), 20.0)) == [0]
    assert (u.outcome, u.fault.code, u.fault.leg, u.fault.command_index) == ("failed", "unreported", 3, 1)
    own = Fault(seq=1, robot_id="sdm_b", t=12.0, code="swing_contact", text="", sequence_id=5, command_index=1, leg=3)
    u.take(own, 21.0)
    assert u.fault is own


def test_a_repeated_command_is_known_to_be_there_and_goes_on():
    u = underway()
    assert not u.take(receipt("refused", cause="repeated"), 20.0)
    assert u.heard and u.outcome == ""
    u = underway()
    u.take(receipt("refused", cause="queue_full"), 20.0)
    assert u.outcome == "refused" and u.fault is None


def test_a_sequence_cancelled_in_the_queue_is_known_from_a_robot_that_had_it_and_does_nothing():
    u = underway()
    u.take(telemetry("idle", 3, number=4), 20.0)
    assert u.outcome == ""  # perhaps it is still on its way up
    u.take(receipt("refused", cause="repeated"), 90.0)
    u.take(telemetry("executing", 1, number=4, seq=1), 90.0)
    assert u.outcome == ""  # it may wait in the queue behind that one
    u.take(telemetry("stopped", 3, number=4, seq=2), 90.0)
    assert (u.outcome, u.fault.code, u.fault.command_index) == ("cancelled", "unreported", -1)


def test_silence_counts_from_the_last_word():
    u = underway()
    assert not u.silent(10.0 + SILENCE) and u.silent(10.1 + SILENCE)
    u.take(telemetry("executing", 0), 50.0)
    assert not u.silent(50.0 + SILENCE) and u.silent(50.1 + SILENCE)
    u.sent(200.0)
    assert not u.silent(200.0 + SILENCE)


def test_each_message_counts_once_and_old_telemetry_not_at_all():
    inbox = Inbox()
    assert inbox.admits(receipt("queued", seq=3)) and not inbox.admits(receipt("queued", seq=3))
    assert inbox.admits(receipt("completed", 0, seq=2))
    assert inbox.admits(telemetry("idle", 0, seq=7)) and not inbox.admits(telemetry("idle", 0, seq=6))


def test_pictures_of_another_sequence_do_not_count():
    u = underway()
    grey = np.zeros((9, 12), dtype=np.uint8)
    for number in (4, 5):
        pair = StereoPair(
            seq=number, robot_id="sdm_b", t=12.0, camera="eye", exposure=1.0, binning=4, left=grey, right=grey,
            state=telemetry("executing", 1, number=number),
        )  # fmt: skip
        u.take(pair, 20.0)
    assert [pair.seq for pair in u.pairs] == [5]


def test_what_came_of_it_is_told_by_telemetry_made_after_the_word_that_ended_it():
    u = underway()
    assert u.ended_at == -np.inf
    u.take(receipt("queued"), 20.0)
    assert u.ended_at == -np.inf
    u.take(receipt("completed"), 20.0)
    u.take(telemetry("idle", 3), 21.0)
    assert u.ended_at == 11.0  # the receipt's, in robot time
