"""The drawings of a robot, read from `spec.toml`: geometry, masses, limits, cameras. Known to both sides of the link.

A figure in the file is a table `{ value, unit, label, source }`; the label says how sure it is (PUB, CAD, INF, EST).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from athlete_twin.assets import read_toml, robot_dir
from athlete_twin.errors import AthleteError, ConfigError
from athlete_twin.geometry.arrays import LegJoints, PerLeg, Vec3, Wheels
from athlete_twin.model.camera import CHASSIS, Pinhole, StereoCamera, mounted, mounted_beside
from athlete_twin.model.spec_entries import Entries

LABELS = ("PUB", "CAD", "INF", "EST")
LEGS = 6

CAMERA_KEYS = {"group", "hfov_deg", "baseline", "size_px"}
CHASSIS_CAMERA_KEYS = {"azimuth_deg", "radius", "height", "look", "pitch_down_deg"}
LEG_CAMERA_KEYS = {"legs", "link", "place", "tilt_deg"}
"""what a `[[camera]]` table may say: of every pair, of one on the chassis, of one on a leg"""


@dataclass(frozen=True, kw_only=True)
class JointSpec:
    """One joint of a leg and the link behind it."""

    name: str
    axis: Vec3
    """in the leg's frame at zero pose"""
    offset: Vec3
    """from the joint before, at zero pose [m]"""
    lower: float
    """[rad]"""
    upper: float
    """[rad]"""
    torque: float
    """limit [N m]"""
    link_mass: float
    """[kg]"""
    link_com: Vec3
    """in the joint's frame [m]"""


@dataclass(frozen=True, kw_only=True)
class WheelSpec:
    """The wheel at the end of every leg."""

    offset: Vec3
    """axle from the last joint at zero pose [m]"""
    radius: float
    """unloaded [m]"""
    width: float
    """[m]"""
    mass: float
    """[kg]"""
    pressure: float
    """nominal, above ambient [Pa]"""


@dataclass(frozen=True, kw_only=True)
class BodyPart:
    """A solid of the chassis in the hex frame: a box, or a hexagonal ring with vertices on the legs' azimuths."""

    name: str
    shape: str
    """"box" or "hexagon_ring" """
    centre: Vec3
    """of its bounding box [m]"""
    size: Vec3
    """of a box along x, y, z; of a ring: outer vertex radius, inner vertex radius, height [m]"""


@dataclass(frozen=True, kw_only=True)
class DeckSpec:
    """A Tri-ATHLETE deck docked to the pallet: drawn rigid, in truth it flexes at the dock."""

    name: str
    mass: float
    """[kg]"""
    part: BodyPart
    dock: Vec3
    """where it docks, hex frame [m]"""
    legs: tuple[int, ...]
    """indices 0 to 5 of the legs it carries"""


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """The drawings of one robot."""

    name: str
    title: str
    joints: tuple[JointSpec, ...]
    """of one leg, from the hip to the ankle; all legs are alike"""
    hips_in_hex: Wheels
    """hip-yaw axes in the hex plane, shape (6, 3) [m]"""
    hip_azimuths: PerLeg
    """direction of each leg's x axis in hex [rad]"""
    wheel: WheelSpec
    body_mass: float
    """chassis without decks and legs [kg]"""
    body_com: Vec3
    """[m]"""
    body_parts: tuple[BodyPart, ...]
    decks: tuple[DeckSpec, ...]
    top_in_hex: float
    """height of the deck plane that published chassis heights refer to, in hex [m]"""
    payload_limit: float
    """[kg]"""
    speed_loaded: float
    """of a joint that carries weight [rad/s]"""
    speed_unloaded: float
    """of a joint of a leg in the air [rad/s]"""
    acceleration_unloaded: float
    """of a joint of a leg in the air: an estimate, none is published, and not a limit that the true motors have [rad/s2]"""
    ratchet: float | None
    """torque over its limit that no gear of a joint holds without skipping a tooth; None for gears that do not ratchet"""
    drive_speed: float
    """on its wheels at most [m/s]"""
    foot_radius: float
    """of the axles from the hex's z axis in the normal stance [m]"""
    foot_azimuths: PerLeg
    """of the axles about the hex's z axis in the normal stance [rad]"""
    chassis_height: float
    """of the hex origin above the ground in the normal stance, before sag [m]"""
    stride: float
    """of one gait cycle on open ground [m]"""
    min_support_margin: float
    """of the stability rule [m]"""
    hip_pitch_rule: tuple[float, float] | None
    """of a leg with a redundant pitch joint: hip pitch with the wheel below the hip-pitch axis [rad], and its change per
    metre further out [rad/m], which keeps the peak torque near its least; None where the leg has none"""
    believed_foot_stiffness: float
    """vertical spring a foot, [SunSpiral2012] eq. 3 [N/m]"""
    believed_tyre_stiffness: float
    """vertical spring of the tyre alone [N/m]"""
    believed_tyre_tangent: float
    """of one tyre along gravity, by how much an axle moves as load comes or goes while another leg is in the air [N/m]"""
    believed_dock_twist: float | None
    """of each of the docks, None without docks [N m/rad]"""
    believed_lateral_ratio: float
    """horizontal over vertical stiffness"""
    believed_sink: float
    """by which axles stand lower than the tyres' springs say, the wheels in soil and the chassis bent between them [m]"""
    believed_map_sigma: float
    """of the height of all that its cameras see at once, from their mountings and the chassis between them and the wheels [m]"""
    cameras: tuple[StereoCamera, ...]

    @property
    def dof(self) -> int:
        """Kinematic joints of one leg."""
        return len(self.joints)

    @property
    def leg_mass(self) -> float:
        """Of one leg with its wheel [kg]."""
        return float(sum(joint.link_mass for joint in self.joints) + self.wheel.mass)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of one leg's joints, hip to ankle."""
        return tuple(j.name for j in self.joints)

    @property
    def lower(self) -> LegJoints:
        """Lower limits of one leg [rad]."""
        return np.array([j.lower for j in self.joints])

    @property
    def upper(self) -> LegJoints:
        """Upper limits of one leg [rad]."""
        return np.array([j.upper for j in self.joints])

    @property
    def torque_limits(self) -> LegJoints:
        """Torque limits of one leg [N m]."""
        return np.array([j.torque for j in self.joints])

    @property
    def mass(self) -> float:
        """Of the whole robot without payload [kg]."""
        leg = sum(j.link_mass for j in self.joints) + self.wheel.mass
        return self.body_mass + sum(d.mass for d in self.decks) + LEGS * leg

    def camera(self, name: str) -> StereoCamera:
        """A stereo pair by its name."""
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(c.name for c in self.cameras)
        raise ConfigError(f"camera {name!r} is not on {self.name}; it has: {known}")


