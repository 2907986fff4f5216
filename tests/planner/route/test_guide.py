"""Headings beside the route: which, in what order, for how long, and what is said when none gives a step."""

from collections import Counter

import numpy as np
import pytest

import planner.agent
from athlete_twin.assets import named_toml, read_toml
from athlete_twin.errors import ConfigError, PlanningError
from athlete_twin.mock import MockAthlete
from athlete_twin.model.spec import load_spec
from planner.agent import GroundAgent
from planner.config import planner_config
from planner.decisions import Decision, NoStep, Proposal
from planner.gait.step_search import search_step
from planner.route.guide import Guide, HeadingConfig, Way, refusals, turned, unit
from planner.route.search import Route

ASIDE = [0.0, 20.0, -20.0, 40.0, -40.0, 60.0, -60.0]


@pytest.fixture(params=["straight", "map"])
def agent(request) -> GroundAgent:
    spec = load_spec("sdm_b")
    content = read_toml(named_toml("variants", "blind")) | {"route": request.param, "settings": {"aside": {"between_steps": 0}}}
    ground = GroundAgent(spec, planner_config(content, spec, name="x"), goal_in_world=np.array([30.0, 0.0]), seed=0)
    for message in MockAthlete(spec).advance(1.0):
        ground.observe(message, 1.0)
    return ground


def ways(agent: GroundAgent) -> list[Way]:
    return agent.guide.ways(agent.belief, agent._ground(agent.belief))


def test_the_routes_heading_comes_first_and_then_the_nearest_to_it(agent):
    found = ways(agent)
    np.testing.assert_allclose(np.rad2deg([w.aside for w in found]), ASIDE, atol=1e-9)
    for way in found:
        np.testing.assert_allclose(np.arctan2(way.heading[1], way.heading[0]), way.aside, atol=1e-6)
        assert way.remaining == pytest.approx(30.0, abs=1e-6)
    assert isinstance(agent.guide.route, Route) == (agent.config.route_method == "map")


def test_a_heading_aside_that_gave_a_step_is_kept_for_a_cycle(agent):
    agent.guide.took(ways(agent)[2])
    for _ in range(5):
        kept = ways(agent)
        np.testing.assert_allclose(np.rad2deg([w.aside for w in kept[:3]]), [-20.0, 0.0, 20.0])
        agent.guide.took(kept[0])
    assert ways(agent)[0].aside == 0.0


def test_the_step_is_taken_on_the_nearest_heading_that_gives_one(agent, monkeypatch):
    asked = []

    def only_aside(kin, springs, belief, ground, request, **rest):
        asked.append(round(np.rad2deg(np.arctan2(request.heading[1], request.heading[0]))))
        if abs(asked[-1]) < 40:
            return NoStep(reason=f"leg {request.leg + 1} is asked to refuse", refused={"test": 1})
        return search_step(kin, springs, belief, ground, request, **rest)

    monkeypatch.setattr(planner.agent, "search_step", only_aside)
    action = agent.next(1.0)
    assert isinstance(action, Proposal)
    assert list(dict.fromkeys(asked)) == [0, 20, -20, 40]
    assert agent.decide(Decision(kind="approve"), 1.0).commands


def test_when_no_heading_gives_a_step_each_is_named_with_what_refused_it(agent, monkeypatch):
    def never(kin, springs, belief, ground, request, **rest):
        ahead = abs(request.heading[1]) < 1e-9
        return NoStep(reason=f"leg {request.leg + 1} may not" + (" at all" if ahead else ""), refused={"test": 2})

    monkeypatch.setattr(planner.agent, "search_step", never)
    action = agent.next(1.0)
    assert isinstance(action, NoStep)
    for angle in ASIDE:
        (told,) = (part for part in action.reason.split(" | ") if part.startswith(f"{angle:+.0f} deg: "))
        assert set(told.split(": ")[1].split("; ")) == {f"leg {n} may not" + (" at all" if angle == 0 else "") for n in range(1, 7)}
    # Straight ahead every leg is tried near its place and farther away.
    assert action.refused == {"test": 2 * 6 * (len(ASIDE) + 1)}


def test_what_is_the_same_on_all_headings_is_said_once():
    ways = [Way(heading=np.array([1.0, 0.0]), aside=a, remaining=1.0) for a in (0.0, 0.3)]
    assert refusals([(way, "a", Counter(x=1)) for way in ways]) == ("a (the same on 2 headings)", Counter(x=2))


def test_one_heading_alone_is_not_named():
    way = Way(heading=np.array([1.0, 0.0]), aside=0.0, remaining=1.0)
    text, total = refusals([(way, "a", Counter(x=1)), (way, "a", Counter(x=2)), (way, "b", Counter(y=1))])
    assert text == "a; b"
    assert total == {"x": 3, "y": 1}


def test_turned_turns_to_the_left_and_directions_without_length_are_refused():
    np.testing.assert_allclose(turned(np.array([1.0, 0.0]), np.pi / 2), [0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(unit(np.array([3.0, 4.0])), [0.6, 0.8])
    for way in ([0.0, 0.0], [np.nan, 1.0]):
        with pytest.raises(PlanningError, match="has no length"):
            unit(np.array(way))


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"aside_deg": (0.0,)}, r"aside_deg is \(0.0,\), need angles above 0"),
        ({"aside_deg": tuple(map(float, range(1, 9)))}, "aside_deg has 8 angles, at most 6"),
        ({"steps_aside": 0}, "steps_aside is 0, must be at least 1"),
    ],
)
def test_headings_out_of_bounds_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        HeadingConfig(**settings)


def test_unknown_routes_are_refused():
    spec = load_spec("sdm_b")
    content = read_toml(named_toml("variants", "blind"))
    with pytest.raises(ConfigError, match="route = 'mop' is not one of straight, map"):
        planner_config(content | {"route": "mop"}, spec, name="x")
    config = planner_config(content, spec, name="x")
    with pytest.raises(ConfigError, match="route 'by air' is not one of"):
        Guide(spec, np.ones(2), method="by air", driving=False, config=config.route, headings=config.headings, typical_terrain=1.0)
