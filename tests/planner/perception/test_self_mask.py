from dataclasses import replace

import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.se3 import SE3
from athlete_twin.model.appearance import VisualPart
from planner.perception.ground_surface import height_above_ground
from planner.perception.robot_drawing import draw_robot
from planner.perception.self_mask import SelfMaskConfig, remove_self
from planner.perception.stereo import StereoConfig, match
from planner.perception.watershed import segment

UP = np.array([0.0, 0.0, 1.0])
LEG, ROCK, SWUNG = 1, 2, 3


def tube(link, radius, low, high, n=32):
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    vertices = np.vstack([np.column_stack([ring, np.full(n, z)]) for z in (low, high)])
    k, m = np.arange(n), (np.arange(n) + 1) % n
    sides = np.vstack([np.column_stack([k, m, k + n]), np.column_stack([m, m + n, k + n])])
    caps = np.vstack([np.column_stack([np.zeros(n - 2, int) + s, k[1:-1] + s, k[2:] + s]) for s in (0, n)])
    return VisualPart(
        link=link,
        link_from_part=SE3.identity(),
        vertices=vertices,
        triangles=np.vstack([sides, caps]),
        colour=np.full(3, 0.5),
        albedo=0.5,
    )


@pytest.fixture
def view(synth):
    """A planted leg, a rock beside it and a swung leg, seen as a HazCam sees them; and what is where."""
    camera = synth.looking(1.5, 42.0)
    cylinders = [synth.Cylinder(2.0, 0.25, 0.11, 0.0, 1.2), synth.Cylinder(1.8, -0.35, 0.2, 0.0, 0.25)]
    cylinders.append(synth.Cylinder(2.3, 0.85, 0.11, 0.45, 1.3))
    scene = synth.Scene(cylinders)
    depth = match(scene.pair(camera, SE3.identity()), camera, config=StereoConfig())
    truth, _, what = scene.trace(camera.hex_from_camera, camera.eye)
    parts = [tube("leg1", 0.11, 0.0, 1.2), tube("leg2", 0.11, 0.45, 1.3)]
    places = {"leg1": np.array([2.0, 0.25, 0.0]), "leg2": np.array([2.3, 0.85, 0.0])}
    poses = {name: SE3.from_translation(place) for name, place in places.items()}
    return depth, truth, what, parts, poses


def masked(view, method, *, shift=(0.0, 0.0, 0.0), ground=None):
    depth, _, _, parts, poses = view
    off = SE3.from_translation(np.array(shift))
    return remove_self(
        depth,
        config=SelfMaskConfig(method=method),
        parts=parts,
        hex_from_link={n: off.compose(p) for n, p in poses.items()},
        up_in_hex=UP,
        ground_in_hex=np.zeros((0, 3)) if ground is None else ground,
    )


def scores(view, result):
    """Recall of leg pixels that had depth and stand above the rest of the ground; terrain and rock lost."""
    depth, truth, what, *_ = view
    z = 1.5 + (depth.camera.hex_from_camera.rotate(depth.eye.rays()) * truth[..., None])[..., 2]
    seen = np.isfinite(depth.depth)
    leg = ((what == LEG) | (what == SWUNG)) & (z > 0.08)
    return (
        result.mask[leg & seen].mean(),
        result.mask[(what == 0) & seen].mean(),
        result.mask[(what == ROCK) & seen].mean(),
    )


@pytest.mark.parametrize("method", ["watershed", "kinematic", "combined"])
def test_legs_go_and_rock_and_ground_stay(view, method):
    recall, ground_lost, rock_lost = scores(view, masked(view, method))
    assert recall > 0.95
    assert ground_lost < 0.04
    assert rock_lost < 0.1


@pytest.mark.parametrize("method", ["kinematic", "combined"])
def test_two_centimetres_of_wrong_belief_are_forgiven(view, method):
    recall, ground_lost, rock_lost = scores(view, masked(view, method, shift=(0.01, 0.02, -0.01)))
    assert recall > 0.95
    assert ground_lost < 0.05
    assert rock_lost < 0.1


def test_combined_holds_where_the_drawing_alone_fails(view):
    shift = (0.0, 0.06, 0.0)
    recall = {m: scores(view, masked(view, m, shift=shift))[0] for m in ("kinematic", "combined")}
    assert recall["combined"] > recall["kinematic"]
    assert recall["combined"] > 0.95


