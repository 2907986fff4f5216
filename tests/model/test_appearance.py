from __future__ import annotations

import numpy as np
import pinocchio
import pytest

from athlete_twin.assets import robot_dir, robot_names
from athlete_twin.errors import AssetError
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model import appearance
from athlete_twin.model.appearance import leg_of, visual_parts
from athlete_twin.model.generated import MATERIALS, generated_files
from athlete_twin.model.link_solids import solids
from athlete_twin.model.solids import beam, box, cylinder, join, lathe, obj_mesh, obj_text, prism
from athlete_twin.model.spec import load_spec
from athlete_twin.model.stance import regular_stance

MOST_TRIANGLES = 25_000
MOST_WHEEL_TRIANGLES = 1_500
ENCLOSED_WITHIN = 0.06  # m, of a link's visuals outside every collision solid
CAMERA_DISPLACEMENT = 0.015  # m, three sigma of a trial's draw


@pytest.fixture(params=robot_names())
def spec(request):
    return load_spec(request.param)


def kind_of(link: str) -> str:
    if link.startswith("wheel"):
        return "wheel"
    return link.split("_", 1)[1] if link.startswith("leg") else link


def link_poses(spec, joints):
    """An own, slow placement of the links, wheels and docks at 0."""
    model = pinocchio.buildModelFromUrdf(str(robot_dir(spec.name) / "robot.urdf"))
    q = pinocchio.neutral(model)
    for leg in range(6):
        for name, angle in zip(spec.joint_names, joints[leg], strict=True):
            q[model.joints[model.getJointId(f"leg{leg + 1}_{name}")].idx_q] = angle
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, q)
    bodies = [(f.name, data.oMf[i]) for i, f in enumerate(model.frames) if f.type == pinocchio.FrameType.BODY]
    return {name: SE3(placed.rotation, placed.translation) for name, placed in bodies}


def test_committed_files_are_what_the_drawings_give(spec):
    folder = robot_dir(spec.name)
    fresh = generated_files(spec.name)
    assert {str(p.relative_to(folder)) for p in folder.glob("meshes/*")} == {n for n in fresh if n.startswith("meshes")}
    for name, text in fresh.items():
        assert (folder / name).read_bytes() == text.encode(), f"{name} is stale: python scripts/build_assets.py"


def test_robots_stay_within_their_triangle_budget(spec):
    parts = visual_parts(spec)
    assert sum(len(p.triangles) for p in parts) <= MOST_TRIANGLES
    assert sum(len(p.triangles) for p in parts if p.link == "wheel1") <= MOST_WHEEL_TRIANGLES


def test_parts_carry_the_materials_and_share_their_arrays(spec):
    parts = visual_parts(spec)
    assert parts is visual_parts(spec)
    tyres = [p for p in parts if p.link.startswith("wheel") and p.albedo < 0.1]
    assert len(tyres) == 6
    assert all(t.vertices is tyres[0].vertices for t in tyres)
    assert tyres[0].colour == pytest.approx(MATERIALS["tyre"])
    for part in parts:
        assert not part.vertices.flags.writeable
        assert part.triangles.min() >= 0
        assert part.triangles.max() < len(part.vertices)
        assert 0.0 < part.albedo < 1.0


def test_wheels_look_as_large_as_drawn(spec):
    wheel = np.concatenate([p.vertices for p in visual_parts(spec) if p.link == "wheel1"])
    assert np.hypot(wheel[:, 0], wheel[:, 2]).max() == pytest.approx(spec.wheel.radius, abs=1e-3)
    tyre = next(p for p in visual_parts(spec) if p.link == "wheel1" and p.albedo < 0.1)
    assert np.ptp(tyre.vertices[:, 1]) == pytest.approx(spec.wheel.width, abs=0.03)


