"""Timed paths against closed forms, the limits sampled from outside, and the toppra library on the same cells."""

import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from athlete_twin.errors import KinematicsError
from athlete_twin.geometry.blended_path import BlendedPath, blended
from athlete_twin.geometry.time_optimal import TimedPath, time_optimal

SPEED, ACCELERATION, PERIOD = 0.1, 0.2, 1.0 / 24.0
TOLERANCE = 0.01
ROUNDING = 1e-9
"""of the limits, relative: the samples themselves are differences of numbers near 1"""


def timed(nodes, tolerance: float = TOLERANCE, *, speed: float = SPEED, acceleration: float = ACCELERATION) -> TimedPath:
    return time_optimal(blended(np.asarray(nodes, dtype=float), tolerance), speed=speed, acceleration=acceleration)


def trapezoid(length: float, speed: float, acceleration: float) -> float:
    """Time from rest to rest along a line."""
    ramp = speed**2 / acceleration
    return 2.0 * np.sqrt(length / acceleration) if length < ramp else length / speed + speed / acceleration


def constant_speed(nodes: np.ndarray, speed: float) -> float:
    """Each straight piece at the speed of its fastest joint, without ramps."""
    return float(np.abs(np.diff(nodes, axis=0)).max(axis=1).sum() / speed)


def followed(motion: TimedPath, start: np.ndarray) -> np.ndarray:
    """What the executive commands, standing still before and after."""
    out = np.array(list(motion.samples(PERIOD)))
    return np.concatenate([[start, start], out, out[-1:]])


def _polyline(seed: int, count: int, scale: float, repeats: str) -> np.ndarray:
    rng = np.random.default_rng(seed)
    nodes = scale * rng.standard_normal((count, 7))
    middle = count // 2
    if repeats and count > 2:
        off = {"same": 0.0, "near": 1e-5 * rng.standard_normal(7), "back": 0.0}[repeats]
        nodes[middle] = nodes[middle - 2 if repeats == "back" else middle - 1] + off
    return nodes


polylines = st.builds(
    _polyline,
    st.integers(0, 2**32 - 1),
    st.integers(1, 12),
    st.sampled_from([1e-5, 1e-3, 0.02, 0.3, 1.5]),
    st.sampled_from(["", "same", "back", "near"]),
)


@settings(max_examples=120, deadline=None)
@given(nodes=polylines, tolerance=st.sampled_from([0.0, 1e-3, TOLERANCE]))
@pytest.mark.slow
def test_what_is_commanded_keeps_speed_and_acceleration_and_ends_at_rest_on_the_last_way_point(nodes, tolerance):
    """No slack but rounding: first and second differences are means of speed and acceleration over a period."""
    q = followed(timed(nodes, tolerance), nodes[0])
    assert np.abs(np.diff(q, axis=0)).max() <= SPEED * PERIOD * (1.0 + ROUNDING)
    assert np.abs(np.diff(q, 2, axis=0)).max() <= ACCELERATION * PERIOD**2 * (1.0 + ROUNDING) + 8.0 * np.spacing(np.abs(q).max())
    np.testing.assert_array_equal(q[-1], nodes[-1])


@settings(max_examples=60, deadline=None)
@given(nodes=polylines)
def test_it_is_never_faster_than_speed_and_acceleration_allow_between_the_ends_of_any_piece(nodes):
    motion = timed(nodes)
    net = float(np.abs(nodes[-1] - nodes[0]).max())
    assert motion.duration >= trapezoid(net, SPEED, ACCELERATION) * (1.0 - 1e-9)
    # Corners are cut: the way left is shorter by what the blends leave out, at most two of their widths each.
    widths = sum(float(np.linalg.norm(b[-1] - b[0])) for _, b in motion.path.blends(0.01))
    assert motion.duration >= constant_speed(nodes, SPEED) - (2.0 * widths + 1e-5) / SPEED


@pytest.mark.parametrize("length", [1e-4, 0.01, 0.049, 0.051, 0.3, 2.0])
def test_one_straight_piece_takes_the_time_of_the_trapezoid(length):
    nodes = np.array([np.zeros(6), length * np.array([0.2, -1.0, 0.5, 0.0, 0.9, 0.1])])
    assert timed(nodes).duration == pytest.approx(trapezoid(length, SPEED, ACCELERATION), rel=1e-2)
    assert timed(nodes).duration >= trapezoid(length, SPEED, ACCELERATION) * (1.0 - 1e-12)


def test_a_path_that_turns_right_round_rests_there():
    nodes = np.array([np.zeros(6), np.full(6, 0.2), np.zeros(6)])
    motion = timed(nodes)
    assert motion.duration == pytest.approx(2.0 * trapezoid(0.2, SPEED, ACCELERATION), rel=1e-2)
    assert motion.speeds[np.argmin(np.abs(motion.grid - motion.path.knots[1]))] == 0.0
    np.testing.assert_allclose(motion.at(np.array([0.5 * motion.duration]))[0], nodes[1], atol=1e-9)


