"""The ground before any rock lies on it, one function a kind: plain fields of height over x and y [m]."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import RectBivariateSpline

from athlete_twin.errors import ConfigError
from athlete_twin.world.height_map import read_height_map
from athlete_twin.world.scenario import Scenario

FINEST_FEATURE = 3.0
"""cells a wave needs, so that the grid can show it"""


def relief(scenario: Scenario, x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Heights at the cells' centres (nx,) by (ny,), shape (nx, ny), not yet shifted to zero at the start [m]."""
    p = dict(scenario.parameters)
    if scenario.kind == "file":
        return _measured(scenario, x, y)
    if scenario.kind == "flat":
        return p["roughness"] * fractal(x, y, rng, wavelength=1.0, octaves=4, gain=0.6)
    if scenario.kind == "slope":
        heading = np.deg2rad(p["heading_deg"])
        along = np.cos(heading) * x[:, None] + np.sin(heading) * y[None, :]
        rough = p["roughness"] * fractal(x, y, rng, wavelength=1.0, octaves=4, gain=0.6)
        return np.asarray(np.tan(np.deg2rad(p["angle_deg"])) * along + rough)
    if scenario.kind == "yard":
        rolling = p["relief"] * fractal(x, y, rng, wavelength=p["wavelength"], octaves=3, gain=0.4)
        return rolling + p["roughness"] * fractal(x, y, rng, wavelength=0.8, octaves=4, gain=0.6)
    if scenario.kind == "dunes":
        return _dunes(p, x, y, rng)
    if scenario.kind == "lava":
        return _lava(p, x, y, rng)
    raise ConfigError(f"ground kind {scenario.kind!r} is not one of flat, yard, dunes, lava, slope, file")


def fractal(
    x: np.ndarray, y: np.ndarray, rng: np.random.Generator, *, wavelength: float, octaves: int, gain: float
) -> np.ndarray:
    """Smooth random waves of unit deviation: each octave half as long and `gain` times as high as the one before."""
    cell = float(x[1] - x[0])
    total = np.zeros((len(x), len(y)))
    power = 0.0
    for octave in range(octaves):
        spacing = 0.5 * wavelength / 2**octave
        amplitude = gain**octave
        # Draw also what the grid cannot show: a finer grid then shows the same ground, with more detail.
        nodes_x, nodes_y = (np.arange(int((e[-1] - e[0]) / spacing) + 5) for e in (x, y))
        values = rng.standard_normal((len(nodes_x), len(nodes_y)))
        power += amplitude**2
        if 2.0 * spacing < FINEST_FEATURE * cell:
            continue
        at_x, at_y = x[0] + (nodes_x - 2) * spacing, y[0] + (nodes_y - 2) * spacing
        total += amplitude * RectBivariateSpline(at_x, at_y, values, kx=3, ky=3, s=0)(x, y)
    return np.asarray(total / np.sqrt(power))


def _dunes(p: dict[str, float], x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ridges with a long windward and a short lee side, bent and broken, with wind ripples on them."""
    heading = np.deg2rad(p["heading_deg"])
    along = np.cos(heading) * x[:, None] + np.sin(heading) * y[None, :]
    bend = 0.22 * p["wavelength"] * fractal(x, y, rng, wavelength=1.6 * p["wavelength"], octaves=2, gain=0.4)
    phase = (along + bend) / p["wavelength"] + rng.uniform()
    s = phase - np.floor(phase)
    rise = np.where(s < 0.65, s / 0.65, (1.0 - s) / 0.35)
    crest = rise * rise * (3.0 - 2.0 * rise)
    swell = 1.0 + 0.35 * fractal(x, y, rng, wavelength=1.3 * p["wavelength"], octaves=1, gain=1.0)
    ripple_phase = 2.0 * np.pi * (along + 0.10 * fractal(x, y, rng, wavelength=2.5, octaves=2, gain=0.4)) / 0.28
    ripples = p["ripples"] * np.sin(ripple_phase) * np.clip(1.2 - crest, 0.2, 1.0)
    return np.asarray(p["relief"] * np.clip(swell, 0.2, 1.8) * crest + ripples)


def _lava(p: dict[str, float], x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Broad swells, sharp pressure ridges and clinker."""
    swells = fractal(x, y, rng, wavelength=p["wavelength"], octaves=2, gain=0.5)
    folds = fractal(x, y, rng, wavelength=0.35 * p["wavelength"], octaves=3, gain=0.5)
    ridges = 1.0 - np.minimum(np.abs(folds), 1.0)
    clinker = fractal(x, y, rng, wavelength=0.45, octaves=3, gain=0.6)
    rough = p["roughness"] * np.abs(clinker) * (0.4 + 0.6 * ridges)
    return np.asarray(p["relief"] * (0.6 * swells + 0.4 * ridges) + rough)


def _measured(scenario: Scenario, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The map, interpolated by a cubic spline that passes through every measured height."""
    if scenario.file is None:
        raise ConfigError(f"scenario {scenario.name!r} of kind 'file' names no height map")
    p = {k: None if np.isnan(v) else v for k, v in scenario.parameters.items()}
    grid = read_height_map(scenario.file, cell=p["map_cell"], height_unit=p["height_unit"])
    map_x, map_y = grid.centres()
    spline = RectBivariateSpline(map_x + scenario.x_min, map_y - 0.5 * scenario.size[1], grid.heights, kx=3, ky=3, s=0)
    return np.asarray(spline(x, y))
