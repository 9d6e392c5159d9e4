"""Causes in what a run tried: too little of it, or not long enough."""

from __future__ import annotations

import numpy as np

from gridworld.base.bounds import LINEAR
from gridworld.diagnosis.evidence import Evidence, Finding, best_of_what_was_tried, longer, percent
from gridworld.world.chain import Chain
from gridworld.world.mdp import BoolArray

_FEWEST = 3  # tries of an action where they are used once; one that is kept may do
_EXPLAINED = 0.5  # of what its policy loses from a state on
_RANDOM = 0.5  # of all steps, or of a uniform policy's entropy: above, it did explore
_DECIDED = 0.3  # of a uniform policy's entropy: below, it hardly explores
_WIDE = 128  # environments
_BONUS = 0.1  # what a first visit pays
_LEFT = 0.2  # of how often the first policy met the goal
_NEVER = 0.01  # of all steps
_RARE = 1e-4  # of all episodes


def not_tried(run: Evidence) -> Finding | None:
    """One that had learned everything from the actions tried could not do much better."""
    ahead = best_of_what_was_tried(run.evaluator, run.visits >= (_FEWEST if run.is_actor_critic else 1))
    best, ours = run.evaluator.solution, Chain(run.mdp, run.snapshot.greedy_policy())
    with np.errstate(invalid="ignore"):
        missing = best.v - ahead >= _EXPLAINED * (best.v - ours.value(best.gamma))
    states = run.split.wrong & (missing | (run.visits.sum(axis=1) == 0))
    return _exploration(run, states, "the actions it needs were hardly ever tried") if states.any() else None


def collapsed(run: Evidence) -> Finding | None:
    """A policy that settled on something else before it knew better."""
    best, goal = run.evaluator.optimum.goal, run.curve.get("sampled_goal_probability")
    if not run.is_actor_critic or goal is None:
        return None
    decided = run.split.wrong & (run.spread < _DECIDED)
    if goal[-1] > 0.5 * best:  # it gets there, by a detour
        states = decided if run.last_setting("ent_coef") <= 0 else decided & False
    else:
        states = decided | (run.split.wrong & (goal[-1] < _LEFT * goal[0]))
    if not states.any():
        return None
    first, last = ("practically never" if each < _RARE else f"in {percent(each)}" for each in goal[[0, -1]])
    first = f"{first} of episodes" if first.endswith("%") else first
    why = f"while it explored, it reached the goal {first} at first and {last} at the end"
    return _exploration(run, states, why)


def never_random(run: Evidence) -> Finding | None:
    """It hardly ever took a random action, and nothing else led it away from its own policy."""
    has_epsilon = run.setting("exploration_final_eps", -1.0) >= 0
    is_led, random = run.config.exploration_bonus or run.config.exploring_starts, _random(run)
    explored = random >= _NEVER or random * run.config.total_timesteps >= run.steps_to_goal
    if is_led or explored or not has_epsilon:
        return None
    return _exploration(run, run.split.wrong, "it hardly ever took a random action")


def ended_early(run: Evidence) -> Finding | None:
    """Its random steps were fewer than a random walk needs to meet the goal twice."""
    optimistic = run.setting("initial_value") >= run.own.v[run.mdp.acting].max()
    explored = _random(run) * run.config.total_timesteps >= 2 * run.steps_to_goal
    if run.is_actor_critic or optimistic or explored:
        return None
    why = "it stopped trying other actions before their values were known"
    return _exploration(run, run.split.wrong, why)


def _exploration(run: Evidence, states: BoolArray, why: str) -> Finding:
    """Whether the steps were too few even for a random walk, or were not used to explore."""
    total, random, needed = run.config.total_timesteps, _random(run), run.steps_to_goal
    told = "" if np.isinf(needed) else f"; a random walk finds the goal once in {needed:,.0f} steps"
    if (total < needed and random >= _NEVER) or random > _RANDOM:
        changes = (longer(run, 10), *_explore(run)[:2])
        return Finding("budget", states, f"{why}{told}, and it had {total:,}", changes)
    spent = "" if run.is_actor_critic else f", and {random * total:,.0f} of its {total:,} were random"
    is_paid = run.is_actor_critic and not run.config.exploration_bonus
    more = f"{longer(run, 10, keep_rate=True)} exploration_bonus={_BONUS}" if is_paid else longer(run, 10)
    return Finding("exploration", states, f"{why}{told}{spent}", (*_explore(run), more)[:3])


def _random(run: Evidence) -> float:
    """How random it acted: the mean epsilon over training, or the entropy that is left of its policy."""
    if run.is_actor_critic:
        goal = run.curve.get("sampled_goal_probability", np.ones(1))
        return 0.0 if goal[-1] < _LEFT * goal[0] else float(run.spread[run.mdp.acting].mean())
    start, end = run.setting("exploration_initial_eps"), run.setting("exploration_final_eps")
    fraction = min(1.0, run.setting("exploration_fraction"))
    return fraction * (start + end) / 2 + (1 - fraction) * end


def _explore(run: Evidence) -> tuple[str, ...]:
    visits = () if run.config.exploration_bonus else (f"exploration_bonus={_BONUS}",)
    if run.is_actor_critic:
        bonus = min(max(10 * run.setting("ent_coef"), 0.1), 1.0)
        wider = (f"n_envs={_WIDE}",) if run.config.n_envs < _WIDE else ()
        falls = run.last_setting("ent_coef") < run.setting("ent_coef")
        value = f"{LINEAR}{bonus:g}" if falls else bonus
        entropy = (run.change("ent_coef", value),) if run.takes("ent_coef") else visits
        return *entropy, *wider
    names = ("exploration_initial_eps", "exploration_fraction")
    changes = tuple(run.change(name, 1.0) for name in names if run.setting(name) < 1)
    return changes or (run.change("exploration_final_eps", 0.3), *visits)
