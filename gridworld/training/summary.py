"""A run's summary: the content of summary.json."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from gridworld.config.settings import privileges
from gridworld.config.train import AUTO, TrainConfig
from gridworld.run.summary import MOST_NAMED, Summary
from gridworld.training.learning_curve import Evaluation, LearningCurve
from gridworld.world.exact.evaluation import Evaluator, Score
from gridworld.world.mdp import EXACT, FloatArray
from gridworld.world.metrics import numbers, optimal_numbers

CLOCK = {"train_seconds", "evaluation_seconds"}  # the summary's times


def summarise(config: TrainConfig, curve: LearningCurve, last: Evaluation, seconds: float) -> Summary:
    """Put the summary together.

    Args:
        config: the run's settings.
        curve: the learning curve.
        last: the evaluation after training.
        seconds: how long training took, evaluations included.

    Returns:
        The fields of `summary.json`; numbers may be infinite here.
    """
    evaluator, certificate = curve.evaluator, curve.certificate
    return {
        "agent": config.agent.name,
        "env": evaluator.mdp.name,
        **_of_another_truth(evaluator.mdp.truth),
        "observation": config.observation.kind,
        "seed": config.seed,
        "recipe": config.recipe,
        "preset": config.preset if config.preset != AUTO else "none",
        "privileges": privileges(dataclasses.asdict(config)),
        "total_timesteps": config.total_timesteps,
        "timesteps": last.step,
        "gamma": config.evaluation.gamma,
        "max_episode_steps": evaluator.max_episode_steps,
        "certified": last.greedy.certified,
        "first_certified_step": certificate.first_certified_step,
        "certified_since_step": certificate.certified_since_step,
        "best_step": curve.best.step,
        "best_regret": curve.best.regret,
        **optimal_numbers(evaluator),
        **_scores(last.greedy),
        **_endless(evaluator, last.snapshot.greedy_policy()),
        "sampled": _scores(last.sampled),
        "train_seconds": round(seconds, 3),
        "evaluation_seconds": round(curve.seconds, 3),
    }


def _endless(evaluator: Evaluator, policy: FloatArray) -> dict[str, list[Any]]:
    """The states in which a policy loops: as files have them, and the first few by their names."""
    states = evaluator.endless_states(policy)
    return {
        "endless_cells": [evaluator.mdp.coordinates(state) for state in states],
        "endless_states": [evaluator.mdp.state_name(state) for state in states[:MOST_NAMED]],
    }


def _of_another_truth(truth: str) -> dict[str, str]:
    return {} if truth == EXACT else {"truth": truth}


def as_json(content: Any) -> Any:
    """The same with null for what JSON has no number for: an endless walk at γ = 1 is worth -inf."""
    if isinstance(content, dict):
        return {key: as_json(value) for key, value in content.items()}
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _scores(score: Score) -> dict[str, float]:
    """The metrics; the certificate stands in the summary once, for the greedy policy."""
    return {name: number for name, number in numbers(score).items() if name != "certified"}
