"""The same robot in MuJoCo, as a peer to measure against: position actuators, implicitfast, the same tick and ground.

The robot's URDF with a free base; every hull and wheel against the height field, none against another, which favours
the peer. MuJoCo is not a dependency: without it there is no figure.
"""

from __future__ import annotations

import importlib
import time
from typing import Any

import numpy as np

from athlete_twin.assets import robot_dir
from athlete_twin.geometry.grid import HeightGrid
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.model.stance import regular_stance
from athlete_twin.world.bullet_world import TICK

STIFFNESS = 1.0e5
"""of every actuator, about that of the robot's own joints [N m/rad]"""
DROP = 0.05
"""above the stance, so that it lands on its wheels [m]"""
SETTLING = 2.0
"""simulated before the clock starts [s]"""
SAG_LIMIT = 0.3
"""a chassis further below its stance is no standing robot, and its speed no figure [m]"""


def mujoco_speed(spec: RobotSpec, ground: HeightGrid, *, seconds: float = 5.0) -> float | None:
    """Simulated seconds a processor second while the robot stands; None where MuJoCo cannot be imported or the robot falls."""
    try:
        mujoco: Any = importlib.import_module("mujoco")
    except ImportError:
        return None
    model = _model(mujoco, spec, ground)
    state = mujoco.MjData(model)
    stance = regular_stance(spec)
    for leg in range(LEGS):
        for k, name in enumerate(spec.joint_names):
            joint = f"leg{leg + 1}_{name}"
            state.qpos[model.joint(joint).qposadr[0]] = stance[leg, k]
            state.ctrl[model.actuator(joint).id] = stance[leg, k]
    start_height = spec.chassis_height + DROP + float(ground.heights.mean())
    state.qpos[:7] = [0.0, 0.0, start_height, 1.0, 0.0, 0.0, 0.0]
    for _ in range(round(SETTLING / TICK)):
        mujoco.mj_step(model, state)
    ticks = round(seconds / TICK)
    begun = time.process_time()
    for _ in range(ticks):
        mujoco.mj_step(model, state)
    took = time.process_time() - begun
    stands = np.isfinite(state.qpos).all() and state.qpos[2] > start_height - DROP - SAG_LIMIT and state.ncon > 0
    return ticks * TICK / took if stands else None


def _model(mujoco: Any, spec: RobotSpec, ground: HeightGrid) -> Any:
    made = mujoco.MjSpec.from_string(_urdf(spec))
    made.body("hex").add_freejoint()
    made.option.timestep = TICK
    made.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for geom in made.geoms:
        geom.contype, geom.conaffinity = 1, 0
    for joint in made.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            continue
        motor = made.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_position(kp=STIFFNESS, dampratio=1.0)
    nx, ny = ground.shape
    heights = ground.heights - ground.heights.min()
    rise = max(float(heights.max()), 1e-3)
    centre = [ground.origin_x + 0.5 * (nx - 1) * ground.cell, ground.origin_y + 0.5 * (ny - 1) * ground.cell]
    half = [0.5 * (nx - 1) * ground.cell, 0.5 * (ny - 1) * ground.cell]
    # MuJoCo's rows run along y and its columns along x.
    made.add_hfield(name="ground", nrow=ny, ncol=nx, size=[*half, rise, 0.5], userdata=(heights / rise).T.ravel().tolist())
    made.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=[*centre, float(ground.heights.min())],
        contype=0, conaffinity=1,
    )  # fmt: skip
    return made.compile()


def _urdf(spec: RobotSpec) -> str:
    """The robot's URDF with MuJoCo's settings: it would weld the chassis to the world and load what only eyes need."""
    opening = f'<robot name="{spec.name}">'
    settings = '<mujoco><compiler discardvisual="true" fusestatic="false"/></mujoco>'
    return (robot_dir(spec.name) / "robot.urdf").read_text().replace(opening, opening + settings)
