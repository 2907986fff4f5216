"""Every generated file of a robot's assets, by its path inside the robot's folder."""

from __future__ import annotations

from athlete_twin.model.body_meshes import body_looks, leg_camera_looks
from athlete_twin.model.leg_meshes import leg_looks
from athlete_twin.model.solids import obj_text
from athlete_twin.model.spec import load_spec
from athlete_twin.model.urdf import urdf_text

MATERIALS = {
    "aluminium": (0.60, 0.61, 0.63),
    "white": (0.84, 0.84, 0.81),
    "gold": (0.70, 0.52, 0.20),
    "actuator": (0.17, 0.17, 0.19),
    "tyre": (0.09, 0.09, 0.09),
    "lens": (0.04, 0.05, 0.08),
}
"""linear red, green, blue reflectance by name; EST, weathered metal and paint, dusty rubber"""


def generated_files(robot: str) -> dict[str, str]:
    """Text of the URDF and of the meshes, fresh from the drawings."""
    spec = load_spec(robot)
    files: dict[str, str] = {}
    visuals: dict[str, list[tuple[str, str]]] = {}
    # A link of one leg can carry more than its kind: its own meshes go by its own name.
    for kind, look in (body_looks(spec) | leg_looks(spec) | leg_camera_looks(spec)).items():
        for material, mesh in look.items():
            path = f"meshes/{kind}_{material}.obj"
            files[path] = obj_text(mesh)
            visuals.setdefault(kind, []).append((path, material))
    files["robot.urdf"] = urdf_text(spec, visuals=visuals, materials=MATERIALS)
    return files
