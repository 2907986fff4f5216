"""Whether a stereo pair can be used at all: what a camera can do to its pictures in the field is an answer, not an error.

A dead camera sends black, one that looks into the sun white, a broken transfer ends in constant rows. Matching such a
pair costs time and may leave a spike; it is left out with its reason, and the map keeps what it had.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import RawImage
from athlete_twin.messages import StereoPair
from athlete_twin.model.camera import StereoCamera

KINDS = ("usable", "size", "truncated", "constant", "black", "saturated")
EXPOSURE = ("black", "saturated")
"""kinds that another exposure of the same bracket can mend"""


@dataclass(frozen=True, kw_only=True)
class QualityConfig:
    """Where an image stops being one."""

    black_level: float = 0.02
    """an image whose 99th percentile lies below this share of white is black"""
    saturated_share: float = 0.5
    """more of the pixels at white"""
    least_spread: float = 0.004
    """standard deviation of the grey values, as a share of white: less is a constant image"""
    truncated_share: float = 0.02
    """as much of the height at the lower border, each row of one grey value, is a transfer that broke off"""

    def __post_init__(self) -> None:
        for name in ("black_level", "saturated_share", "least_spread", "truncated_share"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ConfigError(f"{name} is {getattr(self, name)}, must be between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class PairQuality:
    """The verdict on one pair."""

    kind: str
    """one of `KINDS`"""
    reason: str
    """one line for the operator; empty when usable"""

    @property
    def usable(self) -> bool:
        """Whether the pair can be matched."""
        return self.kind == "usable"

    @property
    def mendable(self) -> bool:
        """Whether it may still serve as one exposure of a bracket."""
        return self.usable or self.kind in EXPOSURE


USABLE = PairQuality(kind="usable", reason="")


def judge(pair: StereoPair, camera: StereoCamera, *, config: QualityConfig | None = None) -> PairQuality:
    """Whether a pair can be used, and if not, why not.

    Args:
        pair: as it came down.
        camera: the drawing of the camera that took it.
        config: the limits.
    """
    config = QualityConfig() if config is None else config
    need = (camera.eye.height_px // pair.binning, camera.eye.width_px // pair.binning)
    if pair.left.shape != pair.right.shape:
        return _no("size", pair, f"left is {_size(pair.left)}, right {_size(pair.right)}")
    for side, image in (("left", pair.left), ("right", pair.right)):
        if image.shape != need:
            kind = "truncated" if image.shape[1] == need[1] and image.shape[0] < need[0] else "size"
            return _no(kind, pair, f"{side} is {_size(image)}, need {need[1]}x{need[0]} at binning {pair.binning}")
        verdict = _judge_image(image, pair, side, config)
        if not verdict.usable:
            return verdict
    return USABLE


def _judge_image(image: RawImage, pair: StereoPair, side: str, config: QualityConfig) -> PairQuality:
    white = float(pair.white)
    if np.percentile(image[::2, ::2], 99.0) < config.black_level * white:
        return _no("black", pair, f"{side} is black")
    share = float(np.mean(image >= 0.998 * white))
    if share > config.saturated_share:
        return _no("saturated", pair, f"{share:.0%} of {side} is white, more than {config.saturated_share:.0%}")
    spread = float(np.std(image[::2, ::2])) / white
    if spread < config.least_spread:
        return _no("constant", pair, f"{side} is constant, its spread is {spread:.2%} of white")
    # Noise makes no row of one value; black or white rows are such a share of a picture only when they were never sent.
    flat = (image.max(axis=1) == image.min(axis=1))[::-1]
    rows = int(np.argmin(flat)) if not flat.all() else len(flat)
    if rows > config.truncated_share * image.shape[0]:
        return _no("truncated", pair, f"{side} ends after row {image.shape[0] - rows} of {image.shape[0]}")
    return USABLE


def _no(kind: str, pair: StereoPair, why: str) -> PairQuality:
    return PairQuality(kind=kind, reason=f"{pair.camera} at {pair.t:.1f} s: {kind}: {why}")


def _size(image: RawImage) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
