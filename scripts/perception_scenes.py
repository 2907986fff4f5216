"""Seeded scenes that perception is measured on: a robot among rocks, pairs of its cameras, the truth of each pixel beside.

The ground is `rock_field` with rocks added beside some wheels. The robot stands there by its own physics and sags; in odd
scenes one leg, which the first camera looks at, is raised. The picture's camera sits 3 cm and 1 deg from where the drawings
have it, in a direction drawn for each scene and camera; encoders and tyres deviate as in any trial.

Everything drawn is keyed by seed and name, so a scene is the same whoever asks for it, and in whatever order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from athlete_twin.athlete import Athlete
from athlete_twin.errors import ConfigError, PhysicsError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import CommandSequence, Fault, LegMove, StereoPair, Telemetry
from athlete_twin.model.appearance import leg_of, visual_parts
from athlete_twin.model.camera import Pinhole, StereoCamera
from athlete_twin.model.spec import RobotSpec, load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.sensors.renderer import PlacedRobot, Renderer
from athlete_twin.sensors.shading import Surface
from athlete_twin.sensors.stereo_camera import EYES, develop, metered_exposure, noise_generator
from athlete_twin.world.scenario import Rock, load_scenario
from athlete_twin.world.terrain import Terrain, build_terrain, generator
from planner.belief import Belief, BeliefFilter
from planner.perception.localise import WheelFitConfig
from planner.sag.sag_model import FootSprings

SUNS_DEG = (15.0, 35.0, 70.0)
POSE_ERROR, ANGLE_ERROR = 0.03, np.deg2rad(1.0)
"""of the camera that the ground believes in [m, rad]"""
ROCK_BESIDE = 0.6
"""share of the wheels that have a rock beside them"""
ROCK_GAP = (0.02, 0.08)
"""from the ground under the wheel that is kept clear to the rock's rim [m]"""
ROCK_SIZE = (0.18, 0.45)
"""its diameter [m]"""
CLEAR = 0.9
"""of the ground under a wheel that no rock reaches into, over its radius"""
LIFT = 1.6
"""by which a leg is raised, over the wheel's radius"""
NAVCAM_EVERY = 4
"""scenes of which one has a NavCam's picture too"""
BRACKET = 4.0
"""factor between neighbouring exposures of a bracket of three"""
CONDITIONS = ("sun", "soft", "saturated")
"""of light: the sun at its elevation, an overcast sky, exposed four times too long"""
TOO_LONG = 4.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A robot that stands somewhere, and what the ground believes of it."""

    spec: RobotSpec
    seed: int
    terrain: Terrain
    raised: int | None
    """index of the leg in the air"""
    cameras: tuple[StereoCamera, ...]
    """as the ground believes them: the first is aimed at the leg across the body, the others are as drawn"""
    world_from_link: dict[str, SE3]
    """true"""
    world_from_hex: SE3
    """true"""
    wheels_in_world: np.ndarray
    """true axle centres, shape (6, 3) [m]"""
    telemetry: Telemetry
    belief: Belief
    hex_from_link: dict[str, SE3]
    """believed"""

    def up_in_hex(self) -> np.ndarray:
        """Believed direction against gravity."""
        return np.asarray(self.belief.world_from_hex.inverse().rotate(np.array([0.0, 0.0, 1.0])))

    def ground_in_hex(self) -> np.ndarray:
        """Believed contacts of the planted wheels, shape (n, 3) [m]."""
        belief = self.belief
        return np.asarray(belief.world_from_hex.inverse().apply(belief.contacts_in_world[belief.planted]))


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneView:
    """One pair of a scene: what went down the link, and what its left image truly shows."""

    scene: Scene
    camera: StereoCamera
    """as drawn"""
    sun_deg: float
    condition: str
    brackets: bool
    pair: StereoPair
    label: np.ndarray
    """0 sky, 1 ground, 2 rock, 3 robot, shape (h, w), uint8"""
    leg: np.ndarray
    """index of the leg a pixel shows, -1 elsewhere, shape (h, w), int8"""
    rock: np.ndarray
    """index into the terrain's rocks, -1 elsewhere, shape (h, w), int32"""
    depth: np.ndarray
    """along the boresight, NaN for sky [m]"""
    points_in_world: np.ndarray
    """shape (h, w, 3) [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """What the two eyes of a pair see before any exposure, and the truth of the left one."""

    camera: StereoCamera
    eye: Pinhole
    radiance: tuple[np.ndarray, np.ndarray]
    label: np.ndarray
    leg: np.ndarray
    rock: np.ndarray
    depth: np.ndarray
    points_in_world: np.ndarray


class Overcast(Renderer):
    """The same ground under a sky without sun."""

    def _lit(self, s: Surface, robot: PlacedRobot, sun: np.ndarray) -> np.ndarray:  # noqa: ARG002
        return np.zeros(len(s.toward), dtype=np.float32)


def stand(robot: str, seed: int) -> Scene:
    """Scene `seed` of a robot: six wheels down if it is even, one leg raised if it is odd."""
    if seed < 0:
        raise ConfigError(f"scene {seed} does not exist, they count from 0")
    spec = load_spec(robot)
    wheels = stance_wheels_in_hex(spec)
    scenario = replace(load_scenario("rock_field"), placed_rocks=_rocks_beside(spec, wheels, seed))
    terrain = build_terrain(scenario, seed, clear_xy=wheels[:, :2], clear_radius=CLEAR * spec.wheel.radius)
    cameras = _cameras(spec, seed)
    raised = _leg_before(spec, cameras[0]) if seed % 2 else None
    athlete = Athlete(spec, scenario, seed, terrain=terrain)
    try:
        telemetry = _last_telemetry(athlete)
        beliefs = BeliefFilter(athlete.kin, FootSprings.from_spec(spec), payload_kg=0.0, config=WheelFitConfig())
        belief = beliefs.update(telemetry)
        if raised is not None:
            telemetry = _raise(athlete, raised)
            beliefs.lift(raised)
            belief = beliefs.update(telemetry)
        return Scene(
            spec=spec, seed=seed, terrain=terrain, raised=raised, cameras=cameras,
            world_from_link=athlete.link_poses(), world_from_hex=athlete.truth().world_from_hex,
            wheels_in_world=athlete.truth().wheels_in_world.copy(), telemetry=telemetry, belief=belief,
            hex_from_link=athlete.kin.link_poses(telemetry.joints),
        )  # fmt: skip
    finally:
        athlete.close()


def look(scene: Scene, sun_deg: float, condition: str = "sun", *, binning: int = 1) -> Iterator[Seen]:
    """What each of the scene's cameras sees under a sun `sun_deg` above the horizon, or under none."""
    if condition not in CONDITIONS:
        raise ConfigError(f"condition {condition!r} is not one of {', '.join(CONDITIONS)}")
    azimuth = float(generator(scene.seed, "scene_sun").uniform(0.0, 2.0 * np.pi))
    e = np.deg2rad(sun_deg)
    sun = np.array([np.cos(e) * np.cos(azimuth), np.cos(e) * np.sin(azimuth), np.sin(e)])
    parts = visual_parts(scene.spec)
    kind = Overcast if condition == "soft" else Renderer
    renderer = kind(scene.terrain, parts, sun_in_world=sun)
    robot = renderer.place(scene.world_from_link)
    leg_of_part = np.array([leg_of(p.link) for p in parts], dtype=np.int8)
    for camera in scene.cameras:
        eye = camera.eye.binned(binning) if binning > 1 else camera.eye
        world_from_left = scene.world_from_hex.compose(camera.hex_from_camera).compose(pose_error(scene.seed, camera.name))
        world_from_right = world_from_left.compose(SE3.from_translation(np.array([camera.baseline, 0.0, 0.0])))
        left, right = (renderer.render(pose, eye, robot) for pose in (world_from_left, world_from_right))
        points = world_from_left.apply((eye.rays() * left.depth[..., None]).reshape(-1, 3)).reshape(*left.depth.shape, 3)
        yield Seen(
            camera=camera, eye=eye, radiance=(left.image, right.image), label=left.label,
            leg=_legs(world_from_left, eye, robot, left.label, leg_of_part), rock=_rocks(scene.terrain, points, left.label),
            depth=left.depth, points_in_world=points,
        )  # fmt: skip


