import math
from collections import deque
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import LinkError, MessageError
from athlete_twin.link import DelayedLink, LinkConfig, downlink, uplink
from athlete_twin.messages import Receipt, StereoPair, Stop, Telemetry, decode, encode

SETTINGS = settings(max_examples=60, deadline=None)


def receipt(k, text=""):
    return Receipt(seq=k, robot_id="sdm_b", t=0.0, sequence_id=k, command_index=-1, status="queued", text=text)


def a_link(seed=0, **config):
    return DelayedLink(LinkConfig(**({"delay": 5.0, "bandwidth": 1e4} | config)), np.random.default_rng(seed))


sends = st.lists(st.tuples(st.floats(0.0, 20.0), st.integers(0, 2000)), min_size=1, max_size=12)


def sent(link, gaps):
    """Sends messages of various sizes after the given gaps; times and sizes."""
    t, out = 0.0, []
    for k, (gap, size) in enumerate(gaps):
        t += gap
        out.append((t, len(link.send(receipt(k, "x" * size), t))))
    return out


def arrivals(link):
    """When each message arrives and which one it is."""
    out = []
    while math.isfinite(link.next_arrival()):
        t = link.next_arrival()
        assert link.receive(np.nextafter(t, -math.inf)) == []
        out += [(t, m.seq) for m in link.receive(t)]
    return out


@SETTINGS
@given(sends, st.floats(0.0, 30.0), st.floats(0.0, 4.0), st.integers(0, 99))
def test_nothing_is_lost_reordered_or_early(gaps, delay, jitter, seed):
    link = a_link(seed, delay=delay, jitter=jitter)
    times = sent(link, gaps)
    got = arrivals(link)
    assert [k for _, k in got] == list(range(len(gaps)))
    for (t, k), (left, size) in zip(got, times, strict=True):
        assert t >= left + delay + 8 * size / 1e4 - 1e-9, k
    assert all(a[0] <= b[0] for a, b in pairwise(got))


@SETTINGS
@given(sends)
def test_bandwidth_is_conserved(gaps):
    link = a_link(delay=0.0)
    times = sent(link, gaps)
    got = arrivals(link)
    sizes = [size for _, size in times]
    for i in range(len(got)):
        for j in range(i + 1, len(got)):
            # Between two arrivals the bits of all later messages up to the second must have passed.
            assert got[j][0] - got[i][0] >= 8 * sum(sizes[i + 1 : j + 1]) / 1e4 - 1e-9


@SETTINGS
@given(sends, st.floats(0.0, 30.0))
def test_delay_shifts_every_arrival_alike(gaps, delay):
    near, far = a_link(delay=0.0), a_link(delay=delay)
    sent(near, gaps)
    sent(far, gaps)
    assert [t for t, _ in arrivals(far)] == pytest.approx([t + delay for t, _ in arrivals(near)])


@SETTINGS
@given(st.floats(0.0, 0.9), st.integers(0, 99))
@pytest.mark.slow
@pytest.mark.ci
def test_loss_only_takes_messages_away(loss, seed):
    gaps = [(1.0, 10)] * 40
    clean, lossy = a_link(seed, jitter=2.0), a_link(seed, jitter=2.0, loss=loss)
    sent(clean, gaps)
    sent(lossy, gaps)
    whole = {k for _, k in arrivals(clean)}
    kept = {k for _, k in arrivals(lossy)}
    assert kept <= whole and (loss > 0.0 or kept == whole)


def test_loss_has_the_asked_rate():
    link = a_link(loss=0.3)
    sent(link, [(0.1, 0)] * 2000)
    # Three standard deviations of a binomial.
    assert len(arrivals(link)) == pytest.approx(1400, abs=3 * math.sqrt(2000 * 0.3 * 0.7))


def test_nothing_leaves_during_an_outage():
    link = a_link(delay=1.0, bandwidth=8000.0, outages=((10.0, 50.0), (60.0, 61.0)))
    size = len(encode(receipt(0)))
    link.send(receipt(0), 9.9)
    # A tenth of a second's worth leaves before the outage, the rest when it ends.
    assert link.next_arrival() == pytest.approx(50.0 + size / 1000.0 - 0.1 + 1.0)
    link.receive(1e3)
    size = len(link.send(receipt(1), 60.5))
    assert link.next_arrival() == pytest.approx(61.0 + size / 1000.0 + 1.0)


def test_defaults_are_the_designs():
    assert (downlink(5.0).bandwidth, uplink(5.0).bandwidth) == (2e6, 64e3)
    assert downlink(5.0).delay == 5.0 and downlink(5.0).loss == 0.0