def test_without_tolerance_each_piece_goes_from_rest_to_rest():
    nodes = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.2], [0.1, 0.2]])
    pieces = sum(trapezoid(float(np.abs(b - a).max()), SPEED, ACCELERATION) for a, b in itertools.pairwise(nodes))
    assert timed(nodes, 0.0).duration == pytest.approx(pieces, rel=1e-2)
    assert timed(nodes).duration < 0.9 * pieces


def test_cutting_a_corner_more_takes_less_time():
    nodes = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.3]])
    durations = [timed(nodes, tolerance).duration for tolerance in (0.0, 0.001, 0.003, 0.01)]
    assert all(b < a for a, b in itertools.pairwise(durations))


def test_half_the_speed_at_a_quarter_of_the_acceleration_is_the_same_motion_slower():
    nodes = _polyline(3, 6, 0.3, "")
    full, half = timed(nodes), timed(nodes, speed=0.5 * SPEED, acceleration=0.25 * ACCELERATION)
    assert half.duration == pytest.approx(2.0 * full.duration, rel=1e-9)
    t = np.linspace(0.0, full.duration, 50)
    np.testing.assert_allclose(half.at(2.0 * t), full.at(t), atol=1e-9)


@pytest.mark.parametrize("nodes", [[[0.3, 0.1]], [[0.3, 0.1], [0.3, 0.1]]])
def test_where_there_is_nowhere_to_go_one_sample_says_so(nodes):
    motion = timed(nodes)
    assert motion.duration == 0.0 and motion.ticks(PERIOD) == 1
    np.testing.assert_array_equal(list(motion.samples(PERIOD)), [nodes[-1]])


def toppra_duration(motion: TimedPath) -> float:
    """The library on the same cells, with the limits held at both ends of each."""
    import toppra.algorithm
    from toppra.constraint import LinearConstraint

    path, grid, steps = motion.path, motion.grid, np.diff(motion.grid)

    class Limits(LinearConstraint):
        def compute_constraint_params(self, *_):
            first, bends, last, caps = cells_of(path, grid)
            a = np.concatenate([first, last + 2.0 * steps[:, None] * bends], axis=1)
            b = np.concatenate([bends, bends], axis=1)
            a, b = (np.concatenate([rows, rows[-1:]]) for rows in (a, b))
            both = np.concatenate([np.eye(a.shape[1]), -np.eye(a.shape[1])])
            self.identical = True
            bounds = np.column_stack([np.zeros(len(grid)), caps])
            return a, b, np.zeros_like(a), both, np.full(len(both), ACCELERATION), None, bounds

    class Line:
        path_interval, dof = np.array([grid[0], grid[-1]]), path.origins.shape[1]

    solver = toppra.algorithm.TOPPRA([Limits()], Line(), gridpoints=grid, solver_wrapper="seidel")
    _, speeds, _ = solver.compute_parameterization(0.0, 0.0)
    return float((2.0 * steps / (speeds[1:] + speeds[:-1])).sum())


def cells_of(path: BlendedPath, grid: np.ndarray):
    """Directions at both ends of each cell, bends, and the squared speed allowed at each grid point, from the path alone."""
    piece = np.searchsorted(path.knots, 0.5 * (grid[1:] + grid[:-1]), side="right") - 1
    first = path.directions[piece] + (grid[:-1] - path.knots[piece])[:, None] * path.bends[piece]
    last = path.directions[piece] + (grid[1:] - path.knots[piece])[:, None] * path.bends[piece]
    steepest = np.maximum(np.abs(first), np.abs(last)).max(axis=1)
    caps = np.minimum(np.append(np.inf, (SPEED / steepest) ** 2), np.append((SPEED / steepest) ** 2, np.inf))
    for at in path.knots[path.stops]:
        caps[np.argmin(np.abs(grid - at))] = 0.0
    return first, path.bends[piece], last, caps


@pytest.mark.parametrize("seed", range(12))
def test_toppra_finds_the_same_time_on_the_same_cells(seed):
    """To a thousandth: at each step the library stays 1e-8 (rad/s)2 below what it found."""
    motion = timed(_polyline(seed, 2 + seed % 6, 0.3, ""))
    theirs = toppra_duration(motion)
    assert motion.duration <= theirs * (1.0 + 1e-9)
    assert motion.duration == pytest.approx(theirs, rel=1e-3)


def test_the_same_path_gives_the_same_bytes_in_another_process():
    program = (
        "import sys\nimport numpy as np\nfrom athlete_twin.geometry.blended_path import blended\n"
        "from athlete_twin.geometry.time_optimal import time_optimal\n"
        "nodes = 0.3 * np.random.default_rng(5).standard_normal((6, 6))\n"
        "motion = time_optimal(blended(nodes, 0.01), speed=0.1, acceleration=0.2)\n"
        "sys.stdout.write(np.array(list(motion.samples(1.0 / 24.0))).tobytes().hex())\n"
    )
    runs = [
        subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=dict(os.environ)).stdout
        for _ in range(2)
    ]
    assert runs[0] == runs[1] and len(runs[0]) > 1000


@pytest.mark.parametrize("limits", [{"speed": 0.0}, {"acceleration": -1.0}, {"speed": np.inf}, {"acceleration": np.nan}])
def test_limits_that_are_none_are_refused(limits):
    with pytest.raises(KinematicsError, match="must be positive and finite"):
        timed(np.zeros((2, 6)), **limits)
