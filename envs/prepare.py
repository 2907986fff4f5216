"""Puts a trial together, from names or from a recording: robot, ground, operator, links and what is told of their origin."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from athlete_twin.assets import named_toml, robot_dir
from athlete_twin.errors import ConfigError
from athlete_twin.link import LinkConfig
from athlete_twin.model.spec import load_spec
from athlete_twin.world.scenario import Scenario, load_scenario, scenario_from_content
from envs.build import check_payload, ground_agent, mock, twin
from envs.mask_score import MaskScore
from envs.origin import BODIES, Origin, origin_of
from envs.stage_times import StageTimes
from envs.trial import Trial, TrialSetup, usable_folder
from envs.variants import TomlVariant, variant_named
from planner.decisions import Operator
from planner.eyes import Look
from planner.operators import scripted_operator

OPERATOR_STREAM = 7003
"""of a scripted operator's generator, beside the seed"""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """A trial by the names of its parts."""

    robot: str
    scenario: str
    """name, or a path ending in .toml"""
    variant: str
    """one of the names that `envs.variants` tells of"""
    seed: int
    operator: str
    """name; one that is no script must be handed in"""
    up: LinkConfig
    down: LinkConfig
    cycles: int | None = None
    """the scenario's own when None"""
    time_limit: float | None = None
    """the scenario's own when None [s]"""
    payload_kg: float = 0.0
    body: str = "twin"
    """"twin", or "mock" without physics on flat ground"""


def prepared(wanted: Wanted, out: Path, *, operator: Operator | None = None) -> Trial:
    """A trial ready to run; everything that can be refused is refused here.

    Args:
        wanted: its parts.
        out: folder for its files, made if need be.
        operator: in place of the scripted one of that name.
    """
    scenario = load_scenario(wanted.scenario)
    setup = TrialSetup(
        robot=wanted.robot,
        scenario=wanted.scenario,
        variant=wanted.variant,
        seed=wanted.seed,
        operator=wanted.operator,
        up=wanted.up,
        down=wanted.down,
        goal=(scenario.goal_distance, 0.0),
        cycles=scenario.cycles if wanted.cycles is None else wanted.cycles,
        time_limit=scenario.time_limit if wanted.time_limit is None else wanted.time_limit,
        payload_kg=wanted.payload_kg,
    )
    if wanted.body not in BODIES:
        raise ConfigError(f"body {wanted.body!r} is not one of {', '.join(BODIES)}")
    operator = operator or operator_named(wanted.operator, wanted.seed)
    variant = variant_named(wanted.variant)
    load_spec(wanted.robot)
    origin = origin_of(
        setup, body=wanted.body, scenario=named_toml("scenarios", wanted.scenario), variant=variant, map_file=scenario.file
    )
    named = str(variant.path) if isinstance(variant, TomlVariant) else wanted.variant
    return _joined(origin, scenario, named, operator, out)


def again(origin: Origin, out: Path, *, operator: Operator | None = None) -> Trial:
    """A recorded trial, ready to run once more.

    Args:
        origin: of the recording.
        out: folder for the new files, made if need be.
        operator: who answers as the recording's did, where that was no script.
    """
    scenario = scenario_again(origin)
    out = usable_folder(out)
    variant = origin.planner
    if not variant:
        file = out / Path(origin.variant_path).name
        file.write_text(origin.variant_toml)
        variant = str(file)
    operator = operator or operator_named(origin.setup.operator, origin.setup.seed)
    return _joined(origin, scenario, variant, operator, out)


def scenario_again(origin: Origin) -> Scenario:
    """The scenario from the text that was recorded."""
    return scenario_from_content(tomllib.loads(origin.scenario_toml), Path(origin.scenario_path))


def operator_named(name: str, seed: int) -> Operator:
    """The scripted operator of a trial with this seed."""
    return scripted_operator(name, rng=np.random.default_rng([max(seed, 0), OPERATOR_STREAM]))


def _joined(origin: Origin, scenario: Scenario, variant: str, operator: Operator, out: Path) -> Trial:
    setup, timer, mask_score = origin.setup, StageTimes(), MaskScore()
    spec = load_spec(setup.robot)
    check_payload(spec, setup.payload_kg)

    def looked(look: Look) -> None:
        mask_score.looked(look)
        trial.looked(look)

    agent = ground_agent(
        spec, variant, goal=setup.goal, seed=setup.seed, payload_kg=setup.payload_kg, timer=timer, on_look=looked
    )
    out = usable_folder(out)
    with timer("set_up"):
        if origin.body == "mock":
            robot, grid = mock(spec, scenario)
        else:
            robot, grid = twin(spec, scenario, setup.seed, payload_kg=setup.payload_kg)
    robot.on_view = mask_score.saw
    trial = Trial(
        setup=setup, spec=spec, robot=robot, agent=agent, operator=operator, grid=grid, out=out, timer=timer,
        mask_score=mask_score, origin=origin.metadata(), urdf=(robot_dir(setup.robot) / "robot.urdf").read_bytes(),
    )  # fmt: skip
    return trial
