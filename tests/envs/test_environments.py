import inspect
import re
import subprocess
import sys
import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import envs  # noqa: F401
from athlete_twin.errors import ConfigError
from athlete_twin.messages import CommandSequence, ImageRequest, Receipt, StereoPair, Stop, Wait
from athlete_twin.model.spec import load_spec
from athlete_twin.world.injected import InjectedFault
from athlete_twin.world.scenario import load_scenario
from envs import build
from envs.env import UplinkEnv, link_pair
from envs.operator_env import OperatorEnv
from envs.rewards import RewardConfig, StepTruth, reward_terms
from envs.spaces import KINDS, NEVER, RECEIPTS, DownlinkView, downlink_space
from planner.decisions import DECISIONS, Decision, Landing, Proposal

IDS = [f"AthleteTwin/{robot}{kind}-v0" for robot in ("SdmB", "T12") for kind in ("-Mock", "", "-Operator")]
MOCKS = [name for name in IDS if "Mock" in name]
TWINS = [name for name in IDS if name not in MOCKS]


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("name", [*MOCKS, *TWINS])
def test_every_id_keeps_gymnasiums_contract(name):
    kwargs = {} if name in MOCKS else {"scenario": "calibration_yard"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Gymnasium's advice as well
        env = gym.make(name, **kwargs)
        check_env(env.unwrapped)
        observation, _ = env.reset(seed=1)
        assert env.observation_space.contains(observation)
        stepped = env.step(env.action_space.sample())[0]
        assert env.observation_space.contains(stepped)
    env.close()


@pytest.mark.parametrize("name", MOCKS)
def test_gymnasiums_contract_holds_when_messages_come_down_in_the_first_step(name):
    env = gym.make(name, link=0.0, cameras=())
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("kind", [UplinkEnv, OperatorEnv])
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_spec_sheet_names_every_field_of_both_spaces(kind, robot):
    env = kind(robot, body="mock")
    rows = [line.split("|")[1] for line in kind.__doc__.splitlines() if line.strip().startswith("| `")]
    listed = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert listed == set(env.action_space) | set(env.observation_space)


@pytest.mark.parametrize("kind", [UplinkEnv, OperatorEnv])
def test_without_cameras_no_field_speaks_of_pictures(kind, scripted):
    env = kind("sdm_b", body="mock", cameras=(), **({} if kind is UplinkEnv else {"make_agent": lambda *_: scripted()}))
    spoken = {*env.action_space, *env.observation_space} & {"cameras", "left", "right", "image_present", "image_age"}
    assert not spoken
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    for choice in range(env.action_space["kind"].n):
        observation = env.step(env.action_space.sample() | {"kind": np.int64(choice)})[0]
        assert env.observation_space.contains(observation)


def test_all_ids_are_registered():
    assert set(IDS) <= set(gym.registry)


def test_importing_envs_is_cheap():
    code = (
        "import sys, envs; heavy = {'pybullet', 'open3d', 'ompl', 'cv2', 'pinocchio', 'numba', 'scipy'} & set(sys.modules); "
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def mock_env():
    env = gym.make("envs:AthleteTwin/SdmB-Mock-v0", link=2.0, cameras=("navcam_1", "hazcam_1"), time_limit=60.0)
    yield env
    env.close()


def nothing(env):
    action = env.action_space.sample()
    action["kind"] = np.int64(KINDS.index("nothing"))
    return action


def test_a_step_ends_at_the_next_downlink_or_after_a_second(mock_env):
    _, info = mock_env.reset(seed=1)
    before = info["mission_time_s"]
    for _ in range(6):
        observation, _, _, _, info = mock_env.step(nothing(mock_env))
        assert info["mission_time_s"] - before == pytest.approx(1.0) or info["messages"]
        before = info["mission_time_s"]
    assert observation["telemetry_age"][0] > 2.0


def test_pictures_come_down_after_two_delays_and_carry_their_age(mock_env):
    observation, _ = mock_env.reset(seed=1)
    assert observation["image_present"].sum() == 0 and observation["image_age"][0] == NEVER
    action = nothing(mock_env)
    action |= {"kind": np.int64(KINDS.index("images")), "cameras": np.array([1, 0], dtype=np.int8)}
    observation, *_ = mock_env.step(action)
    t_first = None
    for _ in range(12):
        observation, _, _, _, info = mock_env.step(nothing(mock_env))
        if observation["image_present"][0] and t_first is None:
            t_first = info["mission_time_s"]
    assert t_first is not None and t_first > 4.0
    assert observation["image_age"][0] > 2.0 and observation["image_present"][1] == 0
    assert observation["left"][0].std() > 5.0 and observation["left"][1].max() == 0


def test_message_objects_go_up_whole(mock_env):
    mock_env.reset(seed=1)
    sequence = CommandSequence(
        seq=0,
        robot_id="sdm_b",
        t=0.0,
        sequence_id=7,
        commands=(Wait(duration=1.0), ImageRequest(cameras=("hazcam_1",), binning=2)),
    )
    arrived = mock_env.unwrapped.step_message(sequence)[-1]["messages"]
    for _ in range(12):
        arrived = arrived + mock_env.step(nothing(mock_env))[-1]["messages"]
    pair = next(m for m in arrived if isinstance(m, StereoPair))
    assert pair.left.shape == (384, 512) and pair.state.sequence_id == 7


def test_steps_count_on_from_a_message_of_ones_own(mock_env):
    mock_env.reset(seed=1)
    own = CommandSequence(seq=100, robot_id="sdm_b", t=0.0, sequence_id=100, commands=(Wait(duration=0.1),))
    arrived = list(mock_env.unwrapped.step_message(own)[-1]["messages"])
    action = {name: np.zeros(part.shape, part.dtype) for name, part in mock_env.action_space.items()}
    arrived += mock_env.step(action | {"kind": np.int64(KINDS.index("drive")), "drive": np.array([0.1, 0.0], np.float32)})[-1]["messages"]
    for _ in range(30):
        arrived += mock_env.step(nothing(mock_env))[-1]["messages"]
    receipts = [(m.sequence_id, m.status) for m in arrived if isinstance(m, Receipt)]
    assert (101, "queued") in receipts and not any(status == "refused" for _, status in receipts)


def test_stops_and_wild_numbers_use_up_none_of_the_sequences_count(mock_env):
    mock_env.reset(seed=0)
    stop = mock_env.action_space.sample() | {"kind": np.int64(KINDS.index("stop"))}
    for _ in range(3):
        mock_env.step(stop)
    for wild in (Stop(seq=10**6, robot_id="sdm_b", t=0.0), CommandSequence(seq=10**6, robot_id="sdm_b", t=1e6, sequence_id=7, commands=())):
        mock_env.unwrapped.step_message(wild)
    assert mock_env.unwrapped._sequences == 0 and mock_env.unwrapped._stops == 10**6 + 1


def test_going_back_to_a_saved_state_tells_that_nothing_has_come_down(mock_env):
    mock_env.reset(seed=0)
    _, info = mock_env.unwrapped.restore_state(mock_env.unwrapped.save_state())
    assert info["messages"] == []


def test_a_slot_shows_the_first_exposure_in_whatever_order_a_bracket_comes(mock_env):
    mock_env.reset(seed=1)
    look = CommandSequence(
        seq=0, robot_id="sdm_b", t=0.0, sequence_id=0,
        commands=(ImageRequest(cameras=("hazcam_1",), binning=4, brackets=(1.0, 2.0)),),
    )  # fmt: skip
    arrived = list(mock_env.unwrapped.step_message(look)[-1]["messages"])
    for _ in range(20):
        arrived += mock_env.step(nothing(mock_env))[-1]["messages"]
    first, second = (m for m in arrived if isinstance(m, StereoPair))
    assert (first.bracket, second.bracket) == (0, 1)
    seen = []
    for order in ((first, second), (second, first)):
        view = DownlinkView(load_spec("sdm_b"), ("hazcam_1",), (3.0, 0.0))
        for message in order:
            view.take(message)
        seen.append(view.observation(99.0))
    assert np.array_equal(seen[0]["left"], seen[1]["left"]) and seen[1]["image_present"].all()


def test_a_stop_reaches_the_robot(mock_env):
    mock_env.reset(seed=1)
    action = nothing(mock_env)
    action["kind"] = np.int64(KINDS.index("stop"))
    mock_env.step(action)
    for _ in range(3):
        mock_env.step(nothing(mock_env))
    assert mock_env.unwrapped.mission.robot.executive.state == "stopped"


def test_episode_is_truncated_at_the_time_limit(mock_env):
    mock_env.reset(seed=1)
    ends = [mock_env.step(nothing(mock_env))[3] for _ in range(70)]
    assert ends.index(True) >= 59


def test_same_seed_and_actions_give_the_same_observations():
    seen = []
    for _ in range(2):
        env = gym.make("AthleteTwin/SdmB-Mock-v0", link=0.5, cameras=("navcam_1",))
        env.reset(seed=4)
        env.action_space.seed(4)
        seen.append([env.step(env.action_space.sample())[0] for _ in range(15)])
        env.close()
    for a, b in zip(*seen, strict=True):
        assert all(np.array_equal(a[k], b[k]) for k in a)


@pytest.mark.parametrize(
    ("kwargs", "said"),
    [
        ({"scenario": "moon"}, "'moon' is not known"),
        ({"cameras": ("eye",)}, "'eye' is not on"),
        ({"step_s": 0.0}, "step_s is 0.0"),
        ({"time_limit": -1.0}, "time_limit is -1.0"),
        ({"render_mode": "ansi"}, "'ansi' is not one of: human, rgb_array, None"),
    ],
)
def test_wrong_arguments_are_refused(kwargs, said):
    with pytest.raises(ConfigError, match=said):
        gym.make("AthleteTwin/SdmB-Mock-v0", **kwargs)


@pytest.mark.parametrize("link", ["fast", (1.0, 2.0, 3.0), (1.0, None), True])
def test_what_is_no_link_is_refused_by_name(link):
    with pytest.raises(ConfigError, match=r"^link is .*, must be seconds one way, or \(up, down\)"):
        inspect.unwrap(link_pair)(link)  # as for a user, whose types nobody enforces


def test_a_link_may_be_two_delays():
    env = gym.make("AthleteTwin/SdmB-Mock-v0", link=(1.0, 2.5))
    env.reset(seed=0)
    env.unwrapped.step_message(Stop(seq=0, robot_id="sdm_b", t=0.0))
    assert [side.delay for side in env.unwrapped.link] == [1.0, 2.5]
    env.close()


def test_a_mock_refuses_faults_that_it_cannot_show():
    faults = (InjectedFault(kind="soft_tyre", t=9.0, leg=0, value=0.5), InjectedFault(kind="brown_out", t=5.0, value=1.0))
    broken = replace(load_scenario("calibration_yard"), faults=faults)
    says = r"scenario 'calibration_yard' injects brown_out, soft_tyre: .*mock.* id without '-Mock', or body='twin'"
    with pytest.raises(ConfigError, match=says):
        gym.make("AthleteTwin/SdmB-Mock-v0", scenario=broken)
    with pytest.raises(ConfigError, match=says):
        OperatorEnv("sdm_b", body="mock", scenario=broken)
    with pytest.raises(ConfigError, match=says):
        build.mock(load_spec("sdm_b"), broken)


def drive_ahead(env):
    action = nothing(env) | {"kind": np.int64(KINDS.index("drive")), "drive": np.array([0.25, 0.0], np.float32)}
    steps = [env.step(action), *(env.step(nothing(env)) for _ in range(3))]
    while env.unwrapped.mission.robot.busy:
        steps.append(env.step(nothing(env)))
    return [*steps, env.step(nothing(env))]


@pytest.mark.slow
@pytest.mark.ci
def test_only_progress_is_rewarded_by_default():
    env = gym.make("AthleteTwin/SdmB-Mock-v0", link=0.0, cameras=())
    _, info = env.reset(seed=0)
    begun = info["truth"]["goal_distance_m"]
    assert set(info["truth"]["reward_terms"].values()) == {0.0}
    rewards = []
    for _, reward, _, _, info in drive_ahead(env):
        terms = info["truth"]["reward_terms"]
        assert reward == sum(terms.values()) and all(v == 0.0 for k, v in terms.items() if k != "progress")
        rewards.append(reward)
    assert sum(rewards) == pytest.approx(begun - info["truth"]["goal_distance_m"]) and sum(rewards) > 0.4


def test_reward_terms_are_what_happened_times_their_weights():
    weights = RewardConfig(progress=2.0, collision_cost=3.0, tip_over_cost=5.0, goal=7.0, second_cost=11.0)
    step = StepTruth(nearer=0.5, collisions=2, seconds=0.1, tips=True, arrives=True)
    expected = {"progress": 1.0, "collision_cost": -6.0, "tip_over_cost": -5.0, "goal": 7.0, "second_cost": -1.1}
    assert reward_terms(step, weights) == pytest.approx(expected)
    assert reward_terms(step, RewardConfig()) == pytest.approx(dict.fromkeys(expected, 0.0) | {"progress": 0.5})


def test_truth_stands_in_info_under_one_key():
    env = gym.make("AthleteTwin/SdmB-Mock-v0", link=0.0, cameras=())
    _, info = env.reset(seed=0)
    _, _, _, _, later = env.step(nothing(env))
    for said in (info, later):
        assert set(said) == {"mission_time_s", "uplinks", "messages", "truth"}
        assert set(said["truth"]) == {"goal_distance_m", "at_goal", "tip_over", "collisions", "reward_terms"}


@pytest.mark.slow
@pytest.mark.ci
def test_reaching_the_goal_terminates_and_does_not_truncate():
    env = gym.make("AthleteTwin/SdmB-Mock-v0", link=0.0, cameras=(), time_limit=500.0)
    env.unwrapped.goal = (0.5, 0.0)
    env.reset(seed=0)
    steps = drive_ahead(env)
    assert [s[2:4] for s in steps[-2:]] == [(True, False)] * 2 and not any(s[2] or s[3] for s in steps[:-2])
    assert steps[-1][4]["truth"]["at_goal"]


def test_the_time_limit_truncates_and_does_not_terminate(mock_env):
    mock_env.reset(seed=0)
    ends = [mock_env.step(nothing(mock_env))[2:4] for _ in range(70)]
    assert set(ends) == {(False, False), (False, True)}


def operator_env(scripted, **kwargs):
    return OperatorEnv("sdm_b", body="mock", link=1.0, make_agent=lambda *_: scripted(), **kwargs)


def decide(env, kind, **more):
    action = env.action_space.sample() | {"kind": np.int64(DECISIONS.index(kind))} | more
    return env.step(action)


def to_proposal(env):
    for _ in range(60):
        observation, *_ = env.step_decision(None) if env.proposal is None else (None,)
        if env.proposal is not None:
            return observation
    raise AssertionError("no proposal")


@pytest.mark.slow
@pytest.mark.ci
def test_operator_env_shows_proposals_and_ends_with_arrival(scripted):
    env = operator_env(scripted, step_s=100.0)
    observation, _ = env.reset(seed=0)
    assert observation["present"] == 0
    observation = to_proposal(env)
    assert observation["present"] == 1 and observation["leg"] == 1
    assert observation["map_green"].sum() > 1000 and env.observation_space.contains(observation)
    observation, _, terminated, _, info = decide(env, "approve")
    assert terminated and info["arrived"] and not info["truth"]["at_goal"]
    env.close()


def test_operator_env_keeps_gymnasiums_contract_with_a_mock(scripted):
    env = operator_env(scripted)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env, skip_render_check=True)


def test_every_decision_reaches_the_ground(scripted):
    env = operator_env(scripted, step_s=100.0)
    env.reset(seed=0)
    to_proposal(env)
    for kind in ("reject", "edit_footfall", "choose_leg", "choose_cameras", "wait"):
        decide(env, kind, cameras=np.ones(len(env.cameras), dtype=np.int8))
        assert env.mission.agent.decided[-1] == kind
    _, _, terminated, _, _ = decide(env, "stop")
    assert terminated and env.mission.counts.e_stops == 1


def test_standing_proposal_without_an_answer_lets_time_pass(scripted):
    env = operator_env(scripted)
    env.reset(seed=0)
    to_proposal(env)
    before = env.mission.t
    env.step_decision(None)
    assert env.mission.t == pytest.approx(before + 1.0)
    assert env.mission.agent.decided == ["wait"]


def test_a_stop_before_any_proposal_ends_the_episode_once_the_robot_is_known_to_have_stopped(scripted):
    env = operator_env(scripted)
    env.reset(seed=0)
    decisions = [Decision(kind="stop"), None, None, None]
    ends = [env.step_decision(decision)[2] for decision in decisions]
    # A second of delay up and one down, and what the bytes take on the link.
    assert ends == [False, False, True, True] and env.mission.robot.executive.state == "stopped"


class InPairs:
    """The scripted ground, whose leg 4 steps together with leg 1."""

    def __init__(self, agent):
        self.agent = agent

    def __getattr__(self, name):
        return getattr(self.agent, name)

    def next(self, t):
        action = self.agent.next(t)
        if not isinstance(action, Proposal):
            return action
        return replace(action, together=(Landing(leg=3, footfall_in_world=np.array([-1.5, 0.25, 0.125])),))


def test_a_step_of_two_legs_is_shown_with_both(scripted):
    env = OperatorEnv("sdm_b", body="mock", link=0.0, step_s=100.0, make_agent=lambda *_: InPairs(scripted()))
    env.reset(seed=0)
    pair = to_proposal(env)
    assert (pair["leg"], pair["companion_leg"]) == (1, 4) and env.observation_space.contains(pair)
    np.testing.assert_array_equal(pair["companion_footfall_in_world"], np.float32([-1.5, 0.25, 0.125]))
    alone_env = operator_env(scripted, step_s=100.0)
    alone_env.reset(seed=0)
    alone = to_proposal(alone_env)
    assert alone["companion_leg"] == 0 and not alone["companion_footfall_in_world"].any()


def test_steps_longer_than_the_longest_wait_ask_again_after_it(scripted):
    env = operator_env(scripted, step_s=4000.0, time_limit=1e5)
    env.reset(seed=0)
    to_proposal(env)
    before = env.mission.t
    env.step_decision(None)
    assert env.mission.t == pytest.approx(before + 3600.0) and env.proposal is not None
    if env.cameras:  # no camera chosen is a wait too
        decide(env, "choose_cameras", cameras=np.zeros(len(env.cameras), dtype=np.int8))
        assert env.mission.t == pytest.approx(before + 7200.0)


def test_a_camera_that_the_robot_does_not_have_is_refused_and_the_proposal_still_stands(scripted):
    env = operator_env(scripted, step_s=100.0)
    env.reset(seed=0)
    to_proposal(env)
    with pytest.raises(ConfigError, match=r"camera 'hazcam_9' is not one of sdm_b's; known: .*hazcam_1"):
        env.step_decision(Decision(kind="choose_cameras", cameras=("hazcam_1", "hazcam_9")))
    assert env.proposal is not None and env.mission.agent.decided == []
    decide(env, "reject")
    assert env.mission.agent.decided == ["reject"]


def test_what_comes_late_replaces_nothing_newer_and_a_receipt_says_whose_it_is():
    spec = load_spec("sdm_b")
    view = DownlinkView(spec, ("hazcam_1",), (3.0, 0.0))
    assert view.observation(0.0)["receipt_of"] == -1.0
    common = {"robot_id": "sdm_b", "command_index": -1}
    newer = Receipt(seq=5, t=9.0, sequence_id=3, status="queued", **common)
    older = Receipt(seq=4, t=8.0, sequence_id=2, status="completed", **common)
    for message in (newer, older):
        view.take(message)
    seen = view.observation(10.0)
    assert RECEIPTS[seen["receipt"]] == "queued" and seen["receipt_of"] == 3.0
    assert downlink_space(spec, ("hazcam_1",)).contains(seen)
