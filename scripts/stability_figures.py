"""How fast and how true the stability map is: seconds for all six legs, and its reach against brute-force inverse kinematics."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from bench_table import Row, row
from stability_oracle import PATIENT_STARTS, STARTS, reaches
from stability_scene import SIZES, StabilityScene, stability_scene

from athlete_twin.geometry.arrays import Joints, PerLegFlag, Vec3
from athlete_twin.model.kinematics import GRAVITY, Kinematics
from athlete_twin.model.load_bearing import load_bearing
from athlete_twin.model.load_family import least_torque_loads
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.statics import peak_torque_fraction
from planner.stability.ground_map import LAST_LINK, UNKNOWN, UNREACHABLE, GroundMap, ground_maps

QUICK, WHOLE, FALSE, MISSED, TORQUE = "<= 1.0", "<= 3.0", "<= 0.005", "<= 0.03", "<= 1.0"
"""targets: seconds without and with collisions, shares of cells, peak torque over the joints' limits"""
ROLL_DEG, PITCH_DEG = 4.0, 3.0
"""of the tilted chassis: 5 deg in all [deg]"""
RUNS = 3
AREA_CELL = 0.05
"""of the load-bearing workspace's area [m]"""
LEANS_DEG = np.arange(-90.0, 91.0, 5.0)
"""of a last link that bears no load [deg]"""
REACH_NAME = "reaches, last link at any lean"
FRICTION = 0.5
"""between wheel and ground, as robot facts 11 gives it for sand on a hard base"""
PEER_NAME = "brute force, all cells at its mean time a cell"
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Verdicts:
    """What the maps and brute force say of the same n cells, each array of shape (n,)."""

    ours: np.ndarray
    """the map calls it within reach"""
    plumb: np.ndarray
    """brute force puts the wheel there and above it with the last link plumb"""
    leaning: np.ndarray
    """the same, or off plumb by no more than the chassis' tilt; only asked where the map claims reach"""
    again: np.ndarray
    """plumb, and the first search denied it"""
    seconds: float
    """that the first searches took"""


def rows(*, robots: tuple[str, ...], cells: int, seed: int = 0) -> list[Row]:
    """Times and truth of the map, robot by robot.

    Args:
        robots: by name.
        cells: how many near a leg, drawn at random, the brute force is asked about.
        seed: of the rock field and of the draw.
    """
    return [one for robot in robots for one in _rows(robot, cells, seed)]


def _rows(robot: str, cells: int, seed: int) -> list[Row]:
    scene = stability_scene(robot, seed)
    size, cell = SIZES[robot]
    name = f"{robot}: stability map of {size:g} x {size:g} m at {100 * cell:g} cm, six legs"
    quick, maps = _seconds(scene, collision=False)
    whole, judged = _seconds(scene, collision=True)
    level = against_oracle(scene, maps, cells=cells, seed=seed)
    both = level.seconds / cells * LEGS * scene.terrain.heights.size
    share = {name: sum(m.counts()[name] for m in judged) / sum(m.reason.size for m in judged) for name in judged[0].counts()}
    return [
        row(f"{name}, without collisions", quick, "s", target=QUICK, peer_name=PEER_NAME, peer=both),
        row(f"{name}, with collisions", whole, "s", target=WHOLE),
        *_truth_rows(robot, level, "last link plumb"),
        *_tilted_rows(robot, cells, seed),
        *(row(f"{robot}: share of cells, {reason}", value, "share") for reason, value in share.items()),
        *_load_rows(robot, scene),
    ]


def _tilted_rows(robot: str, cells: int, seed: int) -> list[Row]:
    """The same of a chassis that is rolled and pitched, where a last link leans out of its leg's plane by up to the tilt."""
    scene = stability_scene(robot, seed, roll_deg=ROLL_DEG, pitch_deg=PITCH_DEG)
    maps = ground_maps(
        scene.kinematics, scene.joints, terrain=scene.terrain, world_from_hex=scene.world_from_hex,
        config=scene.config(collision=False), footfalls=scene.footfalls,
    )  # fmt: skip
    tilt = scene.tilt_deg
    name = f"{robot}, chassis rolled {ROLL_DEG:g} and pitched {PITCH_DEG:g} deg"
    return _truth_rows(name, against_oracle(scene, maps, cells=cells, seed=seed), f"last link within {tilt:.1f} deg of plumb")


def _truth_rows(name: str, found: Verdicts, allowed: str) -> list[Row]:
    ours, starts = found.ours, f"{1 + STARTS} starts of the brute force deny and {1 + PATIENT_STARTS} find"
    wrong = _share(ours & ~found.leaning, ours)
    missed = _share(found.plumb & ~ours, found.plumb)
    return [
        row(f"{name}: cells called reachable that brute force does not reach, {allowed}", wrong, "share", target=FALSE),
        row(f"{name}: cells that brute force reaches, last link plumb, and are called out of reach", missed, "share", target=MISSED),
        row(f"{name}: cells that {starts}, called reachable", float(found.again[ours].sum()), f"of {len(ours)}"),
        row(f"{name}: cells that {starts}, called out of reach", float(found.again[~ours].sum()), f"of {len(ours)}"),
    ]


