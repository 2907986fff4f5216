"""The only place that knows where the assets lie: in a checkout beside the packages, in a wheel inside this one."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from athlete_twin.errors import AssetError, ConfigError

_CHECKOUT = Path(__file__).resolve().parent.parent / "assets"
_INSTALLED = Path(__file__).resolve().parent / "_assets"


def assets_root() -> Path:
    """The folder that holds `robots/`, `scenarios/`, `variants/` and `terrains/`."""
    for root in (_CHECKOUT, _INSTALLED):
        if (root / "robots").is_dir():
            return root
    raise AssetError(f"no assets found in {_CHECKOUT} or {_INSTALLED}; is the package installed whole?")


def robot_dir(name: str) -> Path:
    """Folder of a robot's drawings, truth, URDF and meshes."""
    known = robot_names()
    if name not in known:
        raise ConfigError(f"robot {name!r} is not known; known robots: {', '.join(known)}")
    return assets_root() / "robots" / name


def robot_names() -> list[str]:
    """Names of the robots that have drawings."""
    return sorted(p.parent.name for p in (assets_root() / "robots").glob("*/spec.toml"))


def named_toml(kind: str, name_or_path: str) -> Path:
    """Path of a scenario or variant, by its name in the assets or by a path ending in .toml.

    Args:
        kind: "scenarios" or "variants".
        name_or_path: a name such as "rock_field", or a file's path.
    """
    folder = assets_root() / kind
    path = Path(name_or_path) if name_or_path.endswith(".toml") else folder / f"{name_or_path}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in folder.glob("*.toml")))
        raise ConfigError(f"{kind[:-1]} {name_or_path!r} is not known; known: {known}, or a path ending in .toml")
    return path


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file; an error names the file and the line."""
    try:
        with path.open("rb") as f:
            return tomllib.load(f)
    except FileNotFoundError as e:
        raise ConfigError(f"{path}: no such file") from e
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as e:
        raise ConfigError(f"{path}: not valid TOML: {' '.join(str(e).split())}") from e
    except OSError as e:
        raise ConfigError(f"{path}: cannot be read: {e.strerror}") from e
