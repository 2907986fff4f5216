"""Both sides joined over the link: Gymnasium environments, recordings, trials.

`import envs` registers the ids and imports nothing heavy; `gymnasium.make("envs:AthleteTwin/SdmB-v0")` does it by itself.
A folder of your own called `envs` beside your script would shadow this package.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym

_ROBOTS = {"SdmB": "sdm_b", "T12": "t12"}

for _title, _robot in _ROBOTS.items():
    for _suffix, _entry, _kwargs in (
        ("", "envs.env:UplinkEnv", {}),
        ("-Mock", "envs.env:UplinkEnv", {"body": "mock"}),
        ("-Operator", "envs.operator_env:OperatorEnv", {}),
    ):
        _id = f"AthleteTwin/{_title}{_suffix}-v0"
        if _id not in gym.registry:
            gym.register(id=_id, entry_point=_entry, kwargs={"robot": _robot, **_kwargs})


def __getattr__(name: str) -> Any:
    """`envs.FlatUplink`, imported when asked for: what it needs is not cheap."""
    if name == "FlatUplink":
        from envs.flat_uplink import FlatUplink

        return FlatUplink
    raise AttributeError(f"module 'envs' has no attribute {name!r}")
