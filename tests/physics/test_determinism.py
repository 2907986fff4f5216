"""The same seed and commands give the same bytes: in fresh processes, rebuilt, restored, and beside another world.

Run as a program it prints the SHA-256 of one robot's trajectory: `python tests/physics/test_determinism.py sdm_b 10000`.
"""

import faulthandler
import gc
import hashlib
import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import envs  # noqa: F401
from athlete_twin.errors import PhysicsError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import LEGS, load_spec
from athlete_twin.model.stance import regular_stance, stance_wheels_in_hex
from athlete_twin.physics.body import Body
from athlete_twin.physics.truth import draw_truth
from athlete_twin.physics.tyre import Footing
from athlete_twin.world.bullet_world import BulletWorld
from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import Terrain, build_terrain

ROBOTS = ("sdm_b", "t12")
SEED = 3
TICKS = 10_000
ROOT = Path(__file__).resolve().parents[2]
SWINGING = 1
WARM_UP_EPISODES = 30
LEAK_LIMIT = 20e6  # [bytes]


@cache
def rocks(robot: str) -> Terrain:
    patches = stance_wheels_in_hex(load_spec(robot))[:, :2]
    return build_terrain(load_scenario("rock_field"), SEED, clear_xy=patches, clear_radius=0.45)


class Walk:
    """A robot among rocks that swings leg 2 up and about and sways its chassis, with the hash of all it did.

    It starts at rest `drop` above the ground [m], its hips `legs_up` higher than in the regular stance [rad].
    """

    def __init__(self, robot: str, *, drop: float = 0.05, legs_up: float = 0.0) -> None:
        spec, terrain = load_spec(robot), rocks(robot)
        links = tuple(kinematics(robot).link_poses(np.zeros((LEGS, spec.dof))))
        self.world = BulletWorld(terrain.grid)
        self.body = Body(self.world, spec, draw_truth(spec, SEED, link_names=links), footing=Footing.of(terrain))
        self.start = regular_stance(spec)
        self.start[:, 1] -= legs_up
        self.body.place(SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height + drop])), self.start)
        self.hash = hashlib.sha256()
        self.tick = 0
        self.free_ticks = 0
        """so long the swinging wheel was in the air"""

    def run(self, until: int) -> str:
        """The hash of joints, motors, chassis and tyre forces of every tick so far."""
        body, limits = self.body, np.full(self.start.shape, 0.1)
        while self.tick < until:
            t = self.tick * self.world.tick
            commands = self.start.copy()
            commands[SWINGING, :2] += [0.3 * np.sin(0.5 * t), -0.2 * (1.0 - np.cos(0.4 * t))]
            commands[:, 1] += 0.05 * np.sin(0.3 * t)
            body.step(commands, limits)
            position, quaternion = self.world.bullet.getBasePositionAndOrientation(body.robot, physicsClientId=self.world.client)
            self.hash.update(body.joints.tobytes() + body.rates.tobytes() + body.motors.tobytes())
            self.hash.update(np.array(position + quaternion).tobytes() + body.tyre.forces_in_world.tobytes())
            self.free_ticks += int(body.tyre.loads[SWINGING] == 0.0)
            self.tick += 1
        return self.hash.hexdigest()

    def run_twice(self, *, save_at: int, until: int) -> tuple[str, str]:
        """The hash of a run that saved at a tick and went on, and of one that went on from there a second time."""
        self.run(save_at)
        state, tick, digest = self.body.save(), self.tick, self.hash.copy()
        first = self.run(until)
        self.body.restore(state)
        self.tick, self.hash = tick, digest
        return first, self.run(until)


@contextmanager
def walk(robot: str, **kwargs) -> Iterator[Walk]:
    made = Walk(robot, **kwargs)
    try:
        yield made
    finally:
        made.world.close()


def in_fresh_processes(robot: str, count: int) -> list[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(Path(__file__).resolve()), robot, str(TICKS)]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) for _ in range(count)]
    hashes = [process.communicate(timeout=120)[0].strip() for process in started]
    assert [process.returncode for process in started] == [0] * count
    return hashes


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("robot", ["sdm_b", "t12"])
def test_ten_thousand_ticks_are_the_same_in_processes_restored_rebuilt_and_in_company(robot):
    """The fresh processes never save: equal to them, neither saving nor restoring has left a trace."""
    alone, again = in_fresh_processes(robot, 2)
    assert alone == again
    with walk(robot) as made:
        save_at = int(np.random.default_rng(SEED).integers(1, TICKS))
        saved, restored = made.run_twice(save_at=save_at, until=TICKS)
        assert made.free_ticks > 240 and made.body.tyre.loads.max() > 0.0
    assert saved == alone and restored == alone, f"saved at tick {save_at}"
    with walk(robot) as company, walk(robot) as rebuilt:
        for tick in range(0, TICKS, 500):
            rebuilt.run(tick + 500)
            company.run(company.tick + 7)
        assert rebuilt.hash.hexdigest() == alone


