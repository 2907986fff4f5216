"""Runs one trial to its outcome and writes what DESIGN.md promises: `trial.json` and `trial.mcap`.

The runner only joins what others built: a robot, a ground agent, an operator and two links. It ends with exactly one
outcome, Ctrl-C included, and whatever ends it, the recording is closed and the result is written whole or not at all.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from athlete_twin.errors import ConfigError, PhysicsError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.link import DelayedLink, LinkConfig
from athlete_twin.model.spec import RobotSpec
from athlete_twin.robot import SimulatedRobot, TrackView, TruthView
from envs.mask_score import MaskScore
from envs.mission import Mission
from envs.provenance import provenance
from envs.recorder import Recorder
from envs.scoring import TIPPED, Scorer, Summary, path_of, tilt
from envs.stage_times import StageTimes
from planner.decisions import GroundAgent, Operator
from planner.eyes import Look
from planner.underway import SILENCE

SCHEMA_VERSION = 1
OUTCOMES = ("goal_reached", "cycles_done", "time_limit", "fault", "tip_over", "no_step", "operator_abort")
INTERRUPTED = "interrupted at the console"
LOOK = 1.0
"""how often the runner looks at what happened, when nothing else stops the mission [s]"""
STOP_PATIENCE = 2 * SILENCE
"""after the operator's stop the trial ends when the ground knows of it, or after so long: it goes up again once in between [s]"""
THINNED = 4
"""of a picture's points every so many-th along rows and columns is recorded: enough to see what was seen"""
HASH_DECIMALS = 9
"""of metres, radians and seconds in the trajectory's hash: below any effect, above the last bits of a sum"""


@dataclass(frozen=True, kw_only=True)
class TrialSetup:
    """What names a trial. The same setup gives the same trajectory."""

    robot: str
    scenario: str
    variant: str
    seed: int
    operator: str
    up: LinkConfig
    down: LinkConfig
    goal: tuple[float, float]
    """in world [m]"""
    cycles: int
    """the trial ends after so many gait cycles"""
    time_limit: float
    """mission time [s]"""
    payload_kg: float = 0.0

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigError(f"seed is {self.seed}, must be 0 or more")
        if self.cycles < 1:
            raise ConfigError(f"cycles is {self.cycles}, must be 1 or more")
        if not self.time_limit > 0.0:
            raise ConfigError(f"time limit is {self.time_limit} s, must be positive")


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """Content of `trial.json`; None where nothing was measured."""

    schema_version: int
    robot: str
    payload_kg: float
    scenario: str
    variant: str
    seed: int
    link: dict[str, Any]
    operator: str
    outcome: str
    reason: str
    progress_m: float
    goal_distance_m: float
    gait_cycles: int
    steps_taken: int
    mission_time_s: float
    motion_s: float
    link_s: float
    operator_s: float
    ground_s: float
    wall_time_s: float
    uplinks: int
    command_cycles: int
    downlink_bytes: int
    decisions: int
    rejections: int
    e_stops: int
    faults: int
    collisions: int
    min_support_margin_m: float | None
    min_cps_margin_m: float | None
    min_tip_over_energy_m: float | None
    peak_torque_fraction: float | None
    sag_error_m: Summary
    touchdown_error_m: Summary
    map_error_m: Summary
    localisation_error_m: Summary
    leg_mask: Summary
    stage_times_s: dict[str, dict[str, float]]
    trajectory_sha256: str
    suite_sha256: str | None
    provenance: dict[str, Any]


@dataclass(kw_only=True)
class TrialState:
    """What a progress display sees."""

    mission: Mission
    scorer: Scorer
    truth: TruthView


ProgressReport = Callable[[TrialState], None]


