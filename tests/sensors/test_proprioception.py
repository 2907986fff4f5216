import zlib

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.sensors.proprioception import Proprioception, ProprioceptionNoise

STIFFNESS = np.array([1e5, 1e5, 5e4, 5e4, 3e4, 3e4])
STEP = 2 * np.pi / 2**16
POSE = SE3.from_rpy(0.02, -0.03, 0.1, np.array([1.0, 2.0, 1.75]))
AT_REST = {"rates_in_hex": np.zeros(3), "acceleration_in_hex": np.array([0.0, 0.0, 9.81])}
JOINTS = np.random.default_rng(5).uniform(-1, 1, (6, 6))


def measured(sensors, joints=JOINTS, motors=JOINTS, t=0.0, index=0):
    return sensors.measure(joints, motors, stiffness=STIFFNESS, world_from_hex=POSE, t=t, index=index, **AT_REST)


def sensors(zero=None, **noise):
    zero = np.zeros((6, 6)) if zero is None else zero
    return Proprioception(seed=3, encoder_zero=zero, noise=ProprioceptionNoise(**noise))


def test_encoders_read_the_angle_plus_their_zero_error_within_half_a_step():
    zero = np.deg2rad(0.1) * np.random.default_rng(1).standard_normal((6, 6))
    error = measured(sensors(zero)).joints - JOINTS - zero
    assert np.abs(error).max() <= 0.5 * STEP + 1e-12


def test_torque_is_read_from_the_spring_within_one_encoder_step():
    torque = np.random.default_rng(2).uniform(-800, 800, (6, 6))
    read = measured(sensors(), motors=JOINTS + torque / STIFFNESS).torques
    assert (np.abs(read - torque) <= STEP * STIFFNESS + 1e-9).all()


def test_the_streams_of_noise_are_those_of_recorded_trials():
    """After the numbers that a reading once drew for its torques come attitude, rates and acceleration."""
    read = measured(sensors(), index=7)
    rng = np.random.default_rng([3, zlib.crc32(b"proprioception"), 7])
    rng.standard_normal((6, 6))
    assert read.attitude_rpy[:2] == pytest.approx([0.02, -0.03] + np.deg2rad(0.05) * rng.standard_normal(2))
    assert read.rates == pytest.approx(5e-4 * rng.standard_normal(3))


def test_attitude_noise_has_its_level_and_rates_theirs():
    unit = sensors()
    readings = [measured(unit, index=i) for i in range(1500)]
    tilt = np.array([r.attitude_rpy[:2] for r in readings]) - [0.02, -0.03]
    assert np.rad2deg(tilt.std()) == pytest.approx(0.05, rel=0.08)
    assert np.array([r.rates for r in readings]).std() == pytest.approx(5e-4, rel=0.08)
    assert np.mean([r.acceleration[2] for r in readings]) == pytest.approx(9.81, abs=1e-3)


def test_yaw_walks_as_the_root_of_time():
    drift = []
    for seed in range(200):
        unit = Proprioception(seed=seed, encoder_zero=np.zeros((6, 6)))
        drift.append(measured(unit, t=225.0).attitude_rpy[2] - 0.1)
    assert np.rad2deg(np.std(drift)) == pytest.approx(0.5 * np.sqrt(225 / 3600), rel=0.2)


def test_reading_more_often_changes_no_other_reading():
    often, seldom = sensors(), sensors()
    for i in range(20):
        measured(often, t=float(i), index=i)
    a, b = measured(often, t=20.0, index=20), measured(seldom, t=20.0, index=20)
    for name, value in a.fields().items():
        assert value.tobytes() == getattr(b, name).tobytes()


def test_unusable_noise_is_refused():
    with pytest.raises(ConfigError, match="encoder_bits is 4, must be 8 to 32"):
        ProprioceptionNoise(encoder_bits=4)
    with pytest.raises(ConfigError, match="noise rate is -1"):
        ProprioceptionNoise(rate=-1.0)