def taken(scene: Scene, seen: Seen, *, sun_deg: float, condition: str = "sun", brackets: bool = False, binning: int = 1) -> SceneView:
    """The pair as it comes down: one metered exposure of 8 bits, or three of them merged."""
    metered = metered_exposure(seen.radiance[0]) * (TOO_LONG if condition == "saturated" else 1.0)
    exposures = [metered / BRACKET, metered, metered * BRACKET] if brackets else [metered]
    images = []
    for side, radiance in zip(EYES, seen.radiance, strict=True):
        shots = [
            develop(radiance, s, binning=binning, rng=noise_generator(scene.seed, seen.camera.name, k, eye=side))
            for k, s in enumerate(exposures)
        ]
        images.append(merged(shots, exposures) if brackets else shots[0])
    pair = StereoPair(
        seq=0, robot_id=scene.spec.name, t=scene.telemetry.t, camera=seen.camera.name, binning=binning,
        left=images[0], right=images[1], exposure=metered, state=scene.telemetry,
    )  # fmt: skip
    return SceneView(
        scene=scene, camera=seen.camera, sun_deg=sun_deg, condition=condition, brackets=brackets, pair=pair, label=seen.label,
        leg=seen.leg, rock=seen.rock, depth=seen.depth, points_in_world=seen.points_in_world,
    )  # fmt: skip


