"""Stereo pair -> depth image: the first stage of the ground's view of the terrain.

Model: rectified eyes, so a point at depth z shifts by f b / z pixels along the row. OpenCV's semi-global matching
finds the shift to 1/16 pixel; a second match with the roles of the eyes exchanged removes what only one eye sees. The
error of a depth is the error of the shift seen through z = f b / d: sigma_z = z^2 sigma_d / (f b), and sigma_d grows
where the texture along the row is weak against the image noise.

Depth is along the boresight (z of the camera frame), not along the ray.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
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


@dataclass(frozen=True, kw_only=True)
class StereoConfig:
    """How a pair is matched."""

    mode: str = "3way"
    """"3way" (three paths, fast), "sgbm" (five) or "hh" (eight, twelve times slower for 2 mm)"""
    depth_range: dict[str, tuple[float, float]] = field(
        default_factory=lambda: {"hazcam": (0.6, 7.0), "navcam": (1.2, 12.0), "toolcam": (0.3, 3.0)}
    )
    """per camera group: nearest and farthest depth that is looked for [m]; nearer legs would double the search"""
    block_px: int = 5
    """edge of the matched window, odd: 3 is noisy, 7 fattens legs by another pixel"""
    uniqueness_percent: int = 5
    """the best cost must beat the second by this much"""
    left_right_px: float = 1.0
    """largest difference between the two directions of matching"""
    speckle_px: int = 60
    """islands of fewer pixels are dropped"""
    speckle_step_px: float = 1.0
    """disparities of neighbours closer than this belong to one island"""
    refinements: int = 2
    """rounds of least squares after matching: they halve the median error, a third round gains nothing"""
    refine_sigma_px: float = 2.0
    """of the refinement's Gaussian window"""
    image_noise: float = 2.0
    """of a pixel, one sigma, in grey levels; sets where texture is too weak"""
    sigma_disparity_px: float = 0.10
    """error of the shift on good texture, one sigma; its median was measured as 0.06 to 0.075 on rendered rock fields"""
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

    def points_in_camera(self) -> np.ndarray:
        """A point per pixel in the camera's frame, shape (h, w, 3), NaN where unknown [m]."""
        return np.asarray(self.eye.rays() * self.depth[..., None])


def match(pair: StereoPair, camera: StereoCamera, *, config: StereoConfig) -> DepthImage:
    """Depth of the left image of a pair, with one sigma a pixel [m].

    Args:
        pair: rectified images, perhaps binned.
        camera: the drawing of the camera that took them.
        config: how to match.
    """
    eye = camera.eye.binned(pair.binning) if pair.binning != 1 else camera.eye
    _check(pair, camera, eye)
    constant = eye.focal_px * camera.baseline
    near, far = _depth_range(camera, config)
    smallest = max(int(np.floor(constant / far)), 0)
    count = int(np.ceil((constant / near - smallest) / 16.0)) * 16
    matcher = _matcher(smallest, max(count, 16), config)
    disparity = _consistent(matcher, pair.left, pair.right, smallest + count, config)
    cv2.filterSpeckles(disparity, -16, config.speckle_px, int(config.speckle_step_px * SUBPIXEL))
    shift = disparity.astype(np.float64) / SUBPIXEL
    known = (shift > 0.0) & (shift >= smallest)
    shift = _refined(pair.left, pair.right, shift, known, config)
    sigma_shift = _sigma_disparity(pair.left, config)
    known &= sigma_shift <= config.sigma_disparity_max_px
    depth = np.where(known, constant / np.where(known, shift, 1.0), np.nan)
    sigma = depth**2 * sigma_shift / constant
    return DepthImage(camera=camera, eye=eye, depth=depth, sigma=sigma, grey=pair.left, t=pair.t)


def _check(pair: StereoPair, camera: StereoCamera, eye: Pinhole) -> None:
    if pair.camera != camera.name:
        raise CameraError(f"pair comes from camera {pair.camera!r}, not from {camera.name!r}")
    need = (eye.height_px, eye.width_px)
    if pair.left.shape != need or pair.right.shape != need:
        have = f"{pair.left.shape} and {pair.right.shape}"
        raise CameraError(f"images of {camera.name} have shapes {have}, need {need} at binning {pair.binning}")


