"""A rectified stereo pair from files -> depth, point cloud and elevation map, by the code that walks the robot.

    python scripts/reconstruct.py --left LEFT.png --right RIGHT.png --camera CAMERA.toml --out DIR

Images: PNG, JPEG, TIFF or PGM, grey or colour, 8 or 16 bit, both of the size that the camera file gives. The camera file
(`assets/stereo_camera_example.toml` has every key with its meaning):

    size_px = [1024, 768]      # width and height
    hfov_deg = 70.0            # or focal_px
    baseline_m = 0.15
    depth_range_m = [0.6, 7.0] # nearest and farthest depth that is looked for
    height_m = 1.50            # optional: of the left eye above the ground
    pitch_down_deg = 50.0      # optional: of the boresight below the horizon
    cell_m = 0.05              # optional: of the elevation map
    cx_px, cy_px, right_cx_px  # optional: principal points

Written into DIR: depth.png (16 bit, millimetres, 0 unknown), depth.npz (depth and sigma [m]), cloud.ply (x forward, y left,
z up from the ground below the left eye), elevation.npz (heights, variance, count, origin, cell), pictures of depth and
elevation, summary.json. Exit status 2 and one line for input that cannot be used.
"""

from __future__ import annotations

import json
import sys
import time
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from report_style import png, subplots

from athlete_twin.errors import AthleteError, CameraError, ConfigError
from athlete_twin.geometry.open3d_loader import open3d
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import StereoPair, Telemetry
from athlete_twin.model.camera import Pinhole, StereoCamera
from envs.provenance import provenance
from planner.perception.exposure import merged
from planner.perception.quality import judge
from planner.perception.stereo import DepthImage, StereoConfig, match
from planner.terrain.fusion import FusedTerrain, FusionConfig, TerrainMap

WIDEST_PX = 1600
"""wider images are binned, both eyes alike, until they fit"""
LEAST_KNOWN = 0.1
"""of the pixels with a depth: fewer are chance, as of a pair whose eyes were exchanged"""
NUMBERS = {
    "focal_px", "hfov_deg", "baseline_m", "height_m", "pitch_down_deg", "cell_m", "cx_px", "cy_px", "right_cx_px",
}  # fmt: skip
PAIRS = {"size_px", "depth_range_m"}
NAME = "camera"


@dataclass(frozen=True, kw_only=True)
class Options:
    """Reconstructs one pair."""

    left: Path
    """image of the left eye"""
    right: Path
    """image of the right eye"""
    camera: Path
    """TOML file of the camera, see above"""
    out: Path
    """folder for the results, made when it is not there"""


@dataclass(frozen=True, kw_only=True)
class CameraFile:
    """What the camera file says."""

    camera: StereoCamera
    """at its height, x forward, z up"""
    depth_range: tuple[float, float]
    """[m]"""
    cell: float
    """[m]"""
    right_offset_px: float
    """principal point of the right eye minus the left one's, along the row"""


def main(arguments: list[str] | None = None) -> int:
    """Runs the script; the exit status."""
    options = tyro.cli(Options, args=arguments, description=__doc__)
    try:
        reconstruct(options)
    except (AthleteError, OSError) as e:
        sys.stderr.write(f"reconstruct: {' '.join(str(e).split())}\n")
        return 2
    return 0


