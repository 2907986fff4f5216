"""Faults that a scenario injects at a time: what breaks in the vehicle while it works, for tests of whoever drives it.

    [[fault]]
    kind = "stuck_joint"      # the motor of `joint` of `leg` does not turn any more
    t = 300.0                 # mission time [s]
    leg = 2                   # 1 to 6
    joint = "knee_pitch"

- `stuck_joint`: leg, joint.
- `encoder_bias`: leg, joint, value: the joint's absolute encoder reads so much more from then on [deg]; its torque, read
  from the difference of two encoders, is off as well.
- `torque_drift`: leg, joint, value: the torque reading grows by so much a minute [N m/min].
- `soft_tyre`: leg, value: part that is left of the stiffness of this tyre pumped up, 0.05 to 1; its contact pressure goes
  with it. A tyre only loses: of two such faults the smaller value counts.
- `dead_camera`: camera: its pictures are black from then on.
- `brown_out`: value: the executive loses its sequence and its queue and answers nothing for so long [s]; brakes hold.
"""

from __future__ import annotations

from dataclasses import dataclass

INJECTED_KINDS = ("stuck_joint", "encoder_bias", "torque_drift", "soft_tyre", "dead_camera", "brown_out")
NEEDS: dict[str, tuple[str, ...]] = {
    "stuck_joint": ("leg", "joint"),
    "encoder_bias": ("leg", "joint", "value"),
    "torque_drift": ("leg", "joint", "value"),
    "soft_tyre": ("leg", "value"),
    "dead_camera": ("camera",),
    "brown_out": ("value",),
}
"""keys that each kind needs besides `kind` and `t`, and no others"""
BOUNDS: dict[str, tuple[float, float]] = {
    "encoder_bias": (-10.0, 10.0),
    "torque_drift": (-1000.0, 1000.0),
    "soft_tyre": (0.05, 1.0),
    "brown_out": (0.0, 3600.0),
}
"""of `value`, in the kind's unit"""


@dataclass(frozen=True, kw_only=True)
class InjectedFault:
    """One thing that breaks at one time."""

    kind: str
    """one of `INJECTED_KINDS`"""
    t: float
    """mission time [s]"""
    leg: int = -1
    """index 0 to 5, -1 where none is concerned"""
    joint: str = ""
    camera: str = ""
    value: float = 0.0
    """in the kind's unit"""
