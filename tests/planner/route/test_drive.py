"""Driving as the planner's choice: what cuts a drive, and that belief goes where the mock goes."""

from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.assets import named_toml, read_toml
from athlete_twin.errors import ConfigError
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.messages import Drive, Fault, LegMove, Receipt, Stop
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from planner.agent import GroundAgent
from planner.config import planner_config
from planner.decisions import Arrived, Decision, NoStep, Proposal
from planner.footfall import score_footfalls
from planner.gait.step_search import Ground
from planner.ground import plane_under
from planner.route.drive import DriveConfig, DrivePlan, NoDrive, plan_drive
from planner.route.search import Route

APPROVE = Decision(kind="approve")


def ready(robot: str, goal=(8.0, 1.0)) -> tuple[GroundAgent, MockAthlete]:
    spec = load_spec(robot)
    content = read_toml(named_toml("variants", "blind")) | {"route": "map", "driving": "on"}
    agent = GroundAgent(spec, planner_config(content, spec, name="x"), goal_in_world=np.array(goal), seed=0)
    mock = MockAthlete(spec)
    for message in mock.advance(1.0):
        agent.observe(message, 1.0)
    return agent, mock


def carry_out(agent: GroundAgent, mock: MockAthlete) -> None:
    sequence = agent.decide(APPROVE, mock.t)
    messages = mock.receive(sequence)
    while mock.busy:
        messages += mock.advance(mock.t + 1.0)
    for message in messages:
        agent.observe(message, mock.t)


def to_the_end(agent: GroundAgent, mock: MockAthlete, *, most: int) -> tuple[list[Proposal], object]:
    proposals = []
    for _ in range(most):
        action = agent.next(mock.t)
        if not isinstance(action, Proposal):
            return proposals, action
        proposals.append(action)
        carry_out(agent, mock)
    return proposals, None


@pytest.fixture(params=["sdm_b", "t12"])
def robot(request) -> str:
    return request.param


def planned(agent: GroundAgent, heights, *, length: float = 3.0, **settings) -> DrivePlan | NoDrive:
    """A drive along +x over heights that are a function of x and y."""
    ground = on(agent, heights)
    config = agent.config
    route = Route(points=np.array([[0.0, 0.0], [length, 0.0]]), modes=("drive",), seconds=(1.0,))
    return plan_drive(
        agent.kin, agent.springs, agent.belief, ground, route, route_config=config.route,
        config=replace(config.drive, **settings), step=config.step, payload_kg=0.0,
    )  # fmt: skip


def on(agent: GroundAgent, heights) -> Ground:
    flat = plane_under(agent.belief, cell=agent.config.fusion.cell)
    x, y = np.meshgrid(*flat.centres(), indexing="ij")
    grid: HeightGrid = replace(flat, heights=flat.heights + heights(x, y))
    footfalls = score_footfalls(grid, np.zeros(grid.shape), wheel_radius=agent.spec.wheel.radius, config=agent.config.footfall)
    return Ground(heights=grid, filled=grid, cautious=grid, footfalls=footfalls)


@pytest.mark.slow
def test_over_flat_ground_it_drives_to_the_goal_and_belief_goes_where_the_robot_goes(robot):
    agent, mock = ready(robot)
    proposals, end = to_the_end(agent, mock, most=6)
    assert isinstance(end, Arrived)
    assert [p.kind for p in proposals] == ["shift"] * 3
    assert all("on its wheels" in p.text for p in proposals)
    true, believed = mock.truth().world_from_hex, agent.belief.world_from_hex
    np.testing.assert_allclose(true.translation[:2], [8.0, 1.0], atol=0.01)
    np.testing.assert_allclose(believed.translation[:2], true.translation[:2], atol=0.01)
    np.testing.assert_allclose(agent.belief.contacts_in_world[:, :2], mock.truth().wheels_in_world[:, :2], atol=0.01)


def test_a_stone_in_a_wheels_track_cuts_the_drive_before_the_wheel_reaches_it(robot):
    agent, _ = ready(robot)
    wheel = agent.belief.contacts_in_world[1]
    stone = wheel[:2] + [2.0, 0.0]
    drive = planned(agent, lambda x, y: np.where(np.hypot(x - stone[0], y - stone[1]) < 0.15, 0.12, 0.0))
    assert isinstance(drive, DrivePlan)
    assert "under wheel 2 is" in drive.cut_by
    reached = float(np.linalg.norm(drive.way))
    foot = 0.15 + agent.spec.wheel.radius
    assert 2.0 - foot - 0.35 < reached < 2.0 - 0.15


def test_the_drive_ends_with_the_routes_piece_or_its_longest(robot):
    agent, _ = ready(robot)
    for length, expected in ((1.2, 1.2), (3.0, 3.0), (7.0, 3.0)):
        drive = planned(agent, lambda x, y: 0.0 * x, length=length)
        assert isinstance(drive, DrivePlan) and not drive.cut_by
        np.testing.assert_allclose(drive.way, [expected, 0.0], atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(drive.command.translation_in_hex), expected)
        assert drive.margin >= agent.config.step.stability.min_margin


def test_up_a_slope_contacts_and_chassis_follow_the_ground(robot):
    agent, _ = ready(robot)
    drive = planned(agent, lambda x, y: 0.02 * x, length=2.0)
    assert isinstance(drive, DrivePlan)
    np.testing.assert_allclose(drive.contacts_in_world[:, 2] - agent.belief.contacts_in_world[:, 2], 0.04, atol=1e-6)
    rise = drive.world_from_hex[-1].translation - drive.world_from_hex[0].translation
    np.testing.assert_allclose(rise, [2.0, 0.0, 0.04], atol=1e-6)
    np.testing.assert_allclose(drive.uneven, 0.0, atol=1e-9)


