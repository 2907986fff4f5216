#!/usr/bin/env bash
# Makes .venv from constraints.txt and checks that every library of it loads. Safe to run again at any time.
# PYTHON=/path/to/python3.11 chooses the interpreter; without it, the first one that is CPython 3.11 is taken.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=.venv
# What the wheels link against and pip cannot bring; Debian's names.
system_packages=(libgl1 libegl1 libx11-6 libudev1 libgomp1)

say() { printf 'setup: %s\n' "$*" >&2; }
die() { say "$@"; exit 1; }

can_apt() { [[ "$(id -u)" == 0 ]] && command -v apt-get >/dev/null; }
apt_install() {
    say "installing $* with apt-get"
    { apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends "$@"; } >&2
}

is_cpython_311() {
    # A shim may be on the PATH and still refuse to run, so ask the interpreter itself.
    "$1" -c 'import sys; sys.exit(sys.implementation.name != "cpython" or sys.version_info[:2] != (3, 11))' \
        >/dev/null 2>&1
}

find_python() {
    local candidate
    for candidate in ${PYTHON:+"$PYTHON"} python3.11 /usr/bin/python3.11 /usr/local/bin/python3.11 python3 python; do
        if is_cpython_311 "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    if command -v uv >/dev/null && candidate=$(uv python find 3.11 2>/dev/null) && is_cpython_311 "$candidate"; then
        echo "$candidate"
        return
    fi
    return 1
}

make_venv() {
    local python
    if ! python=$(find_python); then
        can_apt && { apt_install python3.11 python3.11-venv || true; }
        python=$(find_python) || die "CPython 3.11 not found (PyBullet ships no wheels for later versions)." \
            "Install it, e.g. 'apt-get install python3.11 python3.11-venv', 'brew install python@3.11'," \
            "'pyenv install 3.11' or 'uv python install 3.11', or name it: make setup PYTHON=/path/to/python3.11"
    fi
    if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        can_apt && { apt_install python3.11-venv || true; }
        "$python" -c 'import ensurepip, venv' >/dev/null 2>&1 \
            || die "$python cannot make virtual environments; install the package python3.11-venv"
    fi
    say "making $venv with $("$python" --version) at $(command -v "$python")"
    "$python" -m venv --clear "$venv"
}

pip_install() { "$venv/bin/python" -m pip install -qq --disable-pip-version-check -c constraints.txt "$@"; }

pip_install_learning() {
    # torch's default wheel for Linux brings 3 GB of CUDA. Only its CPU build is taken there, 0.2 GB, where pip knows one.
    local torch
    torch="torch==$(sed -n 's/^torch==//p' constraints.txt)"
    [[ "$(uname -s)" == Linux ]] && torch+="+cpu"
    pip_install "$torch" -e '.[rl]' 2>/dev/null
}

libraries_load() {
    # In one interpreter, as the programs use them. Open3D goes through the loader, which names what is missing.
    "$venv/bin/python" - <<'PY'
import sys

import coal, cv2, numba, ompl.base, pinocchio, pybullet, scipy  # noqa: E401
from athlete_twin.errors import MissingLibraryError
from athlete_twin.geometry.open3d_loader import open3d

try:
    open3d()
except MissingLibraryError as e:
    sys.exit(f"setup: {e}")
PY
}

is_cpython_311 "$venv/bin/python" && "$venv/bin/python" -m pip --version >/dev/null 2>&1 || make_venv

say "installing the pinned packages (a few minutes and about 2 GB the first time)"
pip_install -e '.[dev]' || { say "pip failed; trying once more"; sleep 5; pip_install -e '.[dev]'; } \
    || die "pip could not install the packages of constraints.txt; its messages are above"

pip_install_learning || say "pip finds no CPU build of torch: the tests that train a learner are skipped" \
    "(with CUDA: $venv/bin/python -m pip install -c constraints.txt -e '.[rl]')"

if ! problem=$(libraries_load 2>&1); then
    can_apt && { apt_install "${system_packages[@]}" || true; }
    problem=$(libraries_load 2>&1) || {
        printf '%s\n' "$problem" | tail -n 3 >&2
        die "a system library is missing. On Debian or Ubuntu: apt-get install ${system_packages[*]}"
    }
fi
say "ready: $venv"
