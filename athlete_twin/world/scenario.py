"""What a trial happens on: kind of ground, rocks, soil, sun, goal. Read from `assets/scenarios/*.toml`, strictly.

Every key is known, typed and bounded; whatever else stands in the file is refused with one line that names the file,
the key, the value and what would have worked.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from athlete_twin.assets import assets_root, named_toml, read_toml
from athlete_twin.errors import ConfigError, TerrainError
from athlete_twin.world.height_map import read_height_map
from athlete_twin.world.injected import BOUNDS, NEEDS, InjectedFault
from athlete_twin.world.soil import MATERIALS

MAP_MARGIN = 4.0
"""ground that a measured map must show around start and goal: T12's foot radius and a step [m]"""


@dataclass(frozen=True, kw_only=True)
class Rock:
    """One rock: a faceted cap on a disc of the given diameter."""

    x: float
    """of its centre in world [m]"""
    y: float
    """[m]"""
    diameter: float
    """of the disc with the area it covers [m]"""
    height: float
    """of its top above the ground around it [m]"""


@dataclass(frozen=True, kw_only=True)
class RockField:
    """Rocks by the cumulative area fraction F(D) = k exp(-(1.79 + 0.152/k) D)."""

    k: float
    """share of the ground that rocks of any size cover; 0 for none"""
    d_min: float = 0.15
    """smallest diameter drawn [m]"""
    d_max: float = 1.5
    """largest diameter drawn [m]"""
    min_big_across_line: int = 0
    """so many rocks of `big_diameter` or more lie across the straight line from start to goal"""
    big_diameter: float = 0.8
    """[m]"""

    def area_fraction(self, diameter: np.ndarray | float) -> np.ndarray:
        """Share of the ground that rocks of `diameter` [m] up to `d_max` cover."""
        d = np.clip(np.asarray(diameter, dtype=float), self.d_min, self.d_max)
        if self.k == 0.0:
            return np.zeros_like(d)
        q = 1.79 + 0.152 / self.k
        return np.asarray(self.k * (np.exp(-q * d) - np.exp(-q * self.d_max)))


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """The ground of a trial and what is asked there."""

    name: str
    description: str
    kind: str
    """"flat", "yard", "dunes", "lava", "slope" or "file" """
    parameters: Mapping[str, float]
    """of that kind of ground, see `GROUND_KEYS`"""
    file: Path | None
    """measured height map, for kind "file" """
    size: tuple[float, float]
    """extent of the ground along x and y [m]"""
    x_min: float
    """where the ground begins; the start lies at x = 0, y runs symmetrically [m]"""
    cell: float
    """edge of a cell of the true height field [m]"""
    goal_distance: float
    """of the goal from the start, along +x [m]"""
    cycles: int
    """gait cycles after which a trial ends"""
    time_limit: float
    """mission time after which a trial ends [s]"""
    soil: str
    """name of the material between the rocks"""
    friction: float
    """Coulomb coefficient of that ground, the material's own where the file gives none"""
    rocks: RockField
    placed_rocks: tuple[Rock, ...]
    """rocks that lie there whatever the seed"""
    faults: tuple[InjectedFault, ...]
    """what breaks and when, in the order of the file's [[fault]] tables"""
    sun_elevation: float
    """above the horizon [rad]"""
    sun_azimuth: float
    """of the direction to the sun, from world x towards y [rad]"""

    def sun_in_world(self) -> np.ndarray:
        """Unit vector towards the sun, shape (3,)."""
        e, a = self.sun_elevation, self.sun_azimuth
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


@dataclass(frozen=True)
class Number:
    """A number within bounds; `default` None where it must be given."""

    low: float
    high: float
    default: float | None = None
    whole: bool = False


