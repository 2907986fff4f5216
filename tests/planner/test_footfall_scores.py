"""Each method against the closed forms of [Caillas1989] s3.2.1, loops in plain Python, and what must not change a cost."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from athlete_twin.errors import ConfigError
from planner.footfall_scores import METHODS, TYPICAL, CostConfig, cost, first_moment, footprint, underfoot

CELL = 0.05
SIDE = 0.30
"""[m], the paper's foot"""
N = 61
FINE = SIDE / N
"""[m], so that sums over cells come near the paper's integrals: 61 cells cover exactly the foot"""
HALF_A_CELL = 1.0 / N
"""centres of cells reach half a cell less far than the foot on either side, as a share of it"""
SOIL = {"soil_k": 1e6, "soil_n": 0.8}
TABLE = 1e-5
"""relative error of the table of powers in the energy, with room"""


def under_profile(profile):
    """The ground under one square foot: a profile along x, as in the paper's two-dimensional analysis."""
    x = FINE * (np.arange(N) - N // 2)
    return underfoot(np.repeat(profile(x)[:, None], N, axis=1), np.ones((N, N), dtype=np.uint8), cell=FINE)


def cost_of_profile(profile, method, **constants):
    return costs(under_profile(profile), method, **constants)[N // 2, N // 2]


def costs(under, method, *, variance=None, refused=None, **constants):
    shape = under.heights.shape
    return cost(
        under, CostConfig(method=method, **constants),
        variance=np.zeros(shape) if variance is None else variance,
        refused=np.zeros(shape, dtype=bool) if refused is None else refused,
    )  # fmt: skip


def moment_of_profile(profile):
    return first_moment(under_profile(profile))[N // 2, N // 2]


def rugged(seed, shape=(26, 31), rough=0.04):
    return 3.0 + rough * np.random.default_rng(seed).normal(size=shape)


def scored(heights, method, *, shape="disc", **more):
    return costs(underfoot(np.ascontiguousarray(heights), footprint(0.18, CELL, shape=shape), cell=CELL), method, **more)


# Closed forms ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("filled", [7, 20, 29])
def test_a_step_costs_what_the_paper_says(filled):
    """Height h over l of the foot's d, at its edge; l below half of d, which is the least that must bear."""
    h, d, length = 0.08, SIDE, filled * FINE
    step = lambda x: np.where(np.arange(N) < filled, h, 0.0)  # noqa: E731
    assert cost_of_profile(step, "max_min") == pytest.approx(h)
    # Printed h^2 / 2 l (d - l), which is in m4; the variance of a step is h^2 l (d - l) / d^2.
    assert cost_of_profile(step, "plane_fit") == pytest.approx(h**2 * length * (d - length) / d**2)
    assert cost_of_profile(step, "support_area") == pytest.approx(h)
    n = SOIL["soil_n"]
    work = SOIL["soil_k"] * length * d * h ** (n + 1) / (n + 1)
    assert cost_of_profile(step, "support_energy", **SOIL) == pytest.approx(work, rel=TABLE)
    assert cost_of_profile(step, "free_volume") / d == pytest.approx((d - length) * h)
    # Printed M = p h for a step whose middle is p from the foot's, which is in m2; its length is left out.
    p = 0.5 * (d - length)
    assert moment_of_profile(step) / d == pytest.approx(p * h * length)
    tangent = 6 * h * length * (d - length) / d**3  # of the best line through a step
    assert cost_of_profile(step, "asv_slope", asv_slope_deg=1.0) == pytest.approx(np.arctan(tangent), rel=1e-3)


@pytest.mark.slow
@pytest.mark.ci
def test_a_step_that_bears_enough_is_no_support_area_s_business():
    """The paper's own objection: a high step is not told from a low one where l exceeds the least that must bear."""
    for h in (0.02, 0.30):
        step = lambda x, h=h: np.where(np.arange(N) < 40, h, 0.0)  # noqa: E731
        assert cost_of_profile(step, "support_area") == cost_of_profile(step, "support_energy") == 0.0
        assert cost_of_profile(step, "support_area", min_support_fraction=0.7) == pytest.approx(h)


def test_a_slope_costs_what_the_paper_says():
    tangent, d = np.tan(np.deg2rad(12.0)), SIDE
    slope = lambda x: tangent * x  # noqa: E731
    assert cost_of_profile(slope, "max_min") == pytest.approx(d * tangent * (1 - HALF_A_CELL))
    assert cost_of_profile(slope, "plane_fit") == pytest.approx(d**2 / 12 * tangent**2, rel=1e-3)
    assert cost_of_profile(slope, "support_area") == pytest.approx(d / 2 * tangent, rel=2 * HALF_A_CELL)
    volume = d**2 / 2 * tangent
    assert cost_of_profile(slope, "free_volume") / d == pytest.approx(volume, rel=2 * HALF_A_CELL)
    # Printed N5 = N4 / 2, a volume; the moment of a slope's room is d / 6 of it.
    assert moment_of_profile(slope) / d == pytest.approx(d / 6 * volume, rel=1e-3)
    assert cost_of_profile(slope, "asv_slope", asv_slope_deg=11.9) == pytest.approx(np.deg2rad(12.0))
    assert cost_of_profile(slope, "asv_slope", asv_slope_deg=12.1) == 0.0


def test_the_energy_of_a_slope_is_the_integral_of_equation_6():
    tangent, d, n, k = 0.2, SIDE, SOIL["soil_n"], SOIL["soil_k"]
    deepest = d / 2 * tangent
    work = k * d / tangent * deepest ** (n + 2) / (n + 2)  # S = d delta / tan(theta)
    found = cost_of_profile(lambda x: tangent * x, "support_energy", **SOIL)
    assert found == pytest.approx(work, rel=4 * HALF_A_CELL)


@pytest.mark.parametrize("periods", [0.7, 1.0, 2.0, 2.3, 3.0])
def test_a_sinusoid_costs_what_the_paper_says(periods):
    """The paper's a is the amplitude, but for Max-Min, where it is the whole height; Plane Fit leaves out the mean's square."""
    a, d = 0.03, SIDE
    k = 2 * np.pi * periods / d
    wave = lambda x: a * np.sin(k * (x + 0.5 * d))  # noqa: E731
    mean = a * (1 - np.cos(k * d)) / (k * d)
    square = 0.5 * a**2 * (1 - np.sin(2 * k * d) / (2 * k * d))
    assert cost_of_profile(wave, "plane_fit") == pytest.approx(square - mean**2, rel=2e-3)
    expected = a * d * (1 - (1 - np.cos(k * d)) / (k * d))
    assert cost_of_profile(wave, "free_volume") / d == pytest.approx(expected, rel=5e-3)
    low = -a if periods >= 0.75 else a * np.sin(k * d)
    assert cost_of_profile(wave, "max_min") == pytest.approx(a - low, rel=1e-2)
    midpoints = 2e-3 + (k * FINE) ** 2 / 20  # what a sum over midpoints of cells leaves of an integral, with room
    # About the foot's middle: sin(k x) weighs as x does, by the cosine of the phase there.
    arm = 2 * (np.sin(k * d / 2) / k**2 - d / 2 * np.cos(k * d / 2) / k)
    assert moment_of_profile(wave) / d == pytest.approx(abs(a * np.cos(k * d / 2) * arm), rel=midpoints)
    if periods == int(periods):
        # Half of the foot is higher than the sinusoid's middle; the paper says so for any frequency above 1 / d.
        assert cost_of_profile(wave, "support_area") == pytest.approx(a, rel=0.1)


@pytest.mark.parametrize("periods", [1.3, 2.6, 4.7])
def test_support_area_of_a_sinusoid_is_near_its_amplitude_at_any_high_frequency(periods):
    a = 0.03
    wave = lambda x: a * np.sin(2 * np.pi * periods * x / SIDE)  # noqa: E731
    assert cost_of_profile(wave, "support_area") == pytest.approx(a, rel=0.3 / periods)


def test_a_sinusoid_symmetric_about_the_foot_s_middle_has_no_moment():
    wave = lambda x: 0.03 * np.cos(2 * np.pi * 1.7 * x / SIDE)  # noqa: E731
    assert moment_of_profile(wave) == pytest.approx(0.0, abs=1e-12)
    assert cost_of_profile(wave, "asv_slope", asv_slope_deg=1e-3) == 0.0


def test_the_energy_of_a_sinusoid_is_the_integral_of_equation_6():
    a, periods, n, k = 0.03, 2, SOIL["soil_n"], SOIL["soil_k"]
    wave = lambda x: a * np.cos(2 * np.pi * periods * x / SIDE)  # noqa: E731
    area = lambda delta: SIDE**2 * np.arccos(1 - delta / a) / np.pi  # noqa: E731
    work = quad(lambda delta: k * delta**n * area(delta), 0.0, a)[0]
    assert cost_of_profile(wave, "support_energy", **SOIL) == pytest.approx(work, rel=0.1)


def test_free_volume_tells_a_spike_from_a_wave_and_max_min_does_not():
    spike = lambda x: np.where(np.arange(N) == 30, 0.06, 0.0)  # noqa: E731
    wave = lambda x: 0.03 * np.sin(2 * np.pi * (np.arange(N) + 0.5) / 20)  # noqa: E731
    assert cost_of_profile(spike, "max_min") == pytest.approx(cost_of_profile(wave, "max_min"), rel=0.02)
    assert cost_of_profile(wave, "free_volume") < 0.7 * cost_of_profile(spike, "free_volume")
    # Plane Fit takes the spike for nearly flat: the paper's objection to it.
    assert cost_of_profile(spike, "plane_fit") < 0.2 * cost_of_profile(wave, "plane_fit")


def test_equilibrium_stands_in_the_middle_of_a_plateau_and_free_volume_anywhere_on_it():
    """[Caillas1989] figures 10 and 11."""
    heights = np.zeros((41, 41))
    heights[19:22, :] = 0.10  # narrower than the foot
    volume, balanced = (scored(heights, m, shape="square", equilibrium_region=0.2)[10:31, 20] for m in ("free_volume", "equilibrium"))
    assert np.ptp(volume[8:13]) == pytest.approx(0.0, abs=1e-12)
    assert balanced[8] > balanced[9] > balanced[10] < balanced[11] < balanced[12]


# Loops in plain Python ------------------------------------------------------------------------------------------------


def by_hand(heights, i, j, foot, method, **constants):
    """One cell's cost from the paper's formulas, without a library of arrays."""
    k = foot.shape[0] // 2
    cells = [(u, v) for u in range(-k, k + 1) for v in range(-k, k + 1) if foot[u + k, v + k]]
    z = [float(heights[i + u, j + v]) for u, v in cells]
    n, top = len(z), max(z)
    gaps = sorted(top - one for one in z)
    area = CELL**2
    if method == "max_min":
        return top - min(z)
    if method == "plane_fit":
        return sum((one - sum(z) / n) ** 2 for one in z) / n
    depth = gaps[math.ceil(constants.get("min_support_fraction", 0.5) * n) - 1]
    if method == "support_area":
        return depth
    if method == "support_energy":
        k, p = constants["soil_k"], constants["soil_n"] + 1
        return sum(area * k * (depth**p - gap**p) / p for gap in gaps if gap < depth)
    volume = area * sum(gaps)
    if method == "free_volume":
        return volume
    m_x = area * sum(v * CELL * (top - one) for (u, v), one in zip(cells, z, strict=True))
    m_y = area * sum(u * CELL * (top - one) for (u, v), one in zip(cells, z, strict=True))
    if method == "equilibrium":
        return volume, math.hypot(m_x, m_y)
    spread = sum((u * CELL) ** 2 for u, _ in cells)
    tangent = math.hypot(m_x, m_y) / area / spread
    return math.atan(tangent) if math.degrees(math.atan(tangent)) > constants["asv_slope_deg"] else 0.0


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 1000), shape=st.sampled_from(["disc", "square"]),
    method=st.sampled_from([m for m in METHODS if m != "equilibrium"]), share=st.sampled_from([0.05, 0.5, 0.8, 1.0]),
)  # fmt: skip
def test_costs_equal_a_loop_over_the_footprint(seed, shape, method, share):
    heights = rugged(seed)
    constants = {"min_support_fraction": share, "asv_slope_deg": 10.0, **SOIL}
    found = scored(heights, method, shape=shape, **constants)
    foot = footprint(0.18, CELL, shape=shape)
    k = foot.shape[0] // 2
    for i, j in np.random.default_rng(seed).integers([k, k], [26 - k, 31 - k], (12, 2)):
        expected = by_hand(heights, i, j, foot, method, **constants)
        # A table of powers is within 1e-5; sums of squares of heights of 3 m lose what double precision loses.
        assert found[i, j] == pytest.approx(expected, rel=TABLE if method == "support_energy" else 1e-9, abs=1e-10)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 1000), slack=st.sampled_from([0.05, 0.10, 0.5]), region=st.sampled_from([0.3, 0.5]))
