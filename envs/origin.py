"""All that is needed to run a recorded trial again, as the text entries of its file's metadata.

The setup in numbers; scenario and variant as the whole text of their files (a variant's with its base laid under it), so that
changing those later changes nothing; of what cannot go along (drawings, truth, meshes, a measured map, a planner from outside the
project) the name and hash; and the versions of all that moves a trajectory.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from athlete_twin import assets
from athlete_twin.errors import AthleteError, ConfigError, RecordingError
from athlete_twin.link import LinkConfig
from envs.provenance import provenance
from envs.recording import recorded_metadata
from envs.trial import TrialSetup
from envs.variants import OutsidePlanner, TomlVariant, variant_named

FORMAT = "2"
"""of these entries and of the topics; 1 had no origin"""
BODIES = ("twin", "mock")
CODE = ("athlete_twin", "planner", "envs")
"""packages whose sources are hashed"""


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where a recording comes from."""

    setup: TrialSetup
    body: str
    """"twin" or "mock" """
    scenario_toml: str
    scenario_path: str
    """where it was: relative names in it are relative to there"""
    variant_toml: str
    """empty of a planner from outside"""
    variant_path: str
    """empty of a planner from outside"""
    files: Mapping[str, str]
    """sha256 of each file the trial reads besides, by its path below the assets"""
    code: str
    """sha256 over the sources of this project"""
    versions: Mapping[str, Any]
    """as in `trial.json`: package, commit, interpreter, machine, libraries"""
    planner: str = ""
    """a planner from outside, as it was named: its module must be there to be run again; empty where a variant has a file"""
    planner_sha256: str = ""
    """of its source; empty where that lay in no file"""

    def __post_init__(self) -> None:
        if self.body not in BODIES:
            raise RecordingError(f"body {self.body!r} is not one of {', '.join(BODIES)}")

    def metadata(self) -> dict[str, str]:
        """As text entries, with a hash over all of them."""
        entries = {name: str(getattr(self.setup, name)) for name in ("robot", "scenario", "variant", "seed", "operator")}
        entries |= {
            "format": FORMAT,
            "body": self.body,
            "setup": json.dumps(dataclasses.asdict(self.setup)),
            "scenario_toml": self.scenario_toml,
            "scenario_path": self.scenario_path,
            "variant_toml": self.variant_toml,
            "variant_path": self.variant_path,
            "files": json.dumps(dict(self.files)),
            "code": self.code,
            "versions": json.dumps(dict(self.versions)),
        }
        if self.planner:
            entries |= {"planner": self.planner, "planner_sha256": self.planner_sha256}
        return entries | {"sha256": _entries_sha256(entries)}


def origin_of(
    setup: TrialSetup, *, body: str, scenario: Path, variant: TomlVariant | OutsidePlanner, map_file: Path | None
) -> Origin:
    """Where a trial that is about to run comes from.

    Args:
        setup: of the trial.
        body: "twin" or "mock".
        scenario: its file.
        variant: what its name means.
        map_file: measured height map that the scenario names, if any.
    """
    return Origin(
        setup=setup,
        body=body,
        scenario_toml=scenario.read_text(),
        scenario_path=str(scenario),
        variant_toml="" if isinstance(variant, OutsidePlanner) else variant.text,
        variant_path="" if isinstance(variant, OutsidePlanner) else str(variant.path),
        planner=variant.reference if isinstance(variant, OutsidePlanner) else "",
        planner_sha256=variant.sha256 if isinstance(variant, OutsidePlanner) else "",
        files=file_hashes(setup.robot, map_file),
        code=code_sha256(),
        versions=provenance(),
    )