@lru_cache(maxsize=8)
def load_spec(robot: str) -> RobotSpec:
    """The drawings of a robot by its name, such as "sdm_b"."""
    path = robot_dir(robot) / "spec.toml"
    content = read_toml(path)
    try:
        return spec_from_content(content)
    except ConfigError as e:
        raise ConfigError(f"{path}: {e}") from e


def spec_from_content(content: dict[str, Any]) -> RobotSpec:
    """The drawings from the content of a `spec.toml`; what cannot be used is refused with the name of its key."""
    entries = Entries(content)
    try:
        return _drawn(entries)
    except (AthleteError, TypeError, ValueError, AttributeError, LookupError, ArithmeticError) as e:
        told = " ".join(str(e).split())
        raise ConfigError(told if entries.last in told else f"{entries.last or 'the file'} is not usable: {told}") from e


def _drawn(content: Entries) -> RobotSpec:
    hips, wheel, body = content["hips"], content["wheel"], content["body"]
    belief, stance, motion = content["belief"], content["stance"], content["motion"]
    hips_in_hex = np.column_stack([figure(hips["x"]), figure(hips["y"]), np.zeros(LEGS)])
    return RobotSpec(
        name=content["robot"]["name"],
        title=content["robot"]["title"],
        joints=tuple(_joint(j) for j in content["joint"]),
        hips_in_hex=hips_in_hex,
        hip_azimuths=np.deg2rad(figure(hips["azimuth_deg"])),
        wheel=WheelSpec(
            offset=figure(wheel["offset"]),
            radius=figure(wheel["radius"]),
            width=figure(wheel["width"]),
            mass=figure(wheel["mass"]),
            pressure=1000.0 * figure(wheel["pressure_kpa"]),
        ),
        body_mass=figure(body["mass"]),
        body_com=figure(body["com"]),
        body_parts=tuple(_part(p) for p in body["part"]),
        decks=tuple(_deck(d) for d in content.get("deck", [])),
        top_in_hex=figure(body["top_in_hex"]),
        payload_limit=figure(body["payload_limit"]),
        speed_loaded=figure(motion["speed_loaded"]),
        ratchet=figure(motion["ratchet"]) if "ratchet" in motion else None,
        drive_speed=figure(motion["drive_speed_kmh"]) / 3.6,
        speed_unloaded=figure(motion["speed_unloaded"]),
        acceleration_unloaded=figure(motion["acceleration_unloaded"]),
        foot_radius=figure(stance["foot_radius"]),
        foot_azimuths=np.deg2rad(figure(stance["foot_azimuth_deg"]))
        if "foot_azimuth_deg" in stance
        else np.arctan2(hips_in_hex[:, 1], hips_in_hex[:, 0]),
        chassis_height=figure(stance["chassis_height"]),
        stride=figure(stance["stride"]),
        min_support_margin=figure(stance["min_support_margin"]),
        hip_pitch_rule=_hip_pitch_rule(stance),
        believed_foot_stiffness=figure(belief["foot_stiffness_z"]),
        believed_tyre_stiffness=figure(belief["tyre_stiffness_z"]),
        believed_tyre_tangent=figure(belief["tyre_tangent_z"]),
        believed_lateral_ratio=figure(belief["lateral_ratio"]),
        believed_sink=figure(belief["sink"]),
        believed_map_sigma=figure(belief["map_sigma"]),
        believed_dock_twist=figure(belief["dock_twist"]) if "dock_twist" in belief else None,
        cameras=tuple(c for group in content["camera"] for c in _cameras(group)),
    )


