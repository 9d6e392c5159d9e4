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
from gridworld.world.exact.markov_chain import one_hot_policy
from gridworld.world.mdp import FloatArray, IntArray, Mdp

_LAST = 0.6  # of training; what it does after that is its behaviour


@dataclass(frozen=True, eq=False)
class Trained:
    """An implementation after training.

    Attributes:
        mdp: the world.
        gamma: the discount.
        first: what it had before training.
        last: what it has learnt.
        greedy: (S, A), its own deterministic policy.
        visits: (S, A), its actions in training.
        late: (S, A), those in the last two fifths of it.
        frozen: the names of the parameters that training left as they were.
    """

    mdp: Mdp
    gamma: float
    first: PolicySnapshot
    last: PolicySnapshot
    greedy: FloatArray
    visits: IntArray
    late: IntArray
    frozen: list[str]


def build(config: AgentConfig, mdp: Mdp, num_envs: int, seed: int) -> tuple[Agent, TrainingContext]:
    """Build an agent on a world."""
    kind = "none" if config.family == "tabular" else "one_hot"
    envs = StatisticsVectorEnv(num_envs, mdp=mdp, max_episode_steps=mdp.max_episode_steps)
    context = TrainingContext(envs, make_observation(mdp, kind), seed, "cpu")
    return family(config).build(config, context), context


def train(config: AgentConfig, mdp: Mdp, gamma: float, num_envs: int, steps: int, seed: int) -> Trained:
    """Train an agent, with the loop of its own library.

    Args:
        config: its settings, the discount among them.
        mdp: the world.
        gamma: the discount.
        num_envs: environments that step together.
        steps: environment steps.
        seed: of everything.

    Raises:
        InputError: it was refused, or diverged.
        Exception: whatever the implementation raises.
    """
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
    greedy = _greedy(agent, context)
    return Trained(mdp, gamma, first, agent.snapshot(), greedy, visits, visits - earlier, frozen)


def _greedy(agent: Agent, context: TrainingContext) -> FloatArray:
    """What its own `predict` does in every state; of a table, what is best in it."""
    predict = getattr(agent.model, "predict", None)
    if predict is None:
        return agent.snapshot().greedy_policy()
    actions, _ = predict(context.observation.table(), deterministic=True)
    return one_hot_policy(np.asarray(actions).astype(np.int64), context.envs.mdp.num_actions)


def _parameters(agent: Agent) -> dict[str, NDArray[Any]]:
    policy = getattr(agent.model, "policy", None)
    named = policy.named_parameters() if policy is not None else ()
    return {name: value.detach().cpu().numpy().copy() for name, value in named}
