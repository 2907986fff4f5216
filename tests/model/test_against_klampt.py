"""The same URDF in Klamp't: where its links are, its centre of mass, and the support polygons over its contacts.

Klamp't's support polygon counts friction and the contacts' heights, ours is the hull seen from above: they are the same
thing on level ground, and only there are they compared.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from athlete_twin.assets import robot_dir
from athlete_twin.model.kinematics import kinematics
from athlete_twin.model.spec import load_spec
from athlete_twin.model.statics import wheel_loads
from planner.stability.margin import cps_margin, support_margin

klampt = pytest.importorskip("klampt")

CONFIGURATIONS = 50
POSITION = 1e-9
"""[m]; rotations as well, where it is an entry of a matrix"""
MARGIN = 1e-6
"""[m]"""
FRICTION = 0.7
ATTEMPTS = 2
THEIRS = """
import json, sys
from klampt.model import contact
answers = []
for case in json.load(sys.stdin):
    points = [contact.ContactPoint(wheel, [0.0, 0.0, 1.0], case["friction"]) for wheel in case["wheels"]]
    answers.append({
        "edges": [list(edge) for edge in contact.support_polygon(points)],
        "forces": contact.com_equilibrium(points, (0.0, 0.0, -1.0), case["com"]),
    })
print("ANSWERS" + json.dumps(answers))
"""
"""what Klamp't is asked, in a process of its own: its solvers have aborted one that other libraries share, once in some
dozens of runs, and would take the test run with them"""


@pytest.fixture(scope="module", params=("sdm_b", "t12"))
def rival(request, tmp_path_factory):
    """Klamp't's model of a robot, without the shapes, which it would load as meshes."""
    text = (robot_dir(request.param) / "robot.urdf").read_text()
    for shape in ("visual", "collision"):
        text = re.sub(rf"<{shape}>.*?</{shape}>", "", text, flags=re.DOTALL)
    path = tmp_path_factory.mktemp("klampt") / f"{request.param}.urdf"
    path.write_text(text)
    world = klampt.WorldModel()
    assert world.readFile(str(path))
    return request.param, world.robot(0), world  # the world owns the robot


def configurations(robot: str):
    spec, rng = load_spec(robot), np.random.default_rng(5)
    for _ in range(CONFIGURATIONS):
        yield rng.uniform(spec.lower, spec.upper, (6, spec.dof))


def put(rival, robot: str, joints: np.ndarray) -> None:
    """The chassis at the origin, docks and wheels at zero."""
    config = [0.0] * rival.numLinks()
    for leg in range(6):
        for k, name in enumerate(load_spec(robot).joint_names):
            config[rival.link(f"leg{leg + 1}_{name}").getIndex()] = float(joints[leg, k])
    rival.setConfig(config)


def test_every_link_is_at_the_same_place(rival):
    robot, theirs, _ = rival
    for joints in configurations(robot):
        put(theirs, robot, joints)
        poses = kinematics(robot).link_poses(joints)
        assert len(poses) >= 1 + 6 * (load_spec(robot).dof + 1)
        for name, pose in poses.items():
            rotation, translation = theirs.link(name).getTransform()
            assert np.abs(pose.translation - translation).max() < POSITION, name
            # Klamp't lists a rotation column by column.
            assert np.abs(pose.rotation - np.reshape(rotation, (3, 3)).T).max() < POSITION, name


def test_centre_of_mass_is_the_same(rival):
    robot, theirs, _ = rival
    for joints in configurations(robot):
        put(theirs, robot, joints)
        assert np.abs(kinematics(robot).com_in_hex(joints) - theirs.getCom()).max() < POSITION


def stances():
    """Three to six wheels somewhere around the robot on level ground, and a centre of mass above."""
    rng = np.random.default_rng(6)
    for count in (3, 4, 5, 6):
        for _ in range(25):
            angles = np.deg2rad(360.0 / count) * np.arange(count) + rng.normal(0.0, 0.2, count)
            radii = rng.uniform(1.4, 2.6, count)
            wheels = np.column_stack([radii * np.cos(angles), radii * np.sin(angles), np.zeros(count)])
            yield wheels, np.array([*rng.normal(0.0, 0.8, 2), 1.2])


def asked(cases: list[tuple[np.ndarray, np.ndarray]]) -> list[dict]:
    """Edges of the support polygon of each case, as inward normal and offset, and contact forces that balance its weight."""
    question = json.dumps([{"wheels": w.tolist(), "com": c.tolist(), "friction": FRICTION} for w, c in cases])
    for _ in range(ATTEMPTS):
        run = subprocess.run(
            [sys.executable, "-c", THEIRS], input=question, capture_output=True, text=True, timeout=120,
            env={"PATH": os.environ.get("PATH", "")},
        )  # fmt: skip
        if run.returncode == 0:
            return json.loads(run.stdout.split("ANSWERS")[1])
    if run.returncode < 0:
        # Its own heap is broken ("munmap_chunk(): invalid pointer"): there is no second opinion to compare with.
        pytest.skip(f"Klamp't ended by signal {-run.returncode} in each of {ATTEMPTS} attempts: {run.stderr.strip()[-120:]}")
    raise AssertionError(f"Klamp't failed: {run.stderr[-300:]}")


def margin_of(answer: dict, com: np.ndarray) -> float:
    """Distance to the nearest edge of Klamp't's support polygon, exact inside; negative outside."""
    edges = np.array(answer["edges"])
    return float(np.min(edges[:, 2] - edges[:, :2] @ com[:2]))


def test_support_margin_is_klampts():
    inside = 0
    cases = list(stances())
    for (wheels, com), answer in zip(cases, asked(cases), strict=True):
        ours, theirs = support_margin(com, wheels), margin_of(answer, com)
        assert np.sign(ours) == np.sign(theirs)
        if ours > 0.0:
            inside += 1
            assert ours == pytest.approx(theirs, abs=MARGIN)
    assert 20 < inside < 100


def test_conservative_margin_is_the_least_of_klampts_reduced_polygons():
    inside = 0
    cases = [case for case in stances() if len(case[0]) >= 4]
    answers = iter(asked([(np.delete(w, k, axis=0), com) for w, com in cases for k in range(len(w))]))
    for wheels, com in cases:
        theirs = min(margin_of(next(answers), com) for _ in wheels)
        ours = cps_margin(com, wheels)
        assert np.sign(ours) == np.sign(theirs)
        if ours > 0.0:
            inside += 1
            assert ours == pytest.approx(theirs, abs=MARGIN)
    assert inside > 5


def test_a_stance_stands_where_the_margin_says_so():
    cases = list(stances())
    for (wheels, com), answer in zip(cases, asked(cases), strict=True):
        assert (answer["forces"] is not None) == (support_margin(com, wheels) > 0.0)


def test_three_wheels_carry_the_same_loads():
    """Statically determinate: only the forces that two wheels push each other apart with are open."""
    compared = 0
    cases = [(w, com) for w, com in stances() if len(w) == 3 and support_margin(com, w) > 0.0]
    for (wheels, com), answer in zip(cases, asked(cases), strict=True):
        forces = np.array(answer["forces"])
        assert forces[:, 2] == pytest.approx(wheel_loads(wheels, com, weight=1.0)[:, 2], abs=1e-6)
        compared += 1
    assert compared > 5
