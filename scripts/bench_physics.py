"""How fast the twin is, in multiples of real time, beside naive PyBullet and MuJoCo with the same robot on the same ground.

    python scripts/bench_physics.py [--robots sdm_b t12] [--json]

Ground: a scenario's rocks on 400 x 400 cells of 5 cm. All at 240 Hz, one after the other in one process. "Leg swing",
"body shift" and "held still" are the whole vehicle: physics, executive at 24 Hz, sensors, collision watch. "Physics
alone" is `Body.step` of the standing robot, which is what MuJoCo's figure is comparable with. A row's target is for the
ratio where it has a peer's figure or waits for one, and for our own figure where it has no peer by design.

Times are processor seconds (one thread): other jobs on the machine spoil them less than they spoil the wall clock.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace

import numpy as np
import tyro
from bench_table import Row, row, show
from mujoco_peer import mujoco_speed
from naive_pybullet import naive_speed

from athlete_twin.athlete import Athlete
from athlete_twin.errors import AthleteError, PhysicsError
from athlete_twin.messages import BodyMove, Command, CommandSequence, Fault, JointMove, LegMove
from athlete_twin.model.reach import leg_ik
from athlete_twin.model.spec import load_spec
from athlete_twin.world.bullet_world import TICK
from athlete_twin.world.scenario import Scenario, load_scenario

CELLS, CELL = 400, 0.05
"""the field: cells along each side, and their edge [m]"""
SWING_TARGET = 10.0
"""x real time while a leg swings"""
NAIVE_TARGET = 5.0
"""x naive PyBullet while moving"""
MUJOCO_TARGET = 0.5
"""x MuJoCo: an aim"""
CLOCK_TARGET = 1000.0
"""x real time while the robot holds still"""
SHIFT = 0.12
"""of the chassis, each way [m]"""
HELD = 3600.0
"""for the clock's rate [s]"""
STANDING = 5.0
"""for physics alone [s]"""
UNIT = "x real time"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measures and prints some rows a robot."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    scenario: str = "rock_field"
    json: bool = False
    """print one JSON object instead of the table"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        rows = [r for robot in options.robots for r in _rows(robot, _field(options.scenario))]
    except AthleteError as e:
        sys.stderr.write(f"bench_physics: {' '.join(str(e).split())}\n")
        return 2
    show(rows, as_json=options.json)
    return 0


def _field(scenario: str) -> Scenario:
    """The scenario on 400 x 400 cells round the start."""
    side = (CELLS - 1) * CELL
    return replace(load_scenario(scenario), size=(side, side), x_min=-0.5 * side, cell=CELL)


def _rows(robot: str, scenario: Scenario) -> list[Row]:
    spec = load_spec(robot)
    athlete = Athlete(spec, scenario, 0)
    try:
        shift, clock, alone = _shift(athlete), _held(athlete), _alone(athlete)
        swing = _swing(athlete)
    finally:
        athlete.close()
    ground = athlete.terrain.grid
    naive, mujoco = naive_speed(spec, ground), mujoco_speed(spec, ground)
    bullet = "naive PyBullet"
    return [
        _against(f"{robot} leg swing", swing, bullet, naive, NAIVE_TARGET),
        _against(f"{robot} body shift", shift, bullet, naive, NAIVE_TARGET),
        _against(f"{robot} held still", clock, bullet, naive, NAIVE_TARGET),
        _against(f"{robot} physics alone", alone, bullet, naive, NAIVE_TARGET),
        _against(f"{robot} physics alone", alone, "MuJoCo" if mujoco else "MuJoCo, not measured", mujoco, MUJOCO_TARGET),
        _by_itself(f"{robot} leg swing", swing, SWING_TARGET),
        _by_itself(f"{robot} held still", clock, CLOCK_TARGET),
    ]


def _against(name: str, ours: float, peer_name: str, peer: float | None, target: float) -> Row:
    """A row whose target is for our figure over the peer's."""
    against = f"{name} against {peer_name.split(',')[0]}"
    return row(against, ours, UNIT, target=f">= {target}", of="ratio", peer_name=peer_name, peer=peer)


def _by_itself(name: str, ours: float, target: float) -> Row:
    """A row whose target is for our figure."""
    return row(name, ours, UNIT, target=f">= {target}")


def _swing(athlete: Athlete) -> float:
    """Lifts leg 2, swings it forth and back, and times it."""
    spec, leg = athlete.spec, 1
    wheel = athlete.kin.leg_wheel(leg, athlete.executive.setpoint[leg]).translation
    up = wheel + np.array([0.0, 0.0, 1.5 * spec.wheel.radius])
    sides = [leg_ik(spec, leg, (up + np.array([dx, 0.0, 0.0]))[None])[0][0] for dx in (0.3, -0.3, 0.3, -0.3, 0.0)]
    _timed(athlete, LegMove(leg=leg, wheel_in_hex=up, guard="break_contact"))
    return _timed(athlete, JointMove(leg=leg, waypoints=np.array(sides)))


def _shift(athlete: Athlete) -> float:
    """Moves the chassis forth and back on six wheels, and times it."""
    shifts = [BodyMove(translation_in_hex=np.array([dx, 0.0, 0.0])) for dx in (SHIFT, -2.0 * SHIFT, SHIFT)]
    return _timed(athlete, *shifts)


def _held(athlete: Athlete) -> float:
    """Lets the robot come to rest, then times an hour in which nobody commands anything, asked for second by second."""
    while athlete.truth().moving:
        athlete.advance(athlete.t + 1.0)
    until, before, start = athlete.t + HELD, athlete.t, time.process_time()
    while athlete.t < until - 1e-9:
        athlete.advance(athlete.t + 1.0)
    return (athlete.t - before) / (time.process_time() - start)


def _alone(athlete: Athlete) -> float:
    """Times the ticks of the standing body, with nothing around them."""
    body, commands = athlete.body, athlete.body.motors
    limits = np.full(commands.shape, athlete.spec.speed_loaded)
    ticks = round(STANDING / TICK)
    start = time.process_time()
    for _ in range(ticks):
        body.step(commands, limits)
    return ticks * TICK / (time.process_time() - start)


def _timed(athlete: Athlete, *commands: Command) -> float:
    """Multiple of real time at which the robot carries out a sequence."""
    number = athlete.executive.newest_seq + 1
    sequence = CommandSequence(seq=number, robot_id=athlete.robot_id, t=athlete.t, sequence_id=number, commands=commands)
    start, before = time.process_time(), athlete.t
    made = athlete.receive(sequence)
    while athlete.busy:
        made += athlete.advance(athlete.t + 5.0)
    faults = [m.text for m in made if isinstance(m, Fault)]
    if faults:
        raise PhysicsError(f"the benchmark's motion of {athlete.robot_id} failed: {faults[0]}")
    return (athlete.t - before) / (time.process_time() - start)


if __name__ == "__main__":
    sys.exit(main())
