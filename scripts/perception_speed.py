"""How long one 1024 x 768 pair takes from images to map: matching, masking, fusing. Two threads, no GPU.

Wall-clock seconds of a process that may use two threads (OMP_NUM_THREADS unset): the best of several runs, since other
jobs on the machine only add. `bench_perception.py` prints the rows.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from bench_table import Row, row
from stereo_scenes import Scene, scenes

from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.model.spec import load_spec
from planner.perception.self_clearance import SelfClearanceConfig, without_hanging_points
from planner.perception.self_mask import SelfMaskConfig, remove_self
from planner.perception.stereo import StereoConfig, match
from planner.terrain.fusion import FusionConfig, TerrainMap

CAMERAS = {"sdm_b": "hazcam_2", "t12": "hazcam_1"}
"""looked through; both see legs and ground"""
TARGET = "<= 350"
"""for a pair from images to map, on two cores [ms]"""
THREADS = 2
RUNS = 7


def rows(*, robots: tuple[str, ...] = ("sdm_b", "t12")) -> list[Row]:
    """Each stage's milliseconds and their sum, a robot after the other."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(THREADS)
    try:
        return [one for robot in robots for one in _rows(robot)]
    finally:
        cv2.setNumThreads(before)


def _rows(robot: str) -> list[Row]:
    scene = next(iter(scenes(robot, (CAMERAS[robot],), seeds=range(1), suns_deg=(35.0,), binnings=(1,))))
    stages = _stages(scene)
    times: dict[str, list[float]] = {name: [] for name in stages}
    product: Any = scene.pair()
    for run in range(RUNS + 1):
        product = scene.pair()
        for name, stage in stages.items():
            start = time.perf_counter()
            product = stage(product)
            if run > 0:  # the first run compiles
                times[name].append(1000.0 * (time.perf_counter() - start))
    whole = [sum(times[name][k] for name in stages) for k in range(RUNS)]
    parts = [row(f"{robot} {name} a 1024x768 pair", min(times[name]), "ms") for name in stages]
    return [*parts, row(f"{robot} match, mask and fuse a 1024x768 pair", min(whole), "ms", target=TARGET)]


def _stages(scene: Scene) -> dict[str, Callable[[Any], Any]]:
    """The stages as `planner.eyes` joins them, each from the product before."""
    spec = load_spec(scene.robot)
    kin = Kinematics(spec)
    parts, links = visual_parts(spec), kin.link_poses(scene.telemetry.joints)
    up = np.array([0.0, 0.0, 1.0])
    ground = kin.wheels_in_hex(scene.telemetry.joints) - np.array([0.0, 0.0, spec.wheel.radius])
    pose = scene.world_from_hex.compose(scene.camera.hex_from_camera)
    grid = TerrainMap.around(0.0, 0.0, config=FusionConfig())

    def masked(depth: Any) -> Any:
        without = remove_self(
            depth, config=SelfMaskConfig(), parts=parts, hex_from_link=links, up_in_hex=up, ground_in_hex=ground
        )
        return without_hanging_points(
            without.depth, spec, links, up_in_hex=up, ground_in_hex=ground, config=SelfClearanceConfig()
        )

    return {
        "match": lambda pair: match(pair, scene.camera, config=StereoConfig()),
        "mask": masked,
        "fuse": lambda depth: grid.fuse(depth, pose),
    }
