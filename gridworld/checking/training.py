"""One training run on a probe's world, and what is seen of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridworld.agents import Agent, PolicySnapshot, TrainingContext, family
from gridworld.config.agents import AgentConfig
from gridworld.envs.observations import make_observation
from gridworld.envs.statistics_env import StatisticsVectorEnv
from gridworld.world.chain import one_hot_policy
from gridworld.world.mdp import FloatArray, IntArray, Mdp

_LAST = 0.6  # of training; what it does after that is its behaviour


@dataclass(frozen=True, eq=False)
class Trained:
    """An implementation after training."""

    mdp: Mdp
    gamma: float
    first: PolicySnapshot  # what it had before training
    last: PolicySnapshot  # what it has learnt
    greedy: FloatArray  # (S, A), its own deterministic policy
    visits: IntArray  # (S, A), its actions in training
    late: IntArray  # (S, A), those in the last two fifths of it
    frozen: list[str]  # the names of the parameters that training left as they were


def build(config: AgentConfig, mdp: Mdp, num_envs: int, seed: int) -> tuple[Agent, TrainingContext]:
    """Build an agent on a world."""
    kind = "none" if config.family == "tabular" else "one_hot"
    envs = StatisticsVectorEnv(num_envs, mdp=mdp, max_episode_steps=mdp.max_episode_steps)
    context = TrainingContext(envs, make_observation(mdp, kind), seed, "cpu")
    return family(config).build(config, context), context


def train(config: AgentConfig, mdp: Mdp, gamma: float, num_envs: int, steps: int, seed: int) -> Trained:
    """Train an agent, with the loop of its own library; raises whatever the implementation raises."""
    agent, context = build(config, mdp, num_envs, seed)
    first, before = agent.snapshot(), _parameters(agent)
    earlier = np.zeros_like(context.envs.visits)

    def watch(step: int) -> int:
        if step <= _LAST * steps:
            earlier[...] = context.envs.visits
        return step + 1

    agent.learn(steps, watch)
    after = _parameters(agent)
    frozen = [name for name, table in before.items() if name in after and np.array_equal(table, after[name])]
    visits = context.envs.visits.copy()
    greedy, predict = agent.snapshot().greedy_policy(), getattr(agent.model, "predict", None)
    if predict is not None:  # a table has none
        actions, _ = predict(context.observation.table(), deterministic=True)
        greedy = one_hot_policy(np.asarray(actions).astype(np.int64), mdp.num_actions)
    return Trained(mdp, gamma, first, agent.snapshot(), greedy, visits, visits - earlier, frozen)


def _parameters(agent: Agent) -> dict[str, NDArray[Any]]:
    policy = getattr(agent.model, "policy", None)
    named = policy.named_parameters() if policy is not None else ()
    return {name: value.detach().cpu().numpy().copy() for name, value in named}
