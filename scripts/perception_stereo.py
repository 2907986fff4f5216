"""Is a depth's sigma what it says, and what do brackets add in the shade? Rendered rock fields against their truth.

Calibration: z = (depth - true depth) / sigma on ground and rocks, away from outlines, within the depths looked for, by
camera group, binning and sun; seeds that the sigma's constants were not fitted to. Brackets: the sun 15 deg high over
ground whose sky gives a tenth of its light, as towards an airless world's; a shadow's pixel is right within half a pixel
of disparity. `bench_perception.py` prints the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bench_table import Row, row
from report_style import png, subplots
from stereo_scenes import Scene, scenes

from athlete_twin.messages import StereoPair
from planner.perception.exposure import ExposureConfig, merged, toned
from planner.perception.stereo import DepthImage, StereoConfig, match

CAMERAS = {"sdm_b": ("hazcam_2", "navcam_1"), "t12": ("hazcam_1", "navcam_1")}
FIRST_SEED = 3
"""of the measured scenes; seeds 100 and 101 made the constants"""
WITHIN_ONE, WITHIN_TWO = (0.60, 0.76), (0.90, 0.98)
"""shares of |z| below 1 and 2; 0.683 and 0.954 for a normal error"""
SKY_SHARE = 0.1
BRACKET = (1.0, 4.0, 16.0)
"""multiples of the metered exposure"""
RIGHT_PX = 0.5


def rows(*, robots: tuple[str, ...], scenes: int) -> list[Row]:
    """Rows of the benchmark table.

    Args:
        robots: "sdm_b", "t12".
        scenes: seeds a robot.
    """
    return [row for robot in robots for row in (*_calibration(robot, scenes), *_brackets(robot, scenes))]


def pictures(out: Path) -> list[Path]:
    """A reliability plot, one example in pictures, and what a bracket does; the paths written."""
    out.mkdir(parents=True, exist_ok=True)
    found = list(scenes("sdm_b", CAMERAS["sdm_b"], seeds=range(FIRST_SEED, FIRST_SEED + 1), suns_deg=(15.0, 70.0), binnings=(2,)))
    paths = [out / "sigma_reliability.png", out / "stereo_example.png", out / "bracket_example.png"]
    paths[0].write_bytes(_reliability(found))
    paths[1].write_bytes(_example(found[0]))
    harsh = next(iter(scenes("sdm_b", ("hazcam_2",), seeds=range(FIRST_SEED, FIRST_SEED + 1), suns_deg=(15.0,), binnings=(1,))))
    paths[2].write_bytes(_bracket_example(harsh.under_darker_sky(SKY_SHARE)))
    return paths


def standard_errors(scene: Scene, depth: DepthImage) -> np.ndarray:
    """Z of every judged pixel with a depth."""
    z = (depth.depth - scene.left.depth) / depth.sigma
    return np.asarray(z[_asked(scene) & np.isfinite(z)])


def _asked(scene: Scene) -> np.ndarray:
    """Judged pixels whose depth is looked for."""
    near, far = StereoConfig().depth_range[scene.camera.group]
    depth = np.nan_to_num(scene.left.depth, nan=np.inf)
    return np.asarray(scene.judged() & (depth > near) & (depth < 0.95 * far))


def _calibration(robot: str, count: int) -> list[Row]:
    by_group: dict[tuple[str, int, float], list[np.ndarray]] = {}
    for scene in scenes(robot, CAMERAS[robot], seeds=range(FIRST_SEED, FIRST_SEED + count)):
        depth = match(scene.pair(), scene.camera, config=StereoConfig())
        key = (scene.camera.group, scene.binning, scene.sun_deg)
        by_group.setdefault(key, []).append(np.abs(standard_errors(scene, depth)))
    out = []
    for (group, binning, sun), parts in sorted(by_group.items()):
        z = np.concatenate(parts)
        for limit, (low, high) in ((1, WITHIN_ONE), (2, WITHIN_TWO)):
            share = float(np.mean(z < limit))
            name = f"{robot} {group} binning {binning}, sun {sun:.0f} deg: |z| < {limit}"
            out.append(row(name, share, "share", target=f"{low:.2f} - {high:.2f}"))
    return out


def _brackets(robot: str, count: int) -> list[Row]:
    names = ("bracket of 3", "12-bit single")
    right: dict[str, list[float]] = {name: [] for name in ("single", "mertens", "debevec", *names)}
    camera = CAMERAS[robot][:1]
    for plain in scenes(robot, camera, seeds=range(FIRST_SEED, FIRST_SEED + count), suns_deg=(15.0,), binnings=(1,)):
        scene = plain.under_darker_sky(SKY_SHARE)
        single, exposures = scene.pair(), bracket_of(scene)
        pairs = {
            "single": single, "bracket of 3": merged(exposures), "12-bit single": merged([scene.pair(bits=12)]),
            "mertens": _mertens(exposures), "debevec": _debevec(exposures),
        }  # fmt: skip
        for name, pair in pairs.items():
            right[name].append(_right_in_shadow(scene, pair))
    share = {name: float(np.mean(values)) for name, values in right.items()}
    what = f"{robot} shadow pixels with right depth"
    best = share["bracket of 3"]
    return [
        row(f"{what}: bracket of 3", best, "share", target=">= 1.0", of="ratio", peer_name="one 8-bit pair", peer=share["single"]),
        row(f"{what}: bracket of 3", best, "share", target=">= 1.0", of="ratio", peer_name="MergeMertens", peer=share["mertens"]),
        row(f"{what}: bracket of 3", best, "share", target=">= 0.99", of="ratio", peer_name="MergeDebevec", peer=share["debevec"]),
        row(f"{what}: 12-bit single", share["12-bit single"], "share", peer_name="one 8-bit pair", peer=share["single"]),
    ]


def bracket_of(scene: Scene) -> list[StereoPair]:
    """The bracket's pairs, metered one first."""
    return [scene.pair(exposure=scene.metered() * m, bracket=k) for k, m in enumerate(BRACKET)]


