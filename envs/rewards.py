"""Reward of one step from the truth: progress towards the goal, less collisions and time."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Weights; the signs are in the names."""

    progress: float = 1.0
    """for a metre nearer to the goal"""
    collision_cost: float = 1.0
    """for each contact episode"""
    tip_over_cost: float = 10.0
    """once"""
    goal: float = 10.0
    """once, when the robot stands at the goal"""
    second_cost: float = 1e-4
    """for a second of mission time: 3 m take about 1,500 s of motion"""


@dataclass(frozen=True, kw_only=True)
class StepTruth:
    """What a step changed."""

    nearer: float
    """by so much the true chassis came nearer to the goal [m]"""
    collisions: int
    """that began"""
    seconds: float
    """of mission time"""
    tipped: bool
    at_goal: bool


def reward(step: StepTruth, config: RewardConfig) -> float:
    """Sum of the terms."""
    return (
        config.progress * step.nearer
        - config.collision_cost * step.collisions
        - config.second_cost * step.seconds
        - config.tip_over_cost * step.tipped
        + config.goal * step.at_goal
    )
