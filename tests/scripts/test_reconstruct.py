"""The files that reconstruct.py writes hold the plane that the pair shows; what it cannot use it names in one line."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import reconstruct as script

SIZE, FOCAL, BASELINE, HEIGHT, PITCH = (480, 360), 340.0, 0.15, 1.5, 50.0
CAMERA = f"""
size_px = [{SIZE[0]}, {SIZE[1]}]
focal_px = {FOCAL}
baseline_m = {BASELINE}
depth_range_m = [0.8, 6.0]
height_m = {HEIGHT}
pitch_down_deg = {PITCH}
"""


def plane(offset_px=0.0):
    """Both eyes' images of a textured plane z = 0, from its closed form: 8 bit, and the true depth."""
    width, height = SIZE
    texture = cv2.GaussianBlur(np.random.default_rng(5).normal(size=(900, 900)).astype(np.float32), (0, 0), 1.5)
    texture = 128.0 + 40.0 * texture / texture.std()
    p = np.deg2rad(PITCH)
    u, v = np.meshgrid((np.arange(width) - 0.5 * (width - 1)) / FOCAL, (np.arange(height) - 0.5 * (height - 1)) / FOCAL)
    depth = HEIGHT / (np.sin(p) + v * np.cos(p))
    forward = depth * (np.cos(p) - v * np.sin(p))
    images = []
    for eye in (0.0, BASELINE):
        shift = (offset_px / FOCAL) if eye else 0.0
        across = depth * (u - shift) + eye
        x, y = (across / 0.008 + 450).astype(np.float32), (forward / 0.008).astype(np.float32)
        images.append(cv2.remap(texture, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP).clip(0, 255).round())
    return images[0].astype(np.uint8), images[1].astype(np.uint8), depth


@pytest.fixture
def files(tmp_path):
    left, right, _ = plane()
    cv2.imwrite(str(tmp_path / "left.png"), left)
    cv2.imwrite(str(tmp_path / "right.png"), right)
    (tmp_path / "camera.toml").write_text(CAMERA)
    return tmp_path


def run(folder, left="left.png", right="right.png", camera="camera.toml"):
    names = {"--left": left, "--right": right, "--camera": camera, "--out": "out"}
    return script.main([part for key, name in names.items() for part in (key, str(folder / name))])


def test_files_hold_the_plane(files):
    assert run(files) == 0
    truth = plane()[2]
    out = files / "out"
    stored = np.load(out / "depth.npz")
    assert np.isfinite(stored["depth"]).mean() > 0.75
    assert np.nanmedian(np.abs(stored["depth"] - truth)) < 0.01
    millimetres = cv2.imread(str(out / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert millimetres.dtype == np.uint16
    known = millimetres > 0
    assert np.array_equal(known, np.isfinite(stored["depth"]))
    assert np.abs(millimetres[known] / 1000.0 - stored["depth"][known]).max() < 0.001
    elevation = np.load(out / "elevation.npz")
    assert np.nanmedian(np.abs(elevation["heights"])) < 0.01
    head = (out / "cloud.ply").read_bytes()[:400].decode("ascii", "ignore")
    summary = json.loads((out / "summary.json").read_text())
    assert f"element vertex {summary['points']}" in head
    assert summary["points"] == int(known.sum())
    for name in ("depth_view.png", "elevation.png"):
        assert cv2.imread(str(out / name)).std() > 5.0


@pytest.mark.parametrize(("name", "deep"), [("a.jpg", False), ("a.pgm", False), ("a.tiff", True), ("a.png", True)])
def test_other_formats_and_depths_are_read(files, name, deep):
    left, right, truth = plane()
    for side, image in (("l_", left), ("r_", right)):
        stored = image.astype(np.uint16) * 257 if deep else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        cv2.imwrite(str(files / f"{side}{name}"), stored if not name.endswith("pgm") else image)
    assert run(files, left=f"l_{name}", right=f"r_{name}") == 0
    depth = np.load(files / "out" / "depth.npz")["depth"]
    assert np.nanmedian(np.abs(depth - truth)) < 0.015
    assert json.loads((files / "out" / "summary.json").read_text())["bits"] == (12 if deep else 8)


def test_right_eye_with_another_principal_point_gives_the_same_plane(files):
    left, right, truth = plane(offset_px=-17.4)
    cv2.imwrite(str(files / "left.png"), left)
    cv2.imwrite(str(files / "right.png"), right)
    (files / "camera.toml").write_text(CAMERA + f"right_cx_px = {0.5 * (SIZE[0] - 1) - 17.4}\n")
    assert run(files) == 0
    assert np.nanmedian(np.abs(np.load(files / "out" / "depth.npz")["depth"] - truth)) < 0.01


def test_the_example_camera_file_is_whole():
    example = Path(__file__).resolve().parents[2] / "assets" / "stereo_camera_example.toml"
    camera = script.read_camera(example).camera
    assert camera.eye.focal_px == pytest.approx(512 / np.tan(np.deg2rad(35)), rel=1e-3)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("baseline_m = -0.1", "must be positive"),
        ("size_px = [480]", "two numbers"),
        ("depth_range_m = [3.0, 1.0]", "must grow"),
        ("depth_range_m = [0.05, 1.0]", "nearest depth must be"),
        ("focal_px = true", "must be a number"),
        ("cell_m = 0.0", "cell_m"),
        ("hfov_deg = 60.0", "either focal_px or hfov_deg"),
        ("fokal_px = 3.0", "'fokal_px' is not known"),
        ("size_px = [", "is not TOML"),
    ],
)
def test_bad_camera_files_are_refused_in_one_line(files, capfd, change, text):
    key = change.split(" = ")[0]
    kept = "\n".join(line for line in CAMERA.splitlines() if not line.startswith(key + " ="))
    (files / "camera.toml").write_text(f"{kept}\n{change}\n")
    assert run(files) == 2
    said = capfd.readouterr().err
    assert said.startswith("reconstruct: ")
    assert said.count("\n") == 1
    assert text in said


@pytest.mark.parametrize(
    ("kind", "text"),
    [("black", "is black"), ("white", "is white"), ("small", "both must be alike"), ("cut", "is cut off"), ("empty", "0 bytes"),
     ("missing", "no such image"), ("swapped", "seem to be exchanged")],
)  # fmt: skip
def test_bad_images_are_refused_in_one_line(files, capfd, kind, text):
    left = files / "left.png"
    image = cv2.imread(str(left), cv2.IMREAD_UNCHANGED)
    right = "right.png"
    if kind in ("black", "white"):
        cv2.imwrite(str(left), np.full_like(image, 0 if kind == "black" else 255))
    elif kind == "small":
        cv2.imwrite(str(left), image[:100])
    elif kind in ("cut", "empty"):
        raw = left.read_bytes()
        left.write_bytes(raw[: len(raw) // 2] if kind == "cut" else b"")
    elif kind == "missing":
        left.unlink()
    else:
        left, right = files / "right.png", "left.png"
    assert run(files, left=left.name, right=right) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert text in said
