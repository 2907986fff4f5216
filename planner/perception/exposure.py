"""A bracket of exposures, or one deep image, -> the 8-bit pair that the matcher wants.

Sunlit ground and shadow differ by more than eight bits hold: what is texture in the one is noise in the other, and
there the correlator of [SunSpiral2012] s5.2 failed. The images are linear in the light, so an exposure's grey value
over exposure time is radiance, and the mean of several, weighted by what each one's noise leaves it worth, is better
than any of them. Samples at white or within the read noise say nothing and weigh nothing.

The matcher compares differences of grey values. A logarithm makes them ratios of radiance: a pebble twice as bright as
the soil differs from it by as much in the shade as in the sun. Curve and limits are the same for both eyes. Measured by
the depth of shadows (`scripts/perception_stereo.py`), OpenCV's MergeDebevec before the same curve is as good and
MergeMertens, which mixes grey values instead of measuring, worse; square root, cube root and division by the
surroundings' brightness in place of the logarithm are worse too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from athlete_twin.errors import CameraError, ConfigError
from athlete_twin.geometry.arrays import DepthMap, Image
from athlete_twin.messages import StereoPair


@dataclass(frozen=True, kw_only=True)
class ExposureConfig:
    """What the ground knows of the sensor, and how radiance becomes grey again."""

    full_well: float = 12000.0
    """photo-electrons at white, of one pixel, from the data sheet: sets the photon noise"""
    read_noise: float = 12.0
    """of one pixel, one sigma [electrons]"""
    white_share: float = 0.98
    """samples above this share of white may be cut off and are not used"""
    dark_sigma: float = 2.0
    """samples below so many sigma of the read noise are not used where another exposure has a better one"""
    low_percentile: float = 0.2
    """of radiance, becomes black"""
    high_percentile: float = 99.8
    """becomes white"""
    linear_sigma: float = 8.0
    """below so many sigma of the longest exposure's noise in the dark the curve is linear: there a logarithm would only
    draw the noise apart"""

    def __post_init__(self) -> None:
        for name in ("full_well", "read_noise", "linear_sigma"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise ConfigError(f"{name} is {getattr(self, name)}, must be positive")
        if not 0.5 <= self.white_share < 1.0:
            raise ConfigError(f"white_share is {self.white_share}, must be from 0.5 to below 1")
        if not 0.0 <= self.low_percentile < self.high_percentile <= 100.0:
            raise ConfigError(f"percentiles {self.low_percentile} and {self.high_percentile} must grow within 0 to 100")


@dataclass(frozen=True, eq=False, kw_only=True)
class Radiance:
    """What one eye saw, in shares of white a second: linear in the light."""

    value: DepthMap
    """shape (h, w) [1/s]"""
    told: np.ndarray
    """pixels with at least one sample that is neither cut off nor noise, shape (h, w)"""
    dark: float
    """noise where there is no light, one sigma [1/s]"""


def merged(pairs: Sequence[StereoPair], *, config: ExposureConfig | None = None) -> StereoPair:
    """One 8-bit pair from all exposures of one camera and instant; a single 8-bit pair comes back as it is.

    Args:
        pairs: a bracket of equal sizes, or one pair of 8 or 12 bits.
        config: the sensor and the curve.
    """
    config = ExposureConfig() if config is None else config
    _check(pairs)
    if len(pairs) == 1 and pairs[0].bits == 8:
        return pairs[0]
    left, right = radiances(pairs, config=config)
    images = toned(left.value, right.value, dark=max(left.dark, right.dark), config=config)
    reference = min(pairs, key=lambda p: p.bracket)
    return replace(reference, left=images[0], right=images[1], bits=8)


def radiances(pairs: Sequence[StereoPair], *, config: ExposureConfig) -> tuple[Radiance, Radiance]:
    """Radiance of the left and the right eye, by weights from the noise."""
    _check(pairs)
    return _merge_eye(pairs, "left", config), _merge_eye(pairs, "right", config)


def toned(left: DepthMap, right: DepthMap, *, dark: float, config: ExposureConfig) -> tuple[Image, Image]:
    """8-bit images of two radiances by one curve: linear at the bottom, logarithmic above.

    Args:
        left: radiance, shape (h, w) [1/s].
        right: of the other eye.
        dark: noise where there is no light, one sigma [1/s].
        config: the curve's ends.
    """
    low, high = np.percentile(
        np.concatenate([left.ravel()[::7], right.ravel()[::7]]), [config.low_percentile, config.high_percentile]
    )
    bend = max(float(low), config.linear_sigma * dark, 1e-9)
    bottom = np.log1p(min(float(low), 0.5 * float(high)) / bend)
    scale = 255.0 / max(float(np.log1p(float(high) / bend) - bottom), 1e-3)
    return _curve(left, bend, bottom, scale), _curve(right, bend, bottom, scale)


def _curve(radiance: DepthMap, bend: float, bottom: float, scale: float) -> Image:
    grey = scale * (np.log1p(np.maximum(radiance, 0.0) / bend) - bottom)
    out: Image = np.clip(np.rint(grey), 0.0, 255.0).astype(np.uint8)
    return out


def _check(pairs: Sequence[StereoPair]) -> None:
    if not pairs:
        raise CameraError("a bracket of no pairs cannot be merged, need at least one")
    first = pairs[0]
    for pair in pairs:
        if (pair.camera, pair.t, pair.binning) != (first.camera, first.t, first.binning):
            raise CameraError(
                f"a bracket mixes {first.camera} at {first.t} s, binning {first.binning}, with {pair.camera} at {pair.t} s, "
                f"binning {pair.binning}; all must be of one camera and instant"
            )
        if pair.left.shape != first.left.shape or pair.right.shape != first.right.shape:
            raise CameraError(f"a bracket of {first.camera} mixes sizes {first.left.shape} and {pair.left.shape}")
        if not (np.isfinite(pair.exposure) and pair.exposure > 0.0):
            raise CameraError(f"exposure of a pair of {pair.camera} is {pair.exposure} s, must be positive")


def _merge_eye(pairs: Sequence[StereoPair], side: str, config: ExposureConfig) -> Radiance:
    shape = getattr(pairs[0], side).shape
    total, weights = np.zeros(shape), np.zeros(shape)
    # Where every exposure fails, the least wrong one speaks: the shortest of the cut off, the longest of the dark.
    ordered = sorted(pairs, key=lambda p: p.exposure)
    shortest, longest = ordered[0], ordered[-1]
    cut = _share(longest, side) >= config.white_share
    fallback = np.where(cut, _share(shortest, side) / shortest.exposure, _share(longest, side) / longest.exposure)
    dark = np.inf
    for pair in ordered:
        share = _share(pair, side)
        # Of the photons, of reading, of rounding; averaging binned pixels lowers the first two.
        floor = config.read_noise**2 / (config.full_well * pair.binning) ** 2 + 1.0 / (12.0 * pair.white**2)
        variance = share / (config.full_well * pair.binning**2) + floor
        useful = (share < config.white_share) & (share > config.dark_sigma * np.sqrt(floor))
        weight = np.where(useful, pair.exposure**2 / variance, 0.0)
        total += weight * share / pair.exposure
        weights += weight
        dark = min(dark, float(np.sqrt(floor)) / pair.exposure)
    told = weights > 0.0
    value = np.where(told, total / np.where(told, weights, 1.0), fallback)
    return Radiance(value=value, told=told, dark=dark)


def _share(pair: StereoPair, side: str) -> np.ndarray:
    """Grey values as shares of white."""
    return np.asarray(getattr(pair, side) / float(pair.white))