def _load_rows(robot: str, scene: StabilityScene) -> list[Row]:
    """Where a leg can carry beside where it can reach, on level ground; and what the null space of forces is worth."""
    kin, spec = scene.kinematics, scene.kinematics.spec
    farthest = _farthest(scene) + float(np.linalg.norm(spec.wheel.offset))  # the last link may lean outward
    side = np.arange(-farthest, farthest, AREA_CELL)
    flat = np.stack([*np.meshgrid(side, side, indexing="ij"), np.full((len(side),) * 2, spec.wheel.radius - spec.chassis_height)], -1)
    places = flat.reshape(-1, 3) + [*spec.hips_in_hex[0, :2], 0.0]
    able = load_bearing(spec, 0, places, load=spec.mass * GRAVITY / 3.0)
    reach = AREA_CELL**2 * float(_reaches_leaning(spec, 0, places).sum())
    return [
        row(
            f"{robot}: ground that a leg reaches with a plumb last link, level stance", AREA_CELL**2 * float(able.reaches.sum()), "m2",
            peer_name=REACH_NAME, peer=reach,
        ),
        row(
            f"{robot}: ground on which a leg can carry a third of the weight, level stance", AREA_CELL**2 * float(able.carries.sum()),
            "m2", peer_name=REACH_NAME, peer=reach,
        ),
        _best_forces(robot, kin, scene.joints, np.arange(LEGS) != 0, "leg 1 up"),
    ]  # fmt: skip


def _best_forces(robot: str, kin: Kinematics, joints: Joints, standing: PerLegFlag, stance: str) -> Row:
    """Peak torque of a stance with the best forces of the ground; a no with its reason where none hold it."""
    best = least_torque_loads(kin, joints, supporting=standing, friction=FRICTION)
    return row(
        f"{robot}: peak joint torque with {stance}, best forces at friction {FRICTION}", best.peak_torque_fraction, "of the limit",
        target=TORQUE, peer_name="zero interaction", peer=peak_torque_fraction(kin, joints, supporting=standing), no=best.reason,
    )  # fmt: skip


def _reaches_leaning(spec: RobotSpec, leg: int, axles: np.ndarray) -> np.ndarray:
    """Whether a leg on a level chassis puts its axle at each place with its last link at any lean in its plane, shape (n,)."""
    outward = (axles - spec.hips_in_hex[leg]) * [1.0, 1.0, 0.0]
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    reached = np.zeros(len(axles), dtype=bool)
    for lean in np.deg2rad(LEANS_DEG):
        left = np.flatnonzero(~reached)
        directions = np.sin(lean) * outward[left] - np.cos(lean) * UP
        reached[left] = leg_ik(spec, leg, axles[left], last_link_in_hex=directions)[1]
    return reached


def _seconds(scene: StabilityScene, *, collision: bool) -> tuple[float, tuple[GroundMap, ...]]:
    """The best of some runs: other jobs on the machine only add; the first one compiles and is left out."""
    best = np.inf
    maps: tuple[GroundMap, ...] = ()
    for run in range(1 + RUNS):
        start = time.perf_counter()
        maps = ground_maps(
            scene.kinematics, scene.joints, terrain=scene.terrain, world_from_hex=scene.world_from_hex,
            config=scene.config(collision=collision), footfalls=scene.footfalls,
        )  # fmt: skip
        best = min(best, time.perf_counter() - start) if run else np.inf
    return best, maps


def against_oracle(scene: StabilityScene, maps: tuple[GroundMap, ...], *, cells: int, seed: int) -> Verdicts:
    """What the maps and brute force say of cells drawn near the legs.

    Brute force is asked for a plumb last link; a cell that it denies is searched again from more starts, whatever the map says.
    Where the chassis is tilted and the map claims reach, it is asked once more, for a last link off plumb by no more than the tilt.
    """
    draw, rng = (np.random.default_rng([seed, stream]) for stream in (17, 18))
    kin, lift = scene.kinematics, scene.config(collision=False).lift
    spec, hex_from_world = kin.spec, scene.world_from_hex.inverse()
    down = hex_from_world.rotate(-UP)
    x, y = scene.terrain.centres()
    said: list[tuple[bool, bool, bool, bool]] = []
    seconds = 0.0
    while len(said) < cells:
        leg, ix, iy = int(draw.integers(LEGS)), int(draw.integers(len(x))), int(draw.integers(len(y)))
        ground = np.array([x[ix], y[iy], scene.terrain.heights[ix, iy]])
        hip = scene.world_from_hex.apply(spec.hips_in_hex[leg])
        if np.hypot(*(ground - hip)[:2]) > _farthest(scene):
            continue
        wheels = [hex_from_world.apply(ground + (spec.wheel.radius + up) * UP) for up in (0.0, lift)]

        def search(starts: int, lean_deg: float, leg: int = leg, wheels: list[Vec3] = wheels) -> bool:
            return all(reaches(kin, leg, wheel, down, rng=rng, starts=starts, lean_deg=lean_deg) for wheel in wheels)

        start = time.perf_counter()
        first = search(STARTS, 0.0)
        seconds += time.perf_counter() - start
        plumb = first or search(PATIENT_STARTS, 0.0)
        ours = int(maps[leg].reason[ix, iy]) not in (UNKNOWN, UNREACHABLE, LAST_LINK)
        leaning = plumb or (ours and scene.tilt_deg > 0.0 and search(PATIENT_STARTS, scene.tilt_deg))
        said.append((ours, plumb, leaning, plumb and not first))
    ours_of, plumb_of, leaning_of, again_of = np.array(said).T
    return Verdicts(ours=ours_of, plumb=plumb_of, leaning=leaning_of, again=again_of, seconds=seconds)


def _farthest(scene: StabilityScene) -> float:
    """Horizontal distance from a hip beyond which no stretched leg with a plumb last link puts a wheel [m]."""
    spec = scene.kinematics.spec
    return sum(float(np.linalg.norm(joint.offset)) for joint in spec.joints)


def _share(part: np.ndarray, whole: np.ndarray) -> float:
    return float(part.sum() / max(whole.sum(), 1))
