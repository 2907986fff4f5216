import numpy as np
import pytest

from athlete_twin.errors import ConfigError
from athlete_twin.world.scenario import load_scenario
from athlete_twin.world.terrain import build_terrain

GOOD = """
goal_distance = 3.0
[ground]
kind = "yard"
relief = 0.05
wavelength = 5.0
[rocks]
k = 0.1
"""
MAP = """
goal_distance = 3.0
[ground]
kind = "file"
file = "{file}"
{more}
start_x = 5.0
start_y = 5.0
"""


def write(folder, text, name="field.toml"):
    path = folder / name
    path.write_text(text)
    return str(path)


def test_a_minimal_file_is_enough(tmp_path):
    scenario = load_scenario(write(tmp_path, GOOD))
    assert scenario.name == "field"
    assert scenario.rocks.d_max == 1.5
    assert np.linalg.norm(scenario.sun_in_world()) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("k = 0.1", "kay = 0.1", r"rocks\.kay \(= 0\.1\) is not known"),
        ("relief = 0.05", "releif = 0.05", r"ground\.releif .* did you mean 'relief'"),
        ("goal_distance = 3.0", "goal_distanse = 3.0", r"goal_distanse .* did you mean 'goal_distance'"),
        ("goal_distance = 3.0", "", r"key goal_distance is missing; it must be a number from 0\.5 to 40"),
        ("goal_distance = 3.0", 'goal_distance = "far"', r"goal_distance = 'far' is not usable; it must be a number"),
        ("goal_distance = 3.0", "goal_distance = nan", r"goal_distance = nan is not usable"),
        ("goal_distance = 3.0", "goal_distance = true", r"goal_distance = True is not usable"),
        ("goal_distance = 3.0", "goal_distance = 30.0", r"ground\.size_x = 24\.0 m .* 43\.0 m would do"),
        (
            "goal_distance = 3.0",
            "goal_distance = 3.0\ncycles = 2.5",
            r"cycles = 2\.5 is not usable; it must be a whole",
        ),
        (
            "goal_distance = 3.0",
            'goal_distance = 3.0\nsoil = "dune_sad"',
            r"soil = 'dune_sad' .* did you mean 'dune_sand'",
        ),
        ("goal_distance = 3.0", "goal_distance = 3.0\nsun = 3", r"sun must be a table \[sun\], got 3"),
        ("goal_distance = 3.0", "goal_distance = 3.0\nsoil =", r"not valid TOML"),
        ('kind = "yard"', 'kind = "yrad"', r"ground\.kind = 'yrad' is not known; did you mean 'yard'"),
        ('kind = "yard"', "kind = 3", r"ground\.kind = 3 is not usable; it must be a text"),
        ("k = 0.1", "k = -0.1", r"rocks\.k = -0\.1 is not usable; it must be a number from 0 to 0\.3"),
        ("k = 0.1", "k = 0.1\nd_min = 0.9\nd_max = 0.5", r"rocks\.d_min = 0\.9 m must be below rocks\.d_max"),
        ("k = 0.1", "min_big_across_line = 2", r"min_big_across_line needs rocks\.k > 0"),
        ("k = 0.1", "k = 0.1\n[[rock]]\nx = 1.0", r"rock\[0\]\.y is missing"),
        ("k = 0.1", 'k = 0.1\n[[fault]]\nkind = "stuck_jont"\nt = 1', r"'stuck_jont' is not known; did you mean 'stuck_joint'"),
        ("k = 0.1", 'k = 0.1\n[[fault]]\nkind = "soft_tyre"\nt = 1\nleg = 7\nvalue = 0.5', r"fault\[0\]\.leg = 7 .* 1 to 6"),
        ("k = 0.1", 'k = 0.1\n[[fault]]\nkind = "soft_tyre"\nt = 1\nleg = 2', r"fault\[0\]\.value is missing; .* 0\.05 to 1"),
        ("k = 0.1", 'k = 0.1\n[[fault]]\nkind = "brown_out"\nt = 1\nleg = 2', r"fault\[0\]\.leg \(= 2\) is not known"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path, old, new, says):
    path = write(tmp_path, GOOD.replace(old, new))
    with pytest.raises(ConfigError, match=says) as error:
        load_scenario(path)
    assert path in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ConfigError, match="known: black_point, calibration_yard"):
        load_scenario("rock_feild")


