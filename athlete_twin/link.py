"""One direction of a command link: delay, jitter, bandwidth, loss, duplication, corruption, outages. Time is an argument.

Messages leave one after the other: each occupies the transmitter for its encoded size over the bandwidth, an outage holds the
transmitter, and what was sent arrives `delay` plus jitter after its last bit left. Nothing waits and no thread runs. What
arrives is decoded from what was encoded, so that a recording of the bytes replays the same mission.

By default messages arrive once, whole and in the order in which they were sent. Loss, copies, damage and overtaking are asked
for, each by itself. A link that sends again keeps the order too: what came in behind a lost message waits for it, as files
wait in CFDP's acknowledged mode. Every message draws the same five numbers whatever is asked for, so links that differ in one
of these stay paired.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import LinkError
from athlete_twin.messages import Message, decode, encode

DOWN_BANDWIDTH = 2e6
"""robot to ground, DESIGN.md [bit/s]"""
UP_BANDWIDTH = 64e3
"""ground to robot, DESIGN.md [bit/s]"""


@dataclass(frozen=True, kw_only=True)
class LinkConfig:
    """One direction of a link; the other may differ in everything."""

    delay: float
    """one way [s]"""
    bandwidth: float
    """[bit/s]"""
    jitter: float = 0.0
    """each message takes up to so much longer, uniformly [s]"""
    loss: float = 0.0
    """probability that a transmission never arrives"""
    retry_after: float | None = None
    """the sender notices a loss so long after the last bit left and sends again, until it arrives; None: it never does [s]"""
    duplication: float = 0.0
    """probability that a message arrives twice"""
    corruption: float = 0.0
    """probability that a message arrives with one byte changed, past the link's own checks"""
    reordering: bool = False
    """whether a message may overtake an earlier one that jitter or loss holds up"""
    outages: tuple[tuple[float, float], ...] = ()
    """from and to, mission time: nothing leaves meanwhile, what was leaving pauses [s]"""

    def __post_init__(self) -> None:
        for name in ("delay", "jitter"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise LinkError(f"link {name} is {value} s, must be 0 or more")
        if not self.bandwidth > 0.0:
            raise LinkError(f"link bandwidth is {self.bandwidth} bit/s, must be positive")
        for name in ("loss", "duplication", "corruption"):
            value = getattr(self, name)
            if not 0.0 <= value < 1.0:
                raise LinkError(f"link {name} is {value}, must be in [0, 1)")
        if self.retry_after is not None and not (math.isfinite(self.retry_after) and self.retry_after >= 0.0):
            raise LinkError(f"link retry_after is {self.retry_after} s, must be 0 or more, or None for no second try")
        last = -math.inf
        for start, end in self.outages:
            if not (math.isfinite(start) and math.isfinite(end) and last <= start < end):
                raise LinkError(f"outage {start} to {end} s must end after it starts and not begin before {last} s")
            last = end


def downlink(delay: float) -> LinkConfig:
    """The default link from robot to ground: 2 Mbit/s, lossless."""
    return LinkConfig(delay=delay, bandwidth=DOWN_BANDWIDTH)


def uplink(delay: float) -> LinkConfig:
    """The default link from ground to robot: 64 kbit/s, lossless."""
    return LinkConfig(delay=delay, bandwidth=UP_BANDWIDTH)


@dataclass(slots=True, eq=False)
class _Flight:
    """A message under way."""

    raw: bytes
    late: float
    """share of the jitter that it takes"""
    losses: int
    """transmissions of it that are still to be lost"""
    copy_late: float | None
    """share of the jitter by which a copy follows; None for no copy"""
    arrival: float = math.inf
    """[s]"""


class DelayedLink:
    """One direction of the link with what is under way on it."""

    def __init__(self, config: LinkConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.bytes_sent = 0
        """of all transmissions so far, lost ones and second tries included"""
        self.messages_sent = 0
        self._rng = rng
        self._free_at = 0.0
        self._last_send = -math.inf
        self._last_arrival = 0.0
        self._number = 0
        self._under_way: list[tuple[float, int, _Flight]] = []
        """a heap: in the order of sending, or of arrival where messages may overtake each other"""
        self._retries: list[tuple[float, int, _Flight]] = []
        """a heap of what is to be sent again, and when [s]"""

    def send(self, message: Message, t: float) -> bytes:
        """Put a message on the link at mission time `t` [s]; returns the bytes that leave."""
        if not math.isfinite(t) or t < self._last_send:
            raise LinkError(f"send time is {t} s, must be finite and not before the last one, {self._last_send} s")
        self._retry_until(t)
        self._last_send = t
        raw = encode(message)
        self.messages_sent += 1
        late, fate, double, copy_late, flip = self._rng.random(5).tolist()
        config = self.config
        lost = fate < config.loss
        losses = int(lost)
        if lost and config.retry_after is not None:
            # The k-th transmission is lost too with loss^k: one number tells how many are.
            losses = int(math.log(max(fate, 1e-300)) / math.log(config.loss))
        arriving = _damaged(raw, flip / config.corruption) if flip < config.corruption else raw
        flight = _Flight(arriving, late, losses, copy_late if double < config.duplication else None)
        number = self._number
        self._number += 1
        if not config.reordering and not (lost and config.retry_after is None):
            heapq.heappush(self._under_way, (number, number, flight))
        self._transmit(number, flight, t)
        return raw

    def receive(self, t: float) -> list[Message]:
        """Messages that have arrived by mission time `t` [s] and were not received before."""
        return [decode(raw) for raw in self.receive_raw(t)]

    def receive_raw(self, t: float) -> list[bytes]:
        """The same as bytes, for whoever records them or expects damaged ones."""
        self._retry_until(t)
        out: list[bytes] = []
        while self._under_way and self._due(self._under_way[0][2]) <= t:
            flight = heapq.heappop(self._under_way)[2]
            self._last_arrival = self._due(flight)
            out.append(flight.raw)
            if flight.copy_late is not None and not self.config.reordering:
                out.append(flight.raw)
        return out

    def next_arrival(self) -> float:
        """When the next message arrives, if nothing else is sent meanwhile [s]; infinity when none is under way."""
        if self._retries:
            return self._foreseen().next_arrival()
        return self._due(self._under_way[0][2]) if self._under_way else math.inf

    def _due(self, flight: _Flight) -> float:
        return flight.arrival if self.config.reordering else max(self._last_arrival, flight.arrival)

    def _transmit(self, number: int, flight: _Flight, t: float) -> None:
        """Occupy the transmitter with a message from `t` on; it arrives, or is to be sent again, or is gone."""
        config = self.config
        self.bytes_sent += len(flight.raw)
        self._free_at = self._transmitted(max(t, self._free_at), 8.0 * len(flight.raw) / config.bandwidth)
        if flight.losses:
            flight.losses -= 1
            if config.retry_after is not None:
                heapq.heappush(self._retries, (self._free_at + config.retry_after, number, flight))
            return
        flight.arrival = self._free_at + config.delay + config.jitter * flight.late
        if config.reordering:
            heapq.heappush(self._under_way, (flight.arrival, number, flight))
            if flight.copy_late is not None:
                copy = _Flight(flight.raw, 0.0, 0, None, flight.arrival + config.jitter * flight.copy_late)
                heapq.heappush(self._under_way, (copy.arrival, self._number, copy))
                self._number += 1

    def _retry_until(self, t: float) -> None:
        while self._retries and self._retries[0][0] <= t:
            due, number, flight = heapq.heappop(self._retries)
            self._transmit(number, flight, due)

    def _foreseen(self) -> DelayedLink:
        """The link after all second tries, if nothing else is sent: nothing random is left in it."""
        later = DelayedLink(self.config, self._rng)
        later._free_at, later._last_arrival = self._free_at, self._last_arrival
        known = [entry[2] for entry in (*self._under_way, *self._retries)]
        flights = {id(f): _Flight(f.raw, f.late, f.losses, f.copy_late, f.arrival) for f in known}
        later._under_way = [(key, number, flights[id(f)]) for key, number, f in self._under_way]
        later._retries = [(due, number, flights[id(f)]) for due, number, f in self._retries]
        later._number = self._number
        later._retry_until(math.inf)
        return later

    def _transmitted(self, start: float, duration: float) -> float:
        """When a transmission that may begin at `start` has left, pausing in outages [s]."""
        at = start
        for begin, end in self.config.outages:
            if end <= at:
                continue
            if at + duration <= begin:
                break
            duration -= max(0.0, begin - at)
            at = end
        return at + duration


def _damaged(raw: bytes, where: float) -> bytes:
    """The bytes with one of them changed, at a share from 0 to 1 of their length."""
    at = int(where * len(raw))
    return raw[:at] + bytes([raw[at] ^ 0x55]) + raw[at + 1 :]
