"""Measured seconds of each stage: the wall clock lives here and in the scripts, never in the library."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np


class StageTimes:
    """A `planner.decisions.StageTimer` that keeps what it measures."""

    def __init__(self) -> None:
        self._seconds: dict[str, list[float]] = {}
        self._begun = time.perf_counter()

    @contextmanager
    def __call__(self, stage: str, /) -> Iterator[None]:
        """Time one run of `stage`, finished or not."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self._seconds.setdefault(stage, []).append(time.perf_counter() - begun)

    def elapsed(self) -> float:
        """Since this object was made [s]."""
        return time.perf_counter() - self._begun

    def summary(self) -> dict[str, dict[str, float]]:
        """Median, 95th percentile [s] and count of each stage."""
        return {
            stage: {"median": float(np.median(s)), "p95": float(np.percentile(s, 95)), "count": len(s)}
            for stage, s in sorted(self._seconds.items())
        }
