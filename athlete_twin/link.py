"""A command link with delay, jitter, bandwidth, loss and outages. Time is an argument: nothing waits, no thread runs.

Messages leave one after the other: each occupies the transmitter for its encoded size over the bandwidth, an outage
holds the transmitter, and what was sent arrives `delay` plus jitter after its last bit left, never out of order. What
arrives is decoded from what was encoded, so that a recording of the bytes replays the same mission.
"""

from __future__ import annotations

import math
from collections import deque
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
    """One direction of a link."""

    delay: float
    """one way [s]"""
    bandwidth: float
    """[bit/s]"""
    jitter: float = 0.0
    """each message takes up to so much longer, uniformly [s]"""
    loss: float = 0.0
    """probability that a message never arrives"""
    outages: tuple[tuple[float, float], ...] = ()
    """from and to, mission time: nothing leaves meanwhile, what was leaving pauses [s]"""

    def __post_init__(self) -> None:
        for name in ("delay", "jitter"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise LinkError(f"link {name} is {value} s, must be 0 or more")
        if not self.bandwidth > 0.0:
            raise LinkError(f"link bandwidth is {self.bandwidth} bit/s, must be positive")
        if not 0.0 <= self.loss < 1.0:
            raise LinkError(f"link loss is {self.loss}, must be in [0, 1)")
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


class DelayedLink:
    """One direction of the link with what is under way on it."""

    def __init__(self, config: LinkConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.bytes_sent = 0
        """of all messages so far, lost ones included"""
        self.messages_sent = 0
        self._rng = rng
        self._free_at = 0.0
        self._last_send = -math.inf
        self._last_arrival = 0.0
        self._under_way: deque[tuple[float, bytes]] = deque()

    def send(self, message: Message, t: float) -> bytes:
        """Put a message on the link at mission time `t` [s]; returns the bytes that leave."""
        if not math.isfinite(t) or t < self._last_send:
            raise LinkError(f"send time is {t} s, must be finite and not before the last one, {self._last_send} s")
        self._last_send = t
        raw = encode(message)
        self.bytes_sent += len(raw)
        self.messages_sent += 1
        self._free_at = self._transmitted(max(t, self._free_at), 8.0 * len(raw) / self.config.bandwidth)
        # Both numbers are drawn for every message, so that a link with loss stays paired with one without.
        late, fate = (float(v) for v in self._rng.random(2))
        arrival = max(self._last_arrival, self._free_at + self.config.delay + self.config.jitter * late)
        if fate >= self.config.loss:
            self._last_arrival = arrival
            self._under_way.append((arrival, raw))
        return raw

    def receive(self, t: float) -> list[Message]:
        """Messages that have arrived by mission time `t` [s] and were not received before, in the order sent."""
        return [decode(raw) for raw in self.receive_raw(t)]

    def receive_raw(self, t: float) -> list[bytes]:
        """The same as bytes, for whoever records them."""
        out = []
        while self._under_way and self._under_way[0][0] <= t:
            out.append(self._under_way.popleft()[1])
        return out

    def next_arrival(self) -> float:
        """When the next message arrives [s]; infinity when none is under way."""
        return self._under_way[0][0] if self._under_way else math.inf

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
