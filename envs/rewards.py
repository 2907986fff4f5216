"""Reward of one step from the truth, as a sum of named terms. Only progress counts by default."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RewardConfig:
    """Weights; the signs are in the names. A task's designer adds what matters to it."""

    progress: float = 1.0
    """for a metre nearer to the goal"""
    collision_cost: float = 0.0
    """for each contact episode"""
    tip_over_cost: float = 0.0
    """once"""
    goal: float = 0.0
    """once, when the robot stands at the goal"""
    second_cost: float = 0.0
    """for a second of mission time: 3 m take about 1,500 s of motion"""


@dataclass(frozen=True, kw_only=True)
class StepTruth:
    """What a step changed."""

    nearer: float = 0.0
    """by so much the true chassis came nearer to the goal [m]"""
    collisions: int = 0
    """that began"""
    seconds: float = 0.0
    """of mission time"""
    tips: bool = False
    """whether it tipped over in this step"""
    arrives: bool = False
    """whether it came to stand at the goal in this step"""


def reward_terms(step: StepTruth, config: RewardConfig) -> dict[str, float]:
    """What each term gives, by the names of the weights; the reward is their sum."""
    return {
        "progress": config.progress * step.nearer,
        "collision_cost": -config.collision_cost * step.collisions,
        "tip_over_cost": -config.tip_over_cost * step.tips,
        "goal": config.goal * step.arrives,
        "second_cost": -config.second_cost * step.seconds,
    }
