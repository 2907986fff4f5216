"""How long a stereo pair takes to draw, beside PyBullet's TinyRenderer with the same robot, ground, eyes and places.

    python scripts/bench_render.py [--robots sdm_b t12] [--repeats 7] [--json]

Ours is a whole capture of a trial's scene: the robot's tree for its posture, two eyes with sun, hard shadows and texture, photon
and read noise. TinyRenderer draws colour and depth of both eyes without shadows, noise or texture, of the same meshes
(its light is on, its shadows are off: here they cost time and change nothing). Medians of wall time, both with all
cores. Cost grows with the pixels; with the triangles by their logarithm for us, linearly for TinyRenderer.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import tyro
from bench_table import Row, row, show
from tiny_renderer import TinyScene

from athlete_twin.errors import AthleteError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import visual_parts
from athlete_twin.model.camera import Pinhole, StereoCamera
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import RobotSpec, load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.sensors.renderer import Renderer
from athlete_twin.sensors.stereo_camera import StereoRig
from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import build_terrain

SIZES = {(640, 480): 0.150, (1024, 768): 0.400}
"""of a picture [px], and the time that a pair may take [s]"""
CAMERA = "hazcam_2"
"""looks across the body: half of its picture is robot"""
SCENARIO = "rock_field"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures and prints two rows a robot and size."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    repeats: int = 7
    """of each measurement, after one that warms up"""
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    if options.repeats < 1:
        sys.stderr.write(f"bench_render: --repeats {options.repeats} must be at least 1\n")
        return 2
    try:
        rows = [r for robot in options.robots for r in _rows(load_spec(robot), options.repeats)]
    except AthleteError as e:
        sys.stderr.write(f"bench_render: {' '.join(str(e).split())}\n")
        return 2
    show(rows, as_json=options.json)
    return 0


def _rows(spec: RobotSpec, repeats: int) -> list[Row]:
    clear = stance_wheels_in_hex(spec)[:, :2]
    terrain = build_terrain(load_scenario(SCENARIO), 0, clear_xy=clear, clear_radius=0.45)
    world_from_hex = SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height]))
    joints = regular_stance(spec)
    links = {n: world_from_hex.compose(p) for n, p in kinematics(spec.name).link_poses(joints).items()}
    renderer = Renderer(terrain, visual_parts(spec))
    rows = []
    with TinyScene(spec, terrain.grid, world_from_hex, joints) as tiny:
        for (width, height), limit in SIZES.items():
            sized = _resized(spec, width, height)
            camera = sized.camera(CAMERA)
            rig = StereoRig(sized, renderer, seed=0, camera_error=nominal_truth(sized).camera_error)
            ours = _median(_capture(rig, links, world_from_hex), repeats)
            eyes = [world_from_hex.compose(e) for e in (camera.hex_from_camera, camera.hex_from_right())]
            theirs = _median(_tiny(tiny, eyes, camera.eye), repeats)
            name = f"{spec.name} pair of {width} x {height}"
            rows += [
                row(name, 1e3 * ours, "ms", target=f"<= {1e3 * limit:g}"),
                row(f"{name} over TinyRenderer", 1e3 * ours, "ms", target="< 1", of="ratio", peer_name="TinyRenderer", peer=1e3 * theirs),
            ]  # fmt: skip
    return rows


def _resized(spec: RobotSpec, width: int, height: int) -> RobotSpec:
    """The drawings with eyes of another size and the same field of view."""

    def sized(camera: StereoCamera) -> StereoCamera:
        hfov = 2.0 * np.arctan(0.5 * camera.eye.width_px / camera.eye.focal_px)
        return replace(camera, eye=Pinhole.from_fov(width, height, float(hfov)))

    return replace(spec, cameras=tuple(sized(c) for c in spec.cameras))


def _capture(rig: StereoRig, links: dict[str, SE3], world_from_hex: SE3) -> Callable[[], object]:
    return lambda: rig.capture([CAMERA], 1, links, world_from_hex=world_from_hex, index=0)


def _tiny(tiny: TinyScene, eyes: list[SE3], eye: Pinhole) -> Callable[[], object]:
    return lambda: [tiny.picture(pose, eye) for pose in eyes]


def _median(work: Callable[[], object], repeats: int) -> float:
    """Median time of several runs after one that warms up [s]."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


if __name__ == "__main__":
    sys.exit(main())
