"""A variant's content as one nested configuration: a method for each stage, and the methods' own settings.

Scripts read the TOML file, lay the variant that it names as its `base` under it, and hand the whole here; the planner opens
nothing. Top-level keys choose methods:

    self_mask = "combined"          # flatten, kinematic, watershed, combined, none
    fusion = "integrated"           # single_view (the map is the latest set of pictures), lift_and_image (2010: the next
                                    # leg lifts, the map is the pictures since), integrated (of all pictures; also called
                                    # over_time), flat (no pictures: the ground is the plane of the wheels)
    localisation = "filter"         # wheels, wheels_and_map (all is believed that depth aligned to the map says), icp (the same
                                    # with Open3D's registration), filter (Kalman filter of wheels, attitude and map)
    sag = "springs"                 # none, raise_terrain, springs
    margin = "cps"                  # cps, support, energy
    footfall = "free_volume"        # max_min, plane_fit, support_area, support_energy, free_volume, equilibrium, asv_slope
    leg_planner = "sbl"             # sbl, or one of OMPL's
    smoothing = "dijkstra_bisect"
    gait = "reverse_wave"           # reverse_wave, single_steps (2008: the leg whose wheel is farthest behind, whatever stepped before)
    body_motion = "straight"        # straight, sway (off the path to where the next swing asks least of the joints, footfalls kept)
    touchdown = "guarded"           # guarded (until the wheel carries its share), planned (to a height, without feeling the ground)
    unknown_terrain = "refuse"      # refuse, flat (an unknown cell is as high as its neighbours)
    level_deck_deg = 0.5

A variant may also say, and need not:

    route = "straight"              # straight (towards the goal), map (round what the map refuses)
    driving = "off"                 # off, on (on the wheels where a route over the map says so)

and a table `[settings.STAGE]` sets fields of that stage's configuration, such as `[settings.footfall] max_slope_deg = 15`. What is
carried stands there too: `[settings.collision] payload_above = [2.2, 1.6, 1.5]`, and `payload_below` as at Moses Lake [m].
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from athlete_twin.errors import AthleteError, ConfigError
from athlete_twin.model.spec import RobotSpec
from planner.footfall import METHODS as FOOTFALLS
from planner.footfall import FootfallConfig
from planner.footfall_scores import TYPICAL
from planner.gait.aside import AsideConfig
from planner.gait.body_sway import BodySwayConfig
from planner.gait.lift_and_look import LookConfig
from planner.gait.shift import ShiftLimits
from planner.gait.skeleton import GAITS, GaitConfig
from planner.gait.step_search import TOUCHDOWNS, SearchConfig, StepConfig, TouchdownConfig
from planner.gait.survey import SurveyConfig
from planner.motion.collision import CollisionConfig
from planner.motion.planners import METHODS as LEG_PLANNERS
from planner.motion.relief import ReliefConfig
from planner.motion.sbl import SblConfig
from planner.motion.smoothing import SmoothingConfig
from planner.motion.swing import SwingConfig
from planner.perception.bundle import BundleConfig
from planner.perception.localise import AlignConfig, WheelFitConfig
from planner.perception.pose_filter import PoseFilterConfig
from planner.perception.self_clearance import SelfClearanceConfig
from planner.perception.self_mask import METHODS as SELF_MASKS
from planner.perception.self_mask import SelfMaskConfig
from planner.perception.stereo import StereoConfig
from planner.route.drive import DriveConfig
from planner.route.guide import METHODS as ROUTES
from planner.route.guide import HeadingConfig
from planner.route.places import RouteConfig
from planner.sag.compensate import SagConfig
from planner.stability.margin import MARGINS
from planner.stability.stability_map import StabilityConfig
from planner.terrain.fusion import FusionConfig
from planner.terrain.spikes import SpikeConfig

CHOICES: dict[str, tuple[str, ...]] = {
    "self_mask": SELF_MASKS,
    "fusion": ("single_view", "lift_and_image", "integrated", "over_time", "flat"),
    "localisation": ("wheels", "wheels_and_map", "icp", "filter"),
    "sag": ("none", "raise_terrain", "springs"),
    "margin": MARGINS,
    "footfall": FOOTFALLS,
    "leg_planner": LEG_PLANNERS,
    "smoothing": ("dijkstra_bisect", "least_torque"),
    "gait": GAITS,
    "body_motion": ("straight", "sway"),
    "touchdown": TOUCHDOWNS,
    "unknown_terrain": ("refuse", "flat"),
}
OPTIONAL: dict[str, tuple[str, ...]] = {"route": ROUTES, "driving": ("off", "on")}
"""choices that a variant may leave out: the first is taken then"""
ALIASES = {"over_time": "integrated"}
"""older names of methods"""
SETTINGS: dict[str, type] = {
    "stereo": StereoConfig,
    "self_mask": SelfMaskConfig,
    "self_clearance": SelfClearanceConfig,
    "fusion": FusionConfig,
    "spikes": SpikeConfig,
    "bundle": BundleConfig,
    "localisation": AlignConfig,
    "pose_filter": PoseFilterConfig,
    "wheel_fit": WheelFitConfig,
    "sag": SagConfig,
    "footfall": FootfallConfig,
    "collision": CollisionConfig,
    "leg_planner": SblConfig,
    "smoothing": SmoothingConfig,
    "relief": ReliefConfig,
    "gait": GaitConfig,
    "search": SearchConfig,
    "touchdown": TouchdownConfig,
    "shift": ShiftLimits,
    "survey": SurveyConfig,
    "look": LookConfig,
    "route": RouteConfig,
    "headings": HeadingConfig,
    "drive": DriveConfig,
    "aside": AsideConfig,
    "sway": BodySwayConfig,
}


WIDE_PRIOR = {"sigma_xy": 0.1, "sigma_z": 0.1, "sigma_tilt": 0.02, "sigma_yaw": 0.03}
"""of an alignment whose result a filter weighs: what wheels say must not count twice [m], [rad]"""
CLEARANCE = 0.3
"""of a swinging leg from the terrain, over the wheel's radius: what sag is not foreseen grows with the robot"""


