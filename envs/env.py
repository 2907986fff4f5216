"""The uplink environments: an action is what goes up, an observation is what has come down by now, with its age.

A step ends at the next downlink or after `step_s` of mission time, whichever comes first. Reward and end come from the
truth; the observation never does.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import gymnasium as gym
import numpy as np

from athlete_twin.errors import ConfigError, PhysicsError
from athlete_twin.executive import LARGEST_SEQ_STEP
from athlete_twin.link import DelayedLink, LinkConfig, downlink, uplink
from athlete_twin.messages import CommandSequence, Stop
from athlete_twin.model.spec import RobotSpec, load_spec
from athlete_twin.moment import Moment, taken
from athlete_twin.robot import SimulatedRobot, TruthView
from athlete_twin.world.scenario import Scenario, load_scenario
from envs import window
from envs.action_fields import Action, one_of
from envs.build import check_unbroken, drawn_ground, mock, twin
from envs.episode import EpisodeState
from envs.mission import Mission
from envs.rewards import RewardConfig, StepTruth, reward_terms
from envs.scoring import ARRIVED, LOADED, TIPPED, tilt
from envs.spaces import (
    KINDS,
    DownlinkView,
    Observation,
    chosen_cameras,
    command_of,
    downlink_space,
    uplink_action_space,
)
from planner.decisions import GroundAgent

if TYPE_CHECKING:
    from envs.outside_view import OutsideView

DEFAULT_DELAY = 5.0
"""one way, when no link is given [s]"""
Body = Literal["twin", "mock"]
Link = float | tuple[float | LinkConfig, float | LinkConfig] | None
"""what an environment takes for its link, see `link_pair`"""


def link_pair(link: Link) -> tuple[LinkConfig, LinkConfig]:
    """Up and down: each a configuration, or the default one with a delay [s]; one delay for both; 5 s where none is given."""
    sides = tuple(link) if isinstance(link, tuple | list) else (DEFAULT_DELAY if link is None else link,) * 2
    if len(sides) != 2 or not all(isinstance(side, LinkConfig | int | float) and not isinstance(side, bool) for side in sides):
        raise ConfigError(f"link is {link!r}, must be seconds one way, or (up, down), each seconds or a LinkConfig")
    up, down = sides
    return (
        up if isinstance(up, LinkConfig) else uplink(float(up)),
        down if isinstance(down, LinkConfig) else downlink(float(down)),
    )


@dataclass(kw_only=True)
class Score:
    """What the truth said after the last step."""

    distance: float = 0.0
    """to the goal [m]"""
    collisions: int = 0
    """so far"""
    tipped: bool = False
    at_goal: bool = False
    terms: dict[str, float] = field(default_factory=dict)
    """of the last step's reward"""


