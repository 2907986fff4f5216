"""A trial's folder as arrays, for report and film: `trial.json` and `trial.mcap`, and nothing else.

Heights differ by a constant between the two sides: the ground puts z = 0 at the mean height of the first six contacts.
`datum` is the true height of that place; what is believed is lifted by it wherever the two are compared.
"""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from athlete_twin.errors import AthleteError, RecordingError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec, load_spec
from athlete_twin.model.stance import stance_wheels_in_hex
from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import Terrain, build_terrain
from envs.recording import Recorded, read_recording
from envs.schemas import Json, grid_from_message, joint_angles

BINS = ("motion", "link", "ground", "operator")
"""parts of the mission time, in the order they are drawn"""
NAMING = ("robot", "scenario", "variant", "seed", "link", "outcome", "progress_m", "steps_taken")
"""of trial.json, what names a trial in a picture"""


@dataclass(frozen=True, eq=False, kw_only=True)
class States:
    """Samples of the truth."""

    t: np.ndarray
    """shape (n,) [s]"""
    loads: np.ndarray
    """of the wheels, shape (n, 6) [N]"""
    torque_fraction: np.ndarray
    """largest joint torque over its limit at that moment, shape (n,)"""
    peak_torque_fraction: np.ndarray
    """largest so far, low-passed at 0.1 s, shape (n,)"""
    wheels_in_world: np.ndarray
    """axles, shape (n, 6, 3) [m]"""
    support_margin: np.ndarray
    cps_margin: np.ndarray
    tip_over_energy: np.ndarray
    phases: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """The true motion."""

    t: np.ndarray
    world_from_hex: tuple[SE3, ...]
    joints: np.ndarray
    """shape (n, 6, dof) [rad]"""
    docks: np.ndarray
    """in the order of the URDF, shape (n, 0) where the robot has none [rad]"""

    @property
    def places(self) -> np.ndarray:
        """Of the chassis, shape (n, 3) [m]."""
        return np.array([p.translation for p in self.world_from_hex]).reshape(-1, 3)


@dataclass(frozen=True, eq=False, kw_only=True)
class Shown:
    """A proposal with its answer."""

    index: int
    t: float
    kind: str
    leg: int
    footfall: np.ndarray
    """believed, in world [m]"""
    together: tuple[tuple[int, np.ndarray], ...]
    """other legs that step with it, and their footfalls"""
    text: str
    margin: float | None
    sag: float | None
    world_from_hex: SE3
    """believed chassis then"""
    decision: str
    """kind of the answer, "" when none was given"""
    decided: float
    """when [s], NaN when never"""

    @property
    def footfalls(self) -> tuple[tuple[int, np.ndarray], ...]:
        """All legs that step, and where."""
        return ((self.leg, self.footfall), *self.together)


@dataclass(frozen=True, eq=False, kw_only=True)
class Footfall:
    """One step of the truth, numbered as the proposals that were approved."""

    number: int
    leg: int
    t: float
    """of the touch-down [s]"""
    contact: np.ndarray
    """below the axle, in world [m]"""


