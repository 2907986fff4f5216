"""What is broken in one twin: applies the faults that its scenario injects, each at its time."""

from __future__ import annotations

import numpy as np

from athlete_twin.errors import ConfigError
from athlete_twin.geometry.arrays import Joints
from athlete_twin.model.spec import LEGS, RobotSpec
from athlete_twin.physics.body import Body
from athlete_twin.sensors.proprioception import Proprioception
from athlete_twin.world.injected import InjectedFault
from athlete_twin.world.scenario import Scenario


class Breakage:
    """Faults that wait for their time, and those at work."""

    def __init__(self, scenario: Scenario, spec: RobotSpec) -> None:
        """Refuses a joint or a camera that this robot does not have: only here scenario and robot have met."""
        for i, fault in enumerate(scenario.faults):
            where = f"scenario {scenario.name!r}: fault[{i}]"
            _known(f"{where}.joint", fault.joint, spec.joint_names, spec.name)
            _known(f"{where}.camera", fault.camera, tuple(c.name for c in spec.cameras), spec.name)
        self._waiting = sorted(scenario.faults, key=lambda f: f.t)
        self._spec = spec
        self._drifts: list[InjectedFault] = []
        self.dead_cameras: set[str] = set()
        self.dark_until = -np.inf
        """until when the executive is without power [s]"""
        self.applied: list[InjectedFault] = []
        """so far, in order"""

    def next_change(self, t: float) -> float:
        """When something breaks or power comes back next, infinite for never [s]."""
        first = self._waiting[0].t if self._waiting else np.inf
        return min(first, self.dark_until if self.dark_until > t else np.inf)

    def dark(self, t: float) -> bool:
        """Whether the executive is without power at mission time `t` [s]."""
        return t < self.dark_until

    def apply(self, t: float, body: Body, senses: Proprioception) -> list[InjectedFault]:
        """Break what is due at mission time `t` [s]; what broke just now."""
        due = []
        while self._waiting and self._waiting[0].t <= t + 1e-9:
            fault = self._waiting.pop(0)
            joint = self._spec.joint_names.index(fault.joint) if fault.joint else -1
            if fault.kind == "stuck_joint":
                body.stick(fault.leg, joint)
            elif fault.kind == "encoder_bias":
                senses.encoder_bias[fault.leg, joint] += np.deg2rad(fault.value)
            elif fault.kind == "torque_drift":
                self._drifts.append(fault)
            elif fault.kind == "soft_tyre":
                body.lose_pressure(fault.leg, fault.value)
            elif fault.kind == "dead_camera":
                self.dead_cameras.add(fault.camera)
            elif fault.kind == "brown_out":
                self.dark_until = max(self.dark_until, t + fault.value)
            self.applied.append(fault)
            due.append(fault)
        return due

    def torque_offset(self, t: float) -> Joints:
        """What the torque readings are off by at mission time `t`, shape (6, dof) [N m]."""
        out = np.zeros((LEGS, self._spec.dof))
        for fault in self._drifts:
            out[fault.leg, self._spec.joint_names.index(fault.joint)] += fault.value * (t - fault.t) / 60.0
        return out


def _known(key: str, name: str, known: tuple[str, ...], robot: str) -> None:
    if name and name not in known:
        raise ConfigError(f"{key} = {name!r} is not on {robot}; it has {', '.join(known)}")