def test_equilibrium_s_best_is_the_paper_s_choice_in_two_passes(seed, slack, region):
    """In the region of one cell: the least moment among footfalls whose free volume is below (1 + x) of the least."""
    heights = rugged(seed, shape=(17, 17))
    foot, side = footprint(0.10, CELL), 2 * round(0.5 * region / CELL) + 1
    half = side // 2
    inside = {(i, j): by_hand(heights, i, j, foot, "equilibrium") for i in range(2, 15) for j in range(2, 15)}
    refused = np.ones((17, 17), dtype=bool)
    refused[2:15, 2:15] = False
    refused[8, 9] = True  # a footfall on unknown ground is nobody's best
    del inside[8, 9]
    # Only the middle's region is whole: every other cell is taken out, so that its least is everyone's.
    for i, j in list(inside):
        if max(abs(i - 8), abs(j - 8)) > half // 2:
            refused[i, j] = True
            del inside[i, j]
    under = underfoot(heights, foot, cell=CELL)
    found = costs(under, "equilibrium", refused=refused, equilibrium_slack=slack, equilibrium_region=region)
    least = min(volume for volume, _ in inside.values())
    alike = {at: moment for at, (volume, moment) in inside.items() if volume <= (1 + slack) * least}
    best = min(inside, key=lambda at: found[at])
    assert best == min(alike, key=lambda at: alike[at])
    ranked = sorted(inside, key=lambda at: found[at])
    assert set(ranked[: len(alike)]) == set(alike)
    rest = [inside[at][0] for at in ranked[len(alike) :]]
    assert rest == sorted(rest)


