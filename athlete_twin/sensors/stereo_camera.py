"""Stereo pairs as the robot takes them: true poses that differ from the drawings, exposure, photon and read noise, bits.

An image is linear: `grey = white min(1, radiance * exposure * RESPONSE)`, cut off at white, which is 255 or 4095. Pairs are
rectified: the error of a mounting moves both eyes together. A bracket of exposures is taken from one place at one time.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import CameraError
from athlete_twin.geometry.arrays import RawImage, Wheels
from athlete_twin.geometry.se3 import SE3
from athlete_twin.messages import BITS
from athlete_twin.model.camera import Pinhole
from athlete_twin.model.spec import RobotSpec
from athlete_twin.robot import ViewTruth
from athlete_twin.sensors.renderer import Renderer, RenderResult

RESPONSE = 500.0
"""share of white a second for a surface of radiance 1: EST, daylight at 5 ms for albedo 0.4 [1/s]"""
WHITE_ELECTRONS = 12000.0
"""photo-electrons of a single pixel at white; EST, a small machine-vision sensor"""
READ_ELECTRONS = 12.0
"""noise of reading a pixel, one sigma; EST"""
METERED_PERCENTILE = 97.0
"""the brightness that the exposure brings to `METERED_LEVEL`"""
METERED_LEVEL = 0.85
"""of white"""
METERED_FROM_ROW = 1.0 / 3.0
"""the upper third may be sky and is not metered"""
EXPOSURES = (1e-4, 0.05)
"""shortest and longest [s]"""
EYES = ("left", "right")


@dataclass(frozen=True, eq=False, kw_only=True)
class Shot:
    """One pair as taken, and what its left eye truly saw."""

    left: RawImage
    """grey, shape (h, w): 8 bits in uint8, 12 in uint16"""
    right: RawImage
    exposure: float
    """[s]"""
    seen: RenderResult
    """by the left eye: depth and labels, for scoring alone"""
    eye: Pinhole
    world_from_left: SE3
    """true pose of the left eye"""

    def truth(self, *, camera: str, t: float, wheels_in_world: Wheels) -> ViewTruth:
        """What the left image truly shows; the axles are where they were [m]."""
        seen = self.seen
        points = self.eye.rays() * seen.depth[..., None]
        points = self.world_from_left.apply(points.reshape(-1, 3)).reshape(points.shape)
        return ViewTruth(
            t=t, camera=camera, label=seen.label, leg=seen.leg, depth=seen.depth, points_in_world=points,
            wheels_in_world=wheels_in_world,
        )  # fmt: skip


class StereoRig:
    """All stereo pairs of one robot in one trial."""

    def __init__(self, spec: RobotSpec, renderer: Renderer, *, seed: int, camera_error: Mapping[str, SE3]) -> None:
        """Mounts the cameras as they truly are.

        Args:
            spec: the drawings.
            renderer: of the trial's terrain and robot.
            seed: of the trial, keys the noise.
            camera_error: `drawn_camera_from_true_camera` of each pair, from the trial's draw of the truth.
        """
        missing = [c.name for c in spec.cameras if c.name not in camera_error]
        if missing:
            raise CameraError(f"camera_error lacks {', '.join(missing)}; it has {', '.join(camera_error) or 'none'}")
        self._spec = spec
        self._renderer = renderer
        self._seed = seed
        self._link_from_left = {c.name: c.link_from_camera.compose(camera_error[c.name]) for c in spec.cameras}

    def true_pose(self, camera: str) -> SE3:
        """`link_from_camera` of the left eye as it truly is, for scoring."""
        self._spec.camera(camera)
        return self._link_from_left[camera]

    def capture(
        self,
        cameras: Sequence[str],
        binning: int,
        link_poses: Mapping[str, SE3],
        *,
        world_from_hex: SE3,
        index: int,
        exposure: float | None = None,
        bits: int = 8,
        brackets: Sequence[float] = (1.0,),
    ) -> dict[str, tuple[Shot, ...]]:
        """The shots of each named pair, all taken at one instant: one for each exposure of the bracket, in its order.

        Args:
            cameras: names of pairs.
            binning: pixels averaged along each side: 1, 2 or 4.
            link_poses: true `world_from_link` of every link.
            world_from_hex: true pose of the chassis.
            index: counts the captures of a trial; keys the noise, so that a pair's noise does not depend on who else looked.
            exposure: [s]; metered from the left image by default.
            bits: of a grey value, 8 or 12.
            brackets: exposures in multiples of `exposure`.
        """
        drawn = [self._spec.camera(name) for name in cameras]
        robot = self._renderer.place(link_poses)
        out: dict[str, tuple[Shot, ...]] = {}
        for camera in drawn:
            eye = camera.eye.binned(binning)
            world_from_link = world_from_hex if camera.on_chassis else link_poses[camera.link]
            world_from_left = world_from_link.compose(self._link_from_left[camera.name])
            world_from_right = world_from_left.compose(SE3.from_translation(np.array([camera.baseline, 0.0, 0.0])))
            left, right = (
                self._renderer.render(pose, eye, robot) for pose in (world_from_left, world_from_right)
            )
            seconds = metered_exposure(left.image) if exposure is None else exposure
            shots = []
            for bracket, factor in enumerate(brackets):
                images = [
                    develop(
                        radiance, factor * seconds, binning=binning, bits=bits,
                        rng=noise_generator(self._seed, camera.name, index, eye=side, bracket=bracket),
                    )
                    for side, radiance in zip(EYES, (left.image, right.image), strict=True)
                ]  # fmt: skip
                shots.append(
                    Shot(
                        left=images[0], right=images[1], exposure=factor * seconds, seen=left, eye=eye,
                        world_from_left=world_from_left,
                    )
                )  # fmt: skip
            out[camera.name] = tuple(shots)
        return out


def metered_exposure(radiance: np.ndarray) -> float:
    """Exposure that brings the bright part of a picture, sky aside, just below white [s]."""
    lower = radiance[int(METERED_FROM_ROW * len(radiance)) :]
    bright = max(float(np.percentile(lower, METERED_PERCENTILE)), 1e-6)
    return float(np.clip(METERED_LEVEL / (RESPONSE * bright), *EXPOSURES))


def develop(radiance: np.ndarray, exposure: float, *, binning: int, rng: np.random.Generator, bits: int = 8) -> RawImage:
    """The image of a radiance: photon noise, read noise, cut off at white.

    Args:
        radiance: shape (h, w).
        exposure: [s].
        binning: pixels averaged along each side; averaging lowers both kinds of noise.
        rng: of this eye and capture.
        bits: of a grey value: 8 gives uint8, 12 gives uint16.
    """
    if bits not in BITS:
        raise CameraError(f"{bits} bits a grey value is not one of {', '.join(map(str, BITS))}")
    if not (np.isfinite(exposure) and exposure > 0.0):
        raise CameraError(f"exposure is {exposure} s, must be positive, such as {EXPOSURES[0]} to {EXPOSURES[1]} s")
    electrons = np.minimum(np.maximum(radiance, 0.0) * (exposure * RESPONSE), 4.0) * WHITE_ELECTRONS
    # A pixel's photon noise is near Gaussian above some 20 electrons, and below that the read noise covers it.
    sigma = np.sqrt(electrons + READ_ELECTRONS**2) / binning
    noisy = electrons + sigma * rng.standard_normal(radiance.shape, dtype=np.float32)
    white = 2.0**bits - 1.0
    grey: np.ndarray = np.clip(np.rint(noisy * (white / WHITE_ELECTRONS)), 0.0, white)
    return grey.astype(np.uint8 if bits == 8 else np.uint16)


def noise_generator(seed: int, camera: str, index: int, *, eye: str, bracket: int = 0) -> np.random.Generator:
    """The random generator of one eye's noise in one exposure of one capture."""
    key = [seed, zlib.crc32(b"camera_noise"), zlib.crc32(camera.encode()), EYES.index(eye), index]
    # The first exposure's noise is that of a single one: a bracket stays paired with it.
    return np.random.default_rng([*key, bracket] if bracket else key)
