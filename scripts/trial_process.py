"""The process of one trial of a comparison, started by whoever runs it: a worker of this machine, or a task on another."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import envs
from envs.suite_trial import ASKED, LOG, Asked, asked_of

LOOK = 0.2
"""between two looks at the process of a remote trial [s]"""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""variables that say how many threads a library takes: one, as there is a process a core"""


def run_in_folder(asked: Asked, folder: Path, *, inherited: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """Starts the trial's process; what it prints goes to `log.txt`. It lives no longer than its standard input.

    Args:
        asked: the trial.
        folder: where its files go.
        inherited: open files that the process holds as long as it lives.
    """
    (folder / ASKED).write_text(asked.text())
    # It finds the modules that this process finds, in the same order, those of a user's planner among them.
    paths = [str(Path(envs.__file__).resolve().parent.parent), *(p for p in sys.path if p)]
    environment = os.environ | dict.fromkeys(THREADS, "1") | {"PYTHONPATH": os.pathsep.join(dict.fromkeys(paths))}
    with (folder / LOG).open("wb") as log:
        # A session of its own: Ctrl-C is the runner's to handle.
        return subprocess.Popen(
            [sys.executable, "-P", "-X", "faulthandler", "-m", "envs.suite_trial", str(folder)],
            stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, env=environment, start_new_session=True,
            pass_fds=tuple(inherited),
        )  # fmt: skip


def remote_trial(content: dict[str, Any]) -> tuple[int, dict[str, bytes]]:
    """A trial on another machine: exit status of its process, and its files."""
    with tempfile.TemporaryDirectory(prefix="athlete_trial_") as name:
        folder = Path(name)
        process = run_in_folder(asked_of(content), folder)
        try:
            # A task that is cancelled notices between two looks, not within one wait.
            while (status := process.poll()) is None:
                time.sleep(LOOK)
        finally:
            process.kill()
            process.wait()
        return status, {p.name: p.read_bytes() for p in sorted(folder.iterdir()) if p.is_file()}
