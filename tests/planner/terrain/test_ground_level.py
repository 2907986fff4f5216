"""Pictures of the ground beside the wheels tell how deep they stand."""

import numpy as np
import pytest

from planner.terrain.fusion import FusionConfig, TerrainMap
from planner.terrain.ground_level import ground_over_contacts

ANGLES = np.deg2rad(60.0 * np.arange(6))
WHEELS = np.column_stack([2.0 * np.cos(ANGLES), 2.0 * np.sin(ANGLES)])


def seen(height, *, keep=lambda _x, _y: True):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-3.0, 3.0, (150000, 2))
    xy = xy[np.broadcast_to(keep(xy[:, 0], xy[:, 1]), len(xy))]
    terrain = TerrainMap.around(0.0, 0.0, config=FusionConfig(size_x=7.0, size_y=7.0))
    terrain.fuse_points(np.column_stack([xy, height(xy[:, 0], xy[:, 1])]), np.full(len(xy), 0.01))
    return terrain.fused()


def slope(x, y):
    return 0.1 * x - 0.05 * y


def test_depth_of_the_wheels_is_read_off_a_slope():
    contacts = np.column_stack([WHEELS, slope(*WHEELS.T) - 0.02])
    assert ground_over_contacts(seen(slope), contacts) == pytest.approx(0.02, abs=0.001)


def test_rocks_beside_two_wheels_do_not_lift_the_ground():
    rocks = lambda x, y: slope(x, y) + 0.2 * (np.hypot(x - 2.35, y) < 0.2) + 0.3 * (np.hypot(x + 2.3, y) < 0.2)  # noqa: E731
    contacts = np.column_stack([WHEELS, slope(*WHEELS.T) - 0.02])
    assert ground_over_contacts(seen(rocks), contacts) == pytest.approx(0.02, abs=0.003)


def test_too_little_seen_or_too_much_found_says_nothing():
    contacts = np.column_stack([WHEELS, slope(*WHEELS.T) - 0.02])
    assert ground_over_contacts(seen(slope, keep=lambda x, _y: x > 1.5), contacts) is None
    assert ground_over_contacts(seen(slope), contacts - [0.0, 0.0, 0.3]) is None
