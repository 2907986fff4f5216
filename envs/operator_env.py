"""The operator environments: the planner runs inside, the observation is its proposal, the action the operator's decision.

A step ends when a new proposal stands or after `step_s` of mission time, whichever comes first. While no proposal stands,
only a stop has an effect.
"""

from __future__ import annotations

from typing import Any, cast

import gymnasium as gym
import numpy as np

from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.world.scenario import Scenario
from envs.action_fields import Action, flags, one_of, units
from envs.agent_maker import AgentMaker, identity_of
from envs.build import ground_agent
from envs.env import Body, Link, MissionEnv
from envs.rewards import RewardConfig
from envs.spaces import FAR, NEVER, Observation, bounded
from envs.variants import variant_named
from planner.decisions import DECISIONS, Decision, DecisionKind, GroundAgent, Proposal, check_cameras
from planner.decisions import MAX_WAIT as LONGEST_WAIT
from planner.preview.preview import FAULTS

PREVIEW_POSES = 16
"""of the previewed motion, evenly spaced"""
MAP_CELL = 0.1
"""of the map shown [m]"""
MAP_CELLS = 80
"""along each axis of the map shown, centred on the believed chassis: 4 m to each side"""
MAX_WAIT = 60.0
"""an operator waits so long at most in one decision [s]"""
KINDS = ("none", "step", "shift")


