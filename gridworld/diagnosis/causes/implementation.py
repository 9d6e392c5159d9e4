"""The cause in a custom class, found by the class that it is derived from.

A setting that is wrong is wrong for both. So Stable-Baselines3's own class trains in the place of the derived
one, with the same settings on the same world: where that is certified, the difference is in the class.
"""

from __future__ import annotations

import inspect
import time
from dataclasses import replace

from gridworld.agents.sb3.settings import SB3ClassConfig, SB3Config
from gridworld.base.errors import InputError
from gridworld.config.train import AgentConfig
from gridworld.diagnosis.evidence import Evidence, Finding
from gridworld.training.setup import make_context

_LIBRARIES = ("stable_baselines3", "sb3_contrib")
_SEEDS = 2  # its own and the next, as one that was certified may have been lucky
_SECONDS = 2.5  # of the processor


def faulty_class(run: Evidence) -> Finding | None:
    """The library's own class is certified with the same settings."""
    if (sound := of_library(run.config.agent)) is None:
        return None
    until, steps = time.process_time() + _SECONDS, []
    lost = bool(run.curve["certified"].any())
    for seed in range(run.config.seed, run.config.seed + _SEEDS):
        if (found := _certified_after(run, sound, seed, until, lost)) is None:
            return None
        steps.append(f"{found:,}")
    own, seed = run.config.agent.algorithm, run.config.seed
    when = f"{'still at' if lost else 'at'} steps {' and '.join(steps)} (seeds {seed} and {seed + 1})"
    why = (
        f"its class is at fault: with the same settings, {sound.algorithm} is certified {when}; check.py "
        f"{own} shows what is wrong"
    )
    return Finding("implementation", run.split.wrong, why, (f"agent.algorithm={sound.algorithm}",))


def of_library(config: AgentConfig) -> SB3Config | None:
    """The same settings for the library's class that a class is derived from; None: it is that itself."""
    if not isinstance(config, SB3Config) or config.algorithm == type(config).algorithm:
        return None
    if not isinstance(config, SB3ClassConfig):
        return replace(config, algorithm=type(config).algorithm, engine="tabulated")
    from gridworld.agents.sb3.factory import import_class  # imports torch

    kinds = import_class("agent.algorithm", config.algorithm).__mro__
    first = next((kind for kind in kinds if kind.__module__.split(".")[0] in _LIBRARIES), None)
    if first in (None, kinds[0]) or not getattr(first, "policy_aliases", None):
        return None
    known = inspect.signature(first).parameters
    arguments = {name: value for name, value in config.arguments.items() if name in known}
    path = f"{first.__module__.split('.')[0]}.{first.__name__}"
    return replace(config, algorithm=path, arguments=arguments, engine="tabulated")


def _certified_after(
    run: Evidence, agent: SB3Config, seed: int, until: float, to_the_end: bool
) -> int | None:
    """The steps until a certificate, the first or that at the end; None: there is none, or not in time."""
    config = replace(run.config, agent=agent, seed=seed, callbacks=[])
    every, due, found = config.evaluation.every, 0, None

    def watch(step: int) -> int:
        nonlocal due, found
        if step >= min(due, config.total_timesteps):
            due = (step // every + 1) * every
            certified = run.evaluator.score(learner.snapshot().greedy_policy()).certified
            found = step if certified else None
        goes_on = (to_the_end or found is None) and time.process_time() < until
        return due if goes_on else 0

    try:
        learner = agent.build(make_context(config, run.mdp))
        learner.learn(config.total_timesteps, watch)
    except InputError:  # it diverged
        return None
    return found if time.process_time() < until else None
