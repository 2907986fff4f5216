"""The map's scores against what is known in closed form, and the rows' format; one real walk, slow."""

import sys
from pathlib import Path

import numpy as np
import pytest

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from planner.terrain.fusion import FusedTerrain

sys.path.append(str(Path(__file__).parents[2] / "scripts"))
from map_scores import load_bearing, score_map
from perception_maps import Figures, _rows, figures


def flat(height, *, cell=0.05, half=5.0):
    n = int(2 * half / cell) + 1
    return HeightGrid(origin_x=-half, origin_y=-half, cell=cell, heights=np.full((n, n), height))


def believed(heights, sigma):
    grid = flat(0.0)
    known = np.isfinite(heights)
    return FusedTerrain(
        grid=HeightGrid(origin_x=grid.origin_x, origin_y=grid.origin_y, cell=grid.cell, heights=heights),
        variance=np.where(known, sigma**2, np.inf), count=known.astype(np.int64), seen=np.where(known, 0.0, -np.inf),
    )  # fmt: skip


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_the_wheels_of_the_stance_stand_in_the_workspace_and_the_far_ground_does_not(robot):
    spec = load_spec(robot)
    pose = SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height]))
    wheels = stance_wheels_in_hex(spec)[:, :2]
    assert load_bearing(spec, pose, flat(0.0), wheels).all()
    assert not load_bearing(spec, pose, flat(0.0), 4.0 * wheels).any()


def test_scores_of_a_map_with_known_errors():
    """Truth zero; the map stands 2 cm too high, a tenth of the cells is unknown, errors of sigma 1 cm."""
    spec, rng = load_spec("sdm_b"), np.random.default_rng(0)
    heights = 0.5 + rng.normal(0.0, 0.01, flat(0.0).shape)
    heights[rng.uniform(size=heights.shape) < 0.1] = np.nan
    pose = SE3.from_translation(np.array([0.0, 0.0, 1.0 + spec.chassis_height]))
    right = score_map(believed(heights, 0.01), flat(1.0), datum=0.5, spec=spec, world_from_hex=pose)
    assert right.band == pytest.approx(0.90, abs=0.01) and right.coverage == pytest.approx(0.90, abs=0.01)
    assert right.rms == pytest.approx(0.01, abs=0.0005) and right.median == pytest.approx(0.00674, abs=0.0005)
    high = score_map(believed(heights + 0.02, 0.01), flat(1.0), datum=0.5, spec=spec, world_from_hex=pose)
    assert high.median == pytest.approx(0.02, abs=0.001) and high.highest_ghost > 0.04


def test_rows_say_what_was_met():
    made = [
        Figures(
            robot="sdm_b", scene=k, steps=10, ended="", median=0.004, rms=0.02, coverage=0.95, band=0.97, ghost=0.01 * k,
            localisation=0.01,
        )
        for k in range(2)
    ]  # fmt: skip
    rows = _rows("sdm_b", made, made)
    assert [row["met"] for row in rows] == [None, True, True, True, False, None, None, True]
    assert rows[0]["ours"] == 0.0 and rows[-2]["ours"] == 2.0  # asked for twenty steps, the walks ended after ten
    keys = {"name", "ours", "unit", "peer_name", "peer", "ratio", "target", "met"}
    assert all(set(row) == keys for row in rows)
    assert _rows("sdm_b", made, [])[-1]["ours"] is None


@pytest.mark.slow
def test_a_real_walk_meets_the_map_figures():
    done = figures(("sdm_b", 0, 3))
    assert done.steps == 3 and not done.ended
    assert done.median <= 0.010 and done.rms <= 0.03 and done.coverage >= 0.90