@pytest.mark.slow
@pytest.mark.ci
def test_no_camera_sees_the_chassis_it_is_mounted_on(spec):
    """Neither where it is drawn nor displaced as a trial may draw it."""
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    poses = link_poses(spec, regular_stance(spec))
    for part in visual_parts(spec):
        if not part.link.startswith(("leg", "wheel")):
            placed = poses[part.link].compose(part.link_from_part).apply(part.vertices)
            scene.add_triangles(
                o3d.core.Tensor(placed.astype(np.float32)), o3d.core.Tensor(part.triangles.astype(np.uint32))
            )
    shifts = CAMERA_DISPLACEMENT * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    for camera in (c for c in spec.cameras if c.on_chassis):
        for hex_from_eye in (camera.hex_from_camera, camera.hex_from_right()):
            directions = hex_from_eye.rotate(camera.eye.binned(8).rays()).reshape(-1, 3)
            for shift in shifts:
                origins = np.broadcast_to(hex_from_eye.translation + shift, directions.shape)
                rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
                blocked = scene.test_occlusions(o3d.core.Tensor(rays)).numpy()
                assert not blocked.any(), f"{camera.name}: {blocked.sum()} rays, shifted by {shift}"


def test_hip_drums_stay_clear_of_the_cameras(spec):
    drums = [p for p in visual_parts(spec) if p.link == "leg1_hip_yaw"]
    near_axis = np.concatenate([p.vertices for p in drums])
    behind = near_axis[near_axis[:, 0] < 0]
    radius = np.hypot(behind[:, 0], behind[:, 1]).max()
    assert radius <= 0.10 + 0.035
    for camera in (c for c in spec.cameras if c.on_chassis):
        for eye in (camera.hex_from_camera, camera.hex_from_right()):
            distance = np.hypot(*(spec.hips_in_hex[:, :2] - eye.translation[:2]).T).min()
            assert distance > radius + CAMERA_DISPLACEMENT


def test_collision_solids_enclose_what_is_seen(spec):
    """Roughly: lenses, brackets and cheeks may stick out by less than 6 cm; a neighbour's solid counts, as cheeks hold drums."""
    poses = link_poses(spec, regular_stance(spec))
    shapes = solids(spec)
    placed = [
        (solid, pose.compose(SE3.from_rpy(*solid.rpy, np.array(solid.xyz))).inverse())
        for link, pose in poses.items()
        for solid in shapes[kind_of(link)]
    ]
    for part in visual_parts(spec):
        if part.link.startswith(("leg", "wheel")) and part.link[3:4] not in "1l" and part.link != "wheel1":
            continue  # all legs are alike
        points = poses[part.link].compose(part.link_from_part).apply(part.vertices)
        outside = np.min([_distance(solid, solid_from_hex.apply(points)) for solid, solid_from_hex in placed], axis=0)
        if part.link == "hex":  # housings and their booms hang in the air before T12's pallet
            eyes = np.array([c.hex_from_camera.translation for c in spec.cameras if c.on_chassis])
            at_camera = np.linalg.norm(points[:, None] - eyes, axis=2).min(axis=1) < 0.35
            outside = np.append(outside[~at_camera], 0.0)
        assert outside.max() < ENCLOSED_WITHIN, f"{part.link} sticks out by {outside.max():.3f} m"


def _distance(solid, points):
    """How far points lie outside a solid, 0 inside [m]."""
    if solid.shape == "box":
        return np.linalg.norm(np.maximum(np.abs(points) - 0.5 * np.array(solid.size), 0.0), axis=1)
    radial = np.hypot(points[:, 0], points[:, 1]) - solid.size[0]
    axial = np.abs(points[:, 2]) - 0.5 * solid.size[1]
    return np.hypot(np.maximum(radial, 0.0), np.maximum(axial, 0.0))


def test_only_adjacent_links_overlap_in_the_regular_stance(spec):
    urdf = str(robot_dir(spec.name) / "robot.urdf")
    model = pinocchio.buildModelFromUrdf(urdf)
    geometry = pinocchio.buildGeomFromUrdf(model, urdf, pinocchio.GeometryType.COLLISION)
    geometry.addAllCollisionPairs()
    q = pinocchio.neutral(model)
    joints = regular_stance(spec)
    for leg in range(6):
        for name, angle in zip(spec.joint_names, joints[leg], strict=True):
            q[model.joints[model.getJointId(f"leg{leg + 1}_{name}")].idx_q] = angle
    found = geometry.createData()
    pinocchio.computeCollisions(model, model.createData(), geometry, found, q, False)
    for pair, result in zip(geometry.collisionPairs, found.collisionResults, strict=True):
        one, other = geometry.geometryObjects[pair.first], geometry.geometryObjects[pair.second]
        a, b = one.parentJoint, other.parentJoint
        docked = {"deck_left", "deck_right", "hex"}
        both = {model.frames[one.parentFrame].name, model.frames[other.parentFrame].name}
        if a == b or model.parents[a] == b or model.parents[b] == a or both <= docked:
            continue
        assert not result.isCollision(), both