def _depth_range(camera: StereoCamera, config: StereoConfig) -> tuple[float, float]:
    if camera.group not in config.depth_range:
        known = ", ".join(sorted(config.depth_range))
        raise ConfigError(f"no depth_range for camera group {camera.group!r}; there are: {known}")
    return config.depth_range[camera.group]


def _matcher(smallest: int, count: int, config: StereoConfig) -> cv2.StereoSGBM:
    area = config.block_px**2
    # P1 and P2 as OpenCV's documentation recommends for one channel. OpenCV splits the image into a fixed number of
    # stripes, so the result does not depend on the number of threads.
    return cv2.StereoSGBM.create(
        minDisparity=smallest,
        numDisparities=count,
        blockSize=config.block_px,
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
    backward = _padded_disparity(matcher, mirrored_left, mirrored_right, largest)[:, ::-1]
    width = forward.shape[1]
    columns = np.arange(width)[None, :] - np.rint(forward / SUBPIXEL).astype(np.int64)
    back = np.take_along_axis(backward, np.clip(columns, 0, width - 1), axis=1)
    # Outside the right image nothing contradicts, but nothing was matched either.
    agree = np.abs(forward.astype(np.int64) - back) <= config.left_right_px * SUBPIXEL
    agree &= (columns >= 0) & (forward > 0) & (back > 0)
    return np.where(agree, forward, np.int16(-16)).astype(np.int16)


def _padded_disparity(matcher: cv2.StereoSGBM, left: Image, right: Image, largest: int) -> np.ndarray:
    """OpenCV leaves the first `largest` columns unknown even for far points: padded, only the unseen is lost."""
    a = cv2.copyMakeBorder(left, 0, 0, largest, 0, cv2.BORDER_REPLICATE)
    b = cv2.copyMakeBorder(right, 0, 0, largest, 0, cv2.BORDER_REPLICATE)
    return np.asarray(matcher.compute(a, b))[:, largest:]


def _refined(left: Image, right: Image, shift: np.ndarray, known: np.ndarray, config: StereoConfig) -> np.ndarray:
    """Shifts that make the warped right image equal the left one in least squares, window by window [px].

    Semi-global matching fits a parabola to costs that are blind to sampling, which draws shifts to whole pixels: on flat
    ground that is a staircase of several centimetres at 5 m.
    """
    a, b = left.astype(np.float32), right.astype(np.float32)
    rows, columns = np.indices(shift.shape, dtype=np.float32)
    sigma = config.refine_sigma_px
    weight = known.astype(np.float32)
    out = shift.astype(np.float32)
    for _ in range(config.refinements):
        warped = cv2.remap(b, columns - out, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        gradient = 0.125 * cv2.Sobel(0.5 * (warped + a), cv2.CV_32F, 1, 0, ksize=3)
        residual = warped - a
        # A Gaussian, since a box would amplify ripples of the shift that its side lobes turn around.
        trust = weight / (1.0 + np.square(residual / (4.0 * config.image_noise)))
        energy = cv2.GaussianBlur(trust * gradient * gradient, (0, 0), sigma)
        pull = cv2.GaussianBlur(trust * gradient * residual, (0, 0), sigma)
        step = pull / np.maximum(energy, 1.0)
        # Half a pixel is all that matching can be wrong by; more is another surface in the window.
        out = np.where(known, np.clip(out + step, shift - 0.5, shift + 0.5), out).astype(np.float32)
    return out.astype(np.float64)


def _sigma_disparity(left: Image, config: StereoConfig) -> np.ndarray:
    """One sigma of the shift [px]: the floor, and image noise over the root-mean-square gradient along the row."""
    grey = left.astype(np.float32)
    gradient = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    window = (config.block_px + 2, config.block_px + 2)
    energy = cv2.boxFilter(gradient * gradient, cv2.CV_32F, window).astype(np.float64)
    # The noise itself makes gradients: sobel/8 passes 12/64 of its variance (squares of 1, 2, 1 twice, over 8 squared).
    energy = np.maximum(energy - 12.0 / 64.0 * config.image_noise**2, 0.0)
    pixels = window[0] * window[1]
    noise = 2.0 * config.image_noise**2 / (pixels * np.maximum(energy, 1e-6))
    return np.asarray(np.sqrt(config.sigma_disparity_px**2 + noise))
