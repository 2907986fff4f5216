"""Every generated file of a robot's assets, by its path inside the robot's folder."""

from __future__ import annotations

from athlete_twin.model.spec import load_spec
from athlete_twin.model.urdf import urdf_text


def generated_files(robot: str) -> dict[str, str]:
    """Text of the URDF and of the meshes, fresh from the drawings."""
    return {"robot.urdf": urdf_text(load_spec(robot), visuals={}, materials={})}
