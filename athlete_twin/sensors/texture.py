"""Fine texture of ground, rocks and robot, evaluated where a ray hits: grain that stereo matching can hold on to.

Sums of smoothed lattice noise, hashed from the hit point, so that both eyes and every later picture see the same grain
at the same place. Octaves finer than a pixel fade out, as a lens would blur them.
"""

from __future__ import annotations

from typing import no_type_check

import numba
import numpy as np

SKY, GROUND, ROCK, ROBOT = 0, 1, 2, 3
"""labels of a pixel"""

WAVELENGTHS = np.array([1.6, 0.8, 0.4, 0.2, 0.1, 0.05, 0.025, 0.0125, 0.006])
"""of the octaves [m]"""
CONTRAST = np.array(
    [
        [0.0] * 9,
        [0.05, 0.05, 0.06, 0.08, 0.11, 0.15, 0.17, 0.15, 0.12],
        [0.04, 0.06, 0.08, 0.10, 0.12, 0.14, 0.14, 0.12, 0.10],
        [0.00, 0.03, 0.04, 0.05, 0.05, 0.06, 0.06, 0.05, 0.04],
    ]
)
"""brightness of each octave by label: gravel of 2 to 10 cm shows most on the ground"""
BUMP = np.array(
    [
        [0.0] * 9,
        [0.000, 0.003, 0.006, 0.014, 0.022, 0.030, 0.034, 0.034, 0.030],
        [0.000, 0.004, 0.012, 0.028, 0.040, 0.050, 0.050, 0.045, 0.040],
        [0.000, 0.000, 0.000, 0.000, 0.001, 0.002, 0.003, 0.003, 0.003],
    ]
)
"""relief of each octave over its wavelength, by label: what the sun's angle makes visible"""
_TURN = np.array([[0.36, 0.48, -0.80], [-0.80, 0.60, 0.00], [0.48, 0.64, 0.60]])
# Each octave is turned, or the lattice would show; on the ground about the vertical alone.
_TURNS = np.stack([np.linalg.matrix_power(_TURN, n + 1) for n in range(len(WAVELENGTHS))])
_FLAT_TURNS = np.stack([np.array([np.cos(1.1 * n + 0.4), np.sin(1.1 * n + 0.4)]) for n in range(len(WAVELENGTHS))])


@no_type_check
@numba.njit(inline="always")
def _value(hx, hy, hz):  # type: ignore[no-untyped-def]
    h = np.uint32(hx ^ hy ^ hz)
    h = np.uint32((h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D))
    h = np.uint32((h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39))
    h = np.uint32(h ^ (h >> np.uint32(15)))
    return h * (2.0 / 4294967295.0) - 1.0


@no_type_check
@numba.njit(nogil=True, cache=True, error_model="numpy")
def grain(px, py, pz, nx, ny, nz, kind, footprint):  # type: ignore[no-untyped-def]
    """Brightness factor and bent unit normal (three components) of one surface point.

    Point and normal are in the frame that carries the texture: world for ground and rocks, the link for the robot [m].
    `footprint` is the size of a pixel on the surface [m].
    """
    brightness, gx, gy, gz = 1.0, 0.0, 0.0, 0.0
    for octave in range(WAVELENGTHS.shape[0]):
        wave = WAVELENGTHS[octave]
        # Full where a wave spans four pixels, gone at two.
        fade = min(0.5 * wave / footprint - 1.0, 1.0)
        if fade <= 0.0:
            break
        scale = 2.0 / wave
        strength = 2.0 * fade * BUMP[kind, octave]
        seed = np.uint32((octave + 1) * 0x9E3779B1)
        if kind == 1:
            c, s = _FLAT_TURNS[octave, 0], _FLAT_TURNS[octave, 1]
            x, y = scale * (c * px + s * py), scale * (c * py - s * px)
            fx, fy = np.floor(x), np.floor(y)
            hx, hy = np.uint32(int(fx)) * np.uint32(0x8DA6B343), np.uint32(int(fy)) * np.uint32(0xD8163841)
            hx1, hy1 = np.uint32(hx + np.uint32(0x8DA6B343)), np.uint32(hy + np.uint32(0xD8163841))
            fx, fy = x - fx, y - fy
            ux, uy = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy)
            v00, v10 = _value(hx, hy, seed), _value(hx1, hy, seed)
            v01, v11 = _value(hx, hy1, seed), _value(hx1, hy1, seed)
            low, high = v00 + ux * (v10 - v00), v01 + ux * (v11 - v01)
            brightness += fade * CONTRAST[kind, octave] * (low + uy * (high - low))
            dx = 6.0 * fx * (1.0 - fx) * strength * ((1.0 - uy) * (v10 - v00) + uy * (v11 - v01))
            dy = 6.0 * fy * (1.0 - fy) * strength * (high - low)
            gx += c * dx - s * dy
            gy += s * dx + c * dy
            continue
        turn = _TURNS[octave]
        x = scale * (turn[0, 0] * px + turn[0, 1] * py + turn[0, 2] * pz)
        y = scale * (turn[1, 0] * px + turn[1, 1] * py + turn[1, 2] * pz)
        z = scale * (turn[2, 0] * px + turn[2, 1] * py + turn[2, 2] * pz)
        fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
        hx, hy = np.uint32(int(fx)) * np.uint32(0x8DA6B343), np.uint32(int(fy)) * np.uint32(0xD8163841)
        hz = np.uint32(np.uint32(int(fz)) * np.uint32(0xCB1AB31F) + seed)
        hx1, hy1 = np.uint32(hx + np.uint32(0x8DA6B343)), np.uint32(hy + np.uint32(0xD8163841))
        hz1 = np.uint32(hz + np.uint32(0xCB1AB31F))
        fx, fy, fz = x - fx, y - fy, z - fz
        ux, uy, uz = fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy), fz * fz * (3.0 - 2.0 * fz)
        a, b, c, d = _value(hx, hy, hz), _value(hx1, hy, hz), _value(hx, hy1, hz), _value(hx1, hy1, hz)
        e, f, g, h = _value(hx, hy, hz1), _value(hx1, hy, hz1), _value(hx, hy1, hz1), _value(hx1, hy1, hz1)
        low, low_far = a + ux * (b - a), c + ux * (d - c)
        high, high_far = e + ux * (f - e), g + ux * (h - g)
        near, far = low + uy * (low_far - low), high + uy * (high_far - high)
        brightness += fade * CONTRAST[kind, octave] * (near + uz * (far - near))
        if strength > 0.0:
            dx = (1.0 - uz) * ((1.0 - uy) * (b - a) + uy * (d - c)) + uz * ((1.0 - uy) * (f - e) + uy * (h - g))
            dy = (1.0 - uz) * (low_far - low) + uz * (high_far - high)
            dx *= 6.0 * fx * (1.0 - fx) * strength
            dy *= 6.0 * fy * (1.0 - fy) * strength
            dz = 6.0 * fz * (1.0 - fz) * strength * (far - near)
            gx += turn[0, 0] * dx + turn[1, 0] * dy + turn[2, 0] * dz
            gy += turn[0, 1] * dx + turn[1, 1] * dy + turn[2, 1] * dz
            gz += turn[0, 2] * dx + turn[1, 2] * dy + turn[2, 2] * dz
    along = gx * nx + gy * ny + gz * nz
    bx, by, bz = nx - gx + along * nx, ny - gy + along * ny, nz - gz + along * nz
    length = np.sqrt(bx * bx + by * by + bz * bz)
    return max(brightness, 0.15), bx / length, by / length, bz / length