def _right_in_shadow(scene: Scene, pair: StereoPair) -> float:
    asked = _asked(scene) & scene.shadow
    return float(np.mean(_is_right(scene, match(pair, scene.camera, config=StereoConfig()))[asked]))


def _is_right(scene: Scene, depth: DepthImage) -> np.ndarray:
    constant = scene.eye.focal_px * scene.camera.baseline
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(constant / depth.depth - constant / scene.left.depth) < RIGHT_PX)


def _mertens(pairs: Sequence[StereoPair]) -> StereoPair:
    """OpenCV's fusion of grey values."""
    fusion = cv2.createMergeMertens()

    def eye(side: str) -> np.ndarray:
        colour = [cv2.cvtColor(getattr(p, side), cv2.COLOR_GRAY2BGR) for p in pairs]
        return np.asarray(np.clip(np.rint(255.0 * fusion.process(colour)[..., 0]), 0, 255).astype(np.uint8))

    return replace(pairs[0], left=eye("left"), right=eye("right"))


def _debevec(pairs: Sequence[StereoPair]) -> StereoPair:
    """OpenCV's merging to radiance with the linear response, then our curve."""
    times = np.array([p.exposure for p in pairs], dtype=np.float32)
    response = np.repeat(np.maximum(np.arange(256, dtype=np.float32), 1.0).reshape(256, 1, 1) / 128.0, 3, axis=2)
    merging = cv2.createMergeDebevec()

    def eye(side: str) -> np.ndarray:
        colour = [cv2.cvtColor(getattr(p, side), cv2.COLOR_GRAY2BGR) for p in pairs]
        return np.asarray(merging.process(colour, times, response)[..., 0], dtype=np.float64)

    left, right = toned(eye("left"), eye("right"), dark=1e-9, config=ExposureConfig())
    return replace(pairs[0], left=left, right=right)