@dataclass(kw_only=True)
class Trial:
    """One trial under way."""

    setup: TrialSetup
    spec: RobotSpec
    robot: SimulatedRobot
    agent: GroundAgent
    operator: Operator
    grid: HeightGrid
    """true surface, for scores and the recording"""
    out: Path
    """folder that exists"""
    timer: StageTimes = field(default_factory=StageTimes)
    mask_score: MaskScore = field(default_factory=MaskScore)
    """what its builder joins to the robot's views and the ground's looks; without that its figures are None"""
    progress: ProgressReport = lambda _state: None
    interrupted: bool = False
    """set from outside, by a signal's handler or another thread, to end the trial within a second of mission time"""
    origin: Mapping[str, str] = field(default_factory=dict)
    """what the recording says of where it comes from, as `envs.origin` puts it"""
    urdf: bytes = b""
    """goes into the recording, for viewers that draw the robot"""
    suite_sha256: str | None = None
    """of the `envs.suite.Suite` this is a case of, if any"""

    def run(self) -> TrialResult:
        """Run to an outcome; `trial.json` and `trial.mcap` are written when it returns."""
        names = ("robot", "scenario", "variant", "seed", "operator")
        metadata = {name: str(getattr(self.setup, name)) for name in names} | dict(self.origin)
        truth = self.robot.truth()
        self.scorer = Scorer(
            spec=self.spec,
            grid=self.grid,
            goal=np.array(self.setup.goal, dtype=float),
            start=truth.world_from_hex.translation[:2].copy(),
            datum=float(np.mean(self.grid.sample(truth.wheels_in_world[:, :2]))),
        )
        self._tipped = False
        self._last_completed = -1
        self._written = [0, 0, 0]
        with Recorder(self.out / "trial.mcap", metadata=metadata, spec=self.spec) as self._recorder:
            if self.urdf:
                self._recorder.attach("robot.urdf", self.urdf, media_type="application/xml")
            self._recorder.ground_truth(self.grid)
            self.mission = Mission(
                self.robot,
                up=DelayedLink(self.setup.up, np.random.default_rng([self.setup.seed, 1])),
                down=DelayedLink(self.setup.down, np.random.default_rng([self.setup.seed, 2])),
                agent=self.agent,
                recorder=self._recorder,
                on_truth=self._sample,
            )
            try:
                outcome, reason = self._to_outcome()
            except KeyboardInterrupt:
                outcome, reason = "operator_abort", INTERRUPTED
            except PhysicsError as e:
                outcome, reason = "fault", f"the simulation broke off: {e}"
            self._record_track()
            self._recorder.ground_says("outcome", reason, self.mission.t, outcome=outcome)
            result = self._result(outcome, reason)
            self._recorder.result(
                {
                    "outcome": outcome,
                    "reason": reason,
                    "trajectory_sha256": result.trajectory_sha256,
                    "link_sha256": self._recorder.link_sha256,
                }
            )
        write_json(self.out / "trial.json", asdict(result))
        return result

    def looked(self, look: Look) -> None:
        """Record what the ground made of a picture: the points that went into its map, thinned."""
        depth = look.masked.depth
        points = depth.points_in_camera()[::THINNED, ::THINNED][~look.masked.mask[::THINNED, ::THINNED]]
        seen = points[np.isfinite(points).all(axis=1)]
        self._recorder.seen(look.world_from_camera.apply(seen), self.mission.t, made=look.t)

    def _to_outcome(self) -> tuple[str, str]:
        mission, scorer = self.mission, self.scorer
        self._sample(self.robot.truth())
        while not self.interrupted:
            with self.timer("mission_loop"):
                mission.advance(min(mission.t + LOOK, self.setup.time_limit))
            self._take_completed()
            truth = self.robot.truth()
            self.progress(TrialState(mission=mission, scorer=scorer, truth=truth))
            if self._tipped:
                return "tip_over", f"the chassis tilts by {np.rad2deg(tilt(truth.world_from_hex)):.0f} deg"
            if mission.arrived is not None:
                distance = scorer.goal_distance(truth)
                if scorer.at_goal(truth):
                    return "goal_reached", f"{mission.arrived.text}; {distance:.2f} m from the goal"
                hangs = ", ".join(f"wheel {number}" for number in scorer.unloaded(truth))
                lacks = f", where {hangs} carries nothing" if hangs else ""
                return "no_step", f"the ground declared arrival {distance:.2f} m from the goal{lacks}"
            if mission.no_step is not None:
                return self._nothing_to_do()
            if scorer.gait_cycles >= self.setup.cycles:
                return "cycles_done", f"{scorer.gait_cycles} gait cycles"
            if mission.t >= self.setup.time_limit:
                awaited = mission.waiting_for or "nothing"
                return "time_limit", f"{self.setup.time_limit:.0f} s are over; the ground waited for {awaited}"
            if mission.wants_answer and self._asked():
                return "operator_abort", "the operator stopped the robot"
        return "operator_abort", INTERRUPTED

    def _asked(self) -> bool:
        """Let the operator answer; whether the answer ends the trial."""
        mission = self.mission
        proposal = mission.standing
        if proposal is None:
            return False
        self.scorer.proposed(proposal, self.robot.truth())
        decision, seconds = self.operator.decide(proposal, mission.t)
        mission.answer(decision, seconds=seconds)
        if decision.kind != "stop":
            return False
        # The stop still has to reach the robot, and the news of it the ground; a link that is down must not keep the trial.
        mission.advance(mission.t + seconds)
        patience = mission.t + STOP_PATIENCE
        while mission.stop_under_way and mission.t < patience:
            mission.advance(patience, stop_at_downlink=True)
        return True

    def _nothing_to_do(self) -> tuple[str, str]:
        fault, no_step = self.mission.last_fault, self.mission.no_step
        reason = no_step.reason if no_step else ""
        if no_step and no_step.refused:
            reason += " (" + ", ".join(f"{k}: {n}" for k, n in no_step.refused.items()) + ")"
        if fault is not None and fault.sequence_id > self._last_completed:
            return "fault", f"{fault.code}: {fault.text}; {reason}"
        return "no_step", reason

    def _take_completed(self) -> None:
        while self.mission.completed:
            sequence_id, truth = self.mission.completed.popleft()
            proposal = self.mission.approved.get(sequence_id)
            if proposal is not None:
                self._last_completed = sequence_id
                self.scorer.completed(proposal, truth)

    def _sample(self, truth: TruthView) -> None:
        margins = self.scorer.sample(truth)
        self._tipped |= tilt(truth.world_from_hex) > TIPPED
        figures = {
            "support_margin": margins.support,
            "cps_margin": margins.cps,
            "tip_over_energy": margins.energy,
            "goal_distance": self.scorer.goal_distance(truth),
        }
        self._recorder.truth(truth, figures)
        self._record_track()

    def _record_track(self) -> None:
        track, collisions, injected = self.robot.track, self.robot.collisions, self.robot.injected
        for point in track[self._written[0] :]:
            self._recorder.track(point)
        for collision in collisions[self._written[1] :]:
            self._recorder.collision(collision)
        for fault in injected[self._written[2] :]:
            self._recorder.write("/truth/injected_fault", asdict(fault), fault.t)
        self._written = [len(track), len(collisions), len(injected)]

    def _result(self, outcome: str, reason: str) -> TrialResult:
        setup, mission, scorer, truth = self.setup, self.mission, self.scorer, self.robot.truth()
        bins = {name: mission.seconds(name) for name in ("motion", "link", "operator", "ground")}
        least = scorer.least
        counts = mission.counts
        return TrialResult(
            schema_version=SCHEMA_VERSION,
            robot=setup.robot,
            payload_kg=setup.payload_kg,
            scenario=setup.scenario,
            variant=setup.variant,
            seed=setup.seed,
            link={"delay_s": setup.down.delay, "down": asdict(setup.down), "up": asdict(setup.up)},
            operator=setup.operator,
            outcome=outcome,
            reason=reason,
            progress_m=scorer.progress(truth),
            goal_distance_m=scorer.goal_distance(truth),
            gait_cycles=scorer.gait_cycles,
            steps_taken=scorer.steps_taken,
            mission_time_s=bins["motion"] + bins["link"] + bins["operator"] + bins["ground"],
            motion_s=bins["motion"],
            link_s=bins["link"],
            operator_s=bins["operator"],
            ground_s=bins["ground"],
            wall_time_s=self.timer.elapsed(),
            uplinks=counts.uplinks,
            command_cycles=counts.command_cycles,
            downlink_bytes=mission.down.bytes_sent,
            decisions=counts.decisions,
            rejections=counts.rejections,
            e_stops=counts.e_stops,
            faults=counts.faults,
            collisions=len(self.robot.collisions),
            min_support_margin_m=least.support if least else None,
            min_cps_margin_m=least.cps if least else None,
            min_tip_over_energy_m=least.energy if least else None,
            peak_torque_fraction=scorer.peak_torque_fraction,
            sag_error_m=scorer.sag_error(),
            touchdown_error_m=scorer.touchdown_error(),
            map_error_m=scorer.map_error(path_of(list(self.robot.track))),
            localisation_error_m=scorer.localisation_error(),
            leg_mask=self.mask_score.summary(),
            stage_times_s=self.timer.summary(),
            trajectory_sha256=trajectory_sha256(self.robot.track),
            suite_sha256=self.suite_sha256,
            provenance=provenance(),
        )


def trajectory_sha256(track: Iterable[TrackView]) -> str:
    """Hash over the true chassis poses and joints at the recorded mission times."""
    digest = hashlib.sha256()
    for point in track:
        values = np.concatenate([[point.t], point.world_from_hex.matrix()[:3].ravel(), point.joints.ravel()])
        # Adding zero turns -0.0 into 0.0, which is the same place with other bytes.
        digest.update((np.round(values, HASH_DECIMALS) + 0.0).astype("<f8").tobytes())
    return digest.hexdigest()


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON file whole or not at all, even if the power goes; what is not finite becomes null."""
    part = path.with_name(path.name + ".part")
    with part.open("w", encoding="utf-8") as file:
        file.write(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def usable_folder(path: Path) -> Path:
    """The folder, made if need be, after something could be written into it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        probe = path / ".writable"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as e:
        raise ConfigError(
            f"output folder {str(path)!r} cannot be written: {e.strerror}; --out needs a folder you may write to"
        ) from e
    return path


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