def recorded_origin(path: Path) -> Origin:
    """Where a recording comes from, by its own word."""
    entries = recorded_metadata(path, "trial")
    if entries.get("format") != FORMAT:
        told = f"has format {entries['format']!r}" if "format" in entries else "does not say where it comes from"
        raise RecordingError(f"{path}: {told}; recordings of format {FORMAT!r}, as rock_field_trial.py writes, can be run again")
    if entries.get("sha256") != _entries_sha256(entries):
        raise RecordingError(f"{path}: damaged: the entries of its metadata do not match their sha256")
    try:
        return Origin(
            setup=_setup(json.loads(entries["setup"])),
            files=json.loads(entries["files"]),
            versions=json.loads(entries["versions"]),
            planner=entries.get("planner", ""),
            planner_sha256=entries.get("planner_sha256", ""),
            **{k: entries[k] for k in ("body", "scenario_toml", "scenario_path", "variant_toml", "variant_path", "code")},
        )
    except (KeyError, TypeError, ValueError, AthleteError) as e:
        raise RecordingError(f"{path}: its metadata cannot be used: {type(e).__name__} {e}") from e


def changed_since(origin: Origin, *, map_file: Path | None) -> tuple[list[str], list[str]]:
    """What is not as it was: first what makes another trajectory a matter of course, then what may.

    A changed library moves last bits, and a changed drawing moves the robot. A changed line of this project's code may do
    nothing, and another machine should do nothing.
    """
    now, then = provenance(), origin.versions
    firm = [
        f"{name} was {then.get(name)}, is {now[name]}" for name in ("version", "python") if then.get(name) != now[name]
    ]
    libraries = then.get("packages") or {}
    for name in sorted(set(libraries) | set(now["packages"])):
        if libraries.get(name) != now["packages"].get(name):
            firm.append(f"{name} was {libraries.get(name)}, is {now['packages'].get(name)}")
    here = file_hashes(origin.setup.robot, map_file)
    for name in sorted(set(origin.files) | set(here)):
        if origin.files.get(name) != here.get(name):
            what = "is gone" if name not in here else "is new" if name not in origin.files else "has changed"
            firm.append(f"{name} {what}")
    if origin.planner:
        firm += _planner_changed(origin)
    loose = ["the code has changed"] if origin.code != code_sha256() else []
    loose += [f"{name} was {then.get(name)}, is {now[name]}" for name in ("platform", "cpu") if then.get(name) != now[name]]
    return firm, loose


def _planner_changed(origin: Origin) -> list[str]:
    """What is not as it was with a planner from outside: that its module has gone, or has other contents."""
    try:
        variant = variant_named(origin.planner)
    except ConfigError as e:
        return [str(e)]
    if not isinstance(variant, OutsidePlanner):
        return [f"planner {origin.planner} was a planner from outside, is {variant.path}"]
    if variant.sha256 != origin.planner_sha256:
        return [f"planner {origin.planner}: its source has changed"]
    return []


def file_hashes(robot: str, map_file: Path | None) -> dict[str, str]:
    """sha256 of the robot's files and of a measured map, by name."""
    root = assets.assets_root()
    files = {str(p.relative_to(root)): p for p in sorted(assets.robot_dir(robot).rglob("*")) if p.is_file()}
    if map_file is not None:
        files[map_file.name] = map_file
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items() if path.is_file()}


def code_sha256() -> str:
    """Hash over the sources of this project's packages."""
    root = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for package in CODE:
        for path in sorted((root / package).rglob("*.py")):
            digest.update(str(path.relative_to(root)).encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()


def _setup(content: dict[str, Any]) -> TrialSetup:
    known = {f.name for f in dataclasses.fields(LinkConfig)}
    for way in ("up", "down"):
        unknown = sorted(set(content[way]) - known)
        if unknown:
            raise RecordingError(f"link {way} has {', '.join(unknown)}, which this version does not know")
        content[way] = LinkConfig(**{k: _tuples(v) for k, v in content[way].items()})
    content["goal"] = tuple(content["goal"])
    return TrialSetup(**content)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(v) for v in value) if isinstance(value, list) else value


def _entries_sha256(entries: Mapping[str, str]) -> str:
    return hashlib.sha256(json.dumps({k: v for k, v in sorted(entries.items()) if k != "sha256"}).encode()).hexdigest()
