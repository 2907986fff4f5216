"""T12's docks: each deck hangs on the pallet by a joint that bends and one that twists, as springs and dampers.

[SunSpiral2012] s5.1.3: the deck's three parts flex where they are joined, so a lifted leg at a pallet corner drops its
corner more than the springs of the feet can say. SDM-B has no docks: every array here is empty.
"""

from __future__ import annotations

import numpy as np

from athlete_twin.physics.truth import Truth


class DockFlex:
    """Springs of all dock joints, in the order of their names."""

    def __init__(self, truth: Truth, names: list[str]) -> None:
        self._stiffness = np.array(
            [truth.dock_bend_stiffness if n.endswith("bend") else truth.dock_twist_stiffness for n in names]
        )
        self._ratio = truth.dock_damping_ratio
        self._damping = np.zeros(len(names))

    def set_inertias(self, inertias: np.ndarray) -> None:
        """Set the dampers from the inertia that each joint sees [kg m2]."""
        self._damping = 2.0 * self._ratio * np.sqrt(self._stiffness * inertias)

    def torques(self, angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Torques on the dock joints [N m]."""
        return np.asarray(-self._stiffness * angles - self._damping * rates)