def test_masked_pixels_have_no_depth_and_others_keep_theirs(view):
    depth = view[0]
    result = masked(view, "combined")
    assert np.isnan(result.depth.depth[result.mask]).all()
    assert np.isnan(result.depth.sigma[result.mask]).all()
    np.testing.assert_array_equal(result.depth.depth[~result.mask], depth.depth[~result.mask])
    assert result.robot_labels


def test_no_method_changes_nothing(view):
    result = masked(view, "none")
    assert result.depth is view[0]
    assert not result.mask.any()


def test_drawing_has_the_closed_form_depth(view):
    depth, truth, what, parts, poses = view
    drawn = draw_robot(depth, parts, poses)
    leg = (what == LEG) | (what == SWUNG)
    assert (np.isfinite(drawn) == leg).mean() > 0.995
    both = leg & np.isfinite(drawn)
    # The mesh is a polygon of 32 sides inside the cylinder: 0.5 mm at its radius, more where the ray grazes.
    assert np.median(np.abs(drawn - truth)[both]) < 0.001


@pytest.mark.parametrize("known", [True, False])
def test_height_is_measured_from_tilted_ground(view, synth, known):
    camera = synth.looking(1.5, 42.0)
    scene = synth.Scene()
    depth = match(scene.pair(camera, SE3.identity()), camera, config=StereoConfig())
    contacts = np.array([[1.0, 0.0, 0.0], [3.0, 1.0, 0.0], [2.0, -1.0, 0.0]]) if known else np.zeros((0, 3))
    slanted_up = SE3.from_rpy(0.08, -0.1, 0.0).rotate(UP)
    height = height_above_ground(depth, slanted_up, contacts)
    assert abs(np.nanmedian(height)) < 0.02
    assert np.nanquantile(np.abs(height), 0.95) < 0.06


def test_segments_end_at_depth_edges(view):
    depth, _, what, *_ = view
    height = height_above_ground(depth, UP, np.zeros((0, 3)))
    labels = segment(depth, height, ground_cut=0.08, edge_px=1.5, min_segment_px=12)
    legs = {n for k in (LEG, SWUNG) for n in np.unique(labels[(what == k) & (labels > 1)]) if (labels == n).sum() > 200}
    for n in legs:
        inside = what[labels == n]
        assert np.mean((inside == LEG) | (inside == SWUNG)) > 0.85


def test_image_without_robot_keeps_everything(view, synth):
    camera = synth.looking(1.5, 42.0)
    scene = synth.Scene([synth.Cylinder(1.8, -0.35, 0.25, 0.0, 0.4), synth.Cylinder(2.4, 0.5, 0.15, 0.0, 0.25)])
    depth = match(scene.pair(camera, SE3.identity()), camera, config=StereoConfig())
    for method in ("watershed", "combined", "kinematic"):
        result = remove_self(
            depth,
            config=SelfMaskConfig(method=method),
            parts=[],
            hex_from_link={},
            up_in_hex=UP,
            ground_in_hex=np.zeros((0, 3)),
        )
        assert result.mask.mean() < 0.001


def test_wheel_is_told_from_a_rock_by_where_it_stands(synth):
    """Two equal stubs: by the depth alone both are rocks, the one on a believed contact is the wheel."""
    camera = synth.looking(1.5, 42.0)
    scene = synth.Scene([synth.Cylinder(2.0, 0.4, 0.2, 0.0, 0.45), synth.Cylinder(2.0, -0.6, 0.2, 0.0, 0.45)])
    depth = match(scene.pair(camera, SE3.identity()), camera, config=StereoConfig())
    what = scene.trace(camera.hex_from_camera, camera.eye)[2]
    contacts = np.array([[2.0, 0.4, 0.0], [-2.0, 0.4, 0.0], [0.0, -3.0, 0.0]])
    for ground, wheel_gone in ((contacts, True), (np.zeros((0, 3)), False)):
        result = remove_self(
            depth,
            config=SelfMaskConfig(method="watershed"),
            parts=[],
            hex_from_link={},
            up_in_hex=UP,
            ground_in_hex=ground,
        )
        seen = np.isfinite(depth.depth)
        assert (result.mask[(what == 1) & seen].mean() > 0.9) == wheel_gone
        assert result.mask[(what == 2) & seen].mean() < 0.02