def heights(nan=False):
    h = np.random.default_rng(1).normal(0.0, 0.02, (121, 101))
    if nan:
        h[3:5, 7] = np.nan
    return h


@pytest.mark.parametrize("suffix", ["npy", "npz", "asc"])
def test_every_form_of_map_gives_the_same_ground(tmp_path, suffix):
    h = heights()
    file = tmp_path / f"scan.{suffix}"
    more = "map_cell = 0.1"
    if suffix == "npy":
        np.save(file, h)
    elif suffix == "npz":
        np.savez(file, heights=h, cell=0.1)
        more = ""
    else:
        rows = "\n".join(" ".join(repr(float(v)) for v in row) for row in h.T[::-1])
        file.write_text(f"ncols 121\nnrows 101\nxllcorner 0\nyllcorner 0\ncellsize 0.1\nNODATA_value -9999\n{rows}\n")
        more = ""
    scenario = load_scenario(write(tmp_path, MAP.format(file=file.name, more=more)))
    terrain = build_terrain(scenario, 0, clear_xy=np.zeros((0, 2)), clear_radius=0.3)
    at = np.array([7.0 - 5.0, 4.0 - 5.0])
    assert float(terrain.height(at)) == pytest.approx(h[70, 40] - h[50, 50], abs=5e-3)


@pytest.mark.parametrize(
    ("content", "more", "says"),
    [
        (heights(nan=True), "map_cell = 0.1", "2 of 12221 heights are NaN or infinite; every height must be finite"),
        (heights().ravel(), "map_cell = 0.1", r"heights have shape \(12221,\); need a 2-D array"),
        (heights(), "", "does not say how large a cell is; give map_cell"),
        (heights(), "map_cell = 0.02", "ground.start_x = 5.0 m is outside 4.0 to"),
        (heights().astype(complex), "map_cell = 0.1", "need real numbers"),
    ],
)
def test_unusable_map_names_file_key_and_cure(tmp_path, content, more, says):
    np.save(tmp_path / "scan.npy", content)
    path = write(tmp_path, MAP.format(file="scan.npy", more=more))
    with pytest.raises(ConfigError, match=says) as error:
        load_scenario(path)
    assert path in str(error.value)
    assert "scan.npy" in str(error.value)


def test_missing_damaged_and_8_bit_maps_are_refused(tmp_path):
    import cv2

    (tmp_path / "broken.npz").write_bytes(b"not a zip")
    cv2.imwrite(str(tmp_path / "low.png"), np.zeros((200, 200), np.uint8))
    cases = {
        "scna.npy": "no such file; height maps beside it: .*gravel_yard.png",
        "broken.npz": "cannot be read as .npz",
        "low.png": "need one 16-bit channel, found uint8",
        "scan.tif": "suffix '.tif' is not one of .npy, .npz, .png, .asc",
    }
    for file, says in cases.items():
        path = write(tmp_path, MAP.format(file=file, more="map_cell = 0.1\nheight_unit = 0.001"))
        with pytest.raises(ConfigError, match=says):
            load_scenario(path)


def test_injected_faults_come_in_the_order_of_the_file_with_legs_from_zero(tmp_path):
    tables = """
[[fault]]
kind = "brown_out"
t = 300
value = 12.5

[[fault]]
kind = "encoder_bias"
t = 20
leg = 3
joint = "knee_pitch"
value = -0.2
"""
    first, second = load_scenario(write(tmp_path, GOOD + tables)).faults
    assert (first.kind, first.leg, first.value) == ("brown_out", -1, 12.5)
    assert (second.kind, second.t, second.leg, second.joint, second.value) == ("encoder_bias", 20.0, 2, "knee_pitch", -0.2)
    assert load_scenario(write(tmp_path, GOOD)).faults == ()