def test_a_picture_takes_its_size_over_the_bandwidth():
    rng = np.random.default_rng(0)
    zeros = np.zeros((6, 6))
    state = Telemetry(
        seq=0, robot_id="sdm_b", t=0.0, joints=zeros, motors=zeros, torques=zeros, attitude_rpy=np.zeros(3),
        rates=np.zeros(3), acceleration=np.zeros(3), executive_state="idle", sequence_id=-1, command_index=0,
    )  # fmt: skip
    left, right = rng.integers(0, 256, (2, 192, 256)).astype(np.uint8)
    pair = StereoPair(
        seq=0, robot_id="sdm_b", t=0.0, camera="navcam_1", binning=4, left=left, right=right, exposure=0.01, state=state
    )
    link = DelayedLink(downlink(5.0), rng)
    raw = link.send(pair, 0.0)
    assert link.bytes_sent == len(raw) > 2 * 192 * 256
    assert link.next_arrival() == pytest.approx(5.0 + 8 * len(raw) / 2e6)
    (got,) = link.receive(link.next_arrival())
    assert isinstance(got, StereoPair) and np.array_equal(got.left, left) and np.array_equal(got.right, right)


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ({"delay": -1.0}, "delay is -1.0 s"),
        ({"delay": math.nan}, "delay is nan s"),
        ({"jitter": -0.1}, "jitter is -0.1 s"),
        ({"bandwidth": 0.0}, "bandwidth is 0.0 bit/s"),
        ({"bandwidth": math.nan}, "bandwidth is nan bit/s"),
        ({"loss": 1.0}, r"loss is 1.0, must be in \[0, 1\)"),
        ({"duplication": 1.5}, r"duplication is 1.5, must be in \[0, 1\)"),
        ({"corruption": math.nan}, r"corruption is nan, must be in \[0, 1\)"),
        ({"retry_after": -2.0}, "retry_after is -2.0 s"),
        ({"outages": ((5.0, 3.0),)}, "outage 5.0 to 3.0 s"),
        ({"outages": ((0.0, 3.0), (2.0, 4.0))}, "not begin before 3.0 s"),
    ],
)
def test_unusable_links_are_refused(config, said):
    with pytest.raises(LinkError, match=said):
        a_link(**config)


def test_sending_backwards_in_time_is_refused():
    link = a_link()
    link.send(Stop(seq=0, robot_id="sdm_b", t=3.0), 3.0)
    with pytest.raises(LinkError, match="send time is 2"):
        link.send(Stop(seq=1, robot_id="sdm_b", t=2.0), 2.0)


def walked(link, gaps):
    """Sends as `sent` does while what arrives meanwhile is taken; the arrivals as (time, number)."""
    t, out = 0.0, []
    for k, (gap, size) in enumerate(gaps):
        t += gap
        while link.next_arrival() <= t:
            at = link.next_arrival()
            out += [(at, m.seq) for m in link.receive(at)]
        link.send(receipt(k, "x" * size), t)
    return out + arrivals(link)


@SETTINGS
@given(sends, st.floats(0.0, 8.0), st.floats(0.0, 4.0), st.floats(0.0, 0.8), st.floats(0.0, 20.0), st.integers(0, 99))
def test_what_is_sent_again_arrives_once_and_in_order(gaps, delay, jitter, loss, retry_after, seed):
    config = {"delay": delay, "jitter": jitter, "loss": loss, "retry_after": retry_after}
    got = walked(a_link(seed, **config), gaps)
    assert [k for _, k in got] == list(range(len(gaps)))
    assert all(a[0] <= b[0] for a, b in pairwise(got))
    # Nobody comes earlier than over the same link without loss.
    clean = walked(a_link(seed, **config | {"loss": 0.0}), gaps)
    assert all(late[0] >= early[0] - 1e-9 for late, early in zip(got, clean, strict=True))


def brute(config, gaps, seed):
    """Every transmission of a retrying link, simulated in steps of a millisecond by another programme: when each arrives [s]."""
    draws = np.random.default_rng(seed).random((len(gaps), 5))
    step, now = 1e-3, 0
    times = np.cumsum([gap for gap, _ in gaps])
    sizes = [len(encode(receipt(k, "x" * size))) for k, (_, size) in enumerate(gaps)]
    waiting = [(round(t / step), k, 0) for k, t in enumerate(times)]
    left_over, sending, tries, out = 0.0, None, {}, {}
    while len(out) < len(gaps):
        if sending is None and any(at <= now for at, *_ in waiting):
            sending = min(w for w in waiting if w[0] <= now)
            waiting.remove(sending)
            left_over = 8 * sizes[sending[1]] / config["bandwidth"]
        if sending is not None:
            left_over -= step
            if left_over <= 0.0:
                k = sending[1]
                tries[k] = tries.get(k, 0) + 1
                if draws[k, 1] < config["loss"] ** tries[k]:
                    waiting.append((now + round(config["retry_after"] / step), k, 1))
                else:
                    out[k] = now * step + config["delay"] + config["jitter"] * draws[k, 0]
                sending = None
        now += 1
    return np.maximum.accumulate([out[k] for k in range(len(gaps))])


