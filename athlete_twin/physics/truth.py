"""What the robot really is: true compliance, spreads and noise from `truth.toml`, and one trial's draw of them.

Only physics/, world/ and sensors/ read this. Each stream of the draw has its own generator keyed by (seed, stream), so
that one more camera or joint does not move the others.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from athlete_twin.assets import read_toml, robot_dir
from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Joints, LegJoints, PerLeg
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.spec import LEGS, RobotSpec, figure
from athlete_twin.model.spec_entries import Entries

SMALLEST_SCALE = 0.5
"""a drawn scale is cut off here: a tyre with no air is a fault, not a spread"""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The true figures of a robot type, before a trial's draw."""

    joint_stiffness: LegJoints
    """series stiffness of one leg's joints [N m/rad]"""
    joint_damping_ratio: float
    joint_armature: float
    """reflected rotor inertia of the four distal joints of a leg [kg m2]"""
    joint_friction: float
    """Coulomb, over the torque limit"""
    joint_holding: float
    """torque at which a standing motor's brake slips, over the limit"""
    joint_ratchet: float
    """torque at which a tooth slips, over the limit; 0 for gears that do not ratchet"""
    joint_tooth: float
    """by which a slipped tooth sets the link back [rad]"""
    tyre_k1: float
    """[N/m]"""
    tyre_k2: float
    """[N/m2]"""
    tyre_lateral_stiffness: float
    """[N/m]"""
    tyre_damping_ratio: float
    tyre_drive_torque: float
    """of a wheel's motor at most [N m]"""
    dock_bend_stiffness: float
    """[N m/rad]"""
    dock_twist_stiffness: float
    """[N m/rad]"""
    dock_damping_ratio: float
    spread_tyre: float
    """one sigma, relative"""
    spread_mass: float
    """one sigma, relative"""
    spread_encoder: float
    """one sigma [rad]"""
    spread_camera_position: float
    """one sigma [m]"""
    spread_camera_rotation: float
    """one sigma [rad]"""
    encoder_bits: float
    attitude_noise: float
    """one sigma [rad]"""
    yaw_drift: float
    """random walk, one sigma [rad/sqrt(h)]"""
    rate_noise: float
    """[rad/s]"""
    acceleration_noise: float
    """[m/s2]"""


@dataclass(frozen=True, kw_only=True)
class TrialTruth:
    """One trial's robot: the truth of its type with this unit's deviations."""

    truth: Truth
    seed: int
    tyre_scale: PerLeg
    """stiffness of each tyre over the nominal one"""
    mass_scale: dict[str, float]
    """of each link, by its URDF name"""
    encoder_zero: Joints
    """what the encoders read too much, shape (6, dof) [rad]"""
    camera_error: dict[str, SE3]
    """`drawn_camera_from_true_camera` of each stereo pair"""


def generator(seed: int, stream: str, index: int = 0) -> np.random.Generator:
    """The random generator of one named stream of one trial."""
    return np.random.default_rng([seed, zlib.crc32(stream.encode()), index])


@lru_cache(maxsize=8)
def load_truth(robot: str) -> Truth:
    """The truth of a robot by its name."""
    path = robot_dir(robot) / "truth.toml"
    c = Entries(read_toml(path))
    try:
        return Truth(
            joint_stiffness=figure(c["joint"]["stiffness"]),
            joint_damping_ratio=figure(c["joint"]["damping_ratio"]),
            joint_armature=figure(c["joint"]["armature"]),
            joint_friction=figure(c["joint"]["friction"]),
            joint_holding=figure(c["joint"]["holding"]),
            joint_ratchet=figure(c["joint"]["ratchet"]),
            joint_tooth=float(np.deg2rad(figure(c["joint"]["tooth_deg"]))),
            tyre_k1=figure(c["tyre"]["k1"]),
            tyre_k2=figure(c["tyre"]["k2"]),
            tyre_lateral_stiffness=figure(c["tyre"]["lateral_stiffness"]),
            tyre_damping_ratio=figure(c["tyre"]["damping_ratio"]),
            tyre_drive_torque=figure(c["tyre"]["drive_torque"]),
            dock_bend_stiffness=figure(c["dock"]["bend_stiffness"]),
            dock_twist_stiffness=figure(c["dock"]["twist_stiffness"]),
            dock_damping_ratio=figure(c["dock"]["damping_ratio"]),
            spread_tyre=figure(c["spread"]["tyre_stiffness"]),
            spread_mass=figure(c["spread"]["link_mass"]),
            spread_encoder=float(np.deg2rad(figure(c["spread"]["encoder_zero_deg"]))),
            spread_camera_position=figure(c["spread"]["camera_position"]),
            spread_camera_rotation=float(np.deg2rad(figure(c["spread"]["camera_rotation_deg"]))),
            encoder_bits=figure(c["noise"]["encoder_bits"]),
            attitude_noise=float(np.deg2rad(figure(c["noise"]["attitude_deg"]))),
            yaw_drift=float(np.deg2rad(figure(c["noise"]["yaw_drift_deg_per_hour"]))),
            rate_noise=figure(c["noise"]["rate"]),
            acceleration_noise=figure(c["noise"]["acceleration"]),
        )
    except ConfigError as e:
        raise ConfigError(f"{path}: {e}") from e
    except (TypeError, ValueError, AttributeError) as e:
        raise ConfigError(f"{path}: {c.last} is not usable: {e}") from e


def draw_truth(spec: RobotSpec, seed: int, *, link_names: tuple[str, ...], truth: Truth | None = None) -> TrialTruth:
    """One trial's robot, drawn from its seed."""
    truth = load_truth(spec.name) if truth is None else truth
    tyres = 1.0 + truth.spread_tyre * generator(seed, "tyre").standard_normal(LEGS)
    zero = truth.spread_encoder * generator(seed, "encoder_zero").standard_normal((LEGS, spec.dof))
    mass = {n: 1.0 + truth.spread_mass * float(generator(seed, f"mass_{n}").standard_normal()) for n in link_names}
    cameras = {}
    for camera in spec.cameras:
        rng = generator(seed, f"camera_{camera.name}")
        shift = truth.spread_camera_position * rng.standard_normal(3)
        turn = truth.spread_camera_rotation * rng.standard_normal(3)
        cameras[camera.name] = SE3.from_rotvec(turn, shift)
    return TrialTruth(
        truth=truth,
        seed=seed,
        tyre_scale=np.maximum(tyres, SMALLEST_SCALE),
        mass_scale={n: max(s, SMALLEST_SCALE) for n, s in mass.items()},
        encoder_zero=zero,
        camera_error=cameras,
    )


def nominal_truth(spec: RobotSpec, *, link_names: tuple[str, ...] = ()) -> TrialTruth:
    """The truth of a robot type with no spread: for validation against closed forms."""
    return TrialTruth(
        truth=load_truth(spec.name),
        seed=0,
        tyre_scale=np.ones(LEGS),
        mass_scale=dict.fromkeys(link_names, 1.0),
        encoder_zero=np.zeros((LEGS, spec.dof)),
        camera_error={c.name: SE3.identity() for c in spec.cameras},
    )