class OperatorEnv(MissionEnv):
    """One robot, its ground, and a vacant operator's chair.

    **Action**, a dict: the decision on the standing proposal. Fields that the kind does not use are ignored; while no
    proposal stands only a stop has an effect.

    | field | space | meaning |
    |---|---|---|
    | `kind` | Discrete | by `planner.decisions.DECISIONS` |
    | `footfall` | Box(2,) in [-1, 1] | edited footfall: believed chassis plus 4 m times this along x and y of `world` |
    | `leg` | Discrete(6) | to step with: 0 is leg 1 |
    | `cameras` | MultiBinary(n) | to look with, in the order of `env.unwrapped.cameras`; none is a wait. Absent without cameras |
    | `wait` | Box(1,) in [-1, 1] | from 0.1 to 60 s |

    **Observation**, a dict of what the ground proposes and believes; all are copies, all zero while no proposal stands.
    `world` is the ground's own. float32 unless said otherwise; a transform is translation [m] and rotation vector [rad].

    | field | shape | unit, frame, range |
    |---|---|---|
    | `t` | (1,) | mission time [s] |
    | `goal_in_world` | (2,) | x, y [m] |
    | `present` | Discrete(2) | whether a proposal stands |
    | `kind` | Discrete(3) | 0 none, 1 step, 2 shift |
    | `leg` | Discrete(7) | 0 none, 1 to 6 as the papers number them |
    | `footfall_in_world` | (3,) | place of the patch [m] |
    | `companion_leg` | Discrete(7) | that steps together with it, as `leg`; 0 none |
    | `companion_footfall_in_world` | (3,) | place of its patch [m]; zero where none |
    | `predicted_margin`, `predicted_sag` | (1,) | [m]; 0 for not known |
    | `world_from_hex` | (6,) | believed chassis |
    | `preview_times` | (16,) | evenly over the sequence, after it begins [s] |
    | `preview_joints` | (16, 6, dof) | then [rad] |
    | `preview_world_from_hex` | (16, 6) | the same of the chassis |
    | `preview_faults` | MultiBinary(11) | whether the preview finds a fault of each kind of `planner.preview.preview.FAULTS` |
    | `map_height` | (80, 80) | cells of 0.1 m round the believed chassis, first index along x of `world` [m] |
    | `map_known`, `map_green` | (80, 80) uint8 | whether seen, whether a wheel may stand there |

    **Reward**, **truncated** and `info["truth"]` as with `UplinkEnv`. **Terminated**: tipped over, at the goal, or the
    ground has said its last word (`info["arrived"]`, `info["no_step"]`), or it knows that the operator's stop was heard.
    **info**: besides, `text` of the proposal or of the last word, `waiting_for`.
    """

    def __init__(
        self,
        robot: str,
        *,
        body: Body = "twin",
        scenario: str | Scenario = "rock_field",
        variant: str = "integrated",
        link: Link = None,
        cameras: tuple[str, ...] | list[str] | None = None,
        step_s: float = 1.0,
        time_limit: float | None = None,
        render_mode: str | None = None,
        rewards: RewardConfig | None = None,
        make_agent: AgentMaker | None = None,
    ) -> None:
        """Build the spaces; robot and ground are built by `reset`.

        Args:
            robot: name of the drawings.
            body: "twin", or "mock" for no physics on flat ground.
            scenario: name, path ending in .toml, or a scenario itself.
            variant: of the planner, one of the names that `envs.variants` tells of.
            link: one-way delay [s] on default links, or the up and down configuration; 5 s by default.
            cameras: that the operator may choose; all by default.
            step_s: longest step, mission time [s].
            time_limit: mission time after which an episode is truncated [s]; the scenario's by default.
            render_mode: "rgb_array" for pictures from outside, "human" for a window that shows them.
            rewards: weights.
            make_agent: makes another ground than this project's, from drawings, goal and seed.
        """
        super().__init__(
            robot,
            body,
            scenario=scenario,
            link=link,
            cameras=cameras,
            step_s=step_s,
            time_limit=time_limit,
            render_mode=render_mode,
            rewards=rewards or RewardConfig(),
        )
        self._variant_name = variant
        self._variant = variant_named(variant) if make_agent is None else None
        self._make_agent = make_agent
        self.action_space = decision_space(len(self.cameras))
        self.observation_space = proposal_space(self.drawings)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A fresh robot and a ground that knows nothing yet."""
        del options
        self._reset(seed)
        return self._observation(), self._info()

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Answer the standing proposal as the action says, and wait for the next."""
        standing = self.mission.standing
        if standing is None:
            stops = DECISIONS[one_of(action, "kind", len(DECISIONS))] == "stop"
            return self.step_decision(Decision(kind="stop") if stops else None)
        return self.step_decision(decision_of(action, standing, self.cameras, idle=self._idle))

    def step_decision(self, decision: Decision | None) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """The same as `step` with a decision object; None while no proposal stands."""
        mission, begun = self.mission, self.mission.t
        if decision is not None:
            check_cameras(decision, self.drawings)
        self._inputs.append(decision)
        if mission.wants_answer:
            mission.answer(decision or Decision(kind="wait", duration=self._idle))
        elif decision is not None and decision.kind == "stop":
            mission.stop("operator")
        mission.advance(begun + self.step_s)
        value, terminated, truncated, info = self._judged(begun)
        self._show()
        ended = mission.finished or (mission.stopped and not mission.stop_under_way)
        return self._observation(), value, terminated or ended, truncated, info

    @property
    def proposal(self) -> Proposal | None:
        """What the operator is asked, whole; None while nothing is."""
        return self.mission.standing if self.mission.wants_answer else None

    @property
    def _idle(self) -> float:
        """What no answer means: to be asked again after a step, or after the longest wait that may be ordered [s]."""
        return min(self.step_s, LONGEST_WAIT)

    def _agent(self, seed: int) -> GroundAgent:
        if self._make_agent is not None:
            return self._make_agent(self.drawings, self.goal, seed)
        return ground_agent(self.drawings, self._variant or self._variant_name, goal=self.goal, seed=seed)

    def _declared(self) -> bool:
        return self.mission.arrived is not None

    def _info(self) -> dict[str, Any]:
        mission, proposal = self.mission, self.proposal
        said = mission.arrived.text if mission.arrived else mission.no_step.reason if mission.no_step else ""
        return super()._info() | {
            "text": proposal.text if proposal else said,
            "waiting_for": mission.waiting_for,
            "arrived": mission.arrived is not None,
            "no_step": mission.no_step is not None,
        }

    def _made_with(self) -> dict[str, Any]:
        found = self._variant
        content = "" if found is None else found.sha256
        return super()._made_with() | {
            "make_agent": None if self._make_agent is None else identity_of(self._make_agent),
            "variant": self._variant_name,
            "variant's content": content,
        }

    def _input(self, message: Decision | None) -> Any:
        return self.step_decision(message)

    def _observation(self) -> Observation:
        return observed(self.proposal, self.drawings, self.mission.t, self.goal)