GROUND_KEYS: dict[str, dict[str, Number]] = {
    "flat": {"roughness": Number(0.0, 0.05, 0.001)},
    "yard": {"relief": Number(0.0, 1.0), "wavelength": Number(0.5, 20.0), "roughness": Number(0.0, 0.05, 0.004)},
    "dunes": {
        "relief": Number(0.0, 2.0),
        "wavelength": Number(2.0, 30.0),
        "heading_deg": Number(-180.0, 180.0, 25.0),
        "ripples": Number(0.0, 0.05, 0.006),
    },
    "lava": {"relief": Number(0.0, 1.0), "wavelength": Number(0.5, 20.0), "roughness": Number(0.0, 0.2)},
    "slope": {
        "angle_deg": Number(-30.0, 30.0),
        "heading_deg": Number(-180.0, 180.0, 0.0),
        "roughness": Number(0.0, 0.05, 0.004),
    },
    "file": {
        "map_cell": Number(0.005, 0.5, float("nan")),
        "height_unit": Number(1e-6, 10.0, float("nan")),
        "start_x": Number(0.0, 1000.0),
        "start_y": Number(0.0, 1000.0),
    },
}
"""the parameters of each kind of ground; lengths in metres, NaN where the file itself may say it"""

_SHAPE = {"size_x": Number(8.0, 60.0, 24.0), "size_y": Number(8.0, 60.0, 24.0), "x_min": Number(-40.0, -4.0, -9.0)}
_CELL = {"cell": Number(0.01, 0.1, 0.03)}
_TOP = {
    "goal_distance": Number(0.5, 40.0),
    "cycles": Number(1.0, 1000.0, 30.0, whole=True),
    "time_limit": Number(10.0, 1e6, 14400.0),
    "friction": Number(0.05, 2.0, float("nan")),
}
_ROCKS = {
    "k": Number(0.0, 0.3, 0.0),
    "d_min": Number(0.05, 1.0, 0.15),
    "d_max": Number(0.2, 3.0, 1.5),
    "min_big_across_line": Number(0.0, 10.0, 0.0, whole=True),
    "big_diameter": Number(0.2, 2.0, 0.8),
}
_ROCK = {
    "x": Number(-40.0, 60.0),
    "y": Number(-40.0, 40.0),
    "diameter": Number(0.1, 3.0),
    "height": Number(0.02, 3.0),
}
_SUN = {"elevation_deg": Number(5.0, 90.0, 40.0), "azimuth_deg": Number(-360.0, 360.0, 120.0)}
_TEXTS = ("name", "description", "soil")
_TABLES = ("ground", "rocks", "rock", "sun", "fault")


def load_scenario(name_or_path: str) -> Scenario:
    """A scenario by its name in the assets or by a path ending in .toml."""
    path = named_toml("scenarios", name_or_path)
    return scenario_from_content(read_toml(path), path)


