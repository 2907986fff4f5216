"""What planner variants are compared on: a frozen list of cases, each a robot on a seeded field at a delay, and their hash.

Results compare where the hash is the same. It covers every case and the whole text of every scenario used, and a suite's file says
what it was when the suite was frozen: a suite whose scenarios were changed since is refused, not run.

    name = "small"
    description = "..."

    [[fields]]
    robots = ["sdm_b", "t12"]
    scenario = "suite_k010"
    seeds = "50:63"            # as in Python: 50 to 62; or "50, 57", or [50, 57]
    delays = [5.0]             # one way [s]
    cycles = 1                 # optional, as time_limit: the scenario's own when not given

    [frozen]
    suite = "<sha256>"
    suite_k010 = "<sha256 of the scenario>"
"""

from __future__ import annotations

import difflib
import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from athlete_twin.assets import named_toml, read_toml, robot_dir
from athlete_twin.errors import ConfigError, LinkError
from athlete_twin.link import downlink
from athlete_twin.world.scenario import Scenario, load_scenario

FORMAT = 1
"""of what is hashed"""
GOLDEN = 0.5 * (5.0**0.5 - 1.0)
OPERATOR = "approve_all"
"""who decides in every case: whoever is compared to a planner must not be another operator"""
MOST_SEEDS = 100_000
_TOP = ("name", "description", "fields", "frozen")
_FIELDS = ("robots", "scenario", "seeds", "delays", "cycles", "time_limit")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One trial less its variant. Trials of one case are a pair."""

    robot: str
    scenario: str
    """name, or a path ending in .toml"""
    seed: int
    delay: float
    """one way, on each link [s]"""
    cycles: int
    """the trial ends after so many gait cycles"""
    time_limit: float
    """mission time [s]"""
    capped: bool
    """whether `cycles` are fewer than the scenario's own"""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigError(f"seed is {self.seed}, must be 0 or more")
        if self.cycles < 1:
            raise ConfigError(f"cycles is {self.cycles}, must be 1 or more")
        if not self.time_limit > 0.0:
            raise ConfigError(f"time limit is {self.time_limit} s, must be positive")
        downlink(self.delay)

    @property
    def id(self) -> str:
        """Robot, scenario, seed and delay in one word that a folder may bear."""
        return f"{self.robot}-{Path(self.scenario).stem}-{self.seed}-{self.delay:g}"


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Cases in the order in which they are named."""

    name: str
    description: str
    cases: tuple[Case, ...]
    scenarios: Mapping[str, str]
    """sha256 of each scenario's text, and of the measured map it names, by the scenario's name"""

    def __post_init__(self) -> None:
        if not self.cases:
            raise ConfigError(f"suite {self.name}: it has no cases; name robots, scenarios, seeds and delays")
        seen: set[str] = set()
        for case in self.cases:
            if case.id in seen:
                raise ConfigError(f"suite {self.name}: {case.id} is there twice; name each robot, scenario, seed and delay once")
            seen.add(case.id)

    @property
    def sha256(self) -> str:
        """Over robots, seeds, delays, cycles, time limits and the text of every scenario; not over the order or the suite's name."""
        cases = sorted([c.robot, Path(c.scenario).stem, c.seed, c.delay, c.cycles, c.time_limit] for c in self.cases)
        content = {"format": FORMAT, "operator": OPERATOR, "cases": cases, "scenarios": dict(sorted(self.scenarios.items()))}
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def of_robots(self, robots: Sequence[str]) -> tuple[Case, ...]:
        """Its cases for these robots, all of them when none is named; however many of the first are run, each kind has its share."""
        known = sorted({case.robot for case in self.cases})
        for robot in robots:
            if robot not in known:
                raise ConfigError(f"suite {self.name} has no cases for robot {robot!r}{did_you_mean(robot, known)}")
        return _spread([c for c in self.cases if not robots or c.robot in robots])