def reconstruct(options: Options) -> dict[str, Any]:
    """Writes all results; the summary."""
    file = read_camera(options.camera)
    images = [read_image(options.left), read_image(options.right)]
    if images[0].shape != images[1].shape:
        raise CameraError(f"{options.left} is {_size(images[0])}, {options.right} is {_size(images[1])}; both must be alike")
    eye = file.camera.eye
    if images[0].shape != (eye.height_px, eye.width_px):
        raise CameraError(f"{options.left} is {_size(images[0])}, but {options.camera} says {eye.width_px}x{eye.height_px}")
    images[1] = _on_one_axis(images[1], file.right_offset_px)
    binning = 1
    while eye.width_px // binning > WIDEST_PX and binning < 8:
        binning *= 2
    start = time.perf_counter()
    pair = _pair(images, binning)
    verdict = judge(pair, file.camera)
    if not verdict.usable:
        raise CameraError(f"{options.left} and {options.right} cannot be matched: {verdict.reason.split(': ', 1)[1]}")
    # Nobody waits for a file: searched at full size, thin things keep their depth (a photograph has more of them than soil).
    config = StereoConfig(depth_range={NAME: file.depth_range}, full_width_px=WIDEST_PX)
    depth = match(merged([pair]), file.camera, config=config)
    known = np.isfinite(depth.depth)
    if known.mean() < LEAST_KNOWN:
        near, far = file.depth_range
        swapped = match(merged([replace(pair, left=pair.right, right=pair.left)]), file.camera, config=config)
        other = float(np.isfinite(swapped.depth).mean())
        why = "left and right seem to be exchanged" if other > 2.0 * known.mean() else "is the pair rectified?"
        raise CameraError(
            f"only {known.mean():.1%} of the pixels have a depth from {near:g} to {far:g} m, need {LEAST_KNOWN:.0%}: {why}"
        )
    terrain = _mapped(depth, file)
    seconds = time.perf_counter() - start
    options.out.mkdir(parents=True, exist_ok=True)
    _write_depth(depth, options.out)
    points = _write_cloud(depth, options.out / "cloud.ply")
    _write_elevation(terrain, options.out)
    seen = ~terrain.unknown
    summary = {
        "left": str(options.left), "right": str(options.right), "size_px": [eye.width_px, eye.height_px], "binning": binning,
        "bits": pair.bits, "focal_px": depth.eye.focal_px, "baseline_m": file.camera.baseline,
        "depth_range_m": list(file.depth_range), "known_share": float(known.mean()),
        "depth_m": _quantiles(depth.depth[known]), "sigma_m": _quantiles(depth.sigma[known]), "points": points,
        "cells": int(seen.sum()), "cell_m": file.cell,
        "height_m": _quantiles(terrain.grid.heights[seen]) if seen.any() else None,
        "match_and_map_s": seconds, "provenance": provenance(),
    }  # fmt: skip
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    return summary


def read_camera(path: Path) -> CameraFile:
    """The camera of a TOML file; what is missing, unknown or out of range is refused with its key."""
    try:
        content = tomllib.loads(path.read_text())
    except FileNotFoundError as e:
        raise ConfigError(f"{path}: no such camera file; assets/stereo_camera_example.toml is one") from e
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise ConfigError(f"{path}: is not TOML: {e}") from e
    for key, value in content.items():
        if key not in NUMBERS | PAIRS:
            raise ConfigError(f"{path}: key {key!r} is not known; known: {', '.join(sorted(NUMBERS | PAIRS))}")
        values = value if key in PAIRS else [value]
        if not (isinstance(values, list) and len(values) == (2 if key in PAIRS else 1) and all(map(_is_number, values))):
            raise ConfigError(f"{path}: {key} = {value!r} must be {'two numbers' if key in PAIRS else 'a number'}")
    for key in ("size_px", "baseline_m"):
        if key not in content:
            raise ConfigError(f"{path}: key {key!r} is missing")
    if ("focal_px" in content) == ("hfov_deg" in content):
        raise ConfigError(f"{path}: give either focal_px or hfov_deg")
    width, height = (int(v) for v in content["size_px"])
    hfov = content.get("hfov_deg", 60.0)
    if not 1.0 <= hfov <= 170.0:
        raise ConfigError(f"{path}: hfov_deg = {hfov} is not from 1 to 170")
    focal = content["focal_px"] if "focal_px" in content else 0.5 * width / np.tan(0.5 * np.deg2rad(hfov))
    cx, cy = content.get("cx_px", 0.5 * (width - 1)), content.get("cy_px", 0.5 * (height - 1))
    eye = Pinhole(width_px=width, height_px=height, focal_px=float(focal), cx_px=float(cx), cy_px=float(cy))
    up, pitch = float(content.get("height_m", 0.0)), float(np.deg2rad(content.get("pitch_down_deg", 0.0)))
    forward = np.array([np.cos(pitch), 0.0, -np.sin(pitch)])
    right = np.array([0.0, -1.0, 0.0])
    pose = SE3(np.column_stack([right, np.cross(forward, right), forward]), np.array([0.0, 0.0, up]))
    camera = StereoCamera(
        name=NAME, group=NAME, link_from_camera=pose, baseline=float(content["baseline_m"]), eye=eye
    )
    constant = eye.focal_px * camera.baseline
    # From a fifth of the width down to two pixels of shift, where the camera file does not say.
    near, far = content.get("depth_range_m", [constant / (0.2 * width), constant / 2.0])
    cell = float(content.get("cell_m", 0.05))
    if not 0.0 < near < far:
        raise ConfigError(f"{path}: depth_range_m = [{near}, {far}] must grow from above 0")
    if constant / near > 0.8 * width:
        raise ConfigError(
            f"{path}: at {near} m the eyes differ by {constant / near:.0f} px of {width}; the nearest depth must be "
            f"{constant / (0.8 * width):.2f} m or more"
        )
    if not 0.001 <= cell <= 10.0 or far / cell > 4000.0:
        raise ConfigError(f"{path}: cell_m = {cell} must be from 0.001 to 10 and at least a 4000th of {far:g} m")
    offset = float(content.get("right_cx_px", cx)) - float(cx)
    return CameraFile(camera=camera, depth_range=(float(near), float(far)), cell=cell, right_offset_px=offset)


