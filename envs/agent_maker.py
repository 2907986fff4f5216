"""Makers of grounds that are not this project's, and how to tell two of them apart."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from athlete_twin.model.spec import RobotSpec
from planner.decisions import GroundAgent

AgentMaker = Callable[[RobotSpec, tuple[float, float], int], GroundAgent]
"""a ground from drawings, goal in world [m] and seed"""
PLAIN = (bool, int, float, str, bytes, type(None))


def identity_of(maker: Callable[..., Any]) -> str:
    """What makes a maker, in words that are the same in every process: its place, and the plain values that it holds.

    Values that are not plain (objects) are not looked into: two functions of one place that differ in those alone are taken
    for the same.
    """
    if isinstance(maker, partial):
        keywords = tuple(value for pair in sorted(maker.keywords.items()) for value in pair)
        return f"partial({identity_of(maker.func)}, {_plain((*maker.args, *keywords))})"
    of = maker if hasattr(maker, "__qualname__") else type(maker)
    name = f"{of.__module__}.{of.__qualname__}"
    code = getattr(maker, "__code__", None)
    if code is None:
        return name
    held = [cell.cell_contents for cell in getattr(maker, "__closure__", None) or ()]
    defaults = getattr(maker, "__defaults__", None) or ()
    return f"{name} {_plain((*code.co_names, *code.co_consts, *held, *defaults))}"


def _plain(value: Any) -> str:
    if isinstance(value, PLAIN):
        return repr(value)
    if isinstance(value, tuple | list):
        return f"({', '.join(_plain(part) for part in value)})"
    return str(getattr(value, "__qualname__", type(value).__qualname__))