@dataclass(frozen=True, kw_only=True)
class PlannerConfig:
    """One variant of the planner for one robot."""

    name: str
    fusion_method: str
    localisation_method: str
    unknown_terrain: str
    stereo: StereoConfig
    self_mask: SelfMaskConfig
    self_clearance: SelfClearanceConfig
    fusion: FusionConfig
    spikes: SpikeConfig
    bundle: BundleConfig
    align: AlignConfig
    pose_filter: PoseFilterConfig
    wheel_fit: WheelFitConfig
    footfall: FootfallConfig
    survey: SurveyConfig
    look: LookConfig
    step: StepConfig
    route_method: str = "straight"
    driving: bool = False
    route: RouteConfig = field(default_factory=RouteConfig)
    headings: HeadingConfig = field(default_factory=HeadingConfig)
    drive: DriveConfig = field(default_factory=DriveConfig)
    aside: AsideConfig = field(default_factory=AsideConfig)


def planner_config(content: Mapping[str, Any], spec: RobotSpec, *, name: str) -> PlannerConfig:
    """The configuration from a variant's content; an unknown key or value is refused with what would have worked.

    Args:
        content: as read from the variant's TOML file.
        spec: the drawings of the robot, which give the stability rule its margin.
        name: what to call the variant in errors and results, such as its file's name.
    """
    known = (*CHOICES, *OPTIONAL, "level_deck_deg", "settings")
    for key in content:
        if key not in known:
            raise ConfigError(f"variant {name}: key {key!r} is not known; {_meant(key, known)}")
    chosen = {}
    for key, options in (CHOICES | OPTIONAL).items():
        if key not in content and key not in OPTIONAL:
            raise ConfigError(f"variant {name}: key {key!r} is missing; choose one of {', '.join(options)}")
        value = content.get(key, options[0])
        if value not in options:
            raise ConfigError(f"variant {name}: {key} = {value!r} is not one of {', '.join(options)}")
        chosen[key] = ALIASES.get(str(value), str(value))
    if chosen["driving"] == "on" and chosen["route"] != "map":
        raise ConfigError(f"variant {name}: driving = 'on' needs route = 'map': only a route says where it is smooth enough")
    level = content.get("level_deck_deg", 0.0)
    if not isinstance(level, int | float) or not np.isfinite(level) or not 0.0 <= level <= 20.0:
        raise ConfigError(f"variant {name}: level_deck_deg = {level!r} is not a number from 0 to 20")
    own = content.get("settings", {})
    for stage in own:
        if stage not in SETTINGS:
            raise ConfigError(f"variant {name}: [settings.{stage}] is not known; {_meant(stage, tuple(SETTINGS))}")
    extra: dict[str, float] = {
        "level_deck_deg": float(level),
        "sigma_common": spec.believed_map_sigma,
        "sink": spec.believed_sink,
        "terrain_clearance": CLEARANCE * spec.wheel.radius,
        "typical_terrain": TYPICAL[chosen["footfall"]],
    }
    if chosen["localisation"] == "filter":
        extra |= WIDE_PRIOR
    made = {
        stage: _settings(name, stage, own.get(stage, {}), chosen.get(stage), extra)
        for stage in SETTINGS
    }
    relief = made["relief"] if chosen["smoothing"] == "least_torque" else None
    swing = SwingConfig(sbl=made["leg_planner"], smoothing=made["smoothing"], relief=relief)
    return PlannerConfig(
        name=name,
        fusion_method=chosen["fusion"],
        localisation_method=chosen["localisation"],
        unknown_terrain=chosen["unknown_terrain"],
        stereo=made["stereo"],
        self_mask=made["self_mask"],
        self_clearance=made["self_clearance"],
        fusion=made["fusion"],
        spikes=made["spikes"],
        bundle=made["bundle"],
        align=made["localisation"],
        pose_filter=made["pose_filter"],
        wheel_fit=made["wheel_fit"],
        footfall=made["footfall"],
        survey=made["survey"],
        look=made["look"],
        step=StepConfig(
            gait=made["gait"],
            search=made["search"],
            touchdown=made["touchdown"],
            sag=made["sag"],
            stability=StabilityConfig(min_margin=spec.min_support_margin, all_down=chosen["margin"]),
            collision=made["collision"],
            swing=swing,
            leg_planner=chosen["leg_planner"],
            shift=made["shift"],
            sway=made["sway"] if chosen["body_motion"] == "sway" else None,
        ),
        route_method=chosen["route"],
        driving=chosen["driving"] == "on",
        route=made["route"],
        headings=made["headings"],
        drive=made["drive"],
        aside=made["aside"],
    )


def _settings(name: str, stage: str, own: Mapping[str, Any], method: str | None, extra: Mapping[str, Any]) -> Any:
    kind = SETTINGS[stage]
    fields = {f.name for f in dataclasses.fields(kind)}
    values: dict[str, Any] = {k: v for k, v in extra.items() if k in fields}
    if method is not None and "method" in fields:
        values["method"] = method
    for key, value in own.items():
        if key not in fields or key == "method":
            raise ConfigError(
                f"variant {name}: [settings.{stage}] {key} is not known; {_meant(key, tuple(sorted(fields - {'method'})))}"
            )
        values[key] = tuple(value) if isinstance(value, list) else value
    try:
        return kind(**values)
    except (AthleteError, TypeError, ValueError) as e:
        raise ConfigError(f"variant {name}: [settings.{stage}] {' '.join(str(e).split())}") from e


def _meant(key: str, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(key, known, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(known)}"
