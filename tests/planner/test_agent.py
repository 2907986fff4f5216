"""The ground agent between its proposals: what it does when an operator or the link does the unexpected."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.errors import ConfigError, PlanningError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BodyMove, CommandSequence, Fault, ImageRequest, Receipt, Stop
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from planner.agent import GroundAgent
from planner.config import planner_config
from planner.decisions import Decision, NoStep, Proposal, Uplink, Waiting
from planner.gait.step_plan import BodyShift
from planner.gait.step_search import search_step
from planner.ground import flat_ground
from planner.underway import SILENCE

APPROVE = Decision(kind="approve")


@pytest.fixture(params=["sdm_b", "t12"])
def agent(request) -> GroundAgent:
    """A ground that has heard one telemetry of a standing robot."""
    spec = load_spec(request.param)
    config = planner_config(read_toml(named_toml("variants", "blind")), spec, name="blind")
    ground = GroundAgent(spec, config, goal_in_world=np.array([3.0, 0.0]), seed=0)
    for message in MockAthlete(spec).advance(1.0):
        ground.observe(message, 1.0)
    return ground


def proposal(agent: GroundAgent, t: float) -> Proposal:
    action = agent.next(t)
    assert isinstance(action, Proposal), action
    return action


def receipt(sequence: CommandSequence, status: str) -> Receipt:
    return Receipt(
        seq=10 * sequence.sequence_id + len(status), robot_id=sequence.robot_id, t=2.0, sequence_id=sequence.sequence_id,
        command_index=-1, status=status,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.ci
def test_unknown_cameras_are_refused_before_anything_goes_up(agent):
    first = proposal(agent, 1.0)
    known = [camera.name for camera in agent.spec.cameras]
    with pytest.raises(ConfigError, match=f"camera 'eye_9' is not one of {agent.spec.name}'s; known: {', '.join(known)}"):
        agent.decide(Decision(kind="choose_cameras", cameras=(known[0], "eye_9")), 2.0)
    assert proposal(agent, 2.0) is first
    sent = agent.decide(Decision(kind="choose_cameras", cameras=(known[0],)), 3.0)
    assert sent.sequence_id == first.sequence.sequence_id + 1 and sent.commands[0].cameras == (known[0],)


@pytest.mark.parametrize("code", ["ratchet_slip", "gremlins"])
@pytest.mark.slow
def test_after_a_fault_without_a_remedy_of_its_own_the_ground_goes_on_or_says_why_not(agent, code):
    """Torques of a leg whose gear slipped are wrong by a tooth: what stands is misjudged, and nothing may break by it."""
    first = proposal(agent, 1.0)
    for sent_at in (1.0, 11.0):
        sent = agent.decide(APPROVE, sent_at)
        number, t = sent.sequence_id, sent_at + 5.0
        fault = Fault(
            seq=int(t), robot_id=sent.robot_id, t=t, code=code, text="gear", sequence_id=number, command_index=0, leg=first.leg
        )
        torques = agent._telemetry.torques.copy()
        torques[first.leg, 1] += 700.0
        told = replace(agent._telemetry, seq=agent._telemetry.seq + 1, t=t, torques=torques, executive_state="fault", sequence_id=number)
        for message in (fault, receipt(sent, "failed"), told):
            agent.observe(message, t)
        action = agent.next(t)
        assert isinstance(action, Proposal | NoStep), action
        if isinstance(action, NoStep):
            assert action.reason
            return


@pytest.mark.slow
@pytest.mark.ci
def test_an_edit_that_does_not_work_comes_back_as_the_gaits_own_step_with_the_reason(agent):
    own = proposal(agent, 1.0)
    far = Decision(kind="edit_footfall", footfall_in_world=np.array([7.0, 7.0, 0.0]))
    assert agent.decide(far, 1.0) is None
    again = proposal(agent, 2.0)
    assert again.leg == own.leg
    np.testing.assert_allclose(again.footfall_in_world, own.footfall_in_world)
    assert "not at (7.00, 7.00) m: " in again.text
    sequence = agent.decide(APPROVE, 3.0)
    assert sequence is not None and sequence.commands


def test_a_place_that_only_another_leg_reaches_is_no_footfall_of_that_one(agent):
    """The operator moved one leg's footfall, and asked for no step of any other."""
    own = proposal(agent, 1.0)
    other = (own.leg + 3) % 6
    place = agent.belief.contacts_in_world[other] + [0.3, 0.0, 0.0]
    assert agent.decide(Decision(kind="edit_footfall", footfall_in_world=place), 1.0) is None
    again = proposal(agent, 2.0)
    assert again.leg == own.leg and "not at" in again.text
    np.testing.assert_allclose(again.footfall_in_world, own.footfall_in_world)


