"""Which planner a name means: a variant's TOML file with its base laid under it, or a planner from outside the project.

A variant is named in four ways, tried in this order:

1. a path ending in .toml,
2. a name in `assets/variants`,
3. `module:factory`, where `factory` may be an attribute of an attribute; the folder Python was started in counts, after all else on
   the path, so that a file of one's own is found and shadows nothing,
4. the name of an entry point of the group `athlete_twin.planners`, as a package installed beside this one declares it.

A TOML file may begin with `base = "NAME"`: the keys and settings of that variant hold where the file has none of its own. What goes
on, to the planner and into recordings, is the whole.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib
import inspect
import json
import sys
import tomllib
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from athlete_twin.assets import assets_root, named_toml, read_toml
from athlete_twin.errors import ConfigError
from planner.decisions import GroundAgent

GROUP = "athlete_twin.planners"
ARGUMENTS = ("spec", "goal_in_world", "seed", "payload_kg", "timer")
"""keywords that a factory is called with"""
PROPERTIES, METHODS = ("ground_s", "unusable_pairs"), ("observe", "next", "decide")
"""of the protocol `planner.decisions.GroundAgent`"""


@dataclass(frozen=True, kw_only=True)
class TomlVariant:
    """A configuration of this project's own planner."""

    path: Path
    content: dict[str, Any]
    """with what the base says"""
    text: str
    """TOML of the content; the file's own text where it has no base"""

    @property
    def sha256(self) -> str:
        """Of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()


@dataclass(frozen=True, kw_only=True)
class OutsidePlanner:
    """A planner that somebody else wrote."""

    reference: str
    """as it was named"""
    factory: Callable[..., GroundAgent]
    sha256: str
    """of its module's source, or of all sources of the package that it lies in; empty where there is no file"""

    def agent(self, **arguments: Any) -> GroundAgent:
        """The ground that the factory makes of `ARGUMENTS`, checked against the protocol."""
        agent = self.factory(**arguments)
        lacking = [name for name in PROPERTIES if not hasattr(agent, name)]
        lacking += [f"{name}()" for name in METHODS if not callable(getattr(agent, name, None))]
        if lacking:
            needed = ", ".join((*PROPERTIES, *(f"{name}()" for name in METHODS)))
            raise ConfigError(
                f"variant {self.reference!r}: its factory returned a {type(agent).__name__} without {', '.join(lacking)}; "
                f"a planner.decisions.GroundAgent has {needed}"
            )
        return agent


def variant_named(name: str) -> TomlVariant | OutsidePlanner:
    """What a name means; a name that means nothing is refused with those that would have worked."""
    if name.endswith(".toml"):
        return _toml(named_toml("variants", name))
    known = variant_names()
    if name in known:
        return _toml(named_toml("variants", name))
    if ":" in name:
        return _outside(name, name)
    declared = {entry.name: f"{entry.module}:{entry.attr}" for entry in entry_points(group=GROUP)}
    if name in declared:
        return _outside(name, declared[name])
    close = difflib.get_close_matches(name, (*known, *declared), n=1)
    meant = f"; did you mean {close[0]!r}?" if close else ""
    raise ConfigError(
        f"variant {name!r} is not known{meant}; known: {', '.join((*known, *sorted(declared)))}, or a path ending in .toml, "
        f"a planner of one's own as module:factory, or the name of an entry point of group {GROUP}"
    )


def variant_names() -> list[str]:
    """Names of the variants in the assets."""
    return sorted(path.stem for path in (assets_root() / "variants").glob("*.toml"))


def _toml(path: Path) -> TomlVariant:
    own = read_toml(path)
    if "base" not in own:
        return TomlVariant(path=path, content=own, text=path.read_text())
    name = own.pop("base")
    if name not in variant_names():
        raise ConfigError(f"{path}: base = {name!r} is no variant of this project; known: {', '.join(variant_names())}")
    below = read_toml(named_toml("variants", name))
    if "base" in below:
        raise ConfigError(f"{path}: base = {name!r} has a base itself; {below['base']!r} would have worked")
    content = _over(own, below)
    return TomlVariant(path=path, content=content, text=_as_toml(path, content))