@pytest.fixture(scope="module", params=ROBOTS)
def standing(request) -> Iterator[tuple[Walk, object]]:
    with walk(request.param) as made:
        yield made, made.body.save()


@settings(max_examples=8)
@given(at=st.integers(0, 1000))
@pytest.mark.slow
@pytest.mark.ci
def test_a_restored_body_goes_on_as_before_from_any_tick(standing, at):
    made, start = standing
    made.body.restore(start)
    made.tick = 0
    first, again = made.run_twice(save_at=at, until=at + 120)
    assert first == again


@pytest.mark.slow
@pytest.mark.ci
def test_a_restored_body_meets_the_ground_as_before():
    """Saved in the air with its legs up, it falls on its hull."""
    with walk("sdm_b", drop=-0.3, legs_up=1.2) as made:
        assert not made.body.hull_contacts()
        first, again = made.run_twice(save_at=10, until=300)
        assert first == again
        assert made.body.world_from_hex().translation[2] < 1.0


@pytest.mark.slow
@pytest.mark.ci
def test_nothing_is_saved_while_a_hull_touches():
    with walk("sdm_b", drop=-0.3, legs_up=1.2) as made:
        while not made.body.hull_contacts():
            made.run(made.tick + 1)
        with pytest.raises(PhysicsError, match="touches something: a state can be saved only while no hull does"):
            made.body.save()


@pytest.mark.slow
@pytest.mark.ci
def test_a_state_of_another_world_is_refused_and_states_let_go_of_are_freed():
    with walk("sdm_b") as made, walk("sdm_b") as other:
        numbers = [made.body.save().snapshot for _ in range(20)]
        assert len(set(numbers)) <= 2
        with pytest.raises(PhysicsError, match="saved in another world"):
            other.body.restore(made.body.save())


def small_environment(name: str) -> gym.Env:
    """A twin on little ground, so that a reset takes a moment."""
    yard = replace(load_scenario("rock_field"), size=(13.0, 10.0), x_min=-5.0, cell=0.1)
    return gym.make(name, scenario=yard, cameras=("navcam_1",), link=0.1)


def episode(env: gym.Env, seed: int, *, steps: int) -> list[dict]:
    """What is seen after a reset while a picture is taken and leg 2 is lifted."""
    nothing = {k: np.zeros_like(v) for k, v in env.action_space.sample().items()}
    up = np.array([0.0, 0.0, 0.3], dtype=np.float32)
    lift = nothing | {"kind": np.int64(2), "leg": np.int64(1), "wheel": up, "guard": np.int64(1)}
    look = nothing | {"kind": np.int64(4), "cameras": np.ones(1, dtype=np.int8)}
    seen = [env.reset(seed=seed)[0]]
    return seen + [env.step(action)[0] for action in (look, lift, *[nothing] * steps)]


@pytest.mark.parametrize("name", ["AthleteTwin/SdmB-v0", "AthleteTwin/T12-v0"])
@pytest.mark.slow
def test_a_reset_environment_shows_the_same_again(name):
    env = small_environment(name)
    first, again = episode(env, 4, steps=12), episode(env, 4, steps=12)
    env.close()
    assert first[-1]["image_present"].all() and np.ptp([o["joints"][1] for o in first[1:]], axis=0).max() > 0.01
    for a, b in zip(first, again, strict=True):
        assert all(np.array_equal(a[k], b[k]) for k in a)


@pytest.mark.slow
def test_two_hundred_episodes_leave_no_memory_behind():
    """After a warm-up, since allocators and libraries keep what they once had."""
    faulthandler.cancel_dump_traceback_later()  # it takes longer than what else counts as hanging
    env = small_environment("AthleteTwin/SdmB-v0")
    sizes = []
    for number in range(WARM_UP_EPISODES + 200):
        episode(env, number % 5, steps=2)
        sizes.append(resident_bytes())
    env.close()
    growth = np.max(sizes[-10:]) - np.max(sizes[WARM_UP_EPISODES - 10 : WARM_UP_EPISODES])
    assert growth < LEAK_LIMIT, f"{growth / 1e6:.1f} MB more after 200 episodes"


def resident_bytes() -> int:
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


if __name__ == "__main__":
    with walk(sys.argv[1]) as alone:
        print(alone.run(int(sys.argv[2])))