def test_a_sequence_of_which_nothing_is_heard_goes_up_again_as_it_was(agent):
    proposal(agent, 1.0)
    sent = agent.decide(APPROVE, 1.0)
    assert isinstance(agent.next(1.0 + SILENCE - 0.1), Waiting)
    again = agent.next(1.0 + SILENCE + 0.1)
    assert isinstance(again, Uplink) and again.sequence is sent
    assert isinstance(agent.next(1.0 + SILENCE + 5.0), Waiting)
    agent.observe(receipt(sent, "queued"), 80.0)
    assert isinstance(agent.next(80.0 + SILENCE - 1.0), Waiting)
    assert isinstance(agent.next(80.0 + SILENCE + 1.0), Uplink)


def test_pictures_without_ground_beside_the_wheels_are_no_measurement_of_their_depth(agent, monkeypatch):
    told = [None, 0.02]
    monkeypatch.setattr(agent.eyes, "level", lambda _belief: told.pop(0))
    before = agent.belief.world_from_hex.translation[2]
    variance = agent._filter._sink_variance
    agent._level(agent.belief, agent._telemetry)
    assert agent._filter._sink_variance == variance and agent.belief.world_from_hex.translation[2] == before
    assert not agent._levelled
    agent._level(agent.belief, agent._telemetry)
    assert agent._levelled and agent._filter._sink_variance < variance
    assert 0.0 < before - agent.belief.world_from_hex.translation[2] < 0.02


def test_every_exposure_of_a_bracket_is_awaited(agent):
    proposal(agent, 1.0)
    look = ImageRequest(cameras=("a", "b"), brackets=(0.5, 1.0, 4.0))
    agent._send(agent._proposer.sequence([look], 1.0), None)
    assert agent._sent.pairs_awaited == 6


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.slow
@pytest.mark.ci
def test_a_leg_that_hides_the_ground_it_needs_is_lifted_to_look_once_where_it_stands(robot, monkeypatch):
    spec = load_spec(robot)
    config = planner_config(read_toml(named_toml("variants", "integrated")), spec, name="integrated")
    agent = GroundAgent(spec, config, goal_in_world=np.array([3.0, 0.0]), seed=0)
    for message in MockAthlete(spec).advance(1.0):
        agent.observe(message, 1.0)
    agent._surveyed = True
    ground = flat_ground(agent.belief, config, wheel_radius=spec.wheel.radius)
    monkeypatch.setattr(agent, "_ground", lambda _: ground)

    def search(*args, **settings):
        """Leg 3 hides most of what it needs, leg 5 some; no leg finds a step."""
        request = args[4]
        if request.on_the_spot:
            return search_step(*args, **settings)
        return NoStep(reason="hidden", refused={"unknown": {2: 40, 4: 7}.get(request.leg, 0), "rough": 3})

    monkeypatch.setattr("planner.agent.search_step", search)
    for leg in (2, 4):
        look = agent.next(1.0)
        assert isinstance(look, Proposal) and look.leg == leg and "pictures of what it hid" in look.text
        sent = agent.decide(APPROVE, 1.0)
        lift, pictures = sent.commands[0], sent.commands[-1]
        assert lift.guard == "break_contact" and isinstance(pictures, ImageRequest) and pictures.cameras
        agent._sent = None  # as if it had come down again, and nothing been seen
    none = agent.next(1.0)
    assert isinstance(none, NoStep) and none.reason.startswith("hidden")


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.parametrize("stopped", [2, 3, 4], ids=["unswung", "one swung", "both swung"])
@pytest.mark.slow
def test_two_legs_that_a_stop_leaves_in_the_air_come_down_one_after_the_other(robot, stopped):
    """Neither steps twice, the chassis stays until both stand, and then the walk goes on."""
    spec = load_spec(robot)
    content = read_toml(named_toml("variants", "blind")) | {"gait": "opposite_pairs"}
    agent = GroundAgent(spec, planner_config(content, spec, name="pairs"), goal_in_world=np.array([3.0, 0.0]), seed=0)
    mock = MockAthlete(spec)
    t = 1.0
    for message in mock.advance(t):
        agent.observe(message, t)
    together = proposal(agent, t)
    pair = [together.leg, *(landing.leg for landing in together.together)]
    assert len(pair) == 2

    def sends(message) -> None:
        for answer in mock.receive(message):
            agent.observe(answer, t)

    sends(agent.decide(APPROVE, t))
    stop, landed = Stop(seq=1, robot_id=spec.name, t=t, reason="test"), []
    while len(landed) < 2:
        t += 0.25
        for message in mock.advance(t):
            agent.observe(message, t)
        if stop is not None and mock.executive.command_index == stopped:
            sends(replace(stop, t=t))
            stop = None
        action = agent.next(t)
        if not isinstance(action, Proposal):
            assert isinstance(action, Waiting), action
            continue
        assert action.kind == "step" and not action.together and action.leg in pair, action.text
        assert (~agent.belief.planted).sum() == 2 - len(landed)
        commands = agent.decide(APPROVE, t)
        moves = [c for c in commands.commands if isinstance(c, BodyMove)]
        assert not moves or len(landed) == 1
        landed.append(action.leg)
        sends(commands)
        while mock.busy:
            t += 0.25
            for message in mock.advance(t):
                agent.observe(message, t)
    assert sorted(landed) == sorted(pair)
    following = agent.next(t)
    assert isinstance(following, Proposal) and following.together and agent.belief.planted.all()
    assert following.leg not in pair