@pytest.mark.parametrize("method", ["flatten", "kinematic", "watershed", "combined"])
def test_masks_do_not_depend_on_the_order_of_images(view, synth, method):
    camera = synth.looking(1.4, 35.0)
    other = match(synth.Scene([synth.Cylinder(2.2, 0.0, 0.15, 0.0, 0.9)]).pair(camera, SE3.identity()), camera, config=StereoConfig())
    contacts = np.array([[2.0, 0.25, 0.0]])
    second = (other, *view[1:])
    forth = [masked(v, method, ground=contacts) for v in (view, second)]
    back = [masked(v, method, ground=contacts) for v in (second, view)][::-1]
    for a, b in zip(forth, back, strict=True):
        np.testing.assert_array_equal(a.mask, b.mask)
        np.testing.assert_array_equal(a.depth.depth, b.depth.depth)


@pytest.mark.parametrize("method", ["flatten", "kinematic", "watershed", "combined"])
def test_nothing_beyond_the_legs_reach_is_taken(view, synth, method):
    """A post as tall as a leg, farther away than any leg reaches, and no leg."""
    camera = synth.looking(1.5, 15.0)
    scene = synth.Scene([synth.Cylinder(5.5, -1.6, 0.15, 0.0, 1.3)])
    depth = match(scene.pair(camera, SE3.identity()), camera, config=StereoConfig())
    post = (scene.trace(camera.hex_from_camera, camera.eye)[2] == 1) & np.isfinite(depth.depth)
    assert post.sum() > 200
    result = masked((depth, *view[1:]), method, ground=np.array([[2.0, 0.25, 0.0]]))
    assert not result.mask[post].any()


def test_rock_that_stands_beside_a_wheel_stays(synth):
    """Three centimetres between tyre and rock, the belief 3 cm and 1 deg off: the rock keeps its top and most of its face."""
    camera = synth.looking(1.5, 42.0)
    scene = synth.Scene([synth.Cylinder(2.0, 0.2, 0.11, 0.0, 0.9), synth.Cylinder(2.0, -0.06, 0.12, 0.0, 0.16)])
    depth = match(scene.pair(camera, SE3.identity()), camera, config=StereoConfig())
    what = scene.trace(camera.hex_from_camera, camera.eye)[2]
    off = SE3.from_rpy(0.01, -0.01, 0.01, np.array([0.02, -0.02, 0.01]))
    result = remove_self(
        depth,
        config=SelfMaskConfig(method="combined"),
        parts=[tube("leg1", 0.11, 0.0, 0.9)],
        hex_from_link={"leg1": off.compose(SE3.from_translation(np.array([2.0, 0.2, 0.0])))},
        up_in_hex=UP,
        ground_in_hex=np.zeros((0, 3)),
    )
    seen = np.isfinite(depth.depth)
    assert result.mask[(what == 1) & seen].mean() > 0.97
    assert result.mask[(what == 2) & seen].mean() < 0.25


def test_combined_says_by_how_much_the_belief_was_off(view):
    shift = np.array([0.0, 0.03, 0.0])
    result = masked(view, "combined", shift=tuple(shift))
    camera = view[0].camera.hex_from_camera
    leg = np.array([2.0, 0.25, 0.8])
    corrected = camera.apply(result.true_from_drawn.apply(camera.inverse().apply(leg + shift)))
    assert np.linalg.norm((corrected - leg)[:2]) < 0.012


def test_parts_too_near_to_be_matched_are_cut_from_the_drawing_alone(synth):
    """Of what stands nearer than the search begins, every depth is false; what the drawing covers goes."""
    camera = synth.looking(1.5, 42.0, group="navcam")
    scene = synth.Scene([synth.Cylinder(0.75, 0.0, 0.1, 0.7, 1.2)])
    depth = match(scene.pair(camera, SE3.identity()), camera, config=StereoConfig())
    hidden = scene.trace(camera.hex_from_camera, camera.eye)[2] == 1
    # A false match, as repeated texture gives.
    false = replace(depth, depth=np.where(hidden, 4.0, depth.depth), sigma=np.where(hidden, 0.02, depth.sigma))
    result = remove_self(
        false,
        config=SelfMaskConfig(method="combined"),
        parts=[tube("leg1", 0.1, 0.7, 1.2)],
        hex_from_link={"leg1": SE3.from_translation(np.array([0.75, 0.0, 0.0]))},
        up_in_hex=UP,
        ground_in_hex=np.zeros((0, 3)),
    )
    assert result.mask[hidden].mean() > 0.97


def test_unknown_method_is_refused():
    with pytest.raises(ConfigError, match=r"self_mask method 'magic'.*flatten, kinematic, watershed, combined, none"):
        SelfMaskConfig(method="magic")