def _over(own: dict[str, Any], below: dict[str, Any]) -> dict[str, Any]:
    """Tables key by key, all else as a whole."""
    tables = {
        key: _over(own[key], below[key]) for key in own.keys() & below.keys() if isinstance(own[key], dict) and isinstance(below[key], dict)
    }
    return {**below, **own, **tables}


def _as_toml(path: Path, content: dict[str, Any]) -> str:
    """The content as a file without a base; a variant's values are written in TOML as in JSON, but for infinity and NaN."""
    tables = {"": {key: value for key, value in content.items() if key != "settings"}}
    settings = content.get("settings", {})
    if isinstance(settings, dict):
        tables |= {f"settings.{stage}": table for stage, table in settings.items()}
    lines: list[str] = []
    for name, table in tables.items():
        lines += [f"\n[{name}]"] if name else []
        for key, value in table.items() if isinstance(table, dict) else ():
            lines.append(f"{key} = {value!r}" if isinstance(value, float) else f"{key} = {json.dumps(value, default=str)}")
    text = "\n".join([f"# {path.name}, its base laid under it", *lines, ""])
    try:
        same = tomllib.loads(text) == content
    except tomllib.TOMLDecodeError:
        same = False
    if not same:
        raise ConfigError(f"{path}: holds what no variant holds; keys with texts, numbers, lists, and [settings.STAGE] would have worked")
    return text


def _outside(reference: str, target: str) -> OutsidePlanner:
    """The planner that `module:factory` names, imported."""
    name, _, attribute = target.partition(":")
    if not name or not attribute:
        raise ConfigError(f"variant {reference!r}: {target!r} is not module:factory, such as my_planner:make")
    module = _imported(reference, name)
    factory: Any = module
    for part in attribute.split("."):
        if not hasattr(factory, part):
            offered = [k for k, v in vars(module).items() if callable(v) and getattr(v, "__module__", "") == name]
            raise ConfigError(
                f"variant {reference!r}: module {name!r} has no {attribute!r}; it defines {', '.join(offered) or 'nothing to call'}"
            )
        factory = getattr(factory, part)
    if not callable(factory):
        kind = type(factory).__name__
        raise ConfigError(f"variant {reference!r}: {attribute!r} is of type {kind}; a function or class would have worked")
    try:
        inspect.signature(factory).bind(**dict.fromkeys(ARGUMENTS))
    except TypeError as e:
        wanted = ", ".join(ARGUMENTS)
        raise ConfigError(f"variant {reference!r}: {attribute!r} must take the keywords {wanted}: {e}") from e
    except ValueError:  # one without a signature to read shows when it is called
        pass
    return OutsidePlanner(reference=reference, factory=factory, sha256=_source_sha256(module))


def _imported(reference: str, name: str) -> ModuleType:
    here = str(Path.cwd())
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as e:
        if e.name is not None and (name == e.name or name.startswith(f"{e.name}.")):
            raise ConfigError(
                f"variant {reference!r}: no module {name!r}, neither installed nor in {here}, where Python was started"
            ) from e
        raise _broken(reference, name, e) from e
    except Exception as e:  # whatever somebody else's module does when it is imported
        raise _broken(reference, name, e) from e


def _broken(reference: str, name: str, error: Exception) -> ConfigError:
    at = traceback.extract_tb(error.__traceback__)[-1]
    said = " ".join(f"{type(error).__name__}: {error}".split())
    return ConfigError(f"variant {reference!r}: module {name!r} cannot be imported: {said} ({at.filename}:{at.lineno})")


def _source_sha256(module: ModuleType) -> str:
    """Over the file of a module by itself, or over all files of the package that it is part of."""
    top = sys.modules.get(module.__name__.partition(".")[0], module)
    folders = [Path(folder) for folder in getattr(top, "__path__", ())]
    if folders:
        files = [(path.relative_to(folder), path) for folder in folders for path in sorted(folder.rglob("*.py"))]
    else:
        own = getattr(module, "__file__", None)
        files = [(Path(Path(own).name), Path(own))] if own and Path(own).is_file() else []
    if not files:
        return ""
    digest = hashlib.sha256()
    for name, path in files:
        digest.update(str(name).encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()
