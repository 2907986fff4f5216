"""Where a result comes from: versions, platform, commit. Read once a trial, never by the library."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = (
    "pybullet",
    "gymnasium",
    "numpy",
    "scipy",
    "opencv-python-headless",
    "ompl",
    "open3d-cpu",
    "open3d",
    "filterpy",
    "pin",
    "numba",
)
"""those whose version can change a trajectory"""


def provenance() -> dict[str, Any]:
    """Version of this package, commit, interpreter, machine and the packages that matter."""
    return {
        "version": _version("athlete-twin"),
        "git_sha": _git_sha(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu(),
        "packages": {name: v for name in PACKAGES if (v := _version(name)) is not None},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git_sha() -> str | None:
    """Commit of the checkout this file lies in; None when installed from a wheel."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(root), "rev-parse", "HEAD"], capture_output=True, text=True, timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def _cpu() -> str | None:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or None
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or None