def _reliability(found: Sequence[Scene]) -> bytes:
    figure, axes = subplots(1, 2, figsize=(10, 4.2))
    expected = np.linspace(0.02, 0.98, 49)
    from scipy.stats import norm

    limits = norm.ppf(0.5 + 0.5 * expected)
    colours = ("#1f77b4", "#e69f00", "#1b9e77", "#cc5fa0")
    axes[0].plot([0, 1], [0, 1], color="#9ca3af", lw=1, label="as a normal error")
    for scene, colour in zip(found, colours, strict=False):
        depth = match(scene.pair(), scene.camera, config=StereoConfig())
        z = np.sort(np.abs(standard_errors(scene, depth)))
        label = f"{scene.camera.group}, sun {scene.sun_deg:.0f} deg"
        axes[0].plot(expected, np.searchsorted(z, limits) / len(z), color=colour, label=label)
        use = _asked(scene) & np.isfinite(depth.depth)
        sigma, error = depth.sigma[use], np.abs(depth.depth - scene.left.depth)[use]
        edges = np.quantile(sigma, np.linspace(0, 1, 13))
        which = np.clip(np.searchsorted(edges, sigma) - 1, 0, 11)
        said = [1000 * np.median(sigma[which == k]) for k in range(12)]
        seen = [1000 * np.quantile(error[which == k], 0.683) for k in range(12)]
        axes[1].plot(said, seen, "o-", ms=3, color=colour, label=label)
    axes[0].set(xlabel="share expected within a multiple of sigma", ylabel="share found", title="Reliability of sigma")
    axes[0].set_aspect("equal")
    _low, high = axes[1].get_xlim()
    axes[1].plot([0, high], [0, high], color="#9ca3af", lw=1)
    axes[1].set(xscale="log", yscale="log", xlabel="sigma said [mm]", ylabel="error, 68 % quantile [mm]", title="Said and found")
    for a in axes:
        a.grid(visible=True)
        a.legend()
    return png(figure)


def _example(scene: Scene) -> bytes:
    depth = match(scene.pair(), scene.camera, config=StereoConfig())
    figure, axes = subplots(1, 3, figsize=(13, 3.6))
    axes[0].imshow(depth.grey, cmap="gray", vmin=0, vmax=255)
    axes[0].set_title(f"Left image, sun {scene.sun_deg:.0f} deg")
    low, high = np.nanquantile(depth.depth, [0.01, 0.99])
    shown = axes[1].imshow(depth.depth, cmap="viridis_r", vmin=low, vmax=high, interpolation="nearest")
    axes[1].set_title("Depth")
    figure.colorbar(shown, ax=axes[1], label="[m]")
    z = np.where(_asked(scene), (depth.depth - scene.left.depth) / depth.sigma, np.nan)
    shown = axes[2].imshow(z, cmap="RdBu", vmin=-3, vmax=3, interpolation="nearest")
    axes[2].set_title("Error over sigma, ground and rocks")
    figure.colorbar(shown, ax=axes[2])
    _bare(axes)
    return png(figure)


def _bracket_example(scene: Scene) -> bytes:
    single, bracket = scene.pair(), merged(bracket_of(scene))
    figure, axes = subplots(2, 2, figsize=(9, 6.8))
    asked = _asked(scene) & scene.shadow
    for column, (name, pair) in enumerate((("One exposure", single), ("Bracket of three", bracket))):
        axes[0, column].imshow(pair.left, cmap="gray", vmin=0, vmax=255)
        axes[0, column].set_title(name)
        right = _is_right(scene, match(pair, scene.camera, config=StereoConfig()))
        picture = np.full((*right.shape, 3), 0.93)
        picture[asked & right] = [0.11, 0.62, 0.47]
        picture[asked & ~right] = [0.75, 0.22, 0.17]
        axes[1, column].imshow(picture, interpolation="nearest")
        share = np.mean(right[asked])
        axes[1, column].set_title(f"Shadows: depth right (green) {100 * share:.0f} %")
    _bare(axes)
    return png(figure)


def _bare(axes: Any) -> None:
    for a in np.ravel(axes):
        a.set_xticks([])
        a.set_yticks([])
        a.set_facecolor("#d1d5db")
