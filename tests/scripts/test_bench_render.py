"""The renderer's benchmark draws the same thing with both renderers, and judges what it says."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(SCRIPTS))
    try:
        spec = importlib.util.spec_from_file_location("bench_render", SCRIPTS / "bench_render.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["bench_render"] = module
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCRIPTS))
    return module


@pytest.mark.slow
def test_both_renderers_see_the_robot_in_the_same_places(bench):
    spec = bench._resized(bench.load_spec("sdm_b"), 320, 240)
    clear = bench.stance_wheels_in_hex(spec)[:, :2]
    terrain = bench.build_terrain(bench.load_scenario("rock_field"), 0, clear_xy=clear, clear_radius=0.45)
    world_from_hex = bench.SE3.from_translation(np.array([0.0, 0.0, spec.chassis_height]))
    joints = bench.regular_stance(spec)
    links = {n: world_from_hex.compose(p) for n, p in bench.kinematics("sdm_b").link_poses(joints).items()}
    camera = spec.camera("navcam_1")
    # From outside, looking back at the robot: half of the picture is chassis and legs.
    back = bench.SE3.from_rpy(0.0, 0.0, np.pi).compose(camera.hex_from_camera)
    pose = bench.SE3(back.rotation, np.array([4.5, 0.3, 1.6]))
    renderer = bench.Renderer(terrain, bench.visual_parts(spec))
    ours = renderer.render(pose, camera.eye, renderer.place(links)).label == 3
    with bench.TinyScene(spec, terrain.grid, world_from_hex, joints) as tiny:
        theirs = tiny.robot(pose, camera.eye)
    assert ours.mean() > 0.03
    assert (ours & theirs).sum() / (ours | theirs).sum() > 0.85


@pytest.mark.parametrize(("arguments", "message"), [(["--robots", "sdm_x"], "sdm_x"), (["--repeats", "0"], "at least 1")])
def test_bad_usage_is_one_line_and_exit_status_2(bench, capsys, arguments, message):
    assert bench.main(arguments) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1