def _spread(cases: Sequence[Case]) -> tuple[Case, ...]:
    """The cases in an order in which the first so many of them have their share of every robot, scenario and delay.

    A field is walked at all its delays before the next. Fields of a kind lie at even distances on a line, the first of each kind
    at a place of its own (systematic sampling; multiples of the golden ratio, lest kinds with few fields come all at once).
    """
    delays: dict[tuple[str, str, int], tuple[float, ...]] = {}
    for c in cases:
        delays[c.robot, c.scenario, c.seed] = (*delays.get((c.robot, c.scenario, c.seed), ()), c.delay)
    kinds: dict[tuple[str, str, tuple[float, ...]], list[int]] = {}
    for (robot, scenario, seed), swept in delays.items():
        kinds.setdefault((robot, scenario, swept), []).append(seed)
    place, among = {}, Counter[tuple[str, tuple[float, ...]]]()
    for (robot, scenario, swept), seeds in kinds.items():
        start = (0.5 + GOLDEN * among[robot, swept]) % 1.0
        among[robot, swept] += 1
        for rank, seed in enumerate(seeds):
            place[robot, scenario, seed] = (rank + start) / len(seeds)
    return tuple(sorted(cases, key=lambda c: place[c.robot, c.scenario, c.seed]))


def load_suite(name_or_path: str) -> Suite:
    """A suite by its name in the assets or by a path ending in .toml; refused where it is not what was frozen.

    One of the assets must say what it was frozen as; one of a path may.
    """
    path = named_toml("suites", name_or_path)
    suite, content = unfrozen_suite(path), read_toml(path)
    if "frozen" in content or not name_or_path.endswith(".toml"):
        _check_frozen(suite, content.get("frozen", {}), path)
    return suite


def unfrozen_suite(path: Path) -> Suite:
    """The suite that a file says, whatever it was frozen as."""
    return _suite_from_content(read_toml(path), path)


def suite_of(
    *,
    robots: Sequence[str],
    scenarios: Sequence[str],
    seeds: Sequence[int],
    delays: Sequence[float],
    cycles: int | None = None,
    time_limit: float | None = None,
) -> Suite:
    """Every robot in every scenario with every seed at every delay, without a name of its own.

    Args:
        robots: their names.
        scenarios: names, or paths ending in .toml.
        seeds: of the fields.
        delays: one way [s].
        cycles: gait cycles after which a trial ends; the scenario's own when None.
        time_limit: mission time [s]; the scenario's own when None.
    """
    loaded = {name: load_scenario(name) for name in scenarios}
    stems = [Path(name).stem for name in scenarios]
    for stem in stems:
        if stems.count(stem) > 1:
            raise ConfigError(f"scenarios {', '.join(map(str, scenarios))}: {stem} is there twice; each needs a file name of its own")
    # All variants and robots on one field before the next: what is stopped early holds whole pairs.
    cases = [
        _case(robot, name, loaded[name], seed=seed, delay=delay, cycles=cycles, time_limit=time_limit)
        for seed in seeds
        for name in scenarios
        for delay in delays
        for robot in robots
    ]
    hashes = {Path(name).stem: scenario_sha256(name, scenario) for name, scenario in loaded.items()}
    return Suite(name="ad hoc", description="", cases=tuple(cases), scenarios=MappingProxyType(hashes))


def scenario_sha256(name: str, scenario: Scenario) -> str:
    """Hash over the text of a scenario, named so, and over the measured map it names."""
    digest = hashlib.sha256(named_toml("scenarios", name).read_bytes())
    if scenario.file is not None:
        digest.update(scenario.file.read_bytes())
    return digest.hexdigest()


def seeds_of(text: str) -> tuple[int, ...]:
    """Seeds from "7", "0:20" (0 to 19), or several of these with commas between."""
    out: list[int] = []
    for part in text.split(","):
        bounds = part.strip().split(":")
        if len(bounds) > 2 or not all(b.strip().isdecimal() and len(b) < 10 for b in bounds):
            raise ConfigError(f"seeds {text!r} are not usable; a number such as 7, a range such as 0:20, or several with commas")
        first, last = int(bounds[0]), int(bounds[-1]) + (len(bounds) == 1)
        if last <= first or last - first > MOST_SEEDS:
            raise ConfigError(f"seeds {text!r}: {part.strip()} names {max(last - first, 0)} seeds, must be 1 to {MOST_SEEDS}")
        out += range(first, last)
    return tuple(out)


def frozen_table(suite: Suite) -> str:
    """The table that freezes a suite, for the end of its file."""
    lines = [f'{name} = "{sha}"' for name, sha in sorted(suite.scenarios.items())]
    return "\n".join(["[frozen]", f'suite = "{suite.sha256}"', *lines, ""])


def did_you_mean(word: str, known: Sequence[str]) -> str:
    """The end of a message that refuses a name."""
    close = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    return f"{hint} known: {', '.join(known)}"


