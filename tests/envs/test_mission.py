import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.messages import Receipt, StereoPair, Stop, Telemetry
from athlete_twin.model.kinematics import GRAVITY
from planner.decisions import Decision
from planner.underway import SILENCE

BINS = ("motion", "ground", "operator", "link")


def run(mission, *, answer="approve", seconds=0.0, until=1000.0):
    while not mission.finished and mission.t < until:
        mission.advance(min(mission.t + 1.0, until))
        if mission.wants_answer:
            mission.answer(Decision(kind=answer), seconds=seconds)
    return mission


@pytest.mark.slow
@pytest.mark.ci
def test_every_second_falls_in_one_bin(scripted, make_mission):
    m = run(make_mission(scripted(steps=2), delay=3.0), seconds=7.0)
    assert m.mission_time == pytest.approx(m.t, abs=1e-8)
    assert sum(m.seconds(b) for b in BINS) == pytest.approx(m.mission_time, abs=1e-12)
    assert m.seconds("operator") == pytest.approx(14.0)


@pytest.mark.slow
@pytest.mark.ci
def test_ground_computation_is_charged_by_the_table(scripted, make_mission):
    m = run(make_mission(scripted(steps=2), delay=3.0))
    # One pair and two plans; the pair is worked on while the robot still settles, which is motion.
    assert m.agent.ground_s == 5.0
    assert 4.0 <= m.seconds("ground") <= 5.0


@pytest.mark.slow
@pytest.mark.ci
def test_a_command_waits_two_delays_for_its_end(scripted, make_mission):
    near, far = (run(make_mission(scripted(), delay=d)) for d in (1.0, 9.0))
    assert near.seconds("motion") == pytest.approx(far.seconds("motion"), abs=0.1)
    # Two sequences up, and the last receipt of each down.
    assert far.t - near.t == pytest.approx(4 * 8.0, abs=1.0)


def test_robot_is_idle_while_only_the_link_is_awaited(scripted, make_mission):
    m = make_mission(scripted(), delay=5.0)
    m.advance(4.0)
    assert m.robot.t == 4.0 and not m.robot.busy
    assert m.seconds("link") == pytest.approx(4.0)


@pytest.mark.slow
@pytest.mark.ci
def test_ground_sees_nothing_before_the_delay_is_over(scripted, make_mission):
    agent = scripted()
    run(make_mission(agent, delay=5.0))
    assert all(t >= m.t + 5.0 for t, m in agent.seen)
    # The first words come unasked; what was asked for takes the way up as well.
    assert agent.seen[0][0] < 6.0 and agent.seen[1][0] > 10.0


@pytest.mark.slow
@pytest.mark.ci
def test_downlinks_arrive_in_the_order_made(scripted, make_mission):
    agent = scripted()
    run(make_mission(agent))
    made = [m.t for _, m in agent.seen]
    assert made == sorted(made)
    assert {type(m) for _, m in agent.seen} >= {Receipt, StereoPair, Telemetry}


@pytest.mark.slow
@pytest.mark.ci
def test_rejection_brings_a_new_proposal(scripted, make_mission):
    agent = scripted()
    m = make_mission(agent, delay=1.0)
    answers = iter(["reject", "wait", "approve"])
    while not m.finished:
        m.advance(m.t + 1.0)
        if m.wants_answer:
            kind = next(answers)
            m.answer(Decision(kind=kind, duration=20.0 if kind == "wait" else 0.0))
    assert agent.decided == ["reject", "wait", "approve"]
    assert m.counts.decisions == 3 and m.counts.rejections == 1
    assert m.seconds("operator") == pytest.approx(20.0)
    assert m.counts.uplinks == 2 and m.counts.command_cycles == 2


def test_stop_goes_up_as_a_stop(scripted, make_mission):
    m = make_mission(scripted(), delay=1.0)
    while not m.wants_answer:
        m.advance(m.t + 1.0)
    m.answer(Decision(kind="stop"))
    m.advance(m.t + 3.0)
    assert m.counts.e_stops == 1
    assert m.robot.executive.state == "stopped"


def test_a_stop_that_the_link_loses_goes_up_again_until_the_robot_has_stopped(scripted, make_mission):
    m = make_mission(scripted(), delay=1.0)
    while not m.wants_answer:
        m.advance(m.t + 1.0)
    send, lost = m.up.send, []

    def lossy(message, t):
        if isinstance(message, Stop) and len(lost) < 2:
            lost.append(t)
            return b""
        return send(message, t)

    m.up.send = lossy
    m.stop("the operator")
    m.advance(m.t + 1.5 * SILENCE)
    assert len(lost) == 2 and m.robot.executive.state != "stopped"
    m.advance(m.t + SILENCE)
    assert m.robot.executive.state == "stopped"
    assert lost[1] - lost[0] == pytest.approx(SILENCE)
    uplinks = m.counts.uplinks
    m.advance(m.t + 3.0 * SILENCE)
    assert (m.counts.uplinks, m.counts.e_stops) == (uplinks, 1)


def test_answer_without_a_proposal_is_refused(make_mission):
    with pytest.raises(ConfigError, match="answers no proposal"):
        make_mission(None).answer(Decision(kind="approve"))


@pytest.mark.slow
def test_same_mission_twice_ends_at_the_same_time(scripted, make_mission):
    first, second = (run(make_mission(scripted())) for _ in range(2))
    assert first.t == second.t
    a, b = first.robot.truth(), second.robot.truth()
    assert np.array_equal(a.joints, b.joints) and np.array_equal(a.world_from_hex.matrix(), b.world_from_hex.matrix())


@pytest.mark.slow
@pytest.mark.ci
def test_mock_keeps_its_weight(scripted, make_mission):
    m = run(make_mission(scripted()))
    assert m.robot.truth().wheel_loads.sum() == pytest.approx(m.robot.spec.mass * GRAVITY, rel=1e-6)