class MissionEnv(gym.Env[Observation, Action], ABC):
    """What both kinds of environment share: building, the clock, reward, end and the picture from above."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 1}

    def __init__(
        self,
        robot: str,
        body: Body,
        *,
        scenario: str | Scenario,
        link: Link,
        cameras: tuple[str, ...] | list[str] | None,
        step_s: float,
        time_limit: float | None,
        render_mode: str | None,
        rewards: RewardConfig,
    ) -> None:
        if not (isinstance(step_s, int | float) and np.isfinite(step_s) and step_s > 0.0):
            raise ConfigError(f"step_s is {step_s!r} s, must be a positive number")
        if time_limit is not None and not (isinstance(time_limit, int | float) and time_limit > 0.0):
            raise ConfigError(f"time_limit is {time_limit!r} s, must be a positive number")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ConfigError(
                f"render_mode {render_mode!r} is not one of: {', '.join(self.metadata['render_modes'])}, None"
            )
        no_window = window.problem()
        if render_mode == "human" and no_window:
            raise ConfigError(f"render_mode 'human' opens no window here, {no_window}")
        # What this machine can show, and how many pictures of a step each make a second of the mission.
        shown = ["rgb_array"] if no_window else ["human", "rgb_array"]
        self.metadata = {"render_modes": shown, "render_fps": max(1, round(1.0 / step_s))}  # type: ignore[misc]
        self.drawings: RobotSpec = load_spec(robot)
        self.scenario = load_scenario(scenario) if isinstance(scenario, str) else scenario
        if body == "mock":
            check_unbroken(self.scenario)
        self.link = link_pair(link)
        self.cameras = chosen_cameras(self.drawings, cameras)
        self.step_s = step_s
        self.time_limit = self.scenario.time_limit if time_limit is None else time_limit
        self.render_mode = render_mode
        self.goal = (self.scenario.goal_distance, 0.0)
        self._body: Body = body
        self._rewards = rewards
        self._robot: SimulatedRobot | None = None
        self._mission: Mission | None = None
        self._score = Score()
        self._outside: OutsideView | None = None
        self._window: window.Window | None = None
        self._seed, self._inputs = 0, list[Any]()

    @property
    def mission(self) -> Mission:
        """Robot, links and clock since the last reset, for those who want more than arrays."""
        if self._mission is None:
            raise ConfigError("the environment was not reset; call reset() first")
        return self._mission

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The true scene from outside, red, green, blue, shape (360, 640, 3); None without a render mode, or where a window shows it."""
        if self.render_mode is None:
            return None
        robot = self.mission.robot
        if self._outside is None:
            raise ConfigError("the environment is closed; reset() opens it again")
        picture = self._outside.picture(robot)
        if self.render_mode == "rgb_array":
            return picture
        if self._window is None:
            self._window = window.Window(f"ATHLETE {self.drawings.name}")
        self._window.show(picture)
        return None

    def save_state(self) -> EpisodeState:
        """This moment of the episode: what follows `restore_state` of it equals what follows now, to the last bit.

        Of what was sent or done past `step` (by `mission`, say) only the environment that saved knows, until its next
        reset. The generators of the spaces are the caller's.
        """
        self.mission  # noqa: B018  (refuses before the first reset)
        return EpisodeState(
            made_with=self._made_with(), seed=self._seed, inputs=tuple(self._inputs), t=self.mission.t,
            rng=copy.deepcopy(self._np_random), moment=self._taken(),
        )  # fmt: skip

    def restore_state(self, state: EpisodeState) -> tuple[Observation, dict[str, Any]]:
        """Back to a saved moment, as often as wanted: its observation and info.

        Costs milliseconds in the environment that saved it, in a body move as long as its inverse kinematics took so far; after a
        reset, in another one made alike, while a hull touched something, or with a ground inside, the episode is run again from
        its start.
        """
        state.check(self._made_with())
        if self._put_back(state.moment):
            self._inputs = list(state.inputs)
        else:
            self._begin(state.seed)
            for message in state.inputs:
                self._input(message)
            if self.mission.t != state.t:
                raise ConfigError(
                    f"the episode was run again to {self.mission.t} s instead of {state.t} s: "
                    "not all that happened in it went through step()"
                )
        self._np_random = copy.deepcopy(state.rng)
        return self._observation(), self._info()

    def close(self) -> None:
        """Free the simulation, and close the window."""
        self._free()
        if self._window is not None:
            self._window.close()
            self._window = None

    def _reset(self, seed: int | None) -> None:
        """A fresh episode; its seed is drawn where none is given."""
        super().reset(seed=seed)
        self._begin(int(self.np_random.integers(2**31)) if seed is None else seed)
        self._show()

    def _free(self) -> None:
        if self._robot is not None:
            self._robot.close()
        self._robot = self._outside = None

    def _show(self) -> None:
        """What Gymnasium asks of the mode "human": reset and step draw by themselves."""
        if self.render_mode == "human":
            self.render()

    def _begin(self, seed: int) -> None:
        """A fresh robot on fresh ground.

        Everything is built anew: Bullet repeats itself bit by bit only then.
        """
        self._free()
        self._robot, grid = mock(self.drawings, self.scenario) if self._body == "mock" else twin(self.drawings, self.scenario, seed)
        if self.render_mode is not None:
            from envs.outside_view import OutsideView  # the renderer takes a second to load

            self._outside = OutsideView(drawn_ground(self._robot, self.scenario, grid), self.drawings)
        up, down = self.link
        self._mission = Mission(
            self._robot,
            up=DelayedLink(up, np.random.default_rng([seed, 1])),
            down=DelayedLink(down, np.random.default_rng([seed, 2])),
            agent=self._agent(seed),
            on_truth=lambda truth: self._watch(tilt(truth.world_from_hex)),
        )
        self._seed, self._inputs = seed, []
        self._score = Score(
            distance=self._distance_of(self._robot.truth()), terms=reward_terms(StepTruth(), self._rewards)
        )

    def _made_with(self) -> dict[str, Any]:
        """What makes two environments alike."""
        return {
            "robot": self.drawings.name,
            "body": self._body,
            "scenario": self.scenario.name,
            "scenario's content": repr(self.scenario),
            "link": self.link,
            "cameras": self.cameras,
            "step_s": self.step_s,
            "rewards": self._rewards,
            "time_limit": self.time_limit,
        }

    @abstractmethod
    def _input(self, message: Any) -> Any:
        """One step, with what its action meant."""

    @abstractmethod
    def _observation(self) -> Observation:
        """What is seen now."""

    def _taken(self) -> Moment | None:
        """Copies of all that changes, if that can be copied."""
        return None

    def _put_back(self, moment: Moment | None) -> bool:
        """Whether the robot is back where `_taken` copied it; only the one that was copied can be."""
        del moment
        return False

    def _agent(self, seed: int) -> GroundAgent | None:
        """The ground inside, if any."""
        del seed
        return None

    def _declared(self) -> bool:
        """Whether arrival was declared; without a ground inside, standing there is enough."""
        return True

    def _watch(self, angle: float) -> None:
        self._score.tipped |= angle > TIPPED

    def _judged(self, begun: float) -> tuple[float, bool, bool, dict[str, Any]]:
        """Reward, terminated, truncated and info of a step that began at mission time `begun` [s]."""
        mission = self.mission
        truth = mission.robot.truth()
        distance, collisions = self._distance_of(truth), len(mission.robot.collisions)
        tipped = self._score.tipped
        self._watch(tilt(truth.world_from_hex))
        stands = not mission.robot.busy and bool((truth.wheel_loads > LOADED).all())
        at_goal = distance <= ARRIVED and stands and self._declared()
        step = StepTruth(
            nearer=self._score.distance - distance,
            collisions=collisions - self._score.collisions,
            seconds=mission.t - begun,
            tips=self._score.tipped and not tipped,
            arrives=at_goal and not self._score.at_goal,
        )
        self._score.distance, self._score.collisions, self._score.at_goal = distance, collisions, at_goal
        self._score.terms = reward_terms(step, self._rewards)
        value = sum(self._score.terms.values())
        return value, self._score.tipped or at_goal, mission.t >= self.time_limit, self._info()

    def _distance_of(self, truth: TruthView) -> float:
        return float(np.hypot(*(truth.world_from_hex.translation[:2] - self.goal)))

    def _info(self) -> dict[str, Any]:
        score = self._score
        return {
            "mission_time_s": self.mission.t,
            "uplinks": self.mission.counts.uplinks,
            "truth": {
                "goal_distance_m": score.distance,
                "at_goal": score.at_goal,
                "tip_over": score.tipped,
                "collisions": score.collisions,
                "reward_terms": dict(score.terms),
            },
        }