def scenario_from_content(content: dict[str, Any], path: Path) -> Scenario:
    """A scenario from the content of its file; `path` is named in errors and anchors relative file names."""
    _known(path, "", content, [*_TEXTS, *_TOP, *_TABLES])
    top = _numbers(path, "", {k: v for k, v in content.items() if k in _TOP}, _TOP)
    soil = _text(path, "soil", content, "packed_soil")
    if soil not in MATERIALS:
        raise ConfigError(f"{path}: soil = {soil!r} is not known{_did_you_mean(soil, sorted(MATERIALS))}")
    ground = _table(path, "ground", content)
    kind = _text(path, "kind", ground, None, prefix="ground.")
    if kind not in GROUND_KEYS:
        raise ConfigError(f"{path}: ground.kind = {kind!r} is not known{_did_you_mean(kind, list(GROUND_KEYS))}")
    shape = {} if kind == "file" else _SHAPE
    numbers = {**GROUND_KEYS[kind], **shape, **_CELL}
    _known(path, "ground.", ground, ["kind", *numbers, *(["file"] if kind == "file" else [])])
    figures = _numbers(path, "ground.", {k: v for k, v in ground.items() if k not in ("kind", "file")}, numbers)
    rocks = _numbers(path, "rocks.", _table(path, "rocks", content, {}), _ROCKS)
    if rocks["d_min"] >= rocks["d_max"]:
        raise ConfigError(f"{path}: rocks.d_min = {rocks['d_min']} m must be below rocks.d_max = {rocks['d_max']} m")
    if rocks["min_big_across_line"] and not (rocks["k"] > 0.0 and rocks["big_diameter"] < rocks["d_max"]):
        raise ConfigError(f"{path}: rocks.min_big_across_line needs rocks.k > 0 and rocks.big_diameter < rocks.d_max")
    sun = _numbers(path, "sun.", _table(path, "sun", content, {}), _SUN)
    file = _map_file(path, ground) if kind == "file" else None
    if file is not None:
        figures |= _map_shape(path, file, figures, top["goal_distance"])
    elif figures["x_min"] + figures["size_x"] < top["goal_distance"] + MAP_MARGIN:
        enough = top["goal_distance"] + MAP_MARGIN - figures["x_min"]
        raise ConfigError(
            f"{path}: ground.size_x = {figures['size_x']} m from x_min = {figures['x_min']} m ends less than "
            f"{MAP_MARGIN} m beyond the goal at {top['goal_distance']} m; {enough} m would do"
        )
    return Scenario(
        name=_text(path, "name", content, path.stem),
        description=_text(path, "description", content, ""),
        kind=kind,
        parameters=MappingProxyType({k: figures[k] for k in GROUND_KEYS[kind]}),
        file=file,
        size=(figures["size_x"], figures["size_y"]),
        x_min=figures["x_min"],
        cell=figures["cell"],
        goal_distance=top["goal_distance"],
        cycles=int(top["cycles"]),
        time_limit=top["time_limit"],
        soil=soil,
        friction=MATERIALS[soil].friction if np.isnan(top["friction"]) else top["friction"],
        rocks=RockField(
            k=rocks["k"],
            d_min=rocks["d_min"],
            d_max=rocks["d_max"],
            min_big_across_line=int(rocks["min_big_across_line"]),
            big_diameter=rocks["big_diameter"],
        ),
        placed_rocks=_placed(path, content),
        faults=_injected(path, content),
        sun_elevation=float(np.deg2rad(sun["elevation_deg"])),
        sun_azimuth=float(np.deg2rad(sun["azimuth_deg"])),
    )


def _map_file(path: Path, ground: dict[str, Any]) -> Path:
    name = _text(path, "file", ground, None, prefix="ground.")
    if Path(name).is_absolute():
        return Path(name)
    beside = path.parent / name
    return beside if beside.is_file() else assets_root() / "terrains" / name


def _map_shape(path: Path, file: Path, figures: dict[str, float], goal_distance: float) -> dict[str, float]:
    """Extent of a measured map, with the start at the origin; refuses a map that is unusable or too small."""
    given = {k: None if np.isnan(figures[k]) else figures[k] for k in ("map_cell", "height_unit")}
    try:
        grid = read_height_map(file, cell=given["map_cell"], height_unit=given["height_unit"])
    except TerrainError as e:
        raise ConfigError(f"{path}: ground.file = {str(file)!r}: {e}") from e
    size_x, size_y = ((n - 1) * grid.cell for n in grid.shape)
    x, y = figures["start_x"], figures["start_y"]
    lacks = []
    if not MAP_MARGIN <= x <= size_x - goal_distance - MAP_MARGIN:
        lacks.append(f"ground.start_x = {x} m is outside {MAP_MARGIN} to {size_x - goal_distance - MAP_MARGIN:.2f} m")
    if not MAP_MARGIN <= y <= size_y - MAP_MARGIN:
        lacks.append(f"ground.start_y = {y} m is outside {MAP_MARGIN} to {size_y - MAP_MARGIN:.2f} m")
    if lacks:
        raise ConfigError(
            f"{path}: {' and '.join(lacks)}: the map of {size_x:.2f} x {size_y:.2f} m in {str(file)!r} must show "
            f"{MAP_MARGIN} m around start and goal"
        )
    return {"size_x": size_x, "size_y": size_y, "x_min": -x}


