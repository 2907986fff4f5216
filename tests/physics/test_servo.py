"""Joints against closed forms: wind-up, stall, brake, ratchet, friction."""

import numpy as np
import pytest

from athlete_twin.model.spec import load_spec
from athlete_twin.physics.servo import RUBBING_STROKE, Servos
from athlete_twin.physics.truth import nominal_truth
from athlete_twin.world.bullet_world import TICK

RATES = {"sdm_b": 0.1, "t12": 0.1}


class Bench:
    """One robot's joints on a test bench: the links are where they are put."""

    def __init__(self, robot: str) -> None:
        self.spec = load_spec(robot)
        self.truth = nominal_truth(self.spec).truth
        shape = (6, self.spec.dof)
        self.zero = np.zeros(shape)
        self.limits = np.tile(self.spec.torque_limits, (6, 1))
        self.k = np.broadcast_to(self.truth.joint_stiffness, shape)
        self.servos = Servos(self.truth, self.spec.torque_limits, np.full(shape, 10.0), self.zero)

    def step(self, links, commands=None):
        commands = self.zero if commands is None else commands
        return self.servos.step(links, self.zero, commands, np.full(self.zero.shape, 0.1), TICK)


def test_torque_is_the_wind_up_times_the_stiffness():
    """Robot facts 2.4: 2165 N m wind a hip up by 1.2 deg."""
    bench = Bench("sdm_b")
    links = bench.zero.copy()
    links[:, 1] = -np.deg2rad(1.0)
    assert bench.step(links)[:, 1] == pytest.approx(np.full(6, 1e5 * np.deg2rad(1.0)))
    assert np.rad2deg(bench.spec.torque_limits[1] / bench.truth.joint_stiffness[1]) == pytest.approx(1.24, abs=0.01)


def test_motors_follow_at_their_rate_limit_and_are_not_driven_back():
    bench = Bench("sdm_b")
    for _ in range(240):
        bench.step(bench.servos.motors, np.full(bench.zero.shape, 0.5))
    assert bench.servos.motors == pytest.approx(np.full(bench.zero.shape, 0.1), rel=1e-6)
    held = bench.servos.motors.copy()
    bench.step(held - 0.005, held)
    assert np.array_equal(bench.servos.motors, held)


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_a_motor_stalls_at_its_limit_and_goes_on_when_relieved(robot):
    bench = Bench(robot)
    for _ in range(2400):  # links blocked, motors drive on
        bench.step(bench.zero, np.full(bench.zero.shape, 1.0))
    assert bench.servos.torques(bench.zero) == pytest.approx(bench.limits)
    free = bench.servos.motors.copy()
    bench.step(free, np.full(bench.zero.shape, 1.0))
    assert (bench.servos.motors > free).all()


def test_t12s_brake_slips_beyond_what_it_holds_and_its_torque_stays_true():
    bench = Bench("t12")
    links = -2.0 * bench.limits / bench.k
    torques = bench.step(links)
    assert torques == pytest.approx(1.5 * bench.limits)
    assert not bench.servos.slipped.any()
    assert bench.servos.torques(links) == pytest.approx(bench.k * (bench.servos.motors - links))


def test_sdm_bs_gear_ratchets_and_its_torque_reads_wrong_from_then_on():
    """[SunSpiral2012] s7.1. One tooth less wind-up; the encoders before and after disagree by a tooth for good."""
    bench = Bench("sdm_b")
    just_below, just_above = -1.19 * bench.limits / bench.k, -1.21 * bench.limits / bench.k
    assert bench.step(just_below) == pytest.approx(1.19 * bench.limits)
    assert bench.step(just_above) == pytest.approx(1.21 * bench.limits - bench.k * bench.truth.joint_tooth)
    assert bench.servos.slipped == pytest.approx(np.full(bench.zero.shape, bench.truth.joint_tooth))
    measured = bench.k * (bench.servos.motors - just_above)
    assert measured - bench.servos.torques(just_above) == pytest.approx(bench.k * bench.truth.joint_tooth)
    for _ in range(100):
        bench.step(bench.zero)
    assert bench.servos.slipped == pytest.approx(np.full(bench.zero.shape, bench.truth.joint_tooth))


@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_friction_is_a_loop_that_the_wind_up_does_not_show(robot):
    bench = Bench(robot)
    spring, torque = [], []
    for phase in np.linspace(0.0, 4 * np.pi, 4000):
        links = np.full(bench.zero.shape, 2 * RUBBING_STROKE * np.sin(phase))
        rates = np.full(bench.zero.shape, 2 * RUBBING_STROKE * np.cos(phase) * 4 * np.pi / (4000 * TICK))
        made = bench.servos.step(links, rates, bench.zero, np.full(bench.zero.shape, 0.1), TICK)
        spring.append(bench.servos.torques(links)[0, 1])
        torque.append((made + bench.servos.damping * rates)[0, 1])
    loss = np.array(spring) - np.array(torque)
    assert loss.max() == pytest.approx(0.01 * bench.limits[0, 1], rel=1e-6)
    assert loss.min() == pytest.approx(-0.01 * bench.limits[0, 1], rel=1e-6)
