"""Who runs the trials of a comparison: processes of this machine, or a Ray cluster. Either way each trial has a process of its own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import trial_process

from athlete_twin.errors import ConfigError
from envs.suite_trial import TRIAL, Asked

MOMENT = 0.1
"""between two looks at the processes [s]"""
ANSWER = 5.0
"""within which a cluster answers [s]"""
FAREWELL = 10.0
"""within which a task that is cancelled ends [s]"""
LOOKS = 5
"""after which it is said that nothing ended"""


class LocalCrew:
    """Processes of this machine."""

    def __init__(self, size: int) -> None:
        self.size = size
        self._running: dict[Asked, subprocess.Popen[bytes]] = {}

    def start(self, asked: Asked, folder: Path, *, lock: int) -> None:
        """A process; it keeps the lock, so that nobody takes the folder before it is gone."""
        self._running[asked] = trial_process.run_in_folder(asked, folder, inherited=(lock,))

    def ended(self) -> list[tuple[Asked, int]]:
        """Whose process is gone."""
        for _ in range(LOOKS):
            gone = [(asked, p.returncode) for asked, p in self._running.items() if p.poll() is not None]
            for asked, _status in gone:
                _close(self._running.pop(asked))
            if gone:
                return gone
            time.sleep(MOMENT)
        return []

    def stop(self) -> None:
        """End the processes at once: what they were at is done anew another time."""
        for process in self._running.values():
            process.kill()
        for process in self._running.values():
            process.wait()
            _close(process)
        self._running.clear()


class RayCrew:
    """A Ray cluster on whose nodes this package is installed; files come back over Ray, so that no disk need be shared."""

    def __init__(self, address: str, size: int | None) -> None:
        try:
            import ray
        except ImportError as e:
            raise ConfigError("--ray needs Ray: pip install 'athlete-twin[cluster]', or leave --ray out") from e
        self._ray: Any = ray
        _check_listens(address)
        here = {"num_cpus": size or local_cores(), "include_dashboard": False} if address == "local" else {}
        on_term = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address=address, log_to_driver=False, logging_level="error", **here)
        except (ConnectionError, ValueError, RuntimeError) as e:
            raise ConfigError(_no_cluster(address, str(e))) from e
        # Ray takes the signal for itself, and would abort.
        signal.signal(signal.SIGTERM, on_term)
        self.size = size or max(1, int(ray.cluster_resources().get("CPU", 1)))
        # Scripts are not installed on the nodes: the function goes there itself.
        ray.cloudpickle.register_pickle_by_value(trial_process)
        self._run = ray.remote(num_cpus=1, max_retries=0)(trial_process.remote_trial)
        self._running: dict[Any, tuple[Asked, Path]] = {}

    def start(self, asked: Asked, folder: Path, *, lock: int) -> None:  # noqa: ARG002  (only this process writes here)
        """A task of the cluster."""
        self._running[self._run.remote(asked.content())] = (asked, folder)

    def ended(self) -> list[tuple[Asked, int]]:
        """Whose task is done; its files are put into its folder, the result last."""
        done, _ = self._ray.wait(list(self._running), num_returns=1, timeout=LOOKS * MOMENT)
        return [self._fetched(reference) for reference in done]

    def stop(self) -> None:
        """Give up what runs and leave the cluster."""
        for reference in self._running:
            self._ray.cancel(reference)
        if self._running:
            # Each then ends its process and clears its folder away.
            self._ray.wait(list(self._running), num_returns=len(self._running), timeout=FAREWELL)
        self._running.clear()
        self._ray.shutdown()

    def _fetched(self, reference: Any) -> tuple[Asked, int]:
        asked, folder = self._running.pop(reference)
        try:
            status, files = self._ray.get(reference)
        except self._ray.exceptions.RayError as e:
            # A node that was lost is a trial that could not be run: the row says so.
            lines = [line.strip() for line in str(e).splitlines() if line.strip()]
            (folder / "log.txt").write_text(f"Ray: {type(e).__name__}: {lines[0] if lines else ''}\n")
            return asked, 1
        for name in sorted(files, key=lambda name: name == TRIAL):
            part = folder / f"{name}.part"
            part.write_bytes(files[name])
            part.replace(folder / name)
        return asked, status


def local_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _check_listens(address: str) -> None:
    """Refuses an address where nobody answers: Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        try:
            socket.create_connection((host, int(port)), timeout=ANSWER).close()
        except (OSError, OverflowError) as e:
            raise ConfigError(_no_cluster(address, str(e))) from e


def _no_cluster(address: str, told: str) -> str:
    return (
        f"no Ray cluster at {address!r} ({' '.join(told.split())[:200]}); start one with `ray start --head`, or give 'local' to have "
        "one started here"
    )


def _close(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None:
        process.stdin.close()