@pytest.fixture(params=["sdm_b", "t12"])
def pairs(request) -> GroundAgent:
    """A ground that steps two legs at once, its first pair sent."""
    spec = load_spec(request.param)
    content = read_toml(named_toml("variants", "blind")) | {"gait": "opposite_pairs"}
    ground = GroundAgent(spec, planner_config(content, spec, name="pairs"), goal_in_world=np.array([3.0, 0.0]), seed=0)
    for message in MockAthlete(spec).advance(1.0):
        ground.observe(message, 1.0)
    assert proposal(ground, 1.0).together
    ground.decide(APPROVE, 1.0)
    return ground


def breaks_off(agent: GroundAgent, code: str, index: int) -> None:
    """The sequence under way ends with a fault of its command `index`, those before it completed; all wheels bear as at first."""
    sent = agent._sent
    fault = Fault(
        seq=1, robot_id=agent.spec.name, t=50.0, code=code, text="test", sequence_id=sent.sequence.sequence_id, command_index=index,
        leg=getattr(sent.sequence.commands[index], "leg", -1) if index < len(sent.sequence.commands) else -1,
    )  # fmt: skip
    told = replace(
        agent._telemetry, seq=agent._telemetry.seq + 1, t=50.0, executive_state="fault", sequence_id=sent.sequence.sequence_id,
        command_index=index,
    )  # fmt: skip
    for message in (fault, replace(receipt(sent.sequence, "failed"), t=50.0, command_index=index), told):
        agent.observe(message, 50.0)
    agent._digest(sent)


@pytest.mark.slow
@pytest.mark.ci
def test_a_fault_after_the_last_command_is_no_legs_and_both_steps_count(pairs):
    legs = [part.leg for part in pairs._sent.plan.parts]
    breaks_off(pairs, "torque_limit", len(pairs._sent.sequence.commands))
    assert pairs.belief.planted.all() and pairs._forced_leg is None
    assert sorted(leg for leg in range(6) if pairs.stepped[leg]) == sorted(legs)