@dataclass(frozen=True, eq=False, kw_only=True)
class BelievedMap:
    """All that the operator was shown of the terrain, the newest on top."""

    grid: HeightGrid
    """NaN where never seen"""
    allowed: np.ndarray
    """cells where a wheel may stand, shape (nx, ny)"""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrialRecording:
    """One trial."""

    folder: Path
    figures: Json
    """content of trial.json"""
    spec: RobotSpec
    surface: HeightGrid
    """true"""
    states: States
    track: Track
    proposals: tuple[Shown, ...]
    believed: BelievedMap | None
    """None of a trial without proposals"""
    spans: tuple[tuple[str, float, float], ...]
    """what the mission time was spent on: part, begin, end [s]"""
    sent: np.ndarray
    """when uplinks left [s]"""
    arrived: np.ndarray
    """when downlinks other than receipts arrived [s]"""
    collisions: tuple[Json, ...]

    @property
    def datum(self) -> float:
        """True height of what the ground calls z = 0 [m]."""
        return float(np.mean(self.surface.sample(self.states.wheels_in_world[0, :, :2])))

    @property
    def goal(self) -> np.ndarray | None:
        """In world [m]; None when the scenario is not at hand any more."""
        try:
            return np.array([load_scenario(self.figures["scenario"]).goal_distance, 0.0])
        except AthleteError:
            return None

    def footfalls(self) -> tuple[Footfall, ...]:
        """Where wheels truly came down, in order."""
        steps = [p for p in self.proposals if p.kind == "step" and p.decision == "approve"]
        out = []
        for k, (before, now) in enumerate(zip(self.states.phases[:-1], self.states.phases[1:], strict=True)):
            for leg in range(LEGS):
                if before[leg] != "stance" and now[leg] == "stance":
                    t = float(self.states.t[k + 1])
                    asked = [n for n, p in enumerate(steps) if leg in dict(p.footfalls) and p.decided <= t]
                    if not asked:
                        continue
                    contact = self.states.wheels_in_world[k + 1, leg] - [0.0, 0.0, self.spec.wheel.radius]
                    out.append(Footfall(number=asked[-1] + 1, leg=leg, t=t, contact=contact))
        # A wheel that came down, was lifted and came down again for one proposal counts where it stayed.
        return tuple({(f.number, f.leg): f for f in out}.values())

    def map_error(self) -> HeightGrid | None:
        """Believed height less true, on the cells of the believed map [m]."""
        if self.believed is None:
            return None
        grid = self.believed.grid
        x, y = grid.centres()
        xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        return replace(grid, heights=grid.heights + self.datum - self.surface.sample(xy))

    def terrain(self) -> Terrain | None:
        """The ground with its rocks and looks, built again; None where it is not the ground of this trial."""
        try:
            terrain = terrain_of(self.spec, self.figures["scenario"], self.figures["seed"])
        except AthleteError:
            return None
        same = terrain.grid.shape == self.surface.shape and np.allclose(terrain.grid.heights, self.surface.heights, atol=1e-5)
        return terrain if same else None


def terrain_of(spec: RobotSpec, scenario: str, seed: int) -> Terrain:
    """The ground that the twin stands on in a scenario, by its name or path."""
    from athlete_twin.athlete import CLEAR_RADIUS

    return build_terrain(load_scenario(scenario), seed, clear_xy=stance_wheels_in_hex(spec)[:, :2], clear_radius=CLEAR_RADIUS)


def load_figures(folder: Path) -> Json:
    """Content of a trial's trial.json."""
    path = folder / "trial.json"
    try:
        figures = json.loads(path.read_text())
    except FileNotFoundError as e:
        raise RecordingError(f"{path} is missing; scripts/rock_field_trial.py --out {folder} writes it") from e
    except ValueError as e:
        raise RecordingError(f"{path} is damaged: {e}") from e
    if not isinstance(figures, dict):
        raise RecordingError(f"{path} is damaged: it holds a {type(figures).__name__}, not the object that a trial writes")
    lacking = [name for name in NAMING if name not in figures]
    if lacking:
        raise RecordingError(f"{path} is damaged: it does not say {', '.join(lacking)}")
    return figures


def load_recording(folder: Path) -> TrialRecording:
    """Read a trial's folder."""
    figures = load_figures(folder)
    spec = load_spec(figures["robot"])
    lines: dict[str, list[Recorded]] = defaultdict(list)
    for line in read_recording(folder / "trial.mcap"):
        if not line.topic.endswith(("/left", "/right")):
            lines[line.topic].append(line)
    for topic in ("/truth/terrain", "/truth/state", "/truth/joints"):
        if not lines[topic]:
            raise RecordingError(f"{folder}/trial.mcap holds nothing under {topic}; the trial ended before it began")
    surface, _ = grid_from_message(lines["/truth/terrain"][0].content)
    return TrialRecording(
        folder=folder,
        figures=figures,
        spec=spec,
        surface=surface,
        states=_states([r.content for r in lines["/truth/state"]], spec),
        track=_track(lines["/truth/chassis"], lines["/truth/joints"], spec.dof),
        proposals=_proposals(lines),
        believed=_merged([grid_from_message(r.content) for r in lines["/ground/terrain"]]),
        spans=tuple((c["bin"], c["begin"], c["end"]) for c in (r.content for r in lines["/truth/mission_time"])),
        sent=np.array([r.t for topic, rows in lines.items() if topic.startswith("/uplink") for r in rows]),
        arrived=np.array(
            [r.t for topic, rows in lines.items() if topic.startswith("/downlink") and "receipt" not in topic for r in rows]
        ),
        collisions=tuple(r.content for r in lines["/truth/collision"]),
    )