class UplinkEnv(MissionEnv):
    """One robot at the end of a delayed link.

    **Action**, a dict. `kind` says what goes up; the fields it does not use are ignored. Lengths and angles are scaled to
    [-1, 1], float32; what lies beyond is taken as the bound, what is no finite number of the right shape is refused.

    | field | space | meaning |
    |---|---|---|
    | `kind` | Discrete(7) | 0 nothing, 1 joint move, 2 leg move, 3 body move, 4 images, 5 stop, 6 drive |
    | `leg` | Discrete(6) | leg of a joint or leg move: 0 is leg 1 |
    | `joints` | Box(dof,) | motor angles to go to, from the lower to the upper limit of each joint; dof is 6 on SDM-B, 7 on T12 |
    | `wheel` | Box(3,) | axle to go to in `hex`: the normal stance plus 1 m times this |
    | `guard` | Discrete(3) | of a leg move: 0 none, 1 break contact, 2 contact (stops at 0.4 of a wheel's share of the weight) |
    | `shift` | Box(3,) | of the chassis in `hex`, times 0.5 m |
    | `turn` | Box(3,) | of the chassis in `hex`, rotation vector, times 0.2 rad |
    | `drive` | Box(2,) | way of all wheels along x and y of `hex`, times 2 m |
    | `cameras` | MultiBinary(n) | pairs to take, in the order of `env.unwrapped.cameras`, each side binned by 4; absent without cameras |

    **Observation**, a dict of what has come down; all are copies, zero until something comes. float32 unless said otherwise.

    | field | shape | unit, frame, range |
    |---|---|---|
    | `t` | (1,) | mission time [s] |
    | `goal_in_world` | (2,) | x, y of the goal; the ground's `world` begins under the robot, x ahead [m] |
    | `telemetry_age`, `fault_age` | (1,) | since the last was made on board [s]; 1e6 for never |
    | `joints`, `motors` | (6, dof) | angles after and before the wind-up [rad], within 2 pi |
    | `torques` | (6, dof) | over their limits, within 10 |
    | `attitude_rpy` | (3,) | roll, pitch, yaw of `hex` by the inertial unit [rad], within 2 pi |
    | `rates` | (3,) | angular velocity in `hex` [rad/s], within 10 |
    | `acceleration` | (3,) | specific force in `hex` [m/s2], within 100 |
    | `executive_state` | Discrete(5) | 0 unknown, 1 idle, 2 executing, 3 stopped, 4 fault |
    | `receipt` | Discrete | status of the last receipt, by `envs.spaces.RECEIPTS`; 0 for none yet |
    | `receipt_of` | (1,) | id of the sequence that it names; -1 for none, or for one that arrived damaged |
    | `fault` | Discrete | code of the last fault, by `envs.spaces.FAULTS`; 0 for none yet |
    | `image_present` | MultiBinary(n) | whether a pair of this camera has come down |
    | `image_age` | (n,) | since it was taken [s]; 1e6 for never |
    | `left`, `right` | (n, h, w) uint8 | grey pictures, rectified, one fixed slot a camera, zero until one comes |

    The four image fields are absent without cameras (`cameras=()`), which is the cheaper environment.

    **Reward**: the sum of `info["truth"]["reward_terms"]`; weights in `RewardConfig`, all zero but progress.
    **Terminated**: tipped over by 30 degrees, or stands at the goal. **Truncated**: mission time has reached the limit.
    **info**: `mission_time_s`; `uplinks` sent; `messages` that came down in this step; and `truth`, for scoring and never
    for the agent: `goal_distance_m`, `at_goal`, `tip_over`, `collisions` so far and `reward_terms`.
    """

    def __init__(
        self,
        robot: str,
        *,
        body: Body = "twin",
        scenario: str | Scenario = "rock_field",
        link: Link = None,
        cameras: tuple[str, ...] | list[str] | None = None,
        step_s: float = 1.0,
        time_limit: float | None = None,
        render_mode: str | None = None,
        rewards: RewardConfig | None = None,
    ) -> None:
        """Build the spaces; the robot is built by `reset`.

        Args:
            robot: name of the drawings.
            body: "twin", or "mock" for no physics on flat ground.
            scenario: name, path ending in .toml, or a scenario itself.
            link: one-way delay [s] on default links, or the up and down configuration; 5 s by default.
            cameras: shown in observations and usable in actions; all by default, none of an empty tuple.
            step_s: longest step, mission time [s].
            time_limit: mission time after which an episode is truncated [s]; the scenario's by default.
            render_mode: "rgb_array" for pictures from outside, "human" for a window that shows them.
            rewards: weights.
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
        self.action_space = uplink_action_space(self.drawings, self.cameras)
        self.observation_space = downlink_space(self.drawings, self.cameras)
        self._view = DownlinkView(self.drawings, self.cameras, self.goal)
        self._sequences = 0

    _sequences: int
    """of the next sequence"""
    _stops: int
    """of the next stop: robots count sequences, and stops apart"""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A fresh robot; nothing has come down yet."""
        del options
        self._reset(seed)
        return self._observation(), self._info() | {"messages": []}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Send what the action says, and wait. An action that cannot be read raises `CommandError` and changes nothing."""
        command = command_of(action, self.drawings, self.cameras)
        if command is None:
            stops = KINDS[one_of(action, "kind", len(KINDS))] == "stop"
            name, t = self.drawings.name, self.mission.t
            return self.step_message(Stop(seq=self._stops, robot_id=name, t=t, reason="action") if stops else None)
        number = self._sequences
        return self.step_message(
            CommandSequence(
                seq=number, robot_id=self.drawings.name, t=self.mission.t, sequence_id=number, commands=(command,)
            )
        )

    def step_message(
        self, message: CommandSequence | Stop | None
    ) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """The same as `step` with a message object: whole sequences, guards and limits as the sender wants them."""
        begun = self.mission.t
        if message is not None:
            self.mission.send(message)
        self._inputs.append(message)
        if isinstance(message, Stop):
            self._stops = max(self._stops, message.seq) + 1
        elif message is not None and message.seq < self._sequences + LARGEST_SEQ_STEP:  # the robot takes no wilder one either
            self._sequences = max(self._sequences, message.seq) + 1
        arrived = self.mission.advance(begun + self.step_s, stop_at_downlink=True)
        for down in arrived:
            self._view.take(down)
        value, terminated, truncated, info = self._judged(begun)
        self._show()
        return self._observation(), value, terminated, truncated, info | {"messages": arrived}

    def _begin(self, seed: int) -> None:
        super()._begin(seed)
        self._view = DownlinkView(self.drawings, self.cameras, self.goal)
        self._sequences = self._stops = 0

    def restore_state(self, state: EpisodeState) -> tuple[Observation, dict[str, Any]]:
        """As `MissionEnv.restore_state`; nothing has come down since."""
        observation, info = super().restore_state(state)
        return observation, info | {"messages": []}

    def _input(self, message: CommandSequence | Stop | None) -> Any:
        return self.step_message(message)

    def _observation(self) -> Observation:
        return self._view.observation(self.mission.t)

    def _taken(self) -> Moment | None:
        mission = self.mission
        try:
            robot = mission.robot.save()
        except PhysicsError:  # a hull touches something: seed and inputs have to do
            return None
        mine = (self._view, self._score, self._sequences, self._stops)
        return {"robot": mission.robot, "saved": robot, "ours": taken({"mission": vars(mission), "env": mine}, self._lasting())}

    def _put_back(self, moment: Moment | None) -> bool:
        if moment is None or moment["robot"] is not self._robot:
            return False
        self.mission.robot.restore(moment["saved"])
        ours = taken(moment["ours"], self._lasting())
        vars(self.mission).update(ours["mission"])
        self._view, self._score, self._sequences, self._stops = ours["env"]
        return True

    def _lasting(self) -> tuple[object, ...]:
        return (self.mission.robot, self.drawings)