def decision_space(cameras: int) -> gym.spaces.Dict:
    """The operator's decisions, as `OperatorEnv` documents them. Without cameras there is no key for them."""
    return gym.spaces.Dict(
        {
            "kind": gym.spaces.Discrete(len(DECISIONS)),
            "footfall": gym.spaces.Box(-1.0, 1.0, (2,), np.float32),
            "leg": gym.spaces.Discrete(LEGS),
            **({"cameras": gym.spaces.MultiBinary(cameras)} if cameras else {}),
            "wait": gym.spaces.Box(-1.0, 1.0, (1,), np.float32),
        }
    )


def decision_of(action: Action, proposal: Proposal, cameras: tuple[str, ...], *, idle: float) -> Decision:
    """The decision an action means.

    Args:
        action: out of `decision_space`; only the fields that the kind uses are read.
        proposal: it answers.
        cameras: what the action's camera flags stand for.
        idle: a choice of no camera is a wait of so long [s].
    """
    kind = cast(DecisionKind, DECISIONS[one_of(action, "kind", len(DECISIONS))])
    if kind == "edit_footfall":
        unit = units(action, "footfall", 2)
        xy = proposal.world_from_hex.translation[:2] + 0.5 * MAP_CELLS * MAP_CELL * unit
        height = float(proposal.terrain.sample(xy))
        z = height if np.isfinite(height) else float(proposal.footfall_in_world[2])
        return Decision(kind=kind, footfall_in_world=np.append(xy, z))
    if kind == "choose_leg":
        return Decision(kind=kind, leg=one_of(action, "leg", LEGS))
    if kind == "choose_cameras":
        wanted = flags(action, "cameras", len(cameras)) if cameras else ()
        named = tuple(c for c, chosen in zip(cameras, wanted, strict=True) if chosen)
        return Decision(kind=kind, cameras=named) if named else Decision(kind="wait", duration=idle)
    if kind == "wait":
        share = 0.5 * (float(units(action, "wait", 1)[0]) + 1.0)
        return Decision(kind=kind, duration=max(share * MAX_WAIT, 0.1))
    return Decision(kind=kind)


def proposal_space(spec: RobotSpec) -> gym.spaces.Dict:
    """The proposal, its preview and the green-and-red map, as `OperatorEnv` documents them."""
    k, n = PREVIEW_POSES, MAP_CELLS

    def within(bound: float, *shape: int) -> gym.spaces.Box:
        return gym.spaces.Box(-bound, bound, shape, np.float32)

    return gym.spaces.Dict(
        {
            "t": gym.spaces.Box(0.0, NEVER, (1,), np.float32),
            "goal_in_world": within(FAR, 2),
            "present": gym.spaces.Discrete(2),
            "kind": gym.spaces.Discrete(len(KINDS)),
            "leg": gym.spaces.Discrete(LEGS + 1),
            "footfall_in_world": within(FAR, 3),
            "companion_leg": gym.spaces.Discrete(LEGS + 1),
            "companion_footfall_in_world": within(FAR, 3),
            "predicted_margin": within(FAR, 1),
            "predicted_sag": within(FAR, 1),
            "world_from_hex": within(FAR, 6),
            "preview_times": gym.spaces.Box(0.0, NEVER, (k,), np.float32),
            "preview_joints": within(2 * np.pi, k, LEGS, spec.dof),
            "preview_world_from_hex": within(FAR, k, 6),
            "preview_faults": gym.spaces.MultiBinary(len(FAULTS)),
            "map_height": within(FAR, n, n),
            "map_known": gym.spaces.Box(0, 1, (n, n), np.uint8),
            "map_green": gym.spaces.Box(0, 1, (n, n), np.uint8),
        }
    )