# What must not change a cost, and what must ---------------------------------------------------------------------------

LOOSE = {"asv_slope_deg": 1e-3}


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 1000), shape=st.sampled_from(["disc", "square"]))
def test_costs_do_not_depend_on_level_or_place(method, seed, shape):
    heights = rugged(seed)
    here = scored(heights, method, shape=shape, equilibrium_region=0.2, **LOOSE)
    raised = scored(heights + 1.25, method, shape=shape, equilibrium_region=0.2, **LOOSE)
    assert raised == pytest.approx(here, rel=1e-9, abs=1e-12)
    moved = scored(heights[3:, 2:], method, shape=shape, equilibrium_region=0.2, **LOOSE)
    inner = slice(8, -8)  # beyond the reach of the border's footprints and of a region
    assert moved[5:-8, 6:-8] == pytest.approx(here[8:-8, inner], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 1000), shape=st.sampled_from(["disc", "square"]))
def test_costs_turn_and_mirror_with_the_ground(method, seed, shape):
    heights = rugged(seed)
    here = scored(heights, method, shape=shape, **LOOSE)
    assert scored(np.rot90(heights), method, shape=shape, **LOOSE) == pytest.approx(np.rot90(here), rel=1e-9, abs=1e-12)
    assert scored(heights[::-1], method, shape=shape, **LOOSE) == pytest.approx(here[::-1], rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(
    ("method", "power"),
    [("max_min", 1), ("plane_fit", 2), ("support_area", 1), ("support_energy", 1 + SOIL["soil_n"]), ("free_volume", 1), ("equilibrium", 1)],
)
@given(seed=st.integers(0, 1000), factor=st.floats(1.1, 5.0))
@settings(max_examples=8, deadline=None)
def test_costs_grow_with_roughness_by_a_power_of_it(method, power, seed, factor):
    heights = rugged(seed) - 3.0
    once, rougher = scored(heights, method, **SOIL), scored(factor * heights, method, **SOIL)
    assert rougher == pytest.approx(factor**power * once, rel=1e-6, abs=1e-12)


def test_the_slope_method_grows_with_roughness():
    heights = rugged(5) - 3.0
    assert (scored(1.5 * heights, "asv_slope") >= scored(heights, "asv_slope")).all()


@pytest.mark.parametrize("method", METHODS)
def test_flat_ground_costs_nothing(method):
    assert scored(np.full((20, 20), 0.7), method) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_a_doubtful_height_costs_as_much_as_deviations_say(method):
    heights, rng = rugged(11), np.random.default_rng(12)
    as_is = scored(heights, method, **LOOSE)
    for uneven in (False, True) if method != "support_energy" else (False,):
        # A foot that sinks past one doubtful cell spends less on it: the energy need not grow where doubt is uneven.
        variance = rng.uniform(1e-5, 1e-3, heights.shape) if uneven else np.full(heights.shape, 1e-4)
        assert scored(heights, method, variance=variance, deviations=0.0, **LOOSE).tobytes() == as_is.tobytes()
        wary, warier = (scored(heights, method, variance=variance, deviations=d, **LOOSE) for d in (1.0, 2.0))
        assert (wary > as_is).all()
        assert (warier > wary).all()


@pytest.mark.parametrize("method", ["max_min", "support_area", "free_volume"])
@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000))
def test_no_ground_within_the_deviations_costs_more(method, seed):
    heights, rng = rugged(seed), np.random.default_rng(seed)
    variance = rng.uniform(1e-5, 1e-3, heights.shape)
    bound = scored(heights, method, variance=variance, deviations=1.0)
    other = heights + np.sqrt(variance) * rng.uniform(-1.0, 1.0, heights.shape)
    assert (scored(other, method) <= bound + 1e-12).all()