def test_retries_share_the_transmitter_as_a_step_by_step_simulation_says():
    config = {"delay": 1.5, "jitter": 0.7, "loss": 0.5, "retry_after": 2.0, "bandwidth": 1e4}
    rng = np.random.default_rng(4)
    gaps = [(float(g), int(s)) for g, s in zip(rng.uniform(0.05, 1.5, 40), rng.integers(0, 1500, 40), strict=True)]
    got = [t for t, _ in walked(a_link(7, **config), gaps)]
    # A step a try is what the simulation is off by.
    assert np.abs(np.array(got) - brute(config, gaps, 7)).max() < 0.05


def test_copies_follow_their_originals_where_asked_for():
    link = a_link(duplication=0.3)
    sent(link, [(0.1, 0)] * 2000)
    got = [k for _, k in arrivals(link)]
    assert got == sorted(got) and set(got) == set(range(2000))
    assert len(got) == pytest.approx(2600, abs=3 * math.sqrt(2000 * 0.3 * 0.7))


def test_messages_overtake_each_other_only_where_asked_for():
    gaps = [(0.05, 0)] * 200
    kept, free = a_link(jitter=2.0, bandwidth=1e6), a_link(jitter=2.0, bandwidth=1e6, reordering=True)
    sent(kept, gaps)
    sent(free, gaps)
    orderly, loose = arrivals(kept), arrivals(free)
    assert [k for _, k in orderly] == list(range(200))
    assert [k for _, k in loose] != list(range(200)) and sorted(k for _, k in loose) == list(range(200))
    assert all(a[0] <= b[0] for a, b in pairwise(loose))
    assert sum(t for t, _ in loose) < sum(t for t, _ in orderly)


def test_a_damaged_message_is_noticed():
    link = a_link(corruption=0.2)
    sent(link, [(0.1, 5)] * 500)
    whole = damaged = 0
    for raw in link.receive_raw(1e6):
        try:
            decode(raw)
            whole += 1
        except MessageError:
            damaged += 1
    assert whole + damaged == 500
    assert damaged == pytest.approx(100, abs=3 * math.sqrt(500 * 0.2 * 0.8))


def exact_arrivals(config, times, sizes, late):
    """By the definition, one after the other: transmitter, delay, jitter, order [s]. The transmitter's clock stands in outages."""
    lengths = [end - begin for begin, end in config.outages]
    stands_at = [begin - sum(lengths[:k]) for k, (begin, _) in enumerate(config.outages)]

    def on_air(t):
        return t - sum(min(max(t - begin, 0.0), end - begin) for begin, end in config.outages)

    free, last, out = 0.0, 0.0, []
    for t, size, share in zip(times, sizes, late, strict=True):
        free = max(on_air(t), free) + 8 * size / config.bandwidth
        left = free + sum(length for length, stands in zip(lengths, stands_at, strict=True) if stands < free)
        last = max(last, left + config.delay + config.jitter * share)
        out.append(last)
    return np.array(out)


@pytest.mark.parametrize("n", [5_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_many_messages_arrive_on_time_none_lost_doubled_or_reordered(n):
    config = LinkConfig(delay=5.0, bandwidth=64e3, jitter=0.3, outages=((60.0, 80.0), (100.0, 101.5)))
    link, rng = DelayedLink(config, np.random.default_rng(3)), np.random.default_rng(4)
    times = np.cumsum(rng.exponential(0.05, n))
    sizes, at, under_way, every = np.zeros(n), [], deque(), max(1, n // 20_000)

    def take(due):
        for raw in link.receive_raw(due):
            # Every message holds its number: no two are alike, and the oldest under way must be the next to arrive.
            assert raw == under_way.popleft()
            assert len(at) % every or decode(raw).seq == len(at)
            at.append(due)

    for k, t in enumerate(times):
        while (due := link.next_arrival()) <= t:
            take(due)
        under_way.append(link.send(receipt(k), t))
        sizes[k] = len(under_way[-1])
    while math.isfinite(due := link.next_arrival()):
        take(due)
    assert len(at) == n and not under_way
    late = np.random.default_rng(3).random((n, 5))[:, 0]
    exact = exact_arrivals(config, times, sizes, late)
    assert np.abs(np.array(at) - exact).max() < 1e-6  # a physics tick is 4e-3
    # The outage is felt, and nothing leaves in it.
    assert (exact - times).max() > 20.0 and not ((exact - config.delay > 60.4) & (exact - config.delay < 80.0)).any()
