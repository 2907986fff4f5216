"""The filter's covariance is honest, a slip opens it, and a refused alignment leaves what wheels and attitude say."""

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.se3 import SE3
from planner.perception.localise import Alignment, refused_alignment
from planner.perception.pose_filter import PoseFilter, PoseFilterConfig

ANGLES = np.deg2rad(60.0 * np.arange(6))
CONTACTS = np.column_stack([2.0 * np.cos(ANGLES), 2.0 * np.sin(ANGLES), np.zeros(6)])
HEX = np.array([0.0, 0.0, 1.7])
ALL = np.ones(6, dtype=bool)
INFORMATION = np.diag([1 / 0.002**2, 1 / 0.002**2, 1 / 0.004**2, 1 / 0.01**2, 1 / 0.01**2, 1 / 0.003**2])


def alignment(correction, *, information=INFORMATION):
    return Alignment(
        correction=correction, rmse=0.01, rmse_before=0.02, inliers=900, overlap=1000, accepted=True, reason="",
        middle=HEX, information=information,
    )  # fmt: skip


def test_normalised_error_is_as_large_as_the_covariance_says():
    """Errors drawn from the filter's own model: their mean square over the covariance is the state's dimension, 6."""
    rng, config = np.random.default_rng(1), PoseFilterConfig(gate=0.999999)
    floor = np.diag([config.mount_turn**2] * 3 + [config.mount_shift**2] * 3)
    measured = np.linalg.inv(INFORMATION + np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])) + floor
    values = []
    for _ in range(40):
        pose = PoseFilter(config=config)
        error = rng.multivariate_normal(np.zeros(6), pose.covariance)
        for _ in range(5):
            before = pose.covariance
            pose.moved(CONTACTS, HEX, planted=ALL, fit_rmse=0.0)
            error = error + rng.multivariate_normal(np.zeros(6), pose.covariance - before)
            z = error + rng.multivariate_normal(np.zeros(6), measured)
            correction = pose.aligned(alignment(SE3.from_rotvec(z[:3], HEX + z[3:] - SE3.from_rotvec(z[:3]).rotation @ HEX)), HEX)
            error = error - np.concatenate([correction.rotvec(), correction.apply(HEX) - HEX])
            values.append(error @ np.linalg.solve(pose.covariance, error))
    assert np.mean(values) == pytest.approx(6.0, abs=1.0)


def test_fused_pose_is_surer_than_either_source():
    pose = PoseFilter(config=PoseFilterConfig())
    for _ in range(4):
        pose.moved(CONTACTS, HEX, planted=ALL, fit_rmse=0.0)
    wheels = np.diag(pose.covariance).copy()
    pose.aligned(alignment(SE3.identity()), HEX)
    assert (np.diag(pose.covariance)[3:] < wheels[3:]).all()
    assert (np.sqrt(np.diag(pose.covariance)[3:]) < [0.011, 0.011, 0.005]).all()


def test_bare_ground_leaves_the_sideways_place_to_the_wheels():
    blind = INFORMATION.copy()
    blind[3:5, 3:5] = 0.0
    pose = PoseFilter(config=PoseFilterConfig())
    pose.moved(CONTACTS, HEX, planted=ALL, fit_rmse=0.0)
    correction = pose.aligned(alignment(SE3.from_translation(np.array([0.05, -0.05, -0.01])), information=blind), HEX)
    shift = correction.apply(HEX) - HEX
    assert np.abs(shift[:2]).max() < 0.002 and -0.011 < shift[2] < -0.003


def test_a_slip_is_noticed_and_the_map_decides():
    pose = PoseFilter(config=PoseFilterConfig())
    pose.moved(CONTACTS, HEX, planted=ALL, fit_rmse=0.0)
    pose.aligned(alignment(SE3.identity()), HEX)
    pose.moved(CONTACTS, HEX, planted=ALL, fit_rmse=0.0)
    slipped = np.array([0.12, 0.0, 0.0])
    correction = pose.aligned(alignment(SE3.from_translation(slipped)), HEX)
    assert pose.slips == 1
    np.testing.assert_allclose(correction.apply(HEX) - HEX, slipped, atol=0.01)


def test_measured_tilt_corrects_tilt_and_nothing_says_yaw():
    pose = PoseFilter(config=PoseFilterConfig())
    pose.moved(CONTACTS, HEX, planted=ALL, fit_rmse=0.05)
    believed = SE3.from_rpy(0.02, -0.01, 0.7, HEX)
    pose.attitude(believed, np.array([0.012, -0.004, 0.0]))
    correction = pose.aligned(refused_alignment("nothing seen", overlap=0), HEX)
    after = correction.compose(believed).rpy()
    assert abs(after[0] - 0.012) < abs(0.02 - 0.012) and abs(after[1] + 0.004) < abs(-0.01 + 0.004)
    # It turns about a place between the wheels that carry it and itself: neither moves by the whole arm times the turn.
    arm = HEX[2] * np.linalg.norm(correction.rotvec())
    assert np.linalg.norm(correction.apply(HEX) - HEX) < 0.8 * arm
    assert np.linalg.norm(correction.apply(np.zeros(3))) < 0.8 * arm
    assert correction.compose(believed).rpy()[2] == pytest.approx(0.7, abs=1e-3)
    assert pose.correction(HEX).apply(HEX) == pytest.approx(HEX)


def test_wheels_in_disagreement_are_worth_less():
    sure, unsure = PoseFilter(config=PoseFilterConfig()), PoseFilter(config=PoseFilterConfig())
    sure.moved(CONTACTS, HEX, planted=ALL, fit_rmse=0.0)
    unsure.moved(CONTACTS, HEX, planted=ALL, fit_rmse=0.04)
    assert (np.diag(unsure.covariance)[3:] > 4.0 * np.diag(sure.covariance)[3:]).all()


def test_wrong_settings_are_refused():
    with pytest.raises(ConfigError, match=r"wheel_sigma is 0.0, must be positive"):
        PoseFilterConfig(wheel_sigma=0.0)
    with pytest.raises(ConfigError, match=r"gate is 1.5, must be within 0.5 to 1"):
        PoseFilterConfig(gate=1.5)
