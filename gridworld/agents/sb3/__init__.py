"""Algorithms of Stable-Baselines3, of sb3-contrib and custom ones, which learn on the native batch."""

from gridworld.agents.sb3.settings import SCHEMAS

__all__ = ["SCHEMAS"]
