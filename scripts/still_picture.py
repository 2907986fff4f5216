"""A still picture of a robot among the rocks of a scenario, one leg in the air, as the README shows it.

    python scripts/still_picture.py --robot sdm_b --scenario rock_field --seed 0 --out docs/sdm_b_rock_field.png

The stance is set, not simulated; ground, rocks, sun and robot are those of the twin.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from trial_recording import terrain_of

from athlete_twin.errors import AthleteError, ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import Kinematics
from athlete_twin.sensors.onlooker import Posture, looking, stand_point
from athlete_twin.world.terrain import Terrain

MOST_BYTES = 400_000
"""of the file; colours are rounded until it fits"""
SAG = 0.06
"""of the chassis [m]"""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Draws one picture."""

    robot: str = "sdm_b"
    """sdm_b or t12"""
    scenario: str = "rock_field"
    """name of a scenario, or a path ending in .toml"""
    seed: int = 0
    """of the terrain"""
    leg: int = 2
    """number of the leg in the air, 1 to 6"""
    distance: float = 4.0
    """of the onlooker, in foot radii"""
    elevation_deg: float = 13.0
    """of the onlooker above the middle of the robot"""
    out: Path = Path("still.png")
    """the picture, a PNG"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        size = draw(options)
    except AthleteError as e:
        sys.stderr.write(f"still_picture: {' '.join(str(e).split())}\n")
        return 2
    sys.stdout.write(f"written: {options.out}, {size / 1000:.0f} kB\n")
    return 0


def draw(options: Options) -> int:
    """Writes the picture; its size [byte]."""
    from athlete_twin.model.appearance import visual_parts
    from athlete_twin.model.camera import Pinhole
    from athlete_twin.model.spec import load_spec
    from athlete_twin.sensors.renderer import Renderer

    if not 1 <= options.leg <= 6:
        raise ConfigError(f"leg is {options.leg}, must be 1 to 6")
    spec = load_spec(options.robot)
    terrain = terrain_of(spec, options.scenario, options.seed)
    world_from_hex, joints = swinging_stance(Kinematics(spec), terrain, leg=options.leg - 1, sag=SAG)
    links = Posture(spec).link_poses(world_from_hex, joints, np.zeros(0))
    target = world_from_hex.translation * [1.0, 1.0, 0.52] + [0.15, 0.0, 0.0]
    eye = Pinhole.from_fov(1200, 675, np.deg2rad(46.0))
    world_from_camera = looking(
        stand_point(
            terrain, spec, target, distance=options.distance, elevation=np.deg2rad(options.elevation_deg)
        ),
        target,
    )
    picture = Renderer(terrain, visual_parts(spec)).render_view(world_from_camera, eye, links)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    for colours in (256, 192, 128, 96, 64):
        data = _palette_png(picture[..., ::-1], colours)
        if len(data) <= MOST_BYTES:
            break
    options.out.write_bytes(data)
    return len(data)


def swinging_stance(kin: Kinematics, terrain: Terrain, *, leg: int, sag: float) -> tuple[SE3, np.ndarray]:
    """Chassis and joints of a robot that stands on the terrain at the start and swings one leg ahead.

    Args:
        kin: of the robot.
        terrain: the true ground.
        leg: index of the leg in the air.
        sag: of the chassis below its height as drawn [m].
    """
    from athlete_twin.model.reach import all_legs_ik
    from athlete_twin.model.stance import stance_wheels_in_hex

    spec = kin.spec
    wheels = stance_wheels_in_hex(spec)
    heights = terrain.grid.sample(wheels[:, :2])
    datum = float(heights.mean())
    wheels[:, 2] += heights - datum + sag
    wheels[leg] += [0.22 * spec.foot_radius, 0.0, 0.9 * spec.wheel.radius * 2]
    joints, ok = all_legs_ik(spec, wheels)
    if not ok.all():
        # A raised leg may be out of reach for a tall robot: it stands, then.
        joints[leg] = all_legs_ik(spec, stance_wheels_in_hex(spec))[0][leg]
    return SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height + datum - sag])), joints


def _palette_png(rgb: np.ndarray, colours: int) -> bytes:
    """The picture as PNG with a palette of so many colours: a fifth of the size, and the eye sees no difference."""
    import io

    from PIL import Image

    out = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(rgb))
    image = image.quantize(colours, method=Image.Quantize.MEDIANCUT, kmeans=1, dither=Image.Dither.NONE)
    image.save(out, "PNG", optimize=True)
    return out.getvalue()


if __name__ == "__main__":
    sys.exit(main())