def test_solids_are_closed_and_have_the_volume_of_their_formula():
    outline = np.array([[0.0, 0.0], [2.0, 0.0], [1.5, 1.0], [0.5, 1.0]])
    ring = lathe(np.array([[-1.0, 2.0], [1.0, 2.0], [1.0, 3.0], [-1.0, 3.0]]), axis="x", segments=400)
    cases = [
        (box((1.0, 2.0, 3.0), (5.0, 0.0, 0.0)), 6.0),
        (prism(outline, -1.0, 2.0, axis="y"), 4.5),
        (cylinder(0.5, 1.0, 3.0, axis="x", segments=400), np.pi * 0.5),
        (ring, np.pi * (9 - 4) * 2),
        (beam(np.zeros(3), np.array([1.0, 2.0, 2.0]), 0.1, 0.2), 0.06),
        (join(box((1.0, 1.0, 1.0)), box((2.0, 2.0, 2.0)).shifted(z=4.0)), 9.0),
    ]
    for mesh, volume in cases:
        assert mesh.volume() == pytest.approx(volume, rel=1e-3)
        edges = np.concatenate([mesh.triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))])
        forward, backward = ({tuple(e) for e in edges.tolist()}, {tuple(e) for e in edges[:, ::-1].tolist()})
        assert len(forward) == len(edges)  # every directed edge once: closed and consistently turned
        assert forward == backward


def test_every_mesh_is_closed(spec):
    for name, text in generated_files(spec.name).items():
        if not name.endswith(".obj"):
            continue
        mesh = obj_mesh(text)
        edges = np.concatenate([mesh.triangles[:, [i, j]] for i, j in ((0, 1), (1, 2), (2, 0))])
        assert {tuple(e) for e in edges.tolist()} == {tuple(e) for e in edges[:, ::-1].tolist()}, name
        assert mesh.volume() > 0, name


def test_solids_lie_along_the_named_axis():
    for axis, column in (("x", 0), ("y", 1), ("z", 2)):
        extent = np.ptp(cylinder(0.1, -1.0, 2.0, axis=axis).vertices, axis=0)
        assert extent[column] == pytest.approx(3.0)
        assert np.delete(extent, column).max() < 0.21


def test_a_mesh_survives_its_text():
    mesh = beam(np.array([0.1, -0.2, 0.3]), np.array([1.0, 1.0, 1.0]), 0.1, 0.2)
    back = obj_mesh(obj_text(mesh))
    assert back.vertices == pytest.approx(mesh.vertices, abs=1e-5)
    assert (back.triangles == mesh.triangles).all()
    assert "-0.00000" not in obj_text(box((1.0, 1.0, 0.0)))
    with pytest.raises(AssetError, match="something other"):
        obj_mesh("v 0 0 0\nvn 0 0 1\nf 1 1 1\n")


def test_missing_files_are_named_with_the_remedy(spec, tmp_path, monkeypatch):
    monkeypatch.setattr(appearance, "robot_dir", lambda name: tmp_path)
    with pytest.raises(AssetError, match="build_assets"):
        appearance._visual_parts.__wrapped__(spec.name)
    (tmp_path / "robot.urdf").write_bytes((robot_dir(spec.name) / "robot.urdf").read_bytes())
    with pytest.raises(AssetError, match=r"meshes/hex_\w+\.obj is missing"):
        appearance._visual_parts.__wrapped__(spec.name)


@pytest.mark.parametrize(("link", "leg"), [("leg3_hip_yaw", 2), ("wheel6", 5), ("hex", -1), ("deck_left", -1)])
def test_links_belong_to_legs_by_their_name(link, leg):
    assert leg_of(link) == leg