def read_image(path: Path) -> np.ndarray:
    """A grey image, uint8 or uint16, shape (h, w); colours become their luminance."""
    try:
        raw = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except FileNotFoundError as e:
        raise CameraError(f"{path}: no such image") from e
    if raw[:4].tobytes() == b"\x89PNG" and b"IEND" not in raw[-64:].tobytes():
        raise CameraError(f"{path}: is cut off after {len(raw)} bytes")
    image = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if len(raw) else None
    if image is None:
        raise CameraError(f"{path}: {len(raw)} bytes are no whole image; PNG, JPEG, TIFF and PGM are read")
    if image.ndim == 3:
        image = image[..., 0] if image.shape[2] == 1 else cv2.cvtColor(image[..., :3], cv2.COLOR_BGR2GRAY)
    if image.dtype not in (np.uint8, np.uint16):
        raise CameraError(f"{path}: values of {image.dtype} are not read, 8 or 16 bit are")
    return np.asarray(image)


def _on_one_axis(image: np.ndarray, offset_px: float) -> np.ndarray:
    """The right image moved along its rows, so that both eyes have the same principal point."""
    if offset_px == 0.0:
        return image
    moved = cv2.warpAffine(
        image, np.array([[1.0, 0.0, -offset_px], [0.0, 1.0, 0.0]]), (image.shape[1], image.shape[0]),
        flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(moved)


def _pair(images: list[np.ndarray], binning: int) -> StereoPair:
    """The message that a robot would have sent."""
    bits = 8 if images[0].dtype == images[1].dtype == np.uint8 else 12
    if bits == 12:
        # Sixteen bits are cut to the twelve that cameras have; a file may hold twelve already.
        shift = 4 if max(int(i.max()) for i in images) > 4095 else 0
        images = [(i.astype(np.uint16) >> shift) for i in images]
    height, width = (s // binning for s in images[0].shape)
    small = [cv2.resize(i, (width, height), interpolation=cv2.INTER_AREA) if binning > 1 else i for i in images]
    zero = np.zeros((6, 6))
    still = Telemetry(
        seq=0, robot_id=NAME, t=0.0, joints=zero, motors=zero, torques=zero, attitude_rpy=np.zeros(3), rates=np.zeros(3),
        acceleration=np.array([0.0, 0.0, 9.81]), executive_state="idle", sequence_id=-1, command_index=0,
    )  # fmt: skip
    return StereoPair(
        seq=0, robot_id=NAME, t=0.0, camera=NAME, binning=binning, left=small[0], right=small[1], exposure=1.0, state=still,
        bits=bits,
    )  # fmt: skip


def _mapped(depth: DepthImage, file: CameraFile) -> FusedTerrain:
    far = file.depth_range[1]
    # All that the camera can see lies within `far` along its boresight and half its width to either side.
    half = far * 0.5 * depth.eye.width_px / depth.eye.focal_px
    config = FusionConfig(
        size_x=1.5 * far, size_y=2.0 * half, cell=file.cell, max_depth=far, max_sigma=max(0.08, 2.0 * file.cell)
    )
    grid = TerrainMap.around(0.6 * far, 0.0, config=config)
    grid.fuse(depth, file.camera.hex_from_camera)
    return grid.fused()


def _write_depth(depth: DepthImage, out: Path) -> None:
    millimetres = np.clip(np.rint(1000.0 * np.nan_to_num(depth.depth)), 0, 65535).astype(np.uint16)
    cv2.imwrite(str(out / "depth.png"), millimetres)
    np.savez_compressed(out / "depth.npz", depth=depth.depth.astype(np.float32), sigma=depth.sigma.astype(np.float32))
    figure, axes = subplots(1, 2, figsize=(11, 4.4))
    axes[0].imshow(depth.grey, cmap="gray", vmin=0, vmax=255)
    axes[0].set_title("Left image")
    low, high = np.nanquantile(depth.depth, [0.01, 0.99])
    axes[1].set_facecolor("#d1d5db")
    shown = axes[1].imshow(depth.depth, cmap="viridis_r", vmin=low, vmax=high, interpolation="nearest")
    axes[1].set_title("Depth (grey: unknown)")
    for a in axes:
        a.set_xticks([])
        a.set_yticks([])
    figure.colorbar(shown, ax=axes[1], label="depth along the boresight [m]", shrink=0.85)
    (out / "depth_view.png").write_bytes(png(figure))


def _write_cloud(depth: DepthImage, path: Path) -> int:
    o3d = open3d()
    known = np.isfinite(depth.depth)
    points = depth.camera.hex_from_camera.apply(depth.points_in_camera()[known])
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.colors = o3d.utility.Vector3dVector(np.repeat(depth.grey[known][:, None] / 255.0, 3, axis=1))
    if not o3d.io.write_point_cloud(str(path), cloud):
        raise CameraError(f"{path}: the point cloud cannot be written")
    return len(points)


def _write_elevation(terrain: FusedTerrain, out: Path) -> None:
    grid = terrain.grid
    np.savez_compressed(
        out / "elevation.npz", heights=grid.heights, variance=terrain.variance, count=terrain.count,
        origin=np.array([grid.origin_x, grid.origin_y]), cell=grid.cell,
    )  # fmt: skip
    figure, axes = subplots(figsize=(6.4, 5.6))
    axes.set_facecolor("#d1d5db")
    seen = ~terrain.unknown
    if seen.any():
        _hillshade(figure, axes, grid.heights, grid.origin_x, grid.origin_y, grid.cell, seen)
    axes.set_title("Elevation (grey: not seen)")
    axes.set_xlabel("to the right [m]")
    axes.set_ylabel("forward [m]")
    (out / "elevation.png").write_bytes(png(figure))


def _hillshade(
    figure: Any, axes: Any, heights: np.ndarray, origin_x: float, origin_y: float, cell: float, seen: np.ndarray
) -> None:
    """Heights in colours, shaded by a light from the upper left; cut to what was seen, forward up."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LightSource, Normalize

    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    z = heights[part][:, ::-1]
    low, high = np.nanquantile(z, [0.02, 0.98])
    scale = Normalize(low, max(high, low + 1e-3))
    filled = np.where(np.isfinite(z), z, np.nanmedian(z))
    light = LightSource(azdeg=315, altdeg=40)
    picture = light.shade(
        filled, cmap=colormaps["cividis"], norm=scale, vert_exag=1.5, dx=cell, dy=cell, blend_mode="soft"
    )
    picture[~np.isfinite(z)] = [0.82, 0.835, 0.86, 1.0]
    y = origin_y + cell * columns
    x = origin_x + cell * rows
    extent = (-y[-1] - cell / 2, -y[0] + cell / 2, x[0] - cell / 2, x[-1] + cell / 2)
    axes.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
    figure.colorbar(ScalarMappable(scale, colormaps["cividis"]), ax=axes, label="height [m]", shrink=0.85)


def _quantiles(values: np.ndarray) -> dict[str, float]:
    p5, median, p95 = np.quantile(values, [0.05, 0.5, 0.95])
    return {"p5": float(p5), "median": float(median), "p95": float(p95)}


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


if __name__ == "__main__":
    sys.exit(main())
