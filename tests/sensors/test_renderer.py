from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from athlete_twin.errors import CameraError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.camera import Pinhole
from athlete_twin.sensors.renderer import Renderer
from athlete_twin.world.scenario import scenario_from_content
from athlete_twin.world.terrain import build_terrain, load_scenario

DOWN = np.column_stack([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""world_from_camera looking straight down: image right is -y, image down is -x"""
EYE = Pinhole.from_fov(256, 192, np.deg2rad(70))
SUN = np.array([1.0, 0.0, 1.0])
GROUND, ROCK, ROBOT = 1, 2, 3


@dataclass(frozen=True)
class Box:
    size: tuple
    link_from_part: SE3
    link: str = "box"
    albedo: float = 0.5

    @property
    def colour(self):
        return np.array([0.8, 0.5, 0.1])

    @property
    def vertices(self):
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        return corners * np.array(self.size)

    @property
    def triangles(self):
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def flat(tmp_path, **ground):
    content = {
        "goal_distance": 3.0,
        "ground": {"kind": "flat", "roughness": 0.0, "size_x": 16.0, "size_y": 12.0, "x_min": -7.0} | ground,
    }
    return build_terrain(
        scenario_from_content(content, tmp_path / "flat.toml"), 0, clear_xy=np.zeros((0, 2)), clear_radius=0.3
    )


def overhead(height=2.0):
    return SE3(DOWN, np.array([0.0, 0.0, height]))


BOX = Box((0.4, 0.4, 0.4), SE3.identity())


def test_depth_of_a_plane_is_the_closed_form(tmp_path):
    renderer = Renderer(flat(tmp_path), [])
    pitch = np.deg2rad(35)
    forward = np.array([np.cos(pitch), 0.0, -np.sin(pitch)])
    right = np.array([0.0, -1.0, 0.0])
    pose = SE3(np.column_stack([right, np.cross(forward, right), forward]), np.array([0.0, 0.0, 1.75]))
    seen = renderer.render(pose, EYE, renderer.place({}))
    towards_ground = -(EYE.rays() @ pose.rotation.T)[..., 2]
    near = (towards_ground > 0.2) & np.isfinite(seen.depth)
    assert near.mean() > 0.8
    np.testing.assert_allclose(seen.depth[near], 1.75 / towards_ground[near], atol=1e-3)
    assert (seen.label[near] == GROUND).all()


def test_shadow_falls_where_geometry_says(tmp_path):
    renderer = Renderer(flat(tmp_path), [BOX], SUN)
    # The box hovers at 1 m; with the sun at 45 deg over +x its shadow is shifted by 1 m towards -x.
    link_poses = {"box": SE3.from_translation(np.array([1.2, 0.0, 1.0]))}
    robot = renderer.place(link_poses)
    seen = renderer.render(overhead(3.0), EYE, robot)

    def radiance_at(x, y):
        (u, v), _ = EYE.project(overhead(3.0).inverse().apply(np.array([x, y, 0.0])))
        r, c = round(float(v)), round(float(u))
        assert seen.label[r, c] == GROUND
        return float(seen.image[r - 2 : r + 3, c - 2 : c + 3].mean())

    shaded, lit = radiance_at(0.2, 0.0), radiance_at(0.2, 0.6)
    assert shaded < 0.45 * lit
    # 45 deg through a 0.4 m cube: the shadow runs from -0.2 to 0.6, half a width beyond either side of its centre.
    assert radiance_at(0.5, 0.0) < 0.45 * lit
    assert radiance_at(-0.1, 0.0) < 0.45 * lit
    assert radiance_at(-0.35, 0.0) > 0.7 * lit


@pytest.mark.parametrize("azimuth_deg", [0.0, 130.0, 250.0])
@pytest.mark.parametrize("elevation_deg", [15.0, 35.0, 70.0])
def test_shadow_lies_where_elevation_and_azimuth_put_it(tmp_path, elevation_deg, azimuth_deg):
    elevation, azimuth = np.deg2rad(elevation_deg), np.deg2rad(azimuth_deg)
    flat_part = np.cos(elevation)
    toward = np.array([flat_part * np.cos(azimuth), flat_part * np.sin(azimuth), np.sin(elevation)])
    renderer = Renderer(flat(tmp_path, size_x=24.0, size_y=24.0, x_min=-12.0), [BOX], toward)
    centre = np.array([0.0, 0.0, 0.7])
    # The eye hangs over where the sun throws the box's centre.
    eye_pose = SE3(DOWN, np.array([*(-toward[:2] * centre[2] / toward[2]), 4.5]))
    with_box = renderer.render(eye_pose, EYE, renderer.place({"box": SE3.from_translation(centre)}))
    without = renderer.render(eye_pose, EYE, renderer.place({}))
    on_ground = with_box.label == GROUND
    dark = (with_box.image < 0.7 * without.image)[on_ground]
    # Where the ray to the sun enters all three slabs of the box before it leaves any.
    ground = eye_pose.apply((EYE.rays() * without.depth[..., None])[on_ground])
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = ((centre + side - ground) / toward for side in (-0.2, 0.2))
    hidden = np.fmin(a, b).max(axis=1) < np.fmax(a, b).min(axis=1)
    assert hidden.sum() > 50
    assert (dark & hidden).sum() > 0.9 * (dark | hidden).sum()


def test_robot_hides_the_ground_and_is_labelled(tmp_path):
    renderer = Renderer(flat(tmp_path), [BOX], SUN)
    robot = renderer.place({"box": SE3.from_translation(np.array([0.0, 0.0, 0.5]))})
    seen = renderer.render(overhead(2.0), EYE, robot)
    centre = (EYE.height_px // 2, EYE.width_px // 2)
    assert seen.label[centre] == ROBOT
    assert seen.depth[centre] == pytest.approx(2.0 - 0.7, abs=1e-3)
    assert seen.label[5, 5] == GROUND
    assert (renderer.render(overhead(2.0), EYE, renderer.place({})).label == GROUND).all()


@pytest.mark.slow
@pytest.mark.ci
def test_rocks_are_labelled_where_they_lie():
    terrain = build_terrain(load_scenario("rock_field"), 0, clear_xy=np.zeros((0, 2)), clear_radius=0.3)
    renderer = Renderer(terrain, [])
    rock = max((r for r in terrain.rocks if abs(r.x) < 6 and abs(r.y) < 6), key=lambda r: r.diameter)
    pose = SE3(DOWN, np.array([rock.x, rock.y, 4.0]))
    seen = renderer.render(pose, EYE, renderer.place({}))
    centre = (EYE.height_px // 2, EYE.width_px // 2)
    assert seen.label[centre] == ROCK
    top = float(terrain.height(np.array([rock.x, rock.y])))
    assert seen.depth[centre] == pytest.approx(4.0 - top, abs=0.03)


def test_texture_is_the_same_seen_from_elsewhere(tmp_path):
    renderer = Renderer(flat(tmp_path), [], SUN)
    robot = renderer.place({})
    left, right = (
        renderer.render(SE3(DOWN, np.array([0.0, y, 1.5])), EYE, robot).image.astype(np.float32) for y in (0.0, -0.2)
    )
    shift = EYE.focal_px * 0.2 / 1.5
    moved = cv2.warpAffine(right, np.float32([[1, 0, shift], [0, 1, 0]]), (EYE.width_px, EYE.height_px))
    inner = np.s_[20:-20, 60:-20]
    assert np.corrcoef(left[inner].ravel(), moved[inner].ravel())[0, 1] > 0.9
    # And there is something to match: contrast of several percent at the scale of a few pixels.
    fine = left - cv2.GaussianBlur(left, (0, 0), 3)
    assert fine[inner].std() > 0.04 * left[inner].mean()


@pytest.mark.slow
@pytest.mark.ci
def test_same_bytes_again():
    terrain = build_terrain(load_scenario("rock_field"), 1, clear_xy=np.zeros((0, 2)), clear_radius=0.3)
    poses = {"box": SE3.from_translation(np.array([0.3, 0.1, 0.9]))}
    first, again = (Renderer(terrain, [BOX]) for _ in range(2))
    a, b = (r.render(overhead(3.0), EYE, r.place(poses)) for r in (first, again))
    assert a.image.tobytes() == b.image.tobytes()
    assert a.depth.tobytes() == b.depth.tobytes()
    view = [r.render_view(overhead(3.0), EYE, poses) for r in (first, again)]
    assert view[0].tobytes() == view[1].tobytes()
    assert view[0].shape == (EYE.height_px, EYE.width_px, 3)


@pytest.mark.slow
@pytest.mark.ci
def test_horizon_is_ground_below_and_sky_above():
    terrain = build_terrain(load_scenario("rock_field"), 0, clear_xy=np.zeros((0, 2)), clear_radius=0.3)
    renderer = Renderer(terrain, [])
    forward, right = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    pose = SE3(np.column_stack([right, np.cross(forward, right), forward]), np.array([0.0, 0.0, 1.75]))
    seen = renderer.render(pose, EYE, renderer.place({}))
    assert (seen.label[: EYE.height_px // 3] == 0).all()
    assert np.isnan(seen.depth[0]).all()
    assert (seen.label[EYE.height_px // 2 + 5 :] != 0).all()


def test_odd_supersampling_is_refused(tmp_path):
    with pytest.raises(CameraError, match="supersampling is 3, must be 1 or 2"):
        Renderer(flat(tmp_path), []).render_view(overhead(), EYE, {}, supersampling=3)