def observed(proposal: Proposal | None, spec: RobotSpec, t: float, goal: tuple[float, float]) -> Observation:
    """The observation of a proposal, or of none.

    `leg` is 0 for none and 1 to 6 as the papers number them; transforms are translation and rotation vector; what is not
    known is 0.
    """
    k, n = PREVIEW_POSES, MAP_CELLS
    out: Observation = {
        "t": np.array([min(t, NEVER)], dtype=np.float32),
        "goal_in_world": bounded(goal, FAR),
        "present": np.int64(proposal is not None),
        "kind": np.int64(0),
        "leg": np.int64(0),
        "footfall_in_world": np.zeros(3, dtype=np.float32),
        "companion_leg": np.int64(0),
        "companion_footfall_in_world": np.zeros(3, dtype=np.float32),
        "predicted_margin": np.zeros(1, dtype=np.float32),
        "predicted_sag": np.zeros(1, dtype=np.float32),
        "world_from_hex": np.zeros(6, dtype=np.float32),
        "preview_times": np.zeros(k, dtype=np.float32),
        "preview_joints": np.zeros((k, LEGS, spec.dof), dtype=np.float32),
        "preview_world_from_hex": np.zeros((k, 6), dtype=np.float32),
        "preview_faults": np.zeros(len(FAULTS), dtype=np.int8),
        "map_height": np.zeros((n, n), dtype=np.float32),
        "map_known": np.zeros((n, n), dtype=np.uint8),
        "map_green": np.zeros((n, n), dtype=np.uint8),
    }
    if proposal is None:
        return out
    times = np.linspace(0.0, proposal.preview.duration, k)
    moments = [proposal.preview.at(float(at)) for at in times]
    codes = {fault.code for fault in proposal.preview.faults}
    companion = proposal.together[0] if proposal.together else None
    here = proposal.world_from_hex
    offsets = (np.arange(n) - 0.5 * (n - 1)) * MAP_CELL
    xy = np.stack(np.meshgrid(here.translation[0] + offsets, here.translation[1] + offsets, indexing="ij"), axis=-1)
    ix, iy, inside = proposal.terrain.index(xy)
    heights = proposal.terrain.heights[ix, iy]
    known = inside & np.isfinite(heights)
    out |= {
        "kind": np.int64(KINDS.index(proposal.kind)),
        "leg": np.int64(proposal.leg + 1),
        "footfall_in_world": bounded(proposal.footfall_in_world, FAR),
        "companion_leg": np.int64(companion.leg + 1 if companion else 0),
        "companion_footfall_in_world": bounded(companion.footfall_in_world if companion else np.zeros(3), FAR),
        "predicted_margin": bounded(np.nan_to_num([proposal.predicted_margin]), FAR),
        "predicted_sag": bounded(np.nan_to_num([proposal.predicted_sag]), FAR),
        "world_from_hex": _six(here),
        "preview_times": np.minimum(times, NEVER).astype(np.float32),
        "preview_joints": bounded(np.array([moment.joints for moment in moments]), 2 * np.pi),
        "preview_world_from_hex": np.array([_six(moment.world_from_hex) for moment in moments]),
        "preview_faults": np.array([code in codes for code in FAULTS], dtype=np.int8),
        "map_height": bounded(np.where(known, heights, 0.0), FAR),
        "map_known": known.astype(np.uint8),
        "map_green": (known & proposal.footfall_ok[ix, iy]).astype(np.uint8),
    }
    return out


def _six(outer_from_inner: Any) -> np.ndarray:
    return bounded(np.concatenate([outer_from_inner.translation, outer_from_inner.rotvec()]), FAR)
