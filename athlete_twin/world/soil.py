"""What the ground is made of: friction, bearing strength and looks. Rocks are hard, whatever lies between them.

Model: pressure-sinkage `P = k delta^n` [Caillas1989] eq. 5. The constants are estimates: they are chosen so that
SDM-B's tyre pressure (55 kPa) sinks as deep as the field reports and photographs suggest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from athlete_twin.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class SoilMaterial:
    """One material under a wheel."""

    name: str
    friction: float
    """Coulomb coefficient against a tyre"""
    sinkage_modulus: float
    """k of P = k delta^n [Pa/m^n]"""
    sinkage_exponent: float
    """n of P = k delta^n"""
    albedo: float
    """share of the sunlight that it reflects"""
    colour: tuple[float, float, float]
    """red, green, blue, linear, 0 to 1; only the ratio matters beside `albedo`"""

    def sinkage(self, pressure: np.ndarray | float) -> np.ndarray:
        """Depth at which the ground carries a pressure [Pa], shape of `pressure` [m]."""
        loaded = np.maximum(np.asarray(pressure, dtype=float), 0.0) / self.sinkage_modulus
        return np.asarray(loaded ** (1.0 / self.sinkage_exponent))

    def pressure(self, depth: np.ndarray | float) -> np.ndarray:
        """Pressure that the ground carries at a depth [m], shape of `depth` [Pa]."""
        below = np.maximum(np.asarray(depth, dtype=float), 0.0)
        return np.asarray(self.sinkage_modulus * below**self.sinkage_exponent)


MATERIALS: dict[str, SoilMaterial] = {
    material.name: material
    for material in (
        # Sinkage at 55 kPa: under 0.1 mm.
        SoilMaterial(
            name="concrete",
            friction=0.75,
            sinkage_modulus=1.0e9,
            sinkage_exponent=1.0,
            albedo=0.42,
            colour=(0.50, 0.48, 0.45),
        ),
        # Decomposed granite of a test yard: 1.1 cm.
        SoilMaterial(
            name="packed_soil",
            friction=0.60,
            sinkage_modulus=5.0e6,
            sinkage_exponent=1.0,
            albedo=0.32,
            colour=(0.56, 0.42, 0.30),
        ),
        # 4.4 cm.
        SoilMaterial(
            name="dune_sand",
            friction=0.50,
            sinkage_modulus=1.7e6,
            sinkage_exponent=1.1,
            albedo=0.38,
            colour=(0.62, 0.52, 0.38),
        ),
        # Loose sand on a hard-packed base, [SunSpiral2012] s5.3.4: 0.4 cm, friction 0.4 to 0.5 by the 14 deg slope.
        SoilMaterial(
            name="sand_over_hard",
            friction=0.45,
            sinkage_modulus=1.5e7,
            sinkage_exponent=1.0,
            albedo=0.34,
            colour=(0.60, 0.47, 0.34),
        ),
        # Weathered basalt with cinders in its hollows: 0.3 cm.
        SoilMaterial(
            name="lava",
            friction=0.70,
            sinkage_modulus=2.0e7,
            sinkage_exponent=1.0,
            albedo=0.20,
            colour=(0.44, 0.34, 0.29),
        ),
        SoilMaterial(
            name="rock",
            friction=0.70,
            sinkage_modulus=1.0e10,
            sinkage_exponent=1.0,
            albedo=0.25,
            colour=(0.45, 0.40, 0.36),
        ),
    )
}
"""every material by its name"""

ROCK = MATERIALS["rock"]


def soil_material(name: str) -> SoilMaterial:
    """A material by its name."""
    if name not in MATERIALS:
        raise ConfigError(f"soil {name!r} is not known; known: {', '.join(sorted(MATERIALS))}")
    return MATERIALS[name]
