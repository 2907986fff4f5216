"""Single fields of an action, checked: an error names the field, its value and what would have worked.

Numbers beyond the bounds of their space are taken as the bound. What is missing, no number, not finite or of another
shape raises, before anything is sent.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from athlete_twin.errors import CommandError

Action = dict[str, Any]
SHOWN = 60
"""characters of a wrong value in an error"""


def one_of(action: Action, name: str, count: int) -> int:
    """A choice out of so many."""
    value = _numbers(action, name)
    if value is None or value.size != 1 or not 0 <= value.item() < count or value.item() != int(value.item()):
        raise _refused(action, name, f"an integer from 0 to {count - 1}")
    return int(value.item())


def units(action: Action, name: str, size: int) -> np.ndarray:
    """Numbers in [-1, 1], shape (size,)."""
    value = _numbers(action, name)
    if value is None or value.shape != (size,) or not np.isfinite(value).all():
        raise _refused(action, name, f"{size} finite numbers, in [-1, 1]")
    return np.asarray(np.clip(value.astype(float), -1.0, 1.0))


def flags(action: Action, name: str, size: int) -> np.ndarray:
    """Yes or no, shape (size,), bool."""
    value = _numbers(action, name)
    if value is None or value.shape != (size,) or not np.isin(value, (0, 1)).all():
        raise _refused(action, name, f"{size} times 0 or 1")
    return np.asarray(value, dtype=bool)


def _numbers(action: Action, name: str) -> np.ndarray | None:
    """The field as an array of real numbers, None when it is something else."""
    if not isinstance(action, Mapping):
        raise CommandError(f"the action is {_short(action)}, must be a dict of the action space")
    if name not in action:
        raise CommandError(f"action[{name!r}] is missing; the action has: {', '.join(map(str, action)) or 'nothing'}")
    try:
        value = np.asarray(action[name])
    except ValueError:  # a ragged list
        return None
    return value if value.dtype.kind in "biuf" else None


def _refused(action: Action, name: str, wanted: str) -> CommandError:
    return CommandError(f"action[{name!r}] is {_short(action[name])}, must be {wanted}")


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."
