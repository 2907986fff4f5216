"""Stereo pair -> depth image: the first stage of the ground's view of the terrain.

Model: rectified eyes, so a point at depth z shifts by f b / z pixels along the row. OpenCV's semi-global matching
finds the shift, a second match with the roles of the eyes exchanged removes what only one eye sees, and least squares on
the grey values find the sub-pixels. Large pairs are searched at half their size. The error of a depth is the error of the
shift seen through z = f b / d: sigma_z = z^2 sigma_d / (f b). sigma_d grows where what the least squares could not explain
is large against the texture along the row, and where neighbouring shifts differ: there are slopes, outlines and noise.

Depth is along the boresight (z of the camera frame), not along the ray.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import no_type_check

import cv2
import numba
import numpy as np

from athlete_twin.errors import CameraError, ConfigError
from athlete_twin.geometry.arrays import DepthMap, Image
from athlete_twin.messages import StereoPair
from athlete_twin.model.camera import Pinhole, StereoCamera

MODES = {
    "3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    "sgbm": cv2.STEREO_SGBM_MODE_SGBM,
    "hh": cv2.STEREO_SGBM_MODE_HH,
}
SUBPIXEL = 16.0
"""OpenCV's disparities are integers in sixteenths of a pixel."""
SAMPLES = 50.0
"""pixels that a Gaussian window of two pixels' sigma is worth: 4 pi sigma^2"""
ROUGHNESS_WINDOW = 11
"""edge of the window that a shift is compared with its neighbours in [px]"""
OUTLINE_WINDOW = 9
"""a pixel of a pair matched at half size is this near to an outline where its surface is asked again [px]"""


@dataclass(frozen=True, kw_only=True)
class StereoConfig:
    """How a pair is matched."""

    mode: str = "3way"
    """"3way" (three paths, fast), "sgbm" (five) or "hh" (eight, twelve times slower for 2 mm)"""
    depth_range: dict[str, tuple[float, float]] = field(
        default_factory=lambda: {"hazcam": (0.6, 7.0), "navcam": (1.2, 12.0), "toolcam": (0.3, 3.0)}
    )
    """per camera group: nearest and farthest depth that is looked for [m]; nearer legs would double the search"""
    full_width_px: int = 640
    """wider images are searched at half their size and refined at full: an eighth of the time, no worse (README)"""
    coarse_block_px: int = 3
    """`block_px` of the search at half size"""
    block_px: int = 5
    """edge of the matched window, odd: 3 is noisy, 7 fattens legs by another pixel"""
    uniqueness_percent: int = 5
    """the best cost must beat the second by this much"""
    left_right_px: float = 1.0
    """largest difference between the two directions of matching"""
    speckle_px: int = 100
    """islands of fewer pixels are dropped: where there is but noise, the search agrees on islands of some dozen"""
    speckle_step_px: float = 1.0
    """disparities of neighbours closer than this belong to one island"""
    refinements: int = 2
    """rounds of least squares after matching: they halve the median error, a third round gains nothing"""
    refine_sigma_px: float = 2.0
    """of the refinement's Gaussian window"""
    image_noise: float = 2.0
    """of a pixel, one sigma, in grey levels: pixels that misfit by more than four of it are trusted less"""
    sigma_floor_px: float = 0.01
    """error of the shift on perfect texture, one sigma"""
    noise_gain: float = 0.50
    """of the error that the least squares' own misfit promises; below 1, since the roughness below holds part of it.
    This, the next two and their form were fitted to rendered rock fields, seeds 100 and 101, both robots"""
    roughness_gain: float = 1.0
    """of the shifts' deviation from their neighbours' mean: noise, slopes and outlines all show there"""
    least_misfit: float = 3.7
    """added to the mean squared misfit, which cut-off or constant pixels lack [grey levels squared]"""
    sigma_disparity_max_px: float = 1.0
    """where the texture promises less than this the pixel is unknown"""

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ConfigError(f"stereo mode {self.mode!r} is not one of {', '.join(MODES)}")
        if self.block_px < 1 or self.block_px % 2 == 0:
            raise ConfigError(f"block_px is {self.block_px}, must be odd and positive")
        for group, (near, far) in self.depth_range.items():
            if not 0.0 < near < far:
                raise ConfigError(f"depth_range of {group} is {near} to {far} m, must grow from above 0")