def merged(shots: Sequence[np.ndarray], exposures: Sequence[float]) -> np.ndarray:
    """One 8-bit image out of a bracket: per pixel the unsaturated exposures' mean light, its square root scaled to grey.

    The square root gives shadows their texture back and makes photon noise even. The scale is that of the exposures, not
    of the picture, so that both eyes get the same.
    """
    light, weight = np.zeros(shots[0].shape), np.zeros(shots[0].shape)
    order = np.argsort(exposures)
    for rank, k in enumerate(order):
        grey = shots[k].astype(float)
        # The shortest exposure has the last word where all others are white.
        trust = np.where((grey < 250.0) | (rank == 0), exposures[k], 0.0)
        light += trust * grey / exposures[k]
        weight += trust
    bright = light / weight * min(exposures) / 255.0
    return np.asarray(np.clip(np.rint(255.0 * np.sqrt(np.clip(bright, 0.0, 1.0))), 0, 255).astype(np.uint8))


def pose_error(seed: int, camera: str) -> SE3:
    """`drawn_camera_from_true_camera`: 3 cm and 1 deg in a direction drawn for this scene and camera."""
    rng = generator(seed, f"scene_{camera}")
    shift, turn = rng.standard_normal(3), rng.standard_normal(3)
    return SE3.from_rotvec(ANGLE_ERROR * turn / np.linalg.norm(turn), POSE_ERROR * shift / np.linalg.norm(shift))


def _rocks_beside(spec: RobotSpec, wheels: np.ndarray, seed: int) -> tuple[Rock, ...]:
    rng = generator(seed, "scene_rocks")
    out = []
    for wheel in wheels:
        has, azimuth = rng.uniform() < ROCK_BESIDE, rng.uniform(0.0, 2.0 * np.pi)
        gap, size, flat = rng.uniform(*ROCK_GAP), rng.uniform(*ROCK_SIZE), rng.uniform(0.45, 0.6)
        away = CLEAR * spec.wheel.radius + gap + 0.5 * size
        if has:
            x, y = wheel[:2] + away * np.array([np.cos(azimuth), np.sin(azimuth)])
            out.append(Rock(x=float(x), y=float(y), diameter=float(size), height=float(flat * size)))
    return tuple(out)