def test_a_swell_that_takes_the_load_off_a_wheel_is_not_driven_over(robot):
    """A swell of 14 cm under one wheel, gentle enough for the wheel itself: its neighbours lose their loads."""
    agent, _ = ready(robot)
    wheel = agent.belief.contacts_in_world[1] + [2.2, 0.0, 0.0]
    drive = planned(agent, lambda x, y: 0.14 * np.exp(-((x - wheel[0]) ** 2 + (y - wheel[1]) ** 2) / (2 * 0.8**2)))
    assert isinstance(drive, DrivePlan)
    assert "would carry" in drive.cut_by
    held = planned(
        agent, lambda x, y: 0.14 * np.exp(-((x - wheel[0]) ** 2 + (y - wheel[1]) ** 2) / (2 * 0.8**2)), least_load=0.0
    )
    assert isinstance(held, DrivePlan)
    assert np.linalg.norm(held.way) > np.linalg.norm(drive.way)


def test_too_short_a_stretch_and_a_leg_in_the_air_are_refused_with_the_reason(robot):
    agent, _ = ready(robot)
    short = planned(agent, lambda x, y: 0.0 * x, length=0.3)
    assert isinstance(short, NoDrive) and short.reason == "0.3 m are too short to drive"
    agent._belief = replace(agent.belief, planted=np.array([True, False, True, True, True, True]))
    assert planned(agent, lambda x, y: 0.0 * x) == NoDrive(reason="a leg is in the air")


@pytest.mark.slow
def test_a_refused_drive_is_walked(robot):
    agent, mock = ready(robot)
    assert "on its wheels" in agent.next(1.0).text
    assert agent.decide(Decision(kind="reject"), 1.0) is None
    step = agent.next(1.0)
    assert isinstance(step, Proposal) and step.kind == "step"
    carry_out(agent, mock)
    assert "on its wheels" in agent.next(mock.t).text


def test_a_drive_that_breaks_off_stops_the_ground_since_nobody_knows_where_the_robot_is(robot):
    agent, mock = ready(robot)
    agent.next(1.0)
    sent = agent.decide(APPROVE, 1.0)
    mock.receive(sent)
    for _ in range(25):
        for message in mock.advance(mock.t + 1.0):
            agent.observe(message, mock.t)
    run = mock._tell(mock.executive.brown_out())
    for message in [*run, mock._telemetry()]:
        agent.observe(message, mock.t)
    assert any(isinstance(m, Fault) for m in run)
    action = agent.next(mock.t)
    assert isinstance(action, NoStep)
    assert action.reason.startswith("a drive broke off, where the robot stands is not known")


def test_a_drive_that_is_cancelled_before_it_begins_is_proposed_again(robot):
    agent, mock = ready(robot)
    first = agent.next(mock.t)
    sent = agent.decide(APPROVE, mock.t)
    told = mock.receive(sent)
    told += mock.receive(Stop(seq=0, robot_id=robot, t=mock.t, reason="wait"))
    assert [m.status for m in told if isinstance(m, Receipt)] == ["queued", "cancelled"]
    for message in [*told, mock._telemetry()]:
        agent.observe(message, mock.t)
    again = agent.next(mock.t)
    assert isinstance(again, Proposal) and again.text == first.text


@pytest.mark.slow
def test_a_row_of_stones_is_walked_over_between_two_drives(robot, monkeypatch):
    """The believed map holds a row that the mock does not: what is asked here is the choice, not the stones."""
    agent, mock = ready(robot, goal=(9.0, 0.0))
    real = agent._ground

    def with_stones(belief):
        ground = real(belief)
        x, _ = np.meshgrid(*ground.heights.centres(), indexing="ij")
        heights = replace(ground.heights, heights=np.where(np.abs(x - 4.6) < 0.17, ground.heights.heights + 0.14, ground.heights.heights))
        footfalls = score_footfalls(
            heights, np.zeros(heights.shape), wheel_radius=agent.spec.wheel.radius, config=agent.config.footfall
        )
        return Ground(heights=heights, filled=heights, cautious=heights, footfalls=footfalls)

    monkeypatch.setattr(agent, "_ground", with_stones)
    proposals, end = to_the_end(agent, mock, most=120)
    assert isinstance(end, Arrived), end
    kinds = "".join("D" if p.kind == "shift" else "s" for p in proposals)
    assert kinds.startswith("D") and "s" in kinds and kinds.rstrip("s").endswith("D")
    driven = [c for p in proposals for c in p.sequence.commands if isinstance(c, Drive)]
    assert any(isinstance(c, LegMove) for p in proposals for c in p.sequence.commands)
    assert sum(np.linalg.norm(c.translation_in_hex) for c in driven) > 3.0
    np.testing.assert_allclose(mock.truth().world_from_hex.translation[:2], [9.0, 0.0], atol=0.2)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"shortest": 4.0}, r"are \(0.1, 4.0, 3.0\) m: must be finite, above 0 and rise"),
        ({"step": np.nan}, "must be finite"),
        ({"least_load": 1.0}, r"least_load is 1\.0, must be at least 0 and below 1"),
    ],
)
def test_settings_of_drives_out_of_bounds_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        DriveConfig(**settings)
