"""Rocks: how many of which size, where, and what shape.

The cumulative area fraction of rocks of diameter D or more is F(D) = k exp(-q D) with q = 1.79 + 0.152 / k, so the
number of rocks a square metre and metre of diameter is -F'(D) / (pi D^2 / 4). They lie as a Poisson process; a rock
that would overlap a larger one is thrown again: the sizes keep their distribution, the places are nearly independent.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.world.scenario import Rock, RockField, Scenario

THROWS = 60
"""tries to find a rock a free place before it may overlap"""
HEIGHT_OVER_DIAMETER = (0.4, 0.6)
LINE_TRIES = 2000
"""tries to find a large rock a place across the straight line"""
_SHAPE_CELLS = 40
_WAVE_NUMBERS = np.array([3.0, 4.0, 5.5, 7.0, 9.0, 11.5, 15.0, 19.0])
"""of the roughness, in radians a radius"""


def draw_diameters(field: RockField, area: float, rng: np.random.Generator) -> np.ndarray:
    """Diameters of the rocks on `area` [m2], a Poisson number of them, largest first [m]."""
    if field.k == 0.0:
        return np.zeros(0)
    q = 1.79 + 0.152 / field.k
    d = np.geomspace(field.d_min, field.d_max, 2000)
    density = field.k * q * np.exp(-q * d) / (0.25 * np.pi * d**2)
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(d))])
    count = rng.poisson(area * cumulative[-1])
    drawn = np.interp(rng.uniform(0.0, cumulative[-1], count), cumulative, d)
    return np.sort(drawn)[::-1]


def scatter_rocks(
    scenario: Scenario, rng: np.random.Generator, *, clear_xy: np.ndarray, clear_radius: float
) -> tuple[Rock, ...]:
    """Rocks of one seed, the scenario's placed ones first.

    Args:
        scenario: says how many, how large, and what must lie across the straight line.
        rng: of this stream.
        clear_xy: the wheels' first patches, shape (n, 2) [m]. Rocks that reach into them are left out; no other is.
        clear_radius: of these patches [m].
    """
    field = scenario.rocks
    low = np.array([scenario.x_min, -0.5 * scenario.size[1]])
    size = np.array(scenario.size)
    diameters = draw_diameters(field, float(np.prod(size)), rng)
    flatness = rng.uniform(*HEIGHT_OVER_DIAMETER, len(diameters))
    placed = [(r.x, r.y, r.diameter) for r in scenario.placed_rocks]
    taken = np.zeros((len(placed) + len(diameters), 3))
    taken[: len(placed)] = np.array(placed).reshape(-1, 3)
    first = len(placed)
    for i, diameter in enumerate(diameters, start=first):
        before = taken[:i]
        for _ in range(THROWS):
            xy = low + size * rng.uniform(size=2)
            if not _overlaps(xy, diameter, before):
                break
        taken[i] = (*xy, diameter)
    random = taken[first:]
    if field.min_big_across_line:
        _put_across_line(scenario, random, rng, clear_xy=clear_xy, clear_radius=clear_radius, first=taken[:first])
    rocks = [*scenario.placed_rocks]
    for (x, y, d), f in zip(random, flatness, strict=True):
        rocks.append(Rock(x=float(x), y=float(y), diameter=float(d), height=float(d * f)))
    return tuple(r for r in rocks if _is_clear(r.x, r.y, r.diameter, clear_xy, clear_radius))


def across_line(rocks: tuple[Rock, ...], goal_distance: float, *, diameter: float) -> int:
    """Rocks of `diameter` [m] or more whose disc meets the straight line from start to goal."""
    count = 0
    for r in rocks:
        beyond = r.x - np.clip(r.x, 0.0, goal_distance)
        count += int(r.diameter >= diameter and np.hypot(beyond, r.y) < 0.5 * r.diameter)
    return count


class RockShape:
    """A faceted half-superellipsoid over the unit disc: `height(u, v)` is 1 at the top, 0 outside its outline.

    Its outline is irregular but covers the same area as the unit disc, so that the area fractions hold.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        sides = int(rng.integers(6, 10))
        azimuth = 2.0 * np.pi * (np.arange(sides) + rng.uniform(-0.35, 0.35, sides)) / sides
        self._normals = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        self._distance = rng.uniform(0.78, 1.02, sides)
        # A side rises by this many heights a radius: 50 to 74 degrees on a rock half as high as wide.
        self._steepness = rng.uniform(1.2, 3.5, sides)
        self._tops = np.column_stack([rng.uniform(-0.55, 0.55, (3, 2)), rng.uniform(0.85, 1.10, 3)])
        self._harmonics = rng.normal(0.0, 0.06, (2, 4)) / np.array([1.0, 1.0, 1.5, 2.0])
        self._stretch = float(rng.uniform(0.85, 1.18))
        self._turn = float(rng.uniform(0.0, 2.0 * np.pi))
        heading = rng.uniform(0.0, 2.0 * np.pi, len(_WAVE_NUMBERS))
        self._waves = np.column_stack([np.cos(heading), np.sin(heading)]) * _WAVE_NUMBERS[:, None]
        self._phases = rng.uniform(0.0, 2.0 * np.pi, len(_WAVE_NUMBERS))
        self._scale, self._top = 1.0, 1.0
        u = np.linspace(-1.5, 1.5, _SHAPE_CELLS)
        shape = self.height(u[:, None], u[None, :])
        covered = np.count_nonzero(shape > 0.0) * (u[1] - u[0]) ** 2
        self._scale = float(np.sqrt(np.pi / covered))
        self._top = float(shape.max())

    def height(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Height over the rock's own height at (u, v) in units of its nominal radius."""
        c, s = np.cos(self._turn), np.sin(self._turn)
        a = (c * u + s * v) / (self._scale * self._stretch)
        b = (-s * u + c * v) * self._stretch / self._scale
        phi = np.arctan2(b, a)
        outline = np.full(phi.shape, 1.06)
        for order, (cosine, sine) in enumerate(self._harmonics.T, start=2):
            outline += cosine * np.cos(order * phi) + sine * np.sin(order * phi)
        radius = np.hypot(a, b) / outline
        body = 1.15 * np.maximum(1.0 - radius**2.4, 0.0) ** 0.6
        for (nx, ny), distance, steepness in zip(self._normals, self._distance, self._steepness, strict=True):
            body = np.minimum(body, (distance - nx * a - ny * b) * steepness)
        for tilt_x, tilt_y, level in self._tops:
            body = np.minimum(body, level + tilt_x * a + tilt_y * b)
        rough = sum(np.sin(k[0] * a + k[1] * b + p) for k, p in zip(self._waves, self._phases, strict=True))
        inside = body > 0.0
        body = np.where(inside, body + 0.012 * rough * np.minimum(4.0 * np.maximum(body, 0.0), 1.0), 0.0)
        return np.asarray(np.maximum(body, 0.0) / self._top)


def _overlaps(xy: np.ndarray, diameter: float, others: np.ndarray) -> bool:
    if len(others) == 0:
        return False
    return bool(np.any(np.hypot(*(others[:, :2] - xy).T) < 0.5 * (others[:, 2] + diameter)))


def _is_clear(x: float, y: float, diameter: float, clear_xy: np.ndarray, clear_radius: float) -> bool:
    if len(clear_xy) == 0:
        return True
    return bool(np.all(np.hypot(clear_xy[:, 0] - x, clear_xy[:, 1] - y) >= 0.5 * diameter + clear_radius))


def _put_across_line(
    scenario: Scenario,
    random: np.ndarray,
    rng: np.random.Generator,
    *,
    clear_xy: np.ndarray,
    clear_radius: float,
    first: np.ndarray,
) -> None:
    """Move the nearest large rocks onto the straight line until enough lie across it, in place.

    They are moved and not added, so the field has as many rocks of each size as any other. Where the draw has too few
    large ones, its largest grow to the size asked for.
    """
    field, goal = scenario.rocks, scenario.goal_distance

    def lies_across(i: int) -> bool:
        x, y, d = random[i]
        rock = (Rock(x=x, y=y, diameter=d, height=d),)
        return across_line(rock, goal, diameter=field.big_diameter) == 1 and _is_clear(x, y, d, clear_xy, clear_radius)

    for i in range(min(field.min_big_across_line, len(random))):
        random[i, 2] = max(random[i, 2], field.big_diameter)
    large = np.flatnonzero(random[:, 2] >= field.big_diameter)
    fixed = {int(i) for i in large if lies_across(int(i))}
    movable = sorted((int(i) for i in large if int(i) not in fixed), key=lambda i: float(np.hypot(*random[i, :2])))
    for i in movable:
        if len(fixed) >= field.min_big_across_line:
            return
        d = random[i, 2]
        others = np.vstack([first, random[sorted(fixed)]])
        for _ in range(LINE_TRIES):
            xy = np.array([rng.uniform(0.3, goal), 0.35 * d * rng.uniform(-1.0, 1.0)])
            if _is_clear(xy[0], xy[1], d, clear_xy, clear_radius) and not _overlaps(xy, d, others):
                random[i, :2] = xy
                fixed.add(i)
                break
    # Smaller rocks below a moved one are hidden by it: the higher surface counts.