def _states(rows: list[Json], spec: RobotSpec) -> States:
    def column(name: str) -> np.ndarray:
        return np.array([row[name] for row in rows], dtype=float)

    return States(
        t=column("t"),
        loads=column("wheel_loads"),
        torque_fraction=(np.abs(column("torques")) / spec.torque_limits).max(axis=(1, 2)),
        peak_torque_fraction=column("peak_torque_fraction"),
        wheels_in_world=column("wheels_in_world"),
        support_margin=column("support_margin"),
        cps_margin=column("cps_margin"),
        tip_over_energy=column("tip_over_energy"),
        phases=tuple(tuple(row["phases"]) for row in rows),
    )


def _track(chassis: list[Recorded], joints: list[Recorded], dof: int) -> Track:
    angles = np.array([list(joint_angles(r.content).values()) for r in joints])
    legs = LEGS * dof
    return Track(
        t=np.array([r.t for r in joints]),
        world_from_hex=tuple(_pose(r.content) for r in chassis[: len(joints)]),
        joints=angles[:, :legs].reshape(-1, LEGS, dof),
        docks=angles[:, legs:],
    )


def _proposals(lines: dict[str, list[Recorded]]) -> tuple[Shown, ...]:
    answers = {}
    for r in lines["/operator/decision"]:
        # After "wait" the same proposal is answered again.
        answers[r.content["proposal"]] = (r.content["kind"], r.t)
    out = []
    for shown, chassis in zip(lines["/operator/shown"], lines["/ground/chassis"], strict=False):
        c = shown.content
        decision, decided = answers.get(c["index"], ("", float("nan")))
        out.append(
            Shown(
                index=c["index"],
                t=shown.t,
                kind=c["kind"],
                leg=c["leg"],
                footfall=np.array(c["footfall_in_world"]),
                together=tuple((other["leg"], np.array(other["footfall_in_world"])) for other in c.get("together", ())),
                text=c["text"],
                margin=c["predicted_margin"],
                sag=c["predicted_sag"],
                world_from_hex=_pose(chassis.content),
                decision=decision,
                decided=decided,
            )
        )
    return tuple(out)


def _pose(content: Json) -> SE3:
    place: dict[str, Any] = content["translation"]
    turn: dict[str, Any] = content["rotation"]
    return SE3.from_quaternion(np.array([turn[k] for k in "xyzw"]), np.array([place[k] for k in "xyz"]))


def _merged(maps: list[tuple[HeightGrid, dict[str, np.ndarray]]]) -> BelievedMap | None:
    seen = [(grid, flags) for grid, flags in maps if np.isfinite(grid.heights).any()]
    if not seen:
        return None
    cell = min(grid.cell for grid, _ in seen)
    seen = [(grid, flags) for grid, flags in seen if abs(grid.cell - cell) < 1e-9]
    x0 = min(grid.origin_x for grid, _ in seen)
    y0 = min(grid.origin_y for grid, _ in seen)
    starts = [(round((g.origin_x - x0) / cell), round((g.origin_y - y0) / cell)) for g, _ in seen]
    shape = tuple(max(start[k] + g.shape[k] for start, (g, _) in zip(starts, seen, strict=True)) for k in (0, 1))
    heights, allowed = np.full(shape, np.nan), np.zeros(shape, dtype=bool)
    for (i, j), (grid, flags) in zip(starts, seen, strict=True):
        part = np.s_[i : i + grid.shape[0], j : j + grid.shape[1]]
        known = np.isfinite(grid.heights)
        heights[part][known] = grid.heights[known]
        allowed[part][known] = flags["footfall_ok"].astype(bool)[known]
    return BelievedMap(grid=HeightGrid(origin_x=x0, origin_y=y0, cell=cell, heights=heights), allowed=allowed)