def figure(entry: Any) -> Any:
    """Value of a labelled figure: a float, or a read-only array."""
    if not isinstance(entry, Mapping):
        raise ConfigError(f"figure {entry!r} must be a table with value, unit, label and source")
    label = entry.get("label")
    if label not in LABELS or not entry.get("source"):
        raise ConfigError(f"figure {entry} needs a source and a label out of {', '.join(LABELS)}, has {label!r}")
    value = entry["value"]
    if isinstance(value, list):
        array = np.array(value, dtype=float)
        if not np.isfinite(array).all():
            raise ConfigError(f"figure {entry} is not finite")
        array.setflags(write=False)
        return array
    if not np.isfinite(value):
        raise ConfigError(f"figure {entry} is not finite")
    return float(value)


def _hip_pitch_rule(stance: Entries) -> tuple[float, float] | None:
    if "hip_pitch_deg" not in stance:
        return None
    return float(np.deg2rad(figure(stance["hip_pitch_deg"]))), float(np.deg2rad(figure(stance["hip_pitch_slope_deg"])))


def _joint(entry: Entries) -> JointSpec:
    lower, upper = np.deg2rad(figure(entry["limits_deg"]))
    return JointSpec(
        name=entry["name"],
        axis=np.array(entry["axis"], dtype=float),
        offset=figure(entry["offset"]),
        lower=float(lower),
        upper=float(upper),
        torque=figure(entry["torque"]),
        link_mass=figure(entry["link_mass"]),
        link_com=figure(entry["link_com"]),
    )


def _part(entry: Entries) -> BodyPart:
    if entry["shape"] == "hexagon_ring":
        low, high = figure(entry["z_range"])
        size = np.array([figure(entry["vertex_radius"]), figure(entry["inner_vertex_radius"]), high - low])
        centre = np.array([0.0, 0.0, 0.5 * (low + high)])
        return BodyPart(name=entry["name"], shape="hexagon_ring", centre=centre, size=size)
    if entry["shape"] == "box":
        return BodyPart(name=entry["name"], shape="box", centre=figure(entry["centre"]), size=figure(entry["size"]))
    raise ConfigError(f"shape {entry['shape']!r} of part {entry['name']!r} is not one of: box, hexagon_ring")


def _deck(entry: Entries) -> DeckSpec:
    part = BodyPart(name=entry["name"], shape="box", centre=figure(entry["centre"]), size=figure(entry["size"]))
    legs = tuple(int(leg) - 1 for leg in entry["legs"])
    return DeckSpec(name=entry["name"], mass=figure(entry["mass"]), part=part, dock=figure(entry["dock"]), legs=legs)


def _cameras(group: Entries) -> list[StereoCamera]:
    """The pairs of one group: on the chassis at `azimuth_deg`, or beside the last link of `legs`."""
    on_legs = "legs" in group
    unknown = set(group) - (CAMERA_KEYS | (LEG_CAMERA_KEYS if on_legs else CHASSIS_CAMERA_KEYS))
    if unknown:
        where = "legs" if on_legs else "the chassis"
        raise ConfigError(f"camera group {group.get('group')!r} on {where}: key {sorted(unknown)[0]!r} is not known")
    width, height = (int(n) for n in figure(group["size_px"]))
    eye = Pinhole.from_fov(width, height, float(np.deg2rad(figure(group["hfov_deg"]))))
    baseline = figure(group["baseline"])
    if on_legs:
        beside = mounted_beside(figure(group["place"]), float(np.deg2rad(figure(group["tilt_deg"]))), baseline)
        places = [(f"leg{int(leg)}_{group['link']}", beside) for leg in figure(group["legs"])]
    else:
        pitch = float(np.deg2rad(figure(group["pitch_down_deg"])))
        radius, z, look = figure(group["radius"]), figure(group["height"]), group["look"]
        azimuths = np.deg2rad(figure(group["azimuth_deg"]))
        places = [(CHASSIS, mounted(float(a), radius, z, look, pitch, baseline)) for a in azimuths]
    return [
        StereoCamera(
            name=f"{group['group']}_{number}", group=group["group"], link=link, link_from_camera=at, baseline=baseline, eye=eye
        )
        for number, (link, at) in enumerate(places, start=1)
    ]