@dataclass(frozen=True, eq=False, kw_only=True)
class DepthImage:
    """Depth seen by the left eye of a pair, NaN where unknown."""

    camera: StereoCamera
    """as drawn; its eye has the full resolution"""
    eye: Pinhole
    """of this image, binned as the pair was"""
    depth: DepthMap
    """along the boresight, shape (h, w) [m]"""
    sigma: DepthMap
    """one sigma of the depth, NaN where the depth is [m]"""
    grey: Image
    """the left image"""
    t: float
    """when the pair was taken, mission time [s]"""

    def __post_init__(self) -> None:
        if self.depth.shape != self.sigma.shape:
            raise CameraError(
                f"depth and sigma of {self.camera.name} have shapes {self.depth.shape} and {self.sigma.shape}, must be alike"
            )
        bad = _nonsense(np.ascontiguousarray(self.depth), np.ascontiguousarray(self.sigma))
        if bad:
            raise CameraError(
                f"{bad} pixels of {self.camera.name} have a depth or sigma that is negative, zero or infinite, or a depth without "
                f"a sigma; unknown pixels must be NaN"
            )

    def points_in_camera(self) -> np.ndarray:
        """A point per pixel in the camera's frame, shape (h, w, 3), NaN where unknown [m]."""
        return np.asarray(self.eye.rays() * self.depth[..., None])


def match(pair: StereoPair, camera: StereoCamera, *, config: StereoConfig) -> DepthImage:
    """Depth of the left image of a pair, with one sigma a pixel [m].

    Args:
        pair: rectified 8-bit images, perhaps binned; deeper ones and brackets pass through `exposure.merged` first.
        camera: the drawing of the camera that took them.
        config: how to match.
    """
    eye = camera.eye.binned(pair.binning) if pair.binning != 1 else camera.eye
    _check(pair, camera, eye)
    left, right = np.ascontiguousarray(pair.left), np.ascontiguousarray(pair.right)
    constant = np.float32(eye.focal_px * camera.baseline)
    near, far = _depth_range(camera, config)
    smallest = max(int(np.floor(constant / far)), 0)
    count = max(int(np.ceil((constant / near - smallest) / 16.0)) * 16, 16)
    if eye.width_px > config.full_width_px:
        coarse = _coarse(left, right, smallest, count, config)
        slack = 1.0
    else:
        coarse = _searched(left, right, smallest, count, config.block_px, config.speckle_px, config)
        slack = 0.5
    known = (coarse > 0.0) & (coarse >= smallest)
    shift, energy, misfit = _refined(left, right, coarse, known, slack, config)
    sigma_shift = _sigma_disparity(shift, known, energy, misfit, config)
    known &= (sigma_shift <= config.sigma_disparity_max_px) & (shift > 0.0)
    depth = np.where(known, constant / np.where(known, shift, np.float32(1.0)), np.float32(np.nan)).astype(np.float64)
    sigma = depth**2 * sigma_shift / constant
    return DepthImage(camera=camera, eye=eye, depth=depth, sigma=sigma, grey=left, t=pair.t)


@numba.njit(cache=True)
@no_type_check
def _nonsense(depth, sigma):
    """How many pixels would put a hole or a spike into a map: neither unknown nor a positive depth with a positive sigma."""
    count = 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            d, s = depth[v, u], sigma[v, u]
            if not np.isnan(d) and not (0.0 < d < np.inf and 0.0 < s < np.inf):
                count += 1
    return count


def _check(pair: StereoPair, camera: StereoCamera, eye: Pinhole) -> None:
    if pair.camera != camera.name:
        raise CameraError(f"pair comes from camera {pair.camera!r}, not from {camera.name!r}")
    need = (eye.height_px, eye.width_px)
    if pair.left.shape != need or pair.right.shape != need:
        have = f"{pair.left.shape} and {pair.right.shape}"
        raise CameraError(f"images of {camera.name} have shapes {have}, need {need} at binning {pair.binning}")
    if pair.left.dtype != np.uint8 or pair.right.dtype != np.uint8:
        kinds = f"{pair.left.dtype} and {pair.right.dtype}"
        raise CameraError(f"images of {camera.name} are {kinds}; only uint8 is matched, exposure.merged makes it")


def _depth_range(camera: StereoCamera, config: StereoConfig) -> tuple[float, float]:
    if camera.group not in config.depth_range:
        known = ", ".join(sorted(config.depth_range))
        raise ConfigError(f"no depth_range for camera group {camera.group!r}; there are: {known}")
    return config.depth_range[camera.group]


