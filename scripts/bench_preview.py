"""How well a preview foretells what a sequence does, which faults it finds, and what it costs.

    python scripts/bench_preview.py [--robots sdm_b t12] [--motions 16] [--faults 200] [--json]

Positions: the twin walks in a rock field, without delay, its ground approving everything. The axles of all six wheels are compared
with the preview at each half second of each motion, counted from when the robot has the sequence: from the chassis as it truly
stood at the begin, in the world as the ground believes it (its localisation included), and in how far they move (what was wrong
about each axle at the begin left out: the preview's own error). The moving wheel is where the timing counts.

False alarms: sequences that the twin, or the mock walking in other directions on flat ground, carried out without a fault.

Faults: such sequences with a fault put in (`preview_faults`), each confirmed by something other than the preview. Found is a fault
that the preview names by its code.

Seconds are by the wall clock, one thread.
"""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass

import numpy as np
import tyro
from bench_table import Row, row, show
from preview_faults import KINDS, FaultSeeder
from preview_walk import Foreseen, Walk
from rich.console import Console
from rich.progress import Progress

from athlete_twin.errors import AthleteError, ConfigError

FAULT_STREAM = 7101
MOCK_BEARINGS = (0.0, 60.0, 135.0, -90.0)
"""of the goals of the mock's walks [deg]"""
PRECISE, FALSE, SECONDS = "<= 0.03", "< 1", "<= 1"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Walks, compares and prints some rows a robot."""

    robots: tuple[str, ...] = ("sdm_b", "t12")
    scenario: str = "rock_field"
    motions: int = 16
    """of the twin"""
    mock_motions: int = 100
    """of the mock, at most, over all its walks"""
    faults: int = 200
    """over all robots"""
    seed: int = 0
    json: bool = False
    """print one JSON object instead of the table"""

    def __post_init__(self) -> None:
        if min(self.motions, self.faults) < 1 or self.mock_motions < 0:
            given = f"motions {self.motions}, faults {self.faults}, mock_motions {self.mock_motions}"
            raise ConfigError(f"{given}: the first two must be 1 or more, the last 0 or more")


def rows_of(robot: str, options: Options, faults: int, progress: Progress) -> list[Row]:
    """The rows of one robot."""
    walk = Walk(robot, options.scenario, seed=options.seed)
    task = progress.add_task(f"{robot} walks", total=options.motions)
    walked = []
    for motion in walk.motions(most=options.motions):
        walked.append(motion)
        progress.advance(task)
    out = _positions(robot, walked, walk.datum)
    sound = [motion for motion in walked if not motion.faults]
    task = progress.add_task(f"{robot} walks as a mock", total=options.mock_motions)
    for bearing in MOCK_BEARINGS:
        left = options.mock_motions - (len(sound) - len([m for m in walked if not m.faults]))
        mock = Walk(robot, options.scenario, seed=options.seed, variant="blind", body="mock", bearing_deg=bearing)
        for motion in mock.motions(most=max(left, 0)):
            if not motion.faults:
                sound.append(motion)
            progress.advance(task)
    alarmed = [motion for motion in sound if motion.preview.faults]
    for motion in alarmed:
        print(f"{robot}, {motion.proposal.text}: {motion.preview.faults[0]}", file=sys.stderr)
    out.append(row(f"{robot}: false alarms in {len(sound)} sound sequences", 100.0 * len(alarmed) / len(sound), "%", target=FALSE))
    out += _found(robot, walk, sound, faults, options.seed, progress)
    seconds = [motion.seconds for motion in walked + sound[len(walked) :]]
    out.append(row(f"{robot}: a preview, median", float(np.median(seconds)), "s"))
    out.append(row(f"{robot}: a preview, longest", max(seconds), "s", target=SECONDS))
    return out


def _positions(robot: str, walked: list[Foreseen], datum: float) -> list[Row]:
    from_there = np.concatenate([motion.errors("chassis") for motion in walked])
    in_world = np.concatenate([motion.errors("world", datum=datum) for motion in walked])
    moved = np.concatenate([motion.errors("motion") for motion in walked])
    own = np.concatenate([motion.errors("chassis")[:, motion.proposal.leg] for motion in walked if motion.proposal.leg >= 0])
    ends = np.concatenate([motion.errors("chassis")[-1] for motion in walked if motion.times])

    def p95(errors: np.ndarray) -> float:
        return float(np.percentile(errors, 95))

    n = len(walked)
    return [
        row(f"{robot}: wheels, 95th percentile over {n} motions, from the true chassis", p95(from_there), "m", target=PRECISE),
        row(f"{robot}: the same in the believed world", p95(in_world), "m", target=PRECISE),
        row(f"{robot}: the same, how far they move", p95(moved), "m", target=PRECISE),
        row(f"{robot}: the moving wheel, 95th percentile", p95(own), "m"),
        row(f"{robot}: all wheels at the ends of motions, 95th percentile", p95(ends), "m"),
    ]


def _found(robot: str, walk: Walk, sound: list[Foreseen], faults: int, seed: int, progress: Progress) -> list[Row]:
    """Shares of faults put in that the preview names."""
    rng = np.random.default_rng([seed, FAULT_STREAM])
    seeder = FaultSeeder(walk.agent.kin, rng)
    task = progress.add_task(f"{robot}: faults", total=faults)
    put, found = Counter[str](), Counter[str]()
    tries = 0
    while sum(put.values()) < faults and tries < 50 * faults:
        tries += 1
        kind = KINDS[sum(put.values()) % len(KINDS)]
        motion = sound[int(rng.integers(len(sound)))]
        spoilt = seeder.seeded(kind, motion.belief, motion.proposal.sequence)
        if spoilt is None:
            continue
        put[kind] += 1
        progress.advance(task)
        preview = walk.agent.preview(spoilt.sequence, motion.belief, motion.proposal.terrain)
        codes = [fault.code for fault in preview.faults]
        found[kind] += kind in codes
        if kind not in codes:
            print(f"{robot}: {kind} ({spoilt.proof}) not found, only {codes}", file=sys.stderr)
    seeder.close()
    return [row(f"{robot}: {kind} found, of {put[kind]}", float(found[kind]), "faults", target=f">= {put[kind]}") for kind in KINDS]


def main(arguments: list[str] | None = None) -> int:
    """Command line entry."""
    try:
        options = tyro.cli(Options, args=arguments, description=__doc__)
        rows: list[Row] = []
        with Progress(console=Console(stderr=True), transient=True) as progress:
            for number, robot in enumerate(options.robots):
                share = options.faults // len(options.robots) + (number < options.faults % len(options.robots))
                rows += rows_of(robot, options, share, progress)
    except AthleteError as e:
        print(f"error: {e}", file=sys.stderr)
        return 2
    show(rows, as_json=options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
