"""Variants become configurations, and what is wrong in one is named with what would have worked."""

import pytest

from athlete_twin.assets import assets_root
from athlete_twin.errors import ConfigError
from athlete_twin.model.spec import load_spec
from envs.build import variant_content
from planner.config import CHOICES, planner_config
from planner.footfall_scores import TYPICAL
from planner.gait.step_search import SearchConfig

SHIPPED = sorted(p.stem for p in (assets_root() / "variants").glob("*.toml"))


def content(name: str) -> dict:
    return variant_content(name)[1]


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_variants_are_valid(name, robot):
    config = planner_config(content(name), load_spec(robot), name=name)
    assert config.name == name
    assert config.step.stability.min_margin == {"sdm_b": 0.30, "t12": 0.50}[robot]


def test_both_variants_of_the_main_trial_are_shipped():
    assert {"integrated", "blind"} <= set(SHIPPED)


def test_an_unknown_key_is_named_with_the_nearest_known_one():
    with pytest.raises(ConfigError, match=r"variant x: key 'self_masc' is not known; did you mean 'self_mask'\?"):
        planner_config(content("integrated") | {"self_masc": "none"}, load_spec("sdm_b"), name="x")


def test_an_unknown_method_is_named_with_the_known_ones():
    with pytest.raises(ConfigError, match=r"sag = 'string' is not one of none, raise_terrain, springs"):
        planner_config(content("integrated") | {"sag": "string"}, load_spec("sdm_b"), name="x")


@pytest.mark.parametrize("key", sorted(CHOICES))
def test_every_missing_choice_is_named(key):
    incomplete = {k: v for k, v in content("integrated").items() if k != key}
    with pytest.raises(ConfigError, match=f"key '{key}' is missing"):
        planner_config(incomplete, load_spec("sdm_b"), name="x")


def test_a_variant_says_what_payload_is_carried():
    table = {"collision": {"payload_above": [2.2, 1.6, 1.5], "payload_below": [1.2, 1.0, 0.5]}}
    config = planner_config(content("integrated") | {"settings": table}, load_spec("sdm_b"), name="x").step.collision
    assert (config.payload_above, config.payload_below) == ((2.2, 1.6, 1.5), (1.2, 1.0, 0.5))
    assert config.terrain_clearance == pytest.approx(0.3 * 0.242)  # the rest of the stage stays
    wrong = {"collision": {"payload_below": [1.0, 0.0, 0.5]}}
    with pytest.raises(ConfigError, match=r"\[settings.collision\] payload_below is .*, must be three positive lengths"):
        planner_config(content("integrated") | {"settings": wrong}, load_spec("sdm_b"), name="x")


def test_settings_reach_their_stage_and_wrong_ones_are_refused():
    base = content("integrated")
    config = planner_config(base | {"settings": {"footfall": {"max_slope_deg": 15.0}}}, load_spec("sdm_b"), name="x")
    assert config.footfall.max_slope_deg == 15.0
    with pytest.raises(ConfigError, match=r"\[settings.footfall\] max_slop_deg is not known; did you mean 'max_slope_deg'"):
        planner_config(base | {"settings": {"footfall": {"max_slop_deg": 1.0}}}, load_spec("sdm_b"), name="x")
    with pytest.raises(ConfigError, match=r"\[settings.footfall\] max_slope_deg is -1.0, must be positive"):
        planner_config(base | {"settings": {"footfall": {"max_slope_deg": -1.0}}}, load_spec("sdm_b"), name="x")
    with pytest.raises(ConfigError, match=r"\[settings.feet\] is not known"):
        planner_config(base | {"settings": {"feet": {}}}, load_spec("sdm_b"), name="x")


def test_constants_measured_on_a_robot_take_the_place_of_the_drawings():
    base, spec = content("integrated"), load_spec("t12")
    drawn = planner_config(base, spec, name="x").step.sag.springs(spec)
    assert drawn.stiffness_z.tolist() == [spec.believed_foot_stiffness] * 6
    measured = [61e3, 48e3, 60e3, 62e3, 45e3, 64e3]
    config = planner_config(base | {"settings": {"sag": {"stiffness_z": measured}}}, spec, name="x")
    assert config.step.sag.springs(spec).stiffness_z.tolist() == measured
    for wrong in ([1.0, 2.0], [61e3, 48e3, 60e3, 62e3, 0.0, 64e3], [61e3, 48e3, float("nan"), 62e3, 45e3, 64e3]):
        with pytest.raises(ConfigError, match=r"\[settings.sag\] stiffness_z is .*, need six finite positive constants"):
            planner_config(base | {"settings": {"sag": {"stiffness_z": wrong}}}, spec, name="x")


def test_a_tilt_to_leave_alone_must_be_a_small_angle():
    with pytest.raises(ConfigError, match=r"level_deck_deg = 90 is not a number from 0 to 20"):
        planner_config(content("integrated") | {"level_deck_deg": 90}, load_spec("sdm_b"), name="x")


@pytest.mark.parametrize("method", CHOICES["footfall"])
def test_every_footfall_method_can_be_chosen_and_weighs_about_the_same(method):
    config = planner_config(content("integrated") | {"footfall": method}, load_spec("sdm_b"), name="x")
    assert config.footfall.method == method
    assert config.step.search.typical_terrain == TYPICAL[method]
    table = {"footfall": {"soil_n": 0.9, "footprint_diameter": 0.3}, "search": {"typical_terrain": 0.5}}
    own = planner_config(content("integrated") | {"footfall": method, "settings": table}, load_spec("sdm_b"), name="x")
    assert (own.footfall.soil_n, own.footfall.footprint_diameter, own.step.search.typical_terrain) == (0.9, 0.3, 0.5)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_variants_with_a_map_cost_heights_as_they_are(name):
    """The typical costs by which a step search weighs are of heights without their doubt."""
    config = planner_config(content(name), load_spec("sdm_b"), name=name)
    assert config.fusion_method == "flat" or config.footfall.deviations == 0.0


def test_the_shipped_variants_weigh_footfalls_as_the_step_search_does_by_itself():
    config = planner_config(content("integrated"), load_spec("sdm_b"), name="x")
    assert config.step.search.typical_terrain == SearchConfig().typical_terrain


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_a_robots_drawings_say_what_its_maps_and_axles_are_believed_and_a_variant_may_differ(robot):
    spec = load_spec(robot)
    drawn = planner_config(content("integrated"), spec, name="x")
    assert (drawn.fusion.sigma_common, drawn.wheel_fit.sink) == (spec.believed_map_sigma, spec.believed_sink)
    table = {"fusion": {"sigma_common": 0.02}, "wheel_fit": {"sink": 0.05}}
    own = planner_config(content("integrated") | {"settings": table}, spec, name="x")
    assert (own.fusion.sigma_common, own.wheel_fit.sink) == (0.02, 0.05)


def test_a_soil_that_bears_nothing_is_refused():
    with pytest.raises(ConfigError, match=r"\[settings.footfall\] soil_k is 0.0, must be positive"):
        planner_config(content("integrated") | {"settings": {"footfall": {"soil_k": 0.0}}}, load_spec("sdm_b"), name="x")


def test_only_a_variant_that_sways_has_settings_of_sway():
    assert planner_config(content("integrated"), load_spec("sdm_b"), name="x").step.sway is None
    swaying = content("sway") | {"settings": {"sway": {"span": 0.05}}}
    assert planner_config(swaying, load_spec("sdm_b"), name="x").step.sway.span == 0.05
    changed = {key for key in CHOICES if content("sway")[key] != content("integrated")[key]}
    assert changed == {"body_motion"}