def _coarse(left: Image, right: Image, smallest: int, count: int, config: StereoConfig) -> np.ndarray:
    """Shifts found at half the size, spread over the full one and sharpened along the outlines [px], -1 where unknown.

    Least squares at full size finds the sub-pixels anyhow, and a search at half the size costs an eighth.
    """
    small = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (left, right)]
    half = _searched(
        small[0], small[1], smallest // 2, int(np.ceil(count / 32.0)) * 16, config.coarse_block_px,
        config.speckle_px // 4, config,
    )  # fmt: skip
    size = (left.shape[1], left.shape[0])
    nearest = cv2.resize(half, size, interpolation=cv2.INTER_NEAREST)
    linear = cv2.resize(half, size, interpolation=cv2.INTER_LINEAR)
    # On one surface the shift is linear; across an outline a mean would be neither surface's.
    spread = 2.0 * np.where((nearest > 0.0) & (np.abs(linear - nearest) < 1.0), linear, nearest)
    known = spread > 0.0
    window = np.ones((OUTLINE_WINDOW, OUTLINE_WINDOW), dtype=np.uint8)
    low = cv2.erode(np.where(known, spread, np.float32(1e6)), window)
    high = cv2.dilate(np.where(known, spread, np.float32(-1.0)), window)
    _sharpen(left, right, spread, low, high)
    return np.asarray(spread, dtype=np.float32)


@numba.njit(cache=True)
@no_type_check
def _sharpen(left, right, shift, low, high):
    """Beside an outline each pixel takes the surface, near or far, whose shift makes its surroundings agree best."""
    height, width = left.shape
    for v in range(2, height - 2):
        for u in range(2, width - 2):
            if shift[v, u] <= 0.0 or high[v, u] - low[v, u] < 3.0:
                continue
            best, least = shift[v, u], 1e9
            for which in range(3):
                d = shift[v, u] if which == 0 else (low[v, u] if which == 1 else high[v, u])
                at = u - d
                base = int(np.floor(at))
                if base < 2 or base + 3 >= width:
                    continue
                part = at - base
                cost = 0.0
                for dv in range(-2, 3):
                    for du in range(-2, 3):
                        r = (1.0 - part) * right[v + dv, base + du] + part * right[v + dv, base + du + 1]
                        cost += abs(r - left[v + dv, u + du])
                # What the search found stays unless another surface fits clearly better.
                if cost < least * (1.0 if which == 0 else 0.9):
                    best, least = d, cost
            shift[v, u] = best


def _searched(
    left: Image, right: Image, smallest: int, count: int, block_px: int, speckle_px: int, config: StereoConfig
) -> np.ndarray:
    """Shifts of semi-global matching that both directions agree on, islands dropped [px], -1 where unknown."""
    matcher = _matcher(smallest, count, block_px, config)
    disparity = _consistent(matcher, left, right, smallest + count, config)
    cv2.filterSpeckles(disparity, -16, speckle_px, int(config.speckle_step_px * SUBPIXEL))
    return np.asarray(disparity, dtype=np.float32) / np.float32(SUBPIXEL)


def _matcher(smallest: int, count: int, block_px: int, config: StereoConfig) -> cv2.StereoSGBM:
    area = block_px**2
    # P1 and P2 as OpenCV's documentation recommends for one channel. OpenCV splits the image into a fixed number of
    # stripes, so the result does not depend on the number of threads.
    return cv2.StereoSGBM.create(
        minDisparity=smallest,
        numDisparities=count,
        blockSize=block_px,
        P1=8 * area,
        P2=32 * area,
        disp12MaxDiff=-1,
        preFilterCap=31,
        uniquenessRatio=config.uniqueness_percent,
        speckleWindowSize=0,
        mode=MODES[config.mode],
    )


def _consistent(matcher: cv2.StereoSGBM, left: Image, right: Image, largest: int, config: StereoConfig) -> np.ndarray:
    """Disparities of the left image in sixteenths of a pixel, -16 where the two directions of matching disagree."""
    forward = _padded_disparity(matcher, left, right, largest)
    # Mirrored, the right eye is a left eye: the same matcher gives the right image's disparities.
    mirrored_left, mirrored_right = np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1])
    backward = _padded_disparity(matcher, mirrored_left, mirrored_right, largest)
    return np.asarray(_agreeing(forward, backward, int(config.left_right_px * SUBPIXEL)))


@numba.njit(cache=True)
@no_type_check
def _agreeing(forward, backward, limit):
    """`forward` where the pixel it points at points back, -16 elsewhere; `backward` is mirrored."""
    height, width = forward.shape
    out = np.full((height, width), -16, np.int16)
    for v in range(height):
        for u in range(width):
            d = forward[v, u]
            # Outside the right image nothing contradicts, but nothing was matched either.
            at = u - ((d + 8) >> 4)
            if d <= 0 or at < 0:
                continue
            back = backward[v, width - 1 - at]
            if back > 0 and abs(d - back) <= limit:
                out[v, u] = d
    return out


