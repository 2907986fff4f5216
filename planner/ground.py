"""The terrain as one plan sees it: heights with unknown cells, heights without, and the footfalls on it.

Place in the flow: fused terrain -> `Ground`, scored by `footfall`, before route and gait. A variant without pictures believes in a
plane under the wheels instead. What nobody saw counts as the variant's `unknown_terrain` says.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.geometry.grid import HeightGrid
from planner.belief import Belief
from planner.config import PlannerConfig
from planner.footfall import score_footfalls
from planner.gait.step_search import Ground
from planner.terrain.fusion import FusedTerrain
from planner.terrain.spikes import without_spikes

FLAT_RADIUS = 8.0
"""of the flat map of a variant without pictures [m]"""


def mapped_ground(terrain: FusedTerrain, config: PlannerConfig, *, wheel_radius: float) -> Ground:
    """The ground as the pictures show it, blades taken out of it.

    Args:
        terrain: fused from all pictures so far.
        config: what unknown ground counts as, how far a swing keeps off vague ground, what a footfall needs.
        wheel_radius: [m]
    """
    fused, collision = without_spikes(terrain, config=config.spikes), config.step.collision
    if config.unknown_terrain == "flat":
        grid = filled = cautious = fused.filled("nearest").grid
    else:
        # What nobody saw may hide a rock as high as the highest beside it, and a little more.
        guessed = fused.filled("highest", margin=collision.unknown_rise)
        grid = fused.grid
        filled = guessed.grid if config.unknown_terrain == "obstacle" else fused.filled("nearest").grid
        # Where the map is vague a swing keeps farther off, so far that its clearance is of the vaguest height allowed for.
        cautious = guessed.raised(collision.map_deviations, over=collision.map_error_covered).grid
    # A cell that is believed to be as high as its neighbours is believed to be sure; any other of which nobody knows is not.
    believed = fused.unknown & (config.unknown_terrain == "flat")
    variance = np.where(believed, 0.0, fused.variance)
    footfalls = score_footfalls(grid, variance, wheel_radius=wheel_radius, config=config.footfall)
    return Ground(heights=grid, filled=filled, cautious=cautious, footfalls=footfalls)


def flat_ground(belief: Belief, config: PlannerConfig, *, wheel_radius: float) -> Ground:
    """The plane under the wheels, believed to be sure: the ground of a variant without pictures."""
    grid = plane_under(belief, cell=config.fusion.cell)
    footfalls = score_footfalls(grid, np.zeros(grid.shape), wheel_radius=wheel_radius, config=config.footfall)
    return Ground(heights=grid, filled=grid, cautious=grid, footfalls=footfalls)


def plane_under(belief: Belief, *, cell: float) -> HeightGrid:
    """A flat map about the chassis: the plane through the standing wheels' contacts, its cells of edge `cell` [m]."""
    contacts = belief.contacts_in_world[belief.planted]
    design = np.column_stack([contacts[:, :2], np.ones(len(contacts))])
    slope_x, slope_y, height = np.linalg.lstsq(design, contacts[:, 2], rcond=None)[0]
    n = int(2 * FLAT_RADIUS / cell) + 1
    x = belief.world_from_hex.translation[0] - FLAT_RADIUS + cell * np.arange(n)
    y = belief.world_from_hex.translation[1] - FLAT_RADIUS + cell * np.arange(n)
    heights = slope_x * x[:, None] + slope_y * y[None, :] + height
    return HeightGrid(origin_x=float(x[0]), origin_y=float(y[0]), cell=cell, heights=heights)