@pytest.mark.parametrize("works", [True, False])
def test_a_leg_that_would_go_further_down_steps_where_the_operator_says_or_tells_that_it_cannot(agent, monkeypatch, works):
    """And the place is forgotten with that: no later step of another leg is told of it."""
    own = proposal(agent, 1.0)
    sequence = agent.decide(APPROVE, 1.0)
    monkeypatch.setattr("planner.agent.stands", lambda *_: False)
    breaks_off(agent, "no_contact", next(i for i, c in enumerate(sequence.commands) if getattr(c, "lands", False)))
    lower = proposal(agent, 60.0)
    assert lower.leg == own.leg and "further down" in lower.text
    place = own.footfall_in_world + ([-0.1, 0.0, 0.0] if works else [5.0, 0.0, 0.0])
    assert agent.decide(Decision(kind="edit_footfall", footfall_in_world=place), 61.0) is None
    again = proposal(agent, 62.0)
    assert again.leg == own.leg and agent._forced_xy is None
    if works:
        assert "further down" not in again.text and np.linalg.norm((again.footfall_in_world - place)[:2]) < 0.1
    else:
        assert "further down" in again.text and f"not at ({place[0]:.2f}, {place[1]:.2f}) m: " in again.text


@pytest.mark.slow
@pytest.mark.ci
def test_a_second_leg_that_finds_no_ground_goes_down_alone_and_the_first_counts_once(pairs, monkeypatch):
    first, second = (part.leg for part in pairs._sent.plan.parts)
    monkeypatch.setattr("planner.agent.stands", lambda *_: False)
    breaks_off(pairs, "no_contact", 5)
    assert pairs.stepped[first] == 1 and pairs.stepped[second] == 0
    assert np.flatnonzero(~pairs.belief.planted).tolist() == [second]
    lower = proposal(pairs, 60.0)
    assert lower.leg == second and not lower.together and "further down" in lower.text
    # Who does not want that gets another footfall of the same leg, not the same proposal for ever.
    assert pairs.decide(Decision(kind="reject"), 60.0) is None
    other = pairs.next(61.0)
    assert isinstance(other, Proposal | NoStep), other
    if isinstance(other, Proposal):
        assert other.leg == second and "further down" not in other.text


@pytest.mark.slow
def test_a_first_leg_that_finds_no_ground_is_lowered_while_the_other_hangs(pairs, monkeypatch):
    first, _ = (part.leg for part in pairs._sent.plan.parts)
    monkeypatch.setattr("planner.agent.stands", lambda *_: False)
    breaks_off(pairs, "no_contact", 4)
    assert not pairs.stepped
    lower = proposal(pairs, 60.0)
    assert lower.leg == first and not lower.together
    assert [part.leg for part in pairs._offer.plan.parts] == [first]


@pytest.mark.slow
def test_a_leg_that_stands_after_its_fault_is_not_pressed_down_while_the_other_hangs(pairs, monkeypatch):
    _, second = (part.leg for part in pairs._sent.plan.parts)
    monkeypatch.setattr("planner.agent.stands", lambda *_: True)
    breaks_off(pairs, "no_contact", 4)
    assert np.flatnonzero(~pairs.belief.planted).tolist() == [second]
    following = pairs.next(60.0)
    assert isinstance(following, Proposal | NoStep) and getattr(following, "leg", second) == second


@pytest.mark.parametrize("goal", [np.array([np.nan, 0.0]), np.array([3.0, np.inf])])
def test_a_goal_that_is_nowhere_is_refused(goal):
    spec = load_spec("sdm_b")
    config = planner_config(read_toml(named_toml("variants", "blind")), spec, name="blind")
    with pytest.raises(PlanningError, match="must be two finite numbers"):
        GroundAgent(spec, config, goal_in_world=goal, seed=0)


def test_a_shift_that_breaks_off_has_swayed_as_far_as_it_went(agent):
    before = agent.belief
    way, sway = np.array([0.20, 0.06, 0.02]), np.array([0.0, 0.06, 0.02])
    shift = replace(BodyShift.none(), translation_in_hex=way, sway_in_hex=sway)
    for share in (0.0, 0.4, 1.0):
        gone = SE3(before.world_from_hex.rotation, before.world_from_hex.translation + share * before.world_from_hex.rotate(way))
        swayed = shift.swayed_so_far(before.world_from_hex, gone)
        assert swayed == pytest.approx(share * before.world_from_hex.rotate(sway), abs=1e-9)
