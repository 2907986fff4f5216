"""One walk for the map's sake: so many steps with the recommended planner, and what the ground then believes.

Beside the map the walk notes where pixels of the robot itself passed the mask (the pictures' true labels say so): only there
can a leg have left a ghost.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.link import DelayedLink, downlink, uplink
from athlete_twin.model.spec import RobotSpec, load_spec
from athlete_twin.robot import ViewTruth
from athlete_twin.world.scenario import load_scenario
from envs.build import twin, variant_content
from envs.mission import Mission
from planner.agent import GroundAgent
from planner.config import planner_config
from planner.decisions import ApproveAll
from planner.eyes import Look
from planner.terrain.fusion import FusedTerrain
from planner.terrain.spikes import without_spikes

SUN_DEG = (15.0, 35.0, 70.0)
"""elevation of the sun by a scene's number, in turn [deg]"""
GOAL = 6.0
"""ahead: farther than the steps go [m]"""
ROBOT = 3
"""label of the robot in `ViewTruth.label`"""
LOOK_EVERY = 5.0
"""how often the runner looks whether an answer is wanted [s]"""


@dataclass(eq=False, kw_only=True)
class LegPixels:
    """Where pixels of the robot that the mask let pass were put into the world."""

    points: list[np.ndarray] = field(default_factory=list)
    """believed, each shape (n, 3) [m]"""
    _views: dict[tuple[str, float], ViewTruth] = field(default_factory=dict)

    def saw(self, view: ViewTruth) -> None:
        """What a picture truly shows; kept until the ground has looked at it."""
        self._views[view.camera, view.t] = view

    def looked(self, look: Look) -> None:
        """What the ground made of a picture."""
        view = self._views.pop((look.camera, look.t), None)
        if view is None:
            return
        depth = look.masked.depth
        slipped = (view.label == ROBOT) & np.isfinite(depth.depth)
        self.points.append(look.world_from_camera.apply(depth.points_in_camera()[slipped]))


@dataclass(frozen=True, eq=False, kw_only=True)
class Walk:
    """The end of a walk."""

    spec: RobotSpec
    steps: int
    """taken"""
    ended: str
    """why it ended before all its steps; empty when it did not"""
    terrain: FusedTerrain
    """as the planner plans on it: without blades"""
    t: float
    """mission time of the end [s]"""
    truth: HeightGrid
    datum: float
    """true height of what the ground calls zero [m]"""
    world_from_hex: SE3
    """truly"""
    localisation_errors: np.ndarray
    """of the believed chassis at each proposal [m]"""
    slipped: np.ndarray
    """where the robot's own pixels passed the mask, shape (n, 3) [m]"""


def walk(robot: str, scene: int, *, steps: int, variant: str = "integrated") -> Walk:
    """Let a robot take so many steps through the rock field of one scene; the scene's number is its seed."""
    spec = load_spec(robot)
    sun = float(np.deg2rad(SUN_DEG[scene % len(SUN_DEG)]))
    scenario = replace(load_scenario("rock_field"), sun_elevation=sun)
    pixels, operator = LegPixels(), ApproveAll()
    path, content = variant_content(variant)
    config = planner_config(content, spec, name=path.stem)
    agent = GroundAgent(spec, config, goal_in_world=np.array([GOAL, 0.0]), seed=scene)
    agent.eyes.on_look = pixels.looked
    body, truth = twin(spec, scenario, scene)
    try:
        body.on_view = pixels.saw
        mission = Mission(
            body,
            up=DelayedLink(uplink(0.0), np.random.default_rng([scene, 1])),
            down=DelayedLink(downlink(0.0), np.random.default_rng([scene, 2])),
            agent=agent,
        )
        datum = float(np.mean(truth.sample(body.truth().wheels_in_world[:, :2])))
        errors: list[float] = []
        ended = ""
        while True:
            mission.advance(mission.t + LOOK_EVERY)
            if mission.finished:
                ended = mission.no_step.reason if mission.no_step else "arrived"
                break
            if mission.wants_answer and mission.standing is not None:
                here = body.truth().world_from_hex.translation - np.array([0.0, 0.0, datum])
                errors.append(float(np.linalg.norm(mission.standing.world_from_hex.translation - here)))
                if sum(agent.stepped.values()) >= steps:
                    break
                decision, seconds = operator.decide(mission.standing, mission.t)
                mission.answer(decision, seconds=seconds)
        return Walk(
            spec=spec, steps=sum(agent.stepped.values()), ended=ended, t=mission.t, truth=truth,
            terrain=without_spikes(agent.eyes.map.fused(), config=config.spikes), datum=datum, world_from_hex=body.truth().world_from_hex,
            localisation_errors=np.array(errors),
            slipped=np.concatenate([np.zeros((0, 3)), *pixels.points]),
        )  # fmt: skip
    finally:
        body.close()


def highest_leg_ghost(done: Walk, reach: np.ndarray, *, radius: float) -> float:
    """By which a cell that the robot's own pixels fell into stands over all true ground within `radius` [m]; at least 0.

    Judged are cells of `reach`, shape (nx, ny): nobody steps elsewhere. The pixels' cells count with their eight neighbours.
    """
    grid = done.terrain.grid
    ix, iy, inside = grid.index(done.slipped[:, :2])
    touched = np.zeros(grid.shape, dtype=bool)
    touched[ix[inside], iy[inside]] = True
    touched = ndimage.binary_dilation(touched, np.ones((3, 3), dtype=bool))
    x, y = grid.centres()
    true = done.truth.sample(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)) - done.datum
    cells = 2 * round(radius / grid.cell) + 1
    over = grid.heights - ndimage.maximum_filter(true, cells, mode="nearest")
    over = over[touched & reach & np.isfinite(over)]
    return max(float(over.max()), 0.0) if len(over) else 0.0