def _padded_disparity(matcher: cv2.StereoSGBM, left: Image, right: Image, largest: int) -> np.ndarray:
    """OpenCV leaves the first `largest` columns unknown even for far points: padded, only the unseen is lost."""
    a = cv2.copyMakeBorder(left, 0, 0, largest, 0, cv2.BORDER_REPLICATE)
    b = cv2.copyMakeBorder(right, 0, 0, largest, 0, cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(matcher.compute(a, b)[:, largest:])


def _refined(
    left: Image, right: Image, shift: np.ndarray, known: np.ndarray, slack: float, config: StereoConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shifts that make the warped right image equal the left one in least squares, window by window [px], float32.

    Semi-global matching fits a parabola to costs that are blind to sampling, which draws shifts to whole pixels: on flat
    ground that is a staircase of several centimetres at 5 m. More than `slack` [px] off is another surface's.

    Beside the shifts: the windows' mean squared gradient along the row, and the mean square of what the images still
    differ by where they were last compared [grey levels squared].
    """
    a, b = left.astype(np.float32), right.astype(np.float32)
    columns = np.arange(left.shape[1], dtype=np.float32)[None, :]
    rows = np.repeat(np.arange(left.shape[0], dtype=np.float32)[:, None], left.shape[1], axis=1)
    width = 2 * int(np.ceil(2.5 * config.refine_sigma_px)) + 1
    # A Gaussian, since a box would amplify ripples of the shift that its side lobes turn around.
    kernel = cv2.getGaussianKernel(width, config.refine_sigma_px, cv2.CV_32F)
    scale = np.float32(4.0 * config.image_noise)
    out = shift.copy()
    terms = np.zeros((4, *left.shape), dtype=np.float32)
    for _ in range(config.refinements):
        warped = cv2.remap(b, columns - out, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        gradient = cv2.Sobel(cv2.addWeighted(warped, 0.5, a, 0.5, 0.0), cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
        _normal_terms(a, warped, gradient, known, scale, terms)
        smooth = [cv2.sepFilter2D(term, cv2.CV_32F, kernel, kernel) for term in terms]
        _step(out, shift, smooth[0], smooth[1], known, np.float32(slack))
    weight = np.maximum(smooth[3], np.float32(1e-3))
    return out, smooth[0] / weight, smooth[2] / weight


@numba.njit(cache=True)
@no_type_check
def _normal_terms(a, warped, gradient, known, scale, terms):
    """Both sides of the normal equation of each pixel, misfits trusted less; the squared misfit; the trust."""
    for v in range(a.shape[0]):
        for u in range(a.shape[1]):
            if known[v, u]:
                residual = warped[v, u] - a[v, u]
                trust = np.float32(1.0) / (np.float32(1.0) + (residual / scale) ** 2)
                terms[0, v, u] = trust * gradient[v, u] * gradient[v, u]
                terms[1, v, u] = trust * gradient[v, u] * residual
                terms[2, v, u] = trust * residual * residual
                terms[3, v, u] = trust


@numba.njit(cache=True)
@no_type_check
def _step(out, start, energy, pull, known, slack):
    for v in range(out.shape[0]):
        for u in range(out.shape[1]):
            if known[v, u]:
                moved = out[v, u] + pull[v, u] / max(energy[v, u], np.float32(1.0))
                out[v, u] = min(max(moved, start[v, u] - slack), start[v, u] + slack)


def _sigma_disparity(
    shift: np.ndarray, known: np.ndarray, energy: np.ndarray, misfit: np.ndarray, config: StereoConfig
) -> np.ndarray:
    """One sigma of the shift [px], from what the least squares left and from how rough the shifts around are."""
    noise = (misfit + np.float32(config.least_misfit)) / (SAMPLES * np.maximum(energy, np.float32(1e-2)))
    weight = np.maximum(_boxed(known.astype(np.float32)), np.float32(1e-3))
    filled = np.where(known, shift, np.float32(0.0))
    deviation = np.where(known, _boxed(filled) / weight - shift, np.float32(0.0))
    rough = _boxed(deviation * deviation) / weight
    variance = config.sigma_floor_px**2 + config.noise_gain**2 * noise + config.roughness_gain**2 * rough
    return np.asarray(np.sqrt(variance), dtype=np.float32)


def _boxed(values: np.ndarray) -> np.ndarray:
    window = (ROUGHNESS_WINDOW, ROUGHNESS_WINDOW)
    return np.asarray(cv2.boxFilter(values, cv2.CV_32F, window, borderType=cv2.BORDER_REPLICATE))
