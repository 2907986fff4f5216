"""Copies of what changes in an object, to come back to: a branch for look-ahead.

Everything is copied deep but what is named as shared, wherever it is met: drawings, ground, callbacks, scratch memory.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

Moment = dict[str, Any]


def taken(attributes: Moment, shared: Iterable[object]) -> Moment:
    """A copy of an object's attributes that what happens later does not change."""
    return copy.deepcopy(attributes, {id(thing): thing for thing in shared})