def _case(
    robot: str, name: str, scenario: Scenario, *, seed: int, delay: float, cycles: int | None, time_limit: float | None
) -> Case:
    robot_dir(robot)
    return Case(
        robot=robot, scenario=name, seed=seed, delay=float(delay), cycles=scenario.cycles if cycles is None else cycles,
        time_limit=scenario.time_limit if time_limit is None else float(time_limit),
        capped=cycles is not None and cycles < scenario.cycles,
    )  # fmt: skip


def _suite_from_content(content: dict[str, Any], path: Path) -> Suite:
    _known(path, "", content, _TOP)
    groups = content.get("fields", [])
    if not isinstance(groups, list) or not all(isinstance(g, dict) for g in groups):
        raise ConfigError(f"{path}: fields must be tables [[fields]] with {', '.join(_FIELDS)}, got {groups!r}")
    cases: list[Case] = []
    scenarios: dict[str, str] = {}
    for i, group in enumerate(groups):
        prefix = f"fields[{i}]."
        _known(path, prefix, group, _FIELDS)
        try:
            part = suite_of(
                robots=_list(path, prefix, group, "robots", str),
                scenarios=[_value(path, prefix, group, "scenario", str)],
                seeds=_seeds(path, prefix, group),
                delays=_list(path, prefix, group, "delays", float),
                cycles=_value(path, prefix, group, "cycles", int, needed=False),
                time_limit=_value(path, prefix, group, "time_limit", float, needed=False),
            )
        except (ConfigError, LinkError) as e:
            raise ConfigError(f"{e}" if str(e).startswith(str(path)) else f"{path}: {prefix[:-1]}: {e}") from e
        cases += part.cases
        scenarios |= part.scenarios
    return Suite(
        name=_value(path, "", content, "name", str),
        description=_value(path, "", content, "description", str),
        cases=tuple(cases),
        scenarios=MappingProxyType(scenarios),
    )


def _check_frozen(suite: Suite, frozen: Any, path: Path) -> None:
    if not isinstance(frozen, dict) or "suite" not in frozen:
        raise ConfigError(f"{path}: it does not say what it was frozen as; `python scripts/freeze_suite.py {path}` writes that")
    changed = [name for name, sha in suite.scenarios.items() if frozen.get(name) != sha]
    if changed:
        raise ConfigError(
            f"suite {suite.name}: its scenario {', '.join(changed)} has changed since it was frozen; restore the file, or give "
            f"the suite another name and freeze it again (scripts/freeze_suite.py): results of the two do not compare"
        )
    if frozen["suite"] != suite.sha256:
        raise ConfigError(
            f"suite {suite.name}: its cases have changed since it was frozen ({path} says {str(frozen['suite'])[:12]}, they hash to "
            f"{suite.sha256[:12]}); restore the file, or give it another name and freeze it again (scripts/freeze_suite.py)"
        )


def _known(path: Path, prefix: str, content: dict[str, Any], keys: Sequence[str]) -> None:
    for key in content:
        if key not in keys:
            raise ConfigError(f"{path}: key {prefix}{key} is not known{did_you_mean(key, keys)}")


def _value(path: Path, prefix: str, content: dict[str, Any], key: str, kind: type, *, needed: bool = True) -> Any:
    """A value of a type, a whole number being a float as well; None where it is not there and need not be."""
    value = content.get(key)
    if value is None and not needed:
        return None
    if not _is(value, kind):
        raise ConfigError(f"{path}: {prefix}{key} = {value!r} is not usable; it must be a {_WORDS[kind]}")
    return kind(value)


def _list(path: Path, prefix: str, content: dict[str, Any], key: str, kind: type) -> list[Any]:
    value = content.get(key)
    if not isinstance(value, list) or not value or not all(_is(v, kind) for v in value):
        raise ConfigError(f"{path}: {prefix}{key} = {value!r} is not usable; it must be a list with one {_WORDS[kind]} or more")
    return [kind(v) for v in value]


def _seeds(path: Path, prefix: str, group: dict[str, Any]) -> Sequence[int]:
    value = group.get("seeds")
    return seeds_of(value) if isinstance(value, str) else _list(path, prefix, group, "seeds", int)


def _is(value: Any, kind: type) -> bool:
    return not isinstance(value, bool) and isinstance(value, (int, float) if kind is float else kind)


_WORDS = {str: "text", int: "whole number", float: "number"}