def test_noise_adds_its_variance_to_the_mean_square_distance():
    """Plane Fit of noisy heights exceeds that of the true ones by sigma^2 on the average, but for the mean's own noise."""
    heights, sigma, rng = rugged(2), 0.02, np.random.default_rng(2)
    noisy = np.mean([scored(heights + sigma * rng.normal(size=heights.shape), "plane_fit") for _ in range(400)], axis=0)
    expected = scored(heights, "plane_fit", variance=np.full(heights.shape, sigma**2), deviations=1.0)
    n = footprint(0.18, CELL).sum()
    inner = (slice(4, -4), slice(4, -4))
    assert noisy[inner].mean() == pytest.approx(expected[inner].mean() - sigma**2 / n, rel=5e-3)


@pytest.mark.parametrize("method", METHODS)
def test_typical_costs_go_together(method):
    """On a slope whose free volume under SDM-B's wheel is typical, so are the others, within a factor of two."""
    foot = footprint(0.75 * 0.242, CELL)
    x = CELL * np.arange(30)[:, None] * np.ones((1, 30))
    at = (15, 15)
    unit = costs(underfoot(x, foot, cell=CELL), "free_volume")[at]
    slope = TYPICAL["free_volume"] / unit
    found = costs(underfoot(slope * x, foot, cell=CELL), method, **LOOSE)[at]
    assert 0.5 < found / TYPICAL[method] < 2.0


# Wrong use ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("constant", "value"),
    [
        ("soil_k", 0.0), ("soil_k", -1e6), ("soil_n", 0.0), ("soil_n", -1.0), ("equilibrium_slack", 0.0),
        ("equilibrium_region", -1.0), ("asv_slope_deg", 0.0), ("min_support_fraction", 0.0), ("min_support_fraction", 1.5),
        ("footprint_diameter", 0.0), ("footprint_diameter", -0.3), ("footprint_fraction", 0.0), ("deviations", -1.0),
        ("soil_k", float("nan")), ("soil_n", float("inf")),
    ],
)  # fmt: skip
def test_constants_that_mean_nothing_are_named_with_their_value(constant, value):
    with pytest.raises(ConfigError, match=f"{constant} is {value}"):
        CostConfig(**{constant: value})