def _cameras(spec: RobotSpec, seed: int) -> tuple[StereoCamera, ...]:
    """A HazCam aimed at a leg, the next HazCam as drawn, in every fourth scene a NavCam as drawn."""
    haz, nav = ([c for c in spec.cameras if c.group == g] for g in ("hazcam", "navcam"))
    chosen = [_aimed(spec, haz[seed % len(haz)]), haz[(seed + 1) % len(haz)]]
    if seed % NAVCAM_EVERY == 0:
        chosen.append(nav[seed // NAVCAM_EVERY % len(nav)])
    return tuple(chosen)


def _aimed(spec: RobotSpec, camera: StereoCamera) -> StereoCamera:
    """The camera turned about its row until the axle of the leg across the body lies on the middle row.

    As drawn, SDM-B's HazCams look under their legs: 0.3 to 1.2 % of the picture are leg. The robot of 2008 saw its legs fill
    the view ([SunSpiral2012] fig. 8), and what cannot be seen tests no mask.
    """
    wheel = camera.hex_from_camera.inverse().apply(stance_wheels_in_hex(spec))[_leg_before(spec, camera)]
    turn = SE3.from_rotvec(np.array([-np.arctan2(wheel[1], wheel[2]), 0.0, 0.0]))
    return replace(camera, link_from_camera=camera.link_from_camera.compose(turn))


def _leg_before(spec: RobotSpec, camera: StereoCamera) -> int:
    """The leg that stands nearest to the camera's line of sight."""
    wheels = camera.hex_from_camera.inverse().apply(stance_wheels_in_hex(spec))
    off = np.where(wheels[:, 2] > 0.0, np.abs(wheels[:, 0]) / np.maximum(wheels[:, 2], 1e-6), np.inf)
    return int(np.argmin(off))


def _raise(athlete: Athlete, leg: int) -> Telemetry:
    spec = athlete.spec
    wheel = athlete.kin.leg_wheel(leg, athlete.executive.setpoint[leg]).translation
    low, high = (wheel + np.array([0.0, 0.0, k * spec.wheel.radius]) for k in (0.8, LIFT))
    number = athlete.executive.newest_seq + 1
    sequence = CommandSequence(
        seq=number, robot_id=athlete.robot_id, t=athlete.t, sequence_id=number,
        commands=(LegMove(leg=leg, wheel_in_hex=low, guard="break_contact"), LegMove(leg=leg, wheel_in_hex=high)),
    )  # fmt: skip
    made = athlete.receive(sequence)
    while athlete.busy or athlete.truth().moving:
        made += athlete.advance(athlete.t + 5.0)
    faults = [m.text for m in made if isinstance(m, Fault)]
    if faults:
        raise PhysicsError(f"{spec.name} could not raise leg {leg + 1} in scene {athlete.seed}: {faults[0]}")
    return next(m for m in reversed(made) if isinstance(m, Telemetry))


def _last_telemetry(athlete: Athlete) -> Telemetry:
    made = athlete.advance(athlete.t + 0.1)
    return next(m for m in reversed(made) if isinstance(m, Telemetry))


def _legs(world_from_left: SE3, eye: Pinhole, robot: PlacedRobot, label: np.ndarray, leg_of_part: np.ndarray) -> np.ndarray:
    from athlete_twin.geometry.open3d_loader import open3d

    rows, columns = np.nonzero(label == 3)
    directions = world_from_left.rotate(eye.rays()[rows, columns])
    # The renderer's rays start 3 cm before the lens.
    origin = world_from_left.translation + 0.03 * directions
    rays = np.concatenate([origin, directions], axis=1).astype(np.float32)
    triangles = robot.scene.cast_rays(open3d().core.Tensor(rays))["primitive_ids"].numpy()
    out = np.full(label.shape, -1, dtype=np.int8)
    hit = triangles < len(robot.part_of_triangle)
    out[rows[hit], columns[hit]] = leg_of_part[robot.part_of_triangle[triangles[hit]]]
    return out


def _rocks(terrain: Terrain, points: np.ndarray, label: np.ndarray) -> np.ndarray:
    out = np.full(label.shape, -1, dtype=np.int32)
    at = label == 2
    ix, iy, inside = terrain.grid.index(points[at][:, :2])
    out[at] = np.where(inside, terrain.rock_index[ix, iy], -1)
    return out