def _placed(path: Path, content: dict[str, Any]) -> tuple[Rock, ...]:
    entries = content.get("rock", [])
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise ConfigError(f"{path}: rock must be tables [[rock]] with x, y, diameter, height, got {entries!r}")
    out = []
    for i, entry in enumerate(entries):
        prefix = f"rock[{i}]."
        _known(path, prefix, entry, list(_ROCK))
        out.append(Rock(**_numbers(path, prefix, entry, _ROCK)))
    return tuple(out)


def _injected(path: Path, content: dict[str, Any]) -> tuple[InjectedFault, ...]:
    entries = content.get("fault", [])
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise ConfigError(f"{path}: fault must be tables [[fault]] with kind, t and what the kind needs, got {entries!r}")
    out = []
    for i, entry in enumerate(entries):
        prefix = f"fault[{i}]."
        kind = _text(path, "kind", entry, None, prefix=prefix)
        if kind not in NEEDS:
            raise ConfigError(f"{path}: {prefix}kind = {kind!r} is not known{_did_you_mean(kind, list(NEEDS))}")
        _known(path, prefix, entry, ["kind", "t", *NEEDS[kind]])
        rules = {"t": Number(0.0, 1e6)}
        if "leg" in NEEDS[kind]:
            rules["leg"] = Number(1.0, 6.0, whole=True)
        if "value" in NEEDS[kind]:
            rules["value"] = Number(*BOUNDS[kind])
        numbers = _numbers(path, prefix, {k: v for k, v in entry.items() if k in ("t", "leg", "value")}, rules)
        texts = {k: _text(path, k, entry, None, prefix=prefix) for k in ("joint", "camera") if k in NEEDS[kind]}
        out.append(
            InjectedFault(
                kind=kind, t=numbers["t"], leg=int(numbers.get("leg", 0)) - 1, value=numbers.get("value", 0.0), **texts
            )
        )
    return tuple(out)


def _numbers(path: Path, prefix: str, content: dict[str, Any], keys: dict[str, Number]) -> dict[str, float]:
    _known(path, prefix, content, list(keys))
    out: dict[str, float] = {}
    for key, rule in keys.items():
        if key not in content:
            if rule.default is None:
                raise ConfigError(f"{path}: key {prefix}{key} is missing; {_wanted(rule)}")
            out[key] = rule.default
            continue
        value = content[key]
        right_type = isinstance(value, int) if rule.whole else isinstance(value, int | float)
        if isinstance(value, bool) or not right_type or not np.isfinite(value) or not rule.low <= value <= rule.high:
            raise ConfigError(f"{path}: {prefix}{key} = {value!r} is not usable; {_wanted(rule)}")
        out[key] = float(value)
    return out


def _wanted(rule: Number) -> str:
    what = "a whole number" if rule.whole else "a number"
    return f"it must be {what} from {rule.low:g} to {rule.high:g}"


def _text(path: Path, key: str, content: dict[str, Any], default: str | None, *, prefix: str = "") -> str:
    value = content.get(key, default)
    if value is None:
        raise ConfigError(f"{path}: key {prefix}{key} is missing; it must be a text")
    if not isinstance(value, str):
        raise ConfigError(f"{path}: {prefix}{key} = {value!r} is not usable; it must be a text")
    return value


def _table(path: Path, key: str, content: dict[str, Any], default: dict[str, Any] | None = None) -> dict[str, Any]:
    value = content.get(key, default)
    if not isinstance(value, dict):
        raise ConfigError(f"{path}: {key} must be a table [{key}], got {value!r}")
    return value


def _known(path: Path, prefix: str, content: dict[str, Any], keys: list[str]) -> None:
    for key, value in content.items():
        if key not in keys:
            raise ConfigError(f"{path}: key {prefix}{key} (= {value!r}) is not known{_did_you_mean(key, keys)}")


def _did_you_mean(word: str, known: list[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ";"
    return f"{hint} known: {', '.join(known)}"
